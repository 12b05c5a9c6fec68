//! Goals of tracking: the figures that are compared, and their bounds.

use std::f64::consts::{FRAC_PI_2, PI};
use std::fmt::Write as _;

use serde_json::{Value, json};
use tread_control::follower::{Follower, FollowerConfig};
use tread_control::friction::FrictionCurve;
use tread_control::gate::{GateInput, GateLimits, gate};
use tread_control::geometry::Pose;
use tread_control::measured::{Measured, WheelSpeeds};
use tread_control::plan::{Plan, PlanOptions};
use tread_control::plant::{Ground, Plant, PlantSpec};
use tread_control::robot::RobotModel;
use tread_control::tracking::{ThetaKnowledge, TrackerConfig};
use tread_lab::bench::{Course, Figure8, Law};
use tread_lab::parallel::in_parallel;

use super::simulate::{Case, PRIOR_DEVIATION, Terrain, ThetaSource, Trace, simulate};
use super::{Courses, Line, OWN, PEER, STIFFNESSES, UNKNOWN, courses};
use crate::report::Check;
use crate::robot::LOOP_S;

/// Servo lag of these figures, seconds.
const LAG_S: f64 = 0.05;
/// Time from which borders are scored, seconds: before, the robot learns the first ground.
const BORDER_FROM_S: f64 = 30.0;
/// Distance after a border over which errors are scored, metres.
const BORDER_LENGTH_M: f64 = 5.0;
/// Goals: K, and the maximum ratio of our RMS error to the peer's.
const SHARES: [(f64, f64); 4] = [(0.5, 0.6), (2.0, 0.7), (5.0, 0.8), (20.0, 1.0)];

/// Text, figures and checks of this part.
pub(super) struct Found {
    pub(super) text: String,
    pub(super) figures: Value,
    pub(super) checks: Vec<Check>,
}

/// Measures all goals, from the table's lines and from runs of their own.
pub(super) fn find(courses: &Courses, lines: &[Line]) -> Found {
    let mut found = Found {
        text: String::new(),
        figures: json!({}),
        checks: Vec::new(),
    };
    from_the_table(lines, &mut found.checks);
    before_theta_is_known(courses, &mut found);
    with_a_prior(&mut found);
    at_a_border(courses, &mut found);
    with_a_wrong_theta(&mut found);
    from_standstill(&mut found);
    found
}

/// Checks the ratios to the peer, and the steady circle.
fn from_the_table(lines: &[Line], checks: &mut Vec<Check>) {
    let quiet = |line: &&Line| !line.noisy && (line.lag_s - LAG_S).abs() < 1.0e-9;
    for course in ["figure-8", "waypoints"] {
        for (stiffness, share) in SHARES {
            let line = lines
                .iter()
                .filter(quiet)
                .find(|line| line.course == course && line.terrain == Terrain::Uniform(stiffness));
            let ratio = line.map(|line| line.rms_m[OWN] / line.rms_m[PEER]);
            let name = format!("{course}, K {stiffness}, own θ over the peer");
            checks.push(Check::of(name, ratio).at_most(share));
        }
    }
    for line in lines.iter().filter(quiet) {
        if line.course == "circle" && matches!(line.terrain, Terrain::Uniform(_)) {
            let name = format!("circle, K {}, RMS, mm", line.ground());
            checks.push(Check::of(name, 1.0e3 * line.rms_m[OWN]).at_most(0.5));
        }
    }
    let worst = |of: &dyn Fn(&&Line) -> bool, column: usize| {
        lines
            .iter()
            .filter(of)
            .map(|line| line.rms_m[column] / line.rms_m[PEER])
            .fold(0.0, f64::max)
    };
    let noisy = |line: &&Line| line.noisy;
    let switching = |line: &&Line| matches!(line.terrain, Terrain::Switching(_));
    for (name, value) in [
        (
            "with noise, own θ over the peer, worst line",
            worst(&noisy, OWN),
        ),
        (
            "with noise, θ unknown over the peer, worst line",
            worst(&noisy, UNKNOWN),
        ),
        (
            "K switching 5 ↔ 0.7, own θ over the peer, worst line",
            worst(&switching, OWN),
        ),
    ] {
        checks.push(Check::of(name, value).at_most(1.0));
    }
}

