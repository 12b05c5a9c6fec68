//! Settings of webhooks: what is possible, who sees what, and what is written down.

use std::sync::Arc;

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::webhook::WEBHOOKS_MAX;
use tread_server::clock::Clock;
use tread_server::config::webhooks::WebhooksConfig;

use super::receiver::Names;
use super::{BEGIN, create, report};
use crate::harness::{Yard, eventually, time};
use crate::robot::Robot;

/// A server that may call public addresses over `https` alone.
async fn start() -> Yard {
    let folder = Arc::new(tempfile::tempdir().unwrap());
    let clock = Clock::manual(time(BEGIN));
    Yard::start_resolving(folder, clock, Names::of(&[]), WebhooksConfig::default()).await
}

const URL: &str = "https://alerts.example.org/tread";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn settings_that_cannot_be_are_refused_with_the_field_and_a_reason() {
    let yard = start().await;
    let long = "x".repeat(81);
    for (settings, field, reason) in [
        (json!({"name": "", "url": URL}), "name", "1 to 80"),
        (json!({"name": long, "url": URL}), "name", "1 to 80"),
        (
            json!({"name": "a", "url": "nothing"}),
            "url",
            "write it like",
        ),
        (
            json!({"name": "a", "url": "http://alerts.example.org/"}),
            "url",
            "allow_http",
        ),
        (
            json!({"name": "a", "url": "https://u:p@alerts.example.org/"}),
            "url",
            "user name",
        ),
        (
            json!({"name": "a", "url": "https://10.0.0.1/"}),
            "url",
            "not public",
        ),
        (
            json!({"name": "a", "url": "https://[::ffff:10.0.0.1]/"}),
            "url",
            "not public",
        ),
        (
            json!({"name": "a", "url": URL, "kinds": []}),
            "kinds",
            "1 to 100",
        ),
        (
            json!({"name": "a", "url": URL, "kinds": ["robot-lost", "robot-lots"]}),
            "kinds",
            "`robot-lots` is the kind of no alert",
        ),
        (
            json!({"name": "a", "url": URL, "sites": []}),
            "sites",
            "1 to 100",
        ),
    ] {
        let (status, said) = yard.post("/v1/webhooks", &settings).await;
        assert_eq!(
            status,
            StatusCode::UNPROCESSABLE_ENTITY,
            "{settings}: {said}"
        );
        assert_eq!(said["field"], field, "{settings}: {said}");
        let detail = said["detail"].as_str().unwrap();
        assert!(detail.contains(reason), "{settings}: {detail}");
    }
    for (settings, status) in [
        (json!({"name": "a", "url": URL, "kinds": ["A B"]}), 422),
        (json!({"name": "a", "url": URL, "secret": "x"}), 422),
        (json!({"name": "a", "url": URL, "sites": ["nowhere"]}), 404),
    ] {
        let (found, said) = yard.post("/v1/webhooks", &settings).await;
        assert_eq!(found, status, "{settings}: {said}");
    }
    let (id, _) = create(&yard, &json!({"name": "a", "url": URL})).await;
    create(&yard, &json!({"name": "b", "url": URL})).await;
    let taken = json!({"name": "b", "url": URL});
    let (status, said) = yard.post("/v1/webhooks", &taken).await;
    assert_eq!(status, StatusCode::CONFLICT, "{said}");
    let changed = yard.client().put(yard.url(&format!("/v1/webhooks/{id}")));
    let (status, said) = yard.send(changed.json(&taken)).await;
    assert_eq!(status, StatusCode::CONFLICT, "{said}");
    for name in 2..WEBHOOKS_MAX {
        create(
            &yard,
            &json!({"name": format!("webhook {name}"), "url": URL}),
        )
        .await;
    }
    let (status, said) = yard
        .post("/v1/webhooks", &json!({"name": "one more", "url": URL}))
        .await;
    assert_eq!(status, StatusCode::CONFLICT, "{said}");
    assert_eq!(said["type"], "/problems/too-many", "{said}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_secret_is_shown_once_and_changes_are_in_the_audit_log_without_it() {
    let yard = start().await;
    let settings =
        json!({"name": " on call ", "url": URL, "kinds": ["stopped", "base-late", "stopped"]});
    let (id, secret) = create(&yard, &settings).await;
    assert!(secret.starts_with("tread_w_"), "{secret}");
    let path = format!("/v1/webhooks/{id}");
    let (_, rotated) = yard.post(&format!("{path}/secret"), &json!({})).await;
    let next = rotated["secret"].as_str().unwrap().to_owned();
    assert_ne!(secret, next);
    let (status, found) = yard.get_value(&path).await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(
        found,
        json!({"id": id, "name": "on call", "url": URL, "kinds": ["base-late", "stopped"], "sites": null,
               "enabled": true, "created_at": BEGIN, "created_by": "tests", "pending": 0})
    );
    let (_, list) = yard.get_value("/v1/webhooks").await;
    assert_eq!(list, json!({"items": [found], "next_cursor": null}));
    let changed = yard.client().put(yard.url(&path));
    let settings = json!({"name": "on call", "url": URL, "enabled": false});
    let (status, changed) = yard.send(changed.json(&settings)).await;
    assert_eq!(status, StatusCode::OK, "{changed}");
    assert_eq!(
        (&changed["enabled"], &changed["kinds"]),
        (&json!(false), &Value::Null)
    );
    let deleted = yard.client().delete(yard.url(&path));
    assert_eq!(yard.send(deleted).await.0, StatusCode::OK);
    let entries = eventually("all changes are in the audit log", async || {
        let (_, page) = yard.get_value("/v1/audit").await;
        let entries = page["items"].as_array().unwrap().clone();
        let routes = entries.iter().filter(|entry| {
            let route = entry["route"].as_str().unwrap();
            route.starts_with("/v1/webhooks") && entry["method"] != "GET"
        });
        if routes.count() == 4 {
            Ok(entries)
        } else {
            Err(entries)
        }
    })
    .await;
    let text = serde_json::to_string(&entries).unwrap();
    assert!(text.contains("alerts.example.org"), "{text}");
    assert!(!text.contains("tread_w_"), "{text}");
    // It opens nothing.
    let client = crate::harness::client(Some(&next));
    let asked = client.get(yard.url("/v1/sites"));
    assert_eq!(yard.send(asked).await.0, StatusCode::UNAUTHORIZED);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_kind_of_a_newer_agent_may_be_named_once_an_alert_has_it() {
    let yard = start().await;
    let settings = json!({"name": "tyres", "url": URL, "kinds": ["tyre-flat"]});
    let (status, said) = yard.post("/v1/webhooks", &settings).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
    let robot = Robot::join(&yard, "rover-1").await;
    report(&robot, Some("tyre-flat"));
    eventually("the alert is stored", async || {
        let (_, found) = yard.get_value("/v1/alerts?kind=tyre-flat").await;
        if found["items"]
            .as_array()
            .is_some_and(|items| !items.is_empty())
        {
            Ok(())
        } else {
            Err(found)
        }
    })
    .await;
    create(&yard, &settings).await;
    yard.server.stop().await.unwrap();
}
