//! Compares the accelerometer with wheels and gyro: `a_x = v̇` and `a_y = vω`.
//!
//! A tilt adds a part of gravity, so only changes are compared ([`Tilts`]), and a regression with a
//! short memory gives the gain between measured and predicted changes.

use nalgebra::{Matrix2x4, Matrix4, Rotation2, Vector2, Vector4};

use super::history::{BIN_S, Means};
use super::{Comparison, Finding, Kind, Subject, Unit};
use crate::geometry::wrap_angle_rad;
use crate::measured::BodyAcceleration;
use crate::repeats::Repeats;

/// Number of bins over which the speed is differentiated.
const BINS: usize = 4;
/// Time constant of the high-pass filter, seconds.
const HIGH_PASS_S: f64 = 3.0;
/// Information on each tilt at the start, as a number of bins.
const TILT_INFORMATION: f64 = 0.1;
/// Time constant of the regression's memory, seconds.
const MEMORY_S: f64 = 1.5;
/// Minimum excitation `∫ predicted² dt` for a gain, metres squared per second cubed.
const EXCITATION_MIN: f64 = 0.04;
/// Gain above which the accelerometer is inconsistent. A low gain is no fault: slip and noise of
/// the prediction cause one.
const GAIN_MAX: f64 = 1.6;
/// Gain from which the accelerometer counts as healthy.
const GAIN_MIN: f64 = 0.5;
/// Gain of the regression below which the accelerometer is inverted.
const GAIN_INVERTED: f64 = -0.3;
/// Lowest gain that slip can cause, on ice: wheels that slip speed up while the body slows down,
/// but by less.
const SLIP_GAIN_MIN: f64 = -0.5;
/// Alarm threshold of the cumulative sum of evidence that the accelerometer is inverted, seconds;
/// longer than the lag of the wheels.
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

/// High-pass filter that removes the gravity that tilts add to accelerations.
///
/// A tilt relative to the robot adds a constant `b` in the body frame, a slope of the ground a
/// constant `G` in a frame that does not turn, in which the body has the heading ψ. Both are fitted
/// by least squares with exponential forgetting, `a = b + R(−ψ) G`, and subtracted. Without slope
/// this is a first-order high-pass filter.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Tilts {
    information: Matrix4<f64>,
    /// Information times `[b, G]` of the measured and of the predicted acceleration.
    weighted: [Vector4<f64>; 2],
}

impl Default for Tilts {
    fn default() -> Self {
        Self {
            information: Matrix4::zeros(),
            weighted: [Vector4::zeros(); 2],
        }
    }
}

impl Tilts {
    /// Adds the accelerations `[measured, predicted]` at the end of a bin, each `[forward, left]`,
    /// m/s², and returns them without gravity. That of a slope is removed only if there is a
    /// `heading_rad`.
    fn remove(
        &mut self,
        accelerations: [Vector2<f64>; 2],
        heading_rad: Option<f64>,
    ) -> [Vector2<f64>; 2] {
        let mut of_tilts = Matrix2x4::identity();
        if let Some(heading_rad) = heading_rad {
            let turned = Rotation2::new(-heading_rad);
            of_tilts
                .fixed_view_mut::<2, 2>(0, 2)
                .copy_from(turned.matrix());
        }
        let keep = (-BIN_S / HIGH_PASS_S).exp();
        self.information = self.information * keep + of_tilts.transpose() * of_tilts;
        for (weighted, acceleration) in self.weighted.iter_mut().zip(accelerations) {
            *weighted = *weighted * keep + of_tilts.transpose() * acceleration;
        }
        // On a straight path only the sum of both tilts is determined.
        let known = self.information + Matrix4::identity() * TILT_INFORMATION;
        let Some(factors) = known.cholesky() else {
            return accelerations;
        };
        let [measured, predicted] = self
            .weighted
            .map(|weighted| of_tilts * factors.solve(&weighted));
        [accelerations[0] - measured, accelerations[1] - predicted]
    }
}

