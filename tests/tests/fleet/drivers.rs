//! Losing whoever teleoperates a real robot: it always stands. Losing one who looks on: it never
//! does.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tokio_tungstenite::tungstenite::{ClientRequestBuilder, Message};
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream, connect_async};
use tread_api::drive::{Drive, DriveRequest, DriveUpdate, DriverName};
use tread_api::ids::RobotId;
use tread_api::robot::RobotLive;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::relay::Relay;
use tread_tests::wait::{SHORT, eventually};

use crate::fleet;

/// Time between two drive commands.
const PERIOD: Duration = Duration::from_millis(50);
/// A driver that is silent for longer makes the robot slow down: half of how long a command holds.
const GAP_MAX: Duration = Duration::from_millis(125);
/// How often a trial is done again because the machine kept the driver waiting.
const TRIALS_MAX: usize = 8;

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

fn robot() -> RobotId {
    "rover-1".parse().expect("it is an identifier")
}

async fn open(fleet: &Fleet, server: SocketAddr) -> Socket {
    let url = format!("ws://{server}/v1/sites/{SITE}/robots/{}/drive", robot());
    let request = ClientRequestBuilder::new(url.parse().unwrap())
        .with_header("authorization", format!("Bearer {}", fleet.token()));
    connect_async(request).await.unwrap().0
}

fn say(request: &DriveRequest) -> Message {
    Message::text(serde_json::to_string(request).unwrap())
}

/// Drives until it is dropped.
struct Driver {
    _driving: JoinSet<()>,
    longest_gap_ms: Arc<AtomicU64>,
}

impl Driver {
    /// The longest time between two commands since this was last asked.
    fn longest_gap(&self) -> Duration {
        Duration::from_millis(self.longest_gap_ms.swap(0, Ordering::Relaxed))
    }
}

/// Acquires the lease and drives, on a circle, until the connection ends or what is given is dropped.
async fn drive(fleet: &Fleet, server: SocketAddr) -> Driver {
    let mut socket = open(fleet, server).await;
    let driver = DriverName {
        name: "Ann".to_owned(),
    };
    socket
        .send(say(&DriveRequest::Acquire(driver)))
        .await
        .unwrap();
    loop {
        let Message::Text(text) = socket.next().await.unwrap().unwrap() else {
            continue;
        };
        match serde_json::from_str(&text).unwrap() {
            DriveUpdate::Leased(_) => break,
            DriveUpdate::Refused { detail, .. } => panic!("no lease: {detail}"),
            DriveUpdate::Welcome { .. }
            | DriveUpdate::Released { .. }
            | DriveUpdate::Stopped(_)
            | DriveUpdate::View(_)
            | DriveUpdate::Ended { .. } => {}
        }
    }
    let drive = DriveRequest::Drive(Drive {
        linear_m_s: 0.4,
        angular_rad_s: 0.3,
        for_ms: None,
    });
    let longest_gap_ms = Arc::new(AtomicU64::new(0));
    let gap_ms = Arc::clone(&longest_gap_ms);
    let mut driving = JoinSet::new();
    driving.spawn(async move {
        let mut ticks = tokio::time::interval(PERIOD);
        let mut said = Instant::now();
        loop {
            tokio::select! {
                _ = ticks.tick() => {
                    if socket.send(say(&drive)).await.is_err() {
                        return;
                    }
                    let gap = std::mem::replace(&mut said, Instant::now()).elapsed();
                    let gap = u64::try_from(gap.as_millis()).unwrap_or(u64::MAX);
                    gap_ms.fetch_max(gap, Ordering::Relaxed);
                }
                frame = socket.next() => {
                    if !matches!(frame, Some(Ok(_))) {
                        return;
                    }
                }
            }
        }
    });
    Driver {
        _driving: driving,
        longest_gap_ms,
    }
}

async fn live(fleet: &Fleet, what: &str, is: impl Fn(&RobotLive) -> bool) {
    let look = || async { fleet.rest.robot(&robot()).await?.live };
    eventually(what, SHORT, look, |live| live.as_ref().is_some_and(&is)).await;
}

fn speed_m_s(live: &RobotLive) -> f64 {
    live.twist.map_or(0.0, |twist| twist.value.linear_m_s)
}

async fn it_drives(fleet: &Fleet) {
    live(fleet, "it drives", |live| speed_m_s(live) > 0.25).await;
}

