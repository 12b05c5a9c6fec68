//! Garbage at the robots' port, while a good robot connects.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, interval, timeout};
use tread_agent::membership::Membership;
use tread_api::ids::RobotId;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::open_secure_session;
use tread_tests::report::{Check, figure};
use tread_tests::wait::{SHORT, eventually};
use zenoh::Wait as _;

use crate::Arguments;

/// Longest time that a good robot may take.
const CONNECT_MAX_MS: f64 = 100.0;
/// How long a garbage connection waits for the server to end it.
const GARBAGE_WAIT: Duration = Duration::from_secs(10);
/// What garbage there is; the last says nothing at all.
const KINDS: [&[u8]; 5] = [
    b"GET / HTTP/1.1\r\nhost: localhost\r\n\r\n",
    &[0xff; 64],
    // The head of a hello that never comes, and one whose inside makes no sense.
    &[0x16, 0x03, 0x01, 0x02, 0x00, 0x01],
    &[
        0x16, 0x03, 0x01, 0x00, 0x08, 0x01, 0x00, 0x00, 0x04, 0x99, 0x99, 0x99, 0x99,
    ],
    b"",
];
/// The counters of what the gate refuses.
const REFUSALS: [&str; 6] = [
    "gate_not_tls",
    "gate_silent",
    "gate_tls_failed",
    "gate_rate_limited",
    "gate_full",
    "gate_displaced",
];

pub(crate) async fn measure(arguments: &Arguments, fleet: &Fleet) -> anyhow::Result<Vec<Check>> {
    let robot: RobotId = "good".parse()?;
    let joined = fleet.membership(&robot).await;
    // The router that knows it opens while it joins; from here on it only connects.
    connect(fleet, &joined).await?;
    let mut alone_ms = Vec::new();
    for _ in 0..arguments.connects {
        alone_ms.push(connect(fleet, &joined).await?);
    }
    let sent = Arc::new(AtomicU64::new(0));
    let began = Instant::now();
    let mut throwing = JoinSet::new();
    throwing.spawn(throw(
        fleet.zenoh_address(),
        arguments.garbage_hz,
        Arc::clone(&sent),
    ));
    let mut ms = Vec::new();
    for _ in 0..arguments.connects {
        // Not in step with the garbage, and for long enough that it counts.
        tokio::time::sleep(Duration::from_millis(50)).await;
        ms.push(connect(fleet, &joined).await?);
    }
    let rate_hz = figure(sent.load(Ordering::Relaxed)) / began.elapsed().as_secs_f64();
    drop(throwing);
    let sent = sent.load(Ordering::Relaxed);
    let refused = || async {
        let mut refused = 0;
        for name in REFUSALS {
            refused += fleet.counter(name).await;
        }
        refused
    };
    let refused = eventually("all garbage was refused", SHORT, refused, |refused| {
        *refused >= sent
    })
    .await;
    let most = |times: &[f64]| times.iter().copied().fold(0.0, f64::max);
    let median = |times: &mut [f64]| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    };
    Ok(vec![
        Check::of("garbage connections per second", rate_hz)
            .at_least(0.95 * f64::from(arguments.garbage_hz)),
        Check::of("garbage refused and counted", figure(refused)).at_least(figure(sent)),
        Check::of("median connect without garbage, ms", median(&mut alone_ms))
            .at_most(CONNECT_MAX_MS),
        Check::of("median connect under garbage, ms", median(&mut ms)).at_most(CONNECT_MAX_MS),
        Check::of("slowest connect without garbage, ms", most(&alone_ms)).at_most(CONNECT_MAX_MS),
        Check::of("slowest connect under garbage, ms", most(&ms)).at_most(CONNECT_MAX_MS),
    ])
}

/// Connects as the robot and leaves again: milliseconds until the session was open.
async fn connect(fleet: &Fleet, joined: &Membership) -> anyhow::Result<f64> {
    let began = Instant::now();
    let (session, _tunnel) = open_secure_session(&fleet.zenoh_endpoint(), joined).await?;
    let took = began.elapsed();
    tokio::task::spawn_blocking(move || session.close().wait())
        .await?
        .map_err(|error| anyhow::anyhow!("the session did not close: {error}"))?;
    Ok(1e3 * took.as_secs_f64())
}

/// Throws garbage at an address for ever.
async fn throw(address: SocketAddr, rate_hz: u32, sent: Arc<AtomicU64>) -> anyhow::Result<()> {
    let mut ticks = interval(Duration::from_secs(1) / rate_hz);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Burst);
    let mut open = JoinSet::new();
    for kind in KINDS.iter().copied().cycle() {
        ticks.tick().await;
        while open.try_join_next().is_some() {}
        let sent = Arc::clone(&sent);
        open.spawn(async move {
            let mut stream = TcpStream::connect(address).await.context("no connection")?;
            sent.fetch_add(1, Ordering::Relaxed);
            stream.write_all(kind).await?;
            // What comes back is an alert, or the end.
            let mut answer = Vec::new();
            _ = timeout(GARBAGE_WAIT, stream.read_to_end(&mut answer)).await;
            anyhow::Ok(())
        });
    }
    Ok(())
}
