//! `safety`: whether stopping depends on luck.
//!
//! One after the other:
//!
//! 1. **silence**: drivers on a bad network fall silent, on the bench, to the bit the same for a
//!    seed; how soon the target is zero after the last valid end, and on how much way the robot
//!    comes to rest.
//! 2. **lease**: random drivers against a model that knows which commands count.
//! 3. **stop**: a server and real agents that all drive; from the REST call until the answer, which
//!    a robot gives only when its target is zero and the stop is on its disk.
//! 4. **foreign**: stale, expired, old and foreign drive commands over real zenoh to a real agent.
//! 5. **link**: how old drive commands are at a robot while bulk saturates its narrow link.

mod foreign;
mod link;
mod robots;
mod stop;

use std::io::Write;
use std::process::ExitCode;

use clap::Parser;
use serde::Serialize;
use tread_agent::bench::{hand_trials, lease_model};
use tread_tests::fleet::Fleet;

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

/// A figure with what it must be.
#[derive(Debug, Serialize)]
pub(crate) struct Check {
    pub(crate) name: &'static str,
    pub(crate) goal: String,
    pub(crate) value: f64,
    pub(crate) holds: bool,
}

impl Check {
    /// A figure that must be at most `most`.
    pub(crate) fn at_most(name: &'static str, most: f64, value: f64) -> Self {
        Self {
            name,
            goal: format!("<= {most}"),
            value,
            holds: value <= most,
        }
    }

    /// A figure that must be at least `least`.
    pub(crate) fn at_least(name: &'static str, least: f64, value: f64) -> Self {
        Self {
            name,
            goal: format!(">= {least}"),
            value,
            holds: value >= least,
        }
    }
}

/// A count as a figure.
#[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
pub(crate) fn figure(count: u64) -> f64 {
    count as f64
}

/// The value below which that share of the figures lies; infinite without any.
pub(crate) fn quantile(figures: &mut [f64], share: f64) -> f64 {
    figures.sort_by(f64::total_cmp);
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_precision_loss,
        clippy::cast_sign_loss,
        reason = "an index into a list in memory"
    )]
    let index = (figures.len() as f64 * share).ceil() as usize;
    let found = figures.get(index.saturating_sub(1));
    found.copied().unwrap_or(f64::INFINITY)
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    // The executables of this package stand beside each other.
    let node = std::env::current_exe()?.with_file_name("node");
    anyhow::ensure!(
        node.exists(),
        "{} is missing: build it with `cargo build --release -p tread-tests --bins`",
        node.display()
    );
    let (trials, steps, seed) = (arguments.trials, arguments.steps, arguments.seed);
    let mut checks =
        tokio::task::spawn_blocking(move || on_the_bench(trials, steps, seed)).await??;
    let fleet = Fleet::start_with(&node).await;
    checks.extend(stop::measure(&arguments, &fleet).await?);
    drop(fleet);
    let fleet = Fleet::start_with(&node).await;
    checks.extend(foreign::measure(&arguments, &fleet).await?);
    checks.extend(link::measure(&arguments, &fleet).await?);
    print(&arguments, &checks)?;
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn on_the_bench(trials: u64, steps: u64, seed: u64) -> anyhow::Result<Vec<Check>> {
    let hand = hand_trials::run(trials, seed)?;
    let model = lease_model::run(steps, seed);
    let counts = model.counts;
    let refused = counts.malformed + counts.foreign + counts.out_of_order + counts.expired;
    Ok(vec![
        Check::at_least("silence: trials", figure(trials), figure(hand.trials)),
        Check::at_most("silence: misses of 250 ms", 0.0, figure(hand.misses)),
        Check::at_most("silence: worst, ms", 250.0, hand.worst_zero_ms),
        Check::at_most(
            "silence: overruns of v²/2a + v·0.25 s",
            0.0,
            figure(hand.overruns),
        ),
        Check::at_most(
            "silence: worst share of that way",
            1.0,
            hand.worst_way_share,
        ),
        Check::at_least(
            "lease: steps of the model",
            figure(steps),
            figure(model.steps),
        ),
        Check::at_most(
            "lease: wrongly accepted",
            0.0,
            figure(model.wrongly_accepted),
        ),
        Check::at_most("lease: wrongly refused", 0.0, figure(model.wrongly_refused)),
        Check::at_most("lease: outlived their end", 0.0, figure(model.outlived)),
        Check::at_most("lease: stolen", 0.0, figure(model.stolen)),
        Check::at_least("lease: commands accepted", 1.0, figure(counts.accepted)),
        Check::at_least("lease: commands refused", 1.0, figure(refused)),
    ])
}

fn print(arguments: &Arguments, checks: &[Check]) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    if arguments.json {
        serde_json::to_writer(&mut out, &serde_json::json!({ "checks": checks }))?;
        writeln!(out)?;
        return Ok(());
    }
    for check in checks {
        let verdict = if check.holds { "ok" } else { "FAILED" };
        writeln!(
            out,
            "{verdict:<7}{:<48}{:>14.3}   goal {}",
            check.name, check.value, check.goal
        )?;
    }
    Ok(())
}
