//! Connections that send nothing, too much or too slowly harm nobody else.

use std::collections::VecDeque;
use std::time::Duration;

use reqwest::StatusCode;
use serde_json::json;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tread_api::identity::Role;
use tread_server::connections::BOUNDS;
use tread_server::http::extract::{BODY_TIMEOUT, UNAUTHENTICATED_BODY_TIMEOUT};

use crate::harness::{PATIENCE, Yard, client};
use crate::robot::Robot;

/// Sign-ins whose bodies come byte by byte.
const SLOW_BODIES: usize = 4_250;
/// Stops that are asked for meanwhile, each over a connection of its own.
const STOPS: usize = 67;
/// Time between two of them.
const STOP_PERIOD: Duration = Duration::from_millis(100);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn half_open_connections_displace_each_other_and_no_client() {
    let yard = Yard::start().await;
    yard.get_value("/v1/sites").await;
    let address = yard.server.http_address();
    let mut half_open = Vec::new();
    for number in 0..BOUNDS.unproven + 200 {
        let mut stream = TcpStream::connect(address).await.unwrap();
        if number % 2 == 0 {
            stream
                .write_all(b"GET /v1/sites HTTP/1.1\r\nhost: loc")
                .await
                .unwrap();
        }
        half_open.push(stream);
        if number % 100 == 0 {
            assert_eq!(yard.get_value("/v1/sites").await.0, StatusCode::OK);
        }
    }
    let fresh = crate::harness::client(Some(yard.admin()));
    let (status, _) = yard.send(fresh.get(yard.url("/v1/sites"))).await;
    assert_eq!(status, StatusCode::OK);
    let counters = yard.counters().await;
    assert!(counters.http_connections_displaced >= 190, "{counters:?}");
    assert_eq!(counters.http_connections_refused, 0);
    // The oldest are gone.
    let mut said = [0; 16];
    let ended = half_open[0].read(&mut said);
    let ended = tokio::time::timeout(PATIENCE, ended)
        .await
        .expect("it was cut");
    assert!(matches!(ended, Ok(0) | Err(_)));
    drop(half_open);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_connection_that_sends_nothing_or_half_a_head_is_ended() {
    let yard = Yard::start().await;
    let address = yard.server.http_address();
    let silent = TcpStream::connect(address).await.unwrap();
    let mut slow = TcpStream::connect(address).await.unwrap();
    slow.write_all(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\nx: ")
        .await
        .unwrap();
    for (mut stream, within) in [(silent, 5), (slow, 10)] {
        let bound = Duration::from_secs(within) + PATIENCE;
        let mut said = Vec::new();
        let ended = tokio::time::timeout(bound, stream.read_to_end(&mut said)).await;
        assert!(ended.is_ok(), "still open after {bound:?}");
    }
    assert!(yard.counters().await.http_connections_silent >= 1);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_too_long_or_too_deep_is_refused() {
    let yard = Yard::start().await;
    let long = "x".repeat(5_000);
    for path in [
        format!("/v1/sites?cursor={long}"),
        format!("/v1/sites/{long}"),
    ] {
        let (status, said) = yard.get_value(&path).await;
        assert_eq!(status, StatusCode::URI_TOO_LONG, "{said}");
    }
    let deep = format!("{{\"site\": {}", "[".repeat(200_000));
    let asked = yard
        .client()
        .post(yard.url("/v1/missions"))
        .header("content-type", "application/json")
        .body(deep);
    let (status, said) = yard.send(asked).await;
    assert!(status.is_client_error(), "{said}");
    let (status, _) = yard.get_value("/v1/sites?limit=1001").await;
    assert_eq!(status, StatusCode::BAD_REQUEST);
    // What arrives at once is read whole, up to twice the limit.
    for length in [66_000, 100_000] {
        let head = yard
            .client()
            .get(yard.url("/v1/sites"))
            .header("x-long", "y".repeat(length));
        assert_eq!(
            yard.send(head).await.0,
            StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE
        );
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sign_ins_that_send_a_byte_at_a_time_keep_nobody_from_stopping() {
    let yard = Yard::start().await;
    let _robot = Robot::join(&yard, "rover-1").await;
    let viewer = yard.token("screen", Role::Viewer).await.secret;
    let address = yard.server.http_address();
    let (full, is_full) = oneshot::channel();
    let ending = CancellationToken::new();
    let ended = ending.clone();
    let mut flood = JoinSet::new();
    flood.spawn(async move {
        let mut full = Some(full);
        let mut slow = VecDeque::new();
        let mut count = 0;
        while !ended.is_cancelled() {
            let Ok(mut stream) = TcpStream::connect(address).await else {
                continue;
            };
            let head = "POST /v1/session HTTP/1.1\r\nhost: localhost\r\n\
                        content-type: application/json\r\ncontent-length: 100\r\n\r\n{";
            // One that was cut already has made room.
            let _ = stream.write_all(head.as_bytes()).await;
            slow.push_back(stream);
            count += 1;
            if slow.len() == SLOW_BODIES
                && let Some(full) = full.take()
            {
                full.send(()).unwrap();
            }
            if slow.len() > SLOW_BODIES {
                // It goes on: what has ended is replaced.
                slow.pop_front();
            }
        }
        count
    });
    is_full.await.unwrap();
    let mut took = Vec::new();
    let mut failed = Vec::new();
    let mut due = tokio::time::interval(STOP_PERIOD);
    for _ in 0..STOPS {
        due.tick().await;
        let asked_at = Instant::now();
        let stop = client(Some(&viewer))
            .post(yard.url("/v1/stop"))
            .send()
            .await;
        match stop {
            Ok(answer) if answer.status() == StatusCode::OK => took.push(asked_at.elapsed()),
            other => failed.push(format!("{other:?}")),
        }
    }
    took.sort_unstable();
    let p99 = took.get(took.len() * 99 / 100);
    eprintln!(
        "{} of {STOPS} stops, p99 {p99:?}, longest {:?}",
        took.len(),
        took.last()
    );
    assert!(failed.is_empty(), "{failed:?}");
    ending.cancel();
    let count: usize = flood.join_next().await.unwrap().unwrap();
    assert!(count >= SLOW_BODIES, "{count} connections");
    let counters = yard.counters().await;
    assert_eq!(counters.http_connections_refused, 0, "{counters:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_body_of_a_stranger_has_two_seconds() {
    let yard = Yard::start().await;
    let mut slow = TcpStream::connect(yard.server.http_address())
        .await
        .unwrap();
    let head = "POST /v1/session HTTP/1.1\r\nhost: localhost\r\n\
                content-type: application/json\r\ncontent-length: 100\r\n\r\n{";
    slow.write_all(head.as_bytes()).await.unwrap();
    let began_at = Instant::now();
    let mut said = vec![0; 512];
    let length = tokio::time::timeout(PATIENCE, slow.read(&mut said)).await;
    let said = String::from_utf8_lossy(&said[..length.unwrap().unwrap()]).into_owned();
    assert!(said.starts_with("HTTP/1.1 408"), "{said}");
    let took = began_at.elapsed();
    assert!(
        (UNAUTHENTICATED_BODY_TIMEOUT..BODY_TIMEOUT).contains(&took),
        "{took:?}"
    );
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn behind_a_trusted_proxy_each_client_has_an_address_of_its_own() {
    let yard = Yard::start_with(crate::harness::time("2026-11-01T00:00:00Z"), |config| {
        config.web.trusted_proxies = vec!["127.0.0.1".parse().unwrap()];
    })
    .await;
    let guess = |from: &'static str| {
        let asked = client(Some("tread_a_guess")).get(yard.url("/v1/sites"));
        asked.header("x-forwarded-for", from)
    };
    for number in 0..11 {
        let (status, _) = yard.send(guess("198.51.100.1, 203.0.113.9")).await;
        assert_eq!(status.as_u16(), if number < 10 { 401 } else { 429 });
    }
    assert_eq!(
        yard.send(guess("203.0.113.10")).await.0,
        StatusCode::UNAUTHORIZED
    );
    let (status, _) = yard.post("/v1/sites", &json!({"id": "field"})).await;
    assert_eq!(status, StatusCode::CREATED);
    let seen = crate::harness::eventually("the addresses are in the audit log", async || {
        let (_, log) = yard.get_value("/v1/audit?limit=100").await;
        let text = log.to_string();
        if text.contains("203.0.113.9") && text.contains("203.0.113.10") {
            Ok(text)
        } else {
            Err(text)
        }
    })
    .await;
    assert!(!seen.contains("198.51.100.1"), "{seen}");
    yard.server.stop().await.unwrap();
}
