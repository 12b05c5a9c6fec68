//! The accelerometer against what wheels and gyro say: `a_x = v̇` and `a_y = vω`.
//!
//! A lean adds a part of gravity, so that only changes are compared: both sides pass the same
//! high-pass filter, and a regression with a short memory gives the gain between them.

use super::history::{BIN_S, Means};
use super::repeats::Repeats;
use super::{Comparison, Finding, Kind, Subject, Unit};
use crate::measured::BodyAcceleration;

/// Bins over which a speed's change is taken.
const BINS: usize = 4;
/// Time constant of the high-pass filter, seconds.
const HIGH_PASS_S: f64 = 3.0;
/// Memory of the regression, seconds.
const MEMORY_S: f64 = 1.5;
/// Least excitation, metres squared per second cubed.
const EXCITATION_MIN: f64 = 0.04;
/// Gain beyond which it is scaled. A low gain is no fault: slip and noise of the prediction give
/// one.
const GAIN_MAX: f64 = 1.6;
/// Gain from which it agrees.
const GAIN_AGREES: f64 = 0.5;
/// Gain below which it is inverted.
const GAIN_INVERTED: f64 = -0.3;
/// Gain that ice does not give: wheels that slip speed up while the body slows down, but not as
/// much.
const GAIN_OF_ICE: f64 = -0.5;
/// How far below that gain must be for how long, seconds: longer than the wheels may lag.
const INVERTED_S: f64 = 0.35;
/// Excitation, squared, that shows the sign: at least this, and noise beside it.
const SIGN_MIN: f64 = 0.06;
/// What a change of speed weighs against a turn.
const SIGN_FORWARD: f64 = 0.6;
const SIGN_NOISE: f64 = 0.015;
/// Standard deviations of the gain that are let be.
const STD_DEVS: f64 = 4.0;
/// Change of what is expected while it is frozen, metres per second squared.
const FROZEN_CHANGE_M_S2: f64 = 0.3;
/// Difference that no lean explains, metres per second squared.
const IMPOSSIBLE_M_S2: f64 = 5.0;

/// One axis.
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

/// What is known of it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Accelerometer {
    sum: BodyAcceleration,
    count: f64,
    means: [BodyAcceleration; BINS],
    speeds_m_s: [f64; BINS + 1],
    bins: usize,
    forward: Axis,
    left: Axis,
    /// `∫ felt·expected`, `∫ expected²`, `∫ residual²` and `∫ 1`, with a memory.
    sums: [f64; 4],
    /// What was expected when it froze.
    frozen_from: Option<[f64; 2]>,
    /// Cumulative sum of the evidence that it is inverted, seconds.
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

    /// Whether it was excited, and agreed.
    pub(super) fn is_healthy(&self) -> bool {
        self.is_healthy
    }

    /// A bin is over, in which the robot moved like this.
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

    /// The gain and its standard deviation, where there was excitation.
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

    /// Looks whether what is felt and what is expected have the same sign.
    fn sign(&mut self) {
        let square = self.forward.expected.powi(2) + self.left.expected.powi(2);
        if square < SIGN_MIN {
            return;
        }
        let product =
            self.forward.felt * self.forward.expected + self.left.felt * self.left.expected;
        let gain = (product / (square + SIGN_NOISE)).clamp(-1.0, 1.0);
        // Wheels that slip speed up while the body slows down; in a turn it still goes their way.
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

    /// The axis that is excited more.
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
