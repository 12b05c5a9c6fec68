//! `rough`: whether what agents say of the ground holds on robots unlike their own simulator.
//!
//! `cargo run --release -p tread-lab --bin rough -- [--runs N] [--seed N] [--only TEXT]
//! [--tyres-straight] [--json]`
//!
//! Every robot is configured with its data sheet and drives in the rough world. A line is one way
//! of being different, or the population, in which everything differs at once. Printed are the
//! share of 95 % intervals that hold the true θ, the median error, the median half-width and the
//! share of answers without an interval, or with one wider than 60 % of its value, which says as
//! little.

#![expect(clippy::print_stdout, reason = "a program that prints a report")]

use std::ops::RangeInclusive;
use std::process::ExitCode;

use clap::Parser;
use serde::Serialize;
use tread_api::friction::NORMAL_95;
use tread_control::estimation::{EstimatorPrior, TyrePrior};
use tread_lab::parallel::in_parallel;
use tread_lab::random::Random;
use tread_lab::report::{Check, checks_json};
use tread_lab::rough::curve::Shape;
use tread_lab::rough::run::{Course, Outcome, Trial, run};
use tread_lab::rough::sensors::SensorSpec;
use tread_lab::rough::spec::{Deviations, MAKES};

/// Half-width over value above which an interval counts as none.
const WIDE_RATIO: f64 = 0.6;
/// Coverage that one deviation must have.
const LINE_GOAL: RangeInclusive<f64> = 0.9..=1.0;
/// Coverage that the population must have.
const POPULATION_GOAL: RangeInclusive<f64> = 0.93..=0.975;
/// Name of the line in which everything differs.
const POPULATION: &str = "population";

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

#[derive(Debug, Serialize)]
struct Line {
    name: String,
    has_torque: bool,
    estimates: usize,
    /// Share of the estimates whose 95 % interval holds the true θ.
    coverage: f64,
    /// The same on each of [`GROUNDS`].
    coverage_on: [f64; GROUNDS.len()],
    /// Median of θ̂/θ − 1.
    error: f64,
    /// Median half-width of the 95 % interval over its value.
    half_width: f64,
    /// Share of answers that say nothing.
    abstained: f64,
    /// Share of the time in which a contact slipped beyond half the slip of the peak.
    beyond_half_peak: f64,
}

impl Line {
    fn check(&self) -> Check {
        let torque = if self.has_torque { "with" } else { "without" };
        let name = format!(
            "{}, {torque} torque: coverage of the 95 % intervals",
            self.name
        );
        Check::between(
            name,
            self.coverage,
            if self.name == POPULATION {
                POPULATION_GOAL
            } else {
                LINE_GOAL
            },
        )
    }
}

/// Stiffnesses K of the grounds.
const GROUNDS: [f64; 3] = [0.7, 3.0, 12.0];

type Change = fn(&mut Deviations);

/// Deviations, one at a time.
const CHANGES: [(&str, Change); 22] = [
    ("nothing", |_| {}),
    ("payload 20 %", |robot| {
        robot.payload_ratio = 0.2;
    }),
    ("payload -10 %", |robot| {
        robot.payload_ratio = -0.1;
    }),
    ("yaw inertia +25 %", |robot| {
        robot.inertia_ratio = 1.25;
    }),
    ("yaw inertia -20 %", |robot| {
        robot.inertia_ratio = 0.8;
    }),
    ("brush, peak 0.3", |robot| {
        bent(robot, Shape::Brush, 0.3);
    }),
    ("brush, peak 0.8", |robot| {
        bent(robot, Shape::Brush, 0.8);
    }),
    ("Magic Formula, peak 0.5", |robot| {
        bent(robot, Shape::MagicFormula, 0.5);
    }),
    ("LuGre, peak 0.6", |robot| {
        bent(robot, Shape::LuGre, 0.6);
    }),
    ("relaxation 1 cm", |robot| {
        robot.relaxation_m = 0.01;
    }),
    ("relaxation 5 cm", |robot| {
        robot.relaxation_m = 0.05;
    }),
    ("torque scale +3 %", |robot| robot.torque_scale = [1.03; 2]),
    ("torque scale -3 %", |robot| robot.torque_scale = [0.97; 2]),
    ("rotors 10 %, gears 3 %", |robot| {
        robot.rotor_ratio = 0.1;
        robot.gear_loss_ratio = 0.03;
    }),
    ("center of mass 5 % forward", |robot| {
        robot.center_forward_ratio = 0.05;
    }),
    ("center of mass 5 % rearward", |robot| {
        robot.center_forward_ratio = -0.05;
    }),
    ("center of mass 3 % left", |robot| {
        robot.center_left_ratio = 0.03;
    }),
    ("center of mass 3 % right", |robot| {
        robot.center_left_ratio = -0.03;
    }),
    ("slope 5°", |robot| {
        robot.slope_rad = [0.0, 5.0_f64.to_radians()];
    }),
    ("slope -5°", |robot| {
        robot.slope_rad = [0.0, -5.0_f64.to_radians()];
    }),
    ("rolling resistance 4 %", |robot| {
        robot.rolling_resistance_ratio = 0.04;
    }),
    ("servo lag 0.1 s", |robot| {
        robot.servo_lag_s = 0.1;
    }),
];

fn bent(robot: &mut Deviations, shape: Shape, mu_peak: f64) {
    robot.curve.shape = shape;
    robot.curve.mu_peak = mu_peak.min(0.9 * robot.curve.stiffness);
}

