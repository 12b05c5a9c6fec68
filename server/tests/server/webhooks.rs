//! Webhooks: what arrives, what is repeated, and what a receiver cannot do to the server.

mod hostile;
mod outbox;
mod receiver;
mod settings;

use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::geometry::Pose;
use tread_api::robot::Aged;
use tread_server::clock::Clock;
use tread_server::config::webhooks::WebhooksConfig;

use self::receiver::{Mood, Names, Receiver};
use crate::harness::{Yard, eventually, time};
use crate::robot::Robot;

const BEGIN: &str = "2026-11-20T08:00:00Z";

/// A configuration that allows `http` and these networks.
fn allowing(networks: &[&str]) -> WebhooksConfig {
    WebhooksConfig {
        allow_http: true,
        allowed_networks: networks.iter().map(|text| text.parse().unwrap()).collect(),
        ..WebhooksConfig::default()
    }
}

/// A server whose clock stands, and that may call every address of this machine.
async fn start() -> Yard {
    start_at(Arc::new(tempfile::tempdir().unwrap()), time(BEGIN)).await
}

async fn start_at(folder: Arc<tempfile::TempDir>, wall: Timestamp) -> Yard {
    let clock = Clock::manual(wall);
    Yard::start_resolving(folder, clock, Names::of(&[]), allowing(&["127.0.0.0/8"])).await
}

/// A new webhook: its identifier and its secret.
async fn create(yard: &Yard, settings: &Value) -> (String, String) {
    let (status, made) = yard.post("/v1/webhooks", settings).await;
    assert_eq!(status, StatusCode::CREATED, "{made}");
    let id = made["webhook"]["id"].as_str().unwrap().to_owned();
    (id, made["secret"].as_str().unwrap().to_owned())
}

async fn deliveries(yard: &Yard, id: &str) -> Vec<Value> {
    let (status, page) = yard
        .get_value(&format!("/v1/webhooks/{id}/deliveries"))
        .await;
    assert_eq!(status, StatusCode::OK, "{page}");
    page["items"].as_array().unwrap().clone()
}

/// Waits until the newest delivery of a webhook is as wanted.
async fn newest(yard: &Yard, id: &str, is_wanted: impl Fn(&Value) -> bool) -> Value {
    eventually("the newest delivery", async || {
        let found = deliveries(yard, id).await;
        match found.first() {
            Some(delivery) if is_wanted(delivery) => Ok(delivery.clone()),
            _ => Err(found),
        }
    })
    .await
}

/// Lets the robot report one alert, or none.
fn report(robot: &Robot, code: Option<&str>) {
    robot.say(|state| {
        let said = code.map(|code| json!({"code": code, "severity": "warning", "text": "flat"}));
        let said = said.map(|said| serde_json::from_value(said).unwrap());
        state.alerts = said.into_iter().collect();
    });
}

