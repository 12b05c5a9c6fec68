//! A plan: geometry and timing of one trajectory from where the robot stands.
//!
//! A circle is joined tangentially by the quickest of many smooth legs; a robot that stands on it
//! starts there. Waypoints are joined by making the robot's place the first point of the spline;
//! a robot that stands on the first waypoint, or beside it with no smooth way through it, starts
//! from there. Where the path leaves in another
//! direction than the robot points, [`Plan::start_heading_rad`] tells where to turn on the spot.

use thiserror::Error;

use crate::geometry::{Point, Pose};
use crate::path::{
    CircleTarget, Knot, Path, PathError, PathSample, Piece, RADIUS_MIN_M, from_here, join_circle,
    joined_from_afar,
};
use crate::profile::{NodeLimits, SpeedProfile};
use crate::robot::RobotModel;
use crate::trajectory::{CircleSpec, Trajectory, WaypointsSpec};

/// Most waypoints of a path.
pub const WAYPOINTS_MAX: usize = 100_000;
/// Neighbouring waypoints nearer than this are the same point, metres.
pub const WAYPOINT_SPACING_MIN_M: f64 = 1.0e-3;
/// Largest coordinate, metres.
pub const COORDINATE_MAX_M: f64 = 1.0e6;
/// Longest path, metres.
pub const LENGTH_MAX_M: f64 = 200_000.0;
/// A robot nearer to the first waypoint than this starts from it, metres.
const ON_START_M: f64 = 0.05;
/// Distance between the nodes of the timing, metres, on paths that are short enough.
const GRID_M: f64 = 0.02;
/// Most nodes of the timing.
const GRID_MAX: usize = 1_000_000;
/// Fewest cells of the timing.
const GRID_MIN: usize = 16;
/// Share of the wheels' speed and acceleration that a plan may ask for; the rest is for feedback.
const WHEEL_SHARE: f64 = 0.85;

/// Why a trajectory cannot be driven; places count from zero.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum PlanError {
    /// A figure is NaN, infinite or too large.
    #[error("{what} at {place} is not a usable number: {value}")]
    NotFinite {
        /// Which figure.
        what: &'static str,
        /// Index of the waypoint, 0 for a circle or the start.
        place: usize,
        /// What it held.
        value: f64,
    },
    /// A radius that is zero, negative or tighter than [`RADIUS_MIN_M`].
    #[error("the radius must be at least {RADIUS_MIN_M} m, not {0} m")]
    Radius(f64),
    /// No turn, or a negative one.
    #[error("the number of turns must be above zero, not {0}")]
    Turns(f64),
    /// Fewer than two waypoints.
    #[error("a path needs at least two waypoints, not {0}")]
    TooFewWaypoints(usize),
    /// More than [`WAYPOINTS_MAX`] waypoints.
    #[error("a path may have at most {WAYPOINTS_MAX} waypoints, not {0}")]
    TooManyWaypoints(usize),
    /// A waypoint at the same place as the one before.
    #[error("waypoint {place} is at the same place as the one before")]
    DuplicateWaypoint {
        /// Index of the second of the two.
        place: usize,
    },
    /// A speed that is zero or negative.
    #[error("the speed at {place} must be above zero, not {speed_m_s} m/s")]
    SpeedNotPositive {
        /// Index of the waypoint, 0 for a circle or a path's own speed.
        place: usize,
        /// What was asked for.
        speed_m_s: f64,
    },
    /// A speed above what the robot can drive.
    #[error("the speed at {place} is {speed_m_s} m/s, above the robot's limit of {limit_m_s} m/s")]
    SpeedAboveLimit {
        /// Index of the waypoint, 0 for a circle or a path's own speed.
        place: usize,
        /// What was asked for.
        speed_m_s: f64,
        /// The robot's limit.
        limit_m_s: f64,
    },
    /// The path would turn tighter than [`RADIUS_MIN_M`].
    #[error("the path turns too sharply near waypoint {place}")]
    TooTight {
        /// Index of the waypoint at the start of the sharp piece; 0 on the way to a circle.
        place: usize,
    },
    /// The path is longer than [`LENGTH_MAX_M`].
    #[error("the path is {0} m long, above the limit of {LENGTH_MAX_M} m")]
    TooLong(f64),
}

