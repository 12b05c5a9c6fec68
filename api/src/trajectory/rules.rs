//! What makes a trajectory possible: every field is checked where it is read.

use serde::Deserialize;

use super::{
    Circle, Direction, EXCITATION_DEPTH_MAX, EXCITATION_PERIOD_MAX_S, EXCITATION_PERIOD_MIN_S,
    RADIUS_MAX_M, RADIUS_MIN_M, SPEED_MAX_M_S, SPEED_MIN_M_S, TURNS_MAX, TURNS_MIN, Trajectory,
    TrajectoryOptions, WAYPOINT_SPACING_MIN_M, WAYPOINTS_MAX, WAYPOINTS_MIN, Waypoint, Waypoints,
    one_turn,
};
use crate::geometry::{COORDINATE_MAX_M, Point};

/// Why a trajectory cannot be driven by any robot.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum InvalidTrajectory {
    /// The radius is not within [`RADIUS_MIN_M`] to [`RADIUS_MAX_M`].
    #[error("radius_m must be {RADIUS_MIN_M} to {RADIUS_MAX_M}, not {0}")]
    Radius(f64),
    /// The turns are not within [`TURNS_MIN`] to [`TURNS_MAX`].
    #[error("turns must be {TURNS_MIN} to {TURNS_MAX}, not {0}")]
    Turns(f64),
    /// Neither or both of speed and period were given.
    #[error("give either speed_m_s or period_s")]
    SpeedOrPeriod,
    /// The speed is not within [`SPEED_MIN_M_S`] to [`SPEED_MAX_M_S`].
    #[error("the speed must be {SPEED_MIN_M_S} to {SPEED_MAX_M_S} m/s, not {0}")]
    Speed(f64),
    /// A point's own speed is out of range.
    #[error(
        "points[{index}].speed_m_s must be {SPEED_MIN_M_S} to {SPEED_MAX_M_S}, not {speed_m_s}"
    )]
    PointSpeed {
        /// Which point, from 0.
        index: usize,
        /// The speed that was given.
        speed_m_s: f64,
    },
    /// The centre is not finite or too far out.
    #[error("the centre must be within {COORDINATE_MAX_M} m of the origin")]
    Center,
    /// Too few or too many points.
    #[error("a path has {WAYPOINTS_MIN} to {WAYPOINTS_MAX} points, this one has {0}")]
    PointCount(usize),
    /// The speed on the approach to the trajectory is out of range.
    #[error("approach_speed_m_s must be {SPEED_MIN_M_S} to {SPEED_MAX_M_S}, not {0}")]
    ApproachSpeed(f64),
    /// The excitation's depth is out of range.
    #[error("excitation.depth_ratio must be above 0, at most {EXCITATION_DEPTH_MAX}, not {0}")]
    ExcitationDepth(f64),
    /// The excitation's period is out of range.
    #[error(
        "excitation.period_s must be {EXCITATION_PERIOD_MIN_S} to {EXCITATION_PERIOD_MAX_S}, not {0}"
    )]
    ExcitationPeriod(f64),
    /// A point is not finite or too far out.
    #[error("points[{0}] must be within {COORDINATE_MAX_M} m of the origin")]
    PointOffTheMap(usize),
    /// A point's heading is not finite.
    #[error("points[{0}].heading_rad must be a finite number")]
    PointHeading(usize),
    /// A point repeats the one before it.
    #[error(
        "points[{0}] repeats the point before it; keep neighbours {WAYPOINT_SPACING_MIN_M} m apart"
    )]
    DuplicatePoint(usize),
}

pub(super) fn is_speed(speed_m_s: f64) -> bool {
    (SPEED_MIN_M_S..=SPEED_MAX_M_S).contains(&speed_m_s)
}

impl Circle {
    /// Checks every field.
    ///
    /// # Errors
    /// [`InvalidTrajectory`] names the field that is out of range.
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
    /// Checks every point.
    ///
    /// # Errors
    /// [`InvalidTrajectory`] names the first point that is out of range or doubled.
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
    /// What the robot may do beside following it.
    pub fn options(&self) -> TrajectoryOptions {
        match self {
            Self::Circle(circle) => circle.options,
            Self::Waypoints(waypoints) => waypoints.options,
        }
    }

    /// The fastest speed that is asked for anywhere, metres per second.
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
