//! Accuracy of θ: bias, RMS error, coverage of the intervals, abstention.

use serde_json::{Value, json};
use tread_control::estimation::{MODEL_RATIO, TyrePrior};

use crate::drives::{Drive, Driven, SPEED_M_S};
use crate::report::{Check, Options, Section};
use crate::robot::{RobotSpec, SeededRobot, run_seeded};

/// Half-widths of the 50, 80 and 95 % intervals, standard deviations.
const WIDTHS: [f64; 3] = [0.6745, 1.2816, 1.9600];

/// Goal of a scenario.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Goal {
    /// The coverage goal, and an RMS error of at most `rms_max`, relative to θ, if given.
    Measures { rms_max: Option<f64> },
    /// No goal: the robot differs from its configuration.
    Reports,
    /// The estimator must abstain in every run.
    Abstains,
}

/// One line of the table.
pub(crate) struct Scenario {
    pub(crate) name: String,
    pub(crate) drive: Drive,
    pub(crate) robot: RobotSpec,
    pub(crate) goal: Goal,
}

/// One run's outcome.
struct Run {
    /// Error of θ; `None` if the estimator abstained.
    error: Option<RunError>,
    driven: Driven,
}

/// Error of one run's last θ.
#[derive(Debug, Clone, Copy)]
struct RunError {
    /// Error relative to the true θ.
    relative: f64,
    /// Error over the reported standard deviation.
    normalised: f64,
    /// Reported standard deviation relative to the true θ.
    std_dev: f64,
}

/// Figures of one scenario.
struct Figures {
    measured: f64,
    bias: f64,
    rms: f64,
    std_dev: f64,
    coverage: [f64; 3],
    ever_measured: f64,
    ever_informed: f64,
    /// Fraction of runs in which a segment stated information.
    ever_claimed: f64,
    false_alarms: u32,
    /// Coverage of the 95 % interval of each run's first measurement.
    first_coverage: f64,
    /// Coverage of the 95 % interval of θ fused from segments of about a metre, as the map fuses
    /// them.
    segment_coverage: f64,
    segment_rms: f64,
}

fn run_one(scenario: &Scenario, seed: u64) -> Run {
    let mut robot = SeededRobot::new(scenario.robot, scenario.drive.start(), seed);
    let driven = scenario.drive.run(&mut robot);
    let truth = scenario.robot.curve.theta();
    let found = robot.estimator.estimate().theta;
    Run {
        error: found.map(|found| {
            let error = found.theta - truth;
            RunError {
                relative: error / truth,
                normalised: error / found.std_dev,
                std_dev: found.std_dev / truth,
            }
        }),
        driven,
    }
}

fn figures(scenario: &Scenario, runs: &[Run]) -> Figures {
    let truth = scenario.robot.curve.theta();
    // The error of the torque constants, or of the model, is the robot's own: it is not in its
    // segments.
    let gain = if scenario.robot.has_torque {
        scenario.robot.noise.torque_gain_ratio * std::f64::consts::FRAC_1_SQRT_2
    } else {
        MODEL_RATIO
    };
    let firsts: Vec<f64> = runs
        .iter()
        .filter_map(|run| run.driven.first)
        .map(|(theta, std_dev)| (theta - truth) / std_dev)
        .collect();
    let fused: Vec<(f64, f64)> = runs
        .iter()
        .map(|run| run.driven.segments)
        .filter(|(information, _)| *information > 0.0)
        .map(|(information, weighted)| {
            let theta = weighted / information;
            let std_dev = information.recip().sqrt().hypot(gain * theta);
            ((theta - truth) / truth, (theta - truth) / std_dev)
        })
        .collect();
    let errors: Vec<RunError> = runs.iter().filter_map(|run| run.error).collect();
    #[expect(clippy::cast_precision_loss, reason = "counts of runs are small")]
    let share = |count: usize, of: usize| count as f64 / of as f64;
    let mean = |value: &dyn Fn(&RunError) -> f64| {
        errors.iter().map(value).sum::<f64>() * share(1, errors.len())
    };
    Figures {
        measured: share(errors.len(), runs.len()),
        bias: mean(&|error| error.relative),
        rms: mean(&|error| error.relative * error.relative).sqrt(),
        std_dev: mean(&|error| error.std_dev),
        coverage: WIDTHS.map(|width| {
            let is_held = |error: &&RunError| error.normalised.abs() < width;
            let held = errors.iter().filter(is_held).count();
            share(held, errors.len())
        }),
        ever_measured: share(
            runs.iter().filter(|run| run.driven.ever_measured).count(),
            runs.len(),
        ),
        ever_informed: share(
            runs.iter().filter(|run| run.driven.ever_informed).count(),
            runs.len(),
        ),
        ever_claimed: share(
            runs.iter()
                .filter(|run| run.driven.segments.0 > 0.0)
                .count(),
            runs.len(),
        ),
        false_alarms: runs.iter().map(|run| run.driven.ground_changes).sum(),
        first_coverage: share(
            firsts
                .iter()
                .filter(|error| error.abs() < WIDTHS[2])
                .count(),
            firsts.len(),
        ),
        segment_coverage: share(
            fused
                .iter()
                .filter(|error| error.1.abs() < WIDTHS[2])
                .count(),
            fused.len(),
        ),
        segment_rms: (fused.iter().map(|error| error.0 * error.0).sum::<f64>()
            * share(1, fused.len()))
        .sqrt(),
    }
}

