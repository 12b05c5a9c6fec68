//! Connections that send nothing, too much or too slowly harm nobody else.

use std::time::Duration;

use reqwest::StatusCode;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tread_server::connections::BOUNDS;

use crate::harness::{PATIENCE, Yard};

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
    let head = yard
        .client()
        .get(yard.url("/v1/sites"))
        .header("x-long", "y".repeat(100_000));
    assert_eq!(
        yard.send(head).await.0,
        StatusCode::REQUEST_HEADER_FIELDS_TOO_LARGE
    );
    yard.server.stop().await.unwrap();
}
