//! Knowledge about the parameters that all segments share: radii, track, sensor offsets.

use nalgebra::{SMatrix, SVector};

use super::rows::{OFFSETS, index};
use super::{SensorNoise, TyrePrior, ValueWithStdDev};

/// Prior information on `θf` on new ground, negligible compared with any measurement.
const RESISTANCE_PRIOR_INFORMATION: f64 = 1.0;

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
        let mut set_diagonal = |parameter: usize, value: f64| {
            information[(parameter - 1, parameter - 1)] = value;
        };
        set_diagonal(index::RADIUS_OFFSET, 2.0 * radius);
        set_diagonal(index::RADIUS_DIFFERENCE, 0.5 * radius);
        set_diagonal(index::TRACK, weight(tyres.lateral_stiffness_std_dev));
        set_diagonal(index::GYRO_OFFSET, weight(noise.gyro_offset_rad_s));
        set_diagonal(
            index::LONGITUDINAL_OFFSET,
            weight(noise.accelerometer_offset_m_s2),
        );
        set_diagonal(
            index::LONGITUDINAL_SCALE,
            weight(noise.accelerometer_scale_ratio),
        );
        set_diagonal(index::RESISTANCE, RESISTANCE_PRIOR_INFORMATION);
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
        known.information[(place, place)] = RESISTANCE_PRIOR_INFORMATION;
        known.weighted[place] = 0.0;
        known.knows_resistance = false;
        known
    }

    /// Returns `δ_c` and `δ_d` with their standard deviations.
    pub(super) fn values(&self) -> (ValueWithStdDev, ValueWithStdDev) {
        let covariance = self
            .information
            .cholesky()
            .map_or_else(SMatrix::zeros, |factors| factors.inverse());
        let value = covariance * self.weighted;
        let of = |parameter: usize| ValueWithStdDev {
            value: value[parameter - 1],
            std_dev: covariance[(parameter - 1, parameter - 1)].max(0.0).sqrt(),
        };
        (of(index::RADIUS_OFFSET), of(index::RADIUS_DIFFERENCE))
    }
}
