//! Robots join by tokens that count once, renew with the key they have, and are put out.

use std::time::Duration;

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use rcgen::{CertificateParams, KeyPair, SigningKey as _};
use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::enrolment::renewal_message;
use tread_server::identity::attempts::FAILURES_MAX;

use crate::harness::{Yard, client, eventually, time};

fn request(key: &KeyPair) -> String {
    let params = CertificateParams::default();
    params.serialize_request(key).unwrap().pem().unwrap()
}

async fn yard() -> Yard {
    Yard::start_joining_at(time("2026-11-02T10:00:00Z")).await
}

async fn join_token(yard: &Yard, body: Value) -> Value {
    let (status, made) = yard.post("/v1/join-tokens", &body).await;
    assert_eq!(status, StatusCode::CREATED, "{made}");
    made
}

/// Asks as somebody who has nothing but what is in the body.
async fn ask(yard: &Yard, path: &str, body: &Value) -> (StatusCode, Value) {
    yard.send(client(None).post(yard.url(path)).json(body))
        .await
}

async fn enrol(yard: &Yard, token: &str, robot: &str, key: &KeyPair) -> (StatusCode, Value) {
    let body = json!({"token": token, "robot": robot, "certificate_request": request(key)});
    ask(yard, "/v1/enrolments", &body).await
}

/// A robot that has joined by a token of its own: its certificate.
async fn joined(yard: &Yard, robot: &str, key: &KeyPair) -> String {
    let made = join_token(yard, json!({"site": "yard", "robot": robot})).await;
    let secret = made["secret"].as_str().unwrap();
    let (status, got) = enrol(yard, secret, robot, key).await;
    assert_eq!(status, StatusCode::CREATED, "{got}");
    got["certificate"].as_str().unwrap().to_owned()
}