/// Checks that without any θ the law is never worse than the peer over the whole run.
fn before_theta_is_known(courses: &Courses, found: &mut Found) {
    let mut items = Vec::new();
    for (name, course) in courses {
        for stiffness in STIFFNESSES {
            items.push((*name, course, stiffness));
        }
    }
    let ratios = in_parallel(&items, |&(name, course, stiffness)| {
        let case = case(course, Terrain::Uniform(stiffness));
        let whole = |law| simulate(&case, law, ThetaSource::Nothing).rms_m(0.0..f64::INFINITY);
        let best = super::PEER_HEADING_GAINS
            .map(|gain| whole(super::tuned(gain)))
            .into_iter()
            .fold(f64::INFINITY, f64::min);
        (name, stiffness, whole(Law::Shipped(None)) / best)
    });
    for (name, stiffness, ratio) in ratios {
        found.checks.push(
            Check::of(
                format!("{name}, K {stiffness}, θ unknown over the peer, whole run"),
                ratio,
            )
            .at_most(1.0),
        );
    }
}

fn case(course: &Course, terrain: Terrain) -> Case<'_> {
    Case {
        model: RobotModel::yi2007(),
        course,
        terrain,
        lag_s: LAG_S,
        noisy: false,
        seed: 1,
        tracker: TrackerConfig::default(),
    }
}

/// Compares the first lap with the map's prior with a lap of the converged robot.
fn with_a_prior(found: &mut Found) {
    let shape = Figure8::usual();
    let (course, lap_s) = (Course::Figure8(shape), shape.lap_s());
    let ratios = in_parallel(&STIFFNESSES, |&stiffness| {
        let case = case(&course, Terrain::Uniform(stiffness));
        let converged = simulate(&case, Law::Shipped(None), ThetaSource::Own);
        let prior = ThetaKnowledge {
            theta: 1.0 / stiffness,
            std_dev: PRIOR_DEVIATION / stiffness,
        };
        let mapped = simulate(&case, Law::Shipped(Some(prior)), ThetaSource::Map);
        (
            stiffness,
            mapped.rms_m(0.0..lap_s) / converged.rms_m(2.0 * lap_s..3.0 * lap_s),
        )
    });
    for (stiffness, ratio) in ratios {
        let name = format!("figure-8, K {stiffness}, first lap with the prior over converged");
        found.checks.push(Check::of(name, ratio).at_most(1.2));
    }
}

/// Returns sum of squares and count of the errors over the first metres after each entry into the
/// second ground, from [`BORDER_FROM_S`] on.
fn after_entries(trace: &Trace, border_m: f64) -> [f64; 2] {
    let (mut sum, mut count, mut left_m) = (0.0, 0.0, 0.0);
    for pair in trace.ticks.windows(2) {
        let (before, now) = (pair[0], pair[1]);
        let enters = before.pose.x_m < border_m && now.pose.x_m >= border_m;
        if enters && now.time_s > BORDER_FROM_S {
            left_m = BORDER_LENGTH_M;
        }
        if left_m > 0.0 {
            left_m -= before.pose.point().distance_m(now.pose.point());
            sum += now.cross_track_m * now.cross_track_m;
            count += 1.0;
        }
    }
    [sum, count]
}

