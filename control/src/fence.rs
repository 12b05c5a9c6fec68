//! Where a robot may be: the pure geometry of fences, and the speed that keeps it inside.
//!
//! The robot is a disc around its centre. *Clearance* is how far a point is inside the allowed
//! ground: into one of the `keep_in` polygons (the deepest, if there are several) and away from
//! every `keep_out` polygon. It changes by no more than the way between two points, so a path can
//! be walked in steps as long as the clearance of the last one ([`Fence::free_way_m`]): a few
//! looks answer exactly how far the robot may go along its arc, whatever the fence looks like.
//!
//! The cap of the speed is the fastest from which it still stops within that way,
//! `v t + v²/2a = way`, with the time `t` until it brakes and the braking `a` that the ground's
//! lower grip bound surely gives. Outside already, only motion that gains clearance is let
//! through, slowly. Nothing here allocates after [`Fence::new`].

use crate::geometry::{Point, Pose, Twist};
use crate::plan::Plan;
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// Distance kept from a fence beyond the robot's own radius, metres.
pub const MARGIN_M: f64 = 0.10;
/// Standard deviations of the position by which the margin grows.
pub const MARGIN_STD_DEVS: f64 = 2.0;
/// Fastest drive back in from outside, metres per second.
pub const RETURN_MAX_M_S: f64 = 0.15;
/// Friction coefficient that ground of unknown grip is taken to have.
pub const MU_UNKNOWN: f64 = 0.15;
/// Time from a decision until the wheels brake, seconds: a tick of the slowest loop, the servo,
/// and the age of the position.
pub const REACTION_S: f64 = 0.20;
/// Steps along an arc before the rest of it counts as not free.
const STEPS_MAX: u32 = 24;
/// Shortest step along an arc, metres; clearance below this counts as none.
const STEP_MIN_M: f64 = 0.005;
/// Shortest step along a planned way, metres.
const BREACH_STEP_M: f64 = 0.02;
/// Step by which motion from outside is tried, metres.
const RETURN_STEP_M: f64 = 0.05;

/// One side of a polygon, prepared.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Side {
    from: Point,
    to: Point,
    inverse_length_1_m2: f64,
}

#[derive(Debug, Clone, PartialEq)]
struct Ring {
    sides: Vec<Side>,
    low: Point,
    high: Point,
}

impl Ring {
    fn new(corners: &[Point]) -> Self {
        let next = corners.iter().cycle().skip(1);
        let sides = corners.iter().zip(next).map(|(&from, &to)| Side {
            from,
            to,
            inverse_length_1_m2: from.distance_m(to).powi(2).recip(),
        });
        let least =
            |pick: fn(&Point) -> f64| corners.iter().map(pick).fold(f64::INFINITY, f64::min);
        let most =
            |pick: fn(&Point) -> f64| corners.iter().map(pick).fold(f64::NEG_INFINITY, f64::max);
        Self {
            sides: sides.collect(),
            low: Point {
                x_m: least(|corner| corner.x_m),
                y_m: least(|corner| corner.y_m),
            },
            high: Point {
                x_m: most(|corner| corner.x_m),
                y_m: most(|corner| corner.y_m),
            },
        }
    }

    /// A lower bound of the distance from outside; 0 within the polygon's box.
    fn outside_at_least_m(&self, point: Point) -> f64 {
        let off = |value: f64, low: f64, high: f64| (low - value).max(value - high).max(0.0);
        let x_m = off(point.x_m, self.low.x_m, self.high.x_m);
        x_m.max(off(point.y_m, self.low.y_m, self.high.y_m))
    }

    /// Distance to the border, positive inside.
    fn depth_m(&self, point: Point) -> f64 {
        let mut nearest_m2 = f64::INFINITY;
        let mut is_inside = false;
        for side in &self.sides {
            let (from, to) = (side.from, side.to);
            let (side_x, side_y) = (to.x_m - from.x_m, to.y_m - from.y_m);
            let (x_m, y_m) = (point.x_m - from.x_m, point.y_m - from.y_m);
            let share = ((x_m * side_x + y_m * side_y) * side.inverse_length_1_m2).clamp(0.0, 1.0);
            let (off_x, off_y) = (x_m - share * side_x, y_m - share * side_y);
            nearest_m2 = nearest_m2.min(off_x * off_x + off_y * off_y);
            // Whether the ray to the right crosses this side, without a division.
            let is_upward = to.y_m > from.y_m;
            let is_beside = (from.y_m > point.y_m) != (to.y_m > point.y_m);
            is_inside ^= is_beside && ((x_m * side_y < side_x * y_m) == is_upward);
        }
        let distance_m = nearest_m2.sqrt();
        if is_inside { distance_m } else { -distance_m }
    }
}