/// The drives of one way of being different: the paper's robot on three grounds and two courses.
fn alone(change: Change, has_torque: bool, arguments: &Arguments) -> Vec<Trial> {
    let trial = |index: u32| {
        let stiffness = GROUNDS[index as usize % GROUNDS.len()];
        let mut deviations = Deviations::none(stiffness);
        change(&mut deviations);
        let is_circle = (index / 3).is_multiple_of(2);
        Trial {
            make: MAKES[0],
            deviations,
            sensors: SensorSpec::usual(has_torque),
            course: if is_circle {
                Course::Circle
            } else {
                Course::Figure8
            },
            seed: arguments.seed + u64::from(index),
            prior: arguments.prior(),
        }
    };
    (0..arguments.runs).map(trial).collect()
}

/// Robots of all makes in which everything differs.
fn population(has_torque: bool, runs: u32, arguments: &Arguments) -> Vec<Trial> {
    let trial = |index: u32| {
        let seed = arguments.seed + u64::from(index);
        let mut random = Random::new(seed ^ 0x5eed);
        Trial {
            make: random.one_of(&MAKES).unwrap_or(MAKES[0]),
            deviations: Deviations::drawn(&mut random),
            sensors: SensorSpec::drawn(&mut random, has_torque),
            course: random
                .one_of(&[Course::Figure8, Course::Circle])
                .unwrap_or(Course::Figure8),
            seed,
            prior: arguments.prior(),
        }
    };
    (0..runs).map(trial).collect()
}

/// Drives them all, on all processors.
fn drive(trials: &[Trial]) -> anyhow::Result<Vec<Outcome>> {
    in_parallel(trials, run).into_iter().collect()
}

fn median(figures: &mut [f64]) -> f64 {
    figures.sort_by(f64::total_cmp);
    figures.get(figures.len() / 2).copied().unwrap_or(0.0)
}

#[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
fn share(part: usize, of: usize) -> f64 {
    part as f64 / of.max(1) as f64
}

fn line(name: &str, has_torque: bool, outcomes: &[Outcome]) -> Line {
    let (mut errors, mut widths, mut beyond) = (Vec::new(), Vec::new(), Vec::new());
    let (mut held, mut asked, mut on) = (0, 0, [(0, 0); GROUNDS.len()]);
    for outcome in outcomes {
        beyond.push(outcome.beyond_half_peak);
        for said in outcome.said {
            asked += 1;
            let Some(said) = said else { continue };
            let half_width = NORMAL_95 * said.std_dev / said.theta;
            if half_width > WIDE_RATIO {
                continue;
            }
            errors.push(said.theta / outcome.truth - 1.0);
            widths.push(half_width);
            let (low, high) = said.interval_95();
            let holds = usize::from((low..=high).contains(&outcome.truth));
            held += holds;
            let ground = |stiffness: &f64| (outcome.truth * stiffness - 1.0).abs() < 0.01;
            if let Some(ground) = GROUNDS.iter().position(ground) {
                on[ground].0 += holds;
                on[ground].1 += 1;
            }
        }
    }
    Line {
        name: name.to_owned(),
        has_torque,
        estimates: errors.len(),
        coverage: share(held, errors.len()),
        coverage_on: on.map(|(held, of)| share(held, of)),
        error: median(&mut errors),
        half_width: median(&mut widths),
        abstained: 1.0 - share(errors.len(), asked),
        beyond_half_peak: median(&mut beyond),
    }
}

fn print(lines: &[Line]) {
    println!(
        "{:<28} {:>6} {:>9} {:>9} {:>20} {:>9} {:>9} {:>9} {:>9}",
        "", "torque", "estimates", "held", "on K 0.7, 3, 12", "error", "± half", "none", "> ½ peak"
    );
    for line in lines {
        println!(
            "{:<28} {:>6} {:>9} {:>8.1}% {:>20} {:>+8.1}% {:>8.1}% {:>8.1}% {:>8.1}%{}",
            line.name,
            if line.has_torque { "yes" } else { "no" },
            line.estimates,
            100.0 * line.coverage,
            line.coverage_on
                .map(|held| format!("{:.0}", 100.0 * held))
                .join(" "),
            100.0 * line.error,
            100.0 * line.half_width,
            100.0 * line.abstained,
            100.0 * line.beyond_half_peak,
            if line.check().holds { "" } else { "  MISSED" },
        );
    }
}

fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let mut lines = Vec::new();
    for has_torque in [true, false] {
        for (name, change) in CHANGES {
            if name.contains(&arguments.only) {
                let trials = alone(change, has_torque, &arguments);
                lines.push(line(name, has_torque, &drive(&trials)?));
            }
        }
        if POPULATION.contains(&arguments.only) {
            let runs = arguments.runs.saturating_mul(10);
            let trials = population(has_torque, runs, &arguments);
            lines.push(line(POPULATION, has_torque, &drive(&trials)?));
        }
    }
    anyhow::ensure!(
        !lines.is_empty(),
        "no line is named like `{}`",
        arguments.only
    );
    let checks: Vec<Check> = lines.iter().map(Line::check).collect();
    if arguments.json {
        println!(
            "{}",
            serde_json::json!({ "lines": lines, "checks": checks_json(&checks) })
        );
    } else {
        print(&lines);
    }
    Ok(if checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
