//! `robustness`: what agents command, and what they report of θ, while something goes wrong.
//!
//! `cargo run --release -p tread-lab --bin robustness -- [--runs N] [--seed N] [--only TEXT]
//! [--json | --markdown]`
//!
//! Robots, sensors and courses are those of the population of `rough`. Each drive has one disturbance,
//! after 30 s: a channel that fails, blocked wheels, a position that jumps, ground that becomes slippery
//! in a bend; or it starts beside the path. θ is read every second for 20 s.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use serde::Serialize;
use tread_lab::parallel::in_parallel;
use tread_lab::report::{Check, Part, Table, checks_json, page_markdown, percent};
use tread_lab::rough::disturbance::{
    CHANGE_FROM, Channel, ChannelFault, Disturbance, DisturbedTrial, run,
};

/// Minimum coverage of the 95 % intervals on each line.
const COVERAGE_MIN: f64 = 0.9;
/// Maximum fraction of drives with a confidently wrong estimate.
const CONFIDENTLY_WRONG_MAX: f64 = 0.02;
/// Delays of channels whose stamps do not say so.
const FAST_LATE: Duration = Duration::from_millis(60);
const POSITION_LATE: Duration = Duration::from_millis(500);
/// Durations of a blockage, and of a jump of the position that ends.
const BLOCKED: Duration = Duration::from_secs(2);
const JUMPED: Duration = Duration::from_secs(5);
/// Stiffness K of the ground that becomes slippery in a bend.
const CHANGE_TO: f64 = 0.3;

#[derive(Debug, Parser)]
#[command(name = "robustness")]
struct Arguments {
    /// Drives of each line
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    runs: u32,
    /// First seed
    #[arg(long, default_value_t = 6_000_001)]
    seed: u64,
    /// Run only lines whose name contains this text
    #[arg(long, default_value = "")]
    only: String,
    /// Print one JSON object instead of tables
    #[arg(long, conflicts_with = "markdown")]
    json: bool,
    /// Print the tables in Markdown, for the page of the report
    #[arg(long)]
    markdown: bool,
}

/// Drives with one disturbance.
#[derive(Debug, Serialize)]
struct Line {
    disturbance: String,
    has_torque: bool,
    drives: usize,
    /// Share of the drives whose robot stood at the end.
    stand: f64,
    /// Readings of θ that are estimates.
    estimates: usize,
    /// Share of those whose interval contains the true θ; none without estimates.
    coverage: Option<f64>,
    /// Share of the drives with an estimate that is off by more than twice its half-width.
    confidently_wrong: f64,
    /// Drives and ticks in which a command exceeded a limit.
    over_limit_drives: usize,
    over_limit_ticks: usize,
}

/// Returns the disturbances with their names.
fn disturbances() -> Vec<(String, Disturbance)> {
    let mut all = vec![
        ("nothing".to_owned(), Disturbance::None),
        (
            "start 2 m beside the path, in the opposite direction".to_owned(),
            Disturbance::StartAside,
        ),
        (
            "position 1 m off for 5 s".to_owned(),
            Disturbance::PositionJump { lasts: JUMPED },
        ),
        (
            "position 1 m off from then on".to_owned(),
            Disturbance::PositionJump {
                lasts: Duration::MAX,
            },
        ),
        (
            "left wheels blocked for 2 s".to_owned(),
            Disturbance::BlockedWheels { lasts: BLOCKED },
        ),
        (
            format!("K {CHANGE_FROM} to {CHANGE_TO} in a bend"),
            Disturbance::GroundChange {
                stiffness: CHANGE_TO,
            },
        ),
    ];
    let channels = [
        ("gyro", Channel::Gyro, Some(FAST_LATE)),
        ("accelerometer", Channel::Accelerometer, Some(FAST_LATE)),
        ("wheel speeds", Channel::WheelSpeeds, Some(FAST_LATE)),
        ("wheel torques", Channel::WheelTorques, Some(FAST_LATE)),
        ("speed over ground", Channel::BodySpeed, None),
        ("position", Channel::Position, Some(POSITION_LATE)),
    ];
    for (name, channel, late) in channels {
        let faults = [
            ("frozen".to_owned(), Some(ChannelFault::Frozen)),
            ("zero".to_owned(), Some(ChannelFault::Zero)),
            ("dropped".to_owned(), Some(ChannelFault::Dropped)),
            (
                format!("{} ms late", late.unwrap_or_default().as_millis()),
                late.map(ChannelFault::Late),
            ),
        ];
        for (how, fault) in faults {
            let disturbance = |fault| Disturbance::Channel { channel, fault };
            all.extend(fault.map(|fault| (format!("{name} {how}"), disturbance(fault))));
        }
    }
    all
}

