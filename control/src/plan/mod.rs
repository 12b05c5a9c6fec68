//! Plan: geometry and timing of one trajectory from the robot's pose.
//!
//! A circle is joined tangentially by the quickest of many smooth legs; a robot on the circle
//! starts there. Waypoints are joined by such a leg too, or, near the path, by making the robot's
//! position the first point of the spline; a robot at the first waypoint, or beside it with no
//! smooth path through it, starts from there. Where the path starts in another direction than the
//! robot's heading, [`Plan::start_heading_rad`] is the heading to turn to on the spot.

mod error;
mod limits;
mod slowed;
mod traction_limit;

use crate::excitation::{Excitation, ExcitationSpec, PlanTime};
use crate::geometry::{Point, Pose};
use crate::path::{
    CircleTarget, Knot, Path, PathError, PathSample, Piece, RADIUS_MIN_M, join_circle,
    leg_and_spline, spline_from_robot,
};
use crate::profile::{NodeLimits, ProfileInput, SpeedProfile};
use crate::robot::RobotModel;
use crate::trajectory::{CircleSpec, Trajectory, WaypointsSpec};

pub use error::{PlanError, PlanValue};
pub use slowed::{SLOWED_MAX, Slowed, SlowedBy};
pub use traction_limit::{TractionLimitCell, TractionLimitMap, TractionLimitMapSpec};

use limits::{BindingLimits, NodeBounds, Shares, WHEEL_SHARE, node_limits, with_excitation};
use slowed::{CellBounds, Stretches};

/// Maximum number of waypoints of a path.
pub const WAYPOINTS_MAX: usize = 100_000;
/// Minimum distance between consecutive waypoints, metres; closer ones are refused as duplicates.
pub const WAYPOINT_SPACING_MIN_M: f64 = 1.0e-3;
/// Maximum magnitude of a coordinate, metres.
pub const COORDINATE_MAX_M: f64 = 1.0e6;
/// Maximum length of a path, metres.
pub const LENGTH_MAX_M: f64 = 200_000.0;
/// Distance below which a robot counts as being at the first waypoint, metres.
const ON_START_M: f64 = 0.05;
/// Distance between nodes of the timing, metres, unless [`GRID_MIN`] or [`GRID_MAX`] bounds their
/// number.
const GRID_M: f64 = 0.02;
/// Maximum number of cells of the timing.
const GRID_MAX: usize = 1_000_000;
/// Curvature above which a cell of the timing is subdivided, per metre.
const SUBDIVIDED_CURVATURE_1_M: f64 = 1.0;
/// Number of parts of a subdivided cell.
const SUBDIVISIONS: u8 = 8;
/// Lower bound of the peak friction coefficient that is assumed on the approach to the trajectory
/// on unknown ground.
pub const TRACTION_LIMIT_UNKNOWN_MU: f64 = 0.14;
/// Minimum number of cells of the timing.
const GRID_MIN: usize = 16;

/// Options of a plan; none by default.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlanOptions<'map> {
    /// Speed on the approach to the trajectory, metres per second, above 0 and within the robot's
    /// limits; None for the trajectory's own.
    pub approach_speed_m_s: Option<f64>,
    /// Variation of the speed, so that θ can be measured without torque sensing.
    pub excitation: Option<ExcitationSpec>,
    /// Lower bound of the ground's peak friction coefficient, above zero, which limits
    /// accelerations. None leaves the robot's own limits (and [`TRACTION_LIMIT_UNKNOWN_MU`] on the
    /// approach).
    pub traction_limit_mu: Option<f64>,
    /// Lower bound of the peak friction coefficient by position; replaces `traction_limit_mu`. The
    /// geometry uses its minimum, the timing its value at each point.
    pub traction_limits: Option<&'map TractionLimitMap>,
}

impl PlanOptions<'_> {
    /// Returns the peak friction coefficient that the geometry assumes, or None if the ground is
    /// unknown.
    fn least_traction_limit_mu(&self) -> Option<f64> {
        self.traction_limits
            .map(TractionLimitMap::least)
            .or(self.traction_limit_mu)
    }
}

/// Plan at one time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlanSample {
    /// Pose and curvature at the arc length.
    pub path: PathSample,
    /// Arc length from the start, metres.
    pub arc_m: f64,
    /// Speed along the path, metres per second, ≥ 0.
    pub speed_m_s: f64,
    /// Acceleration along the path, metres per second squared.
    pub acceleration_m_s2: f64,
}

