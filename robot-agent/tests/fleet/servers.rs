//! Agents that know several servers.

use std::time::Duration;

use tokio::time::Instant;
use tread_agent::{Agent, AgentConfig, Servers};

use crate::rig::Rig;
use crate::support::{FakeServer, SharedMemory, eventually, free_address};

/// Time within which a robot is to be online at another server.
const MOVE_MAX: Duration = Duration::from_secs(2);

/// A second server, and a rig whose agent knows both.
struct Two {
    rig: Rig,
    port: u16,
    memory: SharedMemory,
}

impl Two {
    fn new() -> Self {
        Self {
            rig: Rig::new(),
            port: free_address().port(),
            memory: SharedMemory::default(),
        }
    }

    fn serve_second(&self) -> FakeServer {
        FakeServer::start(self.port, &self.rig.scenario, &self.memory)
    }

    fn config(&self) -> AgentConfig {
        let second = format!("tcp/127.0.0.1:{}", self.port);
        AgentConfig {
            servers: Servers::new(vec![self.rig.endpoint(), second]).unwrap(),
            ..self.rig.config()
        }
    }

    async fn hellos(memory: &SharedMemory, at_least: usize) {
        eventually("the robot says hello", || {
            let count = memory.lock().unwrap().hellos.len();
            let is_there = count >= at_least;
            is_there.then_some(()).ok_or(format!("{count} hellos"))
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_falls_silent_is_left_for_the_next_and_so_is_that_one() {
    let two = Two::new();
    let (first, second) = (two.rig.serve(), two.serve_second());
    let (pulse, other_pulse) = (first.pulse(), second.pulse());
    let agent = Agent::start(two.config()).unwrap();
    Two::hellos(&two.rig.memory, 1).await;
    tokio::time::sleep(MOVE_MAX).await;
    assert!(
        two.memory.lock().unwrap().hellos.is_empty(),
        "it stays where it is heard"
    );
    pulse.abort();
    let begun = Instant::now();
    Two::hellos(&two.memory, 1).await;
    assert!(begun.elapsed() < MOVE_MAX, "{:?}", begun.elapsed());
    let back = first.pulse();
    other_pulse.abort();
    Two::hellos(&two.rig.memory, 2).await;
    agent.stop().await;
    back.abort();
    first.stop().await;
    second.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_of_another_wire_version_is_silent_to_a_robot() {
    let two = Two::new();
    let (first, second) = (two.rig.serve(), two.serve_second());
    let (pulse, other_pulse) = (first.pulse(), second.pulse());
    let agent = Agent::start(two.config()).unwrap();
    Two::hellos(&two.rig.memory, 1).await;
    let newer = first.pulse_of_another_version();
    pulse.abort();
    let begun = Instant::now();
    Two::hellos(&two.memory, 1).await;
    assert!(begun.elapsed() < MOVE_MAX, "{:?}", begun.elapsed());
    agent.stop().await;
    newer.abort();
    other_pulse.abort();
    first.stop().await;
    second.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_gone_is_left_at_once_and_one_that_never_was_is_passed_over() {
    let two = Two::new();
    let second = two.serve_second();
    let _pulse = second.pulse();
    let begun = Instant::now();
    let agent = Agent::start(two.config()).unwrap();
    Two::hellos(&two.memory, 1).await;
    assert!(begun.elapsed() < MOVE_MAX, "{:?}", begun.elapsed());
    let first = two.rig.serve();
    let _first_pulse = first.pulse();
    let begun = Instant::now();
    second.stop().await;
    Two::hellos(&two.rig.memory, 1).await;
    assert!(begun.elapsed() < MOVE_MAX, "{:?}", begun.elapsed());
    agent.stop().await;
    first.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_server_is_tried_beside_one_that_accepts_connections_and_says_nothing() {
    let two = Two::new();
    let config = two.config();
    let address = two.rig.endpoint();
    let address = address.strip_prefix("tcp/").unwrap();
    // The kernel accepts for it, as for a server whose process is stopped. zenoh waits 2.5 s for it.
    let frozen = std::net::TcpListener::bind(address).unwrap();
    let second = two.serve_second();
    let _pulse = second.pulse();
    let begun = Instant::now();
    let agent = Agent::start(config).unwrap();
    Two::hellos(&two.memory, 1).await;
    assert!(begun.elapsed() < MOVE_MAX, "{:?}", begun.elapsed());
    agent.stop().await;
    second.stop().await;
    drop(frozen);
}
