//! Compares the accelerometer with wheels and gyro: `a_x = v̇` and `a_y = vω`.
//!
//! A tilt adds a part of gravity, so only changes are compared: measured and predicted acceleration
//! pass the same high-pass filter, and a regression with a short memory gives the gain between
//! them.

use super::history::{BIN_S, Means};
use super::repeats::Repeats;
use super::{Comparison, Finding, Kind, Subject, Unit};
use crate::measured::BodyAcceleration;

/// Number of bins over which the speed is differentiated.
const BINS: usize = 4;
/// Time constant of the high-pass filter, seconds.
const HIGH_PASS_S: f64 = 3.0;
/// Time constant of the regression's memory, seconds.
const MEMORY_S: f64 = 1.5;
/// Minimum excitation `∫ expected² dt` for a gain, metres squared per second cubed.
const EXCITATION_MIN: f64 = 0.04;
/// Gain above which the accelerometer is inconsistent. A low gain is no fault: slip and noise of
/// the prediction cause one.
const GAIN_MAX: f64 = 1.6;
/// Gain from which the accelerometer agrees.
const GAIN_AGREES: f64 = 0.5;
/// Gain of the regression below which the accelerometer is inverted.
const GAIN_INVERTED: f64 = -0.3;
/// Lower limit of gains that ice can cause: wheels that slip speed up while the body slows down,
/// but by less.
const GAIN_OF_ICE: f64 = -0.5;
/// Cumulative evidence from which the accelerometer is inverted, seconds; longer than the lag of
/// the wheels.
const INVERTED_S: f64 = 0.35;
/// Minimum squared predicted acceleration for evidence on the sign, (m/s²)².
const SIGN_MIN: f64 = 0.06;
/// Weight of evidence from a change of speed relative to that from a turn.
const SIGN_FORWARD: f64 = 0.6;
/// Noise added to the squared predicted acceleration, (m/s²)².
const SIGN_NOISE: f64 = 0.015;
/// Number of standard deviations of the gain that are tolerated.
const STD_DEVS: f64 = 4.0;
/// Change of the predicted acceleration during which a frozen measurement is a fault, metres per
/// second squared.
const FROZEN_CHANGE_M_S2: f64 = 0.3;
/// Difference of measured and predicted acceleration that no tilt explains, metres per second
/// squared.
const IMPOSSIBLE_M_S2: f64 = 5.0;

/// Measured and predicted acceleration of one axis, low-pass and high-pass filtered, metres per
/// second squared.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Axis {
    felt_low: f64,
    expected_low: f64,
    felt: f64,
    expected: f64,
}

impl Axis {
    fn take(&mut self, comparison: Comparison) {
        let (felt_m_s2, expected_m_s2) = (comparison.observed, comparison.predicted);
        let share = BIN_S / HIGH_PASS_S;
        self.felt_low += share * (felt_m_s2 - self.felt_low);
        self.expected_low += share * (expected_m_s2 - self.expected_low);
        self.felt = felt_m_s2 - self.felt_low;
        self.expected = expected_m_s2 - self.expected_low;
    }

    fn comparison(self) -> Comparison {
        Comparison {
            observed: self.felt,
            predicted: self.expected,
        }
    }
}

/// State of the comparison.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Accelerometer {
    sum: BodyAcceleration,
    count: f64,
    means: [BodyAcceleration; BINS],
    speeds_m_s: [f64; BINS + 1],
    bins: usize,
    forward: Axis,
    left: Axis,
    /// `∫ felt·expected`, `∫ expected²`, `∫ residual²` and `∫ 1`, with exponential forgetting.
    sums: [f64; 4],
    /// Predicted acceleration, `[forward, left]`, when the measurement froze.
    frozen_from: Option<[f64; 2]>,
    /// Cumulative sum of the evidence that the accelerometer is inverted, seconds.
    inverted_s: f64,
    verdict: Option<Finding>,
    is_healthy: bool,
}

impl Accelerometer {
    pub(super) fn restart(&mut self) {
        *self = Self::default();
    }

    pub(super) fn take(&mut self, felt: BodyAcceleration) {
        self.sum.forward_m_s2 += felt.forward_m_s2;
        self.sum.left_m_s2 += felt.left_m_s2;
        self.count += 1.0;
    }

    pub(super) fn verdict(&self) -> Option<Finding> {
        self.verdict
    }

    /// Returns whether there was excitation and the gain agreed.
    pub(super) fn is_healthy(&self) -> bool {
        self.is_healthy
    }

