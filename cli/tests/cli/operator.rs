//! What an operator does by commands: each as a table and as JSON, with its exit codes.

use serde_json::{Value, json};

use crate::terminal::eventually;
use crate::yard::{ROBOT, Ran, Yard};

/// A mission far longer than any test.
const LONG_CIRCLE: [&str; 8] = [
    "send", "circle", "--robot", ROBOT, "--center", "8,6", "--radius", "3",
];

fn id_of(value: &Value) -> String {
    value["id"].as_str().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_ground_is_drawn_changed_and_asked_about_by_commands() {
    let yard = Yard::start().await;
    let sites = yard.json(&["sites"]).await;
    assert_eq!(sites[0]["id"], "yard");
    yard.table(&["sites", "create", "annex", "--cell", "0.5"])
        .await;
    assert!(yard.table(&["sites"]).await.contains("annex"));
    let quay = ["sites", "create", "quay", "--origin", "-33.86,151.21"];
    let quay = yard.json(&[&quay[..], &["--x-axis", "-30"]].concat()).await;
    let place = |latitude: f64, longitude: f64, x_axis: f64| json!({"latitude_deg": latitude, "longitude_deg": longitude, "x_axis_deg": x_axis});
    assert_eq!(quay["origin"], place(-33.86, 151.21, -30.0));
    let placed = yard
        .json(&["sites", "set-origin", "annex", "48.14,11.57"])
        .await;
    assert_eq!(placed["origin"], place(48.14, 11.57, 0.0));
    let listed = yard.table(&["sites"]).await;
    assert!(listed.contains("48.140000,11.570000 x axis 0°"), "{listed}");
    let removed = yard.json(&["sites", "remove-origin", "annex"]).await;
    assert_eq!(removed["origin"], Value::Null);

    let corners = ["0,0", "6,0", "6,4", "-1,4"];
    let create = ["terrains", "create", "sand-pit", "--class", "sand"];
    yard.table(&[&create[..], &corners[..]].concat()).await;
    // Twice is a conflict, and so said.
    let again = yard.run(&[&create[..], &corners[..]].concat()).await;
    assert_eq!(again.code, Some(6), "{}", again.errors);
    assert!(again.errors.contains("next: "), "{}", again.errors);
    let change = ["terrains", "change", "sand-pit", "--class", "gravel"];
    let changed = yard.json(&change).await;
    assert_eq!(
        (&changed["class"], &changed["revision"]),
        (&json!("gravel"), &json!(2))
    );
    assert_eq!(
        changed["polygon"].as_array().map(Vec::len),
        Some(4),
        "the corners stay"
    );
    let shown = yard.table(&["terrains", "show", "sand-pit"]).await;
    assert!(shown.contains("-1.00"), "{shown}");

    let point = yard.json(&["friction", "point", "1,1"]).await;
    assert_eq!(point["terrain"]["id"], "sand-pit");
    let point = yard.table(&["friction", "point", "-9,1"]).await;
    assert!(point.contains("no terrain is drawn there"), "{point}");
    let path = ["friction", "path", "--robot", ROBOT, "0,0", "4,0", "4,3"];
    let along = yard.json(&path).await;
    assert_eq!(along["length_m"], 7.0);
    assert!(yard.table(&path).await.contains("MU LIMIT"));
    for words in [
        &["friction"][..],
        &["friction", "terrains", "sand-pit", "--as-of", "1h"],
        &["friction", "history", "sand-pit", "--from", "3h"],
        &[
            "friction", "history", "-9,1", "--from", "5m", "--step", "1m",
        ],
        &["friction", "cells", "--box", "-5,-5,5,5"],
        &["friction", "difference", "--from", "2h"],
        &["friction", "visits", "--box", "0,0,4,4", "--limit", "3"],
        &["friction", "robots"],
        &["friction", "withdrawals"],
    ] {
        assert!(!yard.table(words).await.trim().is_empty(), "{words:?}");
        yard.json(words).await;
    }
    let history = ["friction", "history", "1,1", "--from", "5m", "--step", "1m"];
    let items = &yard.json(&history).await["items"];
    assert_eq!(items.as_array().map(Vec::len), Some(6), "{items}");
    // Tables say of which time they are: a whole minute, not the time that was asked for.
    for (words, says) in [
        (
            &["friction", "terrains", "sand-pit", "--as-of", "90m"][..],
            "as of ",
        ),
        (&["friction", "cells", "--as-of", "90m"], "as of "),
        (&["friction", "point", "1,1", "--as-of", "90m"], "as of "),
        (
            &["friction", "difference", "--from", "150m", "--to", "90m"],
            "from ",
        ),
    ] {
        let table = yard.table(words).await;
        let first = table.lines().next().unwrap_or_default();
        assert!(
            first.starts_with(says) && first.ends_with(":00Z"),
            "{words:?}: {table}"
        );
    }
    // A picture is drawn of any box, whether or not anybody has driven there.
    let picture = yard.folder.path().join("map.png");
    let map = ["friction", "map", "--png", picture.to_str().unwrap()];
    let drawn = yard
        .run(&[&map[..], &["--box", "0,0,8,6", "--scale", "4"]].concat())
        .await;
    assert_eq!(drawn.code, Some(0), "{}", drawn.errors);
    let bytes = std::fs::read(&picture).unwrap();
    assert!(bytes.starts_with(b"\x89PNG\r\n\x1a\n"));
    let said = yard.json(&[&map[..], &["--box", "0,0,8,6"]].concat()).await;
    assert_eq!(said["file"], picture.to_str().unwrap());
    let visits = yard.json(&["friction", "visits", "--box", "0,0,4,4"]).await;
    assert!(visits.as_array().is_some_and(|all| !all.is_empty()));
    yard.table(&["terrains", "delete", "sand-pit"]).await;
    let gone = yard.run(&["terrains", "show", "sand-pit"]).await;
    assert_eq!(gone.code, Some(5), "{}", gone.errors);
    yard.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_is_checked_sent_held_followed_and_ended_by_commands() {
    let yard = Yard::start().await;
    let table = yard.table(&[&LONG_CIRCLE[..], &["--check"]].concat()).await;
    assert!(table.contains(" m: acceleration or braking"), "{table}");
    let checked = yard.json(&[&LONG_CIRCLE[..], &["--check"]].concat()).await;
    assert!(
        checked["duration_s"]
            .as_f64()
            .is_some_and(|time| time > 20.0)
    );
    let sent = yard
        .json(&[&LONG_CIRCLE[..], &["--turns", "9"]].concat())
        .await;
    let id = id_of(&sent);
    // A second one is refused, since the robot has something to do.
    let refused = yard
        .run(&[&LONG_CIRCLE[..], &["--start", "refuse"]].concat())
        .await;
    assert_eq!(refused.code, Some(6), "{}", refused.errors);
    // The end of its identifier names it, and what names two missions says which.
    let end = &id[id.len() - 6..];
    let shown = yard.json(&["missions", "show", end]).await;
    assert_eq!(id_of(&shown), id);
    let second = id_of(&yard.json(&LONG_CIRCLE).await);
    let common = yard.run(&["missions", "show", &id[..4]]).await;
    assert_eq!(common.code, Some(2), "{}", common.errors);
    for candidate in [&id, &second] {
        assert!(common.errors.contains(candidate), "{}", common.errors);
    }
    yard.table(&["missions", "cancel", &second[second.len() - 8..]])
        .await;
    let nothing = yard.run(&["missions", "show", "ffffffff"]).await;
    assert_eq!(nothing.code, Some(5), "{}", nothing.errors);
    let wait = ["missions", "wait", &id, "--timeout", "300ms"];
    let waited = yard.run(&wait).await;
    assert_eq!(waited.code, Some(7), "{}", waited.errors);
    let listed = yard.json(&["missions", "--robot", ROBOT]).await;
    assert_eq!(id_of(&listed[1]), id, "the newest is first");
    let is_active = async || {
        let seen = yard.json(&["missions", "show", &id]).await;
        seen["state"] == "active"
    };
    for _ in 0..100 {
        if is_active().await {
            break;
        }
    }
    assert!(is_active().await, "the robot has taken it");
    yard.table(&["missions", "pause", &id]).await;
    let (following, cancelling) = (["missions", "follow", &id], ["missions", "cancel", &id]);
    let (followed, cancelled) = tokio::join!(yard.run(&following), yard.run(&cancelling));
    assert_eq!(cancelled.code, Some(0), "{}", cancelled.errors);
    assert_eq!(
        followed.code,
        Some(1),
        "it did not succeed: {}",
        followed.errors
    );
    assert!(followed.text.contains("cancelled"), "{}", followed.text);
    assert!(
        followed.errors.contains(&id),
        "changes are said: {}",
        followed.errors
    );
    let ended = yard.run(&["missions", "pause", &id]).await;
    assert_eq!(ended.code, Some(6), "{}", ended.errors);
    let states = yard.json(&["missions", "--state", "cancelled"]).await;
    assert_eq!(states.as_array().map(Vec::len), Some(2));
    yard.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_are_named_stopped_fenced_and_watched_over_by_commands() {
    let yard = Yard::start().await;
    yard.table(&["robots", "rename", ROBOT, "Old Betsy"]).await;
    let tagged = yard.json(&["robots", "tag", ROBOT, "spare", "north"]).await;
    assert_eq!(tagged["tags"], serde_json::json!(["north", "spare"]));
    let shown = yard.table(&["robots", ROBOT]).await;
    assert!(shown.contains("north, spare"), "{shown}");
    let none = yard.table(&["robots", "tag", ROBOT, "--none"]).await;
    assert!(none.contains("has no tags"), "{none}");
    let shown = yard.table(&["robots", ROBOT]).await;
    assert!(shown.contains("Old Betsy"), "{shown}");
    assert!(yard.table(&["status"]).await.contains("robots present  1"));
    assert_eq!(yard.json(&["leases"]).await, json!([]));

    let stopped = yard.json(&["stop", ROBOT, "--by", "Ann"]).await;
    let stop = id_of(&stopped["stops"][0]);
    // The robot gets the stop before the database does.
    let in_force = ["stops", "--in-force"];
    let stops = yard.table_that_says(&in_force, &stop).await;
    assert!(stops.contains("Ann"), "{stops}");
    yard.table(&["clear", ROBOT, &stop]).await;
    assert_eq!(yard.json(&["stops", "--in-force"]).await, json!([]));

    let fence = yard.folder.path().join("fence.json");
    let corner = |x_m: f64, y_m: f64| json!({"x_m": x_m, "y_m": y_m});
    let square = [(-90.0, -90.0), (90.0, -90.0), (90.0, 90.0), (-90.0, 90.0)];
    let square = square.map(|(x_m, y_m)| corner(x_m, y_m));
    std::fs::write(&fence, json!({"keep_in": [square]}).to_string()).unwrap();
    let set = ["geofence", "--set", fence.to_str().unwrap()];
    yard.table(&set).await;
    // What `--json` prints can be set again, and an old revision is a conflict.
    std::fs::write(&fence, yard.json(&["geofence"]).await.to_string()).unwrap();
    let revised = yard.json(&[&set[..], &["--revision", "1"]].concat()).await;
    assert_eq!(revised["revision"], 2);
    let late = yard.run(&[&set[..], &["--revision", "1"]].concat()).await;
    assert_eq!(late.code, Some(6), "{}", late.errors);

    yard.table(&[
        "limits", ROBOT, "set", "gate", "--speed", "0.2", "--for", "1m",
    ])
    .await;
    eventually("the robot has the limit", || {
        !yard.agent.state().safety.limits.is_empty()
    })
    .await;
    assert!(yard.table(&["robots", ROBOT]).await.contains("robot "));
    yard.table(&["limits", ROBOT, "end", "gate"]).await;

    yard.json(&["alerts", "--all"]).await;
    let nothing = "0192f0c1-2b3c-7d4e-8f50-617283940a1b";
    let unknown = yard.run(&["alerts", "ack", nothing]).await;
    assert_eq!(unknown.code, Some(5), "{}", unknown.errors);
    yard.table(&["robots", "retire", ROBOT]).await;
    assert_eq!(yard.json(&["robots"]).await, json!([]));
    let retired = yard.json(&["robots", "--retired"]).await;
    assert_eq!(retired.as_array().map(Vec::len), Some(1));
    yard.table(&["robots", "restore", ROBOT]).await;
    yard.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_went_wrong_has_its_own_exit_code_and_says_what_to_do_next() {
    let yard = Yard::start().await;
    let unknown = yard.run(&["robots", "rover-9"]).await;
    assert_eq!(unknown.code, Some(5));
    assert!(
        unknown.errors.contains("next: `tread robots`"),
        "{}",
        unknown.errors
    );
    let refused = [&LONG_CIRCLE[..6], &["--radius", "0"]].concat();
    let refused = yard.run(&refused).await;
    assert_eq!(refused.code, Some(4), "{}", refused.errors);
    assert_eq!(yard.run(&["send", "circle"]).await.code, Some(2));
    // Programs read what went wrong as well.
    let unknown = yard.run(&["robots", "rover-9", "--json"]).await;
    let said: Value = serde_json::from_str(&unknown.errors).unwrap();
    assert_eq!(said["exit_code"], 5);
    assert_eq!(said["problem"]["type"], "/problems/unknown-robot");
    let wordless = yard.run(&["send", "circle", "--json"]).await;
    assert_eq!(wordless.code, Some(2));
    let said: Value = serde_json::from_str(&wordless.errors).unwrap();
    assert_eq!(said["exit_code"], 2);
    let error = said["error"].as_str().unwrap();
    assert!(error.contains("not provided: --center <X,Y>"), "{error}");
    let help = yard.run(&["send", "circle", "--json", "--help"]).await;
    assert_eq!((help.code, help.errors.as_str()), (Some(0), ""));
    std::fs::write(yard.folder.path().join("token"), "tread_v_nobody").unwrap();
    let stranger = yard.run(&["robots"]).await;
    assert_eq!(stranger.code, Some(4));
    assert!(
        stranger.errors.contains("tread login"),
        "{}",
        stranger.errors
    );
    for word in ["Bearer", "authorization", "header", "/v1/"] {
        assert!(!stranger.errors.contains(word), "{}", stranger.errors);
    }
    for nobody in [
        ["robots", "--server", "http://127.0.0.1:9"],
        ["--server", "http://127.0.0.1:9", "robots"],
    ] {
        let nobody = Ran::of(nobody.map(str::to_owned).to_vec()).await;
        assert_eq!(nobody.code, Some(3), "{}", nobody.errors);
        assert!(nobody.errors.contains("tread demo"), "{}", nobody.errors);
    }
    yard.end().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_audit_log_is_exported_and_verified_and_what_was_changed_is_named() {
    let yard = Yard::start().await;
    for name in ["annex", "quay"] {
        yard.table(&["sites", "create", name]).await;
    }
    yard.table_that_says(&["audit"], "quay").await;
    let verified = yard.json(&["audit", "verify"]).await;
    let last_id = verified["last_id"].as_u64().unwrap();
    assert!(last_id >= 3, "{verified}");
    let noted = format!("{last_id}:{}", verified["last_hash"].as_str().unwrap());
    yard.table(&["sites", "create", "field"]).await;
    yard.table_that_says(&["audit"], "field").await;
    let again = yard.table(&["audit", "verify", "--noted", &noted]).await;
    assert!(again.contains("entries hold, 1 to "), "{again}");
    let foreign = format!("{last_id}:{}", "0".repeat(64));
    let refused = yard.run(&["audit", "verify", "--noted", &foreign]).await;
    assert_eq!(refused.code, Some(1), "{}", refused.text);
    assert!(
        refused.errors.contains("written anew"),
        "{}",
        refused.errors
    );

    let file = yard.folder.path().join("audit.jsonl");
    let path = file.to_str().unwrap();
    yard.table(&["audit", "export", "--output", path]).await;
    let whole = std::fs::read_to_string(&file).unwrap();
    let again = yard.json(&["audit", "verify", path]).await;
    assert_eq!(again["verified"], json!(whole.lines().count()));
    // One entry of it says something else.
    std::fs::write(
        &file,
        whole.replacen("\"id\":\"quay\"", "\"id\":\"quai\"", 1),
    )
    .unwrap();
    let refused = yard.run(&["audit", "verify", path]).await;
    assert_eq!(refused.code, Some(1), "{}", refused.text);
    let changed = "entry 3 was changed after it was written";
    assert!(refused.errors.contains(changed), "{}", refused.errors);
    yard.end().await;
}
