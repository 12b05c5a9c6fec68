//! Averages the moment balance of a skid-steered robot over windows, without differentiating any
//! rate.
//!
//! Combined slip in the linear range gives, with rim speeds u, `s = (1/u_L + 1/u_R)/2` and
//! `d = 1/u_L − 1/u_R`, independent of the body speed (which the force balance eliminates):
//!
//! ```text
//! d/s² − φ̇ (W + L²/W − W (d/2s)²) = θ ( 4I_G φ̈/(m g W s) + (a/g) d/s² )
//! ```
//! Windows ψ are trapezoids whose sum is one: each rises on the ramp on which the previous one
//! falls. `∫ψφ̈` is then the difference of the gyro's means over two ramps, and every sample is
//! used. The variation of slip within a window is recorded for curved tyres.

use super::{BLOCK_S, SensorSample, signed_rims};
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Maximum factor by which the variation of slip is scaled up to compensate for averaging.
const VARIATION_SCALE_MAX: f64 = 1.5;
/// Duration of a ramp, seconds.
const RAMP_S: f64 = 0.05;

/// Number of intervals of a window in which the variation of slip is recorded.
pub(super) const INTERVALS: usize = 10;

/// Deviation from the means of the window in one interval.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct IntervalDeviation {
    /// Right minus left longitudinal slip.
    pub(super) slip_difference: f64,
    pub(super) turn_rad_s: f64,
    /// Forward acceleration over gravity.
    pub(super) longitudinal_mu: f64,
    /// Weight of the interval; the sum over a window is one.
    pub(super) weight: f64,
}

/// Variation of the motion about its mean within a window.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct MotionVariation {
    /// Means over short intervals.
    intervals: [IntervalDeviation; INTERVALS],
    /// Variance of the samples' `slip_difference`, including sensor noise.
    slip_difference_variance: f64,
}

impl MotionVariation {
    /// Returns the intervals with `slip_difference` scaled to the variance of the samples minus
    /// that of their noise, `slip_difference_noise`.
    pub(super) fn without_noise(
        &self,
        slip_difference_noise: f64,
    ) -> [IntervalDeviation; INTERVALS] {
        let seen = self
            .intervals
            .iter()
            .map(|interval| interval.weight * interval.slip_difference * interval.slip_difference)
            .sum::<f64>();
        let clean = (self.slip_difference_variance - slip_difference_noise).max(0.0);
        let scale = (clean / seen.max(f64::MIN_POSITIVE))
            .sqrt()
            .min(VARIATION_SCALE_MAX);
        self.intervals.map(|interval| IntervalDeviation {
            slip_difference: interval.slip_difference * scale,
            ..interval
        })
    }
}

/// Time of a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SampleSpan {
    /// Middle of the sample, seconds.
    pub(super) middle_s: f64,
    /// Duration of the sample, seconds.
    pub(super) dt_s: f64,
}

impl SampleSpan {
    /// Returns the span shifted by a time in seconds.
    fn later(self, by_s: f64) -> Self {
        Self {
            middle_s: self.middle_s + by_s,
            ..self
        }
    }
}

/// Weighted sums over one window.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct WindowSums {
    weight_s: f64,
    samples: f64,
    is_broken: bool,
    slip: f64,
    harmonic: f64,
    longitudinal_force: f64,
    longitudinal_mu: f64,
    turn: f64,
    rim_difference: f64,
    rim_mean: f64,
    /// Sums of right minus left longitudinal slip and of its square.
    slip_difference: [f64; 2],
    /// Sums over intervals of the time since the window's start.
    intervals: [IntervalDeviation; INTERVALS],
    /// Weighted gyro over the ramps `[first, last]`, radians per second, with the covered fractions
    /// of the ramps in `ramp_share`.
    ramp: [f64; 2],
    ramp_share: [f64; 2],
    ramp_samples: f64,
    /// Sum of the gyro in the window's middle, radians per second, and number of its samples.
    middle: [f64; 2],
}

/// Means over one window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TurnMeans {
    /// Left side of the balance, metres per second.
    pub(super) slip_m_s: f64,
    /// `1/s`, metres per second.
    pub(super) harmonic_m_s: f64,
    /// `(a/g) d/s²`, metres per second.
    pub(super) longitudinal_force_m_s: f64,
    /// `a/g`; in reverse with the opposite sign.
    pub(super) longitudinal_mu: f64,
    pub(super) turn_rad_s: f64,
    pub(super) turn_acceleration_rad_s2: f64,
    /// Rate of `turn_acceleration_rad_s2` over the window; `middle_samples` is the number of
    /// samples in its middle.
    pub(super) turn_jerk_rad_s3: f64,
    pub(super) middle_samples: f64,
    /// `u_R − u_L`, metres per second; in reverse that of the mirrored robot.
    pub(super) rim_difference_m_s: f64,
    /// `(u_R + u_L)/2`, metres per second, negative in reverse.
    pub(super) rim_mean_m_s: f64,
    pub(super) variation: MotionVariation,
    pub(super) duration_s: f64,
    pub(super) samples: f64,
    pub(super) ramp_samples: f64,
}

/// The window that ends with the current block, and the one that begins in it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct TurnWindow {
    ending: WindowSums,
    beginning: WindowSums,
}

impl TurnWindow {
    /// Returns the windows of the next block.
    pub(super) fn next(&self) -> Self {
        Self {
            ending: self.beginning,
            beginning: WindowSums::default(),
        }
    }

