//! Commands to the base and measurements from it.

use serde::{Deserialize, Serialize};

use crate::geometry::{Pose, Twist};

/// Random walk of a gyro's offset, radians per second per square root of a second: that of inexpensive
/// MEMS gyros.
pub(crate) const GYRO_OFFSET_WALK: f64 = 2.0e-4;

/// Angular speeds of the wheels per side; positive drives forward.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct WheelSpeeds {
    /// Left wheels, radians per second.
    pub left_rad_s: f64,
    /// Right wheels, radians per second.
    pub right_rad_s: f64,
}

impl WheelSpeeds {
    /// Returns whether both values are finite.
    pub fn is_finite(self) -> bool {
        self.left_rad_s.is_finite() && self.right_rad_s.is_finite()
    }

    /// Returns the larger magnitude of both sides, radians per second.
    pub fn magnitude_max_rad_s(self) -> f64 {
        self.left_rad_s.abs().max(self.right_rad_s.abs())
    }
}

/// Drive torques per side, sum over both wheels of a side; positive drives forward.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct WheelTorques {
    /// Sum over the left wheels, newton metres, positive forward.
    pub left_n_m: f64,
    /// Sum over the right wheels, newton metres, positive forward.
    pub right_n_m: f64,
}

impl WheelTorques {
    /// Returns whether both values are finite.
    pub fn is_finite(self) -> bool {
        self.left_n_m.is_finite() && self.right_n_m.is_finite()
    }
}

/// Acceleration of the body along the ground, in the body frame: without gravity, unless the user
/// of this type states that it is the specific force.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct BodyAcceleration {
    /// Forward, metres per second squared.
    pub forward_m_s2: f64,
    /// To the left, metres per second squared.
    pub left_m_s2: f64,
}

/// Measurements that a tracking law uses in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Measured {
    /// Robot pose in the site frame.
    pub pose: Pose,
    /// Forward speed and turn rate in the body frame.
    pub twist: Twist,
    /// Measured wheel speeds.
    pub wheel_speeds: WheelSpeeds,
    /// Time since the last accepted position fix, seconds.
    pub pose_age_s: f64,
    /// Standard deviation of the position per axis, metres; infinite if unknown.
    pub position_std_dev_m: f64,
}

impl Measured {
    /// Returns whether all values but `position_std_dev_m` are finite.
    pub fn is_finite(&self) -> bool {
        self.pose.is_finite()
            && self.twist.is_finite()
            && self.wheel_speeds.is_finite()
            && self.pose_age_s.is_finite()
    }
}
