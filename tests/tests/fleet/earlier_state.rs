//! What servers and robots of an earlier build left on their disks; see the README of the fixtures.

use std::collections::BTreeSet;
use std::fs::{self, Permissions};
use std::io::Read as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use flate2::read::GzDecoder;
use jiff::{SignedDuration, Timestamp};
use serde_json::{Map, Value};
use tread_agent::clock::{Clock as _, SystemClock};
use tread_agent::membership::Membership;
use tread_agent::missions::memory::Memory;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::MissionState;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::repository::root;
use tread_tests::rest::Rest;
use tread_tests::wait::{SHORT, eventually};

/// Ends of what depends on the time of asking, or on how much the map's reader believes a measurement.
const NOT_COMPARED: [&str; 7] = [
    ".age_s",
    ".bounds",
    ".friction.mu_peak_lower_bound",
    ".std_dev",
    ".stiffness",
    ".theta_high_95",
    ".theta_low_95",
];
/// Ends of means whose weights are such; see [`MEAN_DIFFERENCE_MAX`].
const MEANS: [&str; 2] = [".effective_track_ratio.value", ".friction.theta"];
/// Largest difference of a mean, as a share.
const MEAN_DIFFERENCE_MAX: f64 = 0.02;
/// Keys that were renamed since, by their earlier names.
const RENAMED: [(&str, &str); 10] = [
    ("clear_asked_at", "clear_requested_at"),
    ("clear_asked_by", "clear_requested_by"),
    ("first_sure_alone_s", "first_known_alone_s"),
    ("pause_wanted", "pause_requested"),
    ("refused_why", "refusal_reason"),
    ("standing_at", "standstill_at"),
    ("sure_alone_s", "known_alone_s"),
    ("sure_s", "known_s"),
    ("theta_sd", "theta_std_dev"),
    ("wanted_at", "requested_at"),
];
/// End of the place of a step's cause.
const CAUSE_FIELD: &str = ".cause";
/// Causes of steps that were renamed since, by their earlier names.
const RENAMED_CAUSES: [(&str, &str); 2] = [
    ("noted", "recorded"),
    ("robot_forgot", "robot_lost_mission"),
];
/// Days for which the server surely keeps audit entries, and tokens that are over.
const KEPT_DAYS: i64 = 390;
/// What it removes then.
const REMOVED_BY_AGE: [&str; 3] = ["audit", "join_tokens", "tokens"];

fn fixtures() -> PathBuf {
    root().join("tests/fixtures/state-before-renaming")
}

fn unpacked(file: &Path) -> Vec<u8> {
    let packed = fs::File::open(file).expect("the fixture is there");
    let mut content = Vec::new();
    GzDecoder::new(packed)
        .read_to_end(&mut content)
        .expect("it was packed by gzip");
    content
}

/// Unpacks every fixture of a folder, readable by its owner alone.
fn unpack(from: &Path, into: &Path) {
    fs::create_dir_all(into).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = into.join(path.file_stem().unwrap());
        if path.is_dir() {
            unpack(&path, &target);
        } else if path.extension().is_some_and(|end| end == "gz") {
            fs::write(&target, unpacked(&path)).unwrap();
            fs::set_permissions(&target, Permissions::from_mode(0o600)).unwrap();
        }
    }
}

/// What the earlier build said, with the present names of fields.
fn expected() -> Value {
    let text = unpacked(&fixtures().join("expected.json.gz"));
    let mut expected: Value = serde_json::from_slice(&text).unwrap();
    let renamed = expected["renamed"].take();
    rename(&mut expected, renamed.as_object().unwrap());
    expected
}