/// Measures the border from K 5 to 0.7 on the circle, and on the figure-8 with the border at
/// several places.
fn at_a_border(courses: &Courses, found: &mut Found) {
    let figure_8 = Course::Figure8(Figure8 {
        laps: 5.0,
        ..Figure8::usual()
    });
    let circle = courses.iter().find(|(name, _)| *name == "circle");
    let circle = circle.map_or(&figure_8, |(_, course)| course);
    for (name, course, borders_m) in [
        ("circle", circle, &[0.0][..]),
        ("figure-8", &figure_8, &[0.0, 1.0, 2.0, 3.0, 3.5][..]),
    ] {
        let sums = in_parallel(borders_m, |&at_m| {
            let terrain = Terrain::Border {
                at_m,
                pair: [5.0, 0.7],
            };
            let case = case(course, terrain);
            let run = |law, knowing| after_entries(&simulate(&case, law, knowing), at_m);
            [
                run(Law::Shipped(None), ThetaSource::Map),
                run(Law::Shipped(None), ThetaSource::Own),
                run(super::tuned(6.0), ThetaSource::Nothing),
            ]
        });
        let rms_m = [0, 1, 2].map(|column| {
            let sum: f64 = sums.iter().map(|row| row[column][0]).sum();
            let count: f64 = sums.iter().map(|row| row[column][1]).sum();
            (sum / count.max(1.0)).sqrt()
        });
        let _ = writeln!(
            found.text,
            "\nFirst 5 m after the border K 5 → 0.7, {name}: {:.2} mm RMS with the map's prior, \
             {:.2} mm without, the peer {:.2} mm.",
            1.0e3 * rms_m[0],
            1.0e3 * rms_m[1],
            1.0e3 * rms_m[2]
        );
        found.figures[format!("border_{name}_rms_mm")] = json!(rms_m.map(|value| 1.0e3 * value));
        found.checks.push(
            Check::of(
                format!("border K 5 → 0.7, first 5 m, {name}, with the prior over without"),
                rms_m[0] / rms_m[1],
            )
            .at_most(0.7),
        );
    }
}

/// Measures the effect of a given θ that is wrong by a factor of ten for a lap, and the recovery
/// with the robot's own measurement.
fn with_a_wrong_theta(found: &mut Found) {
    let shape = Figure8::usual();
    let (course, lap_s) = (Course::Figure8(shape), shape.lap_s());
    let mut items = Vec::new();
    for stiffness in STIFFNESSES {
        for factor in [0.1, 10.0] {
            items.push((stiffness, factor));
        }
    }
    let rows = in_parallel(&items, |&(stiffness, factor)| {
        let case = case(&course, Terrain::Uniform(stiffness));
        let claim = ThetaKnowledge {
            theta: factor / stiffness,
            std_dev: PRIOR_DEVIATION * factor / stiffness,
        };
        let wrong = ThetaSource::Wrong {
            factor,
            until_s: lap_s,
        };
        let trace = simulate(&case, Law::Shipped(Some(claim)), wrong);
        let converged = simulate(&case, Law::Shipped(None), ThetaSource::Own);
        let (from_s, to_s) = (lap_s + 10.0, 2.0 * lap_s + 10.0);
        (
            stiffness,
            factor,
            trace.most_m(0.0),
            trace.rms_m(from_s..to_s) / converged.rms_m(from_s..to_s),
        )
    });
    for (stiffness, factor, most_m, ratio) in rows {
        let name = format!("K {stiffness}, θ wrong × {factor}");
        found
            .checks
            .push(Check::of(format!("{name}, largest error, m"), most_m).at_most(0.1));
        found
            .checks
            .push(Check::of(format!("{name}, 10 s after over converged"), ratio).at_most(1.2));
    }
}

