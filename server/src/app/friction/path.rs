//! Friction along a path, and the speeds that follow from it.
//!
//! A curve of curvature κ allows `v² ≤ lateral_acceleration/κ`. To stop at the end and to slow down
//! in time for each later segment, `v² ≤ v_next² + 2·longitudinal_acceleration·Δs`. Both
//! accelerations are the fractions of the segment's traction limit (a lower bound) that the robot's
//! own planner uses.

use std::collections::{BTreeMap, BTreeSet};

use tread_api::friction::{AskPath, FusedFriction, PathFriction, PathPiece};
use tread_api::geometry::Point;
use tread_api::ids::{RobotId, SiteId};
use tread_api::robot::RobotModel;
use tread_api::site::{Cell, Grid};
use tread_api::trajectory::{Trajectory, Waypoint};
use tread_api::wire::command::{CellPrior, CellTractionLimit, PRIOR_CELLS_MAX, PathPrior};
use tread_control::robot::RobotModel as PlannedModel;

use super::drawn::{Drawn, Near};
use super::{App, AppError, Asked, Look, Reading, SiteView};
use crate::friction::index::{Cells, CompiledFilter, Room};
use crate::friction::traction_limit;

/// Maximum length of a path, metres.
const LENGTH_MAX_M: f64 = 10_000.0;
/// Allowed number of points of a path.
const POINTS: std::ops::RangeInclusive<usize> = 2..=10_000;
/// Maximum number of path segments, however small the cells are.
const PIECES_MAX: usize = 100_000;
/// Number of sides of the polygon by which a circle is approximated.
const CIRCLE_CORNERS: u32 = 256;
/// Relative standard deviation of θ (σ/θ) above which a place counts as unmeasured; the same as the
/// estimator's.
const DEVIATION_RATIO_MAX: f64 = 0.5;
/// Number of cells to either side of a path whose measurements also count for the ground under it.
const NEAR_CELLS: i32 = 2;
/// Number of places along a path that are read in one look at the map.
const PLACES_AT_ONCE: usize = 1_024;
/// Maximum number of cells near a path that are read; beyond it only the path's own cells count.
const NEAR_MAX: usize = 20_000;

impl App {
    /// Returns the friction along a path, for a robot.
    ///
    /// # Errors
    /// Site or robot is not known, or the points do not form a path.
    pub async fn friction_along(
        &self,
        site: &SiteId,
        request: AskPath,
    ) -> Result<PathFriction, AppError> {
        let AskPath {
            points,
            robot,
            as_of,
            normalisation,
        } = request;
        let view = self.site_view(site).await?;
        let found = self.robot_of(view.row.pk, &robot).await?;
        let found = found.ok_or_else(|| AppError::UnknownRobot(site.clone(), robot.clone()))?;
        let asked = Asked {
            as_of,
            configuration: Some(found.configuration),
            normalisation,
        };
        let reading = Reading::new(self, &asked).map_err(in_body)?;
        let length_m = checked_length(&points)?;
        let cut = cut(&points, &view.row.site.grid)?;
        let row = view.row.clone();
        let looking = move |look: &Look<'_>, [reading]: &[Reading; 1]| {
            let drawn = Drawn::new(&view.terrains);
            let near = drawn_near(&drawn, &cut);
            let mut pieces: Vec<PathPiece> = Vec::with_capacity(cut.len());
            for some in cut.chunks(PLACES_AT_ONCE) {
                pieces.extend(look.cells(&view.row, |map| {
                    let mut reader = CellReader::new(map, (&view, &drawn, &near), reading);
                    let piece = |cut: &Cut| described(cut, reader.known_at(cut).as_ref());
                    some.iter().map(piece).collect::<Vec<_>>()
                })?);
            }
            set_speeds(&mut pieces, &cut, length_m, &found.model);
            let known_m: f64 = pieces
                .iter()
                .zip(&cut)
                .filter(|(piece, _)| piece.theta.is_some())
                .map(|(_, cut)| cut.length_m)
                .sum();
            Ok(PathFriction {
                as_of: reading.as_of,
                length_m,
                configuration: found.configuration,
                normalisation: reading.normalisation(),
                // The sum of nothing is −0.
                known_ratio: (known_m / length_m + 0.0).min(1.0),
                pieces,
            })
        };
        self.read_map(&row, [reading], looking).await
    }
}

