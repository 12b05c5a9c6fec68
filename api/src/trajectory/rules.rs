//! Validity rules of trajectories, applied to every field when a trajectory is read.

use serde::Deserialize;

use super::{
    Circle, Direction, EXCITATION_DEPTH_MAX, EXCITATION_PERIOD_MAX_S, EXCITATION_PERIOD_MIN_S,
    RADIUS_MAX_M, RADIUS_MIN_M, SPEED_MAX_M_S, SPEED_MIN_M_S, TURNS_MAX, TURNS_MIN, Trajectory,
    TrajectoryOptions, WAYPOINT_SPACING_MIN_M, WAYPOINTS_MAX, WAYPOINTS_MIN, Waypoint, Waypoints,
    one_turn,
};
use crate::geometry::{COORDINATE_MAX_M, Point};

/// Reason why a trajectory is invalid for every robot.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InvalidTrajectory {
    /// The radius is outside [`RADIUS_MIN_M`] to [`RADIUS_MAX_M`].
    #[error("radius_m must be {RADIUS_MIN_M} to {RADIUS_MAX_M}, not {0}")]
    Radius(f64),
    /// The number of turns is outside [`TURNS_MIN`] to [`TURNS_MAX`].
    #[error("turns must be {TURNS_MIN} to {TURNS_MAX}, not {0}")]
    Turns(f64),
    /// Neither or both of speed and period are given.
    #[error("give either speed_m_s or period_s")]
    SpeedOrPeriod,
    /// The speed is outside [`SPEED_MIN_M_S`] to [`SPEED_MAX_M_S`].
    #[error("the speed must be {SPEED_MIN_M_S} to {SPEED_MAX_M_S} m/s, not {0}")]
    Speed(f64),
    /// The speed of a point is outside [`SPEED_MIN_M_S`] to [`SPEED_MAX_M_S`].
    #[error(
        "points[{index}].speed_m_s must be {SPEED_MIN_M_S} to {SPEED_MAX_M_S}, not {speed_m_s}"
    )]
    PointSpeed {
        /// Index of the point, from 0.
        index: usize,
        /// Given speed, m/s.
        speed_m_s: f64,
    },
    /// The centre is not finite or beyond [`COORDINATE_MAX_M`].
    #[error("the centre must be within {COORDINATE_MAX_M} m of the origin")]
    Center,
    /// There are fewer than [`WAYPOINTS_MIN`] or more than [`WAYPOINTS_MAX`] points.
    #[error("a path has {WAYPOINTS_MIN} to {WAYPOINTS_MAX} points, this one has {0}")]
    PointCount(usize),
    /// The approach speed is outside [`SPEED_MIN_M_S`] to [`SPEED_MAX_M_S`].
    #[error("approach_speed_m_s must be {SPEED_MIN_M_S} to {SPEED_MAX_M_S}, not {0}")]
    ApproachSpeed(f64),
    /// The depth of the excitation is not above 0 and at most [`EXCITATION_DEPTH_MAX`].
    #[error("excitation.depth_ratio must be above 0, at most {EXCITATION_DEPTH_MAX}, not {0}")]
    ExcitationDepth(f64),
    /// The period of the excitation is outside [`EXCITATION_PERIOD_MIN_S`] to
    /// [`EXCITATION_PERIOD_MAX_S`].
    #[error(
        "excitation.period_s must be {EXCITATION_PERIOD_MIN_S} to {EXCITATION_PERIOD_MAX_S}, not {0}"
    )]
    ExcitationPeriod(f64),
    /// The expected start is beyond [`COORDINATE_MAX_M`], or its heading is beyond ±2π.
    #[error(
        "expected_start must be within {COORDINATE_MAX_M} m of the origin, its heading within 2 pi"
    )]
    ExpectedStart,
    /// A point is not finite or beyond [`COORDINATE_MAX_M`].
    #[error("points[{0}] must be within {COORDINATE_MAX_M} m of the origin")]
    PointOffTheMap(usize),
    /// The heading of a point is not finite.
    #[error("points[{0}].heading_rad must be a finite number")]
    PointHeading(usize),
    /// A point is closer to the point before it than [`WAYPOINT_SPACING_MIN_M`].
    #[error(
        "points[{0}] repeats the point before it; keep neighbours {WAYPOINT_SPACING_MIN_M} m apart"
    )]
    DuplicatePoint(usize),
}

pub(super) fn is_speed(speed_m_s: f64) -> bool {
    (SPEED_MIN_M_S..=SPEED_MAX_M_S).contains(&speed_m_s)
}

