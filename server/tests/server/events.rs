//! The feed of events, as its clients read it.

use std::time::Duration;

use reqwest::StatusCode;
use tread_api::wire::ingest::MissionPhase;

use crate::harness::Yard;
use crate::robot::Robot;

/// Reads events of a stream until one fits.
async fn read_until(
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
