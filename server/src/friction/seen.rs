//! What robots measured of one piece of ground, as it is fused.

use tread_api::friction::{Information, NORMAL_95, TYRE_DIFFERENCE_SHARE};

use super::sums::{Known, Sums};
use super::weights::FrictionConfig;

/// Standard deviations from which measurements contradict each other. With as many comparisons as
/// a cell ever sees, one in ten thousand of them cuts off what was true.
pub(super) const CHANGE_DEVIATIONS: f64 = 4.5;
/// Microseconds of a second.
const SECOND_US: f64 = 1.0e6;

/// What one robot measured in one epoch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen<R> {
    /// The robot; its order is the order of adding, so it must not depend on arrival.
    pub robot: R,
    /// First hour of the epoch.
    pub epoch_h: i64,
    /// θ, with its independent error.
    pub theta: Known,
    /// Standard deviation of the error that the robot has everywhere, as a share of θ; 0 if it does
    /// not tell.
    pub robot_ratio: f64,
    /// The same of the error that all robots on its tyres have.
    pub tyre_ratio: f64,
    /// Σ Λ·(θ − mean)² of the passes, which is χ² with one degree less than passes.
    pub scatter: f64,
    /// How many passes.
    pub passes: u64,
    /// End of the newest pass, microseconds since 1970.
    pub newest_at_us: i64,
    /// θ of the newest pass that tells something, if it is known by itself.
    pub newest: Option<Known>,
    /// Friction seen by that pass.
    pub newest_mu: Option<f64>,
    /// Largest friction coefficient seen.
    pub mu_peak: Option<f64>,
    /// Ratio of effective to geometric track.
    pub track: Option<Known>,
    /// Rolling resistance coefficient.
    pub rolling: Option<Known>,
}

impl<R> Seen<R> {
    /// Of sums; `None` when they know no θ.
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

    /// The same in the θ of another model, of which this model's is a multiple.
    #[must_use]
    pub fn scaled(mut self, ratio: f64) -> Self {
        let scale = |known: Known| Known {
            information: known.information * ratio * ratio,
            value: known.value / ratio,
        };
        (self.theta, self.newest) = (scale(self.theta), self.newest.map(&scale));
        self
    }

    /// The passes before the newest one, if the newest contradicts them.
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

    /// Standard deviation of this robot's bias as a share of θ: what it says of itself, and no less
    /// than what is assumed.
    pub(super) fn bias_ratio(&self, config: &FrictionConfig) -> f64 {
        self.robot_ratio.max(config.robot_bias_ratio)
    }

    /// By how much the tyres' errors of two measurements like this one differ, as a share of θ.
    pub(super) fn tyre_difference_ratio(&self) -> f64 {
        TYRE_DIFFERENCE_SHARE * self.tyre_ratio
    }

    pub(super) fn with_newest_alone(mut self, newest: Known) -> Self {
        self.theta = newest;
        self.scatter = 0.0;
        self.passes = 1;
        self.mu_peak = self.newest_mu;
        // Which of the passes showed these is not kept.
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

/// A value with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The value.
    pub value: f64,
    /// Its standard deviation.
    pub std_dev: f64,
}

impl Estimate {
    /// The value that is undercut with this normal quantile, not below `least`.
    pub fn quantile(&self, std_devs: f64, least: f64) -> f64 {
        (self.value + std_devs * self.std_dev).max(least)
    }

    /// The 95 % interval; θ is never negative.
    pub fn interval_95(&self) -> (f64, f64) {
        (
            self.quantile(-NORMAL_95, 0.0),
            self.quantile(NORMAL_95, 0.0),
        )
    }
}

/// What a piece of ground is, which says how a difference between measurements is understood.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ground {
    /// One place: a difference in time is a change.
    Cell,
    /// Many places: a difference is one of place as well.
    Area,
}

#[expect(clippy::cast_precision_loss, reason = "times below 2^53 µs until 2255")]
pub(super) fn seconds(span_us: i64) -> f64 {
    span_us as f64 / SECOND_US
}

/// A robot's clock may run ahead; what it measured is at most new.
pub(super) fn age_s<R>(one: &Seen<R>, now_us: i64) -> f64 {
    seconds(now_us - one.newest_at_us).max(0.0)
}
