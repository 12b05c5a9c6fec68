//! Stops: at once, confirmed or shown as unconfirmed, repeated, cleared; and nothing starts by
//! itself afterwards.

use std::time::Duration;

use jiff::Timestamp;
use reqwest::StatusCode;
use serde_json::{Value, json};
use tokio::io::AsyncWriteExt as _;
use tokio::time::Instant;
use tread_api::keys::Verb;
use tread_api::mission::{Mission, MissionState};
use tread_api::page::Page;
use tread_api::robot::{Alert, AlertReport, FAULT_TEXT_MAX, MissionProgress, PauseCause, Severity};
use tread_api::safety::{StandstillState, StandstillStatus};
use tread_api::stop::{FleetStop, Stop};
use tread_api::wire::ingest::{MissionPhase, Record, RecordContent};

use crate::harness::{Yard, eventually, report};
use crate::robot::Robot;

const STOP: &str = "/v1/sites/yard/robots/rover-1/stop";
const CLEAR: &str = "/v1/sites/yard/robots/rover-1/stop/clear";

impl Yard {
    async fn stop_robot(&self, body: &Value) -> Stop {
        let (status, body) = self.post(STOP, body).await;
        assert_eq!(status, StatusCode::OK, "{body}");
        serde_json::from_value(body).unwrap()
    }

    async fn stop_becomes(&self, what: &str, is: impl Fn(&Stop) -> bool) -> Stop {
        eventually(what, async || {
            let page: Page<Stop> = self.get("/v1/stops").await;
            let newest = page.items.into_iter().next();
            newest.clone().filter(|stop| is(stop)).ok_or(newest)
        })
        .await
    }