/// The plan at one time or place.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlanSample {
    /// Geometry at the arc length.
    pub path: PathSample,
    /// Arc length, metres.
    pub arc_m: f64,
    /// Speed along the path, metres per second, ≥ 0.
    pub speed_m_s: f64,
    /// Acceleration along the path, metres per second squared.
    pub acceleration_m_s2: f64,
}

/// What makes the robot slower than it was asked to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SlowedBy {
    /// Acceleration across the path.
    LateralAcceleration,
    /// Yaw rate.
    AngularSpeed,
    /// Wheel speed.
    WheelSpeed,
    /// Wheel acceleration where the bend changes.
    WheelAcceleration,
    /// Acceleration or braking along the path.
    LinearAcceleration,
}

/// A stretch of the path on which one limit makes the robot slower than it was asked to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slowed {
    /// Which limit.
    pub by: SlowedBy,
    /// Arc length of its begin, metres.
    pub from_m: f64,
    /// Arc length of its end, metres.
    pub to_m: f64,
    /// Slowest speed of the stretch, metres per second.
    pub speed_min_m_s: f64,
}

/// Most stretches that a plan names.
pub const SLOWED_MAX: usize = 1_000;
/// A robot this near to the speed that was asked for counts as driving it.
const AS_ASKED: f64 = 0.98;

/// Geometry and timing of one trajectory.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    path: Path,
    profile: SpeedProfile,
    approach_length_m: f64,
    peak_speed_m_s: f64,
    peak_acceleration_m_s2: f64,
    peak_lateral_m_s2: f64,
    peak_angular_rad_s: f64,
    slowed: Vec<Slowed>,
}

/// A speed that holds from an arc length on.
struct SpeedFrom {
    arc_m: f64,
    speed_m_s: f64,
}

impl Plan {
    /// Plans a trajectory from where the robot stands, at rest.
    ///
    /// # Errors
    /// [`PlanError`] names what cannot be driven, and where.
    pub fn new(
        trajectory: &Trajectory,
        start: Pose,
        model: &RobotModel,
    ) -> Result<Self, PlanError> {
        if !start.is_finite() || start.x_m.abs().max(start.y_m.abs()) > COORDINATE_MAX_M {
            return Err(PlanError::NotFinite {
                what: "the start pose",
                place: 0,
                value: f64::NAN,
            });
        }
        match trajectory {
            Trajectory::Circle(circle) => Self::circle(circle, start, model),
            Trajectory::Waypoints(waypoints) => Self::waypoints(waypoints, start, model),
        }
    }

    fn circle(circle: &CircleSpec, start: Pose, model: &RobotModel) -> Result<Self, PlanError> {
        check_coordinate("the centre", 0, circle.center)?;
        if !(circle.radius_m >= RADIUS_MIN_M && circle.radius_m <= COORDINATE_MAX_M) {
            return Err(PlanError::Radius(circle.radius_m));
        }
        if !(circle.turns > 0.0 && circle.turns.is_finite()) {
            return Err(PlanError::Turns(circle.turns));
        }
        check_speed(circle.speed_m_s, 0, model)?;
        let length_m = std::f64::consts::TAU * circle.radius_m * circle.turns;
        if length_m > LENGTH_MAX_M {
            return Err(PlanError::TooLong(length_m));
        }
        let target = CircleTarget {
            center: circle.center,
            radius_m: circle.radius_m,
            sign: circle.direction.sign(),
            speed_m_s: circle.speed_m_s,
        };
        let (legs, join_rad) =
            join_circle(&target, start, model).ok_or(PlanError::TooTight { place: 0 })?;
        let arc = Piece::Arc {
            center: circle.center,
            radius_m: circle.radius_m,
            start_rad: join_rad,
            sign: target.sign,
            length_m,
        };
        let approach_pieces = legs.len();
        let pieces = legs
            .into_iter()
            .map(Piece::Polynomial)
            .chain([arc])
            .collect();
        let path = Path::new(pieces).map_err(|_| PlanError::TooTight { place: 0 })?;
        let speeds = [SpeedFrom {
            arc_m: 0.0,
            speed_m_s: circle.speed_m_s,
        }];
        Self::timed(path, &speeds, approach_pieces, model)
    }

