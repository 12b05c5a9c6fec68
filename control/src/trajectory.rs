//! What a robot is asked to drive: a circle or waypoints.

use serde::{Deserialize, Serialize};

use crate::geometry::Point;

/// Which way round a circle is driven, seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// The heading grows.
    #[default]
    CounterClockwise,
    /// The heading falls.
    Clockwise,
}

impl Direction {
    /// +1 counter-clockwise, −1 clockwise.
    pub fn sign(self) -> f64 {
        match self {
            Self::CounterClockwise => 1.0,
            Self::Clockwise => -1.0,
        }
    }
}

/// Turns on a circle, counted from where the robot joins it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CircleSpec {
    /// The circle's centre.
    pub center: Point,
    /// Radius, metres, at least [`crate::path::RADIUS_MIN_M`].
    pub radius_m: f64,
    /// Speed along the circle, metres per second.
    pub speed_m_s: f64,
    /// Which way round.
    pub direction: Direction,
    /// How many turns, above zero.
    pub turns: f64,
}

/// One point of a waypoint path.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Waypoint {
    /// Where.
    pub point: Point,
    /// Speed from here to the next point, metres per second; the path's own when absent.
    pub speed_m_s: Option<f64>,
    /// Direction of the path here, radians; free when absent.
    pub heading_rad: Option<f64>,
}

impl From<Point> for Waypoint {
    fn from(point: Point) -> Self {
        Self {
            point,
            speed_m_s: None,
            heading_rad: None,
        }
    }
}

/// A smooth path through points, driven without stopping at them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WaypointsSpec {
    /// The points in driving order, 2 to [`crate::plan::WAYPOINTS_MAX`].
    pub points: Vec<Waypoint>,
    /// Speed wherever a point does not say otherwise, metres per second.
    pub speed_m_s: f64,
}

/// What a robot is asked to drive.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Trajectory {
    /// Turns on a circle.
    Circle(CircleSpec),
    /// A smooth path through points.
    Waypoints(WaypointsSpec),
}