/// Geometry and timing of one trajectory with its approach.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    path: Path,
    profile: SpeedProfile,
    excitation: Option<Excitation>,
    approach_length_m: f64,
    traction_limit_is_known: bool,
    peak_speed_m_s: f64,
    peak_acceleration_m_s2: f64,
    peak_lateral_m_s2: f64,
    peak_angular_rad_s: f64,
    stretches: Stretches,
}

/// Requested speed from an arc length on.
struct SpeedFrom {
    arc_m: f64,
    speed_m_s: f64,
}

/// The robot to plan for.
#[derive(Clone, Copy)]
struct Models<'a> {
    /// With the least traction limit of the options applied.
    limited: &'a RobotModel,
    unlimited: &'a RobotModel,
}

impl Plan {
    /// Plans a trajectory from the pose of a stopped robot in the site frame, without options.
    ///
    /// # Errors
    /// [`PlanError`] names the invalid value or the sharp turn, with the waypoint's index.
    pub fn new(
        trajectory: &Trajectory,
        start: Pose,
        model: &RobotModel,
    ) -> Result<Self, PlanError> {
        Self::with_options(trajectory, start, model, &PlanOptions::default())
    }

    /// Plans a trajectory from the pose of a stopped robot in the site frame, with options.
    ///
    /// # Errors
    /// [`PlanError`] names the invalid value or the sharp turn, with the waypoint's index.
    pub fn with_options(
        trajectory: &Trajectory,
        start: Pose,
        model: &RobotModel,
        options: &PlanOptions<'_>,
    ) -> Result<Self, PlanError> {
        if let Some(speed_m_s) = options.approach_speed_m_s {
            check_speed(speed_m_s, None, model)?;
        }
        let limited = match options.least_traction_limit_mu() {
            Some(mu) if !(mu.is_finite() && mu > 0.0) => {
                return Err(PlanError::NotFinite {
                    what: PlanValue::TractionLimit,
                    waypoint: None,
                    value: mu,
                });
            }
            Some(mu) => model.within_traction_limit(mu),
            None => *model,
        };
        let models = Models {
            limited: &limited,
            unlimited: model,
        };
        check_coordinate(PlanValue::StartPose, None, start.point())?;
        if !start.heading_rad.is_finite() {
            return Err(PlanError::NotFinite {
                what: PlanValue::StartPose,
                waypoint: None,
                value: start.heading_rad,
            });
        }
        match trajectory {
            Trajectory::Circle(circle) => Self::circle(circle, start, models, options),
            Trajectory::Waypoints(waypoints) => Self::waypoints(waypoints, start, models, options),
        }
    }

    fn circle(
        circle: &CircleSpec,
        start: Pose,
        models: Models<'_>,
        options: &PlanOptions<'_>,
    ) -> Result<Self, PlanError> {
        let model = models.limited;
        check_coordinate(PlanValue::Center, None, circle.center)?;
        if !(circle.radius_m >= RADIUS_MIN_M && circle.radius_m <= COORDINATE_MAX_M) {
            return Err(PlanError::Radius(circle.radius_m));
        }
        if !(circle.turns > 0.0 && circle.turns.is_finite()) {
            return Err(PlanError::Turns(circle.turns));
        }
        check_speed(circle.speed_m_s, None, model)?;
        let length_m = std::f64::consts::TAU * circle.radius_m * circle.turns;
        if length_m > LENGTH_MAX_M {
            return Err(PlanError::TooLong(length_m));
        }
        let approach_m_s = options.approach_speed_m_s.unwrap_or(circle.speed_m_s);
        let target = CircleTarget {
            center: circle.center,
            radius_m: circle.radius_m,
            sign: circle.direction.sign(),
            speed_m_s: approach_m_s,
        };
        let (legs, join_rad) = join_circle(&target, start, &on_approach(model, options))
            .ok_or(PlanError::TooTight { waypoint: None })?;
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
        let path = Path::new(pieces).map_err(|_| PlanError::TooTight { waypoint: None })?;
        let speeds = [
            SpeedFrom {
                arc_m: 0.0,
                speed_m_s: approach_m_s,
            },
            SpeedFrom {
                arc_m: path.piece_start_m(approach_pieces),
                speed_m_s: circle.speed_m_s,
            },
        ];
        Self::timed(path, &speeds, approach_pieces, models, options)
    }

