//! Alerts that the server raises itself: robots that are lost, wait or have a wrong clock, and
//! missions that did not succeed.

use std::time::Duration;

use jiff::Timestamp;
use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::geometry::Pose;
use tread_api::ids::MissionId;
use tread_api::mission::{MissionDetail, MissionState};
use tread_api::robot::{Aged, LinkState, UpdateRobot};
use tread_api::wire::ingest::{MissionPhase, Record, RecordContent};
use tread_api::wire::reply::CommandRefusalCode;

use crate::harness::{Yard, circle, eventually, report, time};
use crate::robot::{Mood, Robot};

const BEGIN: &str = "2026-11-10T08:00:00Z";

/// All alerts of that code, the newest first.
async fn alerts(yard: &Yard, code: &str) -> Vec<Value> {
    let (status, found) = yard.get_value("/v1/alerts?site=yard").await;
    assert_eq!(status, StatusCode::OK, "{found}");
    let items = found["items"].as_array().unwrap().iter();
    items
        .filter(|alert| alert["code"] == code)
        .cloned()
        .collect()
}

/// Waits until that many alerts of a code were raised, the newest of which is raised or cleared.
async fn there_are(yard: &Yard, code: &str, count: usize, raised: bool) -> Vec<Value> {
    let what = format!("{count} alerts `{code}`, the newest raised: {raised}");
    eventually(&what, async || {
        let found = alerts(yard, code).await;
        let is_raised = found.first().map(|alert| alert["cleared_at"].is_null());
        if found.len() == count && is_raised == Some(raised) {
            Ok(found)
        } else {
            Err(found)
        }
    })
    .await
}

async fn link_is(yard: &Yard, robot: &str, link: LinkState) {
    eventually("the link", async || {
        let (_, found) = yard
            .get_value(&format!("/v1/sites/yard/robots/{robot}"))
            .await;
        if found["link"] == link.as_str() {
            Ok(())
        } else {
            Err(found)
        }
    })
    .await;
}