    fn waypoints(spec: &WaypointsSpec, start: Pose, model: &RobotModel) -> Result<Self, PlanError> {
        let points = &spec.points;
        if points.len() < 2 {
            return Err(PlanError::TooFewWaypoints(points.len()));
        }
        if points.len() > WAYPOINTS_MAX {
            return Err(PlanError::TooManyWaypoints(points.len()));
        }
        check_speed(spec.speed_m_s, 0, model)?;
        for (place, waypoint) in points.iter().enumerate() {
            check_coordinate("the waypoint", place, waypoint.point)?;
            if let Some(heading_rad) = waypoint.heading_rad.filter(|value| !value.is_finite()) {
                return Err(PlanError::NotFinite {
                    what: "the heading",
                    place,
                    value: heading_rad,
                });
            }
            if let Some(speed_m_s) = waypoint.speed_m_s {
                check_speed(speed_m_s, place, model)?;
            }
            if place > 0
                && points[place - 1].point.distance_m(waypoint.point) < WAYPOINT_SPACING_MIN_M
            {
                return Err(PlanError::DuplicateWaypoint { place });
            }
        }
        // Points that the robot stands on are behind it; the last one always stays.
        let first = points[..points.len() - 1]
            .iter()
            .take_while(|waypoint| waypoint.point.distance_m(start.point()) < ON_START_M)
            .count();
        if points[first].point.distance_m(start.point()) < WAYPOINT_SPACING_MIN_M {
            return Err(PlanError::DuplicateWaypoint { place: first });
        }
        let mut knots: Vec<Knot> = points[first..]
            .iter()
            .map(|waypoint| Knot {
                point: waypoint.point,
                heading_rad: waypoint.heading_rad,
            })
            .collect();
        let too_tight = |error: PathError| match error {
            PathError::TooTight { piece } => PlanError::TooTight {
                place: (piece + first).saturating_sub(1),
            },
        };
        let mut approach_pieces = usize::from(first == 0);
        let path = if first == 0
            && let Some((path, legs)) = joined_from_afar(&knots, start, spec.speed_m_s, model)
        {
            approach_pieces = legs;
            path
        } else {
            // The robot's place is the first knot: it stands on the path, or too near for a leg.
            let behind = first
                .checked_sub(1)
                .and_then(|behind| points[behind].heading_rad);
            knots.insert(
                0,
                Knot {
                    point: start.point(),
                    heading_rad: behind,
                },
            );
            from_here(&mut knots, start, spec.speed_m_s, model).map_err(too_tight)?
        };
        // Waypoint at which a piece starts; the first one's for the approach too.
        let place_of = |piece: usize| (piece + first).saturating_sub(approach_pieces.max(1));
        let mut speeds = vec![SpeedFrom {
            arc_m: 0.0,
            speed_m_s: spec.speed_m_s,
        }];
        for piece in 0..path.piece_count() {
            let waypoint = (piece >= approach_pieces).then(|| &points[place_of(piece)]);
            speeds.push(SpeedFrom {
                arc_m: path.piece_start_m(piece),
                speed_m_s: waypoint
                    .and_then(|point| point.speed_m_s)
                    .unwrap_or(spec.speed_m_s),
            });
        }
        Self::timed(path, &speeds, approach_pieces, model)
    }

    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "counts of grid cells stay far below 2^52"
    )]
    fn timed(
        path: Path,
        speeds: &[SpeedFrom],
        approach_pieces: usize,
        model: &RobotModel,
    ) -> Result<Self, PlanError> {
        let length_m = path.length_m();
        if length_m > LENGTH_MAX_M {
            return Err(PlanError::TooLong(length_m));
        }
        let cells = ((length_m / GRID_M).ceil() as usize).clamp(GRID_MIN, GRID_MAX);
        let cell_m = length_m / cells as f64;
        let mut asked = 0;
        let mut nodes = Vec::with_capacity(cells + 1);
        let mut asked_m_s = Vec::with_capacity(cells + 1);
        let mut bounds = Vec::with_capacity(cells + 1);
        for index in 0..=cells {
            let arc_m = cell_m * index as f64;
            while speeds
                .get(asked + 1)
                .is_some_and(|next| next.arc_m <= arc_m)
            {
                asked += 1;
            }
            let (node, by) = node_limits(&path.sample(arc_m), speeds[asked].speed_m_s, model);
            nodes.push(node);
            bounds.push(by);
            asked_m_s.push(speeds[asked].speed_m_s);
        }
        let profile = SpeedProfile::new(length_m, &nodes, model.limits().linear_jerk_max_m_s3);
        let mut plan = Self {
            approach_length_m: path.piece_start_m(approach_pieces),
            path,
            profile,
            peak_speed_m_s: 0.0,
            peak_acceleration_m_s2: 0.0,
            peak_lateral_m_s2: 0.0,
            peak_angular_rad_s: 0.0,
            slowed: Vec::new(),
        };
        let steps = (plan.duration_s() / 0.05).ceil().min(GRID_MAX as f64) as usize + 1;
        for step in 0..=steps {
            let sample = plan.sample(plan.duration_s() * step as f64 / steps as f64);
            let turn_rad_s = (sample.speed_m_s * sample.path.curvature_1_m).abs();
            plan.peak_speed_m_s = plan.peak_speed_m_s.max(sample.speed_m_s);
            plan.peak_acceleration_m_s2 = plan
                .peak_acceleration_m_s2
                .max(sample.acceleration_m_s2.abs());
            plan.peak_lateral_m_s2 = plan.peak_lateral_m_s2.max(turn_rad_s * sample.speed_m_s);
            plan.peak_angular_rad_s = plan.peak_angular_rad_s.max(turn_rad_s);
            let node = ((sample.arc_m / cell_m) as usize).min(cells);
            if sample.speed_m_s < AS_ASKED * asked_m_s[node] {
                let near = sample.speed_m_s >= AS_ASKED * AS_ASKED * nodes[node].speed_m_s;
                let by = bounds[node].filter(|_| near);
                let by = by.unwrap_or(SlowedBy::LinearAcceleration);
                plan.note_slowed(by, sample.arc_m, sample.speed_m_s);
            }
        }
        Ok(plan)
    }

    /// Lengthens the last stretch, or begins another.
    fn note_slowed(&mut self, by: SlowedBy, arc_m: f64, speed_m_s: f64) {
        // What lies within a few samples of the same limit is one stretch.
        let reach_m = 4.0 * GRID_M + 0.2 * speed_m_s;
        let has_room = self.slowed.len() < SLOWED_MAX;
        match self.slowed.last_mut() {
            Some(last) if last.by == by && arc_m - last.to_m <= reach_m => {
                last.to_m = arc_m;
                last.speed_min_m_s = last.speed_min_m_s.min(speed_m_s);
            }
            _ if has_room => self.slowed.push(Slowed {
                by,
                from_m: arc_m,
                to_m: arc_m,
                speed_min_m_s: speed_m_s,
            }),
            _ => {}
        }
    }

    /// Where a limit makes the robot slower than it was asked to be, in driving order; at most
    /// [`SLOWED_MAX`] stretches.
    pub fn slowed(&self) -> &[Slowed] {
        &self.slowed
    }

    /// The plan at a time since its start, seconds; at rest at its ends before and after.
    pub fn sample(&self, time_s: f64) -> PlanSample {
        let timing = self.profile.sample(time_s);
        PlanSample {
            path: self.path.sample(timing.arc_m),
            arc_m: timing.arc_m,
            speed_m_s: timing.speed_m_s,
            acceleration_m_s2: timing.acceleration_m_s2,
        }
    }

    /// The geometry alone.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Length of the whole path with its approach, metres.
    pub fn length_m(&self) -> f64 {
        self.path.length_m()
    }

    /// Length of the way to the circle or the first waypoint, metres.
    pub fn approach_length_m(&self) -> f64 {
        self.approach_length_m
    }

    /// Time from rest to rest when nothing slows the robot, without turning on the spot, seconds.
    pub fn duration_s(&self) -> f64 {
        self.profile.duration_s()
    }

    /// Direction in which the path leaves the start, radians.
    pub fn start_heading_rad(&self) -> f64 {
        self.path.sample(0.0).pose.heading_rad
    }

    /// Where the path ends.
    pub fn end_pose(&self) -> Pose {
        self.path.sample(self.length_m()).pose
    }

    /// Fastest speed along the path, metres per second.
    pub fn peak_speed_m_s(&self) -> f64 {
        self.peak_speed_m_s
    }

    /// Hardest acceleration or braking along the path, metres per second squared.
    pub fn peak_acceleration_m_s2(&self) -> f64 {
        self.peak_acceleration_m_s2
    }

    /// Hardest acceleration across the path, metres per second squared.
    pub fn peak_lateral_acceleration_m_s2(&self) -> f64 {
        self.peak_lateral_m_s2
    }

    /// Fastest turn, radians per second.
    pub fn peak_angular_rad_s(&self) -> f64 {
        self.peak_angular_rad_s
    }
}

