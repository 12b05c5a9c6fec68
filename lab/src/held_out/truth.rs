//! Whether the simulator is right: θ by pulling a robot with a known force, and smaller integration
//! steps.

use tread_control::geometry::{Pose, wrap_angle_rad};
use tread_control::measured::WheelSpeeds;
use tread_control::robot::GRAVITY_M_S2;

use serde::Serialize;

use super::process::{
    Contacts, OdePlant, OdeProgram, OdeRobot, STEPS_PER_SAMPLE, WHEELS, WheelContact,
};
use crate::rough::means::Means;
use crate::rough::spec::{Deviations, MAKES, Make};

/// Rim speed of the tests, metres per second.
const RIM_M_S: f64 = 0.6;
/// Samples after which a pulled robot moves steadily.
const STEADY_SAMPLES: u32 = 400;
/// Samples over which forces and slip are averaged.
const MEAN_SAMPLES: u32 = 50;
/// Limit of friction in the pull tests.
const PULL_MU_PEAK: f64 = 0.4;
/// Pulls over the limit of friction.
const PULLS: [f64; 4] = [-0.6, 0.3, 0.6, 0.85];
/// Limit of friction that no wheel reaches.
const UNLIMITED_MU: f64 = 10.0;
/// Friction coefficient below which the ratio of force to slip is not taken.
const MU_MIN: f64 = 0.01;
/// Samples of a drive by which steps are compared.
const COMPARED_SAMPLES: u32 = 1_000;
/// Steps in a sample that are compared with the last of them: 1, 0.5 and 0.25 ms.
const COMPARED_STEPS: [u32; 3] = [10, 20, 40];

/// Direction of a pull.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PullDirection {
    /// Against the robot's motion, or with it.
    Longitudinal,
    /// To the side.
    Lateral,
}

impl PullDirection {
    /// Both directions.
    pub const ALL: [Self; 2] = [Self::Longitudinal, Self::Lateral];

    /// Returns the name for reports.
    pub fn text(self) -> &'static str {
        match self {
            Self::Longitudinal => "longitudinal",
            Self::Lateral => "lateral",
        }
    }

    fn axis(self) -> usize {
        match self {
            Self::Longitudinal => 0,
            Self::Lateral => 1,
        }
    }

    fn force_n(self, size_n: f64) -> [f64; 2] {
        match self {
            Self::Longitudinal => [size_n, 0.0],
            Self::Lateral => [0.0, size_n],
        }
    }
}

/// What a pull with a known force showed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Pull {
    /// Direction of the pull.
    pub direction: PullDirection,
    /// θ of the simulator's parameters.
    pub theta: f64,
    /// Force that the wheels had to give, over the weight.
    pub mu: f64,
    /// Friction coefficient by the contacts' feedback, mean of the wheels.
    pub mu_of_contacts: f64,
    /// Slip by the motion of the bodies, mean of the wheels.
    pub slip: f64,
}

impl Pull {
    /// Returns the measured θ: slip over the known force.
    pub fn theta_measured(&self) -> f64 {
        self.slip / self.mu
    }
}

/// Input of [`pull`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PullInput {
    /// K of the simulator's ground.
    pub stiffness: f64,
    /// Direction of the pull.
    pub direction: PullDirection,
    /// Force over the limit of friction.
    pub over_peak: f64,
}

fn robot_of(make: Make, deviations: Deviations) -> anyhow::Result<RobotOf> {
    Ok(RobotOf {
        model: make.model()?,
        deviations,
    })
}

struct RobotOf {
    model: tread_control::robot::RobotModel,
    deviations: Deviations,
}

impl RobotOf {
    fn robot(&self, steps_per_sample: u32) -> OdeRobot<'_> {
        OdeRobot {
            model: &self.model,
            deviations: self.deviations,
            start: Pose::default(),
            contacts: Contacts::Elastic,
            steps_per_sample,
        }
    }

    fn straight(&self) -> WheelSpeeds {
        let rate_rad_s = RIM_M_S / self.model.wheel_radius_m();
        WheelSpeeds {
            left_rad_s: rate_rad_s,
            right_rad_s: rate_rad_s,
        }
    }
}

