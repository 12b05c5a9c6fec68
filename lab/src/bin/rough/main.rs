//! `rough`: tests the agents' estimates of θ on robots that differ from their model and simulator.
//!
//! `cargo run --release -p tread-lab --bin rough -- [--runs N] [--seed N] [--only TEXT]
//! [--tyres-straight] [--bounds N] [--drives FILE] [--json | --markdown]`
//!
//! Every agent is configured with the robot's data sheet; the robot drives in the rough world. A
//! line of the report is one difference, or the population, in which all deviations are drawn at
//! once, or a stratum of it. The report has the coverage of the 95 % intervals, the median error,
//! the median half-width, and the fraction of estimates that are missing or have a half-width above
//! 60 % of the value. With `--bounds` it compares some drives of each line with the Cramér–Rao
//! bound of θ.

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
use tread_lab::report::{Check, checks_json, page_markdown};
use tread_lab::rough::run::{ASKED_AT_S, Trial, run};

use lines::{CHANGES, alone, population};
use parameters::{ParameterLine, parameter_lines};
use score::{Drive, Line, POPULATION, half_width_checks, strata};

#[derive(Debug, Parser)]
#[command(name = "rough")]
struct Arguments {
    /// Number of drives of each line; the population has ten times as many
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// First seed
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Run only lines whose name contains this text
    #[arg(long, default_value = "")]
    only: String,
    /// Configure agents for tyres with a linear friction curve and no relaxation, instead of the
    /// default
    #[arg(long)]
    tyres_straight: bool,
    /// Number of drives of each line for which to compute the Cramér–Rao bound of θ
    #[arg(long, default_value_t = 0)]
    bounds: u32,
    /// Write each drive to this file, one JSON object per line
    #[arg(long, value_name = "FILE")]
    drives: Option<PathBuf>,
    /// Print one JSON object instead of tables
    #[arg(long, conflicts_with = "markdown")]
    json: bool,
    /// Print the tables in Markdown, for the page of the report
    #[arg(long)]
    markdown: bool,
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

/// Runs all drives in parallel.
fn drive(trials: Vec<Trial>) -> anyhow::Result<Vec<Drive>> {
    let outcomes = in_parallel(&trials, run);
    let drives = trials.into_iter().zip(outcomes);
    drives
        .map(|(trial, outcome)| Ok((trial, outcome?)))
        .collect()
}

/// Writes the drives of a line as JSON objects.
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
        .chain(half_width_checks(&lines))
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
        let tables = [score::table(&lines), parameters::table(&parameters)];
        if arguments.markdown {
            println!("{}", page_markdown(&tables, &checks));
        } else {
            println!("{}\n{}", tables[0], tables[1]);
        }
    }
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
