//! The map's friction along the path of a mission, for the tracking law and the plan.
//!
//! It is kept apart from the robot's measurements: the estimator does not use it, so segments do
//! not contain it.

use tread_api::site::{Cell, Grid};
use tread_api::wire::command::{CellTractionLimit, PathPrior};
use tread_control::plan::{TractionLimitCell, TractionLimitMap, TractionLimitMapSpec};
use tread_control::tracking::ThetaKnowledge;

/// Difference of the robot's and the map's θ, in standard deviations, beyond which the robot's own
/// measurement is used alone.
const CONTRADICTION_STD_DEVS: f64 = 4.0;

/// Prior of one mission; empty if the map has no data.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Prior {
    grid_revision: u32,
    traction_limit_mu: Option<f64>,
    robot_bias_ratio: f64,
    /// Sorted by row, then column.
    cells: Box<[(Cell, ThetaKnowledge)]>,
    traction_limits: Box<[CellTractionLimit]>,
}

impl Prior {
    /// Creates the prior that came with an offer; an empty one if any of its values is impossible.
    pub(crate) fn new(prior: Option<&PathPrior>) -> Self {
        let Some(prior) = prior.filter(|prior| prior.is_possible()) else {
            return Self::default();
        };
        let mut cells: Vec<(Cell, ThetaKnowledge)> = prior
            .cells
            .iter()
            .map(|known| {
                let knowledge = ThetaKnowledge {
                    theta: known.theta,
                    std_dev: known.std_dev,
                };
                (known.cell, knowledge)
            })
            .collect();
        cells.sort_by_key(|(cell, _)| (cell.iy, cell.ix));
        Self {
            grid_revision: prior.grid_revision,
            traction_limit_mu: Some(prior.traction_limit_mu),
            robot_bias_ratio: prior.robot_bias_ratio,
            cells: cells.into_boxed_slice(),
            traction_limits: prior.traction_limits.clone().into_boxed_slice(),
        }
    }

    /// Returns the friction coefficient to plan with.
    pub(crate) fn traction_limit_mu(&self) -> Option<f64> {
        self.traction_limit_mu
    }

    /// Returns the friction coefficients by cell; `None` if there are none for this revision of the
    /// grid.
    pub(crate) fn traction_limit_map(&self, grid: Grid) -> Option<TractionLimitMap> {
        let elsewhere_mu = self.traction_limit_mu?;
        if grid.revision != self.grid_revision || self.traction_limits.is_empty() {
            return None;
        }
        let squares = self.traction_limits.iter().map(|limit| TractionLimitCell {
            ix: limit.cell.ix,
            iy: limit.cell.iy,
            mu: limit.mu,
        });
        TractionLimitMap::new(TractionLimitMapSpec {
            square_m: grid.cell_m,
            squares: squares.collect(),
            elsewhere_mu,
        })
    }

    /// Returns the relative standard deviation of one robot's θ around the map's.
    pub(crate) fn robot_bias_ratio(&self) -> f64 {
        self.robot_bias_ratio
    }

    /// Returns the map's θ of a cell; `None` for another revision of the grid. Does not allocate.
    pub(crate) fn at(&self, grid_revision: u32, cell: Cell) -> Option<ThetaKnowledge> {
        if grid_revision != self.grid_revision {
            return None;
        }
        let key = (cell.iy, cell.ix);
        let found = self
            .cells
            .binary_search_by_key(&key, |(cell, _)| (cell.iy, cell.ix));
        found.ok().map(|index| self.cells[index].1)
    }
}

/// Estimates of θ of one place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ThetaSources {
    /// The robot's own.
    pub(crate) measured: Option<ThetaKnowledge>,
    /// The map's.
    pub(crate) prior: Option<ThetaKnowledge>,
}

impl ThetaSources {
    /// Fuses both estimates; returns the measured one alone if they differ by more than
    /// [`CONTRADICTION_STD_DEVS`].
    pub(crate) fn fused(self) -> Option<ThetaKnowledge> {
        match (self.measured, self.prior) {
            (Some(measured), Some(prior)) => {
                let apart = (measured.theta - prior.theta).abs();
                let std_dev = measured.std_dev.hypot(prior.std_dev);
                if apart > CONTRADICTION_STD_DEVS * std_dev {
                    Some(measured)
                } else {
                    Some(measured.fused(prior))
                }
            }
            (measured, prior) => measured.or(prior),
        }
    }
}

