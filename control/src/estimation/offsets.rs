//! What the robot has learned about its own rolling radii, whatever the ground.

use nalgebra::{Matrix2, Vector2, Vector3};

use super::regression::Sums;
use super::{THETA_FIRST, THETA_RANGE, ValueWithDeviation};

/// Standard deviation of θ that is assumed, about [`THETA_FIRST`], when offsets are learned.
const THETA_VAGUE: f64 = 2.0;

/// What is known about `δ_c` and `δ_d`, in information form.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OffsetKnowledge {
    pub(super) information: Matrix2<f64>,
    pub(super) weighted: Vector2<f64>,
}

impl OffsetKnowledge {
    /// Only how far radii spread: each side by `radius_ratio`, independently.
    pub(super) fn unknown(radius_ratio: f64) -> Self {
        let variance = radius_ratio.powi(2).max(1.0e-12);
        Self {
            information: Matrix2::new(2.0 / variance, 0.0, 0.0, 0.5 / variance),
            weighted: Vector2::zeros(),
        }
    }

    /// With what these sums tell about the offsets, whatever their θ.
    pub(super) fn with_ground(&self, sums: &Sums) -> Self {
        if sums.blocks == 0 {
            return *self;
        }
        // Without excitation there is no θ, and the offsets are learned all the same.
        let theta = sums
            .solve(self)
            .map_or(THETA_FIRST, |solution| solution.theta);
        let theta = theta.clamp(*THETA_RANGE.start(), *THETA_RANGE.end());
        let normal = sums.normal(theta);
        let vague = THETA_VAGUE.powi(-2);
        // A corrected square below its own noise is not known to be smaller than that noise.
        let own = normal.matrix[(0, 0)].max(2.0 * normal.noise_std_dev) + vague;
        let own_right = normal.right[0] + vague * THETA_FIRST;
        let cross = Vector2::new(normal.matrix[(1, 0)], normal.matrix[(2, 0)]);
        let information = normal.matrix.fixed_view::<2, 2>(1, 1) - cross * cross.transpose() / own;
        let weighted = Vector2::new(normal.right[1], normal.right[2]) - cross * (own_right / own);
        let Some(covariance) = (self.information + information).try_inverse() else {
            return *self;
        };
        let offsets = covariance * (self.weighted + weighted);
        let fitted_theta = (own_right - cross.dot(&offsets)) / own;
        let parameters = Vector3::new(fitted_theta, offsets[0], offsets[1]);
        let inflation = sums.inflation(&parameters, theta);
        let together = self.information + information / inflation;
        if together.cholesky().is_none() {
            return *self;
        }
        Self {
            information: together,
            weighted: self.weighted + weighted / inflation,
        }
    }

    /// `δ_c` and `δ_d` with their deviations.
    pub(super) fn values(&self) -> (ValueWithDeviation, ValueWithDeviation) {
        let covariance = self
            .information
            .try_inverse()
            .unwrap_or_else(Matrix2::zeros);
        let value = covariance * self.weighted;
        let of = |index: usize| ValueWithDeviation {
            value: value[index],
            std_dev: covariance[(index, index)].max(0.0).sqrt(),
        };
        (of(0), of(1))
    }
}
