//! `identity`: whether robots get in, and only they.
//!
//! 1. **gate**: garbage connections at the robots' port, 200 a second of several kinds; how long a
//!    good robot takes to connect meanwhile.
//! 2. **join**: robots drive; another joins. How long until the server hears it, and whether the
//!    others noticed.

mod gate;
mod join;

use std::process::ExitCode;

use clap::Parser;
use tread_tests::fleet::Fleet;
use tread_tests::process::node;
use tread_tests::report;

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

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let node = node()?;
    let fleet = Fleet::start_secure_with(&node, CERTIFICATE_S).await;
    let mut checks = gate::measure(&arguments, &fleet).await?;
    drop(fleet);
    let mut fleet = Fleet::start_secure_with(&node, CERTIFICATE_S).await;
    checks.extend(join::measure(&arguments, &mut fleet).await?);
    report::print(arguments.json, &checks)
}
