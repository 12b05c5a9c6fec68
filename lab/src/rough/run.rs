//! Runs one closed-loop drive of one robot and records the θ that its agent reports.

use std::time::Duration;

use tread_agent::testing::Bench;
use tread_api::friction::{ParameterEstimate, RobotParameters, ThetaEstimate};
use tread_api::geometry::Point;
use tread_api::trajectory::{
    Circle, Direction, Trajectory, TrajectoryOptions, Waypoint, Waypoints,
};
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;
use tread_control::robot::RobotModel;

use super::bound::{BoundInput, bounds};
use super::drive::{RoughDrive, SimulatedPlant};
use super::sensors::SensorSpec;
use super::spec::{Deviations, Make};
use crate::random::Random;

/// Times after the start of the mission at which the agent's estimate is read, in seconds.
pub const ASKED_AT_S: [u64; 4] = [10, 20, 40, 60];
/// Time at rest before the start, in which the robot's localisation converges.
pub const SETTLES: Duration = Duration::from_secs(2);
/// Speed on the courses, in metres per second.
const SPEED_M_S: f64 = 0.6;
/// Number of waypoints per lap of the figure-8.
const POINTS_PER_LAP: u32 = 24;
/// Number of laps of the figure-8; they take more than a minute.
const LAPS: u32 = 3;

/// Course of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Course {
    /// A lemniscate, 8 m long and 4 m wide.
    Figure8,
    /// A circle of 2 m radius.
    Circle,
}

impl Course {
    /// Returns the name for reports.
    pub fn text(self) -> &'static str {
        match self {
            Self::Figure8 => "figure-8",
            Self::Circle => "circle",
        }
    }

    /// The course as a mission of more than a minute.
    pub fn trajectory(self) -> Trajectory {
        self.laps(LAPS)
    }

    /// The course as a mission of so many figure-8s, or as many circles and a third.
    pub fn laps(self, laps: u32) -> Trajectory {
        let options = TrajectoryOptions::default();
        match self {
            Self::Circle => Trajectory::Circle(Circle {
                center: Point { x_m: 0.0, y_m: 2.0 },
                radius_m: 2.0,
                speed_m_s: Some(SPEED_M_S),
                period_s: None,
                direction: Direction::CounterClockwise,
                turns: f64::from(laps + laps / 3),
                options,
            }),
            Self::Figure8 => {
                let points = 0..=POINTS_PER_LAP * laps;
                let waypoint = |index: u32| {
                    let angle =
                        std::f64::consts::TAU * f64::from(index) / f64::from(POINTS_PER_LAP);
                    Waypoint {
                        x_m: 4.0 * angle.sin(),
                        y_m: 2.0 * (2.0 * angle).sin(),
                        heading_rad: None,
                        speed_m_s: None,
                    }
                };
                Trajectory::Waypoints(Waypoints {
                    points: points.map(waypoint).collect(),
                    speed_m_s: SPEED_M_S,
                    options,
                })
            }
        }
    }
}

/// Specification of a drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trial {
    /// Make of the robot.
    pub make: Make,
    /// Differences of robot and ground from the agent's model.
    pub deviations: Deviations,
    /// Specification of the sensors.
    pub sensors: SensorSpec,
    /// Course to drive.
    pub course: Course,
    /// Seed of the sensor noise.
    pub seed: u64,
    /// Prior of the agent's estimator for robot and tyres.
    pub prior: EstimatorPrior,
    /// Whether to compute the Cramér–Rao bound of θ, which takes about ten times as long.
    pub is_bounded: bool,
}

/// Fraction of the time beyond half the slip at the peak above which a drive belongs to the stratum
/// of large slip.
pub const SLIPS_MOSTLY: f64 = 0.5;

/// Result of a drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// Agent's estimates of θ at the times [`ASKED_AT_S`]; `None` where it gave none.
    pub said: [Option<ThetaEstimate>; ASKED_AT_S.len()],
    /// Lower bounds of the standard deviation of ln θ at those times, if requested.
    pub bounds: Option<[f64; ASKED_AT_S.len()]>,
    /// True θ.
    pub truth: f64,
    /// Fraction of the time in which a contact slipped by more than half the slip at the peak.
    pub beyond_half_peak: f64,
    /// What the agent said of the robot's own parameters in the end.
    pub parameters: Option<RobotParameters>,
    /// Their true values, in the order of [`estimates()`].
    pub true_parameters: [f64; PARAMETERS.len()],
}

