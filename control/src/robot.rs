//! A robot's fixed properties, checked once.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::geometry::Twist;
use crate::measured::WheelSpeeds;

/// Standard gravity, metres per second squared.
pub const GRAVITY_M_S2: f64 = 9.806_65;

/// Share of the traction limit that a plan may use along the path.
const TRACTION_SHARE_LONGITUDINAL: f64 = 0.58;
/// Share of the traction limit that a plan may use across the path: both together leave three tenths for
/// turning the body and for feedback.
const TRACTION_SHARE_LATERAL: f64 = 0.4;

/// What a robot may do at most. Every figure is finite and above zero.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Limits {
    /// Fastest turn of a wheel, radians per second.
    pub wheel_speed_max_rad_s: f64,
    /// Fastest change of a wheel's speed, radians per second squared.
    pub wheel_acceleration_max_rad_s2: f64,
    /// Fastest drive ahead, metres per second.
    pub linear_max_m_s: f64,
    /// Fastest turn of the body, radians per second.
    pub angular_max_rad_s: f64,
    /// Hardest acceleration and braking along the path, metres per second squared.
    pub linear_acceleration_max_m_s2: f64,
    /// Fastest change of acceleration along the path, metres per second cubed.
    pub linear_jerk_max_m_s3: f64,
    /// Hardest acceleration across the path, metres per second squared.
    pub lateral_acceleration_max_m_s2: f64,
}

/// A robot's properties as written in a file or sent over a network, not yet checked.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RobotModelSpec {
    /// Mass m, kilograms.
    pub mass_kg: f64,
    /// Distance between the left and right wheels' contacts, W, metres.
    pub track_width_m: f64,
    /// Distance between the front and rear wheels' contacts, L, metres.
    pub wheelbase_m: f64,
    /// Rolling radius of a wheel, r, metres.
    pub wheel_radius_m: f64,
    /// Moment of inertia about the vertical, `I_G`, kg m².
    pub yaw_inertia_kg_m2: f64,
    /// What the robot may do at most.
    pub limits: Limits,
}

/// Why a robot's properties were refused.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum RobotModelError {
    /// A figure is NaN, infinite, zero or negative.
    #[error("`{field}` must be finite and above zero, not {value}")]
    NotPositive {
        /// The field's name.
        field: &'static str,
        /// What it held.
        value: f64,
    },
}

/// A robot's checked properties: every figure is finite and above zero.
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
    /// The robot of Yi, Song, Zhang and Goodwin, section IV, with limits that suit it.
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

    /// Mass m, kilograms.
    pub fn mass_kg(&self) -> f64 {
        self.spec.mass_kg
    }

    /// Distance between the left and right wheels' contacts, W, metres.
    pub fn track_width_m(&self) -> f64 {
        self.spec.track_width_m
    }

    /// Distance between the front and rear wheels' contacts, L, metres.
    pub fn wheelbase_m(&self) -> f64 {
        self.spec.wheelbase_m
    }

    /// Rolling radius of a wheel, r, metres.
    pub fn wheel_radius_m(&self) -> f64 {
        self.spec.wheel_radius_m
    }

    /// Moment of inertia about the vertical, `I_G`, kg m².
    pub fn yaw_inertia_kg_m2(&self) -> f64 {
        self.spec.yaw_inertia_kg_m2
    }

    /// What the robot may do at most.
    pub fn limits(&self) -> &Limits {
        &self.spec.limits
    }

    /// Load on the two wheels of one side at rest, newtons.
    pub fn side_load_n(&self) -> f64 {
        self.spec.mass_kg * GRAVITY_M_S2 / 2.0
    }

    /// The same robot with accelerations that a peak friction coefficient can give.
    ///
    /// Only a share of `μg`: the rest turns the wheels against the ground, and serves feedback.
    pub(crate) fn within_traction_limit(&self, mu_peak: f64) -> Self {
        let along_m_s2 = Self::longitudinal_traction_m_s2(mu_peak);
        let across_m_s2 = Self::lateral_traction_m_s2(mu_peak);
        let mut spec = self.spec;
        let limits = &mut spec.limits;
        limits.linear_acceleration_max_m_s2 = limits.linear_acceleration_max_m_s2.min(along_m_s2);
        limits.lateral_acceleration_max_m_s2 =
            limits.lateral_acceleration_max_m_s2.min(across_m_s2);
        Self { spec }
    }

    /// Acceleration along the path that a plan may ask of ground with this peak friction, metres per
    /// second squared.
    pub fn longitudinal_traction_m_s2(mu_peak: f64) -> f64 {
        TRACTION_SHARE_LONGITUDINAL * mu_peak * GRAVITY_M_S2
    }

    /// The same across the path.
    pub fn lateral_traction_m_s2(mu_peak: f64) -> f64 {
        TRACTION_SHARE_LATERAL * mu_peak * GRAVITY_M_S2
    }

    /// How much wider than W the robot turns at low speed: `W_eff/W = 1 + (L/W)²`, whatever the
    /// ground. (Moment balance of four isotropic contacts in the linear range of (7).)
    pub fn effective_track_ratio(&self) -> f64 {
        1.0 + (self.spec.wheelbase_m / self.spec.track_width_m).powi(2)
    }

    /// Track width that turns wheel speeds into turn rates, metres.
    pub fn effective_track_m(&self) -> f64 {
        self.spec.track_width_m * self.effective_track_ratio()
    }

    /// Fastest speeding up of a turn, radians per second squared: with the rims' share of it as
    /// strong as the acceleration limit along the path, and within what the wheels may do.
    pub fn angular_acceleration_max_rad_s2(&self) -> f64 {
        let limits = self.limits();
        let rim_max_m_s2 = limits.wheel_acceleration_max_rad_s2 * self.spec.wheel_radius_m;
        limits.linear_acceleration_max_m_s2.min(rim_max_m_s2) / (0.5 * self.effective_track_m())
    }

    /// Wheel speeds that give this twist at low speed, through the effective track.
    pub fn wheel_speeds_from_twist(&self, twist: Twist) -> WheelSpeeds {
        let half_m_s = 0.5 * self.effective_track_m() * twist.angular_rad_s;
        WheelSpeeds {
            left_rad_s: (twist.linear_m_s - half_m_s) / self.spec.wheel_radius_m,
            right_rad_s: (twist.linear_m_s + half_m_s) / self.spec.wheel_radius_m,
        }
    }

    /// The twist that these wheel speeds give at low speed, through the effective track.
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