/// Mean slip and friction coefficient of each wheel over some samples.
fn steady(
    plant: &mut OdePlant,
    command: WheelSpeeds,
) -> anyhow::Result<[([f64; 2], [f64; 2]); WHEELS]> {
    for _ in 0..STEADY_SAMPLES {
        plant.advance(command)?;
    }
    let mut sums = [([0.0; 2], [0.0; 2]); WHEELS];
    for _ in 0..MEAN_SAMPLES {
        plant.advance(command)?;
        let contacts = plant.contacts()?;
        for ((slips, mus), contact) in sums.iter_mut().zip(&contacts) {
            let (slip, mu) = (WheelContact::slip(contact), contact.mu());
            for axis in 0..2 {
                slips[axis] += slip[axis] / f64::from(MEAN_SAMPLES);
                mus[axis] += mu[axis] / f64::from(MEAN_SAMPLES);
            }
        }
    }
    Ok(sums)
}

fn mean(of: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = of.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

/// Pulls a robot that drives straight by known forces, in both directions.
///
/// # Errors
/// The simulation failed.
pub fn pulls(program: &OdeProgram, stiffness: f64) -> anyhow::Result<Vec<Pull>> {
    let mut found = Vec::new();
    for direction in PullDirection::ALL {
        for over_peak in PULLS {
            let input = PullInput {
                stiffness,
                direction,
                over_peak,
            };
            found.push(pull(program, input)?);
        }
    }
    Ok(found)
}

/// Pulls a robot that drives straight by a force.
///
/// # Errors
/// The simulation failed.
pub fn pull(program: &OdeProgram, input: PullInput) -> anyhow::Result<Pull> {
    let PullInput {
        stiffness,
        direction,
        over_peak,
    } = input;
    let mut deviations = Deviations::none(stiffness);
    deviations.curve.mu_peak = PULL_MU_PEAK;
    deviations.relaxation_m = 0.04;
    deviations.rotor_ratio = 0.05;
    deviations.rolling_resistance_ratio = 0.0;
    let of = robot_of(MAKES[2], deviations)?;
    let robot = of.robot(STEPS_PER_SAMPLE);
    let mut plant = OdePlant::start(program, &robot)?;
    for _ in 0..STEADY_SAMPLES {
        plant.advance(of.straight())?;
    }
    let weight_n = robot.mass_kg() * GRAVITY_M_S2;
    let mu = over_peak * PULL_MU_PEAK;
    plant.pull(direction.force_n(-mu * weight_n))?;
    let wheels = steady(&mut plant, of.straight())?;
    let axis = direction.axis();
    Ok(Pull {
        direction,
        theta: deviations.curve.theta(),
        mu,
        mu_of_contacts: mean(wheels.iter().map(|(_, mu)| mu[axis])),
        slip: mean(wheels.iter().map(|(slip, _)| slip[axis])),
    })
}

/// Drives a robot with unequal loads around a circle and returns the largest relative difference of
/// a wheel's measured slip over friction coefficient from θ.
///
/// # Errors
/// The simulation failed.
pub fn unequal_loads(program: &OdeProgram, stiffness: f64) -> anyhow::Result<f64> {
    let mut deviations = Deviations::none(stiffness);
    deviations.center_forward_ratio = 0.15;
    deviations.center_left_ratio = -0.1;
    deviations.center_height_ratio = 0.5;
    // No wheel comes to the limit, where the ratio of force to slip is not K.
    deviations.curve.mu_peak = UNLIMITED_MU;
    deviations.relaxation_m = 0.04;
    let of = robot_of(MAKES[1], deviations)?;
    let mut plant = OdePlant::start(program, &of.robot(STEPS_PER_SAMPLE))?;
    let straight = of.straight();
    let command = WheelSpeeds {
        left_rad_s: 0.85 * straight.left_rad_s,
        right_rad_s: 1.15 * straight.right_rad_s,
    };
    let theta = deviations.curve.theta();
    let wheels = steady(&mut plant, command)?;
    let mut worst = 0.0_f64;
    for (slip, mu) in wheels {
        for axis in 0..2 {
            if mu[axis].abs() > MU_MIN {
                worst = worst.max((slip[axis] / mu[axis] / theta - 1.0).abs());
            }
        }
    }
    Ok(worst)
}

/// Differences of a drive from the same drive with smaller integration steps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StepDifference {
    /// Integration step, seconds.
    pub step_s: f64,
    /// Step of the drive that it is compared with, seconds.
    pub finest_s: f64,
    /// Distance between the ends of the drives, metres.
    pub end_m: f64,
    /// Difference of the headings at the end, radians.
    pub heading_rad: f64,
    /// RMS difference of the turn rates, radians per second.
    pub yaw_rate_rad_s: f64,
    /// RMS difference of the accelerations, metres per second squared.
    pub acceleration_m_s2: f64,
    /// RMS difference of a side's torque, as a friction coefficient.
    pub torque_mu: f64,
}

