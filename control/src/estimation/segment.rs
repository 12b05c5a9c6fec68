//! What a robot learned on one stretch of one ground: additive statistics without any prior on θ.

use serde::{Deserialize, Serialize};

use super::offsets::OffsetKnowledge;
use super::regression::Sums;

/// Additive statistics of one segment. `Λ = 1/σ²` of segments add up, and so do `Λθ`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct SegmentStatistics {
    /// Information on θ, Λ = 1/σ²; 0 when there is none. It holds the offsets' deviation, but not
    /// the error of the torque constants, which is the same in all segments of a robot.
    pub theta_information: f64,
    /// Λθ.
    pub theta_weighted: f64,
    /// Blocks that carry force in the linear range.
    pub samples: u64,
    /// Their time, seconds.
    pub duration_s: f64,
    /// Friction coefficient that the ground has given at least.
    pub mu_peak_lower_bound: Option<f64>,
    /// Information on the effective track over W; 0 when there is none.
    pub effective_track_information: f64,
    /// That information times the ratio.
    pub effective_track_weighted: f64,
    /// Rolling resistance over load, after enough straight driving.
    pub rolling_resistance_ratio: Option<f64>,
}

impl SegmentStatistics {
    /// θ of this segment alone; none when it carries no information.
    pub fn theta(&self) -> Option<f64> {
        (self.theta_information > 0.0).then(|| self.theta_weighted / self.theta_information)
    }

    pub(super) fn of(sums: &Sums, offsets: &OffsetKnowledge, theta_ground: Option<f64>) -> Self {
        let solution = theta_ground.filter(|theta| *theta > 0.0).and_then(|theta| {
            sums.solve_from(offsets, Some(theta))
                .filter(|found| found.is_informative(theta))
        });
        let information = solution.map_or(0.0, |found| found.variance.recip());
        let track = sums.effective_track(offsets);
        let track_information = track.map_or(0.0, |track| track.std_dev.powi(-2));
        Self {
            theta_information: information,
            theta_weighted: solution.map_or(0.0, |found| information * found.theta),
            samples: sums.blocks,
            duration_s: sums.duration_s,
            mu_peak_lower_bound: sums.mu_peak(),
            effective_track_information: track_information,
            effective_track_weighted: track.map_or(0.0, |track| track_information * track.value),
            rolling_resistance_ratio: sums.rolling_resistance(),
        }
    }
}