#[cfg(test)]
mod tests {
    use tread_api::wire::command::CellPrior;

    use super::*;

    fn knowledge(theta: f64, std_dev: f64) -> ThetaKnowledge {
        ThetaKnowledge { theta, std_dev }
    }

    fn prior(cells: Vec<CellPrior>) -> PathPrior {
        PathPrior {
            grid_revision: 1,
            traction_limit_mu: 0.3,
            robot_bias_ratio: 0.08,
            cells,
            traction_limits: Vec::new(),
        }
    }

    fn cell(ix: i32, iy: i32, theta: f64) -> CellPrior {
        CellPrior {
            cell: Cell { ix, iy },
            theta,
            std_dev: 0.02,
        }
    }

    #[test]
    fn a_cell_is_found_in_its_grid_and_nowhere_else() {
        let offered = prior(vec![cell(5, -2, 0.5), cell(-3, 4, 0.2), cell(0, 0, 1.0)]);
        let kept = Prior::new(Some(&offered));
        let theta = |ix, iy| kept.at(1, Cell { ix, iy }).map(|known| known.theta);
        assert_eq!(theta(-3, 4), Some(0.2));
        assert_eq!(theta(5, -2), Some(0.5));
        assert_eq!(theta(4, -3), None);
        assert_eq!(kept.at(2, Cell { ix: 0, iy: 0 }), None);
        assert_eq!(kept.traction_limit_mu(), Some(0.3));
    }

    #[test]
    fn traction_limits_by_place_count_in_their_grid_alone() {
        let grid = |revision| Grid {
            revision,
            cell_m: 2.0,
        };
        let at = |x_m, y_m| tread_control::geometry::Point { x_m, y_m };
        let square = |mu| CellTractionLimit {
            cell: Cell { ix: 3, iy: -1 },
            mu,
        };
        let offered = PathPrior {
            traction_limits: vec![square(0.5)],
            ..prior(Vec::new())
        };
        let kept = Prior::new(Some(&offered));
        let map = kept.traction_limit_map(grid(1)).unwrap();
        assert_eq!((map.at(at(7.0, -1.0)), map.at(at(0.0, 0.0))), (0.5, 0.3));
        assert_eq!(kept.traction_limit_map(grid(2)), None);
        assert_eq!(
            Prior::new(Some(&prior(Vec::new()))).traction_limit_map(grid(1)),
            None
        );
        let offered = PathPrior {
            traction_limits: vec![square(-0.5)],
            ..offered
        };
        assert_eq!(Prior::new(Some(&offered)), Prior::default());
    }

    #[test]
    fn a_prior_with_an_impossible_number_is_none() {
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let offered = prior(vec![cell(0, 0, 0.2), cell(1, 0, bad)]);
            assert_eq!(Prior::new(Some(&offered)), Prior::default());
            let offered = PathPrior {
                traction_limit_mu: bad,
                ..prior(Vec::new())
            };
            assert_eq!(Prior::new(Some(&offered)), Prior::default());
        }
        for bad in [-0.1, 1.1, f64::NAN] {
            let offered = PathPrior {
                robot_bias_ratio: bad,
                ..prior(Vec::new())
            };
            assert_eq!(Prior::new(Some(&offered)), Prior::default());
        }
    }

    #[test]
    fn both_words_count_and_a_contradicted_map_does_not() {
        let fused = |measured, prior| ThetaSources { measured, prior }.fused();
        let measured = knowledge(0.21, 0.02);
        let both = fused(Some(measured), Some(knowledge(0.19, 0.02))).unwrap();
        assert!((both.theta - 0.2).abs() < 1e-9 && both.std_dev < 0.02);
        assert_eq!(fused(None, Some(measured)), Some(measured));
        assert_eq!(fused(Some(measured), None), Some(measured));
        let wrong = knowledge(1.4, 0.05);
        assert_eq!(fused(Some(measured), Some(wrong)), Some(measured));
    }
}
