//! Robots join by tokens that count once, renew with the key they have, and are put out.

use std::time::Duration;

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use jiff::SignedDuration;
use rcgen::{CertificateParams, KeyPair, SigningKey as _};
use reqwest::StatusCode;
use serde_json::{Value, json};
use tread_api::enrolment::renewal_message;
use tread_api::ids::BootId;
use tread_api::robot::Capabilities;
use tread_samples::rover;
use tread_server::authority::{Authority, Issued, RobotName, RobotRequest};
use tread_server::db;
use tread_server::db::enrolments::Renewal;
use tread_server::db::robots::Introduction;
use tread_server::identity::attempts::FAILURES_MAX;
use uuid::Uuid;

use crate::harness::{Yard, circle, client, eventually, site, time};

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
    let next = KeyPair::generate().unwrap();
    renew_with(yard, certificate, present, &next).await
}

async fn renew_with(
    yard: &Yard,
    certificate: &str,
    present: &KeyPair,
    next: &KeyPair,
) -> (StatusCode, Value) {
    let next = request(next);
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

    // What was refused has not used its token up.
    for (made, robot) in [(&named, "rover-2"), (&any, "rover-4")] {
        let (status, got) = enrol(&yard, &secret_of(made), robot, &key).await;
        assert_eq!(status, StatusCode::CREATED, "{got}");
    }

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

/// Lets the server know a robot, as if it had said hello.
async fn introduce(yard: &Yard, robot: &str) {
    let id = robot.parse().unwrap();
    let introduction = Introduction {
        id: &id,
        boot: BootId::from_uuid(Uuid::from_u128(1)),
        agent_version: "0.0.1",
        model: &rover("test rover"),
        capabilities: &Capabilities::default(),
        at: yard.server.app().clock().now(),
    };
    let mut tx = yard.server.app().db().write("test").await.unwrap();
    let site = db::sites::find(&mut tx, &site()).await.unwrap().unwrap();
    let introduced = db::robots::introduce(&mut tx, site.pk, introduction, 3).await;
    introduced.unwrap();
    tx.commit().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_is_put_out_leaves_no_alert_about_its_presence_or_its_work() {
    let yard = yard().await;
    let key = KeyPair::generate().unwrap();
    introduce(&yard, "rover-1").await;
    joined(&yard, "rover-1", &key).await;
    let mut late = circle(&"rover-1".parse().unwrap());
    late["latest_start"] = json!("2026-11-02T10:01:00Z");
    let (status, sent) = yard.post("/v1/missions", &late).await;
    assert_eq!(status, StatusCode::CREATED, "{sent}");
    let (status, sent) = yard
        .post("/v1/missions", &circle(&"rover-1".parse().unwrap()))
        .await;
    assert_eq!(status, StatusCode::CREATED, "{sent}");
    let raised = async || {
        let (_, found) = yard
            .get_value("/v1/alerts?robot=rover-1&raised=true&site=yard")
            .await;
        let codes = found["items"].as_array().unwrap().iter();
        let mut codes: Vec<String> = codes
            .map(|alert| alert["code"].as_str().unwrap().to_owned())
            .collect();
        codes.sort();
        codes
    };
    eventually(
        "a mission has expired and another does not begin",
        async || {
            yard.server.app().clock().advance(Duration::from_mins(3));
            yard.server.app().wake();
            let codes = raised().await;
            if codes == ["mission-expired", "mission-waiting"] {
                Ok(())
            } else {
                Err(codes)
            }
        },
    )
    .await;
    let path = yard.url("/v1/sites/yard/enrolments/rover-1");
    let (status, out) = yard.send(yard.client().delete(path)).await;
    assert_eq!(status, StatusCode::OK, "{out}");
    assert_eq!(raised().await, Vec::<String>::new());
    // Nobody waits for it, however long its mission stays in the queue.
    for _ in 0..5 {
        yard.server.app().clock().advance(Duration::from_mins(2));
        yard.server.app().wake();
        let _ = yard.counters().await;
    }
    assert_eq!(raised().await, Vec::<String>::new());
}

/// A certificate that a thief of the authority's key makes.
fn forged(yard: &Yard, robot: &str, key: &KeyPair) -> String {
    let stolen = Authority::load(&yard.folder.path().join("authority")).unwrap();
    let request = RobotRequest::read(&request(key)).unwrap();
    let name = RobotName {
        site: "yard".parse().unwrap(),
        robot: robot.parse().unwrap(),
        enrolment: 1,
    };
    let now = yard.server.app().clock().now();
    let signed = stolen.sign(&request, &name, now, SignedDuration::from_hours(24));
    signed.unwrap().certificate
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_certificate_that_a_thief_of_the_key_makes_is_not_exchanged_for_one_at_any_time() {
    let yard = yard().await;
    introduce(&yard, "rover-1").await;
    let (key, thief) = (KeyPair::generate().unwrap(), KeyPair::generate().unwrap());
    let certificate = joined(&yard, "rover-1", &key).await;
    let forged = forged(&yard, "rover-1", &thief);
    let (status, refused) = renew(&yard, &forged, &thief).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED, "{refused}");
    let (status, started) = yard.post("/v1/authority/rotation", &json!({})).await;
    assert_eq!(status, StatusCode::CREATED, "{started}");
    let (status, refused) = renew(&yard, &forged, &thief).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED, "{refused}");
    assert_eq!(yard.counters().await.renewals_not_issued, 2);
    eventually("an alert is raised", async || {
        let (_, alerts) = yard.get_value("/v1/alerts").await;
        let mut items = alerts["items"].as_array().unwrap().iter();
        let is_raised =
            items.any(|it| it["code"] == "unknown-certificate" && it["cleared_at"].is_null());
        if is_raised { Ok(()) } else { Err(alerts) }
    })
    .await;
    eventually("it is in the audit log", async || {
        let (_, log) = yard.get_value("/v1/audit?refused=true").await;
        let text = log.to_string();
        let is_there = text.contains("did not give the certificate") && text.contains("rover-1");
        if is_there { Ok(()) } else { Err(log) }
    })
    .await;

    // The robot itself is brought over, though an answer is lost: it shows the one before.
    assert_eq!(renew(&yard, &certificate, &key).await.0, StatusCode::OK);
    let next_key = KeyPair::generate().unwrap();
    let (status, next) = renew_with(&yard, &certificate, &key, &next_key).await;
    assert_eq!(status, StatusCode::OK, "{next}");
    let next = next["certificate"].as_str().unwrap();
    assert_eq!(renew(&yard, next, &next_key).await.0, StatusCode::OK);
    // Now it has shown the newer one, and whoever has an old copy of it gets nothing.
    let (status, refused) = renew(&yard, &certificate, &key).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED, "{refused}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_backup_was_restored_the_next_certificate_of_each_robot_can_be_made_to_count() {
    let yard = yard().await;
    let (key, next_key) = (KeyPair::generate().unwrap(), KeyPair::generate().unwrap());
    let certificate = joined(&yard, "rover-1", &key).await;
    let (_, next) = renew_with(&yard, &certificate, &key, &next_key).await;
    let next = next["certificate"].as_str().unwrap().to_owned();
    // The robot has the next one, and the database is from before that renewal.
    let db = yard.server.app().db().clone();
    let mut tx = db.write("test").await.unwrap();
    let robot = (&"yard".parse().unwrap(), &"rover-1".parse().unwrap(), 1);
    let now = yard.server.app().clock().now();
    let issued = Issued::one("another".to_owned());
    let renewal = Renewal {
        at: now,
        expires_at: now + SignedDuration::from_hours(1),
        authority: "any",
        issued: &issued,
    };
    assert!(
        db::enrolments::renew(&mut tx, robot, renewal)
            .await
            .unwrap()
    );
    tx.commit().await.unwrap();
    let (status, refused) = renew(&yard, &next, &next_key).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED, "{refused}");

    // As `tread-server forget-certificates` does, beside the server.
    let mut tx = db.write("test").await.unwrap();
    let count = db::enrolments::delete_issued_certificates(&mut tx)
        .await
        .unwrap();
    tx.commit().await.unwrap();
    assert_eq!(count, 1);
    assert_eq!(renew(&yard, &next, &next_key).await.0, StatusCode::OK);
    let (status, refused) = renew(&yard, &certificate, &key).await;
    assert_eq!(status, StatusCode::UNAUTHORIZED, "{refused}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn where_robots_connect_in_the_clear_none_joins() {
    let yard = Yard::start().await;
    let (status, answer) = yard.post("/v1/join-tokens", &json!({"site": "yard"})).await;
    assert_eq!(status, StatusCode::CONFLICT);
    assert_eq!(answer["type"], "/problems/enrolment-disabled");
    let key = KeyPair::generate().unwrap();
    let (status, answer) = enrol(&yard, "nonsense", "rover-1", &key).await;
    assert_eq!(
        (status, &answer["type"]),
        (StatusCode::CONFLICT, &json!("/problems/enrolment-disabled"))
    );
}
