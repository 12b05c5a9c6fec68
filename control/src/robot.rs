//! Physical parameters and limits of a robot, validated once, and the kinematics that follow from
//! them.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::geometry::Twist;
use crate::measured::WheelSpeeds;

/// Standard gravity, metres per second squared.
pub const GRAVITY_M_S2: f64 = 9.806_65;

/// Fraction of `μg` that a plan may use along the path.
const TRACTION_SHARE_LONGITUDINAL: f64 = 0.58;
/// Fraction of `μg` that a plan may use across the path. Both fractions together leave three tenths
/// (in root sum of squares) for turning the body and for feedback.
const TRACTION_SHARE_LATERAL: f64 = 0.4;

/// Speed and acceleration limits of a robot. Every value is finite and above zero.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Limits {
    /// Maximum angular speed of a wheel, radians per second.
    pub wheel_speed_max_rad_s: f64,
    /// Maximum angular acceleration of a wheel, radians per second squared.
    pub wheel_acceleration_max_rad_s2: f64,
    /// Maximum speed along the path, metres per second.
    pub linear_max_m_s: f64,
    /// Maximum turn rate of the body, radians per second.
    pub angular_max_rad_s: f64,
    /// Maximum acceleration and deceleration along the path, metres per second squared.
    pub linear_acceleration_max_m_s2: f64,
    /// Maximum jerk along the path, metres per second cubed.
    pub linear_jerk_max_m_s3: f64,
    /// Maximum lateral acceleration, metres per second squared.
    pub lateral_acceleration_max_m_s2: f64,
}

/// Robot parameters as in a file or message, not yet validated.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RobotModelSpec {
    /// Mass m, kilograms.
    pub mass_kg: f64,
    /// Track width W: distance between the left and right wheels' contacts, metres.
    pub track_width_m: f64,
    /// Wheelbase L: distance between the front and rear wheels' contacts, metres.
    pub wheelbase_m: f64,
    /// Rolling radius r of a wheel, metres.
    pub wheel_radius_m: f64,
    /// Yaw inertia `I_G` about the vertical axis through the centre of mass, kg m².
    pub yaw_inertia_kg_m2: f64,
    /// Speed and acceleration limits.
    pub limits: Limits,
}

/// Robot parameter that is out of its range.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum RobotModelError {
    /// A value is NaN, infinite, zero or negative.
    #[error("`{field}` must be finite and above zero, not {value}")]
    NotPositive {
        /// Name of the field.
        field: &'static str,
        /// Rejected value.
        value: f64,
    },
}

/// Validated robot parameters: every value is finite and above zero.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "RobotModelSpec", into = "RobotModelSpec")]
pub struct RobotModel {
    spec: RobotModelSpec,
}

impl TryFrom<RobotModelSpec> for RobotModel {
    type Error = RobotModelError;

    fn try_from(spec: RobotModelSpec) -> Result<Self, Self::Error> {
        let limits = spec.limits;
        let fields = [
            ("mass_kg", spec.mass_kg),
            ("track_width_m", spec.track_width_m),
            ("wheelbase_m", spec.wheelbase_m),
            ("wheel_radius_m", spec.wheel_radius_m),
            ("yaw_inertia_kg_m2", spec.yaw_inertia_kg_m2),
            ("wheel_speed_max_rad_s", limits.wheel_speed_max_rad_s),
            (
                "wheel_acceleration_max_rad_s2",
                limits.wheel_acceleration_max_rad_s2,
            ),
            ("linear_max_m_s", limits.linear_max_m_s),
            ("angular_max_rad_s", limits.angular_max_rad_s),
            (
                "linear_acceleration_max_m_s2",
                limits.linear_acceleration_max_m_s2,
            ),
            ("linear_jerk_max_m_s3", limits.linear_jerk_max_m_s3),
            (
                "lateral_acceleration_max_m_s2",
                limits.lateral_acceleration_max_m_s2,
            ),
        ];
        for (field, value) in fields {
            if !value.is_finite() || value <= 0.0 {
                return Err(RobotModelError::NotPositive { field, value });
            }
        }
        Ok(Self { spec })
    }
}

impl From<RobotModel> for RobotModelSpec {
    fn from(model: RobotModel) -> Self {
        model.spec
    }
}

impl RobotModel {
    /// Returns the robot of Yi, Song, Zhang and Goodwin, section IV. The limits are not from the
    /// paper.
    pub fn yi2007() -> Self {
        Self {
            spec: RobotModelSpec {
                mass_kg: 5.0,
                track_width_m: 0.43,
                wheelbase_m: 0.28,
                wheel_radius_m: 0.08,
                yaw_inertia_kg_m2: 0.45,
                limits: Limits {
                    wheel_speed_max_rad_s: 20.0,
                    wheel_acceleration_max_rad_s2: 60.0,
                    linear_max_m_s: 1.0,
                    angular_max_rad_s: 2.0,
                    linear_acceleration_max_m_s2: 0.8,
                    linear_jerk_max_m_s3: 4.0,
                    lateral_acceleration_max_m_s2: 1.0,
                },
            },
        }
    }

    /// Returns the mass m, kilograms.
    pub fn mass_kg(&self) -> f64 {
        self.spec.mass_kg
    }

    /// Returns the track width W, metres.
    pub fn track_width_m(&self) -> f64 {
        self.spec.track_width_m
    }

    /// Returns the wheelbase L, metres.
    pub fn wheelbase_m(&self) -> f64 {
        self.spec.wheelbase_m
    }

    /// Returns the rolling radius r of a wheel, metres.
    pub fn wheel_radius_m(&self) -> f64 {
        self.spec.wheel_radius_m
    }

