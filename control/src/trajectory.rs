//! Trajectories that a user requests: a circle or waypoints.

use serde::{Deserialize, Serialize};

use crate::geometry::Point;

/// Direction of travel around a circle, seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// The heading increases.
    #[default]
    CounterClockwise,
    /// The heading decreases.
    Clockwise,
}

impl Direction {
    /// Returns +1 for counter-clockwise, −1 for clockwise.
    pub fn sign(self) -> f64 {
        match self {
            Self::CounterClockwise => 1.0,
            Self::Clockwise => -1.0,
        }
    }
}

/// Request to drive around a circle, starting where the robot joins it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CircleSpec {
    /// Centre in the site frame.
    pub center: Point,
    /// Radius, metres, [`crate::path::RADIUS_MIN_M`] to [`crate::plan::COORDINATE_MAX_M`].
    pub radius_m: f64,
    /// Speed along the circle, metres per second.
    pub speed_m_s: f64,
    /// Direction of travel.
    pub direction: Direction,
    /// Number of turns, above zero, not necessarily whole.
    pub turns: f64,
}

/// One point of a waypoint path.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Waypoint {
    /// Position in the site frame.
    pub point: Point,
    /// Speed from here to the next point, metres per second; None for [`WaypointsSpec::speed_m_s`].
    pub speed_m_s: Option<f64>,
    /// Direction of the path at this point, any finite angle, radians counter-clockwise from x; the
    /// robot's heading differs from it by the sideslip. None leaves it free.
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

/// Request to drive a smooth path through points without stopping at them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WaypointsSpec {
    /// Points in driving order, 2 to [`crate::plan::WAYPOINTS_MAX`].
    pub points: Vec<Waypoint>,
    /// Speed from points without a speed of their own, metres per second.
    pub speed_m_s: f64,
}

/// Trajectory that a user requests.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Trajectory {
    /// Circle.
    Circle(CircleSpec),
    /// Smooth path through points.
    Waypoints(WaypointsSpec),
}
