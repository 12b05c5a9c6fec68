//! `ground_change`: how soon agents detect that the ground has changed, and how often they do where it
//! has not, on robots unlike their simulator.
//!
//! `cargo run --release -p tread-lab --bin ground_change -- [--hours H] [--runs N] [--seed N]
//! [--json | --markdown]`
//!
//! Robots, sensors and courses are those of the population of `rough`. Drives without a change take ten
//! minutes each. In the others K changes from 5 to 1 and back under all wheels, after 30 to 54 s.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use serde::Serialize;
use tread_lab::parallel::in_parallel;
use tread_lab::random::Random;
use tread_lab::report::{Check, Part, Table, checks_json, page_markdown, percent};
use tread_lab::rough::ground_change::{ChangeTrial, run};
use tread_lab::rough::run::Course;
use tread_lab::rough::sensors::SensorSpec;
use tread_lab::rough::spec::{Deviations, MAKES};
use tread_lab::rough::width::Width;

/// Time of a drive without a change.
const QUIET: Duration = Duration::from_mins(10);
/// Number of drives without a change in one hour.
const QUIET_PER_HOUR: u32 = 6;
/// Laps of a drive without a change, and of one with a change.
const QUIET_LAPS: u32 = 18;
const CHANGE_LAPS: u32 = 3;
/// Maximum number of false alarms per hour.
const FALSE_PER_HOUR_MAX: f64 = 0.2;
/// Time within which a change from K 5 to 1 must be detected, seconds, and the minimum fraction of
/// drives in which it is.
const DELAY_MAX_S: f64 = 2.0;
const DETECTED_MIN: f64 = 0.95;

#[derive(Debug, Parser)]
#[command(name = "ground_change")]
struct Arguments {
    /// Hours without a change, half of them with wheel torque
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    hours: u32,
    /// Drives of each line with a change
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// First seed
    #[arg(long, default_value_t = 1_000_001)]
    seed: u64,
    /// Print one JSON object instead of tables
    #[arg(long, conflicts_with = "markdown")]
    json: bool,
    /// Print the tables in Markdown, for the page of the report
    #[arg(long)]
    markdown: bool,
}

/// Drives without a change.
#[derive(Debug, Serialize)]
struct UnchangedDrives {
    has_torque: bool,
    hours: f64,
    false_alarms: u64,
    /// Drives that had any.
    drives: usize,
}

/// Change of K.
#[derive(Debug, Clone, Copy)]
struct StiffnessChange {
    from: f64,
    to: f64,
}

/// Drives with a change.
#[derive(Debug, Serialize)]
struct Changed {
    from: f64,
    to: f64,
    has_torque: bool,
    drives: usize,
    /// Share of the drives in which θ was known when the ground changed.
    known: f64,
    /// Share of the drives in which the change was detected within two seconds, and at all.
    in_time: f64,
    detected: f64,
    /// Median delay, seconds; none if nothing was detected.
    delay_s: Option<f64>,
}

fn trial(seed: u64, has_torque: bool) -> ChangeTrial {
    let mut random = Random::new(seed ^ 0xc4a6);
    let mut trial = ChangeTrial {
        make: random.one_of(&MAKES).unwrap_or(MAKES[0]),
        deviations: Deviations::drawn(&mut random),
        sensors: SensorSpec::drawn(&mut random, has_torque),
        course: random
            .one_of(&[Course::Figure8, Course::Circle])
            .unwrap_or(Course::Figure8),
        laps: QUIET_LAPS,
        seed,
        before: QUIET,
        after: None,
    };
    trial.sensors = trial
        .sensors
        .with_drawn_inertial_unit(&mut random, Width::default());
    trial
}

fn quiet(arguments: &Arguments, has_torque: bool) -> anyhow::Result<UnchangedDrives> {
    let drives = arguments.hours * QUIET_PER_HOUR / 2;
    let seeds = (arguments.seed..).take(drives as usize);
    let trials: Vec<ChangeTrial> = seeds.map(|seed| trial(seed, has_torque)).collect();
    let mut line = UnchangedDrives {
        has_torque,
        hours: f64::from(drives) / f64::from(QUIET_PER_HOUR),
        false_alarms: 0,
        drives: 0,
    };
    for outcome in in_parallel(&trials, run) {
        let alarms = outcome?.false_alarms;
        line.false_alarms += alarms;
        line.drives += usize::from(alarms > 0);
    }
    Ok(line)
}

