//! What a robot with a valid certificate may write, damaged, and raw bytes at the robots' port behind
//! the certificate, while another robot works.

mod gate;
mod keys;

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use clap::Args;
use serde::Serialize;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tread_api::ids::RobotId;
use tread_api::wire;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::LightRobot;
use tread_tests::process::node;
use tread_tests::random::Random;
use tread_tests::report::{self, Check, Figure, figure, quantile};

use crate::floods::HONEST_ROBOT;

/// Oldest that the state of another robot may be.
const STATE_AGE_MAX_MS: f64 = 1_000.0;
/// Longest wait for the answer to another robot's introduction.
const HELLO_MAX_MS: f64 = 2_000.0;
/// Time between two looks at the other robots.
const POLL_INTERVAL: Duration = Duration::from_millis(250);
/// Robots that send damaged payloads.
const ROBOTS: u32 = 3;

/// Damaged payloads of a robot, and raw bytes at the robots' port.
#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// How long, seconds
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(1..=3_600))]
    seconds: u64,
    /// Seed of all that is random
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Judge what does not depend on the machine's speed alone: a short run, built for debugging
    #[arg(long)]
    untimed: bool,
}

/// What has been sent.
#[derive(Debug, Default, Serialize)]
pub(crate) struct Sent {
    /// Damaged payloads on a robot's keys.
    pub(crate) payloads: AtomicU64,
    /// Sessions that they went by.
    pub(crate) sessions: AtomicU64,
    /// Connections with a certificate on which an opening was damaged.
    pub(crate) openings: AtomicU64,
    /// Those of them that the server ended or answered.
    pub(crate) ended_openings: AtomicU64,
}

pub(crate) async fn run(arguments: &Arguments, json: bool) -> anyhow::Result<ExitCode> {
    let mut fleet = Fleet::start_secure_with(&node()?, 86_400).await;
    let honest: RobotId = HONEST_ROBOT.parse()?;
    fleet.join(&honest).await;
    fleet.start_agent(&honest, 0.0).await;
    let endpoint = fleet.zenoh_endpoint();
    let quiet = fleet.membership(&"quiet".parse()?).await;
    let mut quiet = LightRobot::start_secure(&endpoint, &quiet).await?;
    let templates = Arc::new(keys::Templates {
        state: wire::encode(&quiet.next_state())?,
        batch: wire::encode(&quiet.next_batch(4))?,
    });
    let sent = Arc::new(Sent::default());
    let mut random = Random::new(arguments.seed);
    let until = Instant::now() + Duration::from_secs(arguments.seconds);
    let mut attacking = JoinSet::new();
    for number in 0..ROBOTS {
        let membership = fleet
            .membership(&format!("damaged-{number}").parse()?)
            .await;
        let (templates, sent) = (Arc::clone(&templates), Arc::clone(&sent));
        let random = Random::new(random.next_u64());
        let endpoint = endpoint.clone();
        attacking.spawn(keys::attack(
            endpoint, membership, templates, sent, random, until,
        ));
    }
    let membership = fleet.membership(&"raw".parse()?).await;
    let recorded = gate::record(&endpoint, &membership).await?;
    let address = fleet.zenoh_address();
    let raw = gate::attack(
        address,
        membership,
        recorded,
        Arc::clone(&sent),
        random,
        until,
    );
    attacking.spawn(raw);
    let (mut ages_ms, mut hellos_ms, mut failed) = (Vec::new(), Vec::new(), 0);
    while Instant::now() < until && !fleet.has_server_ended() {
        let seen = fleet.rest.robot(&honest).await;
        match seen.and_then(|robot| robot.live) {
            Some(live) => ages_ms.push(figure(live.state_age_ms)),
            None => failed += 1,
        }
        let begun = Instant::now();
        failed += u64::from(quiet.hello().await.is_err());
        hellos_ms.push(1e3 * begun.elapsed().as_secs_f64());
        tokio::time::sleep(POLL_INTERVAL).await;
    }
    let survived = !fleet.has_server_ended();
    if survived {
        while attacking.join_next().await.is_some() {}
    } else {
        eprintln!("{}", fleet.log_tail("server").join("\n"));
    }
    attacking.abort_all();
    let stop = format!("/v1/sites/yard/robots/{honest}/stop");
    let stopped = fleet.rest.call(reqwest::Method::POST, &stop, None).await;
    let is_stopped = stopped.is_some_and(|(_, stop)| stop["confirmed_at"].is_string());
    let (oldest, longest) = (quantile(&mut ages_ms, 1.0), quantile(&mut hellos_ms, 1.0));
    let bounded = |figure: Figure, most: f64| {
        if arguments.untimed {
            figure.shown()
        } else {
            figure.at_most(most)
        }
    };
    let count = |of: &AtomicU64| figure(of.load(Ordering::Relaxed));
    let checks = [
        Check::so("the server survived", survived && !fleet.has_server_ended()),
        Check::so("the other robot is stopped and confirms", is_stopped),
        Check::of_count("looks and introductions that failed", failed).exactly(0),
        bounded(
            Check::of("age of the other robot's state, oldest, ms", oldest),
            STATE_AGE_MAX_MS,
        ),
        bounded(
            Check::of("introduction of the other robot, longest, ms", longest),
            HELLO_MAX_MS,
        ),
        Check::of("damaged payloads", count(&sent.payloads)).at_least(100.0),
        Check::of("damaged openings", count(&sent.openings)).at_least(10.0),
        Check::of(
            "share of damaged openings that ended in time",
            count(&sent.ended_openings) / count(&sent.openings).max(1.0),
        )
        .at_least(1.0),
    ];
    let words = format!(
        "{} damaged payloads in {} sessions, {} damaged openings\n",
        count(&sent.payloads),
        count(&sent.sessions),
        count(&sent.openings)
    );
    report::print_with(json, &*sent, words, &checks)
}
