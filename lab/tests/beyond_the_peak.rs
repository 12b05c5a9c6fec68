//! Bends in which wheels slip beyond the peak of their friction curve.

use tread_control::friction::{FrictionCurve, FrictionSpec};
use tread_control::geometry::Pose;
use tread_control::plant::Ground;
use tread_control::robot::RobotModel;
use tread_control::tracking::ThetaKnowledge;
use tread_lab::bench::{Course, Figure8, Law, Run, Scenario, TickInput, TickOutput};

fn curve(stiffness: f64, peak_slip: f64) -> FrictionCurve {
    let shape = FrictionCurve::yi2007().into();
    let spec = FrictionSpec {
        stiffness,
        peak_slip,
        ..shape
    };
    spec.try_into().expect("a curve that is possible")
}

fn known(theta: f64) -> ThetaKnowledge {
    ThetaKnowledge {
        theta,
        std_dev: 0.02 * theta,
    }
}

/// The figure-8 of the report, given a θ that may change with time; every tick's output.
fn figure_8(
    friction_curve: FrictionCurve,
    knowledge: impl Fn(f64) -> ThetaKnowledge,
) -> Vec<TickOutput> {
    let course = Course::Figure8(Figure8::usual());
    let law = Law::Shipped(Some(knowledge(0.0)));
    let scenario = Scenario::usual(friction_curve);
    let mut run = Run::new(course, RobotModel::yi2007(), scenario, law).expect("a valid scenario");
    let ground = Ground::uniform(friction_curve);
    let mut ticks = Vec::new();
    loop {
        let input = TickInput {
            ground: &ground,
            pose_error: Pose::default(),
            knowledge: Some(knowledge(run.time_s())),
        };
        match run.tick(&input, |_, _| {}) {
            Some(output) => ticks.push(output),
            None => return ticks,
        }
    }
}

fn rms_m(ticks: &[TickOutput]) -> f64 {
    let sum: f64 = ticks
        .iter()
        .map(|tick| tick.cross_track_m * tick.cross_track_m)
        .sum();
    #[expect(clippy::cast_precision_loss, reason = "some thousand ticks")]
    let count = ticks.len() as f64;
    (sum / count).sqrt()
}

fn last_half(ticks: &[TickOutput]) -> &[TickOutput] {
    &ticks[ticks.len() / 2..]
}

fn believed(tick: &TickOutput) -> f64 {
    let tracker = tick.tracker.expect("the shipped law says what it believes");
    tracker.beyond_loop
}

#[test]
fn wheels_beyond_the_peak_cost_hardly_more_than_wheels_below_it() {
    for (stiffness, bound_m) in [(0.5, 4.0e-3), (1.0, 1.3e-3), (5.0, 1.0e-4)] {
        let ticks = figure_8(curve(stiffness, 0.2), |_| known(1.0 / stiffness));
        let found_m = rms_m(last_half(&ticks));
        assert!(found_m < bound_m, "K {stiffness}: {found_m} m");
    }
}

#[test]
fn tyres_that_lose_no_friction_in_a_bend_are_detected() {
    for (stiffness, bound_m) in [(0.5, 5.0e-4), (1.0, 4.0e-4), (5.0, 7.0e-4)] {
        let ticks = figure_8(curve(stiffness, 0.9), |_| known(1.0 / stiffness));
        let (found_m, last) = (rms_m(last_half(&ticks)), believed(ticks.last().unwrap()));
        assert!(found_m < bound_m, "K {stiffness}: {found_m} m");
        assert!(last < 0.9, "K {stiffness}: {last} still believed");
    }
}

/// Given ten times too much for a lap, then in a time less and less, then the truth.
fn lies(theta: f64, falls_s: f64) -> impl Fn(f64) -> ThetaKnowledge {
    move |time_s| {
        let share = ((time_s - LAP_S) / falls_s).clamp(0.0, 1.0);
        known(theta * 10.0_f64.powf(1.0 - share))
    }
}

const LAP_S: f64 = 42.0;

#[test]
fn what_was_adapted_under_a_theta_that_is_contradicted_is_forgotten_within_a_second() {
    for falls_s in [0.01, 10.0] {
        let theta = 0.2;
        let ticks = figure_8(curve(1.0 / theta, 0.2), lies(theta, falls_s));
        let at = |time_s: f64| {
            let found = ticks.iter().find(|tick| tick.time_s >= time_s);
            believed(found.expect("three laps take longer"))
        };
        let (before, after) = (at(LAP_S - 0.1), at(LAP_S + falls_s + 1.1));
        assert!(before < 0.5, "{before} still believed");
        assert!(after > 0.9, "in {falls_s} s: {after} believed");
    }
}
