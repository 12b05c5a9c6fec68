//! What becomes of robots' links: they end at once when their robot is put out or their authority is
//! retired, make room for their successors, and take nothing from others.

use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;
use tread_api::ids::BootId;
use tread_api::keys;
use tread_api::tunnel::SessionPrefix;
use uuid::Uuid;
use zenoh::Wait as _;

use super::MESSAGE_BYTES_MAX;
use super::access_tests::{Rig, Who, enrolment, put, robot, site};
use super::gate::LINKS_PER_ROBOT_MAX;
use super::inbox::STATE_BYTES_MAX;
use super::routers::Router;
use super::test_client::{ClientOverrides, POLL_INTERVAL, TestSession, until};
use crate::rate_limit::RateLimit;

const PATIENCE: Duration = Duration::from_secs(20);
/// How soon a robot that was put out is cut off.
const CUT_MAX: Duration = Duration::from_secs(1);
/// How long a session may try to open, milliseconds: less than the lease of one that stands.
const OPEN_MS: u32 = 2_000;
/// Liveliness tokens of a robot that floods.
const TOKENS: usize = 2_000;

async fn sessions_on(router: &Arc<Router>) -> usize {
    let router = Arc::clone(router);
    let counting = tokio::task::spawn_blocking(move || router.session_count());
    counting.await.unwrap()
}

/// A session with an id of one's own.
async fn open_as(rig: &Rig, who: Who, lower: u64) -> Option<TestSession> {
    let client = rig.client(who);
    let prefix: SessionPrefix = client.credentials().await?.session_prefix;
    let shown = ClientOverrides {
        session_id: Some(prefix.session_id(lower)),
        ..ClientOverrides::default()
    };
    client.open(&shown, OPEN_MS).await
}

async fn end(rig: Rig) {
    rig.supervisor.stop().await.unwrap();
    rig.fleet.close().await;
}