impl Circle {
    /// Checks that every field is within its range.
    ///
    /// # Errors
    /// [`InvalidTrajectory`] names the first field that is not.
    pub fn validate(&self) -> Result<(), InvalidTrajectory> {
        if !self.center.is_on_the_map() {
            return Err(InvalidTrajectory::Center);
        }
        if !(RADIUS_MIN_M..=RADIUS_MAX_M).contains(&self.radius_m) {
            return Err(InvalidTrajectory::Radius(self.radius_m));
        }
        if !(TURNS_MIN..=TURNS_MAX).contains(&self.turns) {
            return Err(InvalidTrajectory::Turns(self.turns));
        }
        if self.speed_m_s.is_some() == self.period_s.is_some() {
            return Err(InvalidTrajectory::SpeedOrPeriod);
        }
        let speed_m_s = self.speed_m_s();
        if !is_speed(speed_m_s) {
            return Err(InvalidTrajectory::Speed(speed_m_s));
        }
        self.options.validate()
    }
}

impl Waypoints {
    /// Checks that every field and every point is within its range.
    ///
    /// # Errors
    /// [`InvalidTrajectory`] names the first point that is out of range or a duplicate.
    pub fn validate(&self) -> Result<(), InvalidTrajectory> {
        let count = self.points.len();
        if !(WAYPOINTS_MIN..=WAYPOINTS_MAX).contains(&count) {
            return Err(InvalidTrajectory::PointCount(count));
        }
        if !is_speed(self.speed_m_s) {
            return Err(InvalidTrajectory::Speed(self.speed_m_s));
        }
        let mut previous: Option<Point> = None;
        for (index, point) in self.points.iter().enumerate() {
            let position = point.position();
            if !position.is_on_the_map() {
                return Err(InvalidTrajectory::PointOffTheMap(index));
            }
            if point
                .heading_rad
                .is_some_and(|heading_rad| !heading_rad.is_finite())
            {
                return Err(InvalidTrajectory::PointHeading(index));
            }
            if let Some(speed_m_s) = point.speed_m_s.filter(|&speed_m_s| !is_speed(speed_m_s)) {
                return Err(InvalidTrajectory::PointSpeed { index, speed_m_s });
            }
            let near = |before: Point| before.distance_m(position) < WAYPOINT_SPACING_MIN_M;
            if previous.is_some_and(near) {
                return Err(InvalidTrajectory::DuplicatePoint(index));
            }
            previous = Some(position);
        }
        self.options.validate()
    }
}

impl Trajectory {
    /// Returns the options of the trajectory.
    pub fn options(&self) -> TrajectoryOptions {
        match self {
            Self::Circle(circle) => circle.options,
            Self::Waypoints(waypoints) => waypoints.options,
        }
    }

    /// Returns the maximum requested speed, including the approach, m/s.
    pub fn speed_max_m_s(&self) -> f64 {
        let on_it = match self {
            Self::Circle(circle) => circle.speed_m_s(),
            Self::Waypoints(waypoints) => waypoints
                .points
                .iter()
                .filter_map(|point| point.speed_m_s)
                .fold(waypoints.speed_m_s, f64::max),
        };
        on_it.max(self.options().approach_speed_m_s.unwrap_or(0.0))
    }
}

#[derive(Deserialize)]
pub(super) struct CircleFields {
    center: Point,
    radius_m: f64,
    #[serde(default)]
    speed_m_s: Option<f64>,
    #[serde(default)]
    period_s: Option<f64>,
    #[serde(default)]
    direction: Direction,
    #[serde(default = "one_turn")]
    turns: f64,
    #[serde(default)]
    options: TrajectoryOptions,
}

impl TryFrom<CircleFields> for Circle {
    type Error = InvalidTrajectory;

    fn try_from(fields: CircleFields) -> Result<Self, InvalidTrajectory> {
        let CircleFields {
            center,
            radius_m,
            speed_m_s,
            period_s,
            direction,
            turns,
            options,
        } = fields;
        let circle = Self {
            center,
            radius_m,
            speed_m_s,
            period_s,
            direction,
            turns,
            options,
        };
        circle.validate()?;
        Ok(circle)
    }
}

#[derive(Deserialize)]
pub(super) struct WaypointsFields {
    points: Vec<Waypoint>,
    speed_m_s: f64,
    #[serde(default)]
    options: TrajectoryOptions,
}

impl TryFrom<WaypointsFields> for Waypoints {
    type Error = InvalidTrajectory;

    fn try_from(fields: WaypointsFields) -> Result<Self, InvalidTrajectory> {
        let WaypointsFields {
            points,
            speed_m_s,
            options,
        } = fields;
        let waypoints = Self {
            points,
            speed_m_s,
            options,
        };
        waypoints.validate()?;
        Ok(waypoints)
    }
}
