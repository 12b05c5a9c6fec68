//! `chaos`: server, agent and network fail at random moments, again and again; every mission must
//! end as its policy says, and both sides must say the same of it.
//!
//! Each seed is one run: a server, an agent behind a network that can be cut, a few missions with
//! policies of their own, requests to cancel, pause, resume and replace them, `kill -9` of either
//! process, and cuts of the network, silent or with a reset. A seed that fails is printed with all
//! that is known, and `--seed` runs it alone.
//!
//! With `TREAD_TEST_ENGINE=postgres store-postgres/with-postgres` before it, the server has a PostgreSQL
//! database, and the network between both is cut too. With `--pair` a second server stands by, and the first
//! is killed, frozen or cut off from everything.

use std::collections::BTreeMap;
use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;
use serde::Serialize;
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tread_tests::chaos::{RunReport, run, run_pair};
use tread_tests::process::node;
use tread_tests::report::{self, Check};

/// Breaks things at random and looks whether every mission ends.
#[derive(Debug, Parser)]
#[command(name = "chaos")]
struct Arguments {
    /// Runs, each with a seed of its own
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    runs: u64,
    /// The first seed
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Two servers on one PostgreSQL database
    #[arg(long)]
    pair: bool,
    /// Runs at the same time
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=64))]
    at_once: u32,
    /// Print one JSON object instead of lines
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Details {
    runs: u64,
    missions: u64,
    server_kills: u64,
    agent_kills: u64,
    cuts: u64,
    database_cuts: u64,
    requests: u64,
    ends: BTreeMap<String, u64>,
    failures: Vec<RunReport>,
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let node = Arc::new(node()?);
    let room = Arc::new(Semaphore::new(arguments.at_once as usize));
    let is_pair = arguments.pair;
    let mut runs = JoinSet::new();
    for seed in arguments.seed..arguments.seed + arguments.runs {
        let (node, room) = (Arc::clone(&node), Arc::clone(&room));
        runs.spawn(async move {
            let _place = room.acquire().await;
            if is_pair {
                run_pair(&node, seed).await
            } else {
                run(&node, seed).await
            }
        });
    }
    let mut reports = Vec::new();
    let mut broken = 0;
    while let Some(ended) = runs.join_next().await {
        match ended {
            Ok(report) => {
                if !arguments.json && !report.violations.is_empty() {
                    writeln!(std::io::stdout(), "seed {}: {report:#?}", report.seed)?;
                }
                reports.push(report);
            }
            Err(panic) => {
                broken += 1;
                writeln!(std::io::stderr(), "a run broke: {panic}")?;
            }
        }
    }
    print_report(&arguments, reports, broken)
}

fn print_report(
    arguments: &Arguments,
    reports: Vec<RunReport>,
    broken: u64,
) -> anyhow::Result<ExitCode> {
    let total = |pick: fn(&RunReport) -> u64| reports.iter().map(pick).sum::<u64>();
    let mut ends = BTreeMap::new();
    for end in reports.iter().flat_map(|report| &report.ends) {
        *ends.entry(end.clone()).or_insert(0) += 1;
    }
    let without = |what: &str, kind: &str| {
        let of_kind = |report: &&RunReport| report.violations.iter().any(|it| it.kind == kind);
        let count = reports.iter().filter(of_kind).count() as u64;
        Check::of_count(what, count).exactly(0)
    };
    let checks = [
        Check::of_count("runs that came to their end", reports.len() as u64)
            .exactly(arguments.runs),
        Check::of_count("runs that broke", broken).exactly(0),
        without("runs with a mission that did not end", "stuck"),
        without("runs with a revived mission", "revived"),
        without("runs with two missions at once", "two_at_once"),
        without("runs with an end against its policy", "policy"),
        without("runs in which the sides disagree", "disagree"),
        without("runs with a record lost or doubled", "records"),
    ];
    let details = Details {
        runs: arguments.runs,
        missions: total(|report| report.ends.len() as u64),
        server_kills: total(|report| report.server_kills),
        agent_kills: total(|report| report.agent_kills),
        cuts: total(|report| report.cuts),
        database_cuts: total(|report| report.database_cuts),
        requests: total(|report| report.requests),
        ends,
        failures: reports
            .into_iter()
            .filter(|report| !report.violations.is_empty())
            .collect(),
    };
    let words = format!(
        "{} missions, {} server kills, {} agent kills, {} cuts, {} of the database, {} requests; ends: {:?}\n",
        details.missions,
        details.server_kills,
        details.agent_kills,
        details.cuts,
        details.database_cuts,
        details.requests,
        details.ends
    );
    report::print_with(arguments.json, &details, words, &checks)
}