fn advance(yard: &Yard, span: Duration) {
    yard.server.app().clock().advance(span);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_alert_is_sent_signed_when_it_is_raised_and_when_it_ends() {
    let yard = start().await;
    let receiver = Receiver::start(Mood::Good).await;
    let settings = json!({"name": "on call", "url": receiver.url(), "kinds": ["battery-low"],
                          "sites": ["yard"]});
    let (id, secret) = create(&yard, &settings).await;
    let other = Receiver::start(Mood::Good).await;
    let (status, said) = yard.post("/v1/sites", &json!({"id": "quarry"})).await;
    assert_eq!(status, StatusCode::CREATED, "{said}");
    for (name, more) in [
        ("other kinds", json!({"kinds": ["robot-lost"]})),
        ("disabled", json!({"enabled": false})),
        ("another site", json!({"sites": ["quarry"]})),
    ] {
        let mut settings = json!({"name": name, "url": other.url()});
        let more = more.as_object().unwrap().clone();
        settings.as_object_mut().unwrap().extend(more);
        create(&yard, &settings).await;
    }
    let robot = Robot::join(&yard, "rover-1").await;
    robot.say(|state| {
        let value = Pose {
            x_m: 3.5,
            y_m: -2.0,
            heading_rad: 0.0,
        };
        state.pose = Some(Aged { value, age_ms: 0 });
    });
    report(&robot, Some("battery-low"));
    let opened = receiver.has(1).await.remove(0);
    assert!(
        opened.line.starts_with("POST /alerts?of=yard "),
        "{opened:?}"
    );
    assert_eq!(opened.headers["content-type"], "application/json");
    assert!(opened.is_signed_with(&secret), "{opened:?}");
    assert!(!opened.is_signed_with("tread_w_another"), "{opened:?}");
    assert_eq!(opened.timestamp_s(), time(BEGIN).as_second());
    let said = opened.json();
    let (_, alerts) = yard
        .get_value("/v1/alerts?kind=battery-low&raised=true")
        .await;
    let alert = &alerts["items"][0];
    assert_eq!(
        said,
        json!({
            "v": 1, "delivery": opened.delivery(), "event": "opened", "id": alert["id"],
            "kind": "battery-low", "severity": "warning", "text": "flat", "site": "yard",
            "robot": "rover-1", "mission": null, "place": {"x_m": 3.5, "y_m": -2.0},
            "at": alert["raised_at"], "opened_at": alert["raised_at"], "ended_at": null,
            "link": format!("/#site=yard&tab=alerts&alert={}", alert["id"].as_str().unwrap()),
        })
    );
    assert_eq!(alert["place"], json!({"x_m": 3.5, "y_m": -2.0}));

    report(&robot, None);
    let ended = receiver.has(2).await.remove(1);
    assert!(ended.is_signed_with(&secret), "{ended:?}");
    let said = ended.json();
    assert_eq!(said["event"], "ended");
    assert_eq!(said["id"], alert["id"]);
    assert!(said["ended_at"].is_string(), "{said}");
    assert_ne!(ended.delivery(), opened.delivery());
    let log = newest(&yard, &id, |delivery| delivery["state"] == "delivered").await;
    assert_eq!(log["id"], ended.delivery());
    assert_eq!((&log["status"], &log["attempts"]), (&json!(204), &json!(1)));
    let delivered = eventually("both are in the log", async || {
        let log = deliveries(&yard, &id).await;
        let is_done = log.iter().all(|one| one["state"] == "delivered");
        if log.len() == 2 && is_done {
            Ok(())
        } else {
            Err(log)
        }
    });
    delivered.await;
    let counters = yard.counters().await;
    assert_eq!(counters.webhook_delivered, 2);
    assert_eq!(counters.webhook_attempts_failed, 0);
    assert_eq!(receiver.requests().len(), 2);
    assert_eq!(other.connections(), 0);
    let metrics = yard.server.metrics_address().unwrap();
    let text = reqwest::get(format!("http://{metrics}/metrics")).await;
    let text = text.unwrap().text().await.unwrap();
    for line in ["tread_webhook_delivered_total 2", "tread_webhook_pending 0"] {
        assert!(text.lines().any(|found| found == line), "{line}: {text}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_alert_about_the_server_reaches_webhooks_of_every_site() {
    let folder = Arc::new(tempfile::tempdir().unwrap());
    let yard = start_at(Arc::clone(&folder), time(BEGIN)).await;
    let receiver = Receiver::start(Mood::Good).await;
    let settings = json!({"name": "on call", "url": receiver.url(), "sites": ["yard"],
                          "kinds": ["server-restarted"]});
    let (_, secret) = create(&yard, &settings).await;
    let (_, none) = yard.get_value("/v1/alerts?kind=server-restarted").await;
    assert_eq!(none["items"], json!([]), "it is the first start");
    drop(Robot::join(&yard, "rover-1").await);
    yard.server.stop().await.unwrap();
    let yard = start_at(folder, time("2026-11-20T09:00:00Z")).await;
    let opened = receiver.has(1).await.remove(0);
    assert!(opened.is_signed_with(&secret), "{opened:?}");
    let said = opened.json();
    assert_eq!(said["kind"], "server-restarted");
    assert_eq!(
        (&said["site"], &said["robot"]),
        (&Value::Null, &Value::Null)
    );
    let id = said["id"].as_str().unwrap();
    assert_eq!(said["link"], format!("/#tab=alerts&alert={id}"));
    let path = format!("/v1/alerts/{id}");
    assert_eq!(yard.get_value(&path).await.0, StatusCode::OK);
    // Whoever has seen it ends it.
    let (status, seen) = yard.post(&format!("{path}/acknowledge"), &json!({})).await;
    assert_eq!(status, StatusCode::OK, "{seen}");
    assert!(seen["cleared_at"].is_string(), "{seen}");
    let ended = receiver.has(2).await.remove(1);
    assert_eq!(ended.json()["event"], "ended");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_note_of_a_restart_ends_by_itself() {
    let folder = Arc::new(tempfile::tempdir().unwrap());
    let yard = start_at(Arc::clone(&folder), time(BEGIN)).await;
    drop(Robot::join(&yard, "rover-1").await);
    yard.server.stop().await.unwrap();
    let yard = start_at(folder, time("2026-11-20T09:00:00Z")).await;
    let path = "/v1/alerts?kind=server-restarted";
    let (_, raised) = yard.get_value(path).await;
    assert_eq!(raised["items"][0]["cleared_at"], Value::Null, "{raised}");
    advance(&yard, Duration::from_mins(10));
    eventually("it is over", async || {
        let (_, found) = yard.get_value(path).await;
        let is_over = found["items"][0]["cleared_at"].is_string();
        if is_over { Ok(()) } else { Err(found) }
    })
    .await;
    yard.server.stop().await.unwrap();
}
