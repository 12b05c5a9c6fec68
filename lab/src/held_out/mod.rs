//! The held-out check: agents as shipped drive robots whose bodies, motors and contacts are those of
//! the Open Dynamics Engine (ODE), a simulator that is not ours.
//!
//! `lab/ode/robot.cpp` is the robot, a process of its own ([`process`]); its header says what the
//! true θ is. Sensors, courses and the closed loop are those of the rough world. Robots are drawn
//! from its distributions, made [`WIDTH`] times wider. Nothing of the estimator may be chosen on
//! these robots.

pub mod process;
pub mod truth;

use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;

use crate::random::Random;
use crate::rough::curve::Shape;
use crate::rough::drive::RoughDrive;
use crate::rough::run::{Course, Outcome, Trial, run_with};
use crate::rough::sensors::{SensorSpec, Sensors};
use crate::rough::spec::{Deviations, MAKES};
use crate::rough::width::Width;

use process::{Contacts, OdePlant, OdeProgram, OdeRobot};

/// Factor by which distributions are wider than those of the rough world.
pub const WIDTH: f64 = 1.3;
/// Mask of the seed for drawing the robot, so that robot and sensor noise are independent.
const ROBOT_SEED: u64 = 0x0de;

/// Draws the drive of a seed: the same robot, with torque or without.
pub fn drawn(seed: u64, has_torque: bool) -> Trial {
    let mut random = Random::new(seed ^ ROBOT_SEED);
    let width = Width::new(WIDTH).unwrap_or_default();
    let make = random.one_of(&MAKES).unwrap_or(MAKES[0]);
    let mut deviations = Deviations::drawn_wider(&mut random, width);
    // ODE's own contacts: force-dependent slip up to a limit, alike in both directions.
    deviations.curve.shape = Shape::Linear;
    deviations.lateral_stiffness_ratio = 1.0;
    let mut trial = Trial {
        make,
        deviations,
        sensors: SensorSpec::drawn_wider(&mut random, has_torque, width),
        course: random
            .one_of(&[Course::Figure8, Course::Circle])
            .unwrap_or(Course::Figure8),
        seed,
        prior: EstimatorPrior::default(),
        is_bounded: false,
    };
    trial.sensors = trial.sensors.with_drawn_inertial_unit(&mut random, width);
    trial
}

/// Runs a drive on these contacts, with so many integration steps in a sample.
///
/// # Errors
/// The robot's model or its plan is impossible, or the simulation failed.
pub fn run(
    program: &OdeProgram,
    trial: &Trial,
    contacts: Contacts,
    steps_per_sample: u32,
) -> anyhow::Result<Outcome> {
    let model = trial.make.model()?;
    let robot = OdeRobot {
        model: &model,
        deviations: trial.deviations,
        start: Pose::default(),
        contacts,
        steps_per_sample,
    };
    let plant = OdePlant::start(program, &robot)?;
    let sensors = Sensors::new(trial.sensors, &model, Random::new(trial.seed));
    run_with(trial, RoughDrive::with_plant(plant, sensors))
}
