//! `rough`: whether what agents report of the ground holds on robots unlike their own simulator.
//!
//! `cargo run --release -p tread-lab --bin rough -- [--runs N] [--seed N] [--only TEXT]
//! [--tyres-straight] [--bounds N] [--drives FILE] [--json]`
//!
//! Every robot is configured with its data sheet and drives in the rough world. A line is one way
//! of being different, or the population, in which everything differs at once, and its strata.
//! Printed are the coverage of the 95 % intervals, the median error, the median half-width and the
//! share of answers without an interval, or with one wider than 60 % of its value, which says as
//! little. With `--bounds` some drives of each line are set against how well θ could be known.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

mod lines;
mod parameters;
mod score;

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::Parser;
use tread_control::estimation::{EstimatorPrior, TyrePrior};
use tread_lab::parallel::in_parallel;
use tread_lab::report::{Check, checks_json};
use tread_lab::rough::run::{ASKED_AT_S, Trial, run};

use lines::{CHANGES, alone, population};
use parameters::{ParameterLine, parameter_lines};
use score::{Drive, Line, POPULATION, print, strata};

#[derive(Debug, Parser)]
#[command(name = "rough")]
struct Arguments {
    /// Drives of each line; the population has ten times as many
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// First seed
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Only lines whose name contains this
    #[arg(long, default_value = "")]
    only: String,
    /// Configure agents for tyres that rise straight at once, instead of the default
    #[arg(long)]
    tyres_straight: bool,
    /// Drives of each line of which to work out how well θ could be known
    #[arg(long, default_value_t = 0)]
    bounds: u32,
    /// Write each drive there, one JSON object a line
    #[arg(long, value_name = "FILE")]
    drives: Option<PathBuf>,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

impl Arguments {
    fn prior(&self) -> EstimatorPrior {
        let mut prior = EstimatorPrior::default();
        if self.tyres_straight {
            prior.tyres = TyrePrior::default();
        }
        prior
    }
}

/// Drives them all, on all processors.
fn drive(trials: Vec<Trial>) -> anyhow::Result<Vec<Drive>> {
    let outcomes = in_parallel(&trials, run);
    let drives = trials.into_iter().zip(outcomes);
    drives
        .map(|(trial, outcome)| Ok((trial, outcome?)))
        .collect()
}

/// Writes each drive of a line.
fn write(file: &mut impl Write, name: &str, drives: &[Drive]) -> anyhow::Result<()> {
    for (trial, outcome) in drives {
        let said = outcome
            .said
            .map(|said| said.map(|said| [said.theta, said.std_dev]));
        let object = serde_json::json!({
            "line": name,
            "make": trial.make.name,
            "course": trial.course.text(),
            "seed": trial.seed,
            "deviations": trial.deviations,
            "sensors": trial.sensors,
            "theta": outcome.truth,
            "beyond_half_peak": outcome.beyond_half_peak,
            "asked_at_s": ASKED_AT_S,
            "theta_and_std_dev": said,
            "bounds": outcome.bounds,
        });
        writeln!(file, "{object}")?;
    }
    Ok(())
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let mut file = match &arguments.drives {
        Some(path) => {
            let file =
                File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
            Some(BufWriter::new(file))
        }
        None => None,
    };
    let (mut lines, mut parameters) = (Vec::new(), Vec::new());
    for has_torque in [true, false] {
        let one_change = CHANGES
            .into_iter()
            .map(|(name, change)| (name, alone(change, has_torque, &arguments)));
        let all = (POPULATION, population(has_torque, &arguments));
        for (name, trials) in one_change.chain([all]) {
            if !name.contains(&arguments.only) {
                continue;
            }
            let drives = drive(trials)?;
            if let Some(file) = &mut file {
                write(file, name, &drives)?;
            }
            lines.push(Line::of(
                name,
                has_torque,
                &drives.iter().collect::<Vec<_>>(),
            ));
            if name == POPULATION {
                lines.extend(strata(has_torque, &drives));
                parameters.extend(parameter_lines(has_torque, &drives));
            }
        }
    }
    anyhow::ensure!(
        !lines.is_empty(),
        "no line is named like `{}`",
        arguments.only
    );
    if let Some(mut file) = file {
        file.flush()?;
    }
    let of_parameters = parameters.iter().map(ParameterLine::check);
    let checks: Vec<Check> = lines
        .iter()
        .flat_map(Line::checks)
        .chain(of_parameters)
        .collect();
    if arguments.json {
        println!(
            "{}",
            serde_json::json!({
                "lines": lines,
                "parameters": parameters,
                "checks": checks_json(&checks),
            })
        );
    } else {
        print(&lines);
        parameters::print(&parameters);
    }
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