/// Returns whether robots that measure no wheel torques can have this disturbance.
fn applies_without_torque(disturbance: Disturbance) -> bool {
    !matches!(
        disturbance,
        Disturbance::Channel {
            channel: Channel::WheelTorques,
            ..
        }
    )
}

fn line(
    arguments: &Arguments,
    (name, disturbance): &(String, Disturbance),
    has_torque: bool,
) -> anyhow::Result<Line> {
    let seeds = (arguments.seed..).take(arguments.runs as usize);
    let trials: Vec<DisturbedTrial> = seeds
        .map(|seed| DisturbedTrial::drawn(seed, has_torque, *disturbance))
        .collect();
    let (mut stand, mut estimates, mut covered, mut wrong) = (0, 0, 0, 0);
    let (mut over_limit_drives, mut over_limit_ticks) = (0, 0);
    for outcome in in_parallel(&trials, run) {
        let outcome = outcome?;
        stand += usize::from(outcome.stands);
        estimates += outcome.estimates;
        covered += outcome.covered;
        wrong += usize::from(outcome.is_confidently_wrong());
        over_limit_drives += usize::from(outcome.over_limit_ticks > 0);
        over_limit_ticks += outcome.over_limit_ticks;
    }
    Ok(Line {
        disturbance: name.clone(),
        has_torque,
        drives: trials.len(),
        stand: Part(stand).of(trials.len()),
        estimates,
        coverage: (estimates > 0).then(|| Part(covered).of(estimates)),
        confidently_wrong: Part(wrong).of(trials.len()),
        over_limit_drives,
        over_limit_ticks,
    })
}

fn table(lines: &[Line]) -> Table {
    let mut table = Table::new([
        "disturbance",
        "torque",
        "robot stands at the end",
        "estimates",
        "coverage",
        "confidently wrong",
        "over a limit",
    ]);
    for line in lines {
        table.row([
            line.disturbance.clone(),
            if line.has_torque { "yes" } else { "no" }.to_owned(),
            percent(line.stand),
            line.estimates.to_string(),
            line.coverage.map_or_else(|| "-".to_owned(), percent),
            percent(line.confidently_wrong),
            line.over_limit_ticks.to_string(),
        ]);
    }
    table
}

#[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
fn checks(line: &Line) -> Vec<Check> {
    let torque = if line.has_torque { "with" } else { "without" };
    let name = |what: &str| format!("{}, {torque} torque: {what}", line.disturbance);
    let over = line.over_limit_ticks as f64;
    let mut checks = vec![
        Check::of(name("ticks over a limit"), over).at_most(0.0),
        Check::of(
            name("drives that are confidently wrong"),
            line.confidently_wrong,
        )
        .at_most(CONFIDENTLY_WRONG_MAX),
    ];
    // Where nothing is reported nothing is wrong.
    checks.extend(line.coverage.map(|coverage| {
        Check::of(name("coverage of the 95 % intervals"), coverage).at_least(COVERAGE_MIN)
    }));
    checks
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let mut lines = Vec::new();
    for named in &disturbances() {
        if !named.0.contains(&arguments.only) {
            continue;
        }
        lines.push(line(&arguments, named, true)?);
        if applies_without_torque(named.1) {
            lines.push(line(&arguments, named, false)?);
        }
    }
    let checks: Vec<Check> = lines.iter().flat_map(checks).collect();
    if arguments.json {
        println!(
            "{}",
            serde_json::json!({ "lines": lines, "checks": checks_json(&checks) })
        );
    } else if arguments.markdown {
        println!("{}", page_markdown(&[table(&lines)], &checks));
    } else {
        println!("{}", table(&lines));
    }
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
