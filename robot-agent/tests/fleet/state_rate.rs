//! How often an agent publishes its state, by itself and on request.

use std::time::Duration;

use tread_api::wire::reply::{Acknowledgement, CommandRefusalCode};
use tread_api::wire::state::{STATE_RATE_FOR_MAX_MS, StateRate};

use crate::code;
use crate::rig::Rig;
use crate::support::FakeServer;

/// States over which a rate is measured.
const STATES: u32 = 8;

async fn request(server: &FakeServer, rig: &Rig, rate_hz: f64) -> Acknowledgement {
    let for_ms = STATE_RATE_FOR_MAX_MS;
    server
        .send(&rig.robot, &StateRate { rate_hz, for_ms })
        .await
}

/// Waits until the last states, of those after the first `skipped` ones, came at such a rate by the
/// robot's clock.
async fn published_at(rig: &Rig, what: &str, skipped: usize, holds: impl Fn(f64) -> bool) {
    rig.sees(what, |memory| {
        let states = memory.states.get(skipped..)?;
        let first = states.len().checked_sub(STATES as usize)?;
        let at_us = |index: usize| states.get(index)?.monotonic_us;
        let span = Duration::from_micros(at_us(states.len() - 1)? - at_us(first)?);
        let rate_hz = f64::from(STATES - 1) / span.as_secs_f64();
        holds(rate_hz).then_some(rate_hz)
    })
    .await;
}

fn is_own(rate_hz: f64) -> bool {
    (3.0..6.0).contains(&rate_hz)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_requested_state_rate_is_kept_within_its_range() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    published_at(&rig, "its own rate", 0, is_own).await;
    assert_eq!(request(&server, &rig, 10.0).await, Acknowledgement::Done);
    published_at(&rig, "the requested rate", 0, |rate_hz| {
        (8.0..11.0).contains(&rate_hz)
    })
    .await;
    assert_eq!(request(&server, &rig, 1e6).await, Acknowledgement::Done);
    published_at(&rig, "the highest rate", 0, |rate_hz| {
        (15.0..22.0).contains(&rate_hz)
    })
    .await;
    // The newest request counts, and none makes it slower than it is by itself.
    assert_eq!(request(&server, &rig, 0.1).await, Acknowledgement::Done);
    published_at(&rig, "its own rate", 0, is_own).await;
    for impossible in [0.0, -5.0] {
        let refused = request(&server, &rig, impossible).await.into_result();
        assert_eq!(code(refused), Some(CommandRefusalCode::Impossible));
    }
    agent.stop().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_requested_state_rate_ends_with_the_connection() {
    let rig = Rig::new();
    let server = rig.serve();
    let agent = rig.agent();
    rig.ready(agent.boot()).await;
    assert_eq!(request(&server, &rig, 10.0).await, Acknowledgement::Done);
    published_at(&rig, "the requested rate", 0, |rate_hz| rate_hz > 8.0).await;
    let asked_us = agent.state().monotonic_us.unwrap();
    server.stop().await;
    let skipped = rig.memory.lock().unwrap().states.len();
    let server = rig.serve();
    published_at(&rig, "its own rate", skipped, is_own).await;
    let took_us = agent.state().monotonic_us.unwrap() - asked_us;
    assert!(
        took_us < 1_000 * STATE_RATE_FOR_MAX_MS,
        "it would have ended by itself: {took_us} µs"
    );
    agent.stop().await;
    server.stop().await;
}