    fn waypoints(
        spec: &WaypointsSpec,
        start: Pose,
        models: Models<'_>,
        options: &PlanOptions<'_>,
    ) -> Result<Self, PlanError> {
        let model = models.limited;
        let points = &spec.points;
        if points.len() < 2 {
            return Err(PlanError::TooFewWaypoints(points.len()));
        }
        if points.len() > WAYPOINTS_MAX {
            return Err(PlanError::TooManyWaypoints(points.len()));
        }
        check_speed(spec.speed_m_s, None, model)?;
        for (place, waypoint) in points.iter().enumerate() {
            check_coordinate(PlanValue::Position, Some(place), waypoint.point)?;
            if let Some(heading_rad) = waypoint.heading_rad.filter(|value| !value.is_finite()) {
                return Err(PlanError::NotFinite {
                    what: PlanValue::Heading,
                    waypoint: Some(place),
                    value: heading_rad,
                });
            }
            if let Some(speed_m_s) = waypoint.speed_m_s {
                check_speed(speed_m_s, Some(place), model)?;
            }
            if place > 0
                && points[place - 1].point.distance_m(waypoint.point) < WAYPOINT_SPACING_MIN_M
            {
                return Err(PlanError::DuplicateWaypoint { waypoint: place });
            }
        }
        // Waypoints at the robot's position are skipped; the last waypoint is never skipped.
        let first = points[..points.len() - 1]
            .iter()
            .take_while(|waypoint| waypoint.point.distance_m(start.point()) < ON_START_M)
            .count();
        if points[first].point.distance_m(start.point()) < WAYPOINT_SPACING_MIN_M {
            return Err(PlanError::DuplicateWaypoint { waypoint: first });
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
                waypoint: Some((piece + first).saturating_sub(1)),
            },
        };
        let mut approach_pieces = usize::from(first == 0);
        let path = if first == 0
            && let Some((path, legs)) =
                leg_and_spline(&knots, start, spec.speed_m_s, &on_approach(model, options))
        {
            approach_pieces = legs;
            path
        } else {
            // The robot's position is the first knot: it is on the path, or too near for a leg.
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
            spline_from_robot(&mut knots, start, spec.speed_m_s, model).map_err(too_tight)?
        };
        // Index of the waypoint at which a piece starts; 0 for the approach.
        let place_of = |piece: usize| (piece + first).saturating_sub(approach_pieces.max(1));
        let mut speeds = vec![SpeedFrom {
            arc_m: 0.0,
            speed_m_s: spec.speed_m_s,
        }];
        for piece in 0..path.piece_count() {
            let requested = if piece >= approach_pieces {
                points[place_of(piece)].speed_m_s
            } else {
                options.approach_speed_m_s
            };
            speeds.push(SpeedFrom {
                arc_m: path.piece_start_m(piece),
                speed_m_s: requested.unwrap_or(spec.speed_m_s),
            });
        }
        Self::timed(path, &speeds, approach_pieces, models, options)
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
        Models {
            limited: model,
            unlimited,
        }: Models<'_>,
        options: &PlanOptions<'_>,
    ) -> Result<Self, PlanError> {
        let length_m = path.length_m();
        if length_m > LENGTH_MAX_M {
            return Err(PlanError::TooLong(length_m));
        }
        let cells = ((length_m / GRID_M).ceil() as usize).clamp(GRID_MIN, GRID_MAX);
        let cell_m = length_m / cells as f64;
        let mut requested = 0;
        let binding = BindingLimits::of(model, options.traction_limit_mu);
        let mut bounds: Vec<NodeBounds> = Vec::with_capacity(cells + 1);
        let mut requested_m_s = Vec::with_capacity(cells + 1);
        let mut bend_before_1_m = 0.0;
        let approach_end_m = path.piece_start_m(approach_pieces);
        let cautious = on_approach(model, options);
        let cautious_mu = options
            .traction_limit_mu
            .unwrap_or(TRACTION_LIMIT_UNKNOWN_MU);
        let cautious_binding = BindingLimits::of(&cautious, Some(cautious_mu));
        for index in 0..=cells {
            let arc_m = cell_m * index as f64;
            while speeds
                .get(requested + 1)
                .is_some_and(|next| next.arc_m <= arc_m)
            {
                requested += 1;
            }
            let speed_m_s = speeds[requested].speed_m_s;
            let here = path.sample(arc_m);
            let placed;
            let (model, binding) = if let Some(traction_limit) = options.traction_limits {
                let mu = traction_limit.at(here.pose.point());
                placed = unlimited.within_traction_limit(mu);
                (&placed, BindingLimits::of(&placed, Some(mu)))
            } else if arc_m < approach_end_m {
                (&cautious, cautious_binding)
            } else {
                (model, binding)
            };
            let shares = Shares::on(arc_m < approach_end_m);
            let mut node = node_limits(&here, speed_m_s, model, binding, shares);
            let bend_1_m = here.curvature_1_m.abs();
            // A sharp bend may have its peak between two nodes: the limits in between apply to
            // both.
            if bend_1_m.max(bend_before_1_m) > SUBDIVIDED_CURVATURE_1_M
                && let Some(before) = bounds.last_mut()
            {
                for part in 1..SUBDIVISIONS {
                    let back_m = cell_m * f64::from(part) / f64::from(SUBDIVISIONS);
                    let between = path.sample(arc_m - back_m);
                    let between = node_limits(&between, speed_m_s, model, binding, shares);
                    *before = before.stricter(&between);
                    node = node.stricter(&between);
                }
            }
            bend_before_1_m = bend_1_m;
            bounds.push(node);
            requested_m_s.push(speed_m_s);
        }
        let mut nodes: Vec<NodeLimits> = bounds.iter().map(|node| node.limits).collect();
        let mut jerk_m_s3 = model.limits().linear_jerk_max_m_s3;
        let excitation = match options.excitation {
            Some(spec) => Some(with_excitation(spec, &mut nodes, &mut jerk_m_s3)?),
            None => None,
        };
        // On unknown ground the approach is already bounded by a cautious traction limit, so its
        // limits apply within the averaging time T only (see `profile`).
        let time_limited_nodes = match options.least_traction_limit_mu() {
            Some(_) => 0,
            None => (approach_end_m / cell_m).ceil() as usize,
        };
        let profile = SpeedProfile::new(&ProfileInput {
            length_m,
            limits: &nodes,
            time_limited_nodes,
            jerk_max_m_s3: jerk_m_s3,
        });
        let mut plan = Self {
            excitation,
            approach_length_m: path.piece_start_m(approach_pieces),
            traction_limit_is_known: options.least_traction_limit_mu().is_some(),
            path,
            profile,
            peak_speed_m_s: 0.0,
            peak_acceleration_m_s2: 0.0,
            peak_lateral_m_s2: 0.0,
            peak_angular_rad_s: 0.0,
            stretches: Stretches::default(),
        };
        let steps = (plan.duration_s() / 0.05).ceil().min(GRID_MAX as f64) as usize + 1;
        for step in 0..=steps {
            let share = step as f64 / steps as f64;
            plan.update_peaks(plan.duration_s() * share);
            // A requested excitation does not count as slowing, so the timing without it is
            // checked.
            let timing = plan.profile.sample(plan.profile.duration_s() * share);
            let node = ((timing.arc_m / cell_m) as usize).min(cells);
            let cell = CellBounds {
                requested_m_s: requested_m_s[node],
                allowed_m_s: nodes[node].speed_m_s,
                by: bounds[node].by,
                longitudinal: bounds[node].longitudinal,
            };
            plan.stretches.record(&timing, &cell);
        }
        Ok(plan)
    }

    /// Raises the peak values to those at a time, seconds.
    fn update_peaks(&mut self, time_s: f64) {
        let sample = self.sample(time_s);
        let turn_rad_s = (sample.speed_m_s * sample.path.curvature_1_m).abs();
        self.peak_speed_m_s = self.peak_speed_m_s.max(sample.speed_m_s);
        self.peak_acceleration_m_s2 = self
            .peak_acceleration_m_s2
            .max(sample.acceleration_m_s2.abs());
        self.peak_lateral_m_s2 = self.peak_lateral_m_s2.max(turn_rad_s * sample.speed_m_s);
        self.peak_angular_rad_s = self.peak_angular_rad_s.max(turn_rad_s);
    }

    /// Returns the plan at a time since its start, seconds; before 0 and after the end the speed is
    /// zero.
    pub fn sample(&self, time_s: f64) -> PlanSample {
        let plan_time = self.excitation.map_or(
            PlanTime {
                plan_s: time_s,
                rate: 1.0,
                rate_slope_1_s: 0.0,
            },
            |excitation| excitation.plan_time(time_s),
        );
        let timing = self.profile.sample(plan_time.plan_s);
        PlanSample {
            path: self.path.sample(timing.arc_m),
            arc_m: timing.arc_m,
            speed_m_s: plan_time.rate * timing.speed_m_s,
            acceleration_m_s2: plan_time.rate * plan_time.rate * timing.acceleration_m_s2
                + plan_time.rate_slope_1_s * timing.speed_m_s,
        }
    }

    /// Returns the stretches on which a limit keeps the speed below the requested one, in driving
    /// order; at most [`SLOWED_MAX`].
    pub fn slowed(&self) -> &[Slowed] {
        self.stretches.as_slice()
    }

    /// Returns the excitation, if there is one, with its depth as reduced by the limits.
    pub fn excitation(&self) -> Option<&Excitation> {
        self.excitation.as_ref()
    }

    /// Returns the geometry without timing.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the length of the path including the approach, metres.
    pub fn length_m(&self) -> f64 {
        self.path.length_m()
    }

    /// Returns the length of the approach to the circle or the first waypoint, metres.
    pub fn approach_length_m(&self) -> f64 {
        self.approach_length_m
    }

    /// Returns the peak friction coefficient assumed on the approach, or None if the ground is
    /// known.
    pub(crate) fn assumed_mu(&self) -> Option<f64> {
        (!self.traction_limit_is_known).then_some(TRACTION_LIMIT_UNKNOWN_MU)
    }

    /// Returns the time from start to end, seconds, with excitation but without an initial turn on
    /// the spot, and without any delay by the governor.
    pub fn duration_s(&self) -> f64 {
        let own_s = self.profile.duration_s();
        self.excitation
            .map_or(own_s, |excitation| excitation.time_s(own_s))
    }

    /// Returns the heading of the path at its start, radians counter-clockwise from x.
    pub fn start_heading_rad(&self) -> f64 {
        self.path.sample(0.0).pose.heading_rad
    }

    /// Returns the maximum speed along the path, metres per second.
    pub fn peak_speed_m_s(&self) -> f64 {
        self.peak_speed_m_s
    }

    /// Returns the maximum magnitude of acceleration along the path, metres per second squared.
    pub fn peak_acceleration_m_s2(&self) -> f64 {
        self.peak_acceleration_m_s2
    }

    /// Returns the maximum magnitude of lateral acceleration, metres per second squared.
    pub fn peak_lateral_acceleration_m_s2(&self) -> f64 {
        self.peak_lateral_m_s2
    }

    /// Returns the maximum magnitude of the turn rate, radians per second.
    pub fn peak_angular_rad_s(&self) -> f64 {
        self.peak_angular_rad_s
    }
}

