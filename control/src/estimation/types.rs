//! What goes into the estimator, and what comes out of it.

use serde::{Deserialize, Serialize};

use crate::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};

/// Noise of the sensors; white, one standard deviation per sample, unless said otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SensorNoise {
    /// Gyro, radians per second.
    pub gyro_rad_s: f64,
    /// Accelerometer, metres per second squared.
    pub accelerometer_m_s2: f64,
    /// Offset of the accelerometer, unknown, metres per second squared.
    pub accelerometer_offset_m_s2: f64,
    /// Error of the accelerometer's scale, unknown, share. Sampling a rough drive has the same
    /// effect: what lies between two samples is not seen.
    pub accelerometer_scale_ratio: f64,
    /// Wheel speed, radians per second.
    pub wheel_speed_rad_s: f64,
    /// Body speed, metres per second.
    pub body_speed_m_s: f64,
    /// Wheel torque, as friction coefficient of one side.
    pub torque_mu: f64,
    /// Error of each side's torque constant, unknown, share.
    pub torque_gain_ratio: f64,
    /// Error of each side's rolling radius, unknown, share.
    pub radius_ratio: f64,
    /// Offset of the gyro, unknown, radians per second.
    pub gyro_offset_rad_s: f64,
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
        }
    }
}

/// What is known about the tyres beforehand.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TyrePrior {
    /// How far the tyres' stiffness across may differ from that along, one standard deviation as
    /// a share. It is learned from turning; it only matters until then.
    #[serde(alias = "side_grip_spread")]
    pub lateral_stiffness_std_dev: f64,
    /// Mean θκ of `λ = θμ(1 + κλ + ⅔κ²λ²)`, per friction coefficient: 0 for the paper's straight
    /// rise, `1/(3μ_p)` for a brush-like tyre of peak `μ_p`.
    pub curvature: f64,
    /// Its standard deviation, per friction coefficient. It cannot be learned from turns of one
    /// radius: where it is above zero, intervals are as wide as it makes them.
    pub curvature_std_dev: f64,
    /// Largest friction coefficient at which the rise is as above, somewhat less than the least
    /// peak that the tyres may have; none if only slip limits it.
    pub mu_max: Option<f64>,
    /// Mean of the contacts' relaxation length, metres: the distance over which force follows slip.
    #[serde(default)]
    pub relaxation_m: f64,
    /// Its standard deviation, metres.
    #[serde(default)]
    pub relaxation_std_dev_m: f64,
    /// Mean inertia of what turns with the tyres, at their rim, over the robot's mass.
    #[serde(default)]
    pub rotor_ratio: f64,
    /// Its standard deviation.
    #[serde(default)]
    pub rotor_std_dev_ratio: f64,
    /// Standard deviation of the difference of the sides' loads over their sum; its mean is 0.
    #[serde(default)]
    pub load_difference_std_dev: f64,
    /// Error of θ, as a share, where nearly all of the residuals is what rows do not know. Where it
    /// is 0 the model counts as exact, and residuals beyond the noise as more noise.
    #[serde(default)]
    pub unexplained_ratio: f64,
}

/// How far a robot may differ from its model, one standard deviation each as a share. These are
/// errors of all that a robot measures, and no drive on one ground tells them apart from θ.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ModelUncertainty {
    /// Mass, which measured torques are taken over.
    pub mass_ratio: f64,
    /// By how much more than its model it weighs on average. Robots are loaded, not lightened.
    #[serde(default)]
    pub payload_ratio: f64,
    /// Yaw inertia over mass, which turns are taken over where torque is not measured.
    pub inertia_ratio: f64,
}

impl Default for ModelUncertainty {
    /// Of a robot of which only the data sheet is known, with some payload.
    fn default() -> Self {
        Self {
            mass_ratio: 0.12,
            payload_ratio: 0.1,
            inertia_ratio: 0.15,
        }
    }
}

impl ModelUncertainty {
    /// Of a robot that was weighed.
    pub fn exact() -> Self {
        Self {
            mass_ratio: 0.0,
            payload_ratio: 0.0,
            inertia_ratio: 0.0,
        }
    }
}

/// What is known beforehand of a robot and its tyres. The default fits one of which only the data
/// sheet is known, on tyres of which nothing is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EstimatorPrior {
    /// Its tyres.
    pub tyres: TyrePrior,
    /// How far it may differ from its model.
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
    /// A robot that is as its model says, on tyres that rise straight: the paper's.
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
    /// Mean.
    pub(super) mean: f64,
    /// Standard deviation.
    pub(super) std_dev: f64,
}

impl TyrePrior {
    /// Tyres of which nothing is known: straight, or as curved as a `LuGre` tyre of a peak of 0.5,
    /// with the relaxation lengths of small tyres, the rotors of geared motors, and a load off the
    /// middle. The largest friction coefficient is below the peak of wet grass or loose gravel
    /// (0.3), since slip beyond a peak looks like a small stiffness.
    pub fn unknown() -> Self {
        Self {
            curvature: 1.0,
            curvature_std_dev: 1.0,
            mu_max: Some(0.25),
            relaxation_m: 0.04,
            relaxation_std_dev_m: 0.03,
            rotor_ratio: 0.05,
            rotor_std_dev_ratio: 0.04,
            load_difference_std_dev: 0.05,
            unexplained_ratio: 0.1,
            ..Self::default()
        }
    }