    /// Returns the yaw inertia `I_G`, kg m².
    pub fn yaw_inertia_kg_m2(&self) -> f64 {
        self.spec.yaw_inertia_kg_m2
    }

    /// Returns the speed and acceleration limits.
    pub fn limits(&self) -> &Limits {
        &self.spec.limits
    }

    /// Returns the normal force on the two wheels of one side at standstill on level ground,
    /// `mg/2`, newtons.
    pub fn side_load_n(&self) -> f64 {
        self.spec.mass_kg * GRAVITY_M_S2 / 2.0
    }

    /// Returns this robot with acceleration limits lowered to what a peak friction coefficient
    /// allows.
    ///
    /// Only fractions of `μg` are used along and across the path: the rest serves turning of the
    /// body and feedback.
    pub(crate) fn within_traction_limit(&self, mu_peak: f64) -> Self {
        let longitudinal_m_s2 = Self::longitudinal_traction_m_s2(mu_peak);
        let lateral_m_s2 = Self::lateral_traction_m_s2(mu_peak);
        let mut spec = self.spec;
        let limits = &mut spec.limits;
        limits.linear_acceleration_max_m_s2 =
            limits.linear_acceleration_max_m_s2.min(longitudinal_m_s2);
        limits.lateral_acceleration_max_m_s2 =
            limits.lateral_acceleration_max_m_s2.min(lateral_m_s2);
        Self { spec }
    }

    /// Returns the acceleration along the path that a plan may use on ground with a peak friction
    /// coefficient, a fixed fraction of `μg`, metres per second squared.
    pub fn longitudinal_traction_m_s2(mu_peak: f64) -> f64 {
        TRACTION_SHARE_LONGITUDINAL * mu_peak * GRAVITY_M_S2
    }

    /// Returns the lateral acceleration that a plan may use on ground with a peak friction
    /// coefficient, a fixed fraction of `μg`, metres per second squared.
    pub fn lateral_traction_m_s2(mu_peak: f64) -> f64 {
        TRACTION_SHARE_LATERAL * mu_peak * GRAVITY_M_S2
    }

    /// Returns `W_eff/W = 1 + (L/W)²`, valid at low speed for every friction. (Moment balance of
    /// four isotropic contacts in the linear range of (7).)
    pub fn effective_track_ratio(&self) -> f64 {
        1.0 + (self.spec.wheelbase_m / self.spec.track_width_m).powi(2)
    }

    /// Returns the effective track width `W_eff`, metres, which relates wheel speeds to the turn
    /// rate.
    pub fn effective_track_m(&self) -> f64 {
        self.spec.track_width_m * self.effective_track_ratio()
    }

    /// Returns the maximum angular acceleration, radians per second squared: that at which the rim
    /// acceleration of turning on the spot equals the linear acceleration limit or the wheels'
    /// limit, whichever is smaller.
    pub fn angular_acceleration_max_rad_s2(&self) -> f64 {
        let limits = self.limits();
        let rim_max_m_s2 = limits.wheel_acceleration_max_rad_s2 * self.spec.wheel_radius_m;
        limits.linear_acceleration_max_m_s2.min(rim_max_m_s2) / (0.5 * self.effective_track_m())
    }

    /// Returns the wheel speeds for a twist by the low-speed kinematics, `ω_l = (v − ½ W_eff φ̇)/r`
    /// and `ω_r = (v + ½ W_eff φ̇)/r`; not limited.
    pub fn wheel_speeds_from_twist(&self, twist: Twist) -> WheelSpeeds {
        let half_m_s = 0.5 * self.effective_track_m() * twist.angular_rad_s;
        WheelSpeeds {
            left_rad_s: (twist.linear_m_s - half_m_s) / self.spec.wheel_radius_m,
            right_rad_s: (twist.linear_m_s + half_m_s) / self.spec.wheel_radius_m,
        }
    }

    /// Returns the twist of wheel speeds by the low-speed kinematics, `v = r (ω_l + ω_r)/2` and
    /// `φ̇ = r (ω_r − ω_l)/W_eff`.
    pub fn twist_from_wheel_speeds(&self, wheels: WheelSpeeds) -> Twist {
        let radius_m = self.spec.wheel_radius_m;
        Twist {
            linear_m_s: 0.5 * radius_m * (wheels.left_rad_s + wheels.right_rad_s),
            angular_rad_s: radius_m * (wheels.right_rad_s - wheels.left_rad_s)
                / self.effective_track_m(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_that_is_not_positive_is_refused_by_name() {
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let mut spec = RobotModelSpec::from(RobotModel::yi2007());
            spec.limits.linear_jerk_max_m_s3 = bad;
            let error = RobotModel::try_from(spec).unwrap_err();
            assert!(
                error.to_string().contains("linear_jerk_max_m_s3"),
                "{error}"
            );
        }
    }

    #[test]
    fn a_model_survives_json_and_a_bad_one_does_not_get_in() {
        let model = RobotModel::yi2007();
        let text = serde_json::to_string(&model).unwrap();
        assert_eq!(serde_json::from_str::<RobotModel>(&text).unwrap(), model);
        let bad = text.replace("\"wheelbase_m\":0.28", "\"wheelbase_m\":0.0");
        assert!(serde_json::from_str::<RobotModel>(&bad).is_err());
    }

    #[test]
    fn wheel_speeds_and_twist_are_inverse() {
        let model = RobotModel::yi2007();
        let twist = Twist {
            linear_m_s: 0.7,
            angular_rad_s: -0.4,
        };
        let back = model.twist_from_wheel_speeds(model.wheel_speeds_from_twist(twist));
        assert!((back.linear_m_s - twist.linear_m_s).abs() < 1.0e-12);
        assert!((back.angular_rad_s - twist.angular_rad_s).abs() < 1.0e-12);
    }
}