/// Comparison of the accelerometer with wheels and gyro: measurements of the present bin, filter
/// and regression.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Accelerometer {
    sum: BodyAcceleration,
    count: f64,
    means: [BodyAcceleration; BINS],
    speeds_m_s: [f64; BINS + 1],
    bins: usize,
    /// Whether measured accelerations are the specific force.
    is_specific_force: bool,
    /// Heading since the last restart, radians.
    heading_rad: f64,
    tilts: Tilts,
    /// Measured and predicted acceleration without gravity over the last [`BINS`] bins, m/s².
    forward: Comparison,
    left: Comparison,
    /// `∫ measured·predicted`, `∫ predicted²`, `∫ residual²` and `∫ 1`, with exponential
    /// forgetting.
    sums: [f64; 4],
    /// Predicted acceleration, `[forward, left]`, when the measurement froze.
    frozen_from: Option<[f64; 2]>,
    /// Cumulative sum of the evidence that the accelerometer is inverted, seconds.
    inverted_s: f64,
    verdict: Option<Finding>,
    is_healthy: bool,
}

impl Accelerometer {
    /// Discards all measurements, because the motion since is unknown.
    pub(super) fn restart(&mut self) {
        *self = Self::default();
    }

    /// Adds a measurement of the present bin; `is_specific_force` states whether it contains
    /// gravity on a slope.
    pub(super) fn take(&mut self, measured: BodyAcceleration, is_specific_force: bool) {
        self.is_specific_force = is_specific_force;
        self.sum.forward_m_s2 += measured.forward_m_s2;
        self.sum.left_m_s2 += measured.left_m_s2;
        self.count += 1.0;
    }