/// Runs the part `theta` and returns its tables and checks.
pub(crate) fn run(options: &Options) -> Section {
    let mut section = measure(scenarios(), 0, options);
    // The average of all that is asked for.
    let coverages: Vec<f64> = section
        .checks
        .iter()
        .filter(|check| check.name.ends_with(INTERVALS_HOLD))
        .filter_map(|check| check.value)
        .collect();
    #[expect(clippy::cast_precision_loss, reason = "a count of scenarios")]
    let average = coverages.iter().sum::<f64>() / coverages.len() as f64;
    section.checks.push(
        Check::of("95 % intervals hold, all scenarios on average", average).between(0.94..=0.96),
    );
    section
}

/// End of the names of checks of coverage.
const INTERVALS_HOLD: &str = ": 95 % intervals hold";

/// Runs scenarios, each with the same seeds from `first_seed` on, and returns tables and checks.
pub(crate) fn measure(scenarios: Vec<Scenario>, first_seed: u64, options: &Options) -> Section {
    let mut text = String::from(
        "| scenario | bias % | RMS % | reported σ % | coverage of 50 % | of 80 % | of 95 % | abstains % | \
         false alarms | first-estimate coverage | segments RMS % | segment coverage |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let mut lines = Vec::new();
    let mut checks = Vec::new();
    for scenario in scenarios {
        let runs = run_seeded(options.runs, |seed| run_one(&scenario, first_seed + seed));
        let found = figures(&scenario, &runs);
        check(&scenario, &found, &mut checks);
        let [half, most, nearly_all] = found.coverage.map(|share| 100.0 * share);
        let row = format!(
            "| {} | {:.2} | {:.2} | {:.2} | {half:.1} | {most:.1} | {nearly_all:.1} | {:.1} | {} | {:.1} \
             | {:.2} | {:.1} |",
            scenario.name,
            100.0 * found.bias,
            100.0 * found.rms,
            100.0 * found.std_dev,
            100.0 * (1.0 - found.measured),
            found.false_alarms,
            100.0 * found.first_coverage,
            100.0 * found.segment_rms,
            100.0 * found.segment_coverage,
        );
        // A run that measured nothing has no error.
        text.push_str(&row.replace("NaN", "–"));
        text.push('\n');
        lines.push(line(&scenario.name, &found));
    }
    Section {
        text,
        figures: Value::Array(lines),
        checks,
    }
}

fn check(scenario: &Scenario, found: &Figures, checks: &mut Vec<Check>) {
    let name = &scenario.name;
    match scenario.goal {
        Goal::Reports => {}
        Goal::Abstains => {
            checks.push(
                Check::of(
                    format!("{name}: measured at some moment, share of runs"),
                    found.ever_measured,
                )
                .at_most(0.0),
            );
            checks.push(
                Check::of(
                    format!("{name}: new information at some moment, share of runs"),
                    found.ever_informed,
                )
                .at_most(0.0),
            );
            checks.push(
                Check::of(
                    format!("{name}: information in some segment, share of runs"),
                    found.ever_claimed,
                )
                .at_most(0.0),
            );
        }
        Goal::Measures { rms_max } => {
            if let Some(bound) = rms_max {
                checks.push(Check::of(format!("{name}: RMS error of θ"), found.rms).at_most(bound));
            }
            checks.push(
                Check::of(format!("{name}{INTERVALS_HOLD}"), found.coverage[2])
                    .between(0.925..=0.975),
            );
        }
    }
}

fn line(name: &str, found: &Figures) -> Value {
    json!({
        "scenario": name,
        "bias": found.bias, "rms": found.rms, "reported_std_dev": found.std_dev,
        "coverage_50": found.coverage[0], "coverage_80": found.coverage[1],
        "coverage_95": found.coverage[2], "abstention": 1.0 - found.measured,
        "ever_measured": found.ever_measured, "ever_informed": found.ever_informed,
        "ever_claimed": found.ever_claimed, "false_alarms": found.false_alarms,
        "first_coverage_95": found.first_coverage,
        "segment_rms": found.segment_rms,
        "segment_coverage_95": found.segment_coverage,
    })
}

fn scenarios() -> Vec<Scenario> {
    let mut all = Vec::new();
    with_torque(&mut all);
    without_torque(&mut all);
    sweeps(&mut all);
    tyres(&mut all);
    all
}

fn with_torque(all: &mut Vec<Scenario>) {
    for stiffness in [20.0, 5.0, 1.0] {
        for (gain, rms_max) in [(0.0, 0.01), (0.02, 0.03)] {
            for radius_m in [6.0, 2.4] {
                let mut robot = RobotSpec::on(stiffness);
                robot.has_torque = true;
                robot.noise.torque_gain_ratio = gain;
                all.push(Scenario {
                    name: format!(
                        "torque, circles R {radius_m} m, K {stiffness}, torque constant ±{} %",
                        100.0 * gain
                    ),
                    drive: Drive::StraightThenCircles {
                        radius_m,
                        speed_m_s: SPEED_M_S,
                    },
                    robot,
                    goal: Goal::Measures {
                        rms_max: Some(rms_max),
                    },
                });
            }
        }
    }
}

fn without_torque(all: &mut Vec<Scenario>) {
    for stiffness in [0.5, 1.0, 2.0, 5.0, 10.0, 20.0] {
        all.push(Scenario {
            name: format!("no torque, figure-8, K {stiffness}"),
            drive: Drive::Figure8,
            robot: RobotSpec::on(stiffness),
            goal: Goal::Measures {
                rms_max: (stiffness <= 10.0).then_some(0.10),
            },
        });
    }
    for stiffness in [0.5, 1.0, 2.0, 5.0] {
        all.push(Scenario {
            name: format!("no torque, stop and go, K {stiffness}"),
            drive: Drive::StopAndGo,
            robot: RobotSpec::on(stiffness),
            goal: Goal::Measures { rms_max: None },
        });
    }
    let mut aliasing = RobotSpec::on(5.0);
    aliasing.aliases = true;
    all.push(Scenario {
        name: "no torque, stop and go, K 5, samples that alias".to_owned(),
        drive: Drive::StopAndGo,
        robot: aliasing,
        goal: Goal::Reports,
    });
    for (name, drive) in [
        ("straight", Drive::SteadyStraight),
        ("circle", Drive::SteadyCircle),
    ] {
        for stiffness in [0.5, 5.0] {
            all.push(Scenario {
                name: format!("no torque, steady {name}, K {stiffness}"),
                drive,
                robot: RobotSpec::on(stiffness),
                goal: Goal::Abstains,
            });
        }
    }
}

/// Returns the drive of the sweeps for a robot with or without wheel torque, and its name.
fn usual_drive(has_torque: bool) -> (Drive, &'static str) {
    if has_torque {
        let circles = Drive::StraightThenCircles {
            radius_m: 6.0,
            speed_m_s: SPEED_M_S,
        };
        (circles, "torque, circles R 6 m")
    } else {
        (Drive::Figure8, "no torque, figure-8")
    }
}

fn sweeps(all: &mut Vec<Scenario>) {
    let mut push = |name: String, change: &dyn Fn(&mut RobotSpec)| {
        for has_torque in [true, false] {
            let mut robot = RobotSpec::on(5.0);
            robot.has_torque = has_torque;
            change(&mut robot);
            let (drive, what) = usual_drive(has_torque);
            all.push(Scenario {
                name: format!("{what}, K 5, {name}"),
                drive,
                robot,
                goal: Goal::Measures { rms_max: None },
            });
        }
    };
    for error in [0.0, 0.01] {
        push(format!("radii ±{} %", 100.0 * error), &move |robot| {
            robot.radius_error_max = error;
            // Evenly spread up to it.
            robot.noise.radius_ratio = (error / 3.0_f64.sqrt()).max(1.0e-4);
        });
    }
    for lag_s in [0.0, 0.1] {
        push(format!("lag {lag_s} s"), &move |robot| {
            robot.servo_lag_s = lag_s;
        });
    }
    for offset_m_s2 in [0.0, 0.1] {
        push(
            format!("accelerometer offset ±{offset_m_s2} m/s²"),
            &move |robot| robot.noise.accelerometer_offset_m_s2 = offset_m_s2,
        );
    }
    push("samples that alias".to_owned(), &|robot| {
        robot.aliases = true;
    });
    for ratio in [0.7, 1.4] {
        push(format!("lateral stiffness × {ratio}"), &move |robot| {
            robot.tyres.lateral_stiffness_ratio = ratio;
        });
    }
}

/// Adds scenarios with brush tyres; the true θ is the initial slope of their curve.
fn tyres(all: &mut Vec<Scenario>) {
    // κ = 1/(3λ_m) of 0.46 to 2.88, mean 1.67, standard deviation 0.7, at θ = 0.2.
    let brush = TyrePrior {
        curvature: 0.2 * 1.67,
        curvature_std_dev: 0.2 * 0.7,
        ..TyrePrior::default()
    };
    for (who, configured_tyres, goal) in [
        (
            "configured for a straight rise",
            TyrePrior::default(),
            Goal::Reports,
        ),
        (
            "configured for a brush",
            brush,
            Goal::Measures { rms_max: None },
        ),
    ] {
        for has_torque in [true, false] {
            let mut robot = RobotSpec::on(5.0);
            robot.has_torque = has_torque;
            robot.curvatures = Some([0.46, 2.88]);
            robot.configured_tyres = configured_tyres;
            let (drive, what) = usual_drive(has_torque);
            all.push(Scenario {
                name: format!("{what}, K 5, brush tyres, {who}"),
                drive,
                robot,
                goal,
            });
        }
    }
}
