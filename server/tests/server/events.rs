//! The feed of events, as its clients read it.

use std::time::Duration;

use reqwest::StatusCode;
use serde_json::json;
use tread_api::event::{Event, MissionStep};
use tread_api::ids::MissionId;
use tread_api::mission::{MissionEvent, MissionState};
use tread_api::wire::ingest::MissionPhase;
use tread_server::db;

use crate::harness::{Yard, time};
use crate::robot::Robot;

/// Reads events of a stream until one fits.
pub(crate) async fn read_until(
    response: &mut reqwest::Response,
    text: &mut String,
    is_it: impl Fn(&str) -> bool,
) {
    let reading = async {
        while !is_it(text) {
            let chunk = response.chunk().await.unwrap().expect("the stream goes on");
            text.push_str(&String::from_utf8_lossy(&chunk));
        }
    };
    let read = tokio::time::timeout(Duration::from_secs(15), reading).await;
    assert!(read.is_ok(), "{text}");
}

/// The steps of missions in the text of a stream, in their order.
pub(crate) fn steps_in(text: &str) -> Vec<MissionStep> {
    let bodies = text.lines().filter_map(|line| line.strip_prefix("data: "));
    let events = bodies.filter_map(|body| serde_json::from_str(body).ok());
    let mut steps = Vec::new();
    for event in events {
        if let Event::Step(step) = event {
            steps.push(*step);
        }
    }
    steps
}