/// Measures the approach from rest, 3 m off the circle, with the robot's own follower: the time
/// until it stays within 5 cm.
fn from_standstill(found: &mut Found) {
    let mut items = Vec::new();
    for (name, radius_m, heading_rad) in [
        ("inside, along the path", 3.0, FRAC_PI_2),
        ("inside, facing the path", 3.0, 0.0),
        ("outside, along the path", 9.0, FRAC_PI_2),
        ("outside, facing the path", 9.0, PI),
    ] {
        for stiffness in STIFFNESSES {
            items.push((name, radius_m, heading_rad, stiffness));
        }
    }
    let rows = in_parallel(&items, |&(name, radius_m, heading_rad, stiffness)| {
        let start = Pose {
            x_m: radius_m,
            y_m: 0.0,
            heading_rad,
        };
        let curve = FrictionCurve::with_stiffness(stiffness).expect("stiffness is positive");
        let traction_limit_mu = Some(curve.mu_peak());
        (
            name,
            stiffness,
            arrival(start, stiffness, None),
            arrival(start, stiffness, traction_limit_mu),
        )
    });
    let _ = writeln!(
        found.text,
        "\nFrom rest 3 m off the circle, seconds until inside 5 cm for good; in brackets with the \
         peak friction known to the plan.\n\n| K | start | s |\n|---|---|---|"
    );
    for (name, stiffness, arrival, limited) in rows {
        let _ = writeln!(
            found.text,
            "| {stiffness} | {name} | {:.2} ({:.2}) |",
            arrival.time_s, limited.time_s
        );
        let name = format!("K {stiffness}, 3 m {name}");
        let checks = &mut found.checks;
        checks.push(Check::of(format!("{name}, inside 5 cm, s"), arrival.time_s).at_most(6.0));
        checks.push(
            Check::of(
                format!("{name}, hardest wheel demand over its limit"),
                arrival.wheel_share,
            )
            .at_most(1.0),
        );
    }
}

/// Result of an approach.
struct Arrival {
    /// Time from which the robot stays within 5 cm, seconds.
    time_s: f64,
    /// Maximum ratio of commanded wheel speed or acceleration to its limit.
    wheel_share: f64,
}

fn arrival(start: Pose, stiffness: f64, traction_limit_mu: Option<f64>) -> Arrival {
    let model = RobotModel::yi2007();
    let options = PlanOptions {
        approach_speed_m_s: Some(model.limits().linear_max_m_s),
        traction_limit_mu,
        ..PlanOptions::default()
    };
    let plan = Plan::with_options(&courses::circle_trajectory(), start, &model, &options)
        .expect("the circle can be reached");
    let mut follower = Follower::new(plan, model, FollowerConfig::default()).expect("valid gains");
    let mut plant = Plant::new(model, PlantSpec::default(), start).expect("a valid plant");
    let curve = FrictionCurve::with_stiffness(stiffness).expect("stiffness is positive");
    let (ground, limits) = (Ground::uniform(curve), GateLimits::of(&model));
    let mut previous = WheelSpeeds::default();
    let (mut last_outside_s, mut time_s, mut wheel_share) = (0.0, 0.0, 0.0_f64);
    while time_s < 30.0 {
        let state = *plant.state();
        if (state.pose.x_m.hypot(state.pose.y_m) - 6.0).abs() > 0.05 {
            last_outside_s = time_s;
        }
        let measured = Measured {
            pose: state.pose,
            twist: state.twist(),
            wheel_speeds: state.wheel_speeds,
            pose_age_s: 0.0,
            position_std_dev_m: 0.0,
        };
        let output = follower.step(&measured, None, LOOP_S);
        let input = GateInput {
            command: Some(output.wheel_speeds),
            previous,
            stop: false,
            feedback_age_s: 0.0,
            dt_s: LOOP_S,
        };
        let passed = gate(&input, &limits).wheel_speeds;
        let change = (passed.left_rad_s - previous.left_rad_s)
            .abs()
            .max((passed.right_rad_s - previous.right_rad_s).abs());
        wheel_share = wheel_share
            .max(passed.magnitude_max_rad_s() / limits.wheel_speed_max_rad_s)
            .max(change / LOOP_S / (limits.wheel_acceleration_max_rad_s2 + 1.0e-6));
        previous = passed;
        plant.step(passed, &ground, LOOP_S);
        time_s += LOOP_S;
    }
    Arrival {
        time_s: last_outside_s,
        wheel_share,
    }
}
