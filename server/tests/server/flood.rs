//! One robot that sends all that it can leaves the others their share.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use tokio::time::Instant;
use tread_api::ids::{BootId, RobotId};
use tread_api::keys;
use tread_api::robot::{self, LinkState};
use uuid::Uuid;
use zenoh::Wait as _;
use zenoh::handlers::FifoChannel;
use zenoh::qos::CongestionControl;

use crate::harness::{Yard, eventually, site};
use crate::robot::{Robot, session};

/// How long the flood lasts.
const FLOOD: Duration = Duration::from_secs(4);
/// Longest wait of another robot for the answer to its introduction.
const HELLO_WAIT_MAX: Duration = Duration::from_secs(2);
/// Messages of a flood, at least: fewer would show nothing.
const MESSAGES_MIN: u64 = 2_000;
/// Tokens that the flood has at a time.
const TOKENS_AT_ONCE: usize = 100;

/// Sends what does not read, introductions that nobody waits for, and tokens of new runs.
fn flood(session: &zenoh::Session, robot: &RobotId, until: &AtomicBool, sent: &AtomicU64) {
    let mut tokens = Vec::new();
    while !until.load(Ordering::Relaxed) {
        for key in [keys::state(&site(), robot), keys::friction(&site(), robot)] {
            let put = session.put(key, "no message");
            let _ = put.congestion_control(CongestionControl::Drop).wait();
        }
        let asked = session
            .get(keys::hello(&site(), robot))
            .payload("no introduction")
            .timeout(HELLO_WAIT_MAX)
            .with(FifoChannel::new(1))
            .wait();
        drop(asked);
        let boot = BootId::from_uuid(Uuid::new_v4());
        let key = keys::alive(&site(), robot, boot);
        tokens.extend(session.liveliness().declare_token(key).wait());
        if tokens.len() >= TOKENS_AT_ONCE {
            tokens.clear();
        }
        sent.fetch_add(4, Ordering::Relaxed);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_floods_loses_its_own_messages_and_nobody_elses() {
    let yard = Yard::start().await;
    let loud = Robot::join(&yard, "loud").await;
    let quiet = Robot::join(&yard, "quiet").await;
    let link_of = async |robot: &str| {
        let path = format!("/v1/sites/yard/robots/{robot}");
        yard.get::<robot::Robot>(&path).await.link
    };
    eventually("both are online", async || {
        let links = (link_of("loud").await, link_of("quiet").await);
        if links == (LinkState::Online, LinkState::Online) {
            Ok(())
        } else {
            Err(links)
        }
    })
    .await;
    let (stop, sent) = (
        Arc::new(AtomicBool::new(false)),
        Arc::new(AtomicU64::new(0)),
    );
    let flooding = {
        let (session, robot) = (session(&yard).await, loud.id.clone());
        let (stop, sent) = (Arc::clone(&stop), Arc::clone(&sent));
        tokio::task::spawn_blocking(move || flood(&session, &robot, &stop, &sent))
    };
    let begin = Instant::now();
    let mut slowest = Duration::ZERO;
    while begin.elapsed() < FLOOD {
        let asked = Instant::now();
        quiet.hello().await;
        slowest = slowest.max(asked.elapsed());
        assert_eq!(link_of("quiet").await, LinkState::Online);
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    stop.store(true, Ordering::Relaxed);
    flooding.await.unwrap();
    assert!(slowest <= HELLO_WAIT_MAX, "an answer took {slowest:?}");
    let sent = sent.load(Ordering::Relaxed);
    assert!(sent >= MESSAGES_MIN, "only {sent} messages");
    let counters = yard.counters().await;
    assert!(counters.rate_limited > sent / 4, "{counters:?}");
    assert_eq!(counters.states_dropped + counters.hellos_dropped, 0);
    assert_eq!(counters.presence_dropped + counters.replies_dropped, 0);
    eventually("the loud one is seen as before", async || {
        match link_of("loud").await {
            LinkState::Online => Ok(()),
            other @ (LinkState::Stale | LinkState::Offline) => Err(other),
        }
    })
    .await;
    drop((loud, quiet));
    yard.server.stop().await.unwrap();
}
