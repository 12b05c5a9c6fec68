//! Additive statistics of measurements: what is stored per cell, ground, robot, configuration
//! and epoch.
//!
//! Everything is a sum of integers, a largest or a newest, so the result is the same to the bit
//! for every order and batching of what arrives.

use std::cmp::Ordering;

use jiff::Timestamp;
use tread_api::friction::{Information, Segment};

use super::fixed::Fixed;

/// Seconds of an hour.
pub const HOUR_S: i64 = 3_600;
/// Microseconds of an hour.
const HOUR_US: i64 = 3_600_000_000;
/// Hours of a day, into which old epochs are merged.
pub const DAY_H: i64 = 24;

/// An estimate as sums: Σ Λ and Σ Λ·value.
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

    /// Λ and the value; `None` when nothing is known.
    pub fn known(&self) -> Option<Known> {
        let information = self.information.to_f64();
        (information > 0.0).then(|| Known {
            information,
            value: self.weighted.to_f64() / information,
        })
    }
}

/// A value with the information behind it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Known {
    /// Λ = 1/σ².
    pub information: f64,
    /// The value.
    pub value: f64,
}

/// How many of its own standard deviations θ of a pass must be for the pass to tell of a change.
///
/// One that says less contradicts nothing, and would hide one before it that does.
pub const TELLING_DEVIATIONS: f64 = 4.5;

/// The newest measurement that tells something, by itself, so that a change of the ground shows
/// within an epoch; the newest of all if none does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pass {
    /// When it ended, microseconds since 1970.
    pub ended_at_us: i64,
    /// Its θ; `None` for sums from before this was kept.
    pub theta: Option<Information>,
    /// Friction that it has seen.
    pub mu_peak: Option<f64>,
}

impl Pass {
    /// Whether θ is known by it at all: `θ/σ = Λθ/√Λ`. The database computes the same.
    fn is_telling(&self) -> bool {
        self.theta.is_some_and(|theta| {
            let least = TELLING_DEVIATIONS * TELLING_DEVIATIONS * theta.information;
            theta.information > 0.0 && theta.weighted * theta.weighted >= least
        })
    }

    /// A total order, so that the newest is the same whoever comes first.
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

/// θ with the information of its independent error; all of it where the robot tells nothing apart.
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

/// Bits that compare as the numbers do.
fn ordered(value: f64) -> i64 {
    let bits = value.to_bits().cast_signed();
    bits ^ ((bits >> 63).cast_unsigned() >> 1).cast_signed()
}

/// Additive statistics of some measurements.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sums {
    /// θ.
    pub theta: Pair,
    /// Σ Λ·θ², which tells how far the measurements differ among themselves.
    pub theta_square: Fixed,
    /// Σ Λ times the common error of the robot, as a share of θ.
    pub robot_error: Fixed,
    /// Σ Λ times the common error of the tyres, as a share of θ.
    pub tyre_error: Fixed,
    /// Ratio of effective to geometric track.
    pub track: Pair,
    /// Rolling resistance coefficient.
    pub rolling: Pair,
    /// How many segments.
    pub segments: u64,
    /// How many samples behind them.
    pub samples: u64,
    /// Largest friction coefficient seen.
    pub mu_peak: Option<f64>,
    /// End of the newest of them, microseconds since 1970.
    pub newest_at_us: i64,
    /// The newest of them that tells something.
    pub newest: Pass,
}

impl Sums {
    /// The statistics of one segment; `None` if its numbers leave the range of fixed point.
    pub fn of(segment: &Segment) -> Option<Self> {
        // What a robot has in common with itself or with its like does not add up: it is kept beside
        // what does, and counted only once for all.
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
            newest_at_us: segment.ended_at.as_microsecond(),
            newest: Pass {
                ended_at_us: segment.ended_at.as_microsecond(),
                theta: Some(theta),
                mu_peak: segment.mu_peak_lower_bound,
            },
        })
    }

    /// Adds other measurements.
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

    /// End of the newest.
    pub fn newest_at(&self) -> Timestamp {
        Timestamp::from_microsecond(self.newest_at_us).unwrap_or(Timestamp::MAX)
    }
}

/// The bucket of measuring time: whole hours since 1970.
pub fn epoch_h(time: Timestamp) -> i64 {
    time.as_microsecond().div_euclid(HOUR_US)
}

/// The first hour of the bucket that an hour lies in, where days before `merged_before_h` are
/// merged.
///
/// What is in the database may not be merged yet: reading through this gives the same answer
/// before, during and after.
pub fn bucket_h(hour: i64, merged_before_h: i64) -> i64 {
    if hour < merged_before_h {
        hour.div_euclid(DAY_H) * DAY_H
    } else {
        hour
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

        #[test]
        fn a_bucket_holds_its_hours_and_begins_with_its_first(hour in -10_000_i64..1_000_000, days in 0_i64..50_000) {
            let bucket = bucket_h(hour, days * DAY_H);
            prop_assert!(bucket <= hour && hour - bucket < DAY_H);
            prop_assert_eq!(bucket_h(bucket, days * DAY_H), bucket);
            prop_assert_eq!(bucket == hour, hour >= days * DAY_H || hour % DAY_H == 0);
        }
    }
}