    async fn raised(&self) -> Vec<String> {
        let page: Page<Alert> = self.get("/v1/alerts?raised=true").await;
        let code = |alert: Alert| alert.code.as_str().to_owned();
        page.items.into_iter().map(code).collect()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_is_confirmed_shown_and_cleared_and_nothing_goes_on_by_itself() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let driven = yard.create_mission(&robot.id).await;
    let waiting = yard.create_mission(&robot.id).await;
    yard.mission_becomes(driven.id, MissionState::Active).await;

    let stop = yard
        .stop_robot(&json!({"by": "Ann", "reason": "a child on the yard"}))
        .await;
    assert!(stop.confirmed_at.is_some() && !stop.unconfirmed, "{stop:?}");
    let heard = robot.stops();
    assert_eq!(heard.len(), 1);
    assert_eq!(
        (
            heard[0].stop,
            heard[0].by.as_str(),
            heard[0].reason.as_str()
        ),
        (stop.id, "tests: Ann", "a child on the yard")
    );
    let held = eventually("all missions are held", async || {
        let held = (
            yard.mission(driven.id).await,
            yard.mission(waiting.id).await,
        );
        let both = held.0.mission.pause_requested && held.1.mission.pause_requested;
        let paused = held.0.mission.state == MissionState::Paused;
        if both && paused { Ok(held) } else { Err(held) }
    })
    .await;
    assert_eq!(held.1.mission.state, MissionState::Queued);
    // What is asked for now must wait too, and nothing can be resumed.
    let later = yard.create_mission(&robot.id).await;
    assert!(later.pause_requested);
    let resume = format!("/v1/missions/{}/resume", driven.id);
    let (status, body) = yard.post(&resume, &Value::Null).await;
    assert_eq!(
        (status, body["type"].as_str()),
        (StatusCode::CONFLICT, Some("/problems/robot-refused")),
        "{body}"
    );

    let (status, body) = yard
        .post(CLEAR, &json!({"stop": stop.id, "by": "Bob"}))
        .await;
    assert_eq!(status, StatusCode::OK, "{body}");
    let cleared: Stop = serde_json::from_value(body).unwrap();
    assert!(cleared.cleared_at.is_some());
    assert_eq!(cleared.clear_requested_by.as_deref(), Some("tests: Bob"));

    // The active mission ends; the queue does not move until somebody says so.
    robot.report(0, &driven, MissionPhase::Failed).await;
    yard.mission_becomes(driven.id, MissionState::Failed).await;
    let fresh = yard.create_mission(&robot.id).await;
    yard.mission_becomes(fresh.id, MissionState::Active).await;
    robot.report(1, &fresh, MissionPhase::Succeeded).await;
    yard.mission_becomes(fresh.id, MissionState::Succeeded)
        .await;
    assert_eq!(
        yard.mission(waiting.id).await.mission.state,
        MissionState::Queued
    );
    assert!(
        !robot
            .offers()
            .iter()
            .any(|offer| offer.mission == waiting.id)
    );
    let resume = format!("/v1/missions/{}/resume", waiting.id);
    let (status, body) = yard.post(&resume, &Value::Null).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{body}");
    yard.mission_becomes(waiting.id, MissionState::Active).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_says_when_it_was_commanded_and_when_the_robot_stood() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let stop = yard.stop_robot(&Value::Null).await;
    assert!(stop.confirmed_at.is_some() && stop.standstill_at.is_none());
    let status = |state, stopping_time_ms| {
        Some(StandstillStatus {
            state,
            stopping_time_ms,
        })
    };
    robot.say(|said| {
        said.safety.standstill = status(StandstillState::StandstillNotReached, None);
        said.alerts = vec![AlertReport {
            code: "standstill-not-reached".parse().unwrap(),
            severity: Severity::Critical,
            text: "0.59 m/s".to_owned(),
        }];
    });
    eventually("the alert is raised", async || {
        let raised = yard.raised().await;
        let is_raised = raised.iter().any(|code| code == "standstill-not-reached");
        if is_raised { Ok(()) } else { Err(raised) }
    })
    .await;
    let shown: Page<Stop> = yard.get("/v1/stops").await;
    assert_eq!(shown.items[0].standstill_at, None, "it was only commanded");
    robot.say(|said| {
        said.safety.standstill = status(StandstillState::Standstill, Some(4_200));
        said.alerts.clear();
    });
    let stood = yard
        .stop_becomes("the robot stands", |stop| stop.standstill_at.is_some())
        .await;
    assert!(stood.standstill_at >= stood.confirmed_at, "{stood:?}");
    // The first time counts: it may be pushed afterwards.
    robot.say(|said| said.safety.standstill = status(StandstillState::UnexpectedMotion, None));
    robot.say(|said| said.safety.standstill = status(StandstillState::Standstill, Some(4_200)));
    let again = yard
        .stop_becomes("it is the same stop", |stop| stop.id == stood.id)
        .await;
    assert_eq!(again.standstill_at, stood.standstill_at);
    yard.server.stop().await.unwrap();
}

/// A robot's report that it paused a mission of itself, weeks ago.
fn safety_pause(mission: &Mission, paused_by: PauseCause) -> RecordContent {
    let RecordContent::Mission(mut paused) = report(mission, MissionPhase::Paused) else {
        panic!("a report on a mission");
    };
    paused.progress = Some(MissionProgress {
        id: mission.id,
        revision: mission.revision,
        plan_hash: mission.plan_hash,
        driven_m: 1.0,
        length_m: 18.0,
        cross_track_m: 0.0,
        paused: true,
        paused_by: Some(paused_by),
    });
    RecordContent::Mission(paused)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pause_that_is_reported_after_a_person_resumed_the_mission_does_not_hold_it_again() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    for asked in ["pause", "resume"] {
        let path = format!("/v1/missions/{}/{asked}", mission.id);
        let (status, body) = yard.post(&path, &Value::Null).await;
        assert!(status.is_success(), "{asked}: {body}");
    }
    let content = safety_pause(&mission, PauseCause::Stop);
    robot
        .upload(vec![Record { seq: 0, content }])
        .await
        .unwrap();
    let detail = yard.mission(mission.id).await;
    assert!(!detail.mission.pause_requested, "{detail:?}");
    yard.server.stop().await.unwrap();
}

/// What a robot reports of a stop that came in force then, by its clock, and of standstill now.
fn stopped_since(robot: &Robot, mission: &Mission, since: Timestamp) -> RecordContent {
    let RecordContent::Mission(mut paused) = safety_pause(mission, PauseCause::Stop) else {
        panic!("a report on a mission");
    };
    (paused.at, paused.since) = (robot.state().robot_time, Some(since));
    RecordContent::Mission(paused)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn when_the_stop_began_decides_whether_a_person_resumed_the_mission_since() {
    let yard = Yard::start().await;
    // Its clock is weeks behind.
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let before = robot.state().robot_time;
    for asked in ["pause", "resume"] {
        let path = format!("/v1/missions/{}/{asked}", mission.id);
        let (status, body) = yard.post(&path, &Value::Null).await;
        assert!(status.is_success(), "{asked}: {body}");
    }
    let later = eventually("some time has passed", async || {
        let now = robot.state().robot_time;
        let passed = now.duration_since(before);
        if passed > jiff::SignedDuration::from_secs(2) {
            Ok(now)
        } else {
            Err(passed)
        }
    })
    .await;
    // It stood long after the person had let it go on, for what had begun before that.
    let content = stopped_since(&robot, &mission, before);
    robot
        .upload(vec![Record { seq: 0, content }])
        .await
        .unwrap();
    let detail = yard.mission(mission.id).await;
    assert!(!detail.mission.pause_requested, "{detail:?}");
    // A stop that began afterwards is another one.
    let content = stopped_since(&robot, &mission, later);
    robot
        .upload(vec![Record { seq: 1, content }])
        .await
        .unwrap();
    let detail = yard.mission(mission.id).await;
    assert!(detail.mission.pause_requested, "{detail:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_pause_that_the_robot_reports_for_its_safety_is_what_is_wanted_from_then_on() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    for (seq, paused_by) in (0..).zip([PauseCause::Stop, PauseCause::Teleoperation]) {
        let mission = yard.create_mission(&robot.id).await;
        yard.mission_becomes(mission.id, MissionState::Active).await;
        let seq = 2 * seq;
        let content = safety_pause(&mission, paused_by);
        robot.upload(vec![Record { seq, content }]).await.unwrap();
        let held = yard.mission_becomes(mission.id, MissionState::Paused).await;
        assert!(held.mission.pause_requested, "{paused_by:?}: {held:?}");
        // The reconciler does not let it go on by itself.
        tokio::time::sleep(Duration::from_millis(1_200)).await;
        let holds = robot.holds();
        assert!(!holds.contains(&Verb::Resume), "{paused_by:?}: {holds:?}");
        robot.report(seq + 1, &mission, MissionPhase::Failed).await;
        yard.mission_becomes(mission.id, MissionState::Failed).await;
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_that_is_not_confirmed_is_shown_and_sent_again_over_a_restart() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.be_deaf_to_stops(true);
    let asked_at = Instant::now();
    let stop = yard.stop_robot(&json!({})).await;
    assert!(asked_at.elapsed() < Duration::from_secs(2));
    assert!(stop.unconfirmed && stop.confirmed_at.is_none(), "{stop:?}");
    eventually("the alert is raised", async || {
        let raised = yard.raised().await;
        let has = raised.iter().any(|code| code == "stop-unconfirmed");
        if has { Ok(()) } else { Err(raised) }
    })
    .await;
    assert!(yard.counters().await.stops_unconfirmed >= 1);

    let yard = yard.restart().await;
    yard.stop_becomes("it is still wanted", |stop| stop.unconfirmed)
        .await;
    robot.be_deaf_to_stops(false);
    let confirmed = yard
        .stop_becomes("the robot has confirmed", |stop| {
            stop.confirmed_at.is_some()
        })
        .await;
    assert_eq!(confirmed.id, stop.id);
    assert_eq!(robot.stops()[0].stop, stop.id);
    eventually("the alert is over", async || {
        let raised = yard.raised().await;
        let has = raised.iter().any(|code| code == "stop-unconfirmed");
        if has { Err(raised) } else { Ok(()) }
    })
    .await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_that_the_robot_forgot_is_sent_again_and_one_of_its_own_is_adopted() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let stop = yard.stop_robot(&json!({"by": "Ann"})).await;
    yard.stop_becomes("it is written", |stop| stop.confirmed_at.is_some())
        .await;
    robot.say(|state| state.safety.stop = None);
    eventually("the stop is sent again", async || {
        let count = robot.stops().len();
        if count >= 2 { Ok(()) } else { Err(count) }
    })
    .await;
    assert_eq!(yard.counters().await.stops_lost, 1);
    assert!(robot.stops().iter().all(|heard| heard.stop == stop.id));
    eventually("it can be cleared", async || {
        let (status, body) = yard.post(CLEAR, &json!({"stop": stop.id})).await;
        if status == StatusCode::OK {
            Ok(())
        } else {
            Err(body)
        }
    })
    .await;

    // A robot's identifiers do not rise with time.
    let own = uuid::Uuid::from_u128(u128::MAX);
    robot.say(|state| {
        state.safety.stop = Some(tread_api::safety::StopLatch {
            id: tread_api::ids::StopId::from_uuid(own),
            by: "rover-1".to_owned(),
            reason: "its memory of stops does not read".to_owned(),
            since: "2026-11-01T00:00:00Z".parse().unwrap(),
        });
    });
    eventually("the robot's own stop is listed", async || {
        let page: Page<Stop> = yard.get("/v1/stops?in_force=true").await;
        let found = page
            .items
            .iter()
            .any(|stop| stop.id.as_uuid() == own && stop.by == "rover-1");
        if found { Ok(()) } else { Err(page.items) }
    })
    .await;
    let (status, body) = yard.post(CLEAR, &json!({"stop": own})).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    let later = yard.stop_robot(&json!({})).await;
    yard.stop_becomes("the later one is written", |stop| stop.id == later.id)
        .await;
    let mut listed = Vec::new();
    let mut next = Some("/v1/stops?limit=1".to_owned());
    while let Some(path) = next {
        let page: Page<Stop> = yard.get(&path).await;
        listed.extend(page.items.iter().map(|stop| stop.id.as_uuid()));
        let cursor = page.next_cursor;
        next = cursor.map(|cursor| format!("/v1/stops?limit=1&cursor={cursor}"));
    }
    assert_eq!(listed, [later.id.as_uuid(), own, stop.id.as_uuid()]);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_that_ended_on_its_robot_with_a_later_one_is_listed_as_cleared() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    // Its answer to the stop is lost, as is the clear of whatever came after.
    robot.be_deaf_to_stops(true);
    let stop = yard.stop_robot(&json!({})).await;
    assert!(stop.unconfirmed, "{stop:?}");
    robot.call_stops_over();
    robot.be_deaf_to_stops(false);
    let over = yard
        .stop_becomes("it is over", |stop| stop.cleared_at.is_some())
        .await;
    assert_eq!(over.id, stop.id);
    assert!(over.confirmed_at.is_some() && !over.unconfirmed, "{over:?}");
    eventually("its alert is over too", async || {
        let raised = yard.raised().await;
        let has = raised.iter().any(|code| code == "stop-unconfirmed");
        if has { Err(raised) } else { Ok(()) }
    })
    .await;
    let page: Page<Stop> = yard.get("/v1/stops?in_force=true").await;
    assert!(page.items.is_empty(), "{:?}", page.items);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_clear_names_the_newest_stop_and_reaches_the_robot_or_nothing_is_cleared() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let first = yard.stop_robot(&json!({})).await;
    let second = yard.stop_robot(&json!({})).await;
    yard.stop_becomes("both are written", |stop| {
        stop.id == second.id && stop.confirmed_at.is_some()
    })
    .await;
    let (status, body) = yard.post(CLEAR, &json!({"stop": first.id})).await;
    assert_eq!(status, StatusCode::CONFLICT, "{body}");
    assert_eq!(body["type"], "/problems/stop-not-cleared");
    assert!(body["detail"].as_str().unwrap().contains("newer"), "{body}");
    let (status, body) = yard
        .post(CLEAR, &json!({"stop": uuid::Uuid::from_u128(9)}))
        .await;
    assert_eq!(
        (status, body["type"].as_str()),
        (StatusCode::NOT_FOUND, Some("/problems/unknown-stop"))
    );
    drop(robot);
    let (status, body) = yard.post(CLEAR, &json!({"stop": second.id})).await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{body}");
    let page: Page<Stop> = yard.get("/v1/stops?in_force=true").await;
    let ids: Vec<_> = page.items.iter().map(|stop| stop.id).collect();
    assert_eq!(ids, [second.id]);
    let page: Page<Stop> = yard.get("/v1/stops").await;
    let replaced = page.items.iter().find(|stop| stop.id == first.id);
    assert_eq!(replaced.unwrap().replaced_by, Some(second.id));
    let robot = Robot::join(&yard, "rover-1").await;
    // A robot that came back without the stop, although somebody had asked to clear it, has
    // cleared it as far as anyone knows; a clear now is harmless.
    let (status, body) = yard.post(CLEAR, &json!({"stop": second.id})).await;
    assert_eq!(status, StatusCode::OK, "{body}");
    let page: Page<Stop> = yard.get("/v1/stops?in_force=true").await;
    assert!(page.items.is_empty(), "{:?}", page.items);
    drop(robot);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fleet_stop_reaches_every_robot_and_says_who_has_not_confirmed() {
    let yard = Yard::start().await;
    let near = Robot::join(&yard, "rover-1").await;
    let far = Robot::join(&yard, "rover-2").await;
    drop(Robot::join(&yard, "rover-3").await);
    let (status, body) = yard
        .post("/v1/stop", &json!({"site": "yard", "by": "Ann"}))
        .await;
    assert_eq!(status, StatusCode::OK, "{body}");
    let stopped: FleetStop = serde_json::from_value(body).unwrap();
    assert_eq!(
        (stopped.confirmed, stopped.unconfirmed),
        (2, 1),
        "{stopped:?}"
    );
    let missing = stopped.stops.iter().find(|stop| stop.unconfirmed).unwrap();
    assert_eq!(missing.robot.as_str(), "rover-3");
    assert_eq!((near.stops().len(), far.stops().len()), (1, 1));
    let (status, _) = yard.post("/v1/stop", &json!({"site": "nowhere"})).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    // It comes back, and hears of it.
    let back = Robot::join(&yard, "rover-3").await;
    eventually("the robot that was away has heard", async || {
        let heard = back.stops();
        if heard.iter().any(|stop| stop.stop == missing.id) {
            Ok(())
        } else {
            Err(heard)
        }
    })
    .await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_whose_body_is_wrong_or_missing_stops_all_the_same() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let bare = yard.client().post(yard.url(STOP));
    let garbage = yard.client().post(yard.url(STOP)).body("{\"by\": ");
    let unknown = yard
        .client()
        .post(yard.url("/v1/stop"))
        .json(&json!({"sight": "yard"}));
    let mut sent = 0;
    for request in [bare, garbage, unknown] {
        let (status, body) = yard.send(request).await;
        assert_eq!(status, StatusCode::OK, "{body}");
        sent += 1;
        assert_eq!(robot.stops().len(), sent);
    }
    let (status, body) = yard
        .post("/v1/sites/yard/robots/nobody/stop", &json!({}))
        .await;
    assert_eq!(
        (status, body["type"].as_str()),
        (StatusCode::NOT_FOUND, Some("/problems/unknown-robot"))
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_can_be_read_of_a_stop_counts_and_only_a_site_that_is_none_is_refused() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let ask = |media_type: &'static str, body: &'static str| {
        let asked = yard.client().post(yard.url("/v1/stop"));
        asked.header("content-type", media_type).body(body)
    };
    let json = "application/json";
    for (media_type, body) in [
        (json, r#"{"site": "Yard 1"}"#),
        (json, r#"{"site": 7}"#),
        (json, r#"{"site": ["yard"], "by": "Ann"}"#),
        ("text/plain", r#"{"site": ""}"#),
    ] {
        let (status, said) = yard.send(ask(media_type, body)).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{body}: {said}");
        assert_eq!(said["field"], "site", "{said}");
        assert!(robot.stops().is_empty(), "{body}");
    }
    let (status, _) = yard.send(ask(json, r#"{"site": "elsewhere"}"#)).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    for (count, (media_type, body, reason)) in [
        (json, "", "no reason was given"),
        (json, r#"{"site": nul"#, "no reason was given"),
        (
            "application/x-www-form-urlencoded",
            "site=yard",
            "no reason was given",
        ),
        (json, r#"["yard", "Ann", "smoke"]"#, "no reason was given"),
        (
            json,
            r#"{"site": null, "reason": "smoke", "reson": 1}"#,
            "smoke",
        ),
        (
            "text/plain",
            r#"{"site": "yard", "by": 5, "reason": "a\u001b[2J\u202e\nb"}"#,
            "a [2J  b",
        ),
    ]
    .into_iter()
    .enumerate()
    {
        let (status, said) = yard.send(ask(media_type, body)).await;
        assert_eq!(status, StatusCode::OK, "{body}: {said}");
        let stop = &said["stops"][0];
        assert_eq!(
            (&stop["by"], &stop["reason"]),
            (&json!("tests"), &json!(reason))
        );
        assert_eq!(robot.stops().len(), count + 1, "{body}");
    }
    // A body that does not come keeps no robot going.
    let mut slow = tokio::net::TcpStream::connect(yard.server.http_address())
        .await
        .unwrap();
    let head = format!(
        "POST {STOP} HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {}\r\n\
         content-length: 100\r\n\r\n{{",
        yard.admin()
    );
    slow.write_all(head.as_bytes()).await.unwrap();
    let count = robot.stops().len();
    eventually("the robot is stopped", async || match robot.stops().len() {
        stops if stops > count => Ok(()),
        stops => Err(stops),
    })
    .await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_robot_says_is_bounded_and_moves_no_cursor() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.say(|state| state.fault = Some(format!("\u{1b}[2J{}", "x".repeat(200_000))));
    let fault = eventually("the fault is shown", async || {
        let (_, robot) = yard.get_value("/v1/sites/yard/robots/rover-1").await;
        let fault = robot["live"]["fault"].as_str().map(str::to_owned);
        fault.ok_or(robot)
    })
    .await;
    assert!(fault.chars().count() <= FAULT_TEXT_MAX);
    assert!(fault.starts_with("[2Jxx"), "{}", &fault[..20]);
    for name in ["a\u{1b}[2Jb", "a\0b", "a\nb", "a\u{202e}b", "\u{2066}"] {
        let path = "/v1/sites/yard/robots/rover-1";
        let renamed = yard
            .client()
            .patch(yard.url(path))
            .json(&json!({"name": name}));
        let (status, said) = yard.send(renamed).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
        for (path, body) in [
            ("/v1/tokens", json!({"name": name, "role": "viewer"})),
            ("/v1/sites", json!({"id": "field", "name": name})),
        ] {
            let (status, said) = yard.post(path, &body).await;
            assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{path}: {said}");
            assert_eq!(said["field"], "name", "{said}");
        }
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_clear_of_what_a_robot_showed_last_does_not_end_a_newer_stop_that_it_has_not_heard() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let stop = async |by: &str| -> Stop {
        let (status, body) = yard
            .post("/v1/sites/yard/robots/rover-1/stop", &json!({"by": by}))
            .await;
        assert_eq!(status, StatusCode::OK, "{body}");
        serde_json::from_value(body).unwrap()
    };
    let first = stop("Ann").await;
    eventually("the robot shows its stop", async || {
        let seen: tread_api::robot::Robot = yard.get("/v1/sites/yard/robots/rover-1").await;
        let latch = seen.live.as_ref().and_then(|live| live.safety.stop.clone());
        match latch {
            Some(latch) if latch.id == first.id => Ok(()),
            other => Err(other),
        }
    })
    .await;
    drop(robot);
    let second = stop("Bob").await;
    let (status, body) = yard
        .post(CLEAR, &json!({"stop": first.id, "by": "Cid"}))
        .await;
    assert_ne!(status, StatusCode::OK, "{body}");
    let open: Page<Stop> = yard.get("/v1/stops?in_force=true").await;
    let [open] = open.items.as_slice() else {
        panic!("one stop is open: {open:?}");
    };
    assert_eq!((open.id, open.confirmed_at), (second.id, None));
    let robot = Robot::join(&yard, "rover-1").await;
    eventually("the robot hears of the newer stop", async || {
        let heard: Vec<_> = robot.stops().iter().map(|heard| heard.stop).collect();
        if heard.contains(&second.id) {
            Ok(())
        } else {
            Err(heard)
        }
    })
    .await;
    yard.server.stop().await.unwrap();
}
