//! `identity`: whether robots get in, and only they.
//!
//! 1. **gate**: garbage connections at the robots' port, 200 a second of several kinds; how long a
//!    good robot takes to connect meanwhile.
//! 2. **join**: robots drive; another joins. How long until the server hears it, and whether the
//!    others noticed.

mod gate;
mod join;

use std::io::Write;
use std::process::ExitCode;

use clap::Parser;
use serde::Serialize;
use tread_tests::fleet::Fleet;

/// How long certificates are good for here, seconds: nobody renews meanwhile.
const CERTIFICATE_S: u32 = 3_600;

/// Measures whether robots get in, and only they.
#[derive(Debug, Parser)]
#[command(name = "identity")]
pub(crate) struct Arguments {
    /// Garbage connections per second
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(10..=5_000))]
    garbage_hz: u32,
    /// How often a good robot connects meanwhile
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    connects: u32,
    /// Robots that drive while another joins
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=50))]
    robots: u32,
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
    let fleet = Fleet::start_secure_with(&node, CERTIFICATE_S).await;
    let mut checks = gate::measure(&arguments, &fleet).await?;
    drop(fleet);
    let mut fleet = Fleet::start_secure_with(&node, CERTIFICATE_S).await;
    checks.extend(join::measure(&arguments, &mut fleet).await?);
    print(&arguments, &checks)?;
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn print(arguments: &Arguments, checks: &[Check]) -> anyhow::Result<()> {
    let mut output = std::io::stdout().lock();
    if arguments.json {
        let report = serde_json::json!({"checks": checks});
        writeln!(output, "{report}")?;
        return Ok(());
    }
    for check in checks {
        let verdict = if check.holds {
            "holds"
        } else {
            "DOES NOT HOLD"
        };
        writeln!(
            output,
            "{:50} {:>10.2}  {:>8}  {verdict}",
            check.name, check.value, check.goal
        )?;
    }
    Ok(())
}
