//! A machine whose clock is set back: nobody's history goes back with it.

use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::ids::RobotId;
use tread_api::mission::{MissionDetail, MissionState};
use tread_api::robot::{AlertReport, Severity};
use tread_api::wire::ingest::MissionPhase;
use zenoh::Wait as _;
use zenoh::qos::CongestionControl;
use zenoh::time::{NTP64, TimestampId};

use crate::harness::{Yard, eventually, time};
use crate::robot::{Robot, session};

/// Steps that are waited for, and one that is followed.
const STEPS: [SignedDuration; 2] = [
    SignedDuration::from_hours(-1),
    SignedDuration::from_hours(-50),
];

fn is_sorted(times: &[Option<Timestamp>]) -> bool {
    times.iter().flatten().is_sorted()
}

fn assert_history_sorted(detail: &MissionDetail) {
    let steps: Vec<Option<Timestamp>> = detail.events.iter().map(|event| Some(event.at)).collect();
    assert!(is_sorted(&steps), "{detail:#?}");
    let mission = &detail.mission;
    let times = [
        Some(mission.created_at),
        mission.started_at,
        mission.ended_at,
    ];
    assert!(mission.started_at.is_some() && mission.ended_at.is_some());
    assert!(is_sorted(&times), "{mission:#?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_missions_history_goes_back_with_the_machines_clock() {
    // The robot's clock says midnight, and the server's an hour later.
    for step in STEPS {
        let yard = Yard::start_at(time("2026-11-01T01:00:00Z")).await;
        let clock = yard.server.app().clock().clone();
        let robot = Robot::join(&yard, "rover-1").await;
        clock.advance(Duration::from_secs(10));
        let mission = yard.create_mission(&robot.id).await;
        yard.mission_becomes(mission.id, MissionState::Active).await;
        clock.step(step);
        robot.report(0, &mission, MissionPhase::Started).await;
        clock.step(step);
        robot.report(1, &mission, MissionPhase::Succeeded).await;
        yard.mission_becomes(mission.id, MissionState::Succeeded)
            .await;
        assert_history_sorted(&yard.mission(mission.id).await);
        // The next one is listed as the newest, and is not driven before the first.
        let next = yard.create_mission(&robot.id).await;
        assert!(next.id > mission.id, "{step:?}");
        yard.server.stop().await.unwrap();
    }
}

async fn stop(yard: &Yard, robot: &RobotId) -> Value {
    let path = format!("/v1/sites/yard/robots/{robot}/stop");
    let (status, stop) = yard.post(&path, &json!({"by": "Ann"})).await;
    assert_eq!(status, StatusCode::OK, "{stop}");
    stop
}

fn times_of(entry: &Value, names: &[&str]) -> Vec<Option<Timestamp>> {
    let text = |name: &&str| entry[*name].as_str().map(time);
    names.iter().map(text).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_alert_stop_or_audit_entry_goes_back_with_the_machines_clock() {
    for step in STEPS {
        let yard = Yard::start_at(time("2026-11-10T01:00:00Z")).await;
        let clock = yard.server.app().clock().clone();
        let robot = Robot::join(&yard, "rover-1").await;
        let code = "base-silent";
        robot.say(|state| {
            state.alerts = vec![AlertReport {
                code: code.parse().unwrap(),
                severity: Severity::Critical,
                text: "the base is silent".to_owned(),
            }];
        });
        let alert = eventually("the alert is raised", async || {
            let (_, found) = yard.get_value("/v1/alerts").await;
            let alert = found["items"].as_array().unwrap().iter();
            let mut alert = alert.filter(|alert| alert["code"] == code);
            alert.next().cloned().ok_or(found.clone())
        })
        .await;
        let id = alert["id"].as_str().unwrap();
        let stopped = stop(&yard, &robot.id).await;
        clock.step(step);
        let (status, _) = yard
            .post(&format!("/v1/alerts/{id}/acknowledge"), &json!({}))
            .await;
        assert_eq!(status, StatusCode::OK);
        robot.say(|state| state.alerts.clear());
        clock.step(step);
        let clearing = json!({"stop": stopped["id"], "by": "Bob"});
        let path = format!("/v1/sites/yard/robots/{}/stop/clear", robot.id);
        let (status, cleared) = yard.post(&path, &clearing).await;
        assert_eq!(status, StatusCode::OK, "{cleared}");
        let names = [
            "requested_at",
            "confirmed_at",
            "clear_requested_at",
            "cleared_at",
        ];
        let times = times_of(&cleared, &names);
        assert!(times.iter().all(Option::is_some), "{cleared}");
        assert!(is_sorted(&times), "{cleared}");
        let alert = eventually("the alert is cleared", async || {
            let (_, found) = yard.get_value("/v1/alerts").await;
            let alert = found["items"].as_array().unwrap().iter();
            let mut alert = alert.filter(|alert| alert["id"] == id);
            let alert = alert.next().cloned().unwrap();
            if alert["cleared_at"].is_string() {
                Ok(alert)
            } else {
                Err(alert)
            }
        })
        .await;
        let names = ["raised_at", "acknowledged_at", "cleared_at"];
        let times = times_of(&alert, &names);
        assert!(
            times.iter().all(Option::is_some) && is_sorted(&times),
            "{alert}"
        );
        let audit = eventually("the log has the clearing", async || {
            let (_, found) = yard.get_value("/v1/audit").await;
            let entries = found["items"].as_array().unwrap().clone();
            let last = entries.first().and_then(|entry| entry["path"].as_str());
            if last.is_some_and(|path| path.ends_with("/clear")) {
                Ok(entries)
            } else {
                Err(found)
            }
        })
        .await;
        let times: Vec<_> = audit
            .iter()
            .rev()
            .map(|entry| Some(time(entry["at"].as_str().unwrap())))
            .collect();
        assert!(times.len() >= 3 && is_sorted(&times), "{audit:#?}");
        yard.server.stop().await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_starts_again_with_its_clock_set_back_takes_up_where_it_was() {
    let yard = Yard::start_at(time("2026-11-10T01:00:00Z")).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    let before = yard.server.app().clock().now();
    drop(robot);
    let yard = yard.restart_at(time("2026-11-10T00:00:00Z")).await;
    assert!(yard.server.app().clock().now() >= before);
    let robot: RobotId = "rover-1".parse().unwrap();
    let next = yard.create_mission(&robot).await;
    assert!(
        next.id > mission.id && next.created_at >= before,
        "{next:?}"
    );
    // A day is not waited for, but the order of missions holds.
    let yard = yard.restart_at(time("2026-11-01T00:00:00Z")).await;
    assert!(yard.server.app().clock().now() < before);
    let last = yard.create_mission(&robot).await;
    assert!(last.id > next.id, "{last:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_from_the_future_passes_the_router_as_it_is() {
    let yard = Yard::start().await;
    let (speaker, hearer) = (session(&yard).await, session(&yard).await);
    let (sender, stamps) = std::sync::mpsc::sync_channel(64);
    hearer
        .declare_subscriber("someone/else/clock")
        .callback(move |sample| {
            let _ = sender.try_send(sample.timestamp().copied());
        })
        .background()
        .wait()
        .unwrap();
    // The router's clock was set back by an hour: messages come from an hour ahead.
    let ahead = yard.server.app().clock().now() + Duration::from_hours(1);
    let since_1970 = ahead.duration_since(Timestamp::UNIX_EPOCH);
    let ahead = NTP64::from(Duration::try_from(since_1970).unwrap());
    let stamp = zenoh::time::Timestamp::new(ahead, TimestampId::try_from([7]).unwrap());
    let found = eventually("a message comes through", async || {
        speaker
            .put("someone/else/clock", "tick")
            .congestion_control(CongestionControl::Block)
            .timestamp(stamp)
            .wait()
            .unwrap();
        stamps.try_recv()
    })
    .await;
    assert_eq!(found, Some(stamp), "the router put a time of its own");
    for session in [speaker, hearer] {
        session.close().wait().unwrap();
    }
    yard.server.stop().await.unwrap();
}
