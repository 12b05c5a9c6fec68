//! Validity rules of trajectories, applied to every field when a trajectory is read.
//!
//! A rule about one field is applied while that field is read, so that the parser's error has the
//! field's path.

use std::f64::consts::TAU;
use std::fmt;

use serde::de::{DeserializeSeed, Error as _, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::{
    Circle, Direction, EXCITATION_DEPTH_MAX, EXCITATION_PERIOD_MAX_S, EXCITATION_PERIOD_MIN_S,
    RADIUS_MAX_M, RADIUS_MIN_M, SPEED_MAX_M_S, SPEED_MIN_M_S, TURNS_MAX, TURNS_MIN, Trajectory,
    TrajectoryOptions, WAYPOINT_SPACING_MIN_M, WAYPOINTS_MAX, WAYPOINTS_MIN, Waypoint, Waypoints,
    one_turn,
};
use crate::geometry::{COORDINATE_MAX_M, Point, Pose};

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

fn is_speed(speed_m_s: f64) -> bool {
    (SPEED_MIN_M_S..=SPEED_MAX_M_S).contains(&speed_m_s)
}

fn check_center(center: Point) -> Result<(), InvalidTrajectory> {
    if center.is_on_the_map() {
        Ok(())
    } else {
        Err(InvalidTrajectory::Center)
    }
}

fn check_radius(radius_m: f64) -> Result<(), InvalidTrajectory> {
    if (RADIUS_MIN_M..=RADIUS_MAX_M).contains(&radius_m) {
        Ok(())
    } else {
        Err(InvalidTrajectory::Radius(radius_m))
    }
}

fn check_turns(turns: f64) -> Result<(), InvalidTrajectory> {
    if (TURNS_MIN..=TURNS_MAX).contains(&turns) {
        Ok(())
    } else {
        Err(InvalidTrajectory::Turns(turns))
    }
}

fn check_speed(speed_m_s: f64) -> Result<(), InvalidTrajectory> {
    if is_speed(speed_m_s) {
        Ok(())
    } else {
        Err(InvalidTrajectory::Speed(speed_m_s))
    }
}

fn check_given_speed(speed_m_s: Option<f64>) -> Result<(), InvalidTrajectory> {
    speed_m_s.map_or(Ok(()), check_speed)
}

pub(super) fn check_approach_speed(speed_m_s: Option<f64>) -> Result<(), InvalidTrajectory> {
    match speed_m_s.filter(|&speed_m_s| !is_speed(speed_m_s)) {
        Some(speed_m_s) => Err(InvalidTrajectory::ApproachSpeed(speed_m_s)),
        None => Ok(()),
    }
}

pub(super) fn check_expected_start(start: Option<Pose>) -> Result<(), InvalidTrajectory> {
    let is_pose = |pose: Pose| pose.position().is_on_the_map() && pose.heading_rad.abs() <= TAU;
    if start.is_none_or(is_pose) {
        Ok(())
    } else {
        Err(InvalidTrajectory::ExpectedStart)
    }
}

pub(super) fn check_excitation_depth(depth_ratio: f64) -> Result<(), InvalidTrajectory> {
    if depth_ratio > 0.0 && depth_ratio <= EXCITATION_DEPTH_MAX {
        Ok(())
    } else {
        Err(InvalidTrajectory::ExcitationDepth(depth_ratio))
    }
}

pub(super) fn check_excitation_period(period_s: f64) -> Result<(), InvalidTrajectory> {
    if (EXCITATION_PERIOD_MIN_S..=EXCITATION_PERIOD_MAX_S).contains(&period_s) {
        Ok(())
    } else {
        Err(InvalidTrajectory::ExcitationPeriod(period_s))
    }
}

impl Waypoint {
    /// Checks this point of a path; `before` are all points before it.
    fn check_after(&self, before: &[Self]) -> Result<(), InvalidTrajectory> {
        let index = before.len();
        let position = self.position();
        if !position.is_on_the_map() {
            return Err(InvalidTrajectory::PointOffTheMap(index));
        }
        if self
            .heading_rad
            .is_some_and(|heading_rad| !heading_rad.is_finite())
        {
            return Err(InvalidTrajectory::PointHeading(index));
        }
        if let Some(speed_m_s) = self.speed_m_s.filter(|&speed_m_s| !is_speed(speed_m_s)) {
            return Err(InvalidTrajectory::PointSpeed { index, speed_m_s });
        }
        let is_near =
            |previous: &Self| previous.position().distance_m(position) < WAYPOINT_SPACING_MIN_M;
        if before.last().is_some_and(is_near) {
            return Err(InvalidTrajectory::DuplicatePoint(index));
        }
        Ok(())
    }
}

impl Circle {
    /// Checks that every field is within its range.
    ///
    /// # Errors
    /// [`InvalidTrajectory`] names the first field that is not.
    pub fn validate(&self) -> Result<(), InvalidTrajectory> {
        check_center(self.center)?;
        check_radius(self.radius_m)?;
        check_turns(self.turns)?;
        if self.speed_m_s.is_some() == self.period_s.is_some() {
            return Err(InvalidTrajectory::SpeedOrPeriod);
        }
        check_speed(self.speed_m_s())?;
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
        check_speed(self.speed_m_s)?;
        for (index, point) in self.points.iter().enumerate() {
            point.check_after(&self.points[..index])?;
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
}

/// Reads a value that a check allows.
fn checked<'de, D, T>(
    deserializer: D,
    check: impl FnOnce(T) -> Result<(), InvalidTrajectory>,
) -> Result<T, D::Error>
where
    D: Deserializer<'de>,
    T: Deserialize<'de> + Copy,
{
    let value = T::deserialize(deserializer)?;
    check(value).map_err(D::Error::custom)?;
    Ok(value)
}

fn read_center<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Point, D::Error> {
    checked(deserializer, check_center)
}

fn read_radius<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    checked(deserializer, check_radius)
}

fn read_turns<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    checked(deserializer, check_turns)
}