async fn it_stands_and_is_free(fleet: &Fleet) {
    live(fleet, "it stands, and nobody drives", |live| {
        speed_m_s(live).abs() < 0.02 && live.safety.lease.is_none()
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn losing_the_driver_always_stops_the_robot_however_it_happens() {
    let mut fleet = fleet().await;
    fleet.start_agent(&robot(), 0.0).await;
    let server = fleet.http_address();

    // The driver's program dies: its socket closes without a word.
    let driver = drive(&fleet, server).await;
    it_drives(&fleet).await;
    drop(driver);
    it_stands_and_is_free(&fleet).await;

    // The network resets the connection.
    let relay = Relay::start(server).await.unwrap();
    let driver = drive(&fleet, relay.address()).await;
    it_drives(&fleet).await;
    relay.reset();
    it_stands_and_is_free(&fleet).await;
    drop(driver);

    // The network swallows everything, and no side is notified.
    let driver = drive(&fleet, relay.address()).await;
    it_drives(&fleet).await;
    relay.cut();
    it_stands_and_is_free(&fleet).await;
    drop(driver);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_frame_that_makes_no_sense_stops_a_real_robot() {
    let mut fleet = fleet().await;
    fleet.start_agent(&robot(), 0.0).await;
    for frame in [
        Message::text("{\"drive\":"),
        Message::text(" ".repeat(5_000)),
        Message::binary(vec![1, 2, 3]),
    ] {
        let mut socket = open(&fleet, fleet.http_address()).await;
        let name = "Ann".to_owned();
        let acquire = DriveRequest::Acquire(DriverName { name });
        socket.send(say(&acquire)).await.unwrap();
        let drive = DriveRequest::Drive(Drive {
            linear_m_s: 0.4,
            angular_rad_s: 0.3,
            for_ms: Some(500),
        });
        let mut fastest_m_s: f64 = 0.0;
        for _ in 0..20 {
            socket.send(say(&drive)).await.unwrap();
            tokio::time::sleep(PERIOD).await;
            let seen = fleet.rest.robot(&robot()).await.unwrap().live.unwrap();
            fastest_m_s = fastest_m_s.max(speed_m_s(&seen));
        }
        assert!(fastest_m_s > 0.2, "it hardly moved: {fastest_m_s} m/s");
        socket.send(frame).await.unwrap();
        let closed = async {
            while let Some(frame) = socket.next().await {
                if let Ok(Message::Close(Some(frame))) = frame {
                    return u16::from(frame.code);
                }
            }
            0
        };
        let code = tokio::time::timeout(SHORT, closed).await.unwrap();
        assert!([1003, 1007, 1009].contains(&code), "closed with {code}");
        it_stands_and_is_free(&fleet).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn losing_an_observer_never_stops_the_robot() {
    let mut fleet = fleet().await;
    fleet.start_agent(&robot(), 0.0).await;
    let server = fleet.http_address();
    let relay = Relay::start(server).await.unwrap();
    let driver = drive(&fleet, server).await;
    it_drives(&fleet).await;
    for way in [Relay::reset, Relay::cut] {
        let mut has_reported = false;
        for _ in 0..TRIALS_MAX {
            it_drives(&fleet).await;
            driver.longest_gap();
            let slowest_m_s = lose_an_observer(&fleet, &relay, way).await;
            // A driver that the machine kept waiting makes the robot stand too, as it must.
            if driver.longest_gap() < GAP_MAX {
                assert!(slowest_m_s > 0.2, "it slowed to {slowest_m_s} m/s");
                has_reported = true;
                break;
            }
        }
        assert!(has_reported, "the machine is too busy for a driver");
    }
    drop(driver);
    it_stands_and_is_free(&fleet).await;
}

/// Loses one who looks on, and returns the lowest speed seen until the server has noticed.
async fn lose_an_observer(fleet: &Fleet, relay: &Relay, way: fn(&Relay)) -> f64 {
    let mut observer = open(fleet, relay.address()).await;
    observer.next().await.unwrap().unwrap();
    way(relay);
    let mut slowest_m_s = f64::INFINITY;
    // Longer than the server takes to notice that the observer says nothing.
    for _ in 0..16 {
        tokio::time::sleep(Duration::from_millis(250)).await;
        let seen = fleet.rest.robot(&robot()).await.unwrap().live.unwrap();
        slowest_m_s = slowest_m_s.min(speed_m_s(&seen));
        assert!(seen.safety.lease.is_some(), "{seen:?}");
    }
    slowest_m_s
}
