//! The held-out check on ODE: the simulator is what it is said to be, and agents drive on it.
//!
//! Without ODE these tests check nothing, and say so.

#![cfg(feature = "agent")]

use std::path::Path;

use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::GRAVITY_M_S2;
use tread_lab::held_out::process::{
    Contacts, OdeError, OdePlant, OdeProgram, OdeRobot, STEPS_PER_SAMPLE,
};
use tread_lab::held_out::truth::{PullDirection, PullInput, pull, step_differences, unequal_loads};
use tread_lab::held_out::{drawn, run};
use tread_lab::parallel::in_parallel;
use tread_lab::rough::spec::{Deviations, MAKES};

/// The simulator, or none without ODE.
fn program() -> Option<OdeProgram> {
    match OdeProgram::build(Path::new(env!("CARGO_TARGET_TMPDIR"))) {
        Ok(program) => Some(program),
        Err(OdeError::Missing) => {
            eprintln!("NOT CHECKED: ODE is missing: apt-get install libode-dev g++");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

#[test]
fn a_known_pull_shows_the_true_theta_in_both_directions() {
    let Some(program) = program() else { return };
    for stiffness in [0.457, 18.4] {
        for direction in PullDirection::ALL {
            let input = PullInput {
                stiffness,
                direction,
                over_peak: 0.6,
            };
            let found = pull(&program, input).unwrap();
            let error = found.theta_measured() / found.theta - 1.0;
            assert!(error.abs() < 0.01, "{found:?}");
            assert!(
                (found.mu_of_contacts / found.mu - 1.0).abs() < 0.01,
                "{found:?}"
            );
        }
    }
}

#[test]
fn no_contact_gives_more_than_the_limit_of_friction() {
    let Some(program) = program() else { return };
    let input = PullInput {
        stiffness: 3.0,
        direction: PullDirection::Longitudinal,
        over_peak: 1.25,
    };
    let found = pull(&program, input).unwrap();
    assert!(
        (found.mu_of_contacts / found.mu - 0.8).abs() < 0.01,
        "{found:?}"
    );
}

#[test]
fn slip_goes_by_the_load_of_each_wheel() {
    let Some(program) = program() else { return };
    let worst = unequal_loads(&program, 3.0).unwrap();
    assert!(worst < 0.01, "{worst}");
}

#[test]
fn smaller_steps_change_less_than_the_sensors_see() {
    let Some(program) = program() else { return };
    let trial = drawn(1, true);
    let found = step_differences(&program, trial.make, trial.deviations).unwrap();
    let [whole, half] = found
        .try_into()
        .expect("two steps are compared with a third");
    assert!(half.acceleration_m_s2 < 0.02, "{half:?}");
    assert!(half.yaw_rate_rad_s < 0.001, "{half:?}");
    assert!(half.end_m < whole.end_m, "{half:?} {whole:?}");
}

#[test]
fn a_robot_at_rest_on_a_slope_carries_its_weight_and_creeps_no_further() {
    let Some(program) = program() else { return };
    let mut deviations = Deviations::none(3.0);
    deviations.slope_rad = [0.05, -0.05];
    let model = MAKES[2].model().unwrap();
    let robot = OdeRobot {
        model: &model,
        deviations,
        start: Pose {
            x_m: 1.0,
            y_m: -2.0,
            heading_rad: 0.7,
        },
        contacts: Contacts::Elastic,
        steps_per_sample: STEPS_PER_SAMPLE,
    };
    let mut plant = OdePlant::start(&program, &robot).unwrap();
    for _ in 0..200 {
        plant.advance(WheelSpeeds::default()).unwrap();
    }
    let contacts = plant.contacts().unwrap();
    let loads_n: f64 = contacts.iter().map(|contact| contact.load_n).sum();
    let weight_n = robot.mass_kg() * GRAVITY_M_S2 / (1.0 + 2.0 * 0.05_f64.tan().powi(2)).sqrt();
    assert!(
        (loads_n / weight_n - 1.0).abs() < 0.002,
        "{loads_n} {weight_n}"
    );
    let pose = tread_lab::rough::drive::SimulatedPlant::truth(&plant)
        .state
        .pose;
    let off_m = (pose.x_m - 1.0).hypot(pose.y_m + 2.0);
    assert!(off_m < 5.0e-3, "{pose:?}");
    assert!((pose.heading_rad - 0.7).abs() < 1.0e-2, "{pose:?}");
}

#[test]
fn an_impossible_robot_is_refused_with_its_reason() {
    let Some(program) = program() else { return };
    let model = MAKES[0].model().unwrap();
    let mut deviations = Deviations::none(3.0);
    deviations.servo_lag_s = 0.0;
    let robot = OdeRobot {
        model: &model,
        deviations,
        start: Pose::default(),
        contacts: Contacts::Elastic,
        steps_per_sample: STEPS_PER_SAMPLE,
    };
    let refused = OdePlant::start(&program, &robot).expect_err("a servo has a lag");
    assert!(refused.to_string().contains("servo_lag_s"), "{refused}");
}

#[test]
fn agents_give_estimates_on_odes_contacts_and_most_intervals_hold() {
    let Some(program) = program() else { return };
    // Two robots on K 3, with the longest steps that ODE's robot takes.
    let trials = [8_000_001, 8_000_003].map(|seed| drawn(seed, true));
    let (mut estimates, mut covered) = (0, 0);
    for outcome in in_parallel(&trials, |trial| run(&program, trial, Contacts::Rigid, 10)) {
        let outcome = outcome.unwrap();
        for said in outcome.said.into_iter().flatten() {
            let (low, high) = said.interval_95();
            estimates += 1;
            covered += u32::from((low..=high).contains(&outcome.truth));
        }
    }
    assert!(estimates >= 6, "{estimates} of 8");
    assert!(4 * covered >= 3 * estimates, "{covered} of {estimates}");
}