fn rename(value: &mut Value, renamed: &Map<String, Value>) {
    match value {
        Value::Object(fields) => {
            for (former, present) in renamed {
                if let Some(field) = fields.remove(former) {
                    fields.insert(present.as_str().unwrap().to_owned(), field);
                }
            }
            fields.values_mut().for_each(|field| rename(field, renamed));
        }
        Value::Array(entries) => entries.iter_mut().for_each(|entry| rename(entry, renamed)),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

fn is_near(earlier: &Value, present: &Value) -> bool {
    let both = earlier.as_f64().zip(present.as_f64());
    both.is_some_and(|(earlier, present)| {
        (earlier - present).abs() <= MEAN_DIFFERENCE_MAX * earlier.abs()
    })
}

/// Where `present` lacks something of `earlier`, or says otherwise; it may say more.
fn losses(place: &str, earlier: &Value, present: &Value, found: &mut Vec<String>) {
    match (earlier, present) {
        (Value::Object(earlier), Value::Object(present)) => {
            for (name, earlier) in earlier {
                let place = format!("{place}.{name}");
                if NOT_COMPARED.iter().any(|end| place.ends_with(end)) {
                    continue;
                }
                let renamed = RENAMED.iter().find(|(earlier, _)| earlier == name);
                let name = renamed.map_or(name.as_str(), |(_, now)| now);
                match present.get(name) {
                    Some(present) => losses(&place, earlier, present, found),
                    None => found.push(format!("{place}: {earlier} is gone")),
                }
            }
        }
        (Value::Array(earlier), Value::Array(present)) if earlier.len() == present.len() => {
            for (number, (earlier, present)) in earlier.iter().zip(present).enumerate() {
                losses(&format!("{place}[{number}]"), earlier, present, found);
            }
        }
        _ if earlier == present => {}
        _ if place.ends_with(CAUSE_FIELD)
            && RENAMED_CAUSES
                .iter()
                .any(|(former, now)| earlier == former && present == now) => {}
        _ if MEANS.iter().any(|end| place.ends_with(end)) && is_near(earlier, present) => {}
        _ => found.push(format!("{place}: {earlier} became {present}")),
    }
}

/// Compares the entries of a list, each by what identifies it; more of them may be there.
fn list_losses(name: &str, by: &[&str], earlier: &Value, present: &[Value]) -> Vec<String> {
    let mut found = Vec::new();
    let key = |entry: &Value| by.iter().map(|by| entry[by].clone()).collect::<Vec<_>>();
    let earlier = earlier.as_array().expect("a list");
    assert!(!earlier.is_empty(), "{name} tells nothing");
    for earlier in earlier {
        let place = format!("{name}{:?}", key(earlier));
        match present.iter().find(|present| key(present) == key(earlier)) {
            Some(present) => losses(&place, earlier, present, &mut found),
            None => found.push(format!("{place} is gone")),
        }
    }
    found
}

/// The missions' details, of all that there are.
async fn missions(rest: &Rest) -> Vec<Value> {
    let mut details = Vec::new();
    for mission in rest
        .all::<Value>(&format!("/v1/missions?site={SITE}"))
        .await
    {
        let id = mission["id"].as_str().unwrap();
        details.push(rest.get(&format!("/v1/missions/{id}")).await);
    }
    details
}

async fn everything_of_the_database_is_there(fleet: &Fleet, before: &Value) {
    let rest = &fleet.rest;
    let site = format!("/v1/sites/{SITE}");
    let written: Timestamp = serde_json::from_value(before["audit"][0]["at"].clone()).unwrap();
    let is_old = SystemClock::new().wall().duration_since(written)
        > SignedDuration::from_hours(KEPT_DAYS * 24);
    let mut found = list_losses(
        "missions",
        &["id"],
        &before["missions"],
        &missions(rest).await,
    );
    for (name, by, path) in [
        ("sites", &["id"][..], "/v1/sites".to_owned()),
        ("terrains", &["id"], format!("{site}/terrains")),
        ("robots", &["id"], format!("{site}/robots")),
        ("segments", &["boot", "seq"], format!("{site}/segments")),
        (
            "cells",
            &["cell", "terrain"],
            format!("{site}/friction/cells"),
        ),
        (
            "enrolments",
            &["robot", "number"],
            format!("{site}/enrolments"),
        ),
        ("tokens", &["id"], "/v1/tokens".to_owned()),
        ("join_tokens", &["id"], "/v1/join-tokens".to_owned()),
        ("audit", &["id"], "/v1/audit".to_owned()),
        ("stops", &["id"], "/v1/stops".to_owned()),
        ("alerts", &["id"], format!("/v1/alerts?site={SITE}")),
        (
            "friction_terrains",
            &["terrain"],
            format!("{site}/friction/terrains"),
        ),
    ] {
        if is_old && REMOVED_BY_AGE.contains(&name) {
            continue;
        }
        let present: Vec<Value> = rest.all(&path).await;
        found.extend(list_losses(name, by, &before[name], &present));
    }
    let geofence: Value = rest.get(&format!("{site}/geofence")).await;
    losses("geofence", &before["geofence"], &geofence, &mut found);
    assert!(found.is_empty(), "{}", found.join("\n"));
}

/// Unless its time is over.
async fn the_operators_token_opens(fleet: &Fleet, expected: &Value) {
    let tokens = expected["before"]["tokens"].as_array().unwrap();
    let token = tokens.iter().find(|token| token["role"] == "operator");
    let expires: Timestamp =
        serde_json::from_value(token.expect("it is there")["expires_at"].clone()).unwrap();
    if SystemClock::new().wall() < expires {
        let secret = expected["operator_secret"].as_str().unwrap();
        let operator = Rest::new(format!("http://{}", fleet.http_address()), secret);
        let session: Value = operator.get("/v1/session").await;
        assert_eq!(session["name"], "day shift", "{session}");
    }
}

/// The missions that a robot remembers as ended.
fn ended(fleet: &Fleet, robot: &RobotId) -> BTreeSet<MissionId> {
    let slot = Memory::new(&fleet.robot_folder(robot)).load().unwrap();
    slot.ended().map(|ended| ended.mission).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn state_of_an_earlier_build_opens_and_nothing_of_it_is_lost() {
    let expected = expected();
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let mut fleet = Fleet::start_secure_on(node, |folder| unpack(&fixtures(), folder)).await;
    everything_of_the_database_is_there(&fleet, &expected["before"]).await;
    the_operators_token_opens(&fleet, &expected).await;

    let mission = |name: &str| -> MissionId {
        serde_json::from_value(expected["names"][name].clone()).unwrap()
    };
    let [driven, stopped] = ["rover-1", "rover-2"].map(|name| name.parse::<RobotId>().unwrap());
    let missions_ended = ["m1", "with_prior", "finished_unsent"].map(mission);
    assert_eq!(ended(&fleet, &driven), missions_ended.into());
    let slot = Memory::new(&fleet.robot_folder(&stopped)).load().unwrap();
    let active = slot.active().expect("an active mission");
    assert_eq!(active.mission, mission("paused"));
    let authority = fs::read_to_string(fleet.file("authority").join("ca.pem")).unwrap();
    for robot in [&driven, &stopped] {
        let joined = Membership::load(&fleet.robot_folder(robot)).unwrap();
        let joined = joined.expect("it has joined");
        assert_eq!((&joined.robot, joined.enrolment), (robot, 1));
        assert_eq!(joined.authority.trim(), authority.trim());
        // Their certificates end some day; a robot joins again on the same disk.
        fleet.join(robot).await;
    }

    // The stop holds, and the mission that was paused has ended with the power.
    fleet.start_agent(&stopped, 0.0).await;
    let seen = fleet.rest.robot(&stopped).await.unwrap();
    let latch = seen.live.unwrap().safety.stop.expect("stopped");
    assert_eq!((&*latch.by, &*latch.reason), ("Ann", "end of the shift"));
    let failed = [MissionState::Failed];
    let paused = mission("paused");
    let paused = fleet.rest.mission_reaches(paused, &failed, SHORT).await;
    let why = paused.mission.reason.as_deref();
    assert_eq!(
        why,
        Some("the agent restarted during the mission"),
        "{paused:#?}"
    );

    // What the server had not heard arrives, as it did at the earlier server.
    fleet.start_agent(&driven, 0.0).await;
    let after = &expected["after"];
    let look = || async {
        let segments = format!("/v1/sites/{SITE}/segments");
        let segments: Vec<Value> = fleet.rest.all(&segments).await;
        let mut lacking = list_losses("segments", &["boot", "seq"], &after["segments"], &segments);
        let missions = missions(&fleet.rest).await;
        lacking.extend(list_losses(
            "missions",
            &["id"],
            &after["missions"],
            &missions,
        ));
        lacking
    };
    eventually("nothing is lacking", SHORT, look, Vec::is_empty).await;
    let still_ended = ended(&fleet, &driven);
    assert!(missions_ended.iter().all(|it| still_ended.contains(it)));
}

#[test]
fn a_recording_of_an_earlier_build_is_run_again_to_its_end() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("recording.mcap");
    fs::write(&file, unpacked(&fixtures().join("recording.mcap.gz"))).unwrap();
    let ended = Command::new(env!("CARGO_BIN_EXE_node"))
        .args(["agent", "replay", "--json"])
        .arg(&file)
        .output()
        .unwrap();
    let said: Value = serde_json::from_slice(&ended.stdout).expect("one object");
    assert_eq!(said["robot"], "rover-3", "{said:#}");
    assert_eq!(said["checks"][0]["value"], 152, "{said:#}");
    assert_eq!(said["driving_ticks"], 127, "{said:#}");
    // What it makes of the ground may differ: estimator and law are not those of that build.
    for nothing in ["gap", "torn"] {
        assert_eq!(said[nothing], Value::Null, "{said:#}");
    }
}
