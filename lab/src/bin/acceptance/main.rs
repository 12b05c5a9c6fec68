//! `acceptance`: all figures on θ and tracking that have a goal, in one run.
//!
//! `cargo run --release -p tread-lab --bin acceptance -- [--only TEXT] [--programs FOLDER]
//! [--reports FOLDER | --summarise FOLDER] [--json | --markdown]`
//!
//! Runs the report programs one after the other, each on all cores and with the first seeds of its page in
//! `docs/reports`, and summarises their checks by requirement. A program that fails is a check that does not
//! hold. The programs must have been built; their folder is that of this program.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

mod programs;
mod requirements;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::Parser;
use serde_json::json;
use tread_lab::report::{Check, Table, checks_json, checks_markdown, page_markdown};

use programs::{PROGRAMS, Program, Run, now};
use requirements::{Summary, missing_figures_check, summaries};

/// Maximum duration of all programs on two cores, minutes.
const MINUTES_MAX: f64 = 60.0;

/// Runs all report programs on θ and tracking, and summarises their checks.
///
/// Takes less than an hour on two cores. Build the programs first:
/// `cargo build --release -p tread-lab -p tread-tests --bins` and
/// `cargo build --release -p tread-control --example cost`.
#[derive(Debug, Parser)]
#[command(name = "acceptance")]
struct Arguments {
    /// Run only programs whose name contains this text
    #[arg(long, default_value = "")]
    only: String,
    /// Folder of the programs [default: that of this program]
    #[arg(long, value_name = "FOLDER")]
    programs: Option<PathBuf>,
    /// Write what each program prints to `NAME.json` in this folder
    #[arg(long, value_name = "FOLDER")]
    reports: Option<PathBuf>,
    /// Summarise the reports in this folder, which `--reports` wrote, instead of running the programs
    #[arg(long, value_name = "FOLDER", conflicts_with = "reports")]
    summarise: Option<PathBuf>,
    /// Print one JSON object instead of tables
    #[arg(long, conflicts_with = "markdown")]
    json: bool,
    /// Print the tables in Markdown, for the page of the report
    #[arg(long)]
    markdown: bool,
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let folder = if let Some(folder) = &arguments.programs {
        folder.clone()
    } else {
        let exe = std::env::current_exe().context("cannot find this program's folder")?;
        let folder = exe.parent().context("this program is in no folder")?;
        folder.to_owned()
    };
    let chosen: Vec<_> = PROGRAMS
        .iter()
        .filter(|program| program.name.contains(&arguments.only))
        .collect();
    anyhow::ensure!(
        !chosen.is_empty(),
        "no program is named like `{}`",
        arguments.only
    );
    if arguments.summarise.is_none() {
        // All are there before the first one takes half an hour.
        for program in &chosen {
            program.path(&folder)?;
        }
    }
    if let Some(reports) = &arguments.reports {
        std::fs::create_dir_all(reports)
            .with_context(|| format!("cannot create {}", reports.display()))?;
    }
    let begin = now();
    let mut runs = Vec::new();
    for (number, program) in chosen.iter().enumerate() {
        eprintln!("acceptance: {} of {}: {program}", number + 1, chosen.len());
        let run = match &arguments.summarise {
            Some(reports) => program.kept(reports).and_then(|output| output.read()),
            None => run(program, &folder, arguments.reports.as_deref()),
        };
        let run = run.unwrap_or_else(|error| Run::failed(**program, &error));
        eprintln!("acceptance: {run}");
        runs.push(run);
    }
    let minutes = begin.elapsed().as_secs_f64() / 60.0;
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let duration = Check::of(format!("minutes on {cores} cores"), minutes).at_most(MINUTES_MAX);
    let duration = arguments.summarise.is_none().then_some(duration);
    let summaries = summaries(&runs);
    let mut checks: Vec<Check> = runs.iter().flat_map(Run::named_checks).collect();
    checks.push(missing_figures_check(&summaries));
    checks.extend(duration.clone());
    for missed in checks.iter().filter(|check| !check.holds) {
        let (name, goal, value) = (&missed.name, &missed.goal, missed.figure(3));
        eprintln!("acceptance: not reached: {name}: {value}, goal {goal}");
    }
    if arguments.json {
        let object = json!({
            "programs": runs.iter().map(Run::json).collect::<Vec<_>>(),
            "requirements": summaries,
            "checks": checks_json(&checks),
        });
        println!("{object}");
    } else {
        let missed: Vec<&Check> = checks.iter().filter(|check| !check.holds).collect();
        let table = table(&summaries);
        if arguments.markdown {
            println!("{}", page_markdown(&[table], missed));
        } else {
            println!("{table}");
            if let Some(duration) = &duration {
                println!("{}: {}", duration.name, duration.figure(1));
            }
            if !missed.is_empty() {
                println!("\nnot reached:\n{}", checks_markdown(missed));
            }
        }
    }
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

/// Runs a program and keeps its report in the folder `reports`, if there is one.
fn run(program: &Program, programs: &Path, reports: Option<&Path>) -> anyhow::Result<Run> {
    let output = program.run(programs)?;
    if let Some(reports) = reports {
        let path = program.report_path(reports);
        std::fs::write(&path, &output.report)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    output.read()
}

fn table(summaries: &[Summary]) -> Table {
    let mut table = Table::new([
        "requirement",
        "program",
        "goal",
        "figures",
        "reached",
        "lowest",
        "highest",
    ]);
    let figure =
        |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.3}"));
    for summary in summaries {
        table.row([
            summary.requirement.to_owned(),
            summary.program.to_owned(),
            summary.goals.join("; "),
            summary.figures.to_string(),
            summary.reached.to_string(),
            figure(summary.lowest),
            figure(summary.highest),
        ]);
    }
    table
}
