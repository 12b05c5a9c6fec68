//! Approach of a robot to a circle or a waypoint path: the quickest of many smooth legs.

use std::f64::consts::{FRAC_PI_2, TAU};

use super::leg_time::{LegTime, TargetCircle};
use super::polynomial::{Derivatives, Ends};
use super::{Path, Piece, Polynomial};
use crate::geometry::{Point, Pose, wrap_angle_rad};
use crate::robot::RobotModel;

/// Distance to the circle below which a robot starts on it, metres.
const ON_CIRCLE_M: f64 = 0.05;
/// Heading difference to the path below which a robot need not turn on the spot, radians.
const ALIGNED_RAD: f64 = 0.1;
/// Number of join points on the circle that are tried.
const JOIN_POINTS: u32 = 36;
/// Minimum distance from the start to the end of a leg, metres.
const LEG_MIN_M: f64 = 0.2;
/// Parameter lengths of a leg that are tried, relative to its chord.
const STRETCHES: [f64; 5] = [1.0, 1.15, 1.35, 1.7, 2.4];
/// Distances straight behind the path's start of intermediate points that are tried, metres.
const RUN_INS_M: [f64; 3] = [0.5, 1.0, 2.0];
/// Start headings that are tried, radians relative to the bearing of the leg's end.
const TURNS_RAD: [f64; 5] = [-1.0, -0.5, 0.0, 0.5, 1.0];
/// Parameter speeds at a leg's start that are tried, relative to that at its end. A low one puts
/// the bend near the start, where the robot is still slow.
const START_PACES: [f64; 2] = [1.0, 0.4];
/// Turn rate assumed for turning on the spot, as a fraction of the limit.
const SPOT_TURN_SHARE: f64 = 0.4;

/// Circle to join.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CircleTarget {
    /// Centre in the site frame.
    pub(crate) center: Point,
    /// Radius, metres.
    pub(crate) radius_m: f64,
    /// +1 counter-clockwise, −1 clockwise.
    pub(crate) sign: f64,
    /// Speed along the circle, metres per second.
    pub(crate) speed_m_s: f64,
}

impl CircleTarget {
    fn heading_rad(&self, place_rad: f64) -> f64 {
        place_rad + self.sign * FRAC_PI_2
    }

    fn derivatives(&self, place_rad: f64) -> Derivatives {
        let (sin, cos) = place_rad.sin_cos();
        let forward = Point {
            x_m: -self.sign * sin,
            y_m: self.sign * cos,
        };
        let inward = Point {
            x_m: -cos,
            y_m: -sin,
        };
        let bend = self.radius_m.recip();
        let scaled = |point: Point, factor: f64| Point {
            x_m: point.x_m * factor,
            y_m: point.y_m * factor,
        };
        [
            Point {
                x_m: self.center.x_m + self.radius_m * cos,
                y_m: self.center.y_m + self.radius_m * sin,
            },
            forward,
            scaled(inward, bend),
            scaled(forward, -bend * bend),
            scaled(inward, -bend * bend * bend),
        ]
    }
}

/// Returns the quickest leg to the circle (empty if the robot is on it) and the polar angle of the
/// join in radians; None if no leg can be driven.
pub(crate) fn join_circle(
    target: &CircleTarget,
    start: Pose,
    model: &RobotModel,
) -> Option<(Vec<Polynomial>, f64)> {
    let nearest_rad = if target.center.distance_m(start.point()) > 1.0e-9 {
        target.center.bearing_rad(start.point())
    } else {
        start.heading_rad - target.sign * FRAC_PI_2
    };
    let off_m = (target.center.distance_m(start.point()) - target.radius_m).abs();
    let mut best: Option<(f64, Vec<Polynomial>, f64)> = None;
    if off_m < ON_CIRCLE_M {
        let time_s = spot_turn_s(start, target.heading_rad(nearest_rad), model);
        best = Some((time_s, Vec::new(), nearest_rad));
    }
    let timing = LegTime {
        speed_m_s: target.speed_m_s,
        model,
        circle: Some(TargetCircle {
            center: target.center,
            radius_m: target.radius_m,
        }),
    };
    // Start with the nearest point, in driving direction, so that a tight bound is found early.
    for place in 0..JOIN_POINTS {
        let place_rad = nearest_rad + target.sign * TAU * f64::from(place) / f64::from(JOIN_POINTS);
        let end = target.derivatives(place_rad);
        let bound_s = best.as_ref().map_or(f64::INFINITY, |(best_s, ..)| *best_s);
        // The remaining circle does not count: turns are counted from the join.
        if let Some((time_s, legs)) = join(start, &end, bound_s, &timing)
            && time_s < bound_s
        {
            best = Some((time_s, legs, place_rad));
        }
    }
    best.map(|(_, legs, place_rad)| (legs, place_rad))
}

