//! Input and output types of the estimator.

use serde::{Deserialize, Serialize};

use super::manoeuvre::NoEstimate;
use crate::measured::{BodyAcceleration, GYRO_OFFSET_WALK, WheelSpeeds, WheelTorques};

/// Errors of the sensors: standard deviations of white noise per sample, unless stated otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SensorNoise {
    /// Noise of the gyro, radians per second.
    pub gyro_rad_s: f64,
    /// Noise of the accelerometer, metres per second squared.
    pub accelerometer_m_s2: f64,
    /// Standard deviation of the accelerometer's constant offset, metres per second squared.
    pub accelerometer_offset_m_s2: f64,
    /// Standard deviation of the accelerometer's relative scale error. Sampling of a rough motion
    /// has the same effect, because motion between samples is not measured.
    pub accelerometer_scale_ratio: f64,
    /// Noise of a wheel speed, radians per second.
    pub wheel_speed_rad_s: f64,
    /// Noise of the body speed, metres per second.
    pub body_speed_m_s: f64,
    /// Noise of a side's wheel torque, over wheel radius and the side's load: as a friction
    /// coefficient.
    pub torque_mu: f64,
    /// Standard deviation of the relative error of each side's torque constant.
    pub torque_gain_ratio: f64,
    /// Standard deviation of the relative error of each side's rolling radius.
    pub radius_ratio: f64,
    /// Standard deviation of the gyro's constant offset, radians per second.
    pub gyro_offset_rad_s: f64,
    /// Random walk of that offset, radians per second per square root of a second.
    #[serde(default = "usual_gyro_offset_walk")]
    pub gyro_offset_walk: f64,
}

fn usual_gyro_offset_walk() -> f64 {
    GYRO_OFFSET_WALK
}

impl Default for SensorNoise {
    fn default() -> Self {
        Self {
            gyro_rad_s: 0.003,
            accelerometer_m_s2: 0.05,
            accelerometer_offset_m_s2: 0.02,
            accelerometer_scale_ratio: 0.03,
            wheel_speed_rad_s: 0.02,
            body_speed_m_s: 0.02,
            torque_mu: 0.01,
            torque_gain_ratio: 0.02,
            radius_ratio: 0.0115,
            gyro_offset_rad_s: 0.002,
            gyro_offset_walk: GYRO_OFFSET_WALK,
        }
    }
}

/// Prior of the tyres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TyrePrior {
    /// Standard deviation of the relative difference of lateral and longitudinal tyre stiffness. It
    /// is estimated in turns and matters only until then.
    #[serde(alias = "side_grip_spread")]
    pub lateral_stiffness_std_dev: f64,
    /// Mean of θκ in `λ = θμ(1 + κλ + ⅔κ²λ²)`, per friction coefficient: 0 for the paper's linear
    /// curve, `1/(3μ_p)` for a brush model with the peak `μ_p`. Where all parameters are identified it
    /// counts if its standard deviation is below that of unknown tyres.
    pub curvature: f64,
    /// Standard deviation of θκ, per friction coefficient. Turns of one radius do not excite θκ, so
    /// its uncertainty widens the intervals of θ.
    pub curvature_std_dev: f64,
    /// Largest friction coefficient at which this curve is valid, below the smallest possible peak;
    /// `None` if only slip limits it. Where all parameters are identified the peak follows it.
    pub mu_max: Option<f64>,
    /// Mean of the contacts' relaxation length at zero slip, metres: the rolling distance in which
    /// force follows slip.
    #[serde(default)]
    pub relaxation_m: f64,
    /// Standard deviation of the relaxation length, metres.
    #[serde(default)]
    pub relaxation_std_dev_m: f64,
    /// Mean ratio of the inertia of wheels and rotors, at the rim, to the robot's mass.
    #[serde(default)]
    pub rotor_ratio: f64,
    /// Standard deviation of `rotor_ratio`.
    #[serde(default)]
    pub rotor_std_dev_ratio: f64,
    /// Standard deviation of the difference of the sides' loads over their sum; its mean is 0.
    #[serde(default)]
    pub load_difference_std_dev: f64,
    /// Relative error of θ if nearly all of the residuals are model errors. With 0 the model counts
    /// as exact, and residuals beyond the noise count as additional noise.
    #[serde(default)]
    pub unexplained_ratio: f64,
}

