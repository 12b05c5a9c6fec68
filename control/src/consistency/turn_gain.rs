//! How much of the turn that the wheels say this robot makes on this ground: scrub and rolling radii
//! make it another one for each robot.
//!
//! A regression of the gyro on the wheels with a memory, while nothing contradicts. It makes the
//! wheels a sharper witness where gyro and position contradict each other, and nothing else: it is
//! bounded, so that no fault is learned away.

use super::history::{BIN_S, Means};

/// Memory, seconds of turning.
const MEMORY_S: f64 = 20.0;
/// Slowest turn that is learned from, radians per second.
const TURN_MIN_RAD_S: f64 = 0.15;
/// Excitation from which on the gain counts, radians squared per second.
const KNOWN_MIN: f64 = 0.3;
/// Range of the gain.
const GAIN: std::ops::RangeInclusive<f64> = 0.7..=1.3;

/// The gain of one robot.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct TurnGain {
    product: f64,
    square: f64,
}

impl TurnGain {
    /// A bin in which nothing contradicted.
    pub(super) fn learn(&mut self, means: &Means) {
        let (gyro_rad_s, wheels_rad_s) = (means.gyro_rad_s, means.wheels.angular_rad_s);
        if wheels_rad_s.abs() < TURN_MIN_RAD_S {
            return;
        }
        let keep = 1.0 - BIN_S / MEMORY_S;
        self.product = keep * self.product + BIN_S * gyro_rad_s * wheels_rad_s;
        self.square = keep * self.square + BIN_S * wheels_rad_s * wheels_rad_s;
    }

    /// The gain, once the robot has turned enough.
    pub(super) fn known(&self) -> Option<f64> {
        (self.square >= KNOWN_MIN)
            .then(|| (self.product / self.square).clamp(*GAIN.start(), *GAIN.end()))
    }
}