/// Names of a robot's parameters.
pub const PARAMETERS: [&str; 5] = [
    "apparent mass over the model's",
    "mass, kg",
    "yaw inertia over mass, over the model's",
    "centre of mass forward, m",
    "centre of mass to the left, m",
];

/// A robot's parameters in the order of [`PARAMETERS`].
pub fn estimates(parameters: &RobotParameters) -> [ParameterEstimate; PARAMETERS.len()] {
    [
        parameters.apparent_mass_ratio,
        parameters.mass_kg,
        parameters.yaw_inertia_ratio,
        parameters.center_of_mass_forward_m,
        parameters.center_of_mass_left_m,
    ]
}

fn true_parameters(model: &RobotModel, spec: &Deviations) -> [f64; PARAMETERS.len()] {
    let scale = 0.5 * (spec.torque_scale[0] + spec.torque_scale[1]);
    let mass_ratio = 1.0 + spec.payload_ratio;
    [
        scale * (mass_ratio + spec.rotor_ratio),
        mass_ratio * model.mass_kg(),
        spec.inertia_ratio,
        spec.center_forward_ratio * model.wheelbase_m(),
        spec.center_left_ratio * model.track_width_m(),
    ]
}

/// Runs a drive.
///
/// # Errors
/// The robot's model or its plan is impossible, or the bound cannot be computed.
pub fn run(trial: &Trial) -> anyhow::Result<Outcome> {
    let model = trial.make.model()?;
    let random = Random::new(trial.seed);
    let drive = RoughDrive::new(
        &model,
        trial.deviations,
        trial.sensors,
        Pose::default(),
        random,
    )
    .ok_or_else(|| anyhow::anyhow!("the wheels of {} are no rectangle", trial.make.name))?;
    run_with(trial, drive)
}

/// Runs a drive of a robot that is already made, whose plant need not be that of the rough world.
///
/// # Errors
/// The robot's model or its plan is impossible, the simulation failed, or the bound cannot be
/// computed.
pub fn run_with<P: SimulatedPlant>(trial: &Trial, drive: RoughDrive<P>) -> anyhow::Result<Outcome> {
    let model = trial.make.model()?;
    let mut bench = Bench::with_drive(drive, model).with_prior(trial.prior);
    bench.run_for(SETTLES);
    bench.begin(1, &trial.course.trajectory(), None)?;
    let (mut ticks, mut beyond) = (0_u32, 0_u32);
    let mut said = [None; ASKED_AT_S.len()];
    let mut at_samples = [0; ASKED_AT_S.len()];
    let mut driven_ticks = 0;
    for (index, asked_at_s) in ASKED_AT_S.into_iter().enumerate() {
        for _ in driven_ticks..asked_at_s * 100 {
            bench.tick();
            ticks += 1;
            beyond += u32::from(bench.drive().plant().slip_over_peak() > 0.5);
        }
        driven_ticks = asked_at_s * 100;
        bench.drive().plant().check()?;
        said[index] = bench.theta();
        at_samples[index] = bench.drive().commands().len();
    }
    let bounds = if trial.is_bounded {
        let found = bounds(&BoundInput {
            model: &model,
            deviations: trial.deviations,
            sensors: trial.sensors,
            commands: bench.drive().commands(),
            at_samples: &at_samples,
        });
        let found = found.and_then(|found| <[f64; ASKED_AT_S.len()]>::try_from(found).ok());
        Some(found.ok_or_else(|| anyhow::anyhow!("no bound of seed {}", trial.seed))?)
    } else {
        None
    };
    Ok(Outcome {
        said,
        bounds,
        truth: trial.deviations.curve.theta(),
        beyond_half_peak: f64::from(beyond) / f64::from(ticks.max(1)),
        parameters: bench.robot_parameters(),
        true_parameters: true_parameters(&model, &trial.deviations),
    })
}
