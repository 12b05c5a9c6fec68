//! Additive statistics of one segment, without any prior on θ.

use serde::{Deserialize, Serialize};

use super::identification::Identified;
use super::offsets::OffsetKnowledge;
use super::sums::Sums;
use super::{BLOCK_S, CommonError};

/// Additive statistics of one segment. `Λ = 1/σ²` of segments add up, and so do `Λθ`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct SegmentStatistics {
    /// Information on θ, Λ = 1/σ²; 0 without an estimate. σ includes the errors of offsets and
    /// tyres, but not the robot's common error, so that segments can be summed without knowledge of
    /// common errors. With unknown tyres, later segments on the same ground therefore have little
    /// information.
    pub theta_information: f64,
    /// Λθ.
    pub theta_weighted: f64,
    /// Information on θ without the common errors, which do not average out over segments.
    pub own_information: f64,
    /// Standard deviations of the common errors, relative to θ.
    pub common_ratio: CommonError,
    /// Number of blocks in the linear range.
    pub samples: u64,
    /// Duration of these blocks, seconds.
    pub duration_s: f64,
    /// Lower bound of the peak friction coefficient.
    pub mu_peak_lower_bound: Option<f64>,
    /// Information on the ratio of effective to geometric track width; 0 without an estimate.
    pub effective_track_information: f64,
    /// `effective_track_information` times the ratio.
    pub effective_track_weighted: f64,
    /// Information on the rolling resistance coefficient; 0 before enough straight driving with
    /// torque. It includes the uncertainty of the accelerometer's offset.
    pub rolling_resistance_information: f64,
    /// `rolling_resistance_information` times the coefficient.
    pub rolling_resistance_weighted: f64,
    /// Fraction of the blocks of this segment beyond the linear range of slip.
    pub saturation_ratio: f64,
}

/// Minimum ratio of the information that a segment states to its own information, so that it is not
/// dropped as empty.
const STATED_MIN_RATIO: f64 = 1.0e-6;

/// θ of one segment alone, with its information.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SegmentTheta {
    /// θ of the segment.
    pub(super) theta: f64,
    /// Information Λ that the segment adds to the sum of its ground; its variance includes the
    /// error of the tyres.
    pub(super) information: f64,
    /// Information without the common errors.
    pub(super) own_information: f64,
    /// Standard deviations of the common errors, relative to θ.
    pub(super) common_ratio: CommonError,
    /// Duration of the blocks used, seconds.
    pub(super) duration_s: f64,
}

/// Variance of the θ of one segment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SegmentVariance {
    /// Variance σ².
    pub(super) total: f64,
    /// Covariance c with the θ of the segments before.
    pub(super) shared: f64,
}

/// Information that the segments of one ground state together.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct StatedInformation {
    /// Sum W of the stated information.
    information: f64,
    /// True variance of θ fused from these segments, V ≤ 1/W.
    variance: f64,
    /// Standard deviation of the tyres' part of the error of that θ.
    tyre_std_dev: f64,
}

impl StatedInformation {
    /// Returns the information w that the next segment states: the largest one for which the
    /// variance of the fused θ is at most `1/(W + w)`.
    ///
    /// With weights W and w the fused variance is `(W²V + w²σ² + 2Wwc)/(W + w)²`; the condition is
    /// a quadratic inequality in w.
    pub(super) fn add(&mut self, segment: SegmentVariance) -> f64 {
        let SegmentVariance {
            total: variance,
            shared,
        } = segment;
        let (sum, own) = (self.information, variance.recip());
        let linear = 1.0 - 2.0 * sum * shared;
        let constant = sum * (1.0 - sum * self.variance).max(0.0);
        let most = 0.5 * own * (linear + (linear * linear + 4.0 * variance * constant).sqrt());
        let information = most.clamp(0.0, own);
        let together = sum + information;
        if together > 0.0 {
            self.variance = (sum * sum * self.variance
                + information * (information * variance + 2.0 * sum * shared))
                / (together * together);
        }
        self.information = together;
        information
    }

    /// Returns θ of an identified segment with the information that it states. Its own error is
    /// independent of those of other segments; the error of the tyres, which may become smaller
    /// while more of their friction curve is known, has the correlation 1.
    pub(super) fn identified(&mut self, found: &Identified) -> SegmentTheta {
        let [own, tyres] = [found.own_ratio, found.tyres_ratio].map(|ratio| ratio * found.theta);
        let information = self.add(SegmentVariance {
            total: own.powi(2) + tyres.powi(2),
            shared: self.tyre_std_dev * tyres,
        });
        if self.information > 0.0 {
            self.tyre_std_dev += information / self.information * (tyres - self.tyre_std_dev);
        }
        SegmentTheta {
            theta: found.theta,
            information,
            own_information: own.powi(-2),
            common_ratio: CommonError {
                robot: found.robot_ratio,
                tyres: found.tyres_ratio,
            },
            duration_s: found.duration_s,
        }
    }
}

