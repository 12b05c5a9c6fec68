//! What is repeated, what waits, and what is left out.

use std::sync::Arc;
use std::time::Duration;

use reqwest::StatusCode;
use serde_json::{Value, json};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection as _, SqliteConnection};
use tread_api::ids::{DeliveryId, WebhookId};
use tread_api::webhook::NoticeEvent;
use tread_server::app::webhooks::PENDING_MAX;
use tread_server::db;
use tread_server::db::webhooks::NewDelivery;

use super::receiver::{Mood, Receiver};
use super::{BEGIN, advance, create, deliveries, newest, report, start, start_at};
use crate::harness::{Yard, database, eventually, time};
use crate::robot::Robot;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_delivery_is_repeated_with_its_identifier_until_it_arrives_also_over_a_restart() {
    let folder = Arc::new(tempfile::tempdir().unwrap());
    let yard = start_at(Arc::clone(&folder), time(BEGIN)).await;
    let receiver = Receiver::start(Mood::Says(500, "no\u{1b}[2J room")).await;
    let (id, secret) = create(&yard, &json!({"name": "x", "url": receiver.url()})).await;
    let robot = Robot::join(&yard, "rover-1").await;
    report(&robot, Some("battery-low"));
    let tried = newest(&yard, &id, |delivery| delivery["attempts"] == 1).await;
    assert_eq!(
        (&tried["state"], &tried["status"]),
        (&json!("pending"), &json!(500))
    );
    let detail = tried["detail"].as_str().unwrap();
    assert!(detail.contains("no [2J room"), "{detail}");
    assert_eq!(receiver.requests().len(), 1, "it waits for its back-off");
    advance(&yard, Duration::from_secs(10));
    let tried = newest(&yard, &id, |delivery| delivery["attempts"] == 2).await;
    let requests = receiver.has(2).await;
    assert_eq!(requests[0].delivery(), requests[1].delivery());
    assert_eq!(requests[0].body, requests[1].body);
    assert_eq!(requests[1].timestamp_s(), requests[0].timestamp_s() + 10);
    assert!(tried["next_attempt_at"].is_string(), "{tried}");
    drop(robot);
    yard.server.stop().await.unwrap();

    receiver.set(Mood::Good);
    let yard = start_at(folder, time("2026-11-20T08:05:00Z")).await;
    let requests = receiver.has(3).await;
    let again = requests
        .iter()
        .filter(|request| request.delivery() == requests[0].delivery());
    assert!(again.clone().count() >= 3, "{requests:?}");
    assert!(again.clone().all(|request| request.is_signed_with(&secret)));
    eventually("it is delivered", async || {
        let log = deliveries(&yard, &id).await;
        let of_first = log.iter().find(|one| one["id"] == requests[0].delivery());
        match of_first {
            Some(one) if one["state"] == "delivered" => Ok(()),
            _ => Err(log),
        }
    })
    .await;
    assert_eq!(tried["id"], requests[0].delivery());
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_delivery_under_way_when_the_server_stops_is_sent_again_by_the_next() {
    let folder = Arc::new(tempfile::tempdir().unwrap());
    let yard = start_at(Arc::clone(&folder), time(BEGIN)).await;
    let receiver = Receiver::start(Mood::Hangs).await;
    let (id, _) = create(&yard, &json!({"name": "x", "url": receiver.url()})).await;
    let path = format!("/v1/webhooks/{id}/test");
    let (status, queued) = yard.post(&path, &json!({})).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{queued}");
    let first = receiver.has(1).await.remove(0);
    assert_eq!(first.delivery(), queued["id"]);
    assert_eq!(first.json()["kind"], "test");
    yard.server.stop().await.unwrap();
    receiver.set(Mood::Good);
    let yard = start_at(folder, time(BEGIN)).await;
    let again = receiver.has(2).await.remove(1);
    assert_eq!(again.delivery(), first.delivery());
    newest(&yard, &id, |delivery| delivery["state"] == "delivered").await;
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn that_nothing_can_be_stored_is_sent_all_the_same_and_once_more_when_it_can() {
    let folder = Arc::new(tempfile::tempdir().unwrap());
    let yard = start_at(Arc::clone(&folder), time(BEGIN)).await;
    let receiver = Receiver::start(Mood::Good).await;
    let settings = json!({"name": "x", "url": receiver.url(), "kinds": ["storage-unwritable"]});
    let (id, secret) = create(&yard, &settings).await;
    let options = SqliteConnectOptions::new().filename(database(folder.path()));
    let mut other = SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::query("BEGIN IMMEDIATE")
        .execute(&mut other)
        .await
        .unwrap();
    // Readiness is asked for anew.
    advance(&yard, Duration::from_secs(2));
    let (status, body) = yard.get_value("/readyz").await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{body}");
    let first = receiver.has(1).await.remove(0);
    assert!(first.is_signed_with(&secret), "{first:?}");
    assert_eq!(first.json()["kind"], "storage-unwritable");
    assert_eq!(deliveries(&yard, &id).await, Vec::<Value>::new());
    sqlx::query("ROLLBACK").execute(&mut other).await.unwrap();
    let again = receiver.has(2).await.remove(1);
    assert_eq!(again.delivery(), first.delivery());
    newest(&yard, &id, |delivery| delivery["state"] == "delivered").await;
    yard.server.stop().await.unwrap();
}

/// Queues deliveries that were not sent yet, as if at a time.
async fn queue(yard: &Yard, webhook: &str, count: u32, at: &str) {
    let webhook: WebhookId = webhook.parse().unwrap();
    let app = yard.server.app();
    let mut tx = app.db().write("test").await.unwrap();
    for _ in 0..count {
        let new = NewDelivery {
            id: app.clock().new_id::<DeliveryId>(),
            webhook,
            alert: None,
            event: NoticeEvent::Opened,
            kind: "battery-low".parse().unwrap(),
            body: "{}".to_owned(),
            at: time(at),
        };
        db::webhooks::queue(&mut tx, &new).await.unwrap();
    }
    tx.commit().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_too_many_that_wait_the_oldest_are_dropped_and_counted() {
    let yard = start().await;
    let receiver = Receiver::start(Mood::Says(503, "")).await;
    let settings = json!({"name": "x", "url": receiver.url(), "enabled": false});
    let (id, _) = create(&yard, &settings).await;
    queue(&yard, &id, PENDING_MAX, BEGIN).await;
    for _ in 0..3 {
        let path = format!("/v1/webhooks/{id}/test");
        assert_eq!(yard.post(&path, &json!({})).await.0, StatusCode::ACCEPTED);
    }
    let (_, webhook) = yard.get_value(&format!("/v1/webhooks/{id}")).await;
    assert_eq!(webhook["pending"], PENDING_MAX, "{webhook}");
    assert_eq!(yard.counters().await.webhook_dropped, 3);
    let mut cursor = String::new();
    let mut found = Vec::new();
    loop {
        let path = format!("/v1/webhooks/{id}/deliveries?limit=400{cursor}");
        let (answered, page) = yard.get_value(&path).await;
        assert_eq!(answered, StatusCode::OK, "{page}");
        let items = page["items"].as_array().unwrap().iter();
        found.extend(items.map(|one| one["state"].as_str().unwrap().to_owned()));
        match page["next_cursor"].as_str() {
            Some(next) => cursor = format!("&cursor={next}"),
            None => break,
        }
    }
    assert_eq!(found.len(), 3 + PENDING_MAX as usize);
    let oldest = &found[PENDING_MAX as usize..];
    assert!(oldest.iter().all(|one| one == "dropped"), "{oldest:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_waits_too_long_is_given_up_and_what_is_deleted_is_gone() {
    let yard = start().await;
    let receiver = Receiver::start(Mood::Good).await;
    let settings = json!({"name": "x", "url": receiver.url(), "enabled": false});
    let (id, _) = create(&yard, &settings).await;
    queue(&yard, &id, 2, "2026-11-20T06:00:00Z").await;
    advance(&yard, Duration::from_hours(23));
    let given_up = newest(&yard, &id, |delivery| delivery["state"] == "failed").await;
    let detail = given_up["detail"].as_str().unwrap();
    assert!(detail.contains("waited too long"), "{detail}");
    assert_eq!(yard.counters().await.webhook_given_up, 2);
    assert_eq!(receiver.connections(), 0, "it is not enabled");
    let path = format!("/v1/webhooks/{id}");
    let deleted = yard.client().delete(yard.url(&path));
    assert_eq!(yard.send(deleted).await.0, StatusCode::OK);
    let (status, gone) = yard.get_value(&format!("{path}/deliveries")).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    assert_eq!(gone["type"], "/problems/unknown-webhook", "{gone}");
    let mut tx = yard.server.app().db().read("test").await.unwrap();
    let (left,): (i64,) = sqlx::query_as("SELECT COUNT(*) FROM webhook_deliveries")
        .fetch_one(&mut **tx.as_sqlite().unwrap())
        .await
        .unwrap();
    assert_eq!(left, 0);
    drop(tx);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_secret_that_is_replaced_signs_what_waits_and_a_webhook_that_is_enabled_sends_it() {
    let yard = start().await;
    let receiver = Receiver::start(Mood::Good).await;
    let settings = json!({"name": "x", "url": receiver.url(), "enabled": false});
    let (id, former) = create(&yard, &settings).await;
    queue(&yard, &id, 1, BEGIN).await;
    let path = format!("/v1/webhooks/{id}");
    let (status, made) = yard.post(&format!("{path}/secret"), &json!({})).await;
    assert_eq!(status, StatusCode::OK, "{made}");
    let secret = made["secret"].as_str().unwrap();
    let settings = json!({"name": "y", "url": receiver.url()});
    let changed = yard.client().put(yard.url(&path)).json(&settings);
    let (status, changed) = yard.send(changed).await;
    assert_eq!(status, StatusCode::OK, "{changed}");
    assert_eq!(changed["enabled"], Value::Bool(true));
    let sent = receiver.has(1).await.remove(0);
    assert!(sent.is_signed_with(secret) && !sent.is_signed_with(&former));
    yard.server.stop().await.unwrap();
}
