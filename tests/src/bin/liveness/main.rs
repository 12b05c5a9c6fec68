//! `liveness`: how soon the server shows that a robot is gone, and that it is back.
//!
//! One agent behind a network that can be cut. Measured over and over: from a silent cut to
//! `offline`, from the death of the agent's process to `offline`, and from the healing of the
//! network to `online`, after cuts of several lengths, with and without a reset. What is timed is
//! what a client of the REST API sees, so the poll is in the figures.
//!
//! The relay of those cuts keeps what it was given, as a bridge would. [`lossy`] repeats them where
//! packets are really lost.

mod lossy;

use std::io::Write;
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use serde::Serialize;
use tokio::time::Instant;
use tread_api::ids::RobotId;
use tread_api::robot::LinkState;
use tread_tests::fleet::Fleet;
use tread_tests::process::node;
use tread_tests::random::Random;
use tread_tests::relay::Relay;
use tread_tests::report::{self, Check, quantile};

/// Silent cut to `offline`, at the most.
const SILENCE_MAX_S: f64 = 1.5;
/// Death of the agent to `offline`, at the most.
const DEATH_MAX_S: f64 = 0.2;
/// Healing to `online`, at the most.
const HEALING_MAX_S: f64 = 2.0;
/// Time between two looks.
const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Longest wait for any of them.
const WAIT_MAX: Duration = Duration::from_secs(30);
/// Longest cut.
const CUT_MAX_S: f64 = 14.0;

/// Measures how soon a robot is shown gone and back.
#[derive(Debug, Parser)]
#[command(name = "liveness")]
struct Arguments {
    /// Trials of each kind
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    trials: u32,
    /// What the moments are drawn from
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
    /// Only the cuts that lose packets, here, in a network of this program's own; prints the times
    #[arg(long, hide = true)]
    lossy_here: bool,
}

#[derive(Debug, Serialize)]
struct Details {
    trials: u32,
    not_measured: Option<&'static str>,
}

/// The slowest and, beside it, the median.
fn worst_and_median(name: &str, most_s: f64, mut seen_s: Vec<f64>) -> [Check; 2] {
    [
        Check::of(format!("{name}, s"), quantile(&mut seen_s, 1.0)).at_most(most_s),
        Check::shown(format!("{name}, median, s"), quantile(&mut seen_s, 0.5)),
    ]
}

/// Waits until the server shows a link state and says how long that took, seconds.
async fn shown(fleet: &Fleet, robot: &RobotId, link: LinkState) -> anyhow::Result<f64> {
    shown_since(fleet, robot, link, Instant::now()).await
}

/// The same, counted from a moment that has passed.
async fn shown_since(
    fleet: &Fleet,
    robot: &RobotId,
    link: LinkState,
    began: Instant,
) -> anyhow::Result<f64> {
    loop {
        if fleet.rest.robot(robot).await.map(|robot| robot.link) == Some(link) {
            return Ok(began.elapsed().as_secs_f64());
        }
        anyhow::ensure!(
            began.elapsed() < WAIT_MAX,
            "the robot was not shown {link:?} within {WAIT_MAX:?}: {:?}",
            fleet.log_tail(robot.as_str()),
        );
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}

/// Any moment between two heartbeats.
async fn settle(random: &mut Random) {
    tokio::time::sleep(Duration::from_secs_f64(random.between(1.0..1.5))).await;
}

async fn cuts(
    fleet: &Fleet,
    relay: &Relay,
    robot: &RobotId,
    arguments: &Arguments,
) -> anyhow::Result<(Vec<f64>, Vec<f64>)> {
    let mut random = Random::new(arguments.seed);
    let (mut gone_s, mut back_s) = (Vec::new(), Vec::new());
    for trial in 0..arguments.trials {
        settle(&mut random).await;
        relay.cut();
        gone_s.push(shown(fleet, robot, LinkState::Offline).await?);
        tokio::time::sleep(Duration::from_secs_f64(random.between(0.0..CUT_MAX_S))).await;
        if trial % 2 == 1 {
            relay.reset();
        }
        relay.heal();
        back_s.push(shown(fleet, robot, LinkState::Online).await?);
    }
    Ok((gone_s, back_s))
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let node = node()?;
    if arguments.lossy_here {
        let times = lossy::measure_here(&node, arguments.trials, arguments.seed).await?;
        let mut output = std::io::stdout().lock();
        writeln!(output, "{}", serde_json::to_string(&times)?)?;
        return Ok(ExitCode::SUCCESS);
    }
    let mut fleet = Fleet::start_with(&node).await;
    let robot: RobotId = "rover-1".parse()?;
    let relay = fleet.start_agent_behind_relay(&robot, 0.0).await;
    let (gone_s, back_s) = cuts(&fleet, &relay, &robot, &arguments).await?;
    let mut random = Random::new(!arguments.seed);
    let mut died_s = Vec::new();
    for _ in 0..arguments.trials {
        settle(&mut random).await;
        fleet.kill_agent(&robot);
        died_s.push(shown(&fleet, &robot, LinkState::Offline).await?);
        fleet.spawn_agent_behind(&robot, 0.0, &relay);
        shown(&fleet, &robot, LinkState::Online).await?;
    }
    drop(fleet);
    let mut checks = Vec::new();
    for (name, most_s, seen_s) in [
        ("silent partition to offline", SILENCE_MAX_S, gone_s),
        ("process death to offline", DEATH_MAX_S, died_s),
        ("healing to online", HEALING_MAX_S, back_s),
    ] {
        checks.extend(worst_and_median(name, most_s, seen_s));
    }
    let not_measured = match lossy::measure(arguments.trials, arguments.seed).await? {
        Some(times) => {
            checks.extend(times.into_iter().flat_map(lossy::Times::checks));
            None
        }
        None => Some(lossy::NOT_MEASURED),
    };
    if let Some(what) = not_measured {
        eprintln!("{what}");
    }
    let details = Details {
        trials: arguments.trials,
        not_measured,
    };
    report::print_with(arguments.json, &details, "", &checks)
}
