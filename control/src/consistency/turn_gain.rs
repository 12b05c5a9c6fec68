//! Gain from the turn rate by wheels to that of the body, for this robot on this ground: it depends
//! on scrub and rolling radii.
//!
//! The gain is the regression of the gyro on the wheels with exponential forgetting, updated while no
//! channels contradict each other. It corrects the wheels as the reference where gyro and position
//! contradict each other, and has no other use. It is bounded, so that it cannot absorb a fault.

use super::history::{BIN_S, Means};

/// Time constant of forgetting, seconds of turning.
const MEMORY_S: f64 = 20.0;
/// Minimum turn rate of the wheels for learning, radians per second.
const TURN_MIN_RAD_S: f64 = 0.15;
/// Minimum excitation `∫ ω² dt` for a valid gain, radians squared per second.
const KNOWN_MIN: f64 = 0.3;
/// Bounds of the gain.
const GAIN: std::ops::RangeInclusive<f64> = 0.7..=1.3;

/// Sums of the regression.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct TurnGain {
    product: f64,
    square: f64,
}

impl TurnGain {
    /// Adds a bin without contradictions.
    pub(super) fn learn(&mut self, means: &Means) {
        let (gyro_rad_s, wheels_rad_s) = (means.gyro_rad_s, means.wheels.angular_rad_s);
        if wheels_rad_s.abs() < TURN_MIN_RAD_S {
            return;
        }
        let keep = 1.0 - BIN_S / MEMORY_S;
        self.product = keep * self.product + BIN_S * gyro_rad_s * wheels_rad_s;
        self.square = keep * self.square + BIN_S * wheels_rad_s * wheels_rad_s;
    }

    /// Returns the gain, 0.7 to 1.3; None until the robot has turned enough.
    pub(super) fn known(&self) -> Option<f64> {
        (self.square >= KNOWN_MIN)
            .then(|| (self.product / self.square).clamp(*GAIN.start(), *GAIN.end()))
    }
}
