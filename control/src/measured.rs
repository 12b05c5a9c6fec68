//! What is commanded to, and measured at, the base.

use serde::{Deserialize, Serialize};

use crate::geometry::{Pose, Twist};

/// Turn rates of the two sides' wheels; positive drives ahead.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct WheelSpeeds {
    /// Left wheels, radians per second.
    pub left_rad_s: f64,
    /// Right wheels, radians per second.
    pub right_rad_s: f64,
}

impl WheelSpeeds {
    /// Whether both numbers are finite.
    pub fn is_finite(self) -> bool {
        self.left_rad_s.is_finite() && self.right_rad_s.is_finite()
    }

    /// The larger of both magnitudes, radians per second.
    pub fn magnitude_max_rad_s(self) -> f64 {
        self.left_rad_s.abs().max(self.right_rad_s.abs())
    }
}

/// Drive torques of the two sides, both wheels of a side together; positive drives ahead.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct WheelTorques {
    /// Left wheels, newton metres.
    pub left_n_m: f64,
    /// Right wheels, newton metres.
    pub right_n_m: f64,
}

impl WheelTorques {
    /// Whether both numbers are finite.
    pub fn is_finite(self) -> bool {
        self.left_n_m.is_finite() && self.right_n_m.is_finite()
    }
}

/// Acceleration of the body without gravity, in the body frame.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct BodyAcceleration {
    /// Forward, metres per second squared.
    pub forward_m_s2: f64,
    /// To the left, metres per second squared.
    pub left_m_s2: f64,
}

/// What a tracking law may look at in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Measured {
    /// Where the robot is, site frame.
    pub pose: Pose,
    /// How it moves, body frame.
    pub twist: Twist,
    /// How its wheels turn, as measured.
    pub wheel_speeds: WheelSpeeds,
    /// Age of the last accepted position fix, seconds.
    pub pose_age_s: f64,
    /// Standard deviation of the position per axis, metres; infinite where it is not known.
    pub position_std_dev_m: f64,
}

impl Measured {
    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.pose.is_finite()
            && self.twist.is_finite()
            && self.wheel_speeds.is_finite()
            && self.pose_age_s.is_finite()
    }
}