fn check_coordinate(
    what: PlanValue,
    waypoint: Option<usize>,
    point: Point,
) -> Result<(), PlanError> {
    for value in [point.x_m, point.y_m] {
        if !value.is_finite() || value.abs() > COORDINATE_MAX_M {
            return Err(PlanError::NotFinite {
                what,
                waypoint,
                value,
            });
        }
    }
    Ok(())
}

/// Returns the robot with the limits of the approach to the trajectory.
fn on_approach(model: &RobotModel, options: &PlanOptions<'_>) -> RobotModel {
    match options.least_traction_limit_mu() {
        // The limits already include the traction limit.
        Some(_) => *model,
        None => model.within_traction_limit(TRACTION_LIMIT_UNKNOWN_MU),
    }
}

fn check_speed(
    speed_m_s: f64,
    waypoint: Option<usize>,
    model: &RobotModel,
) -> Result<(), PlanError> {
    if !speed_m_s.is_finite() {
        return Err(PlanError::NotFinite {
            what: PlanValue::Speed,
            waypoint,
            value: speed_m_s,
        });
    }
    if speed_m_s <= 0.0 {
        return Err(PlanError::SpeedNotPositive {
            waypoint,
            speed_m_s,
        });
    }
    let limits = model.limits();
    let rim_max_m_s = WHEEL_SHARE * limits.wheel_speed_max_rad_s * model.wheel_radius_m();
    let limit_m_s = limits.linear_max_m_s.min(rim_max_m_s);
    if speed_m_s > limit_m_s {
        return Err(PlanError::SpeedAboveLimit {
            waypoint,
            speed_m_s,
            limit_m_s,
        });
    }
    Ok(())
}
