//! Detects that a robot was loaded or unloaded while it stood.
//!
//! The apparent mass ([`ApparentMass`]) since the last standstill is compared with that before it.
//! Slopes and rolling resistance are eliminated for each window of 5 s; their remaining error and
//! that of the tyres has the standard deviation [`UNMODELLED_RATIO`].

use super::apparent_mass::ApparentMass;
use super::{PayloadChange, SensorNoise, SensorSample, ValueWithStdDev};
use crate::robot::RobotModel;

/// Minimum duration of a standstill after which the payload may have changed, seconds.
const STANDSTILL_MIN_S: f64 = 5.0;
/// Rim speed of the faster side below which the robot counts as standing, metres per second.
pub(super) const STANDING_M_S: f64 = 0.02;
/// Minimum change of the apparent mass that is reported, relative to the model's mass.
const CHANGE_MIN_RATIO: f64 = 0.05;
/// Minimum change that is reported, in standard deviations of the difference.
const CHANGE_MIN_STD_DEVS: f64 = 4.0;
/// Standard deviation of the errors that windows do not eliminate, relative to the model's mass.
const UNMODELLED_RATIO: f64 = 0.01;
/// Maximum standard deviation of an apparent mass that is compared, relative to the model's mass.
const COMPARED_STD_DEV_MAX: f64 = 0.05;
/// Time for which a change is reported, seconds of samples.
const REPORTED_FOR_S: f64 = 600.0;

/// Compares the apparent masses before and after each long standstill.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct PayloadMonitor {
    /// Apparent mass since the last long standstill.
    since: ApparentMass,
    /// Apparent mass before it, over all drives with the same load.
    before: Option<ValueWithStdDev>,
    standing_s: f64,
    change: Option<PayloadChange>,
    reported_s: f64,
}

impl PayloadMonitor {
    /// Adds a sample, taken `dt_s` seconds after the one before. Returns whether the payload has
    /// changed.
    pub(super) fn add(
        &mut self,
        sample: &SensorSample,
        model: &RobotModel,
        noise: &SensorNoise,
        dt_s: f64,
    ) -> bool {
        self.reported_s += dt_s;
        if self.reported_s > REPORTED_FOR_S {
            self.change = None;
        }
        let rim_m_s = sample.wheel_speeds.magnitude_max_rad_s() * model.wheel_radius_m();
        if rim_m_s < STANDING_M_S {
            self.standing_s += dt_s;
            self.since.interrupt();
            return false;
        }
        if std::mem::take(&mut self.standing_s) >= STANDSTILL_MIN_S {
            self.before = self.known();
            self.since = ApparentMass::default();
        }
        let is_window_done = self.since.add(sample, model, noise, dt_s);
        is_window_done && self.compare()
    }

    /// Restarts the averages after a gap between samples.
    pub(super) fn interrupt(&mut self) {
        self.since.interrupt();
    }

    /// Returns the last change for [`REPORTED_FOR_S`] of samples, then None.
    pub(super) fn change(&self) -> Option<PayloadChange> {
        self.change
    }

    /// Returns the apparent mass since the last long standstill; None if its standard deviation is
    /// too large.
    fn present(&self) -> Option<ValueWithStdDev> {
        let value = self.since.value()?;
        let std_dev = value.std_dev.hypot(UNMODELLED_RATIO);
        (std_dev < COMPARED_STD_DEV_MAX).then_some(ValueWithStdDev { std_dev, ..value })
    }

    /// Returns the apparent mass with the present load, from the drives before and since the last
    /// long standstill; they are independent but for the errors that windows do not eliminate.
    fn known(&self) -> Option<ValueWithStdDev> {
        let (Some(before), Some(present)) = (self.before, self.present()) else {
            return self.present().or(self.before);
        };
        let weights = [before.std_dev.powi(-2), present.std_dev.powi(-2)];
        let sum = weights[0] + weights[1];
        // The errors that windows do not eliminate do not average out.
        Some(ValueWithStdDev {
            value: (weights[0] * before.value + weights[1] * present.value) / sum,
            std_dev: sum.sqrt().recip().max(UNMODELLED_RATIO),
        })
    }

    fn compare(&mut self) -> bool {
        let Some((before, after)) = self.before.zip(self.present()) else {
            return false;
        };
        let std_dev = before.std_dev.hypot(after.std_dev);
        let least = CHANGE_MIN_RATIO.max(CHANGE_MIN_STD_DEVS * std_dev);
        if (after.value - before.value).abs() < least {
            return false;
        }
        self.change = Some(PayloadChange { before, after });
        self.reported_s = 0.0;
        self.before = None;
        true
    }
}
