//! Friction along a path, and the speeds that follow from it.
//!
//! A curve of curvature κ allows `v² ≤ lateral_acceleration/κ`. To stop at the end and to slow down
//! in time for each later segment, `v² ≤ v_next² + 2·longitudinal_acceleration·Δs`. Both
//! accelerations are the fractions of the segment's traction limit (a lower bound) that the robot's
//! own planner uses.

use tread_api::friction::{FusedFriction, PathFriction, PathFrictionRequest, PathPiece};
use tread_api::geometry::Point;
use tread_api::ids::SiteId;
use tread_api::robot::RobotModel;
use tread_api::site::{Cell, Grid};
use tread_control::robot::RobotModel as PlannedModel;

use super::area::Area;
use super::map_reader::in_parts;
use super::present_terrains::{NearbyTerrains, PresentTerrains};
use super::{App, AppError, MapReader, Reading, ReadingParameters, SiteView};
use crate::friction::index::{Cells, CompiledFilter, FusionBuffers};
use crate::friction::traction_limit::{self, TractionEstimate};

/// Maximum length of a path, metres.
const LENGTH_MAX_M: f64 = 10_000.0;
/// Allowed number of points of a path.
const POINTS: std::ops::RangeInclusive<usize> = 2..=10_000;
/// Maximum number of path segments, however small the cells are.
const PIECES_MAX: usize = 100_000;
/// Relative standard deviation of θ (σ/θ) above which a place counts as unmeasured; the same as the
/// estimator's.
const DEVIATION_RATIO_MAX: f64 = 0.5;
/// Number of places along a path that are read in one read of the map.
pub(super) const PLACES_AT_ONCE: usize = 1_024;

impl App {
    /// Returns the friction along a path, for a robot.
    ///
    /// # Errors
    /// Site or robot is not known, or the points do not form a path.
    pub async fn friction_along(
        &self,
        site: &SiteId,
        request: PathFrictionRequest,
    ) -> Result<PathFriction, AppError> {
        let PathFrictionRequest {
            points,
            robot,
            as_of,
            normalisation,
        } = request;
        let view = self.site_view(site).await?;
        let found = self.robot_of(view.row.pk, &robot).await?;
        let found = found.ok_or_else(|| AppError::UnknownRobot(site.clone(), robot.clone()))?;
        let parameters = ReadingParameters {
            as_of,
            configuration: Some(found.configuration),
            normalisation,
        };
        let reading = Reading::new(self, &parameters).map_err(in_body)?;
        let length_m = checked_length(&points)?;
        let cut = cut(&points, &view.row.site.grid)?;
        let row = view.row.clone();
        let looking = move |reader: &MapReader<'_>, [reading]: &[Reading; 1]| {
            let drawn = PresentTerrains::new(&view.terrains);
            let near = drawn_near(&drawn, &cut);
            let mut pieces: Vec<PathPiece> = in_parts(&cut, PLACES_AT_ONCE, |some| {
                reader.cells(&view.row, |map| {
                    let mut cells = CellReader::new(map, (&view, &drawn, &near), reading);
                    let piece = |cut: &Cut| described(cut, cells.known_at(cut).as_ref());
                    some.iter().map(piece).collect()
                })
            })?;
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

/// Returns whether θ is known well enough to derive a traction limit from it; the upper bound of a
/// poorly known θ would make the robot needlessly slow.
pub(super) fn is_measured(known: &FusedFriction) -> bool {
    known.std_dev <= DEVIATION_RATIO_MAX * known.theta
}

/// Returns the friction coefficient that a plan may use.
pub(in crate::app) fn traction_limit_mu(known: Option<&FusedFriction>) -> f64 {
    traction_limit::traction_limit_mu(TractionEstimate {
        mu_peak: known.and_then(|known| known.mu_peak_lower_bound),
        theta_upper_95: known
            .filter(|known| is_measured(known))
            .map(|known| known.bounds.theta_upper_95),
    })
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

pub(super) fn checked_length(points: &[Point]) -> Result<f64, AppError> {
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
    pub(super) curvature_1_m: f64,
}

/// Splits a path at the borders of cells.
pub(super) fn cut(points: &[Point], grid: &Grid) -> Result<Vec<Cut>, AppError> {
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
            _ => curvature(points, index),
        };
        let at = |share: f64| Point {
            x_m: begin.x_m + share * (end.x_m - begin.x_m),
            y_m: begin.y_m + share * (end.y_m - begin.y_m),
        };
        let mut shares = crossings(pair, |point| point.x_m, grid.cell_m);
        shares.extend(crossings(pair, |point| point.y_m, grid.cell_m));
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

/// Returns the fractions of a side (0 to 1) at which one coordinate crosses a border between cells.
fn crossings(side: &[Point], coordinate_m: fn(&Point) -> f64, cell_m: f64) -> Vec<f64> {
    let (from_m, to_m) = (coordinate_m(&side[0]), coordinate_m(&side[1]));
    let (low, high) = (from_m.min(to_m) / cell_m, from_m.max(to_m) / cell_m);
    let mut border = low.floor() + 1.0;
    let mut shares = Vec::new();
    while border < high {
        shares.push((border * cell_m - from_m) / (to_m - from_m));
        border += 1.0;
    }
    shares
}

/// Returns the curvature of the circle through a corner and the points beside it, per metre; infinite
/// for a reversal.
fn curvature(points: &[Point], corner: usize) -> f64 {
    let (a, b, c) = (points[corner - 1], points[corner], points[corner + 1]);
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
pub(super) fn drawn_near<'view, 'cut>(
    drawn: &PresentTerrains<'view>,
    places: impl IntoIterator<Item = &'cut Cut>,
) -> NearbyTerrains<'view> {
    drawn.near(Area::around(places.into_iter().map(|cut| cut.middle)))
}

/// Reads the map at one place after another.
pub(super) struct CellReader<'map> {
    map: Cells<'map>,
    near: &'map NearbyTerrains<'map>,
    filter: CompiledFilter<'map>,
    reading: &'map Reading,
    room: FusionBuffers,
}

impl<'map> CellReader<'map> {
    pub(super) fn new(
        map: Cells<'map>,
        (view, drawn, near): (
            &'map SiteView,
            &PresentTerrains<'_>,
            &'map NearbyTerrains<'map>,
        ),
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
            room: FusionBuffers::default(),
        }
    }

    /// Returns the friction of the ground that is drawn at the centre of a cell.
    pub(super) fn known_at(&mut self, place: &Cut) -> Option<FusedFriction> {
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