/// Prior of the robot's mass and yaw inertia, relative to those of the model.
///
/// The estimator corrects it by the apparent mass and the identification, as far as the sensors
/// show them. What remains is an error that all measurements of the robot have in common.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ModelUncertainty {
    /// Standard deviation of the mass, relative to the model's. An error of the mass scales θ from
    /// measured torques. 0: the mass is exact, and the apparent mass is not used.
    pub mass_ratio: f64,
    /// Mean payload, relative to the model's mass.
    #[serde(default)]
    pub payload_ratio: f64,
    /// Standard deviation of the ratio of yaw inertia to mass, relative to the model's; it scales θ
    /// from turns without measured torque.
    pub inertia_ratio: f64,
}

impl Default for ModelUncertainty {
    /// Returns the uncertainty of a robot with some payload, known only by its data sheet.
    fn default() -> Self {
        Self {
            mass_ratio: 0.12,
            payload_ratio: 0.1,
            inertia_ratio: 0.15,
        }
    }
}

impl ModelUncertainty {
    /// Returns no uncertainty: a robot with measured mass and inertia.
    pub fn exact() -> Self {
        Self {
            mass_ratio: 0.0,
            payload_ratio: 0.0,
            inertia_ratio: 0.0,
        }
    }
}

/// Prior of a robot and its tyres. The default is for a robot known only by its data sheet, with
/// unknown tyres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EstimatorPrior {
    /// Prior of the tyres.
    pub tyres: TyrePrior,
    /// Uncertainty of the robot's model.
    pub model: ModelUncertainty,
}

impl Default for EstimatorPrior {
    fn default() -> Self {
        Self {
            tyres: TyrePrior::unknown(),
            model: ModelUncertainty::default(),
        }
    }
}

impl EstimatorPrior {
    /// Returns the prior of a robot that equals its model, with linear tyres, as in the paper.
    pub fn exact() -> Self {
        Self {
            tyres: TyrePrior::default(),
            model: ModelUncertainty::exact(),
        }
    }
}

/// A tyre's curvature κ at one θ, per slip.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Curvature {
    /// Mean of κ.
    pub(super) mean: f64,
    /// Standard deviation of κ.
    pub(super) std_dev: f64,
}

impl TyrePrior {
    /// Returns the prior of unknown tyres: from linear to as curved as a `LuGre` tyre with a peak
    /// of 0.5, with the relaxation lengths of small tyres, the wheels and rotors of geared motors
    /// and an eccentric load. The largest friction coefficient is below the peak on wet grass or
    /// loose gravel (0.3), because slip beyond a peak looks like a small stiffness.
    pub fn unknown() -> Self {
        Self {
            curvature: 1.0,
            curvature_std_dev: 1.0,
            mu_max: Some(0.25),
            relaxation_m: 0.04,
            relaxation_std_dev_m: 0.03,
            rotor_ratio: 0.1,
            rotor_std_dev_ratio: 0.08,
            load_difference_std_dev: 0.05,
            unexplained_ratio: 0.1,
            ..Self::default()
        }
    }

    /// Returns the largest slip at which the curve is valid, for a `theta` above zero.
    pub(super) fn slip_max(&self, theta: f64) -> f64 {
        self.mu_max.map_or(f64::INFINITY, |mu_max| mu_max * theta)
    }

    /// Returns κ for a `theta` above zero.
    pub(super) fn at(&self, theta: f64) -> Curvature {
        Curvature {
            mean: self.curvature / theta,
            std_dev: self.curvature_std_dev / theta,
        }
    }
}

