//! Geofence: geometry of allowed and forbidden polygons, and the speed limit that keeps a robot
//! inside.
//!
//! The robot is a disc around its centre. *Clearance* is the signed distance of a point from the
//! border of the allowed ground, positive inside: into one of the `keep_in` polygons (the deepest,
//! if there are several) and out of every `keep_out` polygon. Clearance is Lipschitz with constant
//! 1, so a path can be sampled in steps as long as the clearance of the last sample: a few samples
//! give the free distance along an arc, whatever the shape of the fence.
//!
//! [`Fence::limit_speed`] limits the speed so that the robot stops within that distance. Nothing
//! here allocates after [`Fence::new`].

mod polygon;
mod speed;

use crate::geometry::Point;
use crate::plan::Plan;
use crate::robot::RobotModel;
use polygon::Polygon;
pub use speed::{
    Braking, FenceInput, FenceLimit, MARGIN_STD_DEVS, MU_UNKNOWN, REACTION_S, RETURN_MAX_M_S,
};

/// Distance from the robot's disc to the fence that is kept free, metres.
pub const MARGIN_M: f64 = 0.10;
/// Minimum step in checking a planned path, metres.
const BREACH_STEP_M: f64 = 0.02;

/// Polygons that a robot must stay inside (`keep_in`: any one of them) and outside (`keep_out`: all
/// of them).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Fence {
    keep_in: Vec<Polygon>,
    keep_out: Vec<Polygon>,
}

/// Polygons of a fence; each is a list of corners in order, in the site frame.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FenceSpec {
    /// Polygons of which a robot must stay inside any one.
    pub keep_in: Vec<Vec<Point>>,
    /// Polygons outside which a robot must stay.
    pub keep_out: Vec<Vec<Point>>,
}

/// Path of a disc's centre.
struct CentrePath<F> {
    /// Centre at an arc length of 0 to `length_m`, metres.
    point_at: F,
    length_m: f64,
}

/// First point of a path at which a robot's disc leaves the allowed ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Breach {
    /// Arc length from the start of the path, metres.
    pub arc_m: f64,
    /// Centre of the robot at that arc length, site frame.
    pub point: Point,
    /// Distance by which the disc extends beyond the border, metres; infinite if the point is not
    /// finite.
    pub depth_m: f64,
}

/// Polygon of a fence, by its index in the list of [`FenceSpec`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FencePolygon {
    /// Polygon inside which a robot must stay.
    KeepIn(usize),
    /// Polygon outside which a robot must stay.
    KeepOut(usize),
}

/// Overlap of a disc with forbidden ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Overlap {
    /// Violated polygon; of several `keep_in` polygons the one with the smallest depth.
    pub polygon: FencePolygon,
    /// Point of the polygon's border nearest to the disc's centre, site frame.
    pub border: Point,
    /// Distance by which the disc extends beyond the border, metres.
    pub depth_m: f64,
}

/// Returns the radius of the disc that encloses a robot, without margin, metres.
pub fn disc_radius_m(model: &RobotModel) -> f64 {
    // The body is assumed to end one wheel radius beyond the axles.
    0.5 * model
        .track_width_m()
        .hypot(model.wheelbase_m() + 2.0 * model.wheel_radius_m())
}

impl Fence {
    /// Creates a fence. Corners may be in either order; the even-odd rule gives what is inside of a
    /// polygon.
    pub fn new(spec: &FenceSpec) -> Self {
        let prepared = |polygons: &[Vec<Point>]| {
            polygons
                .iter()
                .map(|corners| Polygon::new(corners))
                .collect()
        };
        Self {
            keep_in: prepared(&spec.keep_in),
            keep_out: prepared(&spec.keep_out),
        }
    }

    /// Creates a fence without any allowed ground, in place of one that is invalid.
    pub fn without_allowed_ground() -> Self {
        Self {
            keep_in: vec![Polygon::new(&[])],
            keep_out: Vec::new(),
        }
    }

    /// Returns whether the fence has no polygon, so that it allows everything.
    pub fn is_empty(&self) -> bool {
        self.keep_in.is_empty() && self.keep_out.is_empty()
    }

    /// Returns the clearance of a point of the site frame, metres: positive inside the allowed
    /// ground, negative outside, infinite without any polygon, −∞ for a point that is not finite.
    pub fn clearance_m(&self, point: Point) -> f64 {
        if !point.is_finite() {
            return f64::NEG_INFINITY;
        }
        let depths = self.keep_in.iter().map(|polygon| polygon.depth_m(point));
        let inside_m = if self.keep_in.is_empty() {
            f64::INFINITY
        } else {
            depths.fold(f64::NEG_INFINITY, f64::max)
        };
        let mut clearance_m = inside_m;
        for polygon in &self.keep_out {
            // A polygon farther away than the present clearance cannot reduce it.
            if polygon.outside_distance_min_m(point) < clearance_m {
                clearance_m = clearance_m.min(-polygon.depth_m(point));
            }
        }
        clearance_m
    }

    /// Returns the deepest overlap of a disc with forbidden ground; None if the whole disc is on
    /// allowed ground. `center` is in the site frame.
    pub fn overlap(&self, center: Point, radius_m: f64) -> Option<Overlap> {
        let of = |index: FencePolygon, polygon: &Polygon, depth_m: f64| Overlap {
            polygon: index,
            border: polygon.nearest_border_point(center),
            depth_m,
        };
        let inside = self.keep_in.iter().enumerate().map(|(index, polygon)| {
            let depth_m = radius_m - polygon.depth_m(center);
            of(FencePolygon::KeepIn(index), polygon, depth_m)
        });
        let inside = inside.min_by(|one, other| one.depth_m.total_cmp(&other.depth_m));
        let outside = self.keep_out.iter().enumerate().map(|(index, polygon)| {
            let depth_m = radius_m + polygon.depth_m(center);
            of(FencePolygon::KeepOut(index), polygon, depth_m)
        });
        inside
            .into_iter()
            .chain(outside)
            // NaN counts as an overlap.
            .filter(|overlap| overlap.depth_m > 0.0 || overlap.depth_m.is_nan())
            .max_by(|one, other| one.depth_m.total_cmp(&other.depth_m))
    }

    /// Returns the first point of a plan at which the robot's disc plus [`MARGIN_M`] leaves the
    /// allowed ground, or None.
    pub fn plan_breach(&self, plan: &Plan, model: &RobotModel) -> Option<Breach> {
        let radius_m = disc_radius_m(model) + MARGIN_M;
        let path = CentrePath {
            point_at: |arc_m| plan.path().sample(arc_m).pose.point(),
            length_m: plan.length_m(),
        };
        self.first_breach(&path, radius_m)
    }

    /// Returns the first point of a path at which a disc of `radius_m` leaves the allowed ground,
    /// or None.
    fn first_breach(
        &self,
        path: &CentrePath<impl Fn(f64) -> Point>,
        radius_m: f64,
    ) -> Option<Breach> {
        if self.is_empty() {
            return None;
        }
        let mut arc_m = 0.0;
        loop {
            let point = (path.point_at)(arc_m);
            let depth_m = radius_m - self.clearance_m(point);
            // NaN counts as a breach.
            if depth_m > 0.0 || depth_m.is_nan() {
                return Some(Breach {
                    arc_m,
                    point,
                    depth_m,
                });
            }
            if arc_m >= path.length_m {
                return None;
            }
            // Clearance falls by at most the distance driven.
            arc_m = (arc_m + (-depth_m).max(BREACH_STEP_M)).min(path.length_m);
        }
    }
}

#[cfg(test)]
mod tests;
