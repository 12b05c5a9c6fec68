//! The prior of the ground along the path of a mission, which its robot gets with the offer.

use std::collections::{BTreeMap, BTreeSet};

use tread_api::friction::FusedFriction;
use tread_api::geometry::Point;
use tread_api::ids::{RobotId, SiteId};
use tread_api::site::{Cell, Grid};
use tread_api::trajectory::{Trajectory, Waypoint};
use tread_api::wire::command::{CellPrior, CellTractionLimit, PRIOR_CELLS_MAX, PathPrior};

use super::map_reader::in_parts;
use super::path::{
    CellReader, Cut, PLACES_AT_ONCE, checked_length, cut, drawn_near, is_measured,
    traction_limit_mu,
};
use super::present_terrains::PresentTerrains;
use super::{App, AppError, MapReader, Reading, ReadingParameters, SiteView};

/// Number of sides of the polygon by which a circle is approximated.
const CIRCLE_CORNERS: u32 = 256;
/// Number of cells to either side of a path whose measurements also count for the ground under it.
const NEAR_CELLS: i32 = 2;
/// Maximum number of cells near a path that are read; beyond it only the path's own cells count.
const NEAR_MAX: usize = 20_000;

impl App {
    /// Returns the prior of the ground along a trajectory, for the robot that drives it; `None`
    /// when nothing is known.
    ///
    /// Cells with several grounds get no θ, because the robot could not distinguish these. On the whole
    /// path, the traction limit of a ground is at most its lowest known value on or near the path:
    /// ground that is icy in one cell may also be icy in the next, which was not measured since.
    pub(in crate::app) async fn prior_along(
        &self,
        (site, robot): (&SiteId, &RobotId),
        trajectory: &Trajectory,
    ) -> Result<Option<PathPrior>, AppError> {
        let view = self.site_view(site).await?;
        let found = self.robot_of(view.row.pk, robot).await?;
        let Some(found) = found else { return Ok(None) };
        let parameters = ReadingParameters {
            configuration: Some(found.configuration),
            ..ReadingParameters::default()
        };
        let reading = Reading::new(self, &parameters)?;
        let points = corners(trajectory);
        // A path that is too long to be read gets no prior.
        let Ok(cut) = checked_length(&points).and_then(|_| cut(&points, &view.row.site.grid))
        else {
            return Ok(None);
        };
        let looking = move |reader: &MapReader<'_>| prior_of(reader, &view, &reading, &cut);
        self.with_map_reader_for_robot(looking).await
    }
}

/// What is known at a place along a path.
struct KnownPlace {
    /// Number of the ground at the centre of the cell.
    ground: u16,
    known: Option<FusedFriction>,
    /// Whether measurements in the cell are of one ground.
    has_one_ground: bool,
}