/// The identifier of the last event in the text of a stream.
pub(crate) fn last_id(text: &str) -> String {
    let mut ids = text.lines().filter_map(|line| line.strip_prefix("id: "));
    ids.next_back().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_of_the_server_before_reads_each_step_that_it_missed_once() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let path = "/v1/events?topics=missions";
    let mut stream = yard.client().get(yard.url(path)).send().await.unwrap();
    let first = yard.create_mission(&robot.id).await;
    let mut read = String::new();
    read_until(&mut stream, &mut read, |text| {
        steps_in(text)
            .iter()
            .any(|step| step.step.to == MissionState::Active)
    })
    .await;
    drop(stream);
    robot.report(0, &first, MissionPhase::Succeeded).await;
    yard.mission_becomes(first.id, MissionState::Succeeded)
        .await;
    let second = yard.create_mission(&robot.id).await;
    yard.mission_becomes(second.id, MissionState::Active).await;
    let yard = yard.restart().await;
    let third = yard.create_mission(&robot.id).await;
    let resume = async |last: &str, text: &mut String| {
        let asking = yard.client().get(yard.url(path));
        let mut stream = asking.header("last-event-id", last).send().await.unwrap();
        let is_there = |text: &str| {
            let mut steps = steps_in(text).into_iter();
            text.contains("event: snapshot_end") && steps.any(|step| step.mission == third.id)
        };
        read_until(&mut stream, text, is_there).await;
    };
    let mut rest = String::new();
    resume(&last_id(&read), &mut rest).await;
    // One that leaves after the first of these steps goes on after it.
    let (part, _) = rest.split_at(rest.find("\n\n").unwrap() + 2);
    let mut again = part.to_owned();
    resume(&last_id(part), &mut again).await;
    let mut stored = Vec::new();
    for id in [first.id, second.id, third.id] {
        let events = yard.mission(id).await.events;
        stored.extend(events.into_iter().map(|step| (id, step)));
    }
    for rest in [rest, again] {
        let steps = steps_in(&read).into_iter().chain(steps_in(&rest));
        let mut steps: Vec<_> = steps.map(|step| (step.mission, step.step)).collect();
        let count = steps.len();
        steps.retain(|step| stored.contains(step));
        assert_eq!(steps.len(), count, "all are in the history: {steps:?}");
        // The stream may have ended before the newest.
        let missing = stored.iter().filter(|step| !steps.contains(step));
        let missing: Vec<_> = missing.filter(|(id, _)| *id != third.id).collect();
        assert!(missing.is_empty(), "{missing:?}");
        let repeated = steps.iter().enumerate();
        let repeated = repeated.filter(|(at, step)| steps[..*at].contains(step));
        assert_eq!(repeated.count(), 0, "{steps:?}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn events_begin_with_a_snapshot_follow_what_happens_and_resume() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let open = async |query: &str, last: Option<&str>| {
        let mut request = yard.client().get(yard.url(&format!("/v1/events{query}")));
        if let Some(last) = last {
            request = request.header("last-event-id", last);
        }
        request.send().await.unwrap()
    };
    let mut stream = open("?topics=missions&robots=rover-1", None).await;
    assert_eq!(stream.headers()["content-type"], "text/event-stream");
    let mut text = String::new();
    read_until(&mut stream, &mut text, |text| {
        text.contains("event: snapshot_end")
    })
    .await;
    assert!(text.starts_with("event: snapshot_begin"), "{text}");
    assert!(
        !text.contains("event: robot"),
        "only missions were asked for: {text}"
    );
    let mission = yard.create_mission(&robot.id).await;
    let active = "\"to\":\"active\"";
    read_until(&mut stream, &mut text, |text| text.contains(active)).await;
    let last = text
        .lines()
        .filter_map(|line| line.strip_prefix("id: "))
        .next_back();
    let last = last.unwrap().to_owned();
    drop(stream);
    robot.report(0, &mission, MissionPhase::Succeeded).await;
    let mut stream = open("?topics=missions", Some(&last)).await;
    let mut text = String::new();
    let succeeded = "\"to\":\"succeeded\"";
    read_until(&mut stream, &mut text, |text| text.contains(succeeded)).await;
    assert!(!text.contains("snapshot"), "{text}");
    assert!(
        !text.contains("\"to\":\"offered\""),
        "what was read does not come again: {text}"
    );
    for (query, named) in [
        ("?topics=robots,weather", "weather"),
        ("?robots=rover-9", "rover-9"),
        ("?site=moon", "moon"),
        ("?colour=red", "colour"),
    ] {
        let (status, body) = yard.get_value(&format!("/v1/events{query}")).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{body}");
        assert!(body["detail"].as_str().unwrap().contains(named), "{body}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mission_that_does_not_read_keeps_no_other_from_being_sent() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mut missions = Vec::new();
    for _ in 0..8 {
        missions.push(yard.create_mission(&robot.id).await.id);
    }
    yard.mission_becomes(missions[0], MissionState::Active)
        .await;
    let request = yard.client().get(yard.url("/v1/events?topics=missions"));
    let mut stream = request.send().await.unwrap();
    let mut text = String::new();
    read_until(&mut stream, &mut text, |text| {
        text.contains("event: snapshot_end")
    })
    .await;
    let damaged = missions.remove(4);
    let mut tx = yard.server.app().db().write("test").await.unwrap();
    sqlx::query("UPDATE missions SET trajectory = '{' WHERE id = ?")
        .bind(damaged.to_string())
        .execute(&mut **tx.as_sqlite().unwrap())
        .await
        .unwrap();
    let step: MissionEvent = serde_json::from_value(json!({
        "at": time("2026-11-01T00:00:00Z"), "actor": "server", "from": "queued", "to": "queued",
        "cause": "recorded", "reason": "all of them move at once",
    }))
    .unwrap();
    for &id in missions.iter().chain([&damaged]) {
        db::history::add_event(&mut tx, id, &step).await.unwrap();
    }
    tx.commit().await.unwrap();
    let mut text = String::new();
    let is_notified = |text: &str, kind: &str, id: MissionId| {
        let mut events = text.split("\n\n");
        events.any(|event| event.contains(kind) && event.contains(&id.to_string()))
    };
    read_until(&mut stream, &mut text, |text| {
        let all = missions
            .iter()
            .all(|&id| is_notified(text, "event: mission", id));
        all && is_notified(text, "event: step", damaged)
    })
    .await;
    drop(stream);
    drop(robot);
    yard.server.stop().await.unwrap();
}