/// Waits for the end of a link and of its session inside: how long that took.
async fn cut(session: &mut TestSession, router: &Arc<Router>) -> Duration {
    let begun = Instant::now();
    let ended = tokio::time::timeout(PATIENCE, session.link_ended()).await;
    ended.expect("the link ends");
    until("the session inside ends", async || {
        sessions_on(router).await == 0
    })
    .await;
    begun.elapsed()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_is_put_out_is_cut_off_within_a_second_and_cannot_come_back() {
    let rig = Rig::start().await;
    let mut session = rig.connect(Who::Own, 10_000).await.unwrap();
    let router = rig.fleet.routers.newest().unwrap();
    assert_eq!(sessions_on(&router).await, 1);
    rig.app
        .enrolment_registry()
        .record(&enrolment("rover-1", 2, true));
    let took = cut(&mut session, &router).await;
    assert!(took < CUT_MAX, "it took {took:?}");
    until("the cut is counted", async || {
        rig.app.counters().gate_revoked.get() == 1
    })
    .await;
    assert!(rig.connect(Who::Own, 300).await.is_none());
    let other = rig.connect(Who::Foreign, 10_000).await;
    other.expect("others are not concerned").close().await;
    end(rig).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_on_a_router_that_was_since_replaced_is_cut_off_too() {
    let rig = Rig::start().await;
    let mut session = rig.connect(Who::Own, 10_000).await.unwrap();
    let former = rig.fleet.routers.newest().unwrap();
    // Routers are superseded by those for as many robots again.
    for joined in ["rover-4", "rover-5", "rover-6"] {
        rig.app
            .enrolment_registry()
            .record(&enrolment(joined, 1, false));
    }
    let number = former.number;
    until("another router takes its robots", async || {
        let present = rig.fleet.routers.of(&(site(), robot("rover-1")));
        present.unwrap().number != number
    })
    .await;
    assert_eq!(sessions_on(&former).await, 1, "it stays where it is");
    rig.app
        .enrolment_registry()
        .record(&enrolment("rover-1", 2, true));
    let took = cut(&mut session, &former).await;
    assert!(took < CUT_MAX, "it took {took:?}");
    assert!(rig.connect(Who::Own, 300).await.is_none());
    end(rig).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_authority_that_is_retired_takes_its_links_passwords_and_routers_with_it() {
    let rig = Rig::start().await;
    let mut session = rig.connect(Who::Own, 10_000).await.unwrap();
    let client = rig.client(Who::Own);
    let before = client.credentials().await.unwrap();
    let former = rig.fleet.routers.newest().unwrap();
    let now = rig.app.clock().now();
    rig.authorities.start("admin", now).unwrap();
    let signing = rig.authorities.present().signing().fingerprint().to_owned();
    until("a router of the new authority is open", async || {
        rig.fleet.routers.newest().unwrap().authority() == Some(&*signing)
    })
    .await;
    assert_eq!(sessions_on(&former).await, 1, "it stays where it is");
    // The former certificate still opens links, and gets what derives from the new key.
    let during = client.credentials().await.unwrap();
    assert_ne!(during.password, before.password);
    assert_ne!(during.session_prefix, before.session_prefix);
    let another = rig.connect(Who::Foreign, 10_000).await.unwrap();
    let rotation = rig.authorities.present().id();
    rig.authorities.finish(rotation).unwrap();
    let ended = tokio::time::timeout(CUT_MAX, session.link_ended()).await;
    assert!(ended.is_ok(), "the link ends at once");
    until("its router is closed", async || {
        rig.fleet.routers.all().len() == 1
    })
    .await;
    until("both links are counted", async || {
        rig.app.counters().gate_retired.get() >= 2
    })
    .await;
    // The port shows the new authority, which this client does not know.
    assert!(client.credentials().await.is_none());
    drop(another);
    end(rig).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_comes_back_while_its_former_link_still_stands() {
    let rig = Rig::start().await;
    let client = rig.client(Who::Own);
    let mut first = client
        .open(&ClientOverrides::default(), 10_000)
        .await
        .unwrap();
    // Its network is gone, and nobody has noticed: it does not close. The id is the same.
    let begun = Instant::now();
    let second = client.open(&ClientOverrides::default(), OPEN_MS).await;
    let second = second.expect("the router takes it");
    assert!(begun.elapsed() < CUT_MAX, "it took {:?}", begun.elapsed());
    let ended = tokio::time::timeout(CUT_MAX, first.link_ended()).await;
    assert!(ended.is_ok(), "the former link ends");
    // Another certificate of the same robot takes nothing over, whatever it says.
    let stranger = rig
        .client(Who::Own)
        .open(&ClientOverrides::default(), 300)
        .await;
    assert!(stranger.is_none());
    let key = keys::state(&site(), &robot("rover-1"));
    let received = rig.app.counters().refused_malformed.get();
    put(&second.zenoh, key, "no state".to_owned());
    until("the session lives", async || {
        rig.app.counters().refused_malformed.get() > received
    })
    .await;
    second.close().await;
    end(rig).await;
}

/// Connections to a port of the loopback that are open, as the kernel says.
fn connections_to(port: u16) -> usize {
    let table = std::fs::read_to_string("/proc/self/net/tcp").unwrap();
    let port = format!(":{port:04X}");
    let is_one = |line: &&str| {
        let mut words = line.split_whitespace().skip(2);
        let to = words.next().is_some_and(|remote| remote.ends_with(&port));
        to && words.next() == Some("01")
    };
    table.lines().filter(is_one).count()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_link_on_which_nothing_is_said_takes_no_place_at_the_router() {
    let rig = Rig::start().await;
    let port = rig.fleet.routers.newest().unwrap().address.port();
    let mut silent = Vec::new();
    for who in [Who::Own, Who::Own, Who::Foreign, Who::Foreign] {
        silent.push(rig.client(who).silent().await.unwrap());
    }
    assert_eq!(connections_to(port), 0);
    let session = rig.connect(Who::Own, 10_000).await.unwrap();
    assert_eq!(connections_to(port), 1);
    session.close().await;
    drop(silent);
    end(rig).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_a_robots_links_the_newest_four_stay_at_the_router() {
    let rig = Rig::start().await;
    let mut sessions = Vec::new();
    for lower in 1..=6 {
        sessions.push(open_as(&rig, Who::Own, lower).await.unwrap());
    }
    for oldest in &mut sessions[..2] {
        let ended = tokio::time::timeout(PATIENCE, oldest.link_ended()).await;
        ended.expect("the oldest links end");
    }
    let router = rig.fleet.routers.newest().unwrap();
    until("the newest are left", async || {
        sessions_on(&router).await == LINKS_PER_ROBOT_MAX
    })
    .await;
    let other = rig.connect(Who::Foreign, 10_000).await;
    other.expect("others are not concerned").close().await;
    end(rig).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_declares_liveliness_tokens_without_end_is_cut_off_for_a_while() {
    let rig = Rig::start().await;
    let mut session = rig.connect(Who::Own, 10_000).await.unwrap();
    let mut other = rig.connect(Who::Foreign, 10_000).await.unwrap();
    let zenoh = session.zenoh.clone();
    let declaring = tokio::task::spawn_blocking(move || {
        let token = || {
            let boot = BootId::from_uuid(Uuid::new_v4());
            let key = keys::alive(&site(), &robot("rover-1"), boot);
            zenoh.liveliness().declare_token(key).wait()
        };
        (0..TOKENS).map_while(|_| token().ok()).collect::<Vec<_>>()
    });
    let ended = tokio::time::timeout(PATIENCE, session.link_ended()).await;
    ended.expect("its link is cut");
    let counters = rig.app.counters();
    // The connection closes before it is counted.
    until("the cut is counted", async || {
        counters.gate_cut_off.get() >= 1
    })
    .await;
    drop(declaring.await.unwrap());
    // What it had declared goes with its session, and it does not come back at once.
    until("its session ends", async || {
        sessions_on(&rig.fleet.routers.newest().unwrap()).await == 1
    })
    .await;
    assert!(rig.connect(Who::Own, 300).await.is_none());
    let undisturbed = tokio::time::timeout(POLL_INTERVAL, other.link_ended()).await;
    assert!(undisturbed.is_err(), "others are not concerned");
    until("it is let in again", async || {
        rig.connect(Who::Own, OPEN_MS).await.is_some()
    })
    .await;
    other.close().await;
    end(rig).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_above_its_bound_is_dropped_and_the_next_one_is_heard() {
    let rig = Rig::start().await;
    let session = rig.connect(Who::Own, 10_000).await.unwrap();
    let key = keys::state(&site(), &robot("rover-1"));
    let counters = rig.app.counters();
    let publish = async |bytes: usize| {
        let (zenoh, key) = (session.zenoh.clone(), key.clone());
        let putting = tokio::task::spawn_blocking(move || put(&zenoh, key, "x".repeat(bytes)));
        putting.await.unwrap();
    };
    for bytes in [STATE_BYTES_MAX + 1, 2] {
        let refused = counters.refused_malformed.get();
        publish(bytes).await;
        until("it is refused and counted", async || {
            counters.refused_malformed.get() == refused + 1
        })
        .await;
    }
    // Above what is put together of fragments nothing reaches the server at all.
    let refused = counters.refused_malformed.get();
    publish(MESSAGE_BYTES_MAX + 1).await;
    session.close().await;
    // The router reads what was sent to its end, and meanwhile takes no other session of this identifier.
    let router = rig.fleet.routers.newest().unwrap();
    until("the former session is gone", async || {
        sessions_on(&router).await == 0
    })
    .await;
    let again = rig.connect(Who::Own, 10_000).await.unwrap();
    put(&again.zenoh, key.clone(), "x".to_owned());
    until("a new session is heard", async || {
        counters.refused_malformed.get() > refused
    })
    .await;
    assert_eq!(counters.refused_malformed.get(), refused + 1);
    again.close().await;
    end(rig).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_sends_too_many_bytes_is_read_later_and_keeps_its_link() {
    let rig = Rig::start_with(|fleet| {
        fleet.byte_rate = RateLimit {
            burst: 16 * 1024,
            interval: Duration::from_secs(1) / (128 * 1024),
        };
    })
    .await;
    let mut session = rig.connect(Who::Own, 10_000).await.unwrap();
    let counters = rig.app.counters();
    let (zenoh, key) = (
        session.zenoh.clone(),
        keys::state(&site(), &robot("rover-1")),
    );
    let putting = tokio::task::spawn_blocking(move || put(&zenoh, key, "x".repeat(64 * 1024)));
    putting.await.unwrap();
    until("all of it has come", async || {
        counters.refused_malformed.get() == 1
    })
    .await;
    assert!(counters.gate_throttled.get() > 0);
    let cut = tokio::time::timeout(POLL_INTERVAL, session.link_ended()).await;
    assert!(cut.is_err(), "its link stays");
    session.close().await;
    end(rig).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_joins_gets_a_router_of_its_own_and_others_connect_to_theirs() {
    let rig = Rig::start().await;
    let first = rig.fleet.routers.newest().unwrap();
    rig.app
        .enrolment_registry()
        .record(&enrolment("rover-4", 1, false));
    until("another router is open", async || {
        rig.fleet.routers.newest().unwrap().number != first.number
    })
    .await;
    let second = rig.fleet.routers.newest().unwrap();
    assert_eq!(second.robots, [(site(), robot("rover-4"))].into());
    let session = rig.connect(Who::Own, 10_000).await.unwrap();
    assert_eq!(
        sessions_on(&first).await,
        1,
        "it is one of the first router"
    );
    // The server hears it there.
    let counters = rig.app.counters();
    let refused = counters.refused_malformed.get();
    let key = keys::state(&site(), &robot("rover-1"));
    put(&session.zenoh, key, "no state".to_owned());
    until("it is heard", async || {
        counters.refused_malformed.get() > refused
    })
    .await;
    session.close().await;
    end(rig).await;
}
