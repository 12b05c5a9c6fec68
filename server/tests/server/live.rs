//! Where the map changes is published: on the feed of events, on the network, and as gauges.

use std::time::Duration;

use jiff::SignedDuration;
use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::friction::MapChange;
use tread_api::{keys, wire};
use zenoh::Wait as _;

use crate::harness::{Yard, eventually, measured, model, segment, site};
use crate::robot::{Robot, session};

/// Reads events until one is named `name` and fits; its body.
async fn read_event(
    response: &mut reqwest::Response,
    text: &mut String,
    name: &str,
    is_it: impl Fn(&Value) -> bool,
) -> Value {
    let reading = async {
        loop {
            while let Some(end) = text.find("\n\n") {
                let event: String = text.drain(..end + 2).collect();
                let is_named = event.lines().any(|line| line == format!("event: {name}"));
                let body = event.lines().find_map(|line| line.strip_prefix("data: "));
                let body = body.map(|body| serde_json::from_str::<Value>(body).unwrap());
                if let Some(body) = body.filter(|body| is_named && is_it(body)) {
                    return body;
                }
            }
            let chunk = response.chunk().await.unwrap().expect("the stream goes on");
            text.push_str(&String::from_utf8_lossy(&chunk));
        }
    };
    let read = tokio::time::timeout(Duration::from_secs(15), reading).await;
    read.unwrap_or_else(|_elapsed| panic!("no {name} in {text}"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_change_of_the_map_is_sent_to_clients_and_programs_on_the_network() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let (words, mut notified) = tokio::sync::mpsc::channel(64);
    let program = session(&yard).await;
    let listening = program
        .declare_subscriber(keys::map(&site()))
        .callback(move |sample| {
            let change: MapChange = wire::decode(&sample.payload().to_bytes()).unwrap();
            let _ = words.try_send(change);
        });
    let _listening = listening.wait().unwrap();
    let mut stream = yard
        .client()
        .get(yard.url("/v1/events?topics=map&site=yard"))
        .send()
        .await
        .unwrap();
    let mut text = String::new();
    read_event(&mut stream, &mut text, "snapshot_end", |_| true).await;
    // The first look at the sites is what later ones are compared with.
    let mut seq = 0;
    let published = loop {
        let drive = [(3, 4), (5, 6), (-70, 1)];
        let drive = drive.map(|cell| {
            seq += 1;
            measured(seq, segment(cell, 0.2, 0))
        });
        robot.upload(drive.into()).await.unwrap();
        let change = tokio::time::timeout(Duration::from_secs(3), notified.recv()).await;
        if let Ok(change) = change {
            break change.unwrap();
        }
        assert!(seq < 30, "nothing was published on the network");
    };
    assert_eq!(
        (published.site.as_str(), published.entire_map),
        ("yard", false)
    );
    let corners: Vec<(i32, i32)> = published
        .boxes
        .iter()
        .map(|one| (one.min.ix, one.min.iy))
        .collect();
    assert_eq!(corners, [(-128, 0), (0, 0)], "two cells share a square");
    assert_eq!(
        (published.boxes[1].max.ix, published.boxes[1].max.iy),
        (63, 63)
    );
    let body = read_event(&mut stream, &mut text, "map", |_| true).await;
    let change: MapChange = serde_json::from_value(body["map"].clone()).unwrap();
    assert_eq!(change, published);

    let square = json!([{"x_m": 0, "y_m": 0}, {"x_m": 9, "y_m": 0}, {"x_m": 9, "y_m": 9}]);
    let body = json!({"id": "slab", "class": "concrete", "polygon": square});
    let (status, said) = yard.post("/v1/sites/yard/terrains", &body).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
    let body = read_event(&mut stream, &mut text, "map", |body| {
        body["map"]["entire_map"] == json!(true)
    })
    .await;
    assert_eq!(body["map"]["terrain_revision"], json!(1));
    program.close().wait().unwrap();
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_terrain_that_was_measured_has_gauges() {
    let now = segment((0, 0), 0.2, 0).ended_at + SignedDuration::from_mins(30);
    let yard = Yard::start_at(now).await;
    let square = json!([{"x_m": 0, "y_m": 0}, {"x_m": 9, "y_m": 0}, {"x_m": 9, "y_m": 9}]);
    for id in ["lawn", "unknown"] {
        let body = json!({"id": id, "class": "grass", "polygon": square});
        let (status, said) = yard.post("/v1/sites/yard/terrains", &body).await;
        assert_eq!(status, StatusCode::CREATED, "{said}");
    }
    let robot = Robot::join(&yard, "rover-1").await;
    robot
        .upload(vec![measured(0, segment((3, 1), 0.2, 0))])
        .await
        .unwrap();
    let address = yard.server.metrics_address().unwrap();
    let configuration = model().configuration();
    let labels = format!("{{site=\"yard\",terrain=\"lawn\",configuration=\"{configuration}\"}}");
    let values = eventually("the gauges are there", async || {
        let page = yard.client().get(format!("http://{address}/metrics"));
        let text = page.send().await.unwrap().text().await.unwrap();
        let value = |name: &str| {
            let line = text
                .lines()
                .find_map(|line| line.strip_prefix(&format!("{name}{labels} ")));
            line.and_then(|value| value.parse::<f64>().ok())
        };
        let found = value("tread_terrain_theta")
            .zip(value("tread_terrain_theta_std_dev"))
            .zip(value("tread_terrain_age_seconds"));
        assert!(
            !text.contains("terrain=\"unknown\""),
            "unknown is no number"
        );
        assert!(text.contains("\ntread_terrain_series_left_out 0\n"));
        found.ok_or(text)
    })
    .await;
    let ((theta, std_dev), age_s) = values;
    assert!((theta - 0.2).abs() < 1e-6, "{theta}");
    assert!((0.01..0.03).contains(&std_dev), "{std_dev}");
    assert!((1_740.0..=1_800.0).contains(&age_s), "{age_s}");
    yard.server.stop().await.unwrap();
}
