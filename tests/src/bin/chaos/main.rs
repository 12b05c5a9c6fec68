//! `chaos`: server, agent and network fail at random moments, again and again; every mission must
//! end as its policy says, and both sides must say the same of it.
//!
//! Each seed is one run: a server, an agent behind a network that can be cut, a few missions with
//! policies of their own, requests to cancel, pause, resume and replace them, `kill -9` of either
//! process, and cuts of the network, silent or with a reset. A seed that fails is printed with all
//! that is known, and `--seed` runs it alone.

use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;

use clap::Parser;
use serde::Serialize;
use tokio::sync::Semaphore;
use tokio::task::JoinSet;
use tread_tests::chaos::{RunReport, run};

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
    /// Runs at the same time
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=64))]
    at_once: u32,
    /// Print one JSON object instead of lines
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Check {
    name: &'static str,
    goal: String,
    value: u64,
    holds: bool,
}

#[derive(Debug, Serialize)]
struct Report {
    runs: u64,
    missions: u64,
    server_kills: u64,
    agent_kills: u64,
    cuts: u64,
    requests: u64,
    ends: std::collections::BTreeMap<String, u64>,
    failures: Vec<RunReport>,
    checks: Vec<Check>,
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    // The executables of this package stand beside each other.
    let node = Arc::new(std::env::current_exe()?.with_file_name("node"));
    anyhow::ensure!(
        node.exists(),
        "{} is missing: build it with `cargo build --release -p tread-tests --bins`",
        node.display()
    );
    let room = Arc::new(Semaphore::new(arguments.at_once as usize));
    let mut runs = JoinSet::new();
    for seed in arguments.seed..arguments.seed + arguments.runs {
        let (node, room) = (Arc::clone(&node), Arc::clone(&room));
        runs.spawn(async move {
            let _place = room.acquire().await;
            run(&node, seed).await
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
    let report = summed(&arguments, reports, broken);
    let holds = report.checks.iter().all(|check| check.holds);
    let mut output = std::io::stdout().lock();
    if arguments.json {
        writeln!(output, "{}", serde_json::to_string(&report)?)?;
    } else {
        for check in &report.checks {
            let verdict = if check.holds {
                "holds"
            } else {
                "DOES NOT HOLD"
            };
            let Check {
                name, goal, value, ..
            } = check;
            writeln!(output, "{name:40} {value:>6}  {goal:>8}  {verdict}")?;
        }
        writeln!(
            output,
            "{} missions, {} server kills, {} agent kills, {} cuts, {} requests; ends: {:?}",
            report.missions,
            report.server_kills,
            report.agent_kills,
            report.cuts,
            report.requests,
            report.ends
        )?;
    }
    Ok(if holds {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn summed(arguments: &Arguments, reports: Vec<RunReport>, broken: u64) -> Report {
    let none = |name, value| Check {
        name,
        goal: "= 0".to_owned(),
        value,
        holds: value == 0,
    };
    let total = |pick: fn(&RunReport) -> u64| reports.iter().map(pick).sum::<u64>();
    let ends = reports.iter().flat_map(|report| report.ends.iter());
    let mut counted = std::collections::BTreeMap::new();
    for end in ends {
        *counted.entry(end.clone()).or_insert(0) += 1;
    }
    let violated = |kind: &str| {
        let of_kind = |report: &&RunReport| {
            report
                .violations
                .iter()
                .any(|violation| violation.kind == kind)
        };
        u64::try_from(reports.iter().filter(of_kind).count()).unwrap_or(u64::MAX)
    };
    let done = u64::try_from(reports.len()).unwrap_or(u64::MAX);
    let checks = vec![
        Check {
            name: "runs that came to their end",
            goal: format!("= {}", arguments.runs),
            value: done,
            holds: done == arguments.runs && broken == 0,
        },
        none("runs with a mission that did not end", violated("stuck")),
        none("runs with a revived mission", violated("revived")),
        none("runs with two missions at once", violated("two_at_once")),
        none("runs with an end against its policy", violated("policy")),
        none("runs in which the sides disagree", violated("disagree")),
        none("runs with a record lost or doubled", violated("records")),
    ];
    Report {
        runs: arguments.runs,
        missions: total(|report| u64::try_from(report.ends.len()).unwrap_or(0)),
        server_kills: total(|report| report.server_kills),
        agent_kills: total(|report| report.agent_kills),
        cuts: total(|report| report.cuts),
        requests: total(|report| report.requests),
        ends: counted,
        failures: reports
            .into_iter()
            .filter(|report| !report.violations.is_empty())
            .collect(),
        checks,
    }
}
