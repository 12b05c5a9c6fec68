//! Receivers and names that are not what they should be.

use std::sync::Arc;
use std::time::Duration;

use rcgen::{CertifiedKey, generate_simple_self_signed};
use reqwest::StatusCode;
use rustls::pki_types::PrivateKeyDer;
use serde_json::json;
use tokio_rustls::TlsAcceptor;
use tread_server::clock::Clock;
use tread_server::config::webhooks::WebhooksConfig;

use super::receiver::{Mood, Names, Receiver, Request};
use super::{BEGIN, advance, allowing, create, newest, report, start};
use crate::harness::{Yard, eventually, time};
use crate::robot::Robot;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whatever_a_receiver_does_alerts_go_on_and_others_get_theirs() {
    let yard = start().await;
    let good = Receiver::start(Mood::Good).await;
    let aside = Receiver::start(Mood::Good).await;
    let moods = [
        ("hangs", Mood::Hangs, "no answer in time"),
        ("closes", Mood::ClosesEarly, "connection"),
        ("redirects", Mood::Redirects(aside.url()), "redirect"),
        (
            "redirects to metadata",
            Mood::Redirects("http://169.254.169.254/latest".to_owned()),
            "redirect",
        ),
        ("endless", Mood::Endless, "aaaa"),
        ("lies", Mood::Lies(500), "500"),
    ];
    let mut receivers = Vec::new();
    for (name, mood, detail) in moods {
        let receiver = Receiver::start(mood).await;
        let (id, _) = create(&yard, &json!({"name": name, "url": receiver.url()})).await;
        receivers.push((id, receiver, detail));
    }
    // The status has come, so the delivery has arrived.
    let liar = Receiver::start(Mood::Lies(200)).await;
    let (liar_id, _) = create(
        &yard,
        &json!({"name": "lies of success", "url": liar.url()}),
    )
    .await;
    let (good_id, _) = create(&yard, &json!({"name": "good", "url": good.url()})).await;
    let robot = Robot::join(&yard, "rover-1").await;
    report(&robot, Some("battery-low"));
    good.has(1).await;
    // While the one that hangs is still waited for, alerts and Stop go their way.
    let (status, alerts) = yard
        .get_value("/v1/alerts?kind=battery-low&raised=true")
        .await;
    assert_eq!(status, StatusCode::OK);
    assert_eq!(alerts["items"].as_array().unwrap().len(), 1, "{alerts}");
    let (status, _) = yard
        .post("/v1/sites/yard/robots/rover-1/stop", &json!({}))
        .await;
    assert_eq!(status, StatusCode::OK);
    for id in [&good_id, &liar_id] {
        newest(&yard, id, |delivery| delivery["state"] == "delivered").await;
    }
    for (id, receiver, detail) in &receivers {
        let tried = newest(&yard, id, |delivery| delivery["attempts"] == 1).await;
        let said = tried["detail"].as_str().unwrap();
        assert!(said.contains(detail), "{detail}: {tried}");
        assert!(said.len() < 1_000, "{said}");
        assert!(!said.contains("of=yard"), "a URL may be secret: {said}");
        assert_eq!(tried["state"], "pending", "{tried}");
        assert_eq!(receiver.requests().len(), 1, "{detail}");
    }
    assert_eq!(aside.connections(), 0, "a redirect was followed");
    assert_eq!(yard.counters().await.webhook_attempts_failed, 6);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_name_is_resolved_once_and_called_only_where_every_address_is_allowed() {
    let names = Names::of(&[
        ("good.test", &[&["127.0.0.2"]]),
        ("inner.test", &[&["127.0.0.1"]]),
        ("mapped.test", &[&["::ffff:127.0.0.1"]]),
        ("mixed.test", &[&["127.0.0.2", "127.0.0.1"]]),
        ("metadata.test", &[&["169.254.169.254"]]),
        ("empty.test", &[&[]]),
        // It passes the check when the webhook is tested first, and points inside later.
        ("rebinding.test", &[&["127.0.0.2"], &["127.0.0.1"]]),
    ]);
    let yard = Yard::start_resolving(
        Arc::new(tempfile::tempdir().unwrap()),
        Clock::manual(time(BEGIN)),
        Arc::clone(&names) as _,
        allowing(&["127.0.0.2"]),
    )
    .await;
    // The same port on the address that is allowed and on the one that is not.
    let good = Receiver::start_on("127.0.0.2:0", Mood::Good, None).await;
    let port = good.address.port();
    let inner = Receiver::start_on(&format!("127.0.0.1:{port}"), Mood::Good, None).await;
    let mut refused = Vec::new();
    for host in ["inner", "mapped", "mixed", "metadata", "empty", "unknown"] {
        let url = format!("http://{host}.test:{port}/");
        let (id, _) = create(&yard, &json!({"name": host, "url": url})).await;
        refused.push((host, id));
    }
    for host in ["good", "rebinding"] {
        let url = format!("http://{host}.test:{port}/{host}");
        let (id, _) = create(&yard, &json!({"name": host, "url": url})).await;
        yard.post(&format!("/v1/webhooks/{id}/test"), &json!({}))
            .await;
        newest(&yard, &id, |delivery| delivery["state"] == "delivered").await;
        let name = format!("{host}.test");
        assert_eq!(names.asked(&name), 1, "{host}");
        if host == "rebinding" {
            refused.push((host, id));
        }
    }
    let sent = good.requests();
    assert_eq!(sent[0].headers["host"], format!("good.test:{port}"));
    assert_eq!(sent.len(), 2);
    for (host, id) in &refused {
        yard.post(&format!("/v1/webhooks/{id}/test"), &json!({}))
            .await;
        let tried = newest(&yard, id, |delivery| delivery["detail"].is_string()).await;
        let detail = tried["detail"].as_str().unwrap();
        let wanted = match *host {
            "empty" => "has 0 addresses",
            "unknown" => "cannot be resolved",
            _ => "not public",
        };
        assert!(detail.contains(wanted), "{host}: {detail}");
    }
    assert_eq!(inner.connections(), 0);
    assert_eq!(good.requests().len(), 2);
    yard.server.stop().await.unwrap();
}

/// A certificate for a name, as PEM and as what a receiver uses.
fn certificate(name: &str) -> (String, TlsAcceptor) {
    let _ = rustls::crypto::ring::default_provider().install_default();
    let CertifiedKey { cert, signing_key } =
        generate_simple_self_signed(vec![name.to_owned()]).unwrap();
    let key = PrivateKeyDer::try_from(signing_key.serialize_der()).unwrap();
    let config = rustls::ServerConfig::builder().with_no_client_auth();
    let config = config
        .with_single_cert(vec![cert.der().clone()], key)
        .unwrap();
    (cert.pem(), TlsAcceptor::from(Arc::new(config)))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn over_tls_the_certificate_must_be_of_the_name_and_of_a_trusted_authority() {
    let folder = Arc::new(tempfile::tempdir().unwrap());
    let (trusted, tls) = certificate("alerts.test");
    let (_, foreign_tls) = certificate("foreign.test");
    let ca = folder.path().join("ca.pem");
    std::fs::write(&ca, trusted).unwrap();
    let config = WebhooksConfig {
        allow_http: false,
        ca: Some(ca),
        ..allowing(&["127.0.0.1"])
    };
    let here: &[&[&str]] = &[&["127.0.0.1"]];
    let names = Names::of(&[
        ("alerts.test", here),
        ("other.test", here),
        ("foreign.test", here),
    ]);
    let yard = Yard::start_resolving(folder, Clock::manual(time(BEGIN)), names, config).await;
    let receiver = Receiver::start_on("127.0.0.1:0", Mood::Good, Some(tls)).await;
    let foreign = Receiver::start_on("127.0.0.1:0", Mood::Good, Some(foreign_tls)).await;
    let (port, foreign_port) = (receiver.address.port(), foreign.address.port());
    for (name, url, arrives) in [
        ("right", format!("https://alerts.test:{port}/"), true),
        ("wrong name", format!("https://other.test:{port}/"), false),
        ("address", format!("https://127.0.0.1:{port}/"), false),
        (
            "wrong authority",
            format!("https://foreign.test:{foreign_port}/"),
            false,
        ),
    ] {
        let (id, secret) = create(&yard, &json!({"name": name, "url": url})).await;
        yard.post(&format!("/v1/webhooks/{id}/test"), &json!({}))
            .await;
        let tried = newest(&yard, &id, |delivery| delivery["attempts"] == 1).await;
        assert_eq!(tried["state"] == "delivered", arrives, "{name}: {tried}");
        if arrives {
            let sent = receiver.has(1).await.remove(0);
            assert!(sent.is_signed_with(&secret), "{sent:?}");
            assert_eq!(sent.headers["host"], format!("alerts.test:{port}"));
        } else {
            let detail = tried["detail"].as_str().unwrap().to_lowercase();
            assert!(detail.contains("certificate"), "{name}: {detail}");
        }
    }
    assert_eq!(
        (receiver.requests().len(), foreign.requests().len()),
        (1, 0)
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_webhook_rests_after_a_failure_and_sends_one_delivery_after_the_other() {
    let yard = start().await;
    let receiver = Receiver::start(Mood::Says(500, "")).await;
    let (id, _) = create(&yard, &json!({"name": "x", "url": receiver.url()})).await;
    for _ in 0..3 {
        yard.post(&format!("/v1/webhooks/{id}/test"), &json!({}))
            .await;
    }
    receiver.has(1).await;
    let is_stored = async || {
        let counted = yard.counters().await.webhook_attempts_failed;
        if counted == 1 { Ok(()) } else { Err(counted) }
    };
    eventually("the first attempt is counted", is_stored).await;
    assert_eq!(receiver.requests().len(), 1, "it rests");
    receiver.set(Mood::Good);
    advance(&yard, Duration::from_secs(11));
    let requests = receiver.has(4).await;
    let mut ids: Vec<&str> = requests[1..].iter().map(Request::delivery).collect();
    assert!(ids.is_sorted(), "the oldest first: {ids:?}");
    ids.dedup();
    assert_eq!(ids.len(), 3);
    yard.server.stop().await.unwrap();
}
