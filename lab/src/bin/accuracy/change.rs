//! Delay of the change detection, and its false alarms on unchanged ground.

use std::fmt::Write as _;

use serde_json::{Value, json};
use tread_control::friction::FrictionCurve;
use tread_control::geometry::{Pose, Twist};
use tread_control::plant::Ground;
use tread_control::robot::RobotModel;

use crate::drives::SPEED_M_S;
use crate::report::{Check, Options, Section};
use crate::robot::{LOOP_S, RobotSpec, SeededRobot, run_seeded};

/// Time before the change, in which the first ground is measured, seconds.
const BEFORE_S: f64 = 45.0;
/// Time after the change in which it must be detected, seconds.
const AFTER_S: f64 = 15.0;
/// Time of one run without change, seconds.
const QUIET_S: f64 = 300.0;
/// Number of runs with a change for each run without; the latter are longer.
const CHANGES_PER_QUIET: u32 = 4;

/// A change from one ground to another, with the goal of its detection.
struct GroundTransition {
    theta_before: f64,
    theta_after: f64,
    has_torque: bool,
    /// Maximum mean delay, seconds; `None` without a goal.
    delay_max_s: Option<f64>,
}

/// Bends left and right, 12 s each, after 8 s straight: radius 3 m.
fn twist(time_s: f64) -> Twist {
    let linear_m_s = (0.5 * time_s).min(SPEED_M_S);
    let bend = if time_s < 8.0 {
        0.0
    } else {
        // Trapezoids of 1 s ramps.
        let phase_s = (time_s - 8.0) % 24.0;
        let side = if phase_s < 12.0 { 1.0 } else { -1.0 };
        let into_s = phase_s % 12.0;
        side * into_s.min(12.0 - into_s).min(1.0)
    };
    Twist {
        linear_m_s,
        angular_rad_s: linear_m_s * bend / 3.0,
    }
}

/// Result of one run.
#[derive(Debug, Clone, Copy, Default)]
struct DetectionResult {
    false_alarms: u32,
    /// Time from the change to the alarm, seconds; `None` if the change was missed.
    delay_s: Option<f64>,
}

fn drive(
    spec: &RobotSpec,
    change: Option<FrictionCurve>,
    duration_s: f64,
    seed: u64,
) -> DetectionResult {
    let mut robot = SeededRobot::new(*spec, Pose::default(), seed);
    let model = RobotModel::yi2007();
    // The border comes at another place of the bend in each run.
    let border_s = BEFORE_S + 0.37 * f64::from(u32::try_from(seed % 64).unwrap_or(0));
    let mut found = DetectionResult::default();
    let mut time_s = 0.0;
    while time_s
        < duration_s.max(if change.is_some() {
            border_s + AFTER_S
        } else {
            0.0
        })
    {
        let is_after = change.is_some() && time_s >= border_s;
        if let Some(curve) = change.filter(|_| is_after) {
            robot.ground = Ground::uniform(curve);
        }
        let outcome = robot.act(model.wheel_speeds_from_twist(twist(time_s)));
        time_s += LOOP_S;
        if outcome.ground_changed {
            robot.estimator.close_segment();
            robot.estimator.begin_ground();
            if is_after {
                found.delay_s = Some(time_s - border_s);
                return found;
            }
            found.false_alarms += 1;
        }
    }
    found
}

