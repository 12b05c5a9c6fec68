//! Path through waypoints from the robot's pose: the quickest of several splines.

use super::join::join;
use super::leg_time::{LegTime, piece_time_s};
use super::spline::{Knot, min_jerk_spline};
use super::{Path, PathError, Piece, Polynomial};
use crate::geometry::{Pose, wrap_angle_rad};
use crate::robot::RobotModel;

/// Distance to the first waypoint below which the robot may skip it if no smooth path leads through
/// it, metres.
const BESIDE_START_M: f64 = 0.25;
/// Difference between the path's start heading and the robot's below which the path may start along
/// the latter, radians.
const HEADING_KEPT_RAD: f64 = 0.6;
/// Turn angles above which a waypoint's heading is fixed half-way through the turn, radians; tried
/// in this order. The path is C³ where the heading is fixed, else C⁴.
const HALFWAY_FROM_RAD: [f64; 4] = [2.6, 1.7, 0.8, 0.0];
/// Maximum number of knots for which every angle of [`HALFWAY_FROM_RAD`] is tried.
const ALL_SPLINES_MAX: usize = 500;
/// Exponents α of the spline's parameter `chord^α` that are tried.
const SPLINE_EXPONENTS: [f64; 3] = [1.0, 0.75, 0.5];

/// Returns a path of a smooth leg to the first knot and a spline from there, and the number of the
/// leg's pieces; None if there is no such path.
pub(crate) fn leg_and_spline(
    knots: &[Knot],
    start: Pose,
    speed_m_s: f64,
    model: &RobotModel,
) -> Option<(Path, usize)> {
    let (spline, _) = best_spline(knots, speed_m_s, model).ok()?;
    let begin = spline.first()?;
    let derivatives = [0, 1, 2, 3, 4].map(|order| begin.derivative(order, 0.0));
    let timing = LegTime {
        speed_m_s,
        model,
        circle: None,
    };
    let (_, legs) = join(start, &derivatives, f64::INFINITY, &timing)?;
    let count = legs.len();
    let pieces = legs
        .into_iter()
        .chain(spline)
        .map(Piece::Polynomial)
        .collect();
    Path::new(pieces).ok().map(|path| (path, count))
}

/// Returns a spline from the first knot, which is the robot's position. It starts along the robot's
/// heading where that is near and not much slower.
///
/// # Errors
/// [`PathError::TooTight`] if no spline can be driven.
pub(crate) fn spline_from_robot(
    knots: &mut [Knot],
    start: Pose,
    speed_m_s: f64,
    model: &RobotModel,
) -> Result<Path, PathError> {
    let path_of = |(pieces, time_s): (Vec<Polynomial>, f64)| {
        Path::new(pieces.into_iter().map(Piece::Polynomial).collect()).map(|path| (path, time_s))
    };
    let free = best_spline(knots, speed_m_s, model).and_then(path_of);
    if knots[0].heading_rad.is_some() {
        return free.map(|(path, _)| path);
    }
    knots[0].heading_rad = Some(start.heading_rad);
    let kept = best_spline(knots, speed_m_s, model).and_then(path_of);
    match (free, kept) {
        (Ok((free, free_s)), Ok((kept, kept_s))) => {
            let leaves_rad = free.sample(0.0).pose.heading_rad;
            let turn_rad = wrap_angle_rad(leaves_rad - start.heading_rad).abs();
            let near = turn_rad < HEADING_KEPT_RAD && kept_s < free_s + 1.0 + turn_rad;
            Ok(if near { kept } else { free })
        }
        (Ok((path, _)), Err(_)) | (Err(_), Ok((path, _))) => Ok(path),
        (Err(error), Err(_)) => {
            // Near the first waypoint without a smooth path through it: the waypoint counts as
            // reached.
            if knots.len() < 3 || knots[0].point.distance_m(knots[1].point) > BESIDE_START_M {
                return Err(error);
            }
            let mut onward = knots.to_vec();
            onward.remove(1);
            onward[0].heading_rad = None;
            best_spline(&onward, speed_m_s, model)
                .and_then(path_of)
                .map(|(path, _)| path)
        }
    }
}

/// Returns the quickest spline through the knots over several parametrisations, and its estimated
/// time in seconds.
fn best_spline(
    knots: &[Knot],
    speed_m_s: f64,
    model: &RobotModel,
) -> Result<(Vec<Polynomial>, f64), PathError> {
    let mut best: Option<(Vec<Polynomial>, f64)> = None;
    let mut refused = None;
    for turn_rad in HALFWAY_FROM_RAD {
        // Long paths use the first drivable angle, short ones the quickest of all.
        if best.is_some() && knots.len() > ALL_SPLINES_MAX {
            break;
        }
        let knots = with_halfway_headings(knots, turn_rad);
        for exponent in SPLINE_EXPONENTS {
            let pieces = min_jerk_spline(&knots, exponent);
            let mut time_s = 0.0;
            let tight = pieces.iter().position(|piece| {
                let needed_s = piece_time_s(piece, speed_m_s, model);
                time_s += needed_s.unwrap_or_default();
                needed_s.is_none()
            });
            if let Some(piece) = tight {
                refused = refused.or(Some(PathError::TooTight { piece }));
            } else if best.as_ref().is_none_or(|(_, best_s)| time_s < *best_s) {
                best = Some((pieces, time_s));
            }
        }
    }
    best.ok_or(refused.unwrap_or(PathError::TooTight { piece: 0 }))
}

/// Fixes the heading of knots at which the path turns by more than `from_rad` to half-way through
/// the turn, so that the path swings through them without a cusp.
fn with_halfway_headings(knots: &[Knot], from_rad: f64) -> Vec<Knot> {
    let mut turned = knots.to_vec();
    for index in 1..knots.len().saturating_sub(1) {
        let come_rad = knots[index - 1].point.bearing_rad(knots[index].point);
        let leave_rad = knots[index].point.bearing_rad(knots[index + 1].point);
        let turn_rad = wrap_angle_rad(leave_rad - come_rad);
        if knots[index].heading_rad.is_none() && turn_rad.abs() > from_rad {
            turned[index].heading_rad = Some(come_rad + 0.5 * turn_rad);
        }
    }
    turned
}