    /// Adds a sample; `span` is relative to the block's start.
    pub(super) fn add(&mut self, sample: &SensorSample, model: &RobotModel, span: SampleSpan) {
        let SampleSpan { middle_s, dt_s } = span;
        let rise = ((middle_s - (BLOCK_S - RAMP_S)) / RAMP_S).clamp(0.0, 1.0);
        self.ending
            .add(sample, model, 1.0 - rise, span.later(RAMP_S));
        if rise <= 0.0 {
            return;
        }
        self.beginning
            .add(sample, model, rise, span.later(-(BLOCK_S - RAMP_S)));
        let share = dt_s / RAMP_S;
        self.ending.ramp[1] += sample.gyro_rad_s * share;
        self.ending.ramp_share[1] += share;
        self.beginning.ramp[0] += sample.gyro_rad_s * share;
        self.beginning.ramp_share[0] += share;
        self.beginning.ramp_samples += 1.0;
    }

    /// Returns the means over the window that ends; `None` if it is incomplete.
    pub(super) fn means(&self, block_s: f64) -> Option<TurnMeans> {
        let sums = &self.ending;
        // The first window of a drive has no rising ramp.
        let is_whole = !sums.is_broken
            && sums.ramp_share.iter().all(|share| *share > 0.5)
            && sums.weight_s > 0.5 * block_s;
        if !is_whole {
            return None;
        }
        let mean = |sum: f64| sum / sums.weight_s;
        let rates = [0, 1].map(|end| sums.ramp[end] / sums.ramp_share[end]);
        Some(TurnMeans {
            slip_m_s: mean(sums.slip),
            harmonic_m_s: mean(sums.harmonic),
            longitudinal_force_m_s: mean(sums.longitudinal_force),
            longitudinal_mu: mean(sums.longitudinal_mu),
            turn_rad_s: mean(sums.turn),
            turn_acceleration_rad_s2: (rates[1] - rates[0]) / block_s,
            turn_jerk_rad_s3: if sums.middle[1] > 0.0 {
                4.0 * (rates[0] + rates[1] - 2.0 * sums.middle[0] / sums.middle[1])
                    / (block_s * block_s)
            } else {
                0.0
            },
            middle_samples: sums.middle[1].max(1.0),
            rim_difference_m_s: mean(sums.rim_difference),
            rim_mean_m_s: mean(sums.rim_mean),
            variation: sums.variation(),
            duration_s: block_s,
            samples: sums.samples,
            ramp_samples: sums.ramp_samples.max(1.0),
        })
    }
}

impl WindowSums {
    fn variation(&self) -> MotionVariation {
        let [slip_difference, square] = self.slip_difference.map(|sum| sum / self.weight_s);
        let (turn_rad_s, longitudinal_mu) = (
            self.turn / self.weight_s,
            self.longitudinal_mu / self.weight_s,
        );
        MotionVariation {
            intervals: self.intervals.map(|sum| {
                if sum.weight <= 0.0 {
                    return IntervalDeviation::default();
                }
                IntervalDeviation {
                    slip_difference: sum.slip_difference / sum.weight - slip_difference,
                    turn_rad_s: sum.turn_rad_s / sum.weight - turn_rad_s,
                    longitudinal_mu: sum.longitudinal_mu / sum.weight - longitudinal_mu,
                    weight: sum.weight / self.weight_s,
                }
            }),
            slip_difference_variance: square - slip_difference * slip_difference,
        }
    }

    /// Adds a sample with the weight `share`; `span` is relative to the window's start.
    fn add(&mut self, sample: &SensorSample, model: &RobotModel, share: f64, span: SampleSpan) {
        let SampleSpan { middle_s, dt_s } = span;
        let (Some(rims), Some(acceleration)) = (signed_rims(sample, model), sample.acceleration)
        else {
            self.is_broken = true;
            return;
        };
        let track_m = model.track_width_m();
        let half_sum = 0.5 * (rims.left_m_s.recip() + rims.right_m_s.recip());
        let gap = rims.left_m_s.recip() - rims.right_m_s.recip();
        let turning_m_s = gap / (half_sum * half_sum);
        let tight = 0.5 * gap / half_sum;
        let arm_m = model.effective_track_m() - track_m * tight * tight;
        let forward_m_s2 = rims.sign * acceleration.forward_m_s2;
        let weight_s = share * dt_s;
        if (middle_s - 0.5 * (BLOCK_S + RAMP_S)).abs() <= 0.5 * RAMP_S {
            self.middle[0] += sample.gyro_rad_s;
            self.middle[1] += 1.0;
        }
        self.weight_s += weight_s;
        self.samples += share;
        self.slip += weight_s * (turning_m_s - sample.gyro_rad_s * arm_m);
        self.harmonic += weight_s / half_sum;
        self.longitudinal_force += weight_s * turning_m_s * forward_m_s2 / GRAVITY_M_S2;
        self.longitudinal_mu += weight_s * forward_m_s2 / GRAVITY_M_S2;
        self.turn += weight_s * sample.gyro_rad_s;
        self.rim_difference += weight_s * (rims.right_m_s - rims.left_m_s);
        let slip_difference =
            (rims.right_m_s - rims.left_m_s - track_m * sample.gyro_rad_s) * half_sum;
        self.slip_difference[0] += weight_s * slip_difference;
        self.slip_difference[1] += weight_s * slip_difference * slip_difference;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            clippy::cast_precision_loss,
            reason = "a share of a few intervals, not below zero"
        )]
        let interval = (middle_s.max(0.0) * INTERVALS as f64 / (BLOCK_S + RAMP_S)) as usize;
        let interval = &mut self.intervals[interval.min(INTERVALS - 1)];
        interval.slip_difference += weight_s * slip_difference;
        interval.turn_rad_s += weight_s * sample.gyro_rad_s;
        interval.longitudinal_mu += weight_s * forward_m_s2 / GRAVITY_M_S2;
        interval.weight += weight_s;
        self.rim_mean += weight_s * rims.sign * 0.5 * (rims.right_m_s + rims.left_m_s);
    }
}