/// Drives a robot with given wheel speeds, 10 s of curves with changes of speed, with several
/// integration steps, and compares with the smallest.
///
/// # Errors
/// The simulation failed.
pub fn step_differences(
    program: &OdeProgram,
    make: Make,
    deviations: Deviations,
) -> anyhow::Result<Vec<StepDifference>> {
    let of = robot_of(make, deviations)?;
    let drives = COMPARED_STEPS.map(|steps| -> anyhow::Result<(Vec<Means>, Pose)> {
        let mut plant = OdePlant::start(program, &of.robot(steps))?;
        let straight = of.straight().left_rad_s;
        let mut means = Vec::new();
        for sample in 0..COMPARED_SAMPLES {
            let time_s = 0.01 * f64::from(sample);
            let speed = straight * (time_s / 2.0).min(1.0) * (1.0 + 0.2 * (2.5 * time_s).sin());
            let turn = 0.25 * (0.9 * time_s).sin();
            means.push(plant.advance(WheelSpeeds {
                left_rad_s: speed * (1.0 - turn),
                right_rad_s: speed * (1.0 + turn),
            })?);
        }
        Ok((
            means,
            crate::rough::drive::SimulatedPlant::truth(&plant)
                .state
                .pose,
        ))
    });
    let drives = drives.into_iter().collect::<Result<Vec<_>, _>>()?;
    let (Some((finest, finest_pose)), Some(finest_steps)) = (drives.last(), COMPARED_STEPS.last())
    else {
        return Ok(Vec::new());
    };
    let per_mu = 0.5 * of.model.mass_kg() * GRAVITY_M_S2 * of.model.wheel_radius_m();
    let rms = |means: &[Means], difference: &dyn Fn(&Means, &Means) -> f64| {
        let pairs = means.iter().zip(finest);
        mean(pairs.map(|(one, other)| difference(one, other).powi(2))).sqrt()
    };
    let of_steps = |(steps, (means, pose)): (u32, &(Vec<Means>, Pose))| StepDifference {
        step_s: 0.01 / f64::from(steps),
        finest_s: 0.01 / f64::from(*finest_steps),
        end_m: (pose.x_m - finest_pose.x_m).hypot(pose.y_m - finest_pose.y_m),
        heading_rad: wrap_angle_rad(pose.heading_rad - finest_pose.heading_rad).abs(),
        yaw_rate_rad_s: rms(means, &|one, other| {
            one.yaw_rate_rad_s - other.yaw_rate_rad_s
        }),
        acceleration_m_s2: rms(means, &|one, other| {
            (one.acceleration.forward_m_s2 - other.acceleration.forward_m_s2)
                .hypot(one.acceleration.left_m_s2 - other.acceleration.left_m_s2)
        }),
        torque_mu: rms(means, &|one, other| {
            (one.torques.left_n_m - other.torques.left_n_m) / per_mu
        }),
    };
    Ok(COMPARED_STEPS
        .into_iter()
        .zip(&drives)
        .map(of_steps)
        .filter(|difference| difference.step_s > difference.finest_s)
        .collect())
}
