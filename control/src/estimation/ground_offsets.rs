//! Updates the knowledge of the shared parameters with the measurements of a ground.

use nalgebra::{SMatrix, SVector};

use super::offsets::OffsetKnowledge;
use super::regression::{Normal, Solution, drivetrain_priors, inflation};
use super::rows::{OFFSETS, ParameterMatrix, Parameters, Tangent, index};
use super::sums::Sums;
use super::{THETA_INITIAL, THETA_RANGE, TyrePrior};

/// Standard deviation of the prior of θ, with the mean [`THETA_INITIAL`], when offsets are learned.
const THETA_PRIOR_STD_DEV: f64 = 2.0;

/// Fraction of the prior information that regularises the equations when few kinds of rows exist.
const REGULAR_SHARE: f64 = 1.0e-3;

impl OffsetKnowledge {
    /// Returns the estimate updated with the sums of a ground, with θ and κ of the ground
    /// marginalised. θ and the tyres of `solution` serve as weights only. Works without excitation
    /// of θ, too.
    pub(super) fn with_ground(
        &self,
        sums: &Sums,
        tyres: &TyrePrior,
        solution: Option<&Solution>,
    ) -> Self {
        if sums.blocks == 0 {
            return *self;
        }
        let found = solution.map_or(*tyres, |solution| solution.tyres(tyres));
        let theta = solution.map_or(THETA_INITIAL, |solution| solution.theta);
        let theta = theta.clamp(*THETA_RANGE.start(), *THETA_RANGE.end());
        let channels = sums.channels();
        let tangent = Tangent::at(theta, found.at(theta));
        let normal =
            Normal::of(&channels, theta, tangent, (tyres, 1.0)).with_resistance(self, theta);
        let Some((matrix, right)) = self.without_ground(&normal) else {
            return *self;
        };
        let Some(together) = (self.information + matrix).cholesky() else {
            return *self;
        };
        let offsets = together.solve(&(self.weighted + right));
        let mut parameters = Parameters::zeros();
        parameters.fixed_rows_mut::<OFFSETS>(1).copy_from(&offsets);
        parameters[index::THETA] = theta;
        parameters[index::CURVATURE] = found.curvature;
        for (parameter, mean, _) in drivetrain_priors(tyres) {
            parameters[parameter] = theta * mean;
        }
        let inflation = inflation(&channels, &parameters, theta, tangent);
        let information = self.information + matrix / inflation;
        if information.cholesky().is_none() {
            return *self;
        }
        Self {
            information,
            weighted: self.weighted + right / inflation,
            knows_resistance: true,
        }
    }

    /// Marginalises the parameters of ground and tyres in normal equations by Schur complements;
    /// `None` if the remaining equations would be singular.
    fn without_ground(
        &self,
        normal: &Normal,
    ) -> Option<(SMatrix<f64, OFFSETS, OFFSETS>, SVector<f64, OFFSETS>)> {
        let mut matrix = normal.matrix;
        let mut right = normal.right;
        marginalise(index::LOADS, &mut matrix, &mut right);
        marginalise(index::ROTORS, &mut matrix, &mut right);
        marginalise(index::RELAXATION, &mut matrix, &mut right);
        marginalise(index::CURVATURE, &mut matrix, &mut right);
        // The corrected square of the force is at least its own noise and at least the part that
        // the other regressors explain. Without these bounds, rows with nearly constant force would
        // turn an error of the correction into information on the radii.
        let others = self.information * REGULAR_SHARE + matrix.fixed_view::<OFFSETS, OFFSETS>(1, 1);
        let with_others = matrix
            .fixed_view::<OFFSETS, 1>(1, index::THETA)
            .into_owned();
        let explained = with_others.dot(&others.cholesky()?.solve(&with_others));
        let theta_at = (index::THETA, index::THETA);
        let prior_information = THETA_PRIOR_STD_DEV.powi(-2);
        matrix[theta_at] = matrix[theta_at]
            .max(2.0 * normal.noise_std_dev)
            .max(explained)
            + prior_information;
        right[index::THETA] += prior_information * THETA_INITIAL;
        marginalise(index::THETA, &mut matrix, &mut right);
        Some((
            matrix.fixed_view::<OFFSETS, OFFSETS>(1, 1).into_owned(),
            right.fixed_rows::<OFFSETS>(1).into_owned(),
        ))
    }
}

/// Marginalises a parameter of normal equations by its Schur complement.
fn marginalise(parameter: usize, matrix: &mut ParameterMatrix, right: &mut Parameters) {
    let own = matrix[(parameter, parameter)].max(f64::MIN_POSITIVE);
    let column = matrix.column(parameter).into_owned();
    let share = right[parameter] / own;
    *matrix -= column * column.transpose() / own;
    *right -= column * share;
}
