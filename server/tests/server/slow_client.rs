//! A client of the event stream that reads too slowly is closed with that reason, and nobody else notices.

use std::time::Duration;

use reqwest::StatusCode;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpSocket, TcpStream};
use tread_api::ids::RobotId;
use tread_server::app::events::CLIENT_BYTES_MAX;

use crate::harness::{PATIENCE, Yard, eventually};
use crate::robot::Robot;

/// Waypoints of a mission that makes an event of about a megabyte.
const POINTS: u32 = 30_000;

/// What the sockets of one connection may hold.
const SOCKETS_BYTES: usize = 8 * 1024 * 1024;

fn long_mission(robot: &RobotId) -> Value {
    let points: Vec<Value> = (0..POINTS)
        .map(|index| json!({"x_m": 0.1 * f64::from(index), "y_m": 0.123_456_789}))
        .collect();
    let trajectory = json!({"waypoints": {"speed_m_s": 0.5, "points": points}});
    json!({"site": "yard", "robot": robot, "trajectory": trajectory})
}

/// A client whose socket takes next to nothing, so that what is sent piles up at the server.
async fn deaf(yard: &Yard) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(4_096).unwrap();
    let mut stream = socket.connect(yard.server.http_address()).await.unwrap();
    let request = format!(
        "GET /v1/events HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {}\r\n\
         accept: text/event-stream\r\n\r\n",
        yard.admin()
    );
    stream.write_all(request.as_bytes()).await.unwrap();
    stream
}

/// The last words of a stream, whether it ended or was cut.
async fn read_all(stream: &mut TcpStream) -> String {
    let mut tail: Vec<u8> = Vec::new();
    let mut chunk = vec![0; 1 << 16];
    while let Ok(count @ 1..) = stream.read(&mut chunk).await {
        tail.extend_from_slice(&chunk[..count]);
        let from = tail.len().saturating_sub(500);
        tail.drain(..from);
    }
    String::from_utf8_lossy(&tail).into_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_does_not_read_is_dropped_with_an_end_and_the_others_miss_nothing() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let id = robot.id.clone();
    // Nobody takes the missions: they wait, and only their being asked for is news.
    drop(robot);
    let (mut slow, mut never) = (deaf(&yard).await, deaf(&yard).await);
    let mut reader = yard
        .client()
        .get(yard.url("/v1/events?topics=missions"))
        .send()
        .await
        .unwrap();
    let hub = yard.server.app().hub();
    eventually("all clients are there", async || {
        let count = hub.client_count();
        if count == 3 { Ok(()) } else { Err(count) }
    })
    .await;
    let body = long_mission(&id);
    let event_bytes = serde_json::to_vec(&body).unwrap().len();
    // Beyond the client's buffer there is what the sockets on both sides swallow. Each mission makes
    // two events: it is asked for, and it is cancelled.
    let missions = (CLIENT_BYTES_MAX + SOCKETS_BYTES) / (2 * event_bytes) + 1;
    let reading = async {
        let (mut seen, mut text) = (0, String::new());
        while seen < 2 * missions {
            let chunk = reader.chunk().await.unwrap().expect("the stream goes on");
            text.push_str(&String::from_utf8_lossy(&chunk));
            let Some(end) = text.rfind('\n') else {
                continue;
            };
            assert!(!text.contains("event: end"));
            seen += text[..=end].matches("event: mission\n").count();
            text.drain(..=end);
        }
    };
    let asking = async {
        for _ in 0..missions {
            let (status, answer) = yard.post("/v1/missions", &body).await;
            assert_eq!(status, StatusCode::CREATED, "{answer}");
            let path = format!("/v1/missions/{}/cancel", answer["id"].as_str().unwrap());
            let (status, answer) = yard.post(&path, &json!({})).await;
            assert_eq!(status, StatusCode::ACCEPTED, "{answer}");
        }
    };
    // One that reads when it is dropped gets what it had, and the word that it was too slow.
    let reading_late = async {
        eventually("the slow clients are dropped", async || {
            let dropped = hub.dropped_count();
            if dropped == 2 { Ok(()) } else { Err(dropped) }
        })
        .await;
        let tail = read_all(&mut slow).await;
        assert!(
            tail.contains("event: end") && tail.contains("too_slow"),
            "{tail}"
        );
    };
    let all = async { tokio::join!(reading, asking, reading_late) };
    let all = tokio::time::timeout(3 * PATIENCE, all).await;
    all.expect("the reader gets every event, the slow client its end");
    assert_eq!((hub.client_count(), hub.dropped_count()), (1, 2));
    // One that does not even read that is cut off after a while.
    tokio::time::sleep(Duration::from_secs(7)).await;
    let read = tokio::time::timeout(PATIENCE, read_all(&mut never));
    let tail = read.await.expect("the deaf client was cut off");
    assert!(!tail.contains("too_slow"), "{tail}");
    yard.server.stop().await.unwrap();
}
