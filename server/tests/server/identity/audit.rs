//! The audit log says who did what, from where, and nothing secret.

use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::identity::Role;

use crate::harness::{Yard, client, eventually};

async fn entries(yard: &Yard, query: &str) -> Vec<Value> {
    let (status, page) = yard.get_value(&format!("/v1/audit?{query}")).await;
    assert_eq!(status, StatusCode::OK, "{page}");
    page["items"].as_array().unwrap().clone()
}

async fn until(yard: &Yard, query: &str, count: usize) -> Vec<Value> {
    eventually("the audit log is written", async || {
        let entries = entries(yard, query).await;
        if entries.len() >= count {
            Ok(entries)
        } else {
            Err(entries)
        }
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn changes_and_refusals_are_written_and_secrets_are_not() {
    let yard = Yard::start().await;
    let viewer = yard.token("screen", Role::Viewer).await.secret;
    let (status, _) = yard
        .post("/v1/sites", &json!({"id": "field", "cell_m": 2.0}))
        .await;
    assert_eq!(status, StatusCode::CREATED);
    let (status, _) = yard.post("/v1/sites", &json!({"id": "field"})).await;
    assert_eq!(status, StatusCode::CONFLICT);
    let refused = client(Some(&viewer))
        .post(yard.url("/v1/sites"))
        .json(&json!({"id": "x"}));
    assert_eq!(yard.send(refused).await.0, StatusCode::FORBIDDEN);
    let guessed = client(Some("tread_a_guess")).get(yard.url("/v1/sites"));
    assert_eq!(yard.send(guessed).await.0, StatusCode::UNAUTHORIZED);
    let sign_in = client(None)
        .post(yard.url("/v1/session"))
        .json(&json!({"token": viewer}));
    assert_eq!(yard.send(sign_in).await.0, StatusCode::CREATED);
    yard.get_value("/v1/sites").await;

    let all = until(&yard, "", 6).await;
    let seen: Vec<(&str, &str, u64)> = all
        .iter()
        .rev()
        .map(|entry| {
            let who = entry["who"].as_str().unwrap_or("-");
            (
                who,
                entry["route"].as_str().unwrap(),
                entry["status"].as_u64().unwrap(),
            )
        })
        .collect();
    assert_eq!(
        seen,
        [
            ("init", "tread-server init", 201),
            ("tests", "/v1/sites", 201),
            ("tests", "/v1/sites", 409),
            ("screen", "/v1/sites", 403),
            ("-", "/v1/sites", 401),
            ("screen", "/v1/session", 201),
        ]
    );
    let made = &all[all.len() - 2];
    assert_eq!(made["what"], json!({"id": "field", "cell_m": 2.0}));
    assert_eq!(
        (&made["address"], &made["role"]),
        (&json!("127.0.0.1"), &json!("admin"))
    );
    assert_eq!(made["request_id"].as_str().unwrap().len(), 36);
    let said = Value::from(all.clone()).to_string();
    assert!(!said.contains(&viewer) && !said.contains("guess"), "{said}");

    assert_eq!(entries(&yard, "refused=true").await.len(), 3);
    assert_eq!(entries(&yard, "who=screen").await.len(), 2);
    let (_, first) = yard.get_value("/v1/audit?limit=4").await;
    let cursor = first["next_cursor"].as_str().unwrap();
    assert_eq!(
        entries(&yard, &format!("limit=4&cursor={cursor}"))
            .await
            .len(),
        2
    );
    let (status, _) = yard.get_value("/v1/audit?cursor=x").await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_answered_before_a_stop_is_in_the_log_after_it() {
    let yard = Yard::start().await;
    for number in 0..50 {
        let (status, _) = yard
            .post("/v1/sites", &json!({"id": format!("s-{number}")}))
            .await;
        assert_eq!(status, StatusCode::CREATED);
    }
    let yard = yard.restart().await;
    let created = entries(&yard, "limit=1000").await;
    let created = created.iter().filter(|entry| entry["route"] == "/v1/sites");
    assert_eq!(created.count(), 50);
    yard.server.stop().await.unwrap();
}