impl Default for TyrePrior {
    /// Returns tyres with a linear curve up to the peak, as in the paper's (7).
    fn default() -> Self {
        Self {
            lateral_stiffness_std_dev: 0.3,
            curvature: 0.0,
            curvature_std_dev: 0.0,
            mu_max: None,
            relaxation_m: 0.0,
            relaxation_std_dev_m: 0.0,
            rotor_ratio: 0.0,
            rotor_std_dev_ratio: 0.0,
            load_difference_std_dev: 0.0,
            unexplained_ratio: 0.0,
        }
    }
}

/// One sample of the robot's own sensors.
///
/// Wheel speeds, turn rate and acceleration are means since the previous sample, as from
/// incremental encoders and from inertial sensors with an anti-aliasing filter. Instantaneous
/// values suffice if nothing changes faster than the sampling rate.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SensorSample {
    /// Measured wheel speeds.
    pub wheel_speeds: WheelSpeeds,
    /// Turn rate, radians per second, counter-clockwise positive.
    pub gyro_rad_s: f64,
    /// Acceleration along the ground, body frame, if measured.
    pub acceleration: Option<BodyAcceleration>,
    /// Whether `acceleration` is the specific force, as of a unit without attitude: on a slope it
    /// contains gravity's reaction. Otherwise it is without gravity.
    pub is_specific_force: bool,
    /// Forward speed, metres per second; only in samples with a new measurement.
    pub body_speed_m_s: Option<f64>,
    /// Drive torques at the wheels per side, if the base measures them.
    pub wheel_torques: Option<WheelTorques>,
}

/// Standard deviations of the errors of θ that do not average out over drives of one robot on one
/// ground.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct CommonError {
    /// Error common to all measurements of one robot: mass, yaw inertia, torque constants, and in a
    /// segment the remaining uncertainty of radii and sensor offsets.
    pub robot: f64,
    /// Error from the friction curve of the tyres and from slip that does not follow the model,
    /// common to all robots with the same tyres at similar slip.
    pub tyres: f64,
}

impl CommonError {
    /// Returns the standard deviation of both errors together.
    pub fn std_dev(&self) -> f64 {
        self.robot.hypot(self.tyres)
    }
}

/// Measurement of θ of the ground under the robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThetaMeasurement {
    /// Slip compliance θ = 1/K, without a unit, above 0.
    pub theta: f64,
    /// Standard deviation of θ, including offsets and all common errors.
    pub std_dev: f64,
    /// Standard deviation of θ without the common errors, for comparing measurements of one robot.
    pub own_std_dev: f64,
    /// Common errors of θ.
    pub common: CommonError,
    /// Effective number of rows, blocks and forward speeds, weighted by their information; for a
    /// robot without an exact model, the number of blocks of 0.2 s.
    pub effective_samples: f64,
    /// Duration of the blocks used, seconds.
    pub duration_s: f64,
}

/// Estimate of one parameter of the robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IdentifiedValue {
    /// Estimated value, in the parameter's unit.
    pub value: f64,
    /// Standard deviation of its error, in the same unit.
    pub std_dev: f64,
    /// Whether the estimate is prior-dominated: its variance is more than half of the prior
    /// variance.
    pub is_prior_dominated: bool,
}

/// The robot's own parameters, estimated together with θ.
///
/// On flat ground torques and accelerations determine only the apparent mass; the mass itself also
/// depends on the priors of torque constants and rotors. Without wheel torques no mass is
/// observable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IdentifiedRobot {
    /// Apparent mass `s (m + j)` relative to the model's mass: torque scale s, mass m with payload,
    /// and inertia j of rotors and wheels over the square of the wheel radius.
    pub apparent_mass_ratio: IdentifiedValue,
    /// Mass with payload, kilograms.
    pub mass_kg: IdentifiedValue,
    /// Ratio of yaw inertia to mass, relative to the model's.
    pub inertia_ratio: IdentifiedValue,
    /// Centre of mass forward of the centre of the wheels, metres.
    pub centre_forward_m: IdentifiedValue,
    /// Centre of mass to the left of the centre of the wheels, metres.
    pub centre_left_m: IdentifiedValue,
}

