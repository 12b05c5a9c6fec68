//! The feed of events, as its clients read it.

use std::time::Duration;

use reqwest::StatusCode;
use serde_json::json;
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
        "cause": "noted", "reason": "all of them move at once",
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
