//! Additive statistics of segments, stored per cell, terrain, robot, configuration and epoch.
//!
//! Each statistic is an integer sum, a maximum or the newest element, so the result is identical to
//! the bit for every order and batching of uploads.

use std::cmp::Ordering;

use jiff::Timestamp;
use tread_api::friction::{Information, Segment};

use super::fixed::Fixed;

/// Estimate in additive form: Σ Λ and Σ Λ·value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Pair {
    /// Σ Λ, in the inverse square of the value's unit.
    pub information: Fixed,
    /// Σ Λ·value.
    pub weighted: Fixed,
}

impl Pair {
    fn of(information: &Information) -> Option<Self> {
        Some(Self {
            information: Fixed::from_f64(information.information)?,
            weighted: Fixed::from_f64(information.weighted)?,
        })
    }

    fn add(&mut self, other: &Self) {
        self.information += other.information;
        self.weighted += other.weighted;
    }

    /// Returns Λ and the value; `None` if Λ is not positive.
    pub fn known(&self) -> Option<Known> {
        let information = self.information.to_f64();
        (information > 0.0).then(|| Known {
            information,
            value: self.weighted.to_f64() / information,
        })
    }
}

/// A value with its information.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Known {
    /// Λ = 1/σ², in the inverse square of the value's unit.
    pub information: f64,
    /// The estimated value.
    pub value: f64,
}

/// Minimum ratio of θ to its standard deviation for a pass to be *significant*, that is, to be
/// compared with other measurements for a change of the ground.
///
/// A less significant pass can contradict nothing, and must not replace an earlier significant one.
pub const TELLING_DEVIATIONS: f64 = 4.5;

/// The newest significant pass ([`TELLING_DEVIATIONS`]) by itself, to detect a change of the ground
/// within an epoch; the newest of all passes if none is significant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pass {
    /// End of the pass, microseconds since 1970.
    pub ended_at_us: i64,
    /// θ of the pass; `None` for sums stored by versions that did not record it.
    pub theta: Option<Information>,
    /// Peak friction coefficient of the pass.
    pub mu_peak: Option<f64>,
}

impl Pass {
    /// Returns whether the pass is significant: `θ/σ = Λθ/√Λ` reaches [`TELLING_DEVIATIONS`]. The
    /// SQL of the database computes the same.
    fn is_telling(&self) -> bool {
        self.theta.is_some_and(|theta| {
            let least = TELLING_DEVIATIONS * TELLING_DEVIATIONS * theta.information;
            theta.information > 0.0 && theta.weighted * theta.weighted >= least
        })
    }

    /// Compares two passes by a total order, so that the result does not depend on the order of
    /// arrival.
    fn newer(&self, other: &Self) -> Ordering {
        let bits = |pass: &Self| {
            let theta = pass
                .theta
                .map(|theta| (ordered(theta.information), ordered(theta.weighted)));
            (
                pass.is_telling(),
                pass.ended_at_us,
                theta,
                pass.mu_peak.map(ordered),
            )
        };
        bits(self).cmp(&bits(other))
    }
}

/// Returns θ with the information of its independent error, or with its total information if the
/// segment does not state its errors separately.
fn independent(segment: &Segment) -> Information {
    let theta = segment.theta;
    let Some((errors, value)) = segment.theta_errors.zip(theta.value()) else {
        return theta;
    };
    Information {
        information: errors.independent_information,
        weighted: errors.independent_information * value,
    }
}

/// Maps a number to an integer with the same order.
fn ordered(value: f64) -> i64 {
    let bits = value.to_bits().cast_signed();
    bits ^ ((bits >> 63).cast_unsigned() >> 1).cast_signed()
}

/// Additive statistics of a set of segments.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sums {
    /// θ, with the information of its independent errors.
    pub theta: Pair,
    /// Σ Λ·θ², from which the scatter of the segments is computed.
    pub theta_square: Fixed,
    /// Σ Λ·s, s the standard deviation of the robot's common error relative to θ.
    pub robot_error: Fixed,
    /// Σ Λ·t, t the standard deviation of the tyres' common error relative to θ.
    pub tyre_error: Fixed,
    /// Ratio of effective to geometric track width.
    pub track: Pair,
    /// Rolling resistance coefficient.
    pub rolling: Pair,
    /// Number of segments.
    pub segments: u64,
    /// Number of samples in the segments.
    pub samples: u64,
    /// Maximum of the peak friction coefficients.
    pub mu_peak: Option<f64>,
    /// End of the newest segment, microseconds since 1970.
    pub newest_at_us: i64,
    /// Newest significant pass.
    pub newest: Pass,
}

impl Sums {
    /// Returns the statistics of one segment; `None` if a value exceeds the range of [`Fixed`].
    pub fn of(segment: &Segment) -> Option<Self> {
        Self::of_ended_at(segment, segment.ended_at.as_microsecond())
    }

    /// The same for a segment whose end was corrected to another time, microseconds since 1970.
    pub fn of_ended_at(segment: &Segment, ended_at_us: i64) -> Option<Self> {
        // Errors common to a robot or to its tyres do not average out over segments: they are
        // summed separately and applied once to the estimate.
        let errors = segment.theta_errors;
        let theta = independent(segment);
        let square = if theta.information > 0.0 {
            theta.weighted * theta.weighted / theta.information
        } else {
            0.0
        };
        let pair = |information: &Option<Information>| match information {
            Some(information) => Pair::of(information),
            None => Some(Pair::default()),
        };
        Some(Self {
            theta: Pair::of(&theta)?,
            theta_square: Fixed::from_f64(square)?,
            robot_error: Fixed::from_f64(
                errors.map_or(0.0, |errors| theta.information * errors.robot_ratio),
            )?,
            tyre_error: Fixed::from_f64(
                errors.map_or(0.0, |errors| theta.information * errors.tyre_ratio),
            )?,
            track: pair(&segment.effective_track_ratio)?,
            rolling: pair(&segment.rolling_resistance)?,
            segments: 1,
            samples: u64::from(segment.samples),
            mu_peak: segment.mu_peak_lower_bound,
            newest_at_us: ended_at_us,
            newest: Pass {
                ended_at_us,
                theta: Some(theta),
                mu_peak: segment.mu_peak_lower_bound,
            },
        })
    }

    /// Adds the statistics of other segments.
    pub fn add(&mut self, other: &Self) {
        self.theta.add(&other.theta);
        self.theta_square += other.theta_square;
        self.robot_error += other.robot_error;
        self.tyre_error += other.tyre_error;
        self.track.add(&other.track);
        self.rolling.add(&other.rolling);
        self.segments += other.segments;
        self.samples += other.samples;
        self.mu_peak = match (self.mu_peak, other.mu_peak) {
            (Some(left), Some(right)) => Some(left.max(right)),
            (left, right) => left.or(right),
        };
        self.newest_at_us = self.newest_at_us.max(other.newest_at_us);
        if other.newest.newer(&self.newest) == Ordering::Greater {
            self.newest = other.newest;
        }
    }

    /// Returns the end of the newest segment.
    pub fn newest_at(&self) -> Timestamp {
        Timestamp::from_microsecond(self.newest_at_us).unwrap_or(Timestamp::MAX)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn ordered_bits_compare_as_numbers_do(left in -1.0e9_f64..1.0e9, right in -1.0e9_f64..1.0e9) {
            prop_assert_eq!(ordered(left).cmp(&ordered(right)), left.total_cmp(&right));
        }
    }
}