/// Returns the quickest leg from a pose to the start of a path and its estimated time in seconds;
/// None if the start is too near, or every leg is too tight or slower than `bound_s`.
///
/// A leg is one curve, or two: one to a point straight behind the path's start and one from there.
/// One long curve into a tight bend would leave the direct line by far.
pub(crate) fn join(
    start: Pose,
    end: &Derivatives,
    bound_s: f64,
    timing: &LegTime<'_>,
) -> Option<(f64, Vec<Polynomial>)> {
    let mut best: Option<(f64, Vec<Polynomial>)> = None;
    if let Some((time_s, leg)) = curve(start, end, bound_s, timing) {
        best = Some((time_s, vec![leg]));
    }
    let pace = end[1].x_m.hypot(end[1].y_m);
    let forward = Point {
        x_m: end[1].x_m / pace,
        y_m: end[1].y_m / pace,
    };
    for run_in_m in RUN_INS_M {
        let behind = Point {
            x_m: end[0].x_m - run_in_m * forward.x_m,
            y_m: end[0].y_m - run_in_m * forward.y_m,
        };
        let still = Point::default();
        let bound_s = best.as_ref().map_or(bound_s, |(best_s, _)| *best_s);
        let last_start = Pose {
            x_m: behind.x_m,
            y_m: behind.y_m,
            heading_rad: forward.y_m.atan2(forward.x_m),
        };
        let shape = LegShape {
            length_m: run_in_m,
            start_pace: 1.0,
        };
        let Some(last) = leg(last_start, end, shape) else {
            continue;
        };
        let Some(last_s) = timing.leg_time_s(&last, false, bound_s) else {
            continue;
        };
        let entry = [behind, forward, still, still, still];
        let before = LegTime {
            // If any of the second curve is off the circle, all of the first one counts.
            circle: timing.circle.filter(|_| last_s <= 0.0),
            ..*timing
        };
        let Some((first_s, first)) = curve(start, &entry, bound_s - last_s, &before) else {
            continue;
        };
        let pieces = vec![first, last];
        if Path::new(pieces.iter().copied().map(Piece::Polynomial).collect()).is_ok() {
            best = Some((first_s + last_s, pieces));
        }
    }
    best
}

/// Returns the quickest single curve to a state and its estimated time in seconds, if it is below
/// `bound_s`.
fn curve(
    start: Pose,
    end: &Derivatives,
    mut bound_s: f64,
    timing: &LegTime<'_>,
) -> Option<(f64, Polynomial)> {
    let chord_m = start.point().distance_m(end[0]);
    if chord_m < LEG_MIN_M {
        return None;
    }
    let bearing_rad = start.point().bearing_rad(end[0]);
    let aimed = TURNS_RAD.map(|turn_rad| bearing_rad + turn_rad);
    let mut best: Option<(f64, Polynomial)> = None;
    for heading_rad in std::iter::once(start.heading_rad).chain(aimed) {
        let turn_s = spot_turn_s(start, heading_rad, timing.model);
        let least_m = timing.circle.map_or(chord_m, |circle| {
            circle.distance_m(start.point()).min(chord_m)
        });
        if turn_s + least_m / timing.speed_m_s > bound_s {
            continue;
        }
        let turned = Pose {
            heading_rad,
            ..start
        };
        let shapes = STRETCHES.into_iter().flat_map(|stretch| {
            START_PACES.map(|start_pace| LegShape {
                length_m: stretch * chord_m,
                start_pace,
            })
        });
        for shape in shapes {
            let timed = leg(turned, end, shape).and_then(|leg| {
                timing
                    .leg_time_s(&leg, true, bound_s - turn_s)
                    .map(|time_s| (time_s + turn_s, leg))
            });
            if let Some((time_s, leg)) = timed
                && Path::new(vec![Piece::Polynomial(leg)]).is_ok()
            {
                bound_s = time_s;
                best = Some((time_s, leg));
            }
        }
    }
    best
}

/// Returns the estimated time to turn on the spot, seconds; 0 below [`ALIGNED_RAD`].
fn spot_turn_s(start: Pose, heading_rad: f64, model: &RobotModel) -> f64 {
    let turn_rad = wrap_angle_rad(heading_rad - start.heading_rad).abs();
    if turn_rad > ALIGNED_RAD {
        0.7 + turn_rad / (SPOT_TURN_SHARE * model.limits().angular_max_rad_s)
    } else {
        0.0
    }
}

/// Shape of a leg.
#[derive(Debug, Clone, Copy)]
struct LegShape {
    /// Parameter length times the end's parameter speed, metres.
    length_m: f64,
    /// Parameter speed at the start, relative to that at the end.
    start_pace: f64,
}

/// Returns a leg of a shape, with zero second and higher derivatives at its start.
fn leg(start: Pose, end: &Derivatives, shape: LegShape) -> Option<Polynomial> {
    let (sin, cos) = start.heading_rad.sin_cos();
    let pace = end[1].x_m.hypot(end[1].y_m);
    let still = Point::default();
    let forward = Point {
        x_m: shape.start_pace * pace * cos,
        y_m: shape.start_pace * pace * sin,
    };
    let ends = Ends {
        start: [start.point(), forward, still, still, still],
        end: *end,
    };
    Polynomial::nonic(&ends, shape.length_m / pace)
}