fn read_speed<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    checked(deserializer, check_speed)
}

fn read_given_speed<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    checked(deserializer, check_given_speed)
}

pub(super) fn read_approach_speed<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<f64>, D::Error> {
    checked(deserializer, check_approach_speed)
}

pub(super) fn read_expected_start<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Option<Pose>, D::Error> {
    checked(deserializer, check_expected_start)
}

pub(super) fn read_excitation_depth<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<f64, D::Error> {
    checked(deserializer, check_excitation_depth)
}

pub(super) fn read_excitation_period<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<f64, D::Error> {
    checked(deserializer, check_excitation_period)
}

/// Reads the points of a path one by one.
fn read_points<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Waypoint>, D::Error> {
    deserializer.deserialize_seq(Points)
}

/// Points of a path, each of which is checked as it is read.
struct Points;

impl<'de> Visitor<'de> for Points {
    type Value = Vec<Waypoint>;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a sequence")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut sequence: A) -> Result<Vec<Waypoint>, A::Error> {
        let mut points: Vec<Waypoint> = Vec::new();
        while let Some(point) = sequence.next_element_seed(NextPoint { before: &points })? {
            points.push(point);
        }
        Ok(points)
    }
}

/// The point of a path that follows these.
struct NextPoint<'a> {
    before: &'a [Waypoint],
}

impl<'de> DeserializeSeed<'de> for NextPoint<'_> {
    type Value = Waypoint;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Waypoint, D::Error> {
        let point = Waypoint::deserialize(deserializer)?;
        point.check_after(self.before).map_err(D::Error::custom)?;
        Ok(point)
    }
}

#[derive(Deserialize)]
pub(super) struct CircleFields {
    #[serde(deserialize_with = "read_center")]
    center: Point,
    #[serde(deserialize_with = "read_radius")]
    radius_m: f64,
    #[serde(default, deserialize_with = "read_given_speed")]
    speed_m_s: Option<f64>,
    #[serde(default)]
    period_s: Option<f64>,
    #[serde(default)]
    direction: Direction,
    #[serde(default = "one_turn", deserialize_with = "read_turns")]
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
    #[serde(deserialize_with = "read_points")]
    points: Vec<Waypoint>,
    #[serde(deserialize_with = "read_speed")]
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
