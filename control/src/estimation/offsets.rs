//! Knowledge about the parameters that all segments share: radii, track, sensor offsets.

use nalgebra::{SMatrix, SVector};

use super::regression::{Normal, drive_known, inflation};
use super::rows::{OFFSETS, ParameterMatrix, Parameters, Tangent, index};
use super::sums::Sums;
use super::{SensorNoise, THETA_FIRST, THETA_RANGE, TyrePrior, ValueWithDeviation};

/// Standard deviation of the prior of θ, with the mean [`THETA_FIRST`], when offsets are learned.
const THETA_VAGUE: f64 = 2.0;

/// Fraction of the prior information that regularises the equations when few kinds of rows exist.
const REGULAR_SHARE: f64 = 1.0e-3;
/// Prior information on `θf` on new ground, negligible compared with any measurement.
const RESISTANCE_VAGUE: f64 = 1.0;

/// Estimate of the shared parameters in information form: those of the indices 1 to [`OFFSETS`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OffsetKnowledge {
    /// Information matrix Λ, the inverse of the covariance.
    pub(super) information: SMatrix<f64, OFFSETS, OFFSETS>,
    /// Λ times the estimated parameters.
    pub(super) weighted: SVector<f64, OFFSETS>,
    /// Whether measurements of the present ground have updated `θf`. Only the difference of `δ_c`
    /// and `θf` is observable, so the prior of `θf` must be added only once per ground.
    pub(super) knows_resistance: bool,
}

impl OffsetKnowledge {
    /// Returns the prior of a robot without measurements; radii of the two sides are independent.
    pub(super) fn unknown(noise: &SensorNoise, tyres: &TyrePrior) -> Self {
        let weight = |std_dev: f64| std_dev.max(1.0e-6).powi(-2);
        let radius = weight(noise.radius_ratio);
        let mut information = SMatrix::zeros();
        let mut put = |parameter: usize, value: f64| {
            information[(parameter - 1, parameter - 1)] = value;
        };
        put(index::RADIUS_OFFSET, 2.0 * radius);
        put(index::RADIUS_DIFFERENCE, 0.5 * radius);
        put(index::TRACK, weight(tyres.lateral_stiffness_std_dev));
        put(index::GYRO_OFFSET, weight(noise.gyro_offset_rad_s));
        put(
            index::LONGITUDINAL_OFFSET,
            weight(noise.accelerometer_offset_m_s2),
        );
        put(
            index::LONGITUDINAL_SCALE,
            weight(noise.accelerometer_scale_ratio),
        );
        put(index::RESISTANCE, RESISTANCE_VAGUE);
        Self {
            information,
            weighted: SVector::zeros(),
            knows_resistance: false,
        }
    }

    /// Returns the estimate for new ground: marginalises `θf` and resets it to its prior.
    pub(super) fn on_new_ground(&self) -> Self {
        let mut known = *self;
        let place = index::RESISTANCE - 1;
        let own = known.information[(place, place)].max(f64::MIN_POSITIVE);
        let column = known.information.column(place).into_owned();
        known.information -= column * column.transpose() / own;
        known.weighted -= column * (known.weighted[place] / own);
        for other in 0..OFFSETS {
            known.information[(place, other)] = 0.0;
            known.information[(other, place)] = 0.0;
        }
        known.information[(place, place)] = RESISTANCE_VAGUE;
        known.weighted[place] = 0.0;
        known.knows_resistance = false;
        known
    }

    /// Returns the estimate updated with the sums of a ground, with θ and κ of the ground
    /// marginalised. `theta` and the tyres in `found` serve as weights only. Works without
    /// excitation of θ, too.
    pub(super) fn with_ground(
        &self,
        sums: &Sums,
        tyres: &TyrePrior,
        theta: f64,
        found: &TyrePrior,
    ) -> Self {
        if sums.blocks == 0 {
            return *self;
        }
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
        for (parameter, mean, _) in drive_known(tyres) {
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
        take_out(index::LOADS, &mut matrix, &mut right);
        take_out(index::ROTORS, &mut matrix, &mut right);
        take_out(index::RELAXATION, &mut matrix, &mut right);
        take_out(index::CURVATURE, &mut matrix, &mut right);
        // The corrected square of the force is at least its own noise and at least the part that
        // the other regressors explain. Without these bounds, rows with nearly constant force would
        // turn an error of the correction into information on the radii.
        let others = self.information * REGULAR_SHARE + matrix.fixed_view::<OFFSETS, OFFSETS>(1, 1);
        let with_others = matrix
            .fixed_view::<OFFSETS, 1>(1, index::THETA)
            .into_owned();
        let explained = with_others.dot(&others.cholesky()?.solve(&with_others));
        let theta_at = (index::THETA, index::THETA);
        let vague = THETA_VAGUE.powi(-2);
        matrix[theta_at] = matrix[theta_at]
            .max(2.0 * normal.noise_std_dev)
            .max(explained)
            + vague;
        right[index::THETA] += vague * THETA_FIRST;
        take_out(index::THETA, &mut matrix, &mut right);
        Some((
            matrix.fixed_view::<OFFSETS, OFFSETS>(1, 1).into_owned(),
            right.fixed_rows::<OFFSETS>(1).into_owned(),
        ))
    }

    /// Returns `δ_c` and `δ_d` with their standard deviations.
    pub(super) fn values(&self) -> (ValueWithDeviation, ValueWithDeviation) {
        let covariance = self
            .information
            .cholesky()
            .map_or_else(SMatrix::zeros, |factors| factors.inverse());
        let value = covariance * self.weighted;
        let of = |parameter: usize| ValueWithDeviation {
            value: value[parameter - 1],
            std_dev: covariance[(parameter - 1, parameter - 1)].max(0.0).sqrt(),
        };
        (of(index::RADIUS_OFFSET), of(index::RADIUS_DIFFERENCE))
    }
}

fn take_out(parameter: usize, matrix: &mut ParameterMatrix, right: &mut Parameters) {
    let own = matrix[(parameter, parameter)].max(f64::MIN_POSITIVE);
    let column = matrix.column(parameter).into_owned();
    let share = right[parameter] / own;
    *matrix -= column * column.transpose() / own;
    *right -= column * share;
}