/// Polygons within which, and out of which, a robot must keep.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Fence {
    keep_in: Vec<Ring>,
    keep_out: Vec<Ring>,
}

/// Where something leaves the allowed ground.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Breach {
    /// Way from the start to there, metres.
    pub arc_m: f64,
    /// The centre of the robot there.
    pub point: Point,
    /// How far the robot's disc is outside there, metres.
    pub depth_m: f64,
}

/// What the cap of the speed depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FenceInput {
    /// Where the robot is.
    pub pose: Pose,
    /// Standard deviation of its position, metres.
    pub position_std_dev_m: f64,
    /// How it moves.
    pub present: Twist,
    /// How it is to move.
    pub wanted: Twist,
    /// Friction coefficient that the ground surely gives; [`MU_UNKNOWN`] when absent.
    pub mu_lower: Option<f64>,
}

/// How a robot stands to its fence.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FenceVerdict {
    /// Clearance of the robot's disc with its margin, metres; below zero it is outside.
    pub clearance_m: f64,
    /// Fastest speed along its arc, metres per second; none while the fence is out of reach.
    pub speed_max_m_s: Option<f64>,
}

/// Radius of the disc that stands for a robot, without margin, metres.
pub fn disc_radius_m(model: &RobotModel) -> f64 {
    // The body ends about a wheel's radius beyond the axles.
    0.5 * model
        .track_width_m()
        .hypot(model.wheelbase_m() + 2.0 * model.wheel_radius_m())
}

/// Braking that a robot surely has, metres per second squared: its own limit, and half of what the
/// ground gives, for the rest goes into steering.
pub fn sure_braking_m_s2(model: &RobotModel, mu_lower: Option<f64>) -> f64 {
    let mu = mu_lower
        .filter(|mu| mu.is_finite() && *mu > 0.0)
        .unwrap_or(MU_UNKNOWN);
    model
        .limits()
        .linear_acceleration_max_m_s2
        .min(0.5 * mu * GRAVITY_M_S2)
}

/// Way from a decision to standstill, metres.
pub fn stopping_way_m(speed_m_s: f64, braking_m_s2: f64) -> f64 {
    let speed_m_s = speed_m_s.abs();
    speed_m_s * REACTION_S + speed_m_s * speed_m_s / (2.0 * braking_m_s2)
}

/// Fastest speed with which the robot stops within a way, metres per second.
pub fn speed_within_m_s(way_m: f64, braking_m_s2: f64) -> f64 {
    let delay_m_s = braking_m_s2 * REACTION_S;
    (delay_m_s * delay_m_s + 2.0 * braking_m_s2 * way_m.max(0.0)).sqrt() - delay_m_s
}