fn changed(
    arguments: &Arguments,
    change: StiffnessChange,
    has_torque: bool,
) -> anyhow::Result<Changed> {
    let StiffnessChange { from, to } = change;
    let seeds = (arguments.seed..).take(arguments.runs as usize);
    let trials: Vec<ChangeTrial> = seeds
        .map(|seed| {
            let mut trial = trial(seed, has_torque);
            let curve = &mut trial.deviations.curve;
            curve.stiffness = from;
            curve.mu_peak = curve.mu_peak.min(0.9 * from.min(to));
            ChangeTrial {
                laps: CHANGE_LAPS,
                before: Duration::from_secs(30) + Duration::from_millis(377) * (seed % 64) as u32,
                after: Some(to),
                ..trial
            }
        })
        .collect();
    let (mut delays, mut known) = (Vec::new(), 0);
    for outcome in in_parallel(&trials, run) {
        let outcome = outcome?;
        delays.extend(outcome.delay_s);
        known += usize::from(outcome.was_known);
    }
    delays.sort_by(f64::total_cmp);
    let in_time = delays
        .iter()
        .filter(|delay_s| **delay_s <= DELAY_MAX_S)
        .count();
    Ok(Changed {
        from,
        to,
        has_torque,
        drives: trials.len(),
        known: Part(known).of(trials.len()),
        in_time: Part(in_time).of(trials.len()),
        detected: Part(delays.len()).of(trials.len()),
        delay_s: delays.get(delays.len() / 2).copied(),
    })
}

fn with_or_without(has_torque: bool) -> &'static str {
    if has_torque {
        "with torque"
    } else {
        "without torque"
    }
}

fn quiet_table(lines: &[UnchangedDrives]) -> Table {
    let mut table = Table::new(["no change", "hours", "false alarms", "per hour"]);
    for line in lines {
        table.row([
            with_or_without(line.has_torque).to_owned(),
            format!("{:.1}", line.hours),
            line.false_alarms.to_string(),
            format!("{:.2}", false_per_hour(line)),
        ]);
    }
    table
}

fn change_table(lines: &[Changed]) -> Table {
    let mut table = Table::new([
        "change of K",
        "drives",
        "θ known before",
        "detected within 2 s",
        "detected",
        "median delay",
    ]);
    for line in lines {
        let torque = with_or_without(line.has_torque);
        let delay = |delay_s: f64| format!("{delay_s:.2} s");
        table.row([
            format!("{} to {}, {torque}", line.from, line.to),
            line.drives.to_string(),
            percent(line.known),
            percent(line.in_time),
            percent(line.detected),
            line.delay_s.map_or_else(|| "-".to_owned(), delay),
        ]);
    }
    table
}

#[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
fn false_per_hour(line: &UnchangedDrives) -> f64 {
    line.false_alarms as f64 / line.hours
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let quiet = [quiet(&arguments, true)?, quiet(&arguments, false)?];
    let mut lines = Vec::new();
    for (from, to) in [(5.0, 1.0), (1.0, 5.0)] {
        for has_torque in [true, false] {
            let change = StiffnessChange { from, to };
            lines.push(changed(&arguments, change, has_torque)?);
        }
    }
    let mut checks: Vec<Check> = quiet
        .iter()
        .map(|line| {
            let name = format!("false alarms per hour {}", with_or_without(line.has_torque));
            Check::of(name, false_per_hour(line)).at_most(FALSE_PER_HOUR_MAX)
        })
        .collect();
    checks.extend(lines.first().map(|line| {
        let name = "K 5 to 1 with torque: detected within 2 s";
        Check::of(name, line.in_time).at_least(DETECTED_MIN)
    }));
    if arguments.json {
        let object = serde_json::json!({
            "quiet": quiet, "changed": lines, "checks": checks_json(&checks),
        });
        println!("{object}");
    } else {
        let tables = [quiet_table(&quiet), change_table(&lines)];
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
