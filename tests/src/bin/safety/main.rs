//! `safety`: whether stopping depends on luck.
//!
//! One after the other:
//!
//! 1. **silence**: drivers on a bad network fall silent, on the bench, to the bit the same for a
//!    seed; how soon the target is zero after the last valid end, and over which distance the robot
//!    comes to rest.
//! 2. **lease**: random drivers against a model that knows which commands count.
//! 3. **stop**: a server and real agents that all drive; from the REST call until the answer, which
//!    a robot gives only when its target is zero and the stop is on its disk.
//! 4. **foreign**: stale, expired, old and foreign drive commands over real zenoh to a real agent.
//! 5. **link**: how old drive commands are at a robot while bulk saturates its narrow link.
//! 6. **slow link by TLS**: the same at 1 Mbit/s while the robot uploads a full outbox.

mod foreign;
mod link;
mod robots;
mod stop;

use std::process::ExitCode;

use clap::Parser;
use tread_agent::testing::lease_model::{self, LeaseModelRun};
use tread_lab::teleoperation_trials::{self, TrialRun};
use tread_tests::fleet::Fleet;
use tread_tests::process::node;
use tread_tests::report::{self, Check, figure};

/// How long certificates are good for: longer than any measurement.
const CERTIFICATE_S: u32 = 86_400;

/// Measures whether stopping depends on luck.
#[derive(Debug, Parser)]
#[command(name = "safety")]
pub(crate) struct Arguments {
    /// Trials of drivers that fall silent
    #[arg(long, default_value_t = 10_000)]
    trials: u64,
    /// Steps of the model of leases
    #[arg(long, default_value_t = 1_000_000)]
    steps: u64,
    /// Real agents that are stopped
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=500))]
    robots: u32,
    /// How often each of them is stopped, and the whole fleet
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    rounds: u32,
    /// Foreign drive commands over zenoh
    #[arg(long, default_value_t = 100_000)]
    foreign: u64,
    /// Time on the narrow link, seconds
    #[arg(long, default_value_t = 20)]
    seconds: u64,
    /// What is random is drawn from this
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let node = node()?;
    let seed = arguments.seed;
    let trials = TrialRun {
        trials: arguments.trials,
        seed,
    };
    let model = LeaseModelRun {
        steps: arguments.steps,
        seed,
    };
    let mut checks = tokio::task::spawn_blocking(move || on_the_bench(trials, model)).await??;
    let fleet = Fleet::start_with(&node).await;
    checks.extend(stop::measure(&arguments, &fleet).await?);
    drop(fleet);
    let fleet = Fleet::start_with(&node).await;
    checks.extend(foreign::measure(&arguments, &fleet).await?);
    checks.extend(link::measure(&arguments, &fleet).await?);
    drop(fleet);
    let fleet = Fleet::start_secure_with(&node, CERTIFICATE_S).await;
    checks.extend(link::measure_tls(&arguments, &fleet).await?);
    report::print(arguments.json, &checks)
}

fn on_the_bench(run: TrialRun, model: LeaseModelRun) -> anyhow::Result<Vec<Check>> {
    let TrialRun { trials, .. } = run;
    let hand = teleoperation_trials::run(run)?;
    let steps = model.steps;
    let model = lease_model::run(model);
    let counts = model.counts;
    let refused = counts.malformed + counts.foreign + counts.out_of_order + counts.expired;
    Ok(vec![
        Check::of("silence: trials", figure(hand.trials)).at_least(figure(trials)),
        Check::of("silence: misses of 250 ms", figure(hand.misses)).at_most(0.0),
        Check::of("silence: worst, ms", hand.worst_zero_ms).at_most(250.0),
        Check::of(
            "silence: overruns of v²/2a + v·0.25 s",
            figure(hand.overruns),
        )
        .at_most(0.0),
        Check::of(
            "silence: worst share of that distance",
            hand.worst_distance_share,
        )
        .at_most(1.0),
        Check::of("lease: steps of the model", figure(model.steps)).at_least(figure(steps)),
        Check::of("lease: wrongly accepted", figure(model.wrongly_accepted)).at_most(0.0),
        Check::of("lease: wrongly refused", figure(model.wrongly_refused)).at_most(0.0),
        Check::of("lease: outlived their end", figure(model.outlived)).at_most(0.0),
        Check::of("lease: stolen", figure(model.stolen)).at_most(0.0),
        Check::of("lease: commands accepted", figure(counts.accepted)).at_least(1.0),
        Check::of("lease: commands refused", figure(refused)).at_least(1.0),
    ])
}
