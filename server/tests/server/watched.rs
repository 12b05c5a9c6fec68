//! Agents of robots that somebody watches are asked for states more often; no others are.

use std::time::Duration;

use tokio::task::JoinSet;
use tread_api::wire::state::WATCHED_STATE_RATE_HZ;
use tread_server::app::watched::{REQUEST_DURATION, REQUEST_PERIOD, TRIES_MAX};

use crate::drive::Socket;
use crate::harness::{Yard, eventually};
use crate::robot::Robot;

/// Watches a robot, and reads what the socket says, until the result is dropped.
async fn watch(yard: &Yard, robot: &str) -> JoinSet<()> {
    let socket = Socket::open(yard, robot).await;
    let mut reading = JoinSet::new();
    reading.spawn(socket.stay());
    reading
}

async fn asked(robot: &Robot, times: usize) {
    let what = format!("`{}` is asked {times} times", robot.id);
    eventually(&what, async || {
        let heard = robot.state_rates().len();
        if heard >= times { Ok(()) } else { Err(heard) }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watched_robot_is_asked_once_however_many_watch_it() {
    let yard = Yard::start().await;
    let watched = Robot::join(&yard, "rover-1").await;
    let other = Robot::join(&yard, "rover-2").await;
    let mut sockets = Vec::new();
    for _ in 0..5 {
        sockets.push(watch(&yard, "rover-1").await);
    }
    let gauge = yard.server.app().metrics_text().await;
    assert!(gauge.contains("tread_robots_watched 1"), "{gauge}");
    asked(&watched, 4).await;
    let heard = watched.state_rates();
    for pair in heard.windows(2) {
        let apart = pair[1].0 - pair[0].0;
        // The first answer may have taken a while.
        assert!(apart > REQUEST_PERIOD / 2, "{apart:?}");
    }
    for (_, request) in heard {
        assert!((request.rate_hz - WATCHED_STATE_RATE_HZ).abs() < 1e-9);
        assert_eq!(Duration::from_millis(request.for_ms), REQUEST_DURATION);
    }
    assert!(other.state_rates().is_empty(), "nobody watches it");
    drop(sockets);
    eventually("nobody watches", async || {
        let gauge = yard.server.app().metrics_text().await;
        let is_so = gauge.contains("tread_robots_watched 0");
        if is_so { Ok(()) } else { Err(()) }
    })
    .await;
    let before = watched.state_rates().len();
    let _socket = watch(&yard, "rover-2").await;
    asked(&other, 3).await;
    let after = watched.state_rates().len();
    assert!(after <= before + 1, "{before} before, {after} after");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_that_does_not_know_the_request_is_not_flooded_with_it() {
    let yard = Yard::start().await;
    let older = Robot::join(&yard, "rover-1").await;
    let newer = Robot::join(&yard, "rover-2").await;
    older.be_deaf_to_state_rates();
    let tries = usize::try_from(TRIES_MAX).unwrap();
    let mut socket = watch(&yard, "rover-1").await;
    let _other = watch(&yard, "rover-2").await;
    asked(&older, tries).await;
    for round in 1..=3 {
        drop(socket);
        socket = watch(&yard, "rover-1").await;
        // Its requests show that time passes.
        asked(&newer, newer.state_rates().len() + round).await;
    }
    assert_eq!(older.state_rates().len(), tries);
    // Another run may be of another release.
    let updated = older.reboot(&yard).await;
    asked(&updated, 2).await;
    drop(socket);
    yard.server.stop().await.unwrap();
}
