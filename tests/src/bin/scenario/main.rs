//! `scenario`: what a whole fleet comes to, in a simulated time of its own.
//!
//! Each scenario has a name: `scenario map` is [`tread_tests::scenario::map`].

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use serde::Serialize;
use tread_tests::report::{self, Check};
use tread_tests::scenario::cells;
use tread_tests::scenario::map;
use tread_tests::scenario::report::Size;

mod print;

use self::print::Tables;

/// Runs a fleet in a simulated time and holds what comes of it against what it should be.
#[derive(Debug, Parser)]
#[command(name = "scenario")]
struct Arguments {
    /// Which
    #[command(subcommand)]
    scenario: Scenario,
}

#[derive(Debug, Subcommand)]
enum Scenario {
    /// What a friction map is worth: ten robots of two models make it, a ford freezes, robots arrive
    Map {
        /// What differs between robots is drawn from this
        #[arg(long, default_value_t = 1)]
        seed: u64,
        /// Robots of each of the two models
        #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(2..=9))]
        robots: u32,
        /// Terrains that each of them visits
        #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=5))]
        visits: u32,
        /// Robots of each model that arrive when the ford is frozen
        #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=3))]
        arrivals: u32,
        /// Print one JSON object instead of tables
        #[arg(long, conflicts_with = "markdown")]
        json: bool,
        /// Print the tables in Markdown, for the page of the report
        #[arg(long)]
        markdown: bool,
        /// What to log on standard error, such as `info`
        #[arg(long, default_value = "error")]
        log: String,
    },
    /// How far fused cells of robots unlike the simulator can be trusted
    ///
    /// Robots of the rough world drive figure-8s. Those of one ground differ in payload, inertia, centre of
    /// mass, torque constants, gears and rolling radii.
    Cells {
        /// Seed of the first ground
        #[arg(long, default_value_t = 1_000_001)]
        seed: u64,
        /// Grounds, each once with wheel torque and once without
        #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=10_000))]
        grounds: u32,
        /// Robots on each ground
        #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=20))]
        robots: u32,
        /// Print one JSON object instead of a table
        #[arg(long, conflicts_with = "markdown")]
        json: bool,
        /// Print the table in Markdown, for the page of the report
        #[arg(long)]
        markdown: bool,
    },
}

fn main() -> anyhow::Result<ExitCode> {
    match Arguments::parse().scenario {
        Scenario::Map {
            seed,
            robots,
            visits,
            arrivals,
            json,
            markdown,
            log,
        } => {
            tracing_subscriber::fmt()
                .with_env_filter(log)
                .with_writer(std::io::stderr)
                .init();
            let runtime = tokio::runtime::Builder::new_multi_thread()
                .enable_all()
                .build()?;
            let report = runtime.block_on(map::run(Size {
                seed,
                robots_per_model: robots,
                visits,
                arrivals_per_model: arrivals,
            }))?;
            print_report(
                OutputFormat::of(json, markdown),
                &report,
                &Tables::of_map(&report),
                &report.checks(),
            )
        }
        Scenario::Cells {
            seed,
            grounds,
            robots,
            json,
            markdown,
        } => {
            let report = cells::run(cells::Size {
                seed,
                grounds,
                robots,
            })?;
            print_report(
                OutputFormat::of(json, markdown),
                &report,
                &Tables::of_cells(&report),
                &report.checks(),
            )
        }
    }
}

/// In what form a report is printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum OutputFormat {
    People,
    Json,
    Markdown,
}

impl OutputFormat {
    fn of(json: bool, markdown: bool) -> Self {
        match (json, markdown) {
            (true, _) => Self::Json,
            (_, true) => Self::Markdown,
            _ => Self::People,
        }
    }
}

fn print_report(
    form: OutputFormat,
    report: &impl Serialize,
    tables: &Tables,
    checks: &[Check],
) -> anyhow::Result<ExitCode> {
    if form == OutputFormat::Markdown {
        return report::print_markdown(&tables.markdown(), checks);
    }
    report::print_with(
        form == OutputFormat::Json,
        &Details { report },
        tables,
        checks,
    )
}

#[derive(Debug, Serialize)]
struct Details<'a, R> {
    report: &'a R,
}
