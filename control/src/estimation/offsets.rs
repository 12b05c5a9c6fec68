//! What the robot has learned about itself, whatever the ground: radii, track, sensor offsets.

use nalgebra::{SMatrix, SVector};

use super::regression::{Normal, drive_known, inflation};
use super::rows::{OFFSETS, ParameterMatrix, Parameters, Tangent, index};
use super::sums::Sums;
use super::{SensorNoise, THETA_FIRST, THETA_RANGE, TyrePrior, ValueWithDeviation};

/// Standard deviation of θ that is assumed, about [`THETA_FIRST`], when offsets are learned.
const THETA_VAGUE: f64 = 2.0;

/// Share of what is known with which equations of few kinds of rows are made regular.
const REGULAR_SHARE: f64 = 1.0e-3;
/// Information on `θf` while nothing is known: far below what anything else tells.
const RESISTANCE_VAGUE: f64 = 1.0;

/// What is known about the robot's own parameters, in information form.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OffsetKnowledge {
    pub(super) information: SMatrix<f64, OFFSETS, OFFSETS>,
    pub(super) weighted: SVector<f64, OFFSETS>,
    /// Whether the present ground has had a word on its rolling resistance. Like `δ_c` it acts on
    /// both rows with torque, and only their difference can be learned: what one block takes for
    /// the one, the next must not take for the other.
    pub(super) knows_resistance: bool,
}

impl OffsetKnowledge {
    /// Only how far they spread; radii of the two sides independently.
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

    /// Without what is the ground's own, for new ground.
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

    /// With what these sums tell about the robot, whatever their θ and κ; the given ones only weigh
    /// them. Without excitation there is no θ, and the rest is learned all the same.
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

    /// The Schur complement that takes θκ, then θ, out of normal equations; none where what is left
    /// would not be regular.
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
        // A corrected square below its own noise is not known to be smaller than that noise, and it
        // is no smaller than what the other regressors explain of it: rows whose force hardly
        // varies would tell the radii by what the correction takes too much.
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

    /// `δ_c` and `δ_d` with their standard deviations.
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