impl App {
    /// Returns the prior of the ground along a trajectory, for the robot that drives it; `None`
    /// when nothing is known.
    ///
    /// No θ is given for cells with several grounds, which the robot could not distinguish. The
    /// traction limit of a ground is nowhere above its lowest known value on or near the path:
    /// ground that is frozen in one cell may be frozen in the next, where nobody has measured
    /// since.
    pub(in crate::app) async fn prior_along(
        &self,
        (site, robot): (&SiteId, &RobotId),
        trajectory: &Trajectory,
    ) -> Result<Option<PathPrior>, AppError> {
        let view = self.site_view(site).await?;
        let found = self.robot_of(view.row.pk, robot).await?;
        let Some(found) = found else { return Ok(None) };
        let asked = Asked {
            configuration: Some(found.configuration),
            ..Asked::default()
        };
        let reading = Reading::new(self, &asked)?;
        let points = corners(trajectory);
        // A path that is too long to be read gets no prior.
        let Ok(cut) = checked_length(&points).and_then(|_| cut(&points, &view.row.site.grid))
        else {
            return Ok(None);
        };
        let looking = move |look: &Look<'_>| prior_of(look, &view, &reading, &cut);
        self.look_for_robot(looking).await
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
    look: &Look<'_>,
    view: &SiteView,
    reading: &Reading,
    cut: &[Cut],
) -> Result<Option<PathPrior>, AppError> {
    let drawn = Drawn::new(&view.terrains);
    let places: Vec<Cut> = {
        let near = near(cut, &view.row.site.grid);
        cut.iter().copied().chain(near).collect()
    };
    let around = drawn_near(&drawn, &places);
    let mut known: Vec<KnownPlace> = Vec::with_capacity(places.len());
    for some in places.chunks(PLACES_AT_ONCE) {
        known.extend(look.cells(&view.row, |map| {
            let mut reader = CellReader::new(map, (view, &drawn, &around), reading);
            let known = some.iter().map(|place| KnownPlace {
                ground: around.ground_at(place.middle),
                known: reader.known_at(place),
                has_one_ground: map.cell(place.cell, reading.choice()).len() == 1,
            });
            known.collect::<Vec<_>>()
        })?);
    }
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
        robot_bias_ratio: look.app().friction_config().robot_bias_ratio,
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

/// Returns whether θ is known well enough to derive a traction limit from it; the upper bound of a
/// poorly known θ would make the robot needlessly slow.
fn is_measured(known: &FusedFriction) -> bool {
    known.std_dev <= DEVIATION_RATIO_MAX * known.theta
}

/// Returns the friction coefficient that a plan may use.
pub(in crate::app) fn traction_limit_mu(known: Option<&FusedFriction>) -> f64 {
    traction_limit::traction_limit_mu(
        known.and_then(|known| known.mu_peak_lower_bound),
        known
            .filter(|known| is_measured(known))
            .map(|known| known.bounds.theta_upper_95),
    )
}

fn in_body(error: AppError) -> AppError {
    if let AppError::InvalidQuery { parameter, detail } = error {
        let field = parameter;
        AppError::Invalid { field, detail }
    } else {
        error
    }
}

fn invalid(detail: String) -> AppError {
    AppError::Invalid {
        field: "points",
        detail,
    }
}

fn checked_length(points: &[Point]) -> Result<f64, AppError> {
    if !POINTS.contains(&points.len()) {
        return Err(invalid(format!(
            "a path has {} to {} points, not {}",
            POINTS.start(),
            POINTS.end(),
            points.len()
        )));
    }
    if let Some(index) = points.iter().position(|point| !point.is_on_the_map()) {
        return Err(invalid(format!("point {index} is not on the map")));
    }
    let length_m: f64 = points
        .windows(2)
        .map(|pair| pair[0].distance_m(pair[1]))
        .sum();
    if length_m > LENGTH_MAX_M {
        let detail = format!("a path is at most {LENGTH_MAX_M} m long, not {length_m:.0}");
        return Err(invalid(detail));
    }
    if length_m <= 0.0 {
        return Err(invalid("the path has no length".to_owned()));
    }
    Ok(length_m)
}

/// Section of a straight side of the path within one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::app) struct Cut {
    pub(in crate::app) from_m: f64,
    pub(in crate::app) length_m: f64,
    pub(in crate::app) cell: Cell,
    pub(in crate::app) middle: Point,
    /// Curvature at its begin, per metre; nonzero only where the begin is a corner of the path.
    curvature_1_m: f64,
}

/// Splits a path at the borders of cells.
fn cut(points: &[Point], grid: &Grid) -> Result<Vec<Cut>, AppError> {
    let mut pieces: Vec<Cut> = Vec::new();
    let mut from_m = 0.0;
    for (index, pair) in points.windows(2).enumerate() {
        let (begin, end) = (pair[0], pair[1]);
        let side_m = begin.distance_m(end);
        if side_m <= 0.0 {
            continue;
        }
        let curvature_1_m = match index {
            0 => 0.0,
            _ => curvature(points[index - 1], begin, end),
        };
        let at = |share: f64| Point {
            x_m: begin.x_m + share * (end.x_m - begin.x_m),
            y_m: begin.y_m + share * (end.y_m - begin.y_m),
        };
        let mut shares = crossings((begin.x_m, end.x_m), grid.cell_m);
        shares.extend(crossings((begin.y_m, end.y_m), grid.cell_m));
        shares.extend([0.0, 1.0]);
        shares.sort_unstable_by(f64::total_cmp);
        for (place, pair) in shares.windows(2).enumerate() {
            let length_m = (pair[1] - pair[0]) * side_m;
            if length_m <= 1.0e-9 && place > 0 {
                continue;
            }
            let middle = at(f64::midpoint(pair[0], pair[1]));
            let off = || invalid("the path leaves the map".to_owned());
            pieces.push(Cut {
                from_m: from_m + pair[0] * side_m,
                length_m,
                cell: grid.cell_at(middle).ok_or_else(off)?,
                middle,
                curvature_1_m: if place == 0 { curvature_1_m } else { 0.0 },
            });
            if pieces.len() > PIECES_MAX {
                let detail = format!("the path passes through more than {PIECES_MAX} cells");
                return Err(invalid(detail));
            }
        }
        from_m += side_m;
    }
    Ok(pieces)
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

/// Returns the fractions of a side (0 to 1) at which one coordinate crosses a border between cells.
fn crossings((from_m, to_m): (f64, f64), cell_m: f64) -> Vec<f64> {
    let (low, high) = (from_m.min(to_m) / cell_m, from_m.max(to_m) / cell_m);
    let mut border = low.floor() + 1.0;
    let mut shares = Vec::new();
    while border < high {
        shares.push((border * cell_m - from_m) / (to_m - from_m));
        border += 1.0;
    }
    shares
}

/// Returns the curvature of the circle through three points, per metre; infinite for a reversal.
fn curvature(a: Point, b: Point, c: Point) -> f64 {
    let (ab, bc, ca) = (a.distance_m(b), b.distance_m(c), c.distance_m(a));
    let doubled_area =
        ((b.x_m - a.x_m) * (c.y_m - a.y_m) - (b.y_m - a.y_m) * (c.x_m - a.x_m)).abs();
    let product = ab * bc * ca;
    let onward = (b.x_m - a.x_m) * (c.x_m - b.x_m) + (b.y_m - a.y_m) * (c.y_m - b.y_m);
    if product <= 0.0 || (onward < 0.0 && doubled_area <= 1.0e-12) {
        if ab > 0.0 && bc > 0.0 {
            f64::INFINITY
        } else {
            0.0
        }
    } else {
        2.0 * doubled_area / product
    }
}

/// Returns the terrains whose bounding boxes touch that of the places.
fn drawn_near<'view, 'cut>(
    drawn: &Drawn<'view>,
    places: impl IntoIterator<Item = &'cut Cut>,
) -> Near<'view> {
    let (mut low, mut high) = (
        Point {
            x_m: f64::INFINITY,
            y_m: f64::INFINITY,
        },
        Point {
            x_m: f64::NEG_INFINITY,
            y_m: f64::NEG_INFINITY,
        },
    );
    for Cut { middle, .. } in places {
        (low.x_m, low.y_m) = (low.x_m.min(middle.x_m), low.y_m.min(middle.y_m));
        (high.x_m, high.y_m) = (high.x_m.max(middle.x_m), high.y_m.max(middle.y_m));
    }
    drawn.near(low, high)
}

/// Reads the map at one place after another.
struct CellReader<'map> {
    map: Cells<'map>,
    near: &'map Near<'map>,
    filter: CompiledFilter<'map>,
    reading: &'map Reading,
    room: Room,
}