async fn renew(yard: &Yard, certificate: &str, present: &KeyPair) -> (StatusCode, Value) {
    let next = request(&KeyPair::generate().unwrap());
    let proof = present.sign(&renewal_message(&next)).unwrap();
    let body = json!({
        "certificate": certificate, "certificate_request": next,
        "proof": BASE64_STANDARD.encode(proof),
    });
    ask(yard, "/v1/enrolments/renew", &body).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_join_token_counts_once_and_whatever_does_not_count_is_answered_alike() {
    let yard = yard().await;
    let key = KeyPair::generate().unwrap();
    let secret_of = |made: &Value| made["secret"].as_str().unwrap().to_owned();
    let used = join_token(&yard, json!({"site": "yard"})).await;
    assert!(secret_of(&used).starts_with("tread_j_"));
    let (status, got) = enrol(&yard, &secret_of(&used), "rover-1", &key).await;
    assert_eq!(status, StatusCode::CREATED, "{got}");
    assert_eq!(
        (&got["robot"], &got["enrolment"]),
        (&json!("rover-1"), &json!(1))
    );
    assert_eq!(got["lifetime_s"], 3_600);

    let revoked = join_token(&yard, json!({"site": "yard"})).await;
    let id = revoked["join_token"]["id"].as_str().unwrap();
    let gone = yard
        .client()
        .delete(yard.url(&format!("/v1/join-tokens/{id}")));
    assert_eq!(yard.send(gone).await.0, StatusCode::OK);
    let named = join_token(&yard, json!({"site": "yard", "robot": "rover-2"})).await;
    let any = join_token(&yard, json!({"site": "yard"})).await;
    let late = join_token(&yard, json!({"site": "yard", "valid_minutes": 1})).await;
    yard.server.app().clock().advance(Duration::from_mins(1));

    let admin = yard.admin().to_owned();
    let cases = [
        ("nonsense", "malformed".to_owned(), "rover-9"),
        ("wrong", format!("tread_j_{}", "0".repeat(72)), "rover-9"),
        ("a person's token", admin, "rover-9"),
        ("used", secret_of(&used), "rover-9"),
        ("revoked", secret_of(&revoked), "rover-9"),
        ("late", secret_of(&late), "rover-9"),
        ("for another", secret_of(&named), "rover-3"),
        ("for a new one alone", secret_of(&any), "rover-1"),
    ];
    let mut answers = Vec::new();
    for (what, token, robot) in &cases {
        let (status, answer) = enrol(&yard, token, robot, &key).await;
        assert_eq!(status, StatusCode::UNAUTHORIZED, "{what}: {answer}");
        answers.push(answer);
    }
    assert!(
        answers.windows(2).all(|pair| pair[0] == pair[1]),
        "{answers:#?}"
    );
    let counters = yard.counters().await;
    let counted = [
        counters.join_token_malformed,
        counters.join_token_used,
        counters.join_token_revoked,
        counters.join_token_expired,
        counters.join_token_other_robot,
        counters.robots_enrolled,
    ];
    assert_eq!(counted, [3, 1, 1, 1, 2, 1], "{counters:?}");

    // The audit log names the tokens that were refused, and why.
    let named_in_log = |log: &Value, made: &Value, refused: &str| {
        let entries = log["items"].as_array().unwrap();
        entries.iter().any(|entry| {
            let what = &entry["what"];
            what["join_token"] == made["join_token"]["id"] && what["refused"] == refused
        })
    };
    let log = eventually("the audit log is written", async || {
        let (_, log) = yard.get_value("/v1/audit?limit=100").await;
        let is_whole = named_in_log(
            &log,
            &any,
            "the robot is known and the join token does not name it",
        );
        if is_whole { Ok(log) } else { Err(log) }
    })
    .await;
    assert!(named_in_log(&log, &used, "used"), "{log:#}");
    assert!(named_in_log(&log, &late, "expired"), "{log:#}");
    assert!(named_in_log(&log, &revoked, "revoked"), "{log:#}");
    assert!(named_in_log(&log, &named, "for another robot"), "{log:#}");
    for made in [&used, &revoked, &named, &any, &late] {
        assert!(
            !log.to_string().contains(&secret_of(made)),
            "a secret is in the log"
        );
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn guessing_join_tokens_locks_and_a_bad_request_says_nothing_about_its_token() {
    let yard = yard().await;
    let key = KeyPair::generate().unwrap();
    let made = join_token(&yard, json!({"site": "yard"})).await;
    let good = made["secret"].as_str().unwrap();
    let mut answers = Vec::new();
    for token in [good, "nonsense"] {
        let body = json!({"token": token, "robot": "rover-1", "certificate_request": "none"});
        let (status, answer) = ask(&yard, "/v1/enrolments", &body).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY);
        answers.push(answer);
    }
    assert_eq!(answers[0], answers[1]);
    for _ in 0..FAILURES_MAX {
        let (status, _) = enrol(&yard, "nonsense", "rover-1", &key).await;
        assert_eq!(status, StatusCode::UNAUTHORIZED);
    }
    let (status, answer) = enrol(&yard, "nonsense", "rover-1", &key).await;
    assert_eq!(status, StatusCode::TOO_MANY_REQUESTS, "{answer}");
    // Behind the same address a good one is taken all the same.
    let (status, answer) = enrol(&yard, good, "rover-1", &key).await;
    assert_eq!(status, StatusCode::CREATED, "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_certificate_is_renewed_by_its_key_until_its_robot_is_put_out_or_joins_again() {
    let yard = yard().await;
    let (key, other) = (KeyPair::generate().unwrap(), KeyPair::generate().unwrap());
    let certificate = joined(&yard, "rover-1", &key).await;
    let (status, next) = renew(&yard, &certificate, &key).await;
    assert_eq!(status, StatusCode::OK, "{next}");
    assert_ne!(next["certificate"], certificate);
    let (status, stolen) = renew(&yard, &certificate, &other).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED);
    // A robot that was away longer than its certificate lasts is one of the fleet still.
    yard.server.app().clock().advance(Duration::from_hours(20));
    assert_eq!(renew(&yard, &certificate, &key).await.0, StatusCode::OK);

    let again = joined(&yard, "rover-1", &other).await;
    let (status, former) = renew(&yard, &certificate, &key).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED);
    assert_eq!(renew(&yard, &again, &other).await.0, StatusCode::OK);

    let path = yard.url("/v1/sites/yard/enrolments/rover-1");
    let (status, out) = yard.send(yard.client().delete(path)).await;
    assert_eq!(
        (status, &out["revoked_by"]),
        (StatusCode::OK, &json!("tests"))
    );
    let (status, put_out) = renew(&yard, &again, &other).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED);
    assert!(
        stolen == former && former == put_out,
        "{stolen} {former} {put_out}"
    );
    let counters = yard.counters().await;
    assert_eq!(
        (counters.renewals_refused, counters.renewals_revoked),
        (1, 2)
    );
    assert_eq!(counters.certificates_renewed, 3);
    let (_, listed) = yard.get_value("/v1/sites/yard/enrolments").await;
    assert_eq!(listed["items"].as_array().unwrap().len(), 1);
    assert_eq!(listed["items"][0]["number"], 2);
    let path = yard.url("/v1/sites/yard/enrolments/nobody");
    assert_eq!(
        yard.send(yard.client().delete(path)).await.0,
        StatusCode::NOT_FOUND
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn where_robots_connect_in_the_clear_none_joins() {
    let yard = Yard::start().await;
    let (status, answer) = yard.post("/v1/join-tokens", &json!({"site": "yard"})).await;
    assert_eq!(status, StatusCode::CONFLICT);
    assert_eq!(answer["type"], "/problems/robots-do-not-join");
    let key = KeyPair::generate().unwrap();
    let (status, answer) = enrol(&yard, "nonsense", "rover-1", &key).await;
    assert_eq!(
        (status, &answer["type"]),
        (StatusCode::CONFLICT, &json!("/problems/robots-do-not-join"))
    );
}