/// Runs the part `change` and returns its tables and checks.
pub(crate) fn run(options: &Options) -> Section {
    let borders = [
        (0.2, 0.4, true, Some(1.0)),
        (0.4, 0.2, true, None),
        (0.2, 1.43, true, None),
        (1.43, 0.2, true, None),
        (0.2, 0.4, false, None),
    ]
    .map(
        |(theta_before, theta_after, has_torque, delay_max_s)| GroundTransition {
            theta_before,
            theta_after,
            has_torque,
            delay_max_s,
        },
    );
    let mut text = String::from(
        "| θ | | delay mean s | delay 95 % s | missed % | false alarms before |\n\
         |---|---|---|---|---|---|\n",
    );
    let (mut lines, mut checks) = (Vec::new(), Vec::new());
    for border in &borders {
        changes(border, options, &mut text, &mut lines, &mut checks);
    }
    text.push_str("\n| no change, θ | | hours | false alarms per hour |\n|---|---|---|---|\n");
    for (theta, has_torque) in [(0.05, true), (0.2, true), (1.0, true), (0.2, false)] {
        quiet(
            theta,
            has_torque,
            options,
            &mut text,
            &mut lines,
            &mut checks,
        );
    }
    Section {
        text,
        figures: Value::Array(lines),
        checks,
    }
}

fn spec(theta: f64, has_torque: bool) -> RobotSpec {
    let mut spec = RobotSpec::on(1.0 / theta);
    spec.has_torque = has_torque;
    spec
}

fn channel(has_torque: bool) -> &'static str {
    if has_torque { "torque" } else { "no torque" }
}

fn changes(
    border: &GroundTransition,
    options: &Options,
    text: &mut String,
    lines: &mut Vec<Value>,
    checks: &mut Vec<Check>,
) {
    let curve = RobotSpec::on(1.0 / border.theta_after).curve;
    let runs = run_seeded(options.runs, |seed| {
        drive(
            &spec(border.theta_before, border.has_torque),
            Some(curve),
            0.0,
            seed,
        )
    });
    let mut delays: Vec<f64> = runs.iter().filter_map(|run| run.delay_s).collect();
    delays.sort_by(f64::total_cmp);
    #[expect(clippy::cast_precision_loss, reason = "counts of runs are small")]
    let (found, count) = (delays.len() as f64, runs.len() as f64);
    let mean_s = delays.iter().sum::<f64>() / found;
    let late_s = delays.get(delays.len() * 95 / 100).copied();
    let late = late_s.map_or("–".to_owned(), |late_s| format!("{late_s:.2}"));
    let missed = 1.0 - found / count;
    let alarms: u32 = runs.iter().map(|run| run.false_alarms).sum();
    let name = format!(
        "{} → {}, {}",
        border.theta_before,
        border.theta_after,
        channel(border.has_torque)
    );
    let _ = writeln!(
        text,
        "| {} → {} | {} | {mean_s:.2} | {late} | {:.1} | {alarms} |",
        border.theta_before,
        border.theta_after,
        channel(border.has_torque),
        100.0 * missed
    );
    lines.push(json!({
        "change": name, "delay_mean_s": mean_s, "delay_95_s": late_s, "missed": missed,
        "false_alarms": alarms,
    }));
    if let Some(bound_s) = border.delay_max_s {
        checks.push(Check::of(format!("θ {name}: mean delay, s"), mean_s).at_most(bound_s));
        checks.push(Check::of(format!("θ {name}: changes missed, share"), missed).at_most(0.0));
    }
}

fn quiet(
    theta: f64,
    has_torque: bool,
    options: &Options,
    text: &mut String,
    lines: &mut Vec<Value>,
    checks: &mut Vec<Check>,
) {
    let runs = (options.runs / CHANGES_PER_QUIET).max(1);
    let alarms: u32 = run_seeded(runs, |seed| {
        drive(&spec(theta, has_torque), None, QUIET_S, seed).false_alarms
    })
    .into_iter()
    .sum();
    let hours = f64::from(runs) * QUIET_S / 3600.0;
    let rate = f64::from(alarms) / hours;
    let _ = writeln!(
        text,
        "| {theta} | {} | {hours:.1} | {rate:.2} |",
        channel(has_torque)
    );
    lines.push(json!({
        "theta": theta, "has_torque": has_torque, "hours": hours,
        "false_alarms_per_hour": rate,
    }));
    checks.push(
        Check::of(
            format!(
                "θ {theta} unchanged, {}: false alarms per hour",
                channel(has_torque)
            ),
            rate,
        )
        .at_most(0.2),
    );
}