impl<'map> CellReader<'map> {
    fn new(
        map: Cells<'map>,
        (view, drawn, near): (&'map SiteView, &Drawn<'_>, &'map Near<'map>),
        reading: &'map Reading,
    ) -> Self {
        let filter = map
            .map()
            .filter(reading.choice(), |found| drawn.ground_of(view, found));
        Self {
            map,
            near,
            filter,
            reading,
            room: Room::default(),
        }
    }

    /// Returns the friction of the ground that is drawn at the centre of a cell.
    fn known_at(&mut self, place: &Cut) -> Option<FusedFriction> {
        let ground = self.near.ground_at(place.middle);
        let (which, at) = ((ground, &self.filter), self.reading.fused_at());
        let fused = self.map.fuse_cell(place.cell, which, at, &mut self.room);
        fused.map(|fused| fused.to_api(self.reading.now_us))
    }
}

fn described(cut: &Cut, known: Option<&FusedFriction>) -> PathPiece {
    PathPiece {
        from_m: cut.from_m,
        cell: cut.cell,
        theta: known.map(|known| known.theta),
        std_dev: known.map(|known| known.std_dev),
        theta_upper_95: known.map(|known| known.bounds.theta_upper_95),
        age_s: known.map(|known| known.age_s),
        disputed: known.is_some_and(|known| known.disputed),
        traction_limit_mu: traction_limit_mu(known),
        speed_m_s: 0.0,
    }
}