/// Returns the prior of the ground along a path.
fn prior_of(
    reader: &MapReader<'_>,
    view: &SiteView,
    reading: &Reading,
    cut: &[Cut],
) -> Result<Option<PathPrior>, AppError> {
    let drawn = PresentTerrains::new(&view.terrains);
    let places: Vec<Cut> = {
        let near = near(cut, &view.row.site.grid);
        cut.iter().copied().chain(near).collect()
    };
    let around = drawn_near(&drawn, &places);
    let known: Vec<KnownPlace> = in_parts(&places, PLACES_AT_ONCE, |some| {
        reader.cells(&view.row, |map| {
            let mut cells = CellReader::new(map, (view, &drawn, &around), reading);
            let known = some.iter().map(|place| KnownPlace {
                ground: around.ground_at(place.middle),
                known: cells.known_at(place),
                has_one_ground: map.cell(place.cell, reading.choice()).len() == 1,
            });
            known.collect()
        })
    })?;
    let mut grounds: BTreeMap<u16, f64> = BTreeMap::new();
    for place in &known {
        if let Some(measured) = place.known.as_ref().filter(|known| is_measured(known)) {
            let mu = traction_limit_mu(Some(measured));
            let least = grounds.entry(place.ground).or_insert(mu);
            *least = least.min(mu);
        }
    }
    let mut traction_limits: BTreeMap<(i32, i32), CellTractionLimit> = BTreeMap::new();
    for (cut, place) in cut.iter().zip(&known) {
        let cell = cut.cell;
        let least_mu = grounds.get(&place.ground).copied().unwrap_or(f64::INFINITY);
        let mu = traction_limit_mu(place.known.as_ref()).min(least_mu);
        let limit = traction_limits
            .entry((cell.iy, cell.ix))
            .or_insert(CellTractionLimit { cell, mu });
        limit.mu = limit.mu.min(mu);
    }
    // The smoothed path may leave the straight line between corners, so the cells beside it are
    // included.
    let mut cells: BTreeMap<(i32, i32), CellPrior> = BTreeMap::new();
    for (Cut { cell, .. }, place) in places.iter().zip(&known) {
        let key = (cell.iy, cell.ix);
        if cells.len() >= PRIOR_CELLS_MAX || cells.contains_key(&key) {
            continue;
        }
        let measured = place.known.as_ref().filter(|known| is_measured(known));
        if let Some(known) = measured.filter(|_| place.has_one_ground) {
            let prior = CellPrior {
                cell: *cell,
                theta: known.theta,
                std_dev: known.std_dev,
            };
            cells.insert(key, prior);
        }
    }
    let traction_limit_least_mu = traction_limits.values().map(|limit| limit.mu);
    let traction_limit_least_mu = traction_limit_least_mu.fold(f64::INFINITY, f64::min);
    let traction_limits: Vec<CellTractionLimit> = traction_limits
        .into_values()
        .take(PRIOR_CELLS_MAX)
        .collect();
    let cells: Vec<CellPrior> = cells.into_values().collect();
    let prior = PathPrior {
        grid_revision: view.row.site.grid.revision,
        traction_limit_mu: traction_limit_least_mu,
        robot_bias_ratio: reader.app().friction_config().robot_bias_ratio,
        cells,
        traction_limits,
    };
    Ok(Some(prior).filter(|prior| !prior.cells.is_empty() && prior.is_possible()))
}

/// Returns points along a trajectory, dense enough to determine its cells.
fn corners(trajectory: &Trajectory) -> Vec<Point> {
    match trajectory {
        Trajectory::Circle(circle) => (0..=CIRCLE_CORNERS)
            .map(|number| {
                let share = f64::from(number) / f64::from(CIRCLE_CORNERS);
                let angle = std::f64::consts::TAU * share;
                Point {
                    x_m: circle.center.x_m + circle.radius_m * angle.cos(),
                    y_m: circle.center.y_m + circle.radius_m * angle.sin(),
                }
            })
            .collect(),
        Trajectory::Waypoints(waypoints) => {
            waypoints.points.iter().map(Waypoint::position).collect()
        }
    }
}

/// Returns the centres of the cells near a path, each once.
fn near(cut: &[Cut], grid: &Grid) -> Vec<Cut> {
    let around = |index: i32| index.saturating_sub(NEAR_CELLS)..=index.saturating_add(NEAR_CELLS);
    let mut cells: BTreeSet<(i32, i32)> = BTreeSet::new();
    for cut in cut {
        for iy in around(cut.cell.iy) {
            cells.extend(around(cut.cell.ix).map(|ix| (iy, ix)));
        }
        if cells.len() > NEAR_MAX {
            // For a path this long its own cells suffice.
            return Vec::new();
        }
    }
    let place = |(iy, ix)| Cut {
        from_m: 0.0,
        length_m: 0.0,
        cell: Cell { ix, iy },
        middle: grid.center_of(Cell { ix, iy }),
        curvature_1_m: 0.0,
    };
    cells.into_iter().map(place).collect()
}