/// Lets the server's time go on while its robots are heard.
async fn pass(yard: &Yard, seconds: u64) {
    for _ in 0..seconds {
        yard.server.app().clock().advance(Duration::from_secs(1));
        yard.server.app().wake();
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_goes_away_raises_an_alert_until_it_is_back_also_over_a_restart() {
    let yard = Yard::start_at(time(BEGIN)).await;
    pass(&yard, 31).await;
    let robot = Robot::join(&yard, "rover-1").await;
    link_is(&yard, "rover-1", LinkState::Online).await;
    pass(&yard, 1).await;
    drop(robot);
    link_is(&yard, "rover-1", LinkState::Offline).await;
    yard.server.app().clock().advance(Duration::from_secs(10));
    pass(&yard, 1).await;
    assert_eq!(alerts(&yard, "robot-lost").await, Vec::<Value>::new());
    yard.server.app().clock().advance(Duration::from_secs(10));
    let raised = there_are(&yard, "robot-lost", 1, true).await;
    assert_eq!(raised[0]["severity"], "critical");
    let text = raised[0]["text"].as_str().unwrap();
    assert!(text.contains("15 s"), "{text}");
    // It is the same alert after a restart.
    let yard = yard.restart_at(time("2026-11-10T09:00:00Z")).await;
    pass(&yard, 35).await;
    there_are(&yard, "robot-lost", 1, true).await;
    let robot = Robot::join(&yard, "rover-1").await;
    link_is(&yard, "rover-1", LinkState::Online).await;
    pass(&yard, 1).await;
    there_are(&yard, "robot-lost", 1, true).await;
    pass(&yard, 4).await;
    let cleared = there_are(&yard, "robot-lost", 1, false).await;
    assert_eq!(cleared[0]["id"], raised[0]["id"]);
    // One that goes away while the server is down is missed as well.
    drop(robot);
    let yard = yard.restart_at(time("2026-11-10T10:00:00Z")).await;
    pass(&yard, 20).await;
    there_are(&yard, "robot-lost", 1, false).await;
    pass(&yard, 11).await;
    there_are(&yard, "robot-lost", 2, true).await;
    // Nobody misses a robot that is retired.
    let retired = UpdateRobot {
        retired: Some(true),
        ..UpdateRobot::default()
    };
    let path = yard.url("/v1/sites/yard/robots/rover-1");
    let (status, said) = yard.send(yard.client().patch(path).json(&retired)).await;
    assert_eq!(status, StatusCode::OK, "{said}");
    there_are(&yard, "robot-lost", 2, false).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_that_leaves_by_itself_is_not_missed() {
    let yard = Yard::start_at(time(BEGIN)).await;
    pass(&yard, 31).await;
    let robot = Robot::join(&yard, "rover-1").await;
    link_is(&yard, "rover-1", LinkState::Online).await;
    pass(&yard, 1).await;
    robot.say(|state| state.leaving = true);
    let key = ("yard".parse().unwrap(), "rover-1".parse().unwrap());
    eventually("the last word is heard", async || {
        let presence = yard.server.app().presences().get(&key);
        if presence.has_left() { Ok(()) } else { Err(()) }
    })
    .await;
    drop(robot);
    link_is(&yard, "rover-1", LinkState::Offline).await;
    yard.server.app().clock().advance(Duration::from_mins(1));
    pass(&yard, 3).await;
    assert_eq!(alerts(&yard, "robot-lost").await, Vec::<Value>::new());
    yard.server.stop().await.unwrap();
}

async fn failed(robot: &Robot, yard: &Yard, seq: u64, reason: &str) -> MissionId {
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.say(|state| state.mission = None);
    let RecordContent::Mission(mut said) = report(&mission, MissionPhase::Failed) else {
        unreachable!("it is a report");
    };
    said.reason = Some(reason.to_owned());
    let content = RecordContent::Mission(said);
    robot.upload(vec![Record { seq, content }]).await.unwrap();
    yard.mission_becomes(mission.id, MissionState::Failed).await;
    mission.id
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_failed_raises_an_alert_until_it_is_acknowledged_or_one_succeeds() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mut events = yard
        .client()
        .get(yard.url("/v1/events?topics=alerts"))
        .send()
        .await
        .unwrap();
    let first = failed(&robot, &yard, 0, "a wheel is stuck").await;
    let raised = there_are(&yard, "mission-failed", 1, true).await;
    let text = raised[0]["text"].as_str().unwrap();
    assert!(
        text.contains(&first.to_string()) && text.contains("a wheel is stuck"),
        "{text}"
    );
    let mut heard = String::new();
    while !heard.contains("mission-failed") {
        let next = tokio::time::timeout(Duration::from_secs(15), events.chunk()).await;
        heard.push_str(&String::from_utf8_lossy(&next.unwrap().unwrap().unwrap()));
    }
    // Another failure is another alert, and only the newest is raised.
    let second = failed(&robot, &yard, 1, "a wheel is off").await;
    let raised = there_are(&yard, "mission-failed", 2, true).await;
    assert!(
        raised[0]["text"]
            .as_str()
            .unwrap()
            .contains(&second.to_string())
    );
    assert!(raised[1]["cleared_at"].is_string(), "{raised:?}");
    let yard = yard.restart().await;
    let raised = there_are(&yard, "mission-failed", 2, true).await;
    let id = raised[0]["id"].as_str().unwrap();
    let path = format!("/v1/alerts/{id}/acknowledge");
    let (status, seen) = yard.post(&path, &json!({})).await;
    assert_eq!(status, StatusCode::OK);
    assert!(seen["cleared_at"].is_string(), "{seen}");
    let times = [
        &seen["raised_at"],
        &seen["acknowledged_at"],
        &seen["cleared_at"],
    ];
    let times = times.map(|at| at.as_str().unwrap().parse::<Timestamp>().unwrap());
    assert!(times.is_sorted(), "{seen}");
    drop(robot);
    let robot = Robot::join(&yard, "rover-1").await;
    failed(&robot, &yard, 0, "again").await;
    there_are(&yard, "mission-failed", 3, true).await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.report(1, &mission, MissionPhase::Succeeded).await;
    there_are(&yard, "mission-failed", 3, false).await;
    yard.server.stop().await.unwrap();
}

fn driven_m(detail: &MissionDetail) -> f64 {
    detail.mission.progress.unwrap().driven_m
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_ended_without_its_robots_word_keeps_how_far_it_was_shown_to_have_come() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.drive(&mission, 0.0);
    robot.report(0, &mission, MissionPhase::Started).await;
    robot.drive(&mission, 11.5);
    eventually("the server knows how far it is", async || {
        let detail = yard.mission(mission.id).await;
        let driven_m = detail.mission.progress.map(|progress| progress.driven_m);
        if driven_m == Some(11.5) {
            Ok(())
        } else {
            Err(driven_m)
        }
    })
    .await;
    // The agent starts again, and knows only that it drove the mission.
    let robot = robot.reboot(&yard).await;
    robot.report(1, &mission, MissionPhase::Failed).await;
    let detail = yard.mission_becomes(mission.id, MissionState::Failed).await;
    assert!((driven_m(&detail) - 11.5).abs() < 1e-9, "{detail:?}");
    let (_, alert) = yard.get_value("/v1/alerts").await;
    assert_eq!(alert["items"][0]["code"], "mission-failed", "{alert}");

    // What the server ended by itself keeps it too, until the robot's own word comes.
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.drive(&mission, 3.25);
    eventually("the server knows how far it is", async || {
        let detail = yard.mission(mission.id).await;
        let driven_m = detail.mission.progress.map(|progress| progress.driven_m);
        if driven_m == Some(3.25) {
            Ok(())
        } else {
            Err(driven_m)
        }
    })
    .await;
    let first_run = robot.boot;
    let robot = robot.reboot(&yard).await;
    let detail = yard.mission_becomes(mission.id, MissionState::Failed).await;
    assert!((driven_m(&detail) - 3.25).abs() < 1e-9, "{detail:?}");
    let RecordContent::Mission(mut late) = report(&mission, MissionPhase::Failed) else {
        unreachable!("it is a report");
    };
    let mut progress = detail.mission.progress.unwrap();
    progress.driven_m = 3.5;
    late.progress = Some(progress);
    let content = RecordContent::Mission(late);
    let late = vec![Record { seq: 9, content }];
    robot.upload_as(first_run, late).await.unwrap();
    let detail = yard.mission(mission.id).await;
    assert!((driven_m(&detail) - 3.5).abs() < 1e-9, "{detail:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn missions_that_expire_or_are_rejected_raise_alerts_until_one_succeeds() {
    let yard = Yard::start_at(time(BEGIN)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot.set_mood(Mood::Refusing(CommandRefusalCode::Impossible));
    let rejected = yard.create_mission(&robot.id).await;
    yard.mission_becomes(rejected.id, MissionState::Rejected)
        .await;
    let raised = there_are(&yard, "mission-rejected", 1, true).await;
    assert_eq!(raised[0]["mission"], json!(rejected.id));
    assert_eq!(raised[0]["robot"], "rover-1");

    let mut late = circle(&robot.id);
    drop(robot);
    link_is(&yard, "rover-1", LinkState::Offline).await;
    late["latest_start"] = json!("2026-11-10T08:01:00Z");
    let (status, expired) = yard.post("/v1/missions", &late).await;
    assert_eq!(status, StatusCode::CREATED, "{expired}");
    yard.server.app().clock().advance(Duration::from_mins(2));
    let raised = there_are(&yard, "mission-expired", 1, true).await;
    assert_eq!(raised[0]["mission"], expired["id"]);
    there_are(&yard, "mission-rejected", 1, true).await;

    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.report(0, &mission, MissionPhase::Succeeded).await;
    there_are(&yard, "mission-expired", 1, false).await;
    there_are(&yard, "mission-rejected", 1, false).await;
    let (_, of_kind) = yard.get_value("/v1/alerts?kind=mission-expired").await;
    assert_eq!(of_kind["items"].as_array().unwrap().len(), 1, "{of_kind}");
    let (_, open) = yard
        .get_value("/v1/alerts?kind=mission-expired&raised=true")
        .await;
    assert_eq!(open["items"], json!([]));
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_does_not_come_on_raises_an_alert_where_it_stands_until_it_drives() {
    let yard = Yard::start_at(time(BEGIN)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.drive(&mission, 3.0);
    robot.say(|state| {
        let value = Pose {
            x_m: 1.0,
            y_m: 5.0,
            heading_rad: 0.0,
        };
        state.pose = Some(Aged { value, age_ms: 0 });
    });
    pass(&yard, 3).await;
    // In steps that are too short for a robot to be lost.
    for _ in 0..32 {
        yard.server.app().clock().advance(Duration::from_secs(10));
        link_is(&yard, "rover-1", LinkState::Online).await;
    }
    pass(&yard, 2).await;
    let raised = there_are(&yard, "robot-waiting", 1, true).await;
    assert_eq!(raised[0]["mission"], json!(mission.id));
    assert_eq!(raised[0]["place"], json!({"x_m": 1.0, "y_m": 5.0}));
    let text = raised[0]["text"].as_str().unwrap();
    assert!(text.contains("for 5 min"), "{text}");
    robot.drive(&mission, 4.0);
    pass(&yard, 2).await;
    there_are(&yard, "robot-waiting", 1, false).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_whose_clock_stays_wrong_raises_an_alert_that_says_by_how_much() {
    // The played robots' clocks are nine days behind this.
    let yard = Yard::start_at(time(BEGIN)).await;
    let _robot = Robot::join(&yard, "rover-1").await;
    link_is(&yard, "rover-1", LinkState::Online).await;
    pass(&yard, 2).await;
    assert_eq!(alerts(&yard, "clock-wrong").await, Vec::<Value>::new());
    pass(&yard, 35).await;
    let raised = there_are(&yard, "clock-wrong", 1, true).await;
    let text = raised[0]["text"].as_str().unwrap();
    assert!(text.contains("s behind the server's"), "{text}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_does_not_begin_raises_an_alert_until_it_begins_or_ends() {
    let yard = Yard::start_at(time(BEGIN)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    link_is(&yard, "rover-1", LinkState::Online).await;
    let id = robot.id.clone();
    drop(robot);
    link_is(&yard, "rover-1", LinkState::Offline).await;
    let first = yard.create_mission(&id).await;
    pass(&yard, 2).await;
    yard.server.app().clock().advance(Duration::from_secs(290));
    pass(&yard, 1).await;
    assert_eq!(alerts(&yard, "mission-waiting").await, Vec::<Value>::new());
    yard.server.app().clock().advance(Duration::from_secs(10));
    pass(&yard, 1).await;
    let raised = there_are(&yard, "mission-waiting", 1, true).await;
    assert_eq!(raised[0]["mission"], json!(first.id));
    let text = raised[0]["text"].as_str().unwrap();
    assert!(text.contains("5 min: the robot is not heard"), "{text}");
    // It is the same alert after a restart, and ends with its mission.
    let yard = yard.restart_at(time("2026-11-10T09:00:00Z")).await;
    pass(&yard, 3).await;
    there_are(&yard, "mission-waiting", 1, true).await;
    let path = format!("/v1/missions/{}/cancel", first.id);
    let (status, said) = yard.post(&path, &json!({})).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{said}");
    pass(&yard, 1).await;
    there_are(&yard, "mission-waiting", 1, false).await;
    // One that begins in time raises none.
    let _robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    there_are(&yard, "mission-waiting", 1, false).await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_is_away_no_longer_waits_on_a_mission_that_has_ended() {
    let yard = Yard::start_at(time(BEGIN)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    yard.mission_becomes(mission.id, MissionState::Active).await;
    robot.drive(&mission, 3.0);
    pass(&yard, 3).await;
    for _ in 0..32 {
        yard.server.app().clock().advance(Duration::from_secs(10));
        link_is(&yard, "rover-1", LinkState::Online).await;
    }
    pass(&yard, 2).await;
    there_are(&yard, "robot-waiting", 1, true).await;
    drop(robot);
    link_is(&yard, "rover-1", LinkState::Offline).await;
    let path = format!("/v1/missions/{}/cancel", mission.id);
    let (status, said) = yard.post(&path, &json!({})).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{said}");
    pass(&yard, 1).await;
    // The robot may be driving it still, as far as anybody knows.
    there_are(&yard, "robot-waiting", 1, true).await;
    yard.server.app().clock().advance(Duration::from_hours(2));
    pass(&yard, 3).await;
    there_are(&yard, "robot-waiting", 1, false).await;
    yard.server.stop().await.unwrap();
}