/// What the robot may do where the path bends like this.
/// The second is the limit that makes it slower than it was asked to be.
fn node_limits(
    path: &PathSample,
    asked_m_s: f64,
    model: &RobotModel,
) -> (NodeLimits, Option<SlowedBy>) {
    let limits = model.limits();
    let bend = path.curvature_1_m.abs();
    let slope = path.curvature_slope_1_m2.abs();
    let radius_m = model.wheel_radius_m();
    let half_track_m = 0.5 * model.effective_track_m();
    let rim_max_m_s = WHEEL_SHARE * limits.wheel_speed_max_rad_s * radius_m;
    let rim_max_m_s2 = WHEEL_SHARE * limits.wheel_acceleration_max_rad_s2 * radius_m;
    // The outer wheels: v (1 + bW/2), and a (1 + bW/2) + v² b' W/2, half of the limit for each.
    let outer = 1.0 + bend * half_track_m;
    let floor = f64::MIN_POSITIVE;
    let bounds_m_s = [
        (
            SlowedBy::LateralAcceleration,
            (limits.lateral_acceleration_max_m_s2 / bend.max(floor)).sqrt(),
        ),
        (
            SlowedBy::AngularSpeed,
            limits.angular_max_rad_s / bend.max(floor),
        ),
        (SlowedBy::WheelSpeed, rim_max_m_s / outer),
        (
            SlowedBy::WheelAcceleration,
            (0.5 * rim_max_m_s2 / (slope * half_track_m).max(floor)).sqrt(),
        ),
    ];
    let mut slowest = (asked_m_s, None);
    for (by, bound_m_s) in bounds_m_s {
        if bound_m_s < slowest.0 {
            slowest = (bound_m_s, Some(by));
        }
    }
    let node = NodeLimits {
        speed_m_s: slowest.0,
        acceleration_m_s2: limits
            .linear_acceleration_max_m_s2
            .min(0.5 * rim_max_m_s2 / outer),
    };
    (node, slowest.1)
}

fn check_coordinate(what: &'static str, place: usize, point: Point) -> Result<(), PlanError> {
    for value in [point.x_m, point.y_m] {
        if !value.is_finite() || value.abs() > COORDINATE_MAX_M {
            return Err(PlanError::NotFinite { what, place, value });
        }
    }
    Ok(())
}

fn check_speed(speed_m_s: f64, place: usize, model: &RobotModel) -> Result<(), PlanError> {
    if !speed_m_s.is_finite() {
        return Err(PlanError::NotFinite {
            what: "the speed",
            place,
            value: speed_m_s,
        });
    }
    if speed_m_s <= 0.0 {
        return Err(PlanError::SpeedNotPositive { place, speed_m_s });
    }
    let limits = model.limits();
    let rim_max_m_s = WHEEL_SHARE * limits.wheel_speed_max_rad_s * model.wheel_radius_m();
    let limit_m_s = limits.linear_max_m_s.min(rim_max_m_s);
    if speed_m_s > limit_m_s {
        return Err(PlanError::SpeedAboveLimit {
            place,
            speed_m_s,
            limit_m_s,
        });
    }
    Ok(())
}