/// Sets the speeds backwards from the end, where the robot stops.
fn set_speeds(pieces: &mut [PathPiece], cut: &[Cut], length_m: f64, model: &RobotModel) {
    let limits = model.limits;
    let mut next_m_s = 0.0_f64;
    let mut next_at_m = length_m;
    for (piece, cut) in pieces.iter_mut().zip(cut).rev() {
        let longitudinal = PlannedModel::longitudinal_traction_m_s2(piece.traction_limit_mu);
        let longitudinal = longitudinal.min(limits.linear_acceleration_max_m_s2);
        let lateral = PlannedModel::lateral_traction_m_s2(piece.traction_limit_mu);
        let lateral = lateral.min(limits.lateral_acceleration_max_m_s2);
        let braked = (next_m_s * next_m_s + 2.0 * longitudinal * (next_at_m - cut.from_m)).sqrt();
        let curve = if cut.curvature_1_m > 0.0 {
            let turn = limits.angular_max_rad_s / cut.curvature_1_m;
            (lateral / cut.curvature_1_m).sqrt().min(turn)
        } else {
            f64::INFINITY
        };
        piece.speed_m_s = braked.min(curve).min(limits.linear_max_m_s);
        (next_m_s, next_at_m) = (piece.speed_m_s, cut.from_m);
    }
}

#[cfg(test)]
mod tests;