    /// Returns the contradiction found in the last bin.
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
        self.heading_rad = wrap_angle_rad(self.heading_rad + motion.gyro_rad_s * BIN_S);
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
        let predicted = [
            (self.speeds_m_s[BINS] - self.speeds_m_s[0]) / (bins * BIN_S),
            speed_m_s * motion.gyro_rad_s,
        ];
        let mean = |of: fn(&BodyAcceleration) -> f64| self.means.iter().map(of).sum::<f64>() / bins;
        let measured = [
            mean(|measured| measured.forward_m_s2),
            mean(|measured| measured.left_m_s2),
        ];
        let accelerations = [measured.into(), predicted.into()];
        let axes = comparisons(accelerations);
        let middle_rad = self.heading_rad - 0.5 * bins * BIN_S * motion.gyro_rad_s;
        let heading_rad = self.is_specific_force.then_some(middle_rad);
        [self.forward, self.left] = comparisons(self.tilts.remove(accelerations, heading_rad));
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
            && gain.is_some_and(|(gain, _)| (GAIN_MIN..=GAIN_MAX).contains(&gain));
    }

    /// Updates the regression of measured on predicted accelerations. Returns its gain and the
    /// gain's standard deviation; None without enough excitation.
    fn regress(&mut self) -> Option<(f64, f64)> {
        let keep = (-BIN_S / MEMORY_S).exp();
        let before = if self.sums[1] > 0.0 {
            self.sums[0] / self.sums[1]
        } else {
            1.0
        };
        for axis in [self.forward, self.left] {
            let residual = axis.observed - before * axis.predicted;
            let new = [
                axis.observed * axis.predicted,
                axis.predicted * axis.predicted,
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
        let square = self.forward.predicted.powi(2) + self.left.predicted.powi(2);
        if square < SIGN_MIN {
            return;
        }
        let product = self.forward.observed * self.forward.predicted
            + self.left.observed * self.left.predicted;
        let gain = (product / (square + SIGN_NOISE)).clamp(-1.0, 1.0);
        // Wheels that slip speed up while the body slows down; in a turn the signs still agree.
        let weight = if self.forward.predicted.abs() > self.left.predicted.abs() {
            SIGN_FORWARD
        } else {
            1.0
        };
        let evidence_s = weight * BIN_S * (SLIP_GAIN_MIN - gain);
        self.inverted_s = (self.inverted_s + evidence_s).clamp(0.0, 1.0);
    }

    fn inverted(&self) -> Option<Finding> {
        (self.inverted_s >= INVERTED_S).then(|| {
            let axis = self.stronger();
            finding(Kind::Inverted, axis)
        })
    }

    /// Returns the axis with the larger predicted acceleration.
    fn stronger(&self) -> Comparison {
        if self.forward.predicted.abs() > self.left.predicted.abs() {
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
            observed: gain * axis.predicted,
            predicted: axis.predicted,
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

/// Pairs the axes of the accelerations `[measured, predicted]`.
fn comparisons([observed, predicted]: [Vector2<f64>; 2]) -> [Comparison; 2] {
    [0, 1].map(|axis: usize| Comparison {
        observed: observed[axis],
        predicted: predicted[axis],
    })
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::Twist;
    use crate::robot::GRAVITY_M_S2;

    /// A drive along eights on sloped ground with a tilted unit that measures the specific force.
    #[derive(Debug, Clone, Copy)]
    struct Drive {
        speed_m_s: f64,
        turn_rad_s: f64,
        lap_s: f64,
        slope: [f64; 2],
        /// Offset of the unit, forward and left, metres per second squared.
        offset_m_s2: [f64; 2],
        gain: f64,
    }

    impl Drive {
        /// Returns how many of the bins of a minute had a verdict, and how many were healthy.
        fn verdicts(&self) -> (u32, u32) {
            let mut own = Accelerometer::default();
            let (mut heading_rad, mut last_m_s) = (0.3_f64, 0.0);
            let (mut with_verdict, mut healthy) = (0, 0);
            for bin in 0..1_200_u32 {
                let time_s = f64::from(bin) * BIN_S;
                let starts = (time_s / 2.0).min(1.0);
                let phase = std::f64::consts::TAU * time_s / self.lap_s;
                let motion = Twist {
                    linear_m_s: starts * self.speed_m_s * (1.0 + 0.3 * (3.0 * phase).sin()),
                    angular_rad_s: starts * self.turn_rad_s * (2.0 * phase.sin()).clamp(-1.0, 1.0),
                };
                heading_rad += motion.angular_rad_s * BIN_S;
                let (sin, cos) = heading_rad.sin_cos();
                let [x, y] = self.slope;
                let forward_m_s2 = (motion.linear_m_s - last_m_s) / BIN_S;
                last_m_s = motion.linear_m_s;
                let of_motion = [forward_m_s2, motion.linear_m_s * motion.angular_rad_s];
                let of_slope = [x * cos + y * sin, y * cos - x * sin];
                let measured = [0, 1].map(|axis: usize| {
                    self.gain * (of_motion[axis] + GRAVITY_M_S2 * of_slope[axis])
                        + self.offset_m_s2[axis]
                });
                let measured = BodyAcceleration {
                    forward_m_s2: measured[0],
                    left_m_s2: measured[1],
                };
                own.take(measured, true);
                let means = Means {
                    gyro_rad_s: motion.angular_rad_s,
                    wheels: motion,
                    odometry_m_s: None,
                };
                own.step(&means, &Repeats::default());
                with_verdict += u32::from(own.verdict().is_some());
                healthy += u32::from(own.is_healthy());
            }
            (with_verdict, healthy)
        }
    }

    prop_compose! {
        fn drives()(
            speed_m_s in 0.7..1.4_f64,
            turn_rad_s in 0.5..1.0_f64,
            lap_s in 8.0..20.0_f64,
            slope in prop::array::uniform2(-0.15..0.15_f64),
            offset_m_s2 in prop::array::uniform2(-0.3..0.3_f64),
        ) -> Drive {
            Drive { speed_m_s, turn_rad_s, lap_s, slope, offset_m_s2, gain: 1.0 }
        }
    }

    proptest! {
        #[test]
        fn gravity_on_a_slope_is_no_fault_of_a_unit_without_attitude(drive in drives()) {
            let (with_verdict, healthy) = drive.verdicts();
            prop_assert_eq!(with_verdict, 0);
            prop_assert!(healthy > 100, "{}", healthy);
        }

        #[test]
        fn an_inverted_unit_is_noticed_on_a_slope(drive in drives()) {
            let (with_verdict, healthy) = Drive { gain: -1.0, ..drive }.verdicts();
            prop_assert!(with_verdict > 100, "{}", with_verdict);
            prop_assert_eq!(healthy, 0);
        }
    }
}
