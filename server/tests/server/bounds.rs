//! What one robot, or somebody who may only stop robots, can make the server keep.

use std::collections::HashSet;
use std::time::Duration;

use futures_util::{StreamExt as _, stream};
use reqwest::StatusCode;
use serde_json::json;
use sqlx::Connection as _;
use tokio::time::Instant;
use tread_api::friction::Segment;
use tread_api::identity::Role;
use tread_api::ids::{AlertCode, BootId, ConfigurationId, RobotId, StopId};
use tread_api::page::Page;
use tread_api::rights::{Rights, Scope};
use tread_api::robot::{Alert, AlertReport, Capabilities, Severity};
use tread_api::safety::StopLatch;
use tread_api::stop::Stop;
use tread_api::wire::RefusalCode;
use tread_api::wire::hello::Hello;
use tread_api::wire::ingest::Record;
use tread_server::app::App;
use tread_server::app::stops::StopReason;
use tread_server::db::stops::StopFilter;
use tread_server::db::{self, RecordKey};
use uuid::Uuid;

use crate::harness::{
    Yard, client, eventually, folder_of_the_crate, measured, model, segment, site, time,
};
use crate::ingest::Writer;
use crate::robot::Robot;

/// Robots that are away while they are stopped.
const AWAY: usize = 200;
/// Fleet stops that somebody asks for who may do no more than look and stop.
const FLEET_STOPS: usize = 105;
/// How many of those are under way at once.
const AT_ONCE: usize = 15;
/// Latches that a robot makes up, and in what time.
const LATCHES: u32 = 700;
const FORGING: Duration = Duration::from_secs(15);

fn hello(robot: &str, boot: BootId) -> Hello {
    Hello {
        robot: robot.parse().unwrap(),
        boot,
        agent_version: "0".to_owned(),
        model: model(),
        robot_time: time("2026-11-01T00:00:00Z"),
        capabilities: Capabilities::default(),
    }
}

fn boot(number: u128) -> BootId {
    BootId::from_uuid(Uuid::from_u128(number))
}

async fn introduce(app: &App, robot: &str) {
    let hello = hello(robot, boot(1));
    // A robot says it again while the server has much to write.
    eventually("the server takes a hello", async || {
        app.hello(&site(), &hello).await
    })
    .await;
}

impl Yard {
    async fn stops_in_force(&self) -> Vec<Stop> {
        let page: Page<Stop> = self.get("/v1/stops?in_force=true&limit=1000").await;
        assert_eq!(page.next_cursor, None);
        page.items
    }

