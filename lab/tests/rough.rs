//! Robots of the rough world, as shipped: what agents report of the ground holds.

#![cfg(feature = "agent")]

use tread_api::friction::NORMAL_95;
use tread_control::estimation::EstimatorPrior;
use tread_lab::parallel::in_parallel;
use tread_lab::random::Random;
use tread_lab::report::WIDE_RATIO;
use tread_lab::rough::bound::{BoundInput, bounds};
use tread_lab::rough::run::{Course, Outcome, Trial, run};
use tread_lab::rough::sensors::SensorSpec;
use tread_lab::rough::spec::{Deviations, MAKES};

/// Robots in which everything differs, with seeds that nothing was chosen on.
fn population(has_torque: bool, runs: u64) -> Vec<Outcome> {
    let trial = |seed: u64| {
        let mut random = Random::new(seed ^ 0x5eed);
        Trial {
            make: random.one_of(&MAKES).unwrap_or(MAKES[0]),
            deviations: Deviations::drawn(&mut random),
            sensors: SensorSpec::drawn(&mut random, has_torque),
            course: random
                .one_of(&[Course::Figure8, Course::Circle])
                .unwrap_or(Course::Figure8),
            seed,
            prior: EstimatorPrior::default(),
            is_bounded: false,
        }
    };
    let trials: Vec<Trial> = (7_000_000..7_000_000 + runs).map(trial).collect();
    let outcomes = in_parallel(&trials, run).into_iter();
    outcomes
        .map(|outcome| outcome.expect("the robots can be"))
        .collect()
}

/// Answers, intervals narrow enough to say something, and those that cover the truth.
fn counts(outcomes: &[Outcome]) -> [u32; 3] {
    let mut counts = [0; 3];
    for outcome in outcomes {
        for said in outcome.said {
            counts[0] += 1;
            let Some(said) = said else { continue };
            if NORMAL_95 * said.std_dev > WIDE_RATIO * said.theta {
                continue;
            }
            counts[1] += 1;
            let (low, high) = said.interval_95();
            counts[2] += u32::from((low..=high).contains(&outcome.truth));
        }
    }
    counts
}

#[test]
fn intervals_hold_on_robots_that_differ_in_everything() {
    // Over 240 drives each: 97 % and 96 % of the intervals, 87 % and 76 % of the answers.
    for (has_torque, least_share) in [(true, 0.75), (false, 0.6)] {
        let [answers, estimates, covered] = counts(&population(has_torque, 60));
        eprintln!("torque {has_torque}: {covered} of {estimates} of {answers}");
        assert!(f64::from(estimates) > least_share * f64::from(answers));
        assert!(f64::from(covered) > 0.92 * f64::from(estimates));
    }
}

/// A robot on a circle, with a change.
fn circle(change: impl Fn(&mut Deviations)) -> Trial {
    let mut deviations = Deviations::none(0.7);
    change(&mut deviations);
    Trial {
        make: MAKES[0],
        deviations,
        sensors: SensorSpec::usual(true),
        course: Course::Circle,
        seed: 3,
        prior: EstimatorPrior::default(),
        is_bounded: false,
    }
}

#[test]
fn payload_does_not_shift_theta_once_the_robot_has_accelerated() {
    let of_payload = |payload_ratio: f64| {
        let outcome = run(&circle(|robot| robot.payload_ratio = payload_ratio));
        let last = outcome.expect("the robot can be").said[3];
        last.expect("a circle measures θ on soft ground").theta
    };
    let (empty, loaded) = (of_payload(0.0), of_payload(0.3));
    assert!((loaded / empty - 1.0).abs() < 0.05, "{empty} and {loaded}");
}

#[test]
fn a_load_off_the_middle_on_a_slope_does_not_shift_theta_on_a_circle() {
    // The slope's force swings as the robot turns, and the side that carries less slips more.
    for center_left_ratio in [-0.03, 0.03] {
        let trial = circle(|robot| {
            robot.center_left_ratio = center_left_ratio;
            robot.slope_rad = [0.05, 0.0];
        });
        let outcome = run(&trial).expect("the robot can be");
        let found = outcome.said[3].expect("a circle measures θ on soft ground");
        let (low, high) = found.interval_95();
        assert!((low..=high).contains(&outcome.truth), "{found:?}");
        assert!(
            (found.theta / outcome.truth - 1.0).abs() < 0.15,
            "{found:?}"
        );
    }
}

#[test]
fn the_bound_of_a_longer_drive_is_lower_and_torque_lowers_it() {
    let bound = |has_torque: bool| {
        let trial = Trial {
            sensors: SensorSpec::usual(has_torque),
            is_bounded: true,
            ..circle(|_| {})
        };
        let outcome = run(&trial).expect("the robot can be");
        outcome.bounds.expect("it was asked for")
    };
    let (with, without) = (bound(true), bound(false));
    for found in [with, without] {
        assert!(found.windows(2).all(|pair| pair[1] < pair[0]), "{found:?}");
        assert!(found[3] > 0.0, "{found:?}");
    }
    assert!(
        with.iter()
            .zip(without)
            .all(|(with, without)| *with < without)
    );
}

#[test]
fn a_robot_that_never_moved_is_bounded_by_what_was_known() {
    let model = MAKES[0].model().expect("the makes are robots");
    let found = bounds(&BoundInput {
        model: &model,
        deviations: Deviations::none(3.0),
        sensors: SensorSpec::usual(true),
        commands: &[tread_control::measured::WheelSpeeds::default(); 100],
        at_samples: &[100],
    });
    let found = found.expect("the plant can be")[0];
    assert!((1.0..1.2).contains(&found), "{found}");
}
