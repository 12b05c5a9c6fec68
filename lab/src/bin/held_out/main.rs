//! `held_out`: tests the agents' estimates of θ on robots of a simulator that is not ours.
//!
//! `cargo run --release -p tread-lab --bin held_out -- [--runs N] [--seed N] [--contacts NAME]
//! [--world NAME] [--steps N] [--drives FILE] [--json | --markdown]`
//!
//! The robots are those of `lab/ode/robot.cpp`, on the contacts of the Open Dynamics Engine. They are
//! drawn from the distributions of the rough world, made 1.3 times wider. Agents are as shipped and know
//! the data sheet. Each robot drives twice: with measured torque, and without. Answers are read at the
//! times of `rough`. Contacts are of three kinds (`Contacts`). The report has the coverage of the 95 % intervals, in all and for each ground, with
//! the goal; the share of answers that abstain, which have a half-width above 60 % of the value or no
//! estimate; and what shows that the simulator is right: θ by pulling robots with known forces, and
//! the difference that smaller integration steps make.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

mod score;
mod simulator;

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::Context;
use clap::Parser;
use tread_lab::held_out::process::{Contacts, OdeProgram, STEPS_PER_SAMPLE};
use tread_lab::held_out::{drawn, run};
use tread_lab::parallel::in_parallel;
use tread_lab::report::{Check, checks_json, checks_markdown};
use tread_lab::rough::run::{self as rough, ASKED_AT_S, Trial};

use score::{Drive, Group, Line};
use simulator::Simulator;

/// Number of drives after which progress is printed.
const PROGRESS_EVERY: usize = 20;
/// Number of robots on rigid contacts for each robot on other contacts.
const OTHERS_SHARE: u32 = 3;

/// World in which robots drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum World {
    /// The simulator that is not ours.
    Ode,
    /// The same robots in the rough world.
    Rough,
}

#[derive(Debug, Parser)]
#[command(name = "held_out")]
struct Arguments {
    /// Number of robots on rigid contacts; a third of them drives on each of the others. Each drives
    /// with torque and without
    #[arg(long, default_value_t = 240, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// First seed
    #[arg(long, default_value_t = 9_000_001)]
    seed: u64,
    /// Drive on these contacts alone [default: all]
    #[arg(long, value_enum)]
    contacts: Option<Contacts>,
    /// Integration steps in a sample of 10 ms
    #[arg(long, default_value_t = STEPS_PER_SAMPLE, value_parser = clap::value_parser!(u32).range(10..=1_000))]
    steps: u32,
    /// World in which the robots drive; `rough` shows what the wider distributions alone do, with
    /// that world's contacts instead of rigid ones
    #[arg(long, value_enum, default_value_t = World::Ode)]
    world: World,
    /// Write each drive to this file, one JSON object per line
    #[arg(long, value_name = "FILE")]
    drives: Option<PathBuf>,
    /// Print one JSON object instead of tables
    #[arg(long, conflicts_with = "markdown")]
    json: bool,
    /// Print the tables in Markdown
    #[arg(long)]
    markdown: bool,
}

/// Runs all drives in parallel, with progress on standard error.
fn drive(program: &OdeProgram, group: Group, arguments: &Arguments) -> anyhow::Result<Vec<Drive>> {
    let runs = if arguments.contacts.is_some() || group.contacts == Contacts::Rigid {
        arguments.runs
    } else {
        arguments.runs.div_ceil(OTHERS_SHARE)
    };
    let trials: Vec<Trial> = (0..u64::from(runs))
        .map(|index| drawn(arguments.seed + index, group.has_torque))
        .collect();
    let (done, count) = (AtomicUsize::new(0), trials.len());
    let outcomes = in_parallel(&trials, |trial| {
        let outcome = match arguments.world {
            World::Ode => run(program, trial, group.contacts, arguments.steps),
            World::Rough => rough::run(trial),
        };
        let outcome = outcome.with_context(|| format!("the drive of seed {} failed", trial.seed));
        let done = done.fetch_add(1, Ordering::Relaxed) + 1;
        if done.is_multiple_of(PROGRESS_EVERY) || done == count {
            let (contacts, torque) = (group.contacts.text(), group.torque());
            eprintln!("held_out: {contacts}, {torque} torque: {done} of {count} drives");
        }
        outcome
    });
    let drives = trials.into_iter().zip(outcomes);
    drives
        .map(|(trial, outcome)| Ok((trial, outcome?)))
        .collect()
}

/// Writes drives as JSON objects.
fn write(file: &mut impl Write, group: Group, drives: &[Drive]) -> anyhow::Result<()> {
    for (trial, outcome) in drives {
        let said = outcome
            .said
            .map(|said| said.map(|said| [said.theta, said.std_dev]));
        let object = serde_json::json!({
            "contacts": group.contacts,
            "make": trial.make.name,
            "course": trial.course.text(),
            "seed": trial.seed,
            "deviations": trial.deviations,
            "sensors": trial.sensors,
            "theta": outcome.truth,
            "beyond_half_peak": outcome.beyond_half_peak,
            "asked_at_s": ASKED_AT_S,
            "theta_and_std_dev": said,
        });
        writeln!(file, "{object}")?;
    }
    Ok(())
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let exe = std::env::current_exe().context("cannot find this program's folder")?;
    let folder = exe.parent().context("this program is in no folder")?;
    let program = OdeProgram::build(folder)?;
    let mut file = match &arguments.drives {
        Some(path) => {
            let file =
                File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
            Some(BufWriter::new(file))
        }
        None => None,
    };
    let simulator = Simulator::tested(&program)?;
    let mut lines = Vec::new();
    for contacts in Contacts::ALL {
        let is_left_out = arguments.contacts.is_some_and(|only| only != contacts);
        if is_left_out || (arguments.world == World::Rough && contacts != Contacts::Rigid) {
            continue;
        }
        for has_torque in [true, false] {
            let group = Group {
                contacts,
                has_torque,
            };
            let drives = drive(&program, group, &arguments)?;
            if let Some(file) = &mut file {
                write(file, group, &drives)?;
            }
            lines.extend(score::lines(group, &drives));
        }
    }
    if let Some(mut file) = file {
        file.flush()?;
    }
    let of_lines = lines.iter().filter_map(Line::check);
    let checks: Vec<Check> = of_lines.chain(simulator.checks()).collect();
    if arguments.json {
        println!(
            "{}",
            serde_json::json!({
                "lines": lines,
                "simulator": simulator,
                "checks": checks_json(&checks),
            })
        );
    } else if arguments.markdown {
        println!(
            "## Coverage\n\n{}\n## The simulator\n\n{}\n## Goals\n\n{}",
            score::markdown(&lines),
            simulator.markdown(),
            checks_markdown(&checks)
        );
    } else {
        println!("{}\n{}", score::text(&lines), simulator.text());
        for check in &checks {
            let (verdict, figure) = (check.verdict(), check.figure(4));
            println!(
                "{verdict}  {:<72} {figure:>9}  goal {}",
                check.name, check.goal
            );
        }
    }
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
