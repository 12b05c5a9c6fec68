//! Many clients of the event stream, one of which never reads: it is dropped, the others are not.

use std::net::SocketAddr;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::{TcpSocket, TcpStream};
use tokio::task::JoinSet;
use tread_api::ids::RobotId;
use tread_tests::light_robot::LightRobot;
use tread_tests::wait::SHORT;

use crate::fleet;

/// Clients that read.
const READERS: usize = 1_000;
/// Memory that a thousand clients and one that never reads may cost the server, bytes.
const MEMORY_MAX: u64 = 200_000_000;
/// Events of robots that each reader must see after the deaf one has joined.
const EVENTS_EACH: usize = 5;

/// Missions whose events fill the buffer of the one that never reads, and the sockets before it.
const LONG_MISSIONS: usize = 8;

async fn open(stream: TcpStream, topics: &str, token: &str) -> BufReader<TcpStream> {
    let mut stream = stream;
    let request = format!(
        "GET /v1/events?topics={topics} HTTP/1.1\r\nhost: localhost\r\n\
         authorization: Bearer {token}\r\naccept: text/event-stream\r\n\r\n"
    );
    let sent = stream.write_all(request.as_bytes()).await;
    sent.expect("the server listens");
    BufReader::new(stream)
}

/// Reads until so many events of robots have come after the snapshot.
async fn read_events(mut stream: BufReader<TcpStream>, wanted: usize) -> usize {
    let mut line = String::new();
    let (mut seen, mut is_snapshot_over) = (0, false);
    while seen < wanted {
        line.clear();
        if stream.read_line(&mut line).await.unwrap_or(0) == 0 {
            break;
        }
        match line.trim_end() {
            "event: snapshot_end" => is_snapshot_over = true,
            "event: robot" if is_snapshot_over => seen += 1,
            "event: end" => break,
            _ => {}
        }
    }
    seen
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_a_thousand_event_clients_one_that_never_reads_disturbs_nobody() {
    let fleet = fleet().await;
    let address: SocketAddr = fleet.http_address();
    let endpoint = fleet.zenoh_endpoint();
    let mut robots = Vec::new();
    for number in 0..20 {
        let id: RobotId = format!("light-{number}").parse().unwrap();
        let robot = LightRobot::start(&endpoint, &fleet.site(), id).await;
        robots.push(robot.unwrap());
    }
    // A socket that takes next to nothing, so that what is sent piles up at the server.
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(4_096).unwrap();
    let deaf = socket.connect(address).await.unwrap();
    let mut deaf = open(deaf, "robots,missions", fleet.token()).await;
    let mut readers = JoinSet::new();
    for _ in 0..READERS {
        let stream = TcpStream::connect(address).await.unwrap();
        let token = fleet.token().to_owned();
        readers.spawn(async move {
            read_events(open(stream, "robots", &token).await, EVENTS_EACH).await
        });
    }
    let talking = async {
        loop {
            for robot in &mut robots {
                robot.publish_state().await.unwrap();
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    let reading = async {
        let mut whole = 0;
        while let Some(seen) = readers.join_next().await {
            whole += usize::from(seen.unwrap() == EVENTS_EACH);
        }
        whole
    };
    // Two events of about a megabyte each, for nobody but the one that does not read.
    let asking = async {
        let points: Vec<Value> = (0..30_000_u32)
            .map(|index| json!({"x_m": 0.1 * f64::from(index), "y_m": 0.123_456_789}))
            .collect();
        let trajectory = json!({"waypoints": {"speed_m_s": 0.5, "points": points}});
        let robot = "light-0".parse().unwrap();
        for _ in 0..LONG_MISSIONS {
            let mission = fleet.rest.send(&robot, trajectory.clone()).await;
            let path = format!("/v1/missions/{mission}/cancel");
            fleet.rest.post(&path, &Value::Null).await;
        }
    };
    let both = async { tokio::join!(reading, asking).0 };
    let whole = tokio::select! {
        () = talking => 0,
        whole = tokio::time::timeout(6 * SHORT, both) => whole.expect("the readers are served"),
    };
    assert_eq!(whole, READERS, "some clients were cut off");
    let used = fleet.server_usage().unwrap();
    assert!(
        used.memory_peak_bytes < MEMORY_MAX,
        "the server used {} MB",
        used.memory_peak_bytes / 1_000_000
    );
    let health: Value = fleet.rest.get("/v1/server").await;
    assert!(!health.is_null());
    // It was dropped: what it had is there, and then its end, or the cut.
    let draining = async {
        let mut line = Vec::new();
        while deaf
            .read_until(b'\n', &mut line)
            .await
            .is_ok_and(|count| count > 0)
        {
            line.clear();
        }
    };
    let drained = tokio::time::timeout(SHORT, draining).await;
    drained.expect("the client that never reads was dropped");
}
