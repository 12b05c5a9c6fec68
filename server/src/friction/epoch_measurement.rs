//! Measurements of one piece of ground, the input of the fusion.

use tread_api::friction::{Information, NORMAL_95, TYRE_DIFFERENCE_SHARE};

use super::sums::{Known, Sums};
use super::weights::FrictionConfig;

/// Number of standard deviations beyond which measurements contradict each other. With the usual
/// number of comparisons in a cell, one in ten thousand detects a false change.
pub(super) const CHANGE_DEVIATIONS: f64 = 4.5;
/// Microseconds per second.
const SECOND_US: f64 = 1.0e6;

/// Measurements of one robot in one epoch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochMeasurement<R> {
    /// Robot. Its order determines the order of summation, so it must not depend on the order of
    /// arrival.
    pub robot: R,
    /// First hour of the epoch.
    pub epoch_h: i64,
    /// θ, with the information of its independent error.
    pub theta: Known,
    /// Standard deviation of the error common to all segments of the robot, relative to θ; 0 if the
    /// robot does not state it.
    pub robot_ratio: f64,
    /// Standard deviation of the error common to all robots with the same tyres, relative to θ.
    pub tyre_ratio: f64,
    /// Σ Λ·(θ − mean)² over the passes, Λ their information: χ² distributed with `passes` − 1
    /// degrees of freedom if they agree.
    pub scatter: f64,
    /// Number of passes.
    pub passes: u64,
    /// End of the newest pass, microseconds since 1970.
    pub newest_at_us: i64,
    /// θ of the newest significant pass, if it is stored separately.
    pub newest: Option<Known>,
    /// Peak friction coefficient of the newest significant pass.
    pub newest_mu: Option<f64>,
    /// Peak friction coefficient of all passes.
    pub mu_peak: Option<f64>,
    /// Ratio of effective to geometric track width, with its information.
    pub track: Option<Known>,
    /// Rolling resistance coefficient, with its information.
    pub rolling: Option<Known>,
}

impl<R> EpochMeasurement<R> {
    /// Returns the measurements of `sums`; `None` if they have no information on θ.
    pub fn of(robot: R, epoch_h: i64, sums: &Sums) -> Option<Self> {
        let theta = sums.theta.known()?;
        let scatter = sums.theta_square.to_f64() - theta.information * theta.value * theta.value;
        Some(Self {
            robot,
            epoch_h,
            theta,
            robot_ratio: sums.robot_error.to_f64() / theta.information,
            tyre_ratio: sums.tyre_error.to_f64() / theta.information,
            scatter: scatter.max(0.0),
            passes: sums.segments,
            newest_at_us: sums.newest_at_us,
            newest: sums.newest.theta.as_ref().and_then(known),
            newest_mu: sums.newest.mu_peak,
            mu_peak: sums.mu_peak,
            track: sums.track.known(),
            rolling: sums.rolling.known(),
        })
    }

    /// Converts θ to that of another robot model: divides it by `ratio`.
    #[must_use]
    pub fn scaled(mut self, ratio: f64) -> Self {
        let scale = |known: Known| Known {
            information: known.information * ratio * ratio,
            value: known.value / ratio,
        };
        (self.theta, self.newest) = (scale(self.theta), self.newest.map(&scale));
        self
    }

    /// Compares with another entry by θ, as a tie-break: two revisions of a terrain may each have a sum of
    /// the same robot and epoch.
    pub(super) fn cmp_theta(&self, other: &Self) -> std::cmp::Ordering {
        let information = self.theta.information.total_cmp(&other.theta.information);
        information.then_with(|| self.theta.value.total_cmp(&other.theta.value))
    }

    /// Returns θ of the newest pass and of the others if they contradict each other, else `None`.
    pub(super) fn contradicted(&self) -> Option<(Known, Known)> {
        let newest = self.newest.filter(|_| self.passes > 1)?;
        let information = self.theta.information - newest.information;
        if information <= 1.0e-9 * self.theta.information {
            return None;
        }
        let weighted =
            self.theta.information * self.theta.value - newest.information * newest.value;
        let before = Known {
            information,
            value: weighted / information,
        };
        let variance = newest.information.recip()
            + information.recip()
            + (self.tyre_difference_ratio() * self.theta.value).powi(2);
        ((newest.value - before.value).abs() > CHANGE_DEVIATIONS * variance.sqrt())
            .then_some((newest, before))
    }

    /// Returns the standard deviation of this robot's bias relative to θ: the stated one, at least
    /// the configured one.
    pub(super) fn bias_ratio(&self, config: &FrictionConfig) -> f64 {
        self.robot_ratio.max(config.robot_bias_ratio)
    }

    /// Returns the standard deviation of the difference of the tyres' errors in two measurements
    /// like this one, relative to θ.
    pub(super) fn tyre_difference_ratio(&self) -> f64 {
        TYRE_DIFFERENCE_SHARE * self.tyre_ratio
    }

    pub(super) fn with_newest_alone(mut self, newest: Known) -> Self {
        self.theta = newest;
        self.scatter = 0.0;
        self.passes = 1;
        self.mu_peak = self.newest_mu;
        // These are not stored separately for the newest pass.
        (self.track, self.rolling) = (None, None);
        self
    }

    pub(super) fn without_newest(mut self, before: Known) -> Self {
        self.theta = before;
        self.passes -= 1;
        self.newest = None;
        self.mu_peak = None;
        self
    }
}

fn known(information: &Information) -> Option<Known> {
    (information.information > 0.0).then(|| Known {
        information: information.information,
        value: information.weighted / information.information,
    })
}

/// An estimated value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// Estimated value.
    pub value: f64,
    /// Standard deviation of its error.
    pub std_dev: f64,
}

impl Estimate {
    /// Returns the quantile of the normal distribution that is `std_devs` standard deviations above
    /// the value, or below it if negative.
    pub fn quantile(&self, std_devs: f64) -> f64 {
        self.value + std_devs * self.std_dev
    }

    /// Returns lower and upper bound of the 95 % interval, both at least 0.
    pub fn interval_95(&self) -> (f64, f64) {
        (
            self.quantile(-NORMAL_95).max(0.0),
            self.quantile(NORMAL_95).max(0.0),
        )
    }
}

/// Kind of a piece of ground, which determines the meaning of differences between measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ground {
    /// One place: differences over time are changes of the ground.
    Cell,
    /// Several places: differences may also be spatial, so no changes are detected.
    Area,
}

#[expect(clippy::cast_precision_loss, reason = "times below 2^53 µs until 2255")]
pub(super) fn seconds(span_us: i64) -> f64 {
    span_us as f64 / SECOND_US
}

/// Returns the age of the newest pass in seconds; 0 if a robot's clock is ahead.
pub(super) fn age_s<R>(one: &EpochMeasurement<R>, now_us: i64) -> f64 {
    seconds(now_us - one.newest_at_us).max(0.0)
}