    /// Stops a robot that is away, lets it come back, and waits until it has heard of it.
    async fn tells_on_return(&self, name: &str) {
        introduce(self.server.app(), name).await;
        let path = format!("/v1/sites/yard/robots/{name}/stop");
        let (status, body) = self.post(&path, &json!({"by": "Ann"})).await;
        assert_eq!(status, StatusCode::OK, "{body}");
        let stop: Stop = serde_json::from_value(body).unwrap();
        let robot = Robot::join(self, name).await;
        eventually("the robot has heard of its stop", async || {
            let heard: Vec<StopId> = robot.stops().iter().map(|heard| heard.stop).collect();
            if heard.contains(&stop.id) {
                Ok(())
            } else {
                Err(heard)
            }
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stops_of_robots_that_are_away_are_one_of_each_however_often_they_are_asked_for() {
    let yard = Yard::start().await;
    for number in 0..AWAY {
        introduce(yard.server.app(), &format!("away-{number}")).await;
    }
    let viewer = yard.token("desk", Role::Viewer).await.secret;
    let viewer = client(Some(&viewer));
    let stops = stream::iter(0..FLEET_STOPS).map(|_| {
        let request = viewer.post(yard.url("/v1/stop")).json(&json!({}));
        yard.send(request)
    });
    let answers: Vec<_> = stops.buffer_unordered(AT_ONCE).collect().await;
    let mut newest = StopId::from_uuid(Uuid::nil());
    for (status, body) in answers {
        assert_eq!(status, StatusCode::OK, "{body}");
        assert_eq!(body["unconfirmed"], AWAY);
        for stop in body["stops"].as_array().unwrap() {
            newest = newest.max(serde_json::from_value(stop["id"].clone()).unwrap());
        }
    }
    let open = eventually("the newest stops are written", async || {
        let open = yard.stops_in_force().await;
        if open.iter().any(|stop| stop.id == newest) {
            Ok(open)
        } else {
            Err(open.len())
        }
    })
    .await;
    let robots: HashSet<_> = open.iter().map(|stop| &stop.robot).collect();
    assert_eq!((open.len(), robots.len()), (AWAY, AWAY));
    // What was replaced is history.
    let page: Page<Stop> = yard.get("/v1/stops?robot=away-7&limit=1000").await;
    let open = page.items.iter().filter(|stop| stop.replaced_by.is_none());
    assert_eq!(open.count(), 1, "{:?}", page.items);
    yard.tells_on_return("late").await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_makes_up_latches_has_few_stops_and_takes_no_stop_from_another() {
    let yard = Yard::start().await;
    let app = yard.server.app();
    let forger = Robot::join(&yard, "forger").await;
    let begun = Instant::now();
    for number in 0..LATCHES {
        forger.say(|state| {
            state.seq += 1;
            state.safety.stop = Some(StopLatch {
                id: StopId::from_uuid(Uuid::from_u128(u128::from(number) + 1)),
                by: "forger".to_owned(),
                reason: "made up".to_owned(),
                since: time("2026-11-01T00:00:00Z"),
            });
        });
        let key = (site(), forger.id.clone());
        let now = app.clock().now();
        app.presences()
            .state(&key, forger.state(), app.clock().elapsed(), now);
        app.wake();
        tokio::time::sleep_until(begun + FORGING * (number + 1) / LATCHES).await;
    }
    let page: Page<Stop> = yard.get("/v1/stops?robot=forger&limit=1000").await;
    let count = page.items.len();
    // Three at once, and one every ten seconds.
    assert!((1..=3 + 2).contains(&count), "{count} stops");
    assert_eq!(yard.stops_in_force().await.len(), 1);
    // The last one that it shows is adopted in its time, and can be cleared by its name at once.
    let last = json!({"stop": Uuid::from_u128(u128::from(LATCHES))});
    let (status, body) = yard
        .post("/v1/sites/yard/robots/forger/stop/clear", &last)
        .await;
    assert_eq!(status, StatusCode::OK, "{body}");
    yard.tells_on_return("late").await;
    drop(forger);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn alerts_of_unconfirmed_stops_are_what_the_stops_say() {
    let yard = Yard::start().await;
    let app = yard.server.app();
    for robot in ["away", "free"] {
        introduce(app, robot).await;
    }
    let (status, _) = yard
        .post("/v1/sites/yard/robots/away/stop", &json!({}))
        .await;
    assert_eq!(status, StatusCode::OK);
    let raised = async |what: &str, robots: &[&str]| {
        eventually(what, async || {
            let page: Page<Alert> = yard.get("/v1/alerts?raised=true").await;
            let named = page.items.iter().map(|alert| alert.robot.as_ref().unwrap());
            let mut named: Vec<&str> = named.map(RobotId::as_str).collect();
            named.sort_unstable();
            if named == robots {
                Ok(())
            } else {
                Err(page.items)
            }
        })
        .await;
    };
    raised("the stop is unconfirmed", &["away"]).await;
    // As if the one could not be written down, and the other were left over from a stop that was
    // replaced.
    let code: AlertCode = "stop-unconfirmed".parse().unwrap();
    let mut tx = app.db().write("test").await.unwrap();
    let pk = async |tx: &mut db::Tx, robot: &str| {
        let found = db::robots::pk_of(tx, &site(), &robot.parse().unwrap()).await;
        found.unwrap().unwrap()
    };
    let (away, free) = (pk(&mut tx, "away").await, pk(&mut tx, "free").await);
    let now = app.clock().now();
    db::alerts::clear(&mut tx, away, &code, now).await.unwrap();
    let report = AlertReport {
        code,
        severity: Severity::Critical,
        text: "left over".to_owned(),
    };
    let id = app.clock().new_id::<tread_api::ids::AlertId>();
    db::alerts::raise(&mut tx, free, id, &report, now)
        .await
        .unwrap();
    tx.commit().await.unwrap();
    raised("it is raised again, and the other one is over", &["away"]).await;
    // Nobody misses the confirmation of a robot that is retired.
    let url = yard.url("/v1/sites/yard/robots/away");
    let retired = yard.client().patch(url).json(&json!({"retired": true}));
    let (status, body) = yard.send(retired).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    raised("the alert is over", &[]).await;
    yard.server.stop().await.unwrap();
}

async fn count(writer: &Writer, what: &'static str) -> i64 {
    let mut tx = writer.app.db().read("test").await.unwrap();
    let (count,): (i64,) = sqlx::query_as(what)
        .fetch_one(&mut **tx.as_sqlite().unwrap())
        .await
        .unwrap();
    count
}

const RUNS: &str = "SELECT COUNT(*) FROM boots";
const CONFIGURATIONS: &str = "SELECT COUNT(*) FROM configurations";

fn one(seq: u64) -> Vec<Record> {
    vec![measured(seq, segment((1, 1), 0.2, 0))]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_begins_few_runs_and_those_of_which_nothing_is_kept_are_forgotten() {
    let writer = Writer::start().await;
    let before = count(&writer, RUNS).await;
    let mut refused = 0;
    for number in 2..402 {
        if let Err(refusal) = writer.upload_of("rover-1", boot(number), one(1)).await {
            assert_eq!(refusal.code, RefusalCode::Busy);
            refused += 1;
        }
        let hello = hello("rover-1", boot(1_000_000 + number));
        if let Err(refusal) = writer.app.hello(&site(), &hello).await {
            assert_eq!(refusal.code, RefusalCode::Busy);
            refused += 1;
        }
    }
    let begun = count(&writer, RUNS).await - before;
    assert!((90..=100).contains(&begun), "{begun} runs");
    assert_eq!(begun + refused, 800);
    // Another robot has its own, and this one may go on later.
    let other = writer.upload_of("rover-2", boot(3), one(1)).await;
    assert!(other.is_ok(), "{other:?}");
    writer.app.clock().advance(Duration::from_secs(10));
    let later = writer.upload_of("rover-1", boot(9_999), one(1)).await;
    assert_eq!(later.unwrap().committed, 1);

    let mut tx = writer.app.db().write("test").await.unwrap();
    let robot = "rover-2".parse().unwrap();
    let robot_pk = db::robots::pk_of(&mut tx, &site(), &robot).await;
    let robot_pk = robot_pk.unwrap().unwrap();
    for number in 0..50 {
        let boot_pk = db::robots::boot_key(&mut tx, robot_pk, boot(20_000 + number), 5)
            .await
            .unwrap();
        let key = RecordKey { boot_pk, seq: 1 };
        db::history::record_report(&mut tx, key).await.unwrap();
    }
    tx.commit().await.unwrap();
    // The five newest, the one that said hello, and the one of which a measurement is kept.
    let kept = "SELECT COUNT(*) FROM boots JOIN robots ON robots.pk = boots.robot_pk
                WHERE robots.id = 'rover-2'";
    assert_eq!(count(&writer, kept).await, 7);
    assert_eq!(count(&writer, "SELECT COUNT(*) FROM reports_seen").await, 5);
    let again = writer.upload_of("rover-2", boot(3), one(1)).await.unwrap();
    assert_eq!((again.committed, again.duplicates), (0, 1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_measures_with_few_configurations_and_those_that_nobody_has_are_replaced() {
    let writer = Writer::start().await;
    let of = |number: u128| -> Vec<Record> {
        let configuration = ConfigurationId::from_uuid(Uuid::from_u128(number));
        let segment = Segment {
            configuration,
            ..segment((1, 1), 0.2, 0)
        };
        vec![measured(u64::try_from(number).unwrap(), segment)]
    };
    let mut taken = 0;
    for number in 1..=300 {
        taken += u64::from(
            writer
                .upload_of("rover-1", boot(1), of(number))
                .await
                .is_ok(),
        );
    }
    // At once; more only as time goes by, and never more than a hundred.
    assert_eq!(taken, 10);
    for number in 301..=500 {
        writer.app.clock().advance(Duration::from_mins(1));
        let receipt = writer.upload_of("rover-1", boot(1), of(number)).await;
        let receipt = receipt.unwrap();
        taken += receipt.committed;
        if let Some(refused) = receipt.refused.first() {
            assert!(refused.reason.contains("100"), "{refused:?}");
        }
    }
    assert_eq!(taken, 100);
    let measured_with = count(&writer, CONFIGURATIONS).await;
    // What it measured with before goes on.
    let again = writer.upload_of("rover-1", boot(1), of(1)).await.unwrap();
    assert_eq!(again.duplicates, 1);
    for number in 1..=100_u32 {
        writer.app.clock().advance(Duration::from_mins(1));
        let mut hello = hello("rover-2", boot(1));
        hello.model.mass_kg += f64::from(number);
        writer.app.hello(&site(), &hello).await.unwrap();
    }
    let declared = count(&writer, CONFIGURATIONS).await - measured_with;
    assert!(
        (0..=2).contains(&declared),
        "{declared} configurations more"
    );
    let robot = writer.app.robot(&site(), &"rover-2".parse().unwrap()).await;
    assert!((robot.unwrap().model.mass_kg - model().mass_kg - 100.0).abs() < 1e-9);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_raises_few_alerts_and_the_oldest_that_are_over_are_forgotten() {
    let yard = Yard::start().await;
    let app = yard.server.app();
    let robot = Robot::join(&yard, "rover-1").await;
    let key = (site(), robot.id.clone());
    let say = async |code: Option<String>| {
        robot.say(|state| {
            state.seq += 1;
            let report = |code: String| AlertReport {
                code: code.parse().unwrap(),
                severity: Severity::Warning,
                text: "made up".to_owned(),
            };
            state.alerts = code.map(report).into_iter().collect();
        });
        let now = app.clock().now();
        app.presences()
            .state(&key, robot.state(), app.clock().elapsed(), now);
        app.wake();
        tokio::time::sleep(Duration::from_millis(10)).await;
    };
    let raised = async || -> Page<Alert> { yard.get("/v1/alerts?limit=1000").await };
    // One that comes and goes takes nothing from the others.
    for number in 0..300 {
        say((number % 2 == 0).then(|| "flapping".to_owned())).await;
    }
    let flapping = raised().await.items.len();
    assert!((3..=11).contains(&flapping), "{flapping} alerts");
    for number in 0..600 {
        say(Some(format!("made-up-{number}"))).await;
    }
    // Forty at once, and one every five seconds.
    let page = raised().await;
    let raised = page.items.len();
    assert!((20..=50).contains(&raised), "{raised} alerts");
    robot.say(|state| state.alerts.clear());
    eventually("all are over", async || {
        let page: Page<Alert> = yard.get("/v1/alerts?raised=true").await;
        if page.items.is_empty() {
            Ok(())
        } else {
            Err(page.items)
        }
    })
    .await;
    let mut tx = app.db().write("test").await.unwrap();
    let robot_pk = db::robots::pk_of(&mut tx, &site(), &robot.id).await;
    let robot_pk = robot_pk.unwrap().unwrap();
    db::alerts::prune(&mut tx, robot_pk, 5).await.unwrap();
    tx.commit().await.unwrap();
    let left: Page<Alert> = yard.get("/v1/alerts?limit=1000").await;
    let ids = |alerts: &[Alert]| alerts.iter().map(|alert| alert.id).collect::<Vec<_>>();
    assert_eq!(ids(&left.items), ids(&page.items[..5]));
    drop(robot);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_does_not_stand_before_it_was_confirmed_in_whatever_order_that_is_noted() {
    let writer = Writer::start().await;
    let at = |second: &str| time(&format!("2026-11-01T00:00:{second}Z"));
    let stop: Stop = serde_json::from_value(json!({
        "id": Uuid::from_u128(7), "site": "yard", "robot": "rover-1", "by": "Ann", "reason": "a test",
        "requested_at": at("01"), "confirmed_at": null, "standstill_at": null, "unconfirmed": false,
        "clear_requested_by": null, "clear_requested_at": null, "cleared_at": null,
    }))
    .unwrap();
    let mut tx = writer.app.db().write("test").await.unwrap();
    db::stops::insert(&mut tx, std::slice::from_ref(&stop), 10)
        .await
        .unwrap();
    db::stops::confirm(&mut tx, &[stop.id], at("09"))
        .await
        .unwrap();
    db::stops::record_standstill(&mut tx, stop.id, at("05"))
        .await
        .unwrap();
    let kept = db::stops::find(&mut tx, stop.id).await.unwrap().unwrap();
    assert_eq!(kept.standstill_at, Some(at("09")));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_that_is_written_down_late_is_history_and_of_history_the_newest_is_kept() {
    let writer = Writer::start().await;
    let mut tx = writer.app.db().write("test").await.unwrap();
    let stop = |number: u32, second: u32| -> Stop {
        serde_json::from_value(json!({
            "id": Uuid::from_u128(u128::from(number)), "site": "yard", "robot": "rover-1",
            "by": "Ann", "reason": "a test", "confirmed_at": null, "standstill_at": null,
            "requested_at": time(&format!("2026-11-01T00:00:{second:02}Z")), "unconfirmed": false,
            "clear_requested_by": null, "clear_requested_at": null, "cleared_at": null,
        }))
        .unwrap()
    };
    for (number, second) in [(1, 1), (3, 3), (2, 2), (4, 3)] {
        db::stops::insert(&mut tx, &[stop(number, second)], 10)
            .await
            .unwrap();
    }
    let open = db::stops::in_force(&mut tx).await.unwrap();
    let ids: Vec<Uuid> = open.iter().map(|stop| stop.id.as_uuid()).collect();
    assert_eq!(ids, [Uuid::from_u128(4)]);
    for number in 5..60 {
        db::stops::insert(&mut tx, &[stop(number, number)], 10)
            .await
            .unwrap();
    }
    let kept = db::stops::list(&mut tx, &StopFilter::default(), 100).await;
    let kept: Vec<u128> = kept
        .unwrap()
        .iter()
        .map(|stop| stop.id.as_uuid().as_u128())
        .collect();
    assert_eq!(kept, (50..60).rev().collect::<Vec<u128>>());
}

/// A database as it was before a migration, with these rows, brought up to date.
async fn migrated(first_later: &str, rows: &str) -> sqlx::SqliteConnection {
    let folder = folder_of_the_crate().join("../store-sqlite/migrations");
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    files.sort();
    let is_later = |file: &std::path::PathBuf| {
        let name = file.file_name().unwrap().to_string_lossy().into_owned();
        name.starts_with("2026") && name.as_str() >= first_later
    };
    let mut db = sqlx::SqliteConnection::connect("sqlite::memory:")
        .await
        .unwrap();
    let run = async |db: &mut sqlx::SqliteConnection, sql: String| {
        sqlx::raw_sql(sqlx::AssertSqlSafe(sql))
            .execute(db)
            .await
            .unwrap();
    };
    for file in files.iter().filter(|file| !is_later(file)) {
        run(&mut db, std::fs::read_to_string(file).unwrap()).await;
    }
    run(&mut db, rows.to_owned()).await;
    for file in files.iter().filter(|file| is_later(file)) {
        run(&mut db, std::fs::read_to_string(file).unwrap()).await;
    }
    db
}

/// A database of before tokens had rights and sites of their own is brought up to date.
#[tokio::test]
async fn tokens_keep_their_roles_and_hold_everywhere() {
    let rows = "
        INSERT INTO tokens (id, name, role, lookup, hash, created_at_us, created_by, expires_at_us)
            VALUES ('0192f0c1-2b3c-7d4e-8f50-617283940a1a', 'eyes', 'viewer', x'0101010101010101',
                    zeroblob(32), 0, 'init', 9),
                ('0192f0c1-2b3c-7d4e-8f50-617283940a1b', 'hands', 'operator', x'0202020202020202',
                    zeroblob(32), 0, 'init', 9),
                ('0192f0c1-2b3c-7d4e-8f50-617283940a1c', 'boss', 'admin', x'0303030303030303',
                    zeroblob(32), 0, 'init', 9);
        INSERT INTO sessions (id, token_id, lookup, hash, created_at_us, expires_at_us)
            VALUES ('s', '0192f0c1-2b3c-7d4e-8f50-617283940a1a', x'0404040404040404',
                    zeroblob(32), 0, 9);";
    let mut db = migrated("20261122131500", rows).await;
    let tokens = tread_store_sqlite::tokens::list(&mut db, &Scope::EVERYWHERE, None, 10).await;
    let tokens: Vec<_> = tokens
        .unwrap()
        .into_iter()
        .map(|token| (token.name, token.role, token.rights, token.sites))
        .collect();
    let expected = [
        ("boss", Role::Admin),
        ("hands", Role::Operator),
        ("eyes", Role::Viewer),
    ];
    let expected = expected.map(|(name, role)| {
        let rights = Rights::from(role);
        (name.to_owned(), Some(role), rights, Scope::EVERYWHERE)
    });
    assert_eq!(tokens, expected);
    let of_both = sqlx::query("UPDATE tokens SET rights = '[]' WHERE name = 'eyes'");
    assert!(of_both.execute(&mut db).await.is_err());
    let of_none = sqlx::query("UPDATE tokens SET role = NULL WHERE name = 'eyes'");
    assert!(of_none.execute(&mut db).await.is_err());
    let nowhere = sqlx::query("UPDATE tokens SET scope = '[]' WHERE name = 'eyes'");
    assert!(nowhere.execute(&mut db).await.is_err());
    let sessions: i64 = sqlx::query_scalar("SELECT COUNT(*) FROM sessions")
        .fetch_one(&mut db)
        .await
        .unwrap();
    assert_eq!(sessions, 1);
}

/// A database of before robots had one open stop each is brought up to date.
#[tokio::test]
async fn of_several_open_stops_of_a_robot_the_newest_stays_open() {
    let rows = "
        INSERT INTO sites (pk, id, name, grid_revision, cell_m, created_at_us)
            VALUES (1, 'yard', 'yard', 1, 1.0, 0);
        INSERT INTO configurations (pk, id) VALUES (1, 'c');
        INSERT INTO robots (pk, site_pk, id, configuration_pk, agent_version, boot,
                first_seen_at_us, last_hello_at_us)
            VALUES (1, 1, 'a', 1, '', 'x', 0, 0), (2, 1, 'b', 1, '', 'x', 0, 0);
        INSERT INTO stops (id, robot_pk, stopped_by, reason, wanted_at_us, cleared_at_us) VALUES
            ('s1', 1, '', '', 10, NULL), ('s3', 1, '', '', 30, NULL), ('s2', 1, '', '', 20, NULL),
            ('s9', 1, '', '', 90, 95), ('t1', 2, '', '', 10, NULL);
        INSERT INTO cell_sums (site_pk, iy, ix, grid_revision, terrain, terrain_revision, robot_pk,
                configuration_pk, epoch_h, information_hi, information_lo, weighted_hi, weighted_lo,
                segments, samples, newest_at_us)
            VALUES (1, 0, 0, 1, '', 0, 2, 1, 0, 1, 0, 1, 0, 1, 1, 0);";
    let mut db = migrated("20261122093000", rows).await;
    let stops: Vec<(String, Option<String>)> =
        sqlx::query_as("SELECT id, replaced_by FROM stops ORDER BY id")
            .fetch_all(&mut db)
            .await
            .unwrap();
    let replaced = |id: &str, by: Option<&str>| (id.to_owned(), by.map(str::to_owned));
    let expected = [
        replaced("s1", Some("s3")),
        replaced("s2", Some("s3")),
        replaced("s3", None),
        replaced("s9", None),
        replaced("t1", None),
    ];
    assert_eq!(stops, expected);
    let measured: Vec<(i64, i64)> = sqlx::query_as("SELECT * FROM measured_configurations")
        .fetch_all(&mut db)
        .await
        .unwrap();
    assert_eq!(measured, [(2, 1)]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_is_recorded_and_shown_unconfirmed_while_no_robot_is_reached() {
    let writer = Writer::start().await;
    let (site, robot) = (site(), "rover-1".parse().unwrap());
    let asked = writer.app.stop_robot(&site, &robot, StopReason::default());
    let stop = asked.await.unwrap();
    assert!(stop.unconfirmed, "{stop:?}");
    eventually("the database has the stop", async || {
        let mut tx = writer.app.db().read("test").await.unwrap();
        let found = db::stops::find(&mut tx, stop.id).await;
        found.unwrap().ok_or("not yet")
    })
    .await;
}