    /// Largest slip at which the rise is as above, at a θ above zero.
    pub(super) fn slip_max(&self, theta: f64) -> f64 {
        self.mu_max.map_or(f64::INFINITY, |mu_max| mu_max * theta)
    }

    /// κ at a θ above zero.
    pub(super) fn at(&self, theta: f64) -> Curvature {
        Curvature {
            mean: self.curvature / theta,
            std_dev: self.curvature_std_dev / theta,
        }
    }
}

impl Default for TyrePrior {
    /// Tyres that rise straight to their peak, as the paper's (7).
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
/// Wheel speeds, turn rate and acceleration are means since the sample before, as encoders that
/// count and inertial sensors with a filter against aliasing give them. Values of the moment do as
/// well where nothing changes faster than the samples come.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SensorSample {
    /// Measured wheel speeds.
    pub wheel_speeds: WheelSpeeds,
    /// Turn rate, radians per second.
    pub gyro_rad_s: f64,
    /// Acceleration without gravity, body frame.
    pub acceleration: Option<BodyAcceleration>,
    /// Speed ahead, metres per second; only in the sample in which it is new.
    pub body_speed_m_s: Option<f64>,
    /// Drive torques per side, where the base gives them.
    pub wheel_torques: Option<WheelTorques>,
}

/// Standard deviations of the errors of θ that no drive of a robot on one ground averages out.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct CommonError {
    /// Of what is the robot's: mass, yaw inertia, torque constants, and of a segment what is left
    /// unknown of radii and sensor offsets. One error of all that it measures.
    pub robot: f64,
    /// Of the tyres' curvature. One error of all robots on these tyres, where they slip alike.
    pub tyres: f64,
}

impl CommonError {
    /// Both together.
    pub fn std_dev(&self) -> f64 {
        self.robot.hypot(self.tyres)
    }
}

/// What is known about the ground under the robot now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThetaMeasurement {
    /// θ = 1/K.
    pub theta: f64,
    /// Its standard deviation, with that of the offsets and of all common errors.
    pub std_dev: f64,
    /// Standard deviation without the common errors: that of a robot compared with itself.
    pub own_std_dev: f64,
    /// The common errors.
    pub common: CommonError,
    /// Blocks that carry the measurement, weighed by their share of its information.
    pub effective_samples: f64,
    /// Time that was used, seconds.
    pub duration_s: f64,
}

/// A parameter of the robot that was identified.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IdentifiedValue {
    /// Its value.
    pub value: f64,
    /// Its standard deviation.
    pub std_dev: f64,
    /// Whether most of what is known of it was known beforehand: its variance is more than half of
    /// that of the prior.
    pub is_mostly_prior: bool,
}

/// The robot's own parameters, as they were identified together with θ.
///
/// On flat ground torques and accelerations tell only the apparent mass, so that the mass itself
/// rests on what is known of torque constants and rotors. Without torque nothing tells a mass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IdentifiedRobot {
    /// Apparent mass `s (m + j)` over the mass of the model: torque scale s, mass m with payload, and
    /// inertia j of rotors and wheels at the rim.
    pub apparent_mass_ratio: IdentifiedValue,
    /// Mass with payload, kilograms.
    pub mass_kg: IdentifiedValue,
    /// Yaw inertia over mass, over that of the model.
    pub inertia_ratio: IdentifiedValue,
    /// Centre of mass forward of the centre of the wheels, metres.
    pub centre_forward_m: IdentifiedValue,
    /// Centre of mass to the left of it, metres.
    pub centre_left_m: IdentifiedValue,
}

/// A change of the load.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PayloadChange {
    /// Apparent mass over the mass of the model before the robot stood.
    pub before: ValueWithDeviation,
    /// The same since then.
    pub after: ValueWithDeviation,
}

/// What the estimator can say.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Estimate {
    /// θ of the present ground; none while it is unexcited.
    pub theta: Option<ThetaMeasurement>,
    /// Whether the last block brought no new information on θ.
    pub no_new_information: bool,
    /// Friction coefficient that the ground has given at least; none before any force.
    pub mu_peak_lower_bound: Option<f64>,
    /// Measured effective track over W; none before enough turning.
    pub effective_track_ratio: Option<f64>,
    /// Rolling resistance over load; none before enough straight driving with torque.
    pub rolling_resistance_ratio: Option<f64>,
    /// Mean share by which the nominal rolling radii are too large, and its standard deviation.
    pub radius_offset: ValueWithDeviation,
    /// Right minus left of the same, and its standard deviation.
    pub radius_difference: ValueWithDeviation,
    /// Share of blocks beyond the linear range of slip, of those driven fast enough.
    pub saturation_share: f64,
    /// Samples dropped because they were not finite or not possible.
    pub dropped_samples: u64,
    /// The robot's own parameters; none of a robot that counts as exactly as its model says, and
    /// before anything is known.
    pub robot: Option<IdentifiedRobot>,
    /// The last change of the load, for ten minutes of driving.
    pub payload_change: Option<PayloadChange>,
}

/// A figure and its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ValueWithDeviation {
    /// The figure.
    pub value: f64,
    /// Its standard deviation.
    pub std_dev: f64,
}

/// What a sample led to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct UpdateOutcome {
    /// A block of samples was finished and used.
    pub block_done: bool,
    /// In that block a wheel slipped beyond the range in which force grows with slip.
    pub slips: bool,
    /// The ground has changed: close the segment and call [`super::Estimator::begin_ground`].
    pub ground_changed: bool,
}