/// The pose after a way along an arc; a negative way goes backwards.
fn along_arc(pose: Pose, curvature_1_m: f64, way_m: f64) -> Pose {
    let turn_rad = curvature_1_m * way_m;
    let middle_rad = pose.heading_rad + 0.5 * turn_rad;
    // The chord of the arc: sin(x)/x of half the turn.
    let half_rad = 0.5 * turn_rad;
    let chord_m = if half_rad.abs() < 1.0e-6 {
        way_m
    } else {
        way_m * half_rad.sin() / half_rad
    };
    Pose {
        x_m: pose.x_m + chord_m * middle_rad.cos(),
        y_m: pose.y_m + chord_m * middle_rad.sin(),
        heading_rad: pose.heading_rad + turn_rad,
    }
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

    /// The first place at which a robot that drives a plan, with the margin that it keeps anyway,
    /// would leave the allowed ground.
    pub fn plan_breach(&self, plan: &Plan, model: &RobotModel) -> Option<Breach> {
        let radius_m = disc_radius_m(model) + MARGIN_M;
        let point_at = |arc_m: f64| plan.path().sample(arc_m).pose.point();
        self.first_breach(point_at, plan.length_m(), radius_m)
    }

    /// The first place along a way at which a disc leaves the allowed ground.
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
            // Clearance cannot be used up before so much more of the way.
            arc_m = (arc_m + (-depth_m).max(BREACH_STEP_M)).min(length_m);
        }
    }

    /// How far a disc may go along its arc, metres, at most `most_m`; 0 outside.
    fn free_way_m(&self, pose: Pose, twist: Twist, radius_m: f64, most_m: f64) -> f64 {
        if twist.linear_m_s.abs() < 1.0e-6 {
            return most_m;
        }
        let curvature_1_m = twist.angular_rad_s / twist.linear_m_s;
        let direction = twist.linear_m_s.signum();
        let mut way_m = 0.0;
        for _ in 0..STEPS_MAX {
            let at = along_arc(pose, curvature_1_m, direction * way_m);
            let clearance_m = self.clearance_m(at.point()) - radius_m;
            if clearance_m < STEP_MIN_M {
                return way_m;
            }
            way_m += clearance_m;
            if way_m >= most_m {
                return most_m;
            }
        }
        way_m
    }

    /// Whether motion from outside leads back in.
    fn leads_back(&self, pose: Pose, twist: Twist, clearance_m: f64) -> bool {
        if twist.linear_m_s.abs() < 1.0e-6 {
            // Turning on the spot leaves the disc where it is.
            return true;
        }
        let curvature_1_m = twist.angular_rad_s / twist.linear_m_s;
        let step_m = RETURN_STEP_M.copysign(twist.linear_m_s);
        let next = along_arc(pose, curvature_1_m, step_m);
        self.clearance_m(next.point()) > clearance_m + 0.1 * RETURN_STEP_M
    }

    /// The speed that keeps a robot inside, looking along the arc that is wanted and along the one
    /// that is driven.
    pub fn judge(&self, input: &FenceInput, model: &RobotModel) -> FenceVerdict {
        if self.is_empty() {
            return FenceVerdict {
                clearance_m: f64::INFINITY,
                speed_max_m_s: None,
            };
        }
        let all_stop = FenceVerdict {
            clearance_m: f64::NEG_INFINITY,
            speed_max_m_s: Some(0.0),
        };
        if !(input.pose.is_finite() && input.present.is_finite() && input.wanted.is_finite()) {
            return all_stop;
        }
        if !input.position_std_dev_m.is_finite() {
            return all_stop;
        }
        let radius_m =
            disc_radius_m(model) + MARGIN_M + MARGIN_STD_DEVS * input.position_std_dev_m.max(0.0);
        let here_m = self.clearance_m(input.pose.point());
        let clearance_m = here_m - radius_m;
        let cap = |most_m_s: f64| FenceVerdict {
            clearance_m,
            speed_max_m_s: Some(most_m_s),
        };
        if clearance_m < STEP_MIN_M {
            return cap(if self.leads_back(input.pose, input.wanted, here_m) {
                RETURN_MAX_M_S
            } else {
                0.0
            });
        }
        let braking_m_s2 = sure_braking_m_s2(model, input.mu_lower);
        let fastest_m_s = input
            .present
            .linear_m_s
            .abs()
            .max(input.wanted.linear_m_s.abs());
        // A little more than is needed, so that the cap does not flicker at its own edge.
        let reach_m = 1.2 * stopping_way_m(fastest_m_s, braking_m_s2);
        if clearance_m >= reach_m {
            return FenceVerdict {
                clearance_m,
                speed_max_m_s: None,
            };
        }
        let free_m = [input.present, input.wanted]
            .into_iter()
            .map(|twist| self.free_way_m(input.pose, twist, radius_m, reach_m))
            .fold(reach_m, f64::min);
        if free_m >= reach_m {
            return FenceVerdict {
                clearance_m,
                speed_max_m_s: None,
            };
        }
        cap(speed_within_m_s(free_m, braking_m_s2))
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use proptest::prelude::*;

    use super::*;

    fn square(x_m: f64, y_m: f64, half_m: f64) -> Vec<Point> {
        [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
            .into_iter()
            .map(|(east, north)| Point {
                x_m: x_m + half_m * east,
                y_m: y_m + half_m * north,
            })
            .collect()
    }

    fn yard() -> Fence {
        Fence::new(
            vec![square(0.0, 0.0, 5.0), square(8.0, 0.0, 4.0)],
            vec![square(2.0, 2.0, 0.5)],
        )
    }

    proptest! {
        #[test]
        fn clearance_changes_by_no_more_than_the_way(
            x_m in -15.0..15.0_f64, y_m in -15.0..15.0_f64,
            dx_m in -2.0..2.0_f64, dy_m in -2.0..2.0_f64,
        ) {
            let fence = yard();
            let here = Point { x_m, y_m };
            let there = Point { x_m: x_m + dx_m, y_m: y_m + dy_m };
            let change_m = (fence.clearance_m(here) - fence.clearance_m(there)).abs();
            prop_assert!(change_m <= here.distance_m(there) + 1.0e-9);
        }

        #[test]
        fn a_robot_that_keeps_to_the_cap_never_leaves_the_fence(
            x_m in -4.0..4.0_f64, y_m in -4.0..4.0_f64, heading_rad in -3.1..3.1_f64,
            twists in prop::collection::vec((-1.0..1.0_f64, -2.0..2.0_f64), 1..12),
            mu in prop_oneof![Just(None), (0.05..0.9_f64).prop_map(Some)],
        ) {
            let (fence, model) = (yard(), RobotModel::yi2007());
            let mut pose = Pose { x_m, y_m, heading_rad };
            let radius_m = disc_radius_m(&model);
            prop_assume!(fence.clearance_m(pose.point()) > radius_m + MARGIN_M);
            let braking_m_s2 = sure_braking_m_s2(&model, mu);
            let dt_s = 0.02;
            let mut present = Twist::default();
            // What was decided comes to the wheels this much later.
            let mut delayed = [Twist::default(); 5];
            for (linear_m_s, angular_rad_s) in twists {
                for _ in 0..100 {
                    let wanted = Twist { linear_m_s, angular_rad_s };
                    let input = FenceInput {
                        pose, position_std_dev_m: 0.0, present, wanted, mu_lower: mu,
                    };
                    let most_m_s = fence.judge(&input, &model).speed_max_m_s;
                    let share = most_m_s.map_or(1.0, |most_m_s| {
                        (most_m_s / linear_m_s.abs().max(1.0e-9)).min(1.0)
                    });
                    delayed.rotate_left(1);
                    delayed[4] = Twist {
                        linear_m_s: share * linear_m_s, angular_rad_s: share * angular_rad_s,
                    };
                    // No braking harder than the ground surely gives.
                    let target = delayed[0];
                    let most = braking_m_s2 * dt_s;
                    let linear_m_s = present.linear_m_s
                        + (target.linear_m_s - present.linear_m_s).clamp(-most, most);
                    let is_braking = linear_m_s.abs() < present.linear_m_s.abs();
                    // Braking stays on the arc, as the gate does.
                    let angular_rad_s = if is_braking && present.linear_m_s.abs() > 1.0e-9 {
                        present.angular_rad_s * linear_m_s / present.linear_m_s
                    } else {
                        target.angular_rad_s
                    };
                    present = Twist { linear_m_s, angular_rad_s };
                    let curvature_1_m = present.angular_rad_s / present.linear_m_s;
                    pose = if present.linear_m_s.abs() > 1.0e-9 {
                        along_arc(pose, curvature_1_m, present.linear_m_s * dt_s)
                    } else {
                        Pose { heading_rad: pose.heading_rad + present.angular_rad_s * dt_s, ..pose }
                    };
                    let left_m = fence.clearance_m(pose.point()) - radius_m;
                    prop_assert!(left_m > 0.0, "left by {left_m} at {pose:?}");
                }
            }
        }
    }

    #[test]
    fn a_concave_polygon_is_inside_where_it_is() {
        // A horseshoe that is open to the right.
        let corners = [
            (0.0, 0.0),
            (4.0, 0.0),
            (4.0, 1.0),
            (1.0, 1.0),
            (1.0, 3.0),
            (4.0, 3.0),
            (4.0, 4.0),
            (0.0, 4.0),
        ];
        let corners: Vec<Point> = corners
            .into_iter()
            .map(|(x_m, y_m)| Point { x_m, y_m })
            .collect();
        let mut turned = corners.clone();
        turned.reverse();
        for corners in [corners, turned] {
            let fence = Fence::new(vec![corners], Vec::new());
            for (x_m, y_m, clearance_m) in [
                (0.5, 2.0, 0.5),
                (3.0, 0.5, 0.5),
                (3.0, 3.5, 0.5),
                (2.0, 2.0, -1.0),
                (5.0, 0.5, -1.0),
                (-1.0, 2.0, -1.0),
                (0.5, 0.5, 0.5),
            ] {
                let got_m = fence.clearance_m(Point { x_m, y_m });
                assert!(
                    (got_m - clearance_m).abs() < 1.0e-12,
                    "{x_m} {y_m}: {got_m}"
                );
            }
        }
    }

    #[test]
    fn along_a_fence_is_free_and_towards_it_is_slow() {
        let (fence, model) = (
            Fence::new(vec![square(0.0, 0.0, 5.0)], Vec::new()),
            RobotModel::yi2007(),
        );
        let gap_m = disc_radius_m(&model) + MARGIN_M + 0.05;
        let at = |heading_rad: f64| FenceInput {
            pose: Pose {
                x_m: 5.0 - gap_m,
                y_m: 0.0,
                heading_rad,
            },
            position_std_dev_m: 0.0,
            present: Twist::default(),
            wanted: Twist {
                linear_m_s: 0.8,
                angular_rad_s: 0.0,
            },
            mu_lower: None,
        };
        let cap = |heading_rad| fence.judge(&at(heading_rad), &model).speed_max_m_s;
        assert!(cap(0.0).unwrap() < 0.2);
        assert!(cap(1.57).is_none_or(|most_m_s| most_m_s > 0.5));
        assert!(cap(PI).is_none_or(|most_m_s| most_m_s > 0.5));
    }

    #[test]
    fn from_outside_only_the_way_back_is_open() {
        let (fence, model) = (yard(), RobotModel::yi2007());
        let at = |heading_rad: f64, linear_m_s: f64| {
            let input = FenceInput {
                pose: Pose {
                    x_m: -6.0,
                    y_m: 0.0,
                    heading_rad,
                },
                position_std_dev_m: 0.0,
                present: Twist::default(),
                wanted: Twist {
                    linear_m_s,
                    angular_rad_s: 0.1,
                },
                mu_lower: None,
            };
            fence.judge(&input, &model).speed_max_m_s
        };
        assert_eq!(at(0.0, 0.5), Some(RETURN_MAX_M_S));
        assert_eq!(at(0.0, -0.5), Some(0.0));
        assert_eq!(at(PI, 0.5), Some(0.0));
        assert_eq!(at(PI, -0.5), Some(RETURN_MAX_M_S));
        assert_eq!(at(PI, 0.0), Some(RETURN_MAX_M_S), "turning is open");
    }

    #[test]
    fn a_path_that_crosses_is_named_by_its_place() {
        let fence = yard();
        let line = |y_m: f64| {
            move |arc_m: f64| Point {
                x_m: arc_m - 4.0,
                y_m,
            }
        };
        assert_eq!(fence.first_breach(line(-1.0), 10.0, 0.3), None);
        let breach = fence.first_breach(line(2.0), 10.0, 0.3).unwrap();
        assert!((breach.point.x_m - 1.2).abs() < 0.05, "{breach:?}");
        assert!((breach.arc_m - 5.2).abs() < 0.05, "{breach:?}");
        let nowhere = |_: f64| Point {
            x_m: f64::NAN,
            y_m: 0.0,
        };
        assert!(fence.first_breach(nowhere, 1.0, 0.3).is_some());
        assert_eq!(Fence::default().first_breach(nowhere, 1.0, 0.3), None);
    }

    #[test]
    fn a_pose_that_is_no_number_stops() {
        let input = FenceInput {
            pose: Pose {
                x_m: f64::NAN,
                ..Pose::default()
            },
            position_std_dev_m: 0.0,
            present: Twist::default(),
            wanted: Twist::default(),
            mu_lower: None,
        };
        let verdict = yard().judge(&input, &RobotModel::yi2007());
        assert_eq!(verdict.speed_max_m_s, Some(0.0));
    }
}