    /// Evaluates one bin with the forward speed of the wheels and the turn rate of the gyro.
    pub(super) fn step(&mut self, motion: &Means, repeats: &Repeats) {
        let speed_m_s = motion.wheels.linear_m_s;
        self.verdict = None;
        self.is_healthy = false;
        if self.count < 1.0 {
            self.bins = 0;
            return;
        }
        self.means.rotate_left(1);
        self.means[BINS - 1] = BodyAcceleration {
            forward_m_s2: self.sum.forward_m_s2 / self.count,
            left_m_s2: self.sum.left_m_s2 / self.count,
        };
        (self.sum, self.count) = (BodyAcceleration::default(), 0.0);
        self.speeds_m_s.rotate_left(1);
        self.speeds_m_s[BINS] = speed_m_s;
        self.bins = (self.bins + 1).min(BINS + 1);
        if self.bins <= BINS {
            return;
        }
        #[expect(clippy::cast_precision_loss, reason = "there are few bins")]
        let bins = BINS as f64;
        let expected = [
            (self.speeds_m_s[BINS] - self.speeds_m_s[0]) / (bins * BIN_S),
            speed_m_s * motion.gyro_rad_s,
        ];
        let mean = |of: fn(&BodyAcceleration) -> f64| self.means.iter().map(of).sum::<f64>() / bins;
        let felt = [mean(|felt| felt.forward_m_s2), mean(|felt| felt.left_m_s2)];
        let axes = [0, 1].map(|axis: usize| Comparison {
            observed: felt[axis],
            predicted: expected[axis],
        });
        self.forward.take(axes[0]);
        self.left.take(axes[1]);
        let gain = self.regress();
        if !repeats.is_repeating() {
            self.sign();
        }
        self.verdict = self
            .frozen(repeats, axes)
            .or_else(|| impossible(axes))
            .or_else(|| self.inverted())
            .or_else(|| self.scaled(gain));
        self.is_healthy = self.verdict.is_none()
            && !repeats.is_frozen()
            && gain.is_some_and(|(gain, _)| (GAIN_AGREES..=GAIN_MAX).contains(&gain));
    }

    /// Returns the gain and its standard deviation; None without enough excitation.
    fn regress(&mut self) -> Option<(f64, f64)> {
        let keep = (-BIN_S / MEMORY_S).exp();
        let before = if self.sums[1] > 0.0 {
            self.sums[0] / self.sums[1]
        } else {
            1.0
        };
        for axis in [self.forward, self.left] {
            let residual = axis.felt - before * axis.expected;
            let new = [
                axis.felt * axis.expected,
                axis.expected * axis.expected,
                residual * residual,
                1.0,
            ];
            for (sum, new) in self.sums.iter_mut().zip(new) {
                *sum += new * BIN_S;
            }
        }
        for sum in &mut self.sums {
            *sum *= keep;
        }
        let [product, square, residual, time] = self.sums;
        if square < EXCITATION_MIN {
            return None;
        }
        #[expect(clippy::cast_precision_loss, reason = "there are few bins")]
        let correlation_s = BINS as f64 * BIN_S;
        let std_dev = (residual / time * correlation_s / square).sqrt();
        Some((product / square, std_dev))
    }

    /// Updates the evidence that measured and predicted acceleration have opposite signs.
    fn sign(&mut self) {
        let square = self.forward.expected.powi(2) + self.left.expected.powi(2);
        if square < SIGN_MIN {
            return;
        }
        let product =
            self.forward.felt * self.forward.expected + self.left.felt * self.left.expected;
        let gain = (product / (square + SIGN_NOISE)).clamp(-1.0, 1.0);
        // Wheels that slip speed up while the body slows down; in a turn the signs still agree.
        let weight = if self.forward.expected.abs() > self.left.expected.abs() {
            SIGN_FORWARD
        } else {
            1.0
        };
        let evidence_s = weight * BIN_S * (GAIN_OF_ICE - gain);
        self.inverted_s = (self.inverted_s + evidence_s).clamp(0.0, 1.0);
    }

    fn inverted(&self) -> Option<Finding> {
        (self.inverted_s >= INVERTED_S).then(|| {
            let axis = self.stronger();
            finding(Kind::Inverted, axis.comparison())
        })
    }

    /// Returns the axis with the larger predicted acceleration.
    fn stronger(&self) -> Axis {
        if self.forward.expected.abs() > self.left.expected.abs() {
            self.forward
        } else {
            self.left
        }
    }

    fn scaled(&self, gain: Option<(f64, f64)>) -> Option<Finding> {
        let (gain, std_dev) = gain?;
        let slack = STD_DEVS * std_dev;
        let kind = if gain < GAIN_INVERTED - slack {
            Kind::Inverted
        } else if gain > GAIN_MAX + slack {
            Kind::Inconsistent
        } else {
            return None;
        };
        let axis = self.stronger();
        let comparison = Comparison {
            observed: gain * axis.expected,
            predicted: axis.expected,
        };
        Some(finding(kind, comparison))
    }

    fn frozen(&mut self, repeats: &Repeats, axes: [Comparison; 2]) -> Option<Finding> {
        if !repeats.is_frozen() {
            self.frozen_from = None;
            return None;
        }
        let from = *self
            .frozen_from
            .get_or_insert(axes.map(|axis| axis.predicted));
        axes.into_iter()
            .zip(from)
            .find(|(axis, from)| (axis.predicted - from).abs() > FROZEN_CHANGE_M_S2)
            .map(|(axis, _)| finding(Kind::Frozen, axis))
    }
}

fn impossible(axes: [Comparison; 2]) -> Option<Finding> {
    axes.into_iter()
        .find(|axis| (axis.observed - axis.predicted).abs() > IMPOSSIBLE_M_S2)
        .map(|axis| finding(Kind::Inconsistent, axis))
}

fn finding(kind: Kind, comparison: Comparison) -> Finding {
    let Comparison {
        observed,
        predicted,
    } = comparison;
    Finding {
        subject: Subject::Accelerometer,
        kind,
        observed,
        predicted,
        unit: Unit::MetresPerSecondSquared,
    }
}