impl SegmentStatistics {
    /// Returns θ of this segment alone; `None` without information.
    pub fn theta(&self) -> Option<f64> {
        (self.theta_information > 0.0).then(|| self.theta_weighted / self.theta_information)
    }

    /// Returns the statistics of the blocks in `sums`; without `theta` those on θ are 0.
    /// `accelerometer_offset_mu` is the standard deviation of the accelerometer's offset over
    /// gravity.
    pub(super) fn of(
        sums: &Sums,
        offsets: &OffsetKnowledge,
        theta: Option<SegmentTheta>,
        accelerometer_offset_mu: f64,
    ) -> Self {
        let information = theta.map_or(0.0, |found| {
            found
                .information
                .max(STATED_MIN_RATIO * found.own_information)
        });
        let duration_s = theta.map_or(0.0, |found| found.duration_s);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a number of blocks"
        )]
        let blocks = (duration_s / BLOCK_S).round() as u64;
        let track = sums.effective_track(offsets);
        let track_information = track.map_or(0.0, |track| track.std_dev.powi(-2));
        let rolling = sums.rolling_resistance(accelerometer_offset_mu);
        let rolling_information = rolling.map_or(0.0, |rolling| rolling.std_dev.powi(-2));
        Self {
            theta_information: information,
            theta_weighted: theta.map_or(0.0, |found| information * found.theta),
            own_information: theta.map_or(0.0, |found| found.own_information),
            common_ratio: theta.map_or_else(CommonError::default, |found| found.common_ratio),
            samples: sums.blocks.max(blocks),
            duration_s: sums.duration_s.max(duration_s),
            mu_peak_lower_bound: sums.mu_peak(),
            effective_track_information: track_information,
            effective_track_weighted: track.map_or(0.0, |track| track_information * track.value),
            rolling_resistance_information: rolling_information,
            rolling_resistance_weighted: rolling
                .map_or(0.0, |rolling| rolling_information * rolling.value),
            saturation_ratio: sums.saturation_share(),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn segments_with_a_common_error_never_claim_more_than_their_sum_keeps(
            segments in prop::collection::vec((0.1..10.0_f64, 0.0..1.0_f64), 1..20),
        ) {
            let mut stated = StatedInformation::default();
            let mut weights: Vec<f64> = Vec::new();
            let mut variance_sum = 0.0;
            for (variance, correlation) in segments {
                let shared = 0.1 * correlation;
                let weight = stated.add(SegmentVariance { total: variance, shared });
                prop_assert!((0.0..=variance.recip()).contains(&weight));
                let before: f64 = weights.iter().sum();
                variance_sum += weight * (weight * variance + 2.0 * before * shared);
                weights.push(weight);
            }
            let information: f64 = weights.iter().sum();
            prop_assert!(variance_sum <= information * (1.0 + 1.0e-9));
        }

        #[test]
        fn segments_never_claim_more_than_their_sum_keeps_while_the_tyres_become_known(
            segments in prop::collection::vec((0.01..0.3_f64, 0.01..0.3_f64), 1..20),
            theta in 0.1..2.0_f64,
        ) {
            let mut stated = StatedInformation::default();
            let (mut information, mut own_variance, mut tyres_std_dev) = (0.0, 0.0, 0.0);
            for (own_ratio, tyres_ratio) in segments {
                let found = stated.identified(&Identified {
                    theta,
                    own_ratio,
                    robot_ratio: 0.1,
                    tyres_ratio,
                    tyre_prior_ratio: 0.0,
                    duration_s: 10.0,
                });
                information += found.information;
                own_variance += (found.information * own_ratio * theta).powi(2);
                tyres_std_dev += found.information * tyres_ratio * theta;
            }
            // Of the sum of all θ, weighted by their information.
            let variance = own_variance + tyres_std_dev * tyres_std_dev;
            prop_assert!(variance <= information * (1.0 + 1.0e-9));
        }

        #[test]
        fn segments_that_share_nothing_claim_all_they_have(
            variances in prop::collection::vec(0.1..10.0_f64, 1..20),
        ) {
            let mut stated = StatedInformation::default();
            for variance in variances {
                let alone = SegmentVariance { total: variance, shared: 0.0 };
                prop_assert!((stated.add(alone) * variance - 1.0).abs() < 1.0e-9);
            }
        }
    }
}
