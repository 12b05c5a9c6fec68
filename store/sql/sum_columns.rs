//! Columns of the sums of measurements.

use tread_api::friction::Information;
use tread_store::friction::Sums;
use tread_store::friction::fixed::Fixed;
use tread_store::friction::sums::{Pair, Pass};
use tread_store::sums::{SumKey, SumRow};

use super::{EngineError, ground, unsigned};

/// A row of the table of sums.
pub(super) struct RawSum {
    pub(super) site_pk: i64,
    pub(super) ix: i64,
    pub(super) iy: i64,
    pub(super) grid_revision: i64,
    pub(super) terrain: String,
    pub(super) terrain_revision: i64,
    pub(super) robot_pk: i64,
    pub(super) configuration_pk: i64,
    pub(super) epoch_h: i64,
    pub(super) information_hi: i64,
    pub(super) information_lo: i64,
    pub(super) weighted_hi: i64,
    pub(super) weighted_lo: i64,
    pub(super) square_hi: i64,
    pub(super) square_lo: i64,
    pub(super) track_information_hi: i64,
    pub(super) track_information_lo: i64,
    pub(super) track_weighted_hi: i64,
    pub(super) track_weighted_lo: i64,
    pub(super) rolling_information_hi: i64,
    pub(super) rolling_information_lo: i64,
    pub(super) rolling_weighted_hi: i64,
    pub(super) rolling_weighted_lo: i64,
    pub(super) segments: i64,
    pub(super) samples: i64,
    pub(super) mu_peak: Option<f64>,
    pub(super) newest_at_us: i64,
    pub(super) newest_information: Option<f64>,
    pub(super) newest_weighted: Option<f64>,
    pub(super) newest_mu: Option<f64>,
    pub(super) pass_at_us: i64,
    pub(super) robot_error_hi: i64,
    pub(super) robot_error_lo: i64,
    pub(super) tyre_error_hi: i64,
    pub(super) tyre_error_lo: i64,
}

impl TryFrom<RawSum> for SumRow {
    type Error = EngineError;

    fn try_from(raw: RawSum) -> Result<Self, EngineError> {
        let key = SumKey {
            robot_pk: raw.robot_pk,
            epoch_h: raw.epoch_h,
            cell: ground::cell(raw.ix, raw.iy)?,
            terrain: ground::terrain(&raw.terrain, raw.terrain_revision)?,
            grid_revision: unsigned("grid revision", raw.grid_revision)?,
            site_pk: raw.site_pk,
            configuration_pk: raw.configuration_pk,
        };
        let (units, steps) = (Fixed::from_units, Fixed::from_steps);
        let newest_theta = raw.newest_information.zip(raw.newest_weighted);
        let sums = Sums {
            theta: Pair {
                information: units(raw.information_hi) + steps(raw.information_lo),
                weighted: units(raw.weighted_hi) + steps(raw.weighted_lo),
            },
            theta_square: units(raw.square_hi) + steps(raw.square_lo),
            robot_error: units(raw.robot_error_hi) + steps(raw.robot_error_lo),
            tyre_error: units(raw.tyre_error_hi) + steps(raw.tyre_error_lo),
            track: Pair {
                information: units(raw.track_information_hi) + steps(raw.track_information_lo),
                weighted: units(raw.track_weighted_hi) + steps(raw.track_weighted_lo),
            },
            rolling: Pair {
                information: units(raw.rolling_information_hi) + steps(raw.rolling_information_lo),
                weighted: units(raw.rolling_weighted_hi) + steps(raw.rolling_weighted_lo),
            },
            segments: unsigned("count", raw.segments)?,
            samples: unsigned("count", raw.samples)?,
            mu_peak: raw.mu_peak,
            newest_at_us: raw.newest_at_us,
            newest: Pass {
                ended_at_us: raw.pass_at_us,
                theta: newest_theta.map(|(information, weighted)| Information {
                    information,
                    weighted,
                }),
                mu_peak: raw.newest_mu,
            },
        };
        Ok(Self { key, sums })
    }
}
