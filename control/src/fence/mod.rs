//! Where a robot may be: the pure geometry of fences, and the speed that keeps it inside.
//!
//! The robot is a disc around its centre. *Clearance* is how far a point is inside the allowed
//! ground: into one of the `keep_in` polygons (the deepest, if there are several) and away from
//! every `keep_out` polygon. It changes by no more than the distance between two points, so a path
//! can be walked in steps as long as the clearance of the last one: a few looks answer exactly how
//! far the robot may go along its arc, whatever the fence looks like.
//!
//! [`speed`] caps the speed so that it still stops within that distance. Nothing here allocates after
//! [`Fence::new`].

mod ring;
mod speed;

use crate::geometry::Point;
use crate::plan::Plan;
use crate::robot::RobotModel;
use ring::Ring;
pub use speed::{
    Braking, FenceInput, FenceVerdict, MARGIN_STD_DEVS, MU_UNKNOWN, REACTION_S, RETURN_MAX_M_S,
};

/// Distance kept from a fence beyond the robot's own radius, metres.
pub const MARGIN_M: f64 = 0.10;
/// Shortest step along a planned path, metres.
const BREACH_STEP_M: f64 = 0.02;

/// Polygons within which, and out of which, a robot must keep.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Fence {
    keep_in: Vec<Ring>,
    keep_out: Vec<Ring>,
}

/// Where something leaves the allowed ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Breach {
    /// Distance from the start to there, metres.
    pub arc_m: f64,
    /// The centre of the robot there.
    pub point: Point,
    /// How far the robot's disc is outside there, metres.
    pub depth_m: f64,
}

/// A polygon of a fence, by its place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FencePolygon {
    /// One within which a robot must keep.
    KeepIn(usize),
    /// One out of which a robot must keep.
    KeepOut(usize),
}

/// Where a disc is on ground that is not allowed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Overlap {
    /// The polygon that forbids it: of several `keep_in` ones the one that is left the least.
    pub polygon: FencePolygon,
    /// The point of its border that is nearest to the disc's centre.
    pub border: Point,
    /// How far the disc is on the wrong side of it, metres.
    pub depth_m: f64,
}

/// Radius of the disc that stands for a robot, without margin, metres.
pub fn disc_radius_m(model: &RobotModel) -> f64 {
    // The body ends about a wheel's radius beyond the axles.
    0.5 * model
        .track_width_m()
        .hypot(model.wheelbase_m() + 2.0 * model.wheel_radius_m())
}

impl Fence {
    /// A fence of polygons, each its corners in order.
    pub fn new(keep_in: Vec<Vec<Point>>, keep_out: Vec<Vec<Point>>) -> Self {
        let rings =
            |polygons: Vec<Vec<Point>>| polygons.iter().map(|corners| Ring::new(corners)).collect();
        Self {
            keep_in: rings(keep_in),
            keep_out: rings(keep_out),
        }
    }

    /// A fence within which there is no room at all, for one that cannot be used.
    pub fn without_room() -> Self {
        Self {
            keep_in: vec![Ring::new(&[])],
            keep_out: Vec::new(),
        }
    }

    /// Whether it bounds nothing.
    pub fn is_empty(&self) -> bool {
        self.keep_in.is_empty() && self.keep_out.is_empty()
    }

    /// How far a point is inside the allowed ground, metres; negative outside. Infinite without
    /// any polygon.
    pub fn clearance_m(&self, point: Point) -> f64 {
        if !point.is_finite() {
            return f64::NEG_INFINITY;
        }
        let depths = self.keep_in.iter().map(|ring| ring.depth_m(point));
        let inside_m = if self.keep_in.is_empty() {
            f64::INFINITY
        } else {
            depths.fold(f64::NEG_INFINITY, f64::max)
        };
        let mut clearance_m = inside_m;
        for ring in &self.keep_out {
            // One that is farther than the nearest so far need not be looked at.
            if ring.outside_at_least_m(point) < clearance_m {
                clearance_m = clearance_m.min(-ring.depth_m(point));
            }
        }
        clearance_m
    }

    /// The polygon that a disc overlaps the most without being allowed to; none if it may be there.
    pub fn overlap(&self, center: Point, radius_m: f64) -> Option<Overlap> {
        let of = |polygon: FencePolygon, ring: &Ring, depth_m: f64| Overlap {
            polygon,
            border: ring.border_near(center),
            depth_m,
        };
        let inside = self.keep_in.iter().enumerate().map(|(index, ring)| {
            let depth_m = radius_m - ring.depth_m(center);
            of(FencePolygon::KeepIn(index), ring, depth_m)
        });
        let inside = inside.min_by(|one, other| one.depth_m.total_cmp(&other.depth_m));
        let outside = self.keep_out.iter().enumerate().map(|(index, ring)| {
            let depth_m = radius_m + ring.depth_m(center);
            of(FencePolygon::KeepOut(index), ring, depth_m)
        });
        inside
            .into_iter()
            .chain(outside)
            // Not a number is no permission.
            .filter(|overlap| overlap.depth_m > 0.0 || overlap.depth_m.is_nan())
            .max_by(|one, other| one.depth_m.total_cmp(&other.depth_m))
    }

    /// The first place at which a robot that drives a plan, with the margin that it keeps anyway,
    /// would leave the allowed ground.
    pub fn plan_breach(&self, plan: &Plan, model: &RobotModel) -> Option<Breach> {
        let radius_m = disc_radius_m(model) + MARGIN_M;
        let point_at = |arc_m: f64| plan.path().sample(arc_m).pose.point();
        self.first_breach(point_at, plan.length_m(), radius_m)
    }

    /// The first place along a path at which a disc leaves the allowed ground.
    pub fn first_breach(
        &self,
        point_at: impl Fn(f64) -> Point,
        length_m: f64,
        radius_m: f64,
    ) -> Option<Breach> {
        if self.is_empty() {
            return None;
        }
        let mut arc_m = 0.0;
        loop {
            let point = point_at(arc_m);
            let depth_m = radius_m - self.clearance_m(point);
            // Not a number is no permission.
            if depth_m > 0.0 || depth_m.is_nan() {
                return Some(Breach {
                    arc_m,
                    point,
                    depth_m,
                });
            }
            if arc_m >= length_m {
                return None;
            }
            // Clearance cannot be used up before so much more of the path.
            arc_m = (arc_m + (-depth_m).max(BREACH_STEP_M)).min(length_m);
        }
    }
}

#[cfg(test)]
mod tests;
