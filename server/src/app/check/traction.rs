//! Traction limits of the friction map with which a robot plans a mission: those of its offer.

use tread_api::site::Grid;
use tread_api::wire::command::PathPrior;
use tread_control::plan::{PlanOptions, TractionLimitCell, TractionLimitMap, TractionLimitMapSpec};

/// Traction limits of a plan; without any the robot model's own limits alone apply.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::app) struct Traction {
    least_mu: Option<f64>,
    cells: Option<TractionLimitMap>,
}

impl Traction {
    /// Takes the limits from the prior of an offer, as the robot does: those of cells count for the
    /// grid they were made for only.
    pub(in crate::app) fn of_prior(prior: Option<&PathPrior>, grid: &Grid) -> Self {
        let Some(prior) = prior else {
            return Self::default();
        };
        let is_of_grid = prior.grid_revision == grid.revision && !prior.traction_limits.is_empty();
        let cells = prior.traction_limits.iter().map(|limit| TractionLimitCell {
            ix: limit.cell.ix,
            iy: limit.cell.iy,
            mu: limit.mu,
        });
        let spec = is_of_grid.then(|| TractionLimitMapSpec {
            square_m: grid.cell_m,
            squares: cells.collect(),
            elsewhere_mu: prior.traction_limit_mu,
        });
        Self {
            least_mu: Some(prior.traction_limit_mu),
            cells: spec.and_then(TractionLimitMap::new),
        }
    }

    /// Returns the options with these limits.
    pub(in crate::app) fn limiting<'a>(&'a self, options: &PlanOptions<'a>) -> PlanOptions<'a> {
        PlanOptions {
            traction_limit_mu: self.least_mu,
            traction_limits: self.cells.as_ref(),
            ..*options
        }
    }
}