/// A change of the payload during a standstill.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PayloadChange {
    /// Apparent mass relative to the model's mass, before the standstill.
    pub before: ValueWithStdDev,
    /// Apparent mass relative to the model's mass, since the standstill.
    pub after: ValueWithStdDev,
}

/// Estimates of the present ground and of the robot.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Estimate {
    /// θ of the present ground; `None` without excitation.
    pub theta: Option<ThetaMeasurement>,
    /// Why there is no θ, or none whose 95 % interval is narrower than ± 60 %; `None` if there is one.
    pub no_estimate: Option<NoEstimate>,
    /// Whether the motion of about the last two seconds did not excite θ.
    pub no_new_information: bool,
    /// Lower bound of the peak friction coefficient: what several blocks used, for the heaviest
    /// load that the torques allow; `None` before any force.
    pub mu_peak_lower_bound: Option<f64>,
    /// Ratio of effective to geometric track width; `None` before enough turning.
    pub effective_track_ratio: Option<f64>,
    /// Rolling resistance coefficient; `None` before enough straight driving with torque.
    pub rolling_resistance_ratio: Option<f64>,
    /// Mean relative error of the nominal rolling radii, positive if they are too large.
    pub radius_offset: ValueWithStdDev,
    /// Right minus left relative error of the nominal rolling radii.
    pub radius_difference: ValueWithStdDev,
    /// Fraction of blocks beyond the linear range of slip, among those with sufficient speed.
    pub saturation_share: f64,
    /// Root mean square of the residuals of the worst channel, in their assumed standard
    /// deviations, where it is so large that the model does not describe the robot and there is no
    /// θ.
    pub misfit_ratio: Option<f64>,
    /// Factor by which residuals of the newest seconds exceed those before, where they contradict the
    /// estimate so much that there is no θ.
    pub newest_misfit_ratio: Option<f64>,
    /// Delays of gyro and accelerometer, where they are too large or have changed, so that there is no θ.
    pub late_sensor: Option<LateSensor>,
    /// Wheel torques that the sensor repeats to the last bit while the robot drives; θ is estimated without
    /// them.
    pub frozen_torque: Option<WheelTorques>,
    /// Number of samples dropped because they were not finite or not plausible.
    pub dropped_samples: u64,
    /// The robot's own parameters; `None` if the model counts as exact, and before enough blocks.
    pub robot: Option<IdentifiedRobot>,
    /// The last change of the payload, for ten minutes of samples.
    pub payload_change: Option<PayloadChange>,
}

/// Delays of the inertial sensors relative to the wheel speeds, by their time stamps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorDelays {
    /// Delay of the gyro, seconds.
    pub gyro_s: f64,
    /// Delay of the accelerometer, seconds.
    pub accelerometer_s: f64,
}

/// Delays of which at least one is too large, or has changed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LateSensor {
    /// Delays in the newest seconds; the identified ones where these do not show any.
    pub newest: SensorDelays,
    /// Delays that the estimate assumes.
    pub identified: SensorDelays,
}

/// An estimated value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ValueWithStdDev {
    /// Estimated value, in the unit of the estimated quantity.
    pub value: f64,
    /// Standard deviation of its error, in the same unit.
    pub std_dev: f64,
}

/// Result of adding a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct UpdateOutcome {
    /// Whether a block of samples was completed and used.
    pub block_done: bool,
    /// Whether a wheel slipped beyond the linear range in that block.
    pub slips: bool,
    /// Whether the ground has changed; then close the segment and call
    /// [`super::Estimator::begin_ground`].
    pub ground_changed: bool,
}
