//! Tracking on courses, grounds and with a robot that no gain was chosen on.

use std::fmt::Write as _;

use serde_json::{Value, json};
use tread_control::geometry::{Point, Pose};
use tread_control::robot::RobotModel;
use tread_control::tracking::TrackerConfig;
use tread_control::trajectory::{CircleSpec, Direction, Trajectory, Waypoint, WaypointsSpec};
use tread_lab::bench::{Course, Figure8, Law};
use tread_lab::parallel::in_parallel;

use super::courses::plan;
use super::simulate::{Case, Terrain, ThetaSource};
use super::{millimetres, peer, score};
use crate::held_out::{FIRST_SEED, STIFFNESSES, robots};
use crate::report::{Check, Options, Section};

/// Lag of the wheel servo, seconds.
const LAG_S: f64 = 0.07;
/// A path of nine points.
const POINTS: [(f64, f64); 9] = [
    (0.0, 0.0),
    (2.5, 0.0),
    (4.5, 1.5),
    (4.5, 4.0),
    (6.5, 5.5),
    (9.0, 4.5),
    (9.5, 2.0),
    (7.5, -0.5),
    (4.5, -2.0),
];

/// Runs the tracking part of the held-out set and returns its tables and checks.
pub(crate) fn run(options: &Options) -> Section {
    let seeds = u64::from((options.runs / 100).clamp(1, 20));
    let mut wanted = Vec::new();
    for (robot, model) in robots() {
        for (course_name, course) in courses(&model) {
            for stiffness in STIFFNESSES {
                for noisy in [false, true] {
                    wanted.push((robot, model, course_name, course.clone(), stiffness, noisy));
                }
            }
        }
    }
    let rows = in_parallel(&wanted, |(_, model, _, course, stiffness, noisy)| {
        let case = Case {
            model: *model,
            course,
            terrain: Terrain::Uniform(*stiffness),
            lag_s: LAG_S,
            noisy: *noisy,
            seed: FIRST_SEED,
            tracker: TrackerConfig::default(),
        };
        let seeds = if *noisy { seeds } else { 1 };
        [
            peer(&case, seeds).0,
            score(&case, seeds, Law::Shipped(None), ThetaSource::Nothing).0,
            score(&case, seeds, Law::Shipped(None), ThetaSource::Own).0,
        ]
    });
    let mut text = format!(
        "Cross-track RMS of the second half, mm, lag {:.0} ms; noisy lines over {seeds} seeds.\n\n\
         | robot | course | K | noise | tuned with integral | ours, θ unknown | ours, own θ |\n\
         |---|---|---|---|---|---|---|\n",
        1.0e3 * LAG_S
    );
    let mut lines = Vec::new();
    let mut worst = [[0.0_f64; 2]; 2];
    for ((robot, _, course, _, stiffness, noisy), rms_m) in wanted.iter().zip(&rows) {
        let _ = writeln!(
            text,
            "| {robot} | {course} | {stiffness} | {} | {} | {} | {} |",
            if *noisy { "yes" } else { "no" },
            millimetres(rms_m[0]),
            millimetres(rms_m[1]),
            millimetres(rms_m[2]),
        );
        lines.push(json!({
            "robot": robot, "course": course, "stiffness": stiffness, "noise": noisy,
            "peer_mm": 1.0e3 * rms_m[0], "unknown_mm": 1.0e3 * rms_m[1], "own_mm": 1.0e3 * rms_m[2],
        }));
        for column in [0, 1] {
            let most = &mut worst[usize::from(*noisy)][column];
            *most = most.max(rms_m[column + 1] / rms_m[0]);
        }
    }
    let mut checks = Vec::new();
    for (noise, ratios) in ["without noise", "with noise"].into_iter().zip(worst) {
        for (law, ratio) in ["θ unknown", "own θ"].into_iter().zip(ratios) {
            checks.push(
                Check::of(
                    format!("held out, {noise}, {law} over the peer, worst line"),
                    ratio,
                )
                .at_most(1.0),
            );
        }
    }
    Section {
        text,
        figures: Value::Array(lines),
        checks,
    }
}

fn courses(model: &RobotModel) -> [(&'static str, Course); 3] {
    let circle = Trajectory::Circle(CircleSpec {
        center: Point::default(),
        radius_m: 3.5,
        speed_m_s: 0.5,
        direction: Direction::Clockwise,
        turns: 3.0,
    });
    let on_circle = Pose {
        x_m: 0.0,
        y_m: 3.5,
        heading_rad: 0.0,
    };
    let waypoints = Trajectory::Waypoints(WaypointsSpec {
        points: POINTS
            .iter()
            .cycle()
            .take(2 * POINTS.len() + 1)
            .map(|&(x_m, y_m)| Waypoint::from(Point { x_m, y_m }))
            .collect(),
        speed_m_s: 0.5,
    });
    [
        ("circle R 3.5 m", plan(&circle, on_circle, model)),
        (
            "figure-8 10×5 m",
            Course::Figure8(Figure8 {
                half_length_m: 5.0,
                half_width_m: 2.5,
                rate_rad_s: 0.11,
                laps: 3.0,
            }),
        ),
        ("nine points", plan(&waypoints, Pose::default(), model)),
    ]
}
