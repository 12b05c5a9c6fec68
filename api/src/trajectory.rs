//! What a user asks a robot to drive: a circle or waypoints.

mod check;
mod rules;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

pub use self::check::{
    BINDINGS_MAX, Binding, BindingLimit, CheckTrajectory, ExpectedMeasurement, PLANNED_POINTS_MAX,
    Place, PlannedPath, StartSource, THETA_ASSUMED, TrajectoryCheck,
};
pub use self::rules::InvalidTrajectory;
use self::rules::{CircleFields, WaypointsFields, is_speed};
use crate::geometry::Point;

/// Fewest waypoints of a path.
pub const WAYPOINTS_MIN: usize = 2;
/// Most waypoints of a path.
pub const WAYPOINTS_MAX: usize = 100_000;
/// Smallest distance between neighbouring waypoints, metres; closer ones are the same point.
pub const WAYPOINT_SPACING_MIN_M: f64 = 1.0e-3;
/// Smallest radius of a circle, metres.
pub const RADIUS_MIN_M: f64 = 0.05;
/// Largest radius of a circle, metres.
pub const RADIUS_MAX_M: f64 = 10_000.0;
/// Slowest speed that can be asked for, metres per second.
pub const SPEED_MIN_M_S: f64 = 0.01;
/// Fastest speed that can be asked for, metres per second; each robot's own limit is lower.
pub const SPEED_MAX_M_S: f64 = 50.0;
/// Fewest turns of a circle.
pub const TURNS_MIN: f64 = 0.05;
/// Most turns of a circle.
pub const TURNS_MAX: f64 = 1_000.0;
/// Deepest variation of the speed (excitation), as a share of it.
pub const EXCITATION_DEPTH_MAX: f64 = 0.8;
/// Shortest period of an excitation, seconds.
pub const EXCITATION_PERIOD_MIN_S: f64 = 1.0;
/// Longest period of an excitation, seconds.
pub const EXCITATION_PERIOD_MAX_S: f64 = 20.0;

/// A path to drive, as a user requests it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Trajectory {
    /// Turns on a circle.
    Circle(Circle),
    /// A smooth path through points, driven without stopping at them.
    Waypoints(Waypoints),
}

/// Direction of travel on a circle, seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// The heading grows.
    #[default]
    CounterClockwise,
    /// The heading falls.
    Clockwise,
}

/// Turns on a circle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "CircleFields")]
pub struct Circle {
    /// The circle's centre.
    pub center: Point,
    /// Radius, metres.
    #[schema(minimum = 0.05, maximum = 10_000.0, example = 3.0)]
    pub radius_m: f64,
    /// Speed along the circle, metres per second; give this or `period_s`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.01, maximum = 50.0, example = 0.6)]
    pub speed_m_s: Option<f64>,
    /// Time for one turn, seconds; give this or `speed_m_s`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub period_s: Option<f64>,
    /// Direction of travel; counter-clockwise when absent.
    #[serde(default)]
    pub direction: Direction,
    /// How many turns; one when absent.
    #[serde(default = "one_turn")]
    #[schema(minimum = 0.05, maximum = 1000.0, default = 1.0)]
    pub turns: f64,
    /// What the robot may do beside it; nothing when absent.
    #[serde(default, skip_serializing_if = "TrajectoryOptions::is_none")]
    pub options: TrajectoryOptions,
}

impl Circle {
    /// The speed along the circle, metres per second, from the speed or the period.
    pub fn speed_m_s(&self) -> f64 {
        let from_period =
            || std::f64::consts::TAU * self.radius_m / self.period_s.unwrap_or(f64::INFINITY);
        self.speed_m_s.unwrap_or_else(from_period)
    }
}

fn one_turn() -> f64 {
    1.0
}

/// A smooth path through points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "WaypointsFields")]
pub struct Waypoints {
    /// The points in driving order, 2 to 100 000.
    #[schema(min_items = 2, max_items = 100_000)]
    pub points: Vec<Waypoint>,
    /// Speed wherever a point has none of its own, metres per second.
    #[schema(minimum = 0.01, maximum = 50.0, example = 0.6)]
    pub speed_m_s: f64,
    /// What the robot may do beside it; nothing when absent.
    #[serde(default, skip_serializing_if = "TrajectoryOptions::is_none")]
    pub options: TrajectoryOptions,
}

/// What a robot may do beside following its trajectory.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct TrajectoryOptions {
    /// Speed of the approach to the trajectory, metres per second; the trajectory's own when
    /// absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.01, maximum = 50.0)]
    pub approach_speed_m_s: Option<f64>,
    /// Excitation, a variation of the speed along the path, so that friction can be measured
    /// without torque sensing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub excitation: Option<Excitation>,
}

/// Excitation, a periodic variation of the speed: the speed falls by the depth and recovers,
/// and never exceeds the requested one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Excitation {
    /// By which share the speed falls at most; less where the robot's limits leave less.
    #[serde(default = "default_depth")]
    #[schema(exclusive_minimum = 0.0, maximum = 0.8, default = 0.5)]
    pub depth_ratio: f64,
    /// Time from one slowing down to the next, seconds.
    #[serde(default = "default_period")]
    #[schema(minimum = 1.0, maximum = 20.0, default = 3.0)]
    pub period_s: f64,
}

impl Default for Excitation {
    fn default() -> Self {
        Self {
            depth_ratio: default_depth(),
            period_s: default_period(),
        }
    }
}

fn default_depth() -> f64 {
    0.5
}

fn default_period() -> f64 {
    3.0
}

impl TrajectoryOptions {
    /// Whether nothing is asked for.
    pub fn is_none(&self) -> bool {
        self.approach_speed_m_s.is_none() && self.excitation.is_none()
    }

    /// Checks every figure.
    ///
    /// # Errors
    /// [`InvalidTrajectory`] names the one that is out of range.
    pub fn validate(&self) -> Result<(), InvalidTrajectory> {
        if let Some(speed_m_s) = self
            .approach_speed_m_s
            .filter(|&speed_m_s| !is_speed(speed_m_s))
        {
            return Err(InvalidTrajectory::ApproachSpeed(speed_m_s));
        }
        let Some(excitation) = self.excitation else {
            return Ok(());
        };
        let depth = excitation.depth_ratio;
        if !(depth > 0.0 && depth <= EXCITATION_DEPTH_MAX) {
            return Err(InvalidTrajectory::ExcitationDepth(depth));
        }
        let period_s = excitation.period_s;
        if !(EXCITATION_PERIOD_MIN_S..=EXCITATION_PERIOD_MAX_S).contains(&period_s) {
            return Err(InvalidTrajectory::ExcitationPeriod(period_s));
        }
        Ok(())
    }
}

/// One point of a path.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Waypoint {
    /// East-like coordinate, metres.
    pub x_m: f64,
    /// North-like coordinate, metres.
    pub y_m: f64,
    /// Speed from here to the next point, metres per second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed_m_s: Option<f64>,
    /// Direction of the path at this point, radians; free when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heading_rad: Option<f64>,
}

impl Waypoint {
    /// Where the point lies.
    pub fn position(&self) -> Point {
        Point {
            x_m: self.x_m,
            y_m: self.y_m,
        }
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn refusal(body: &serde_json::Value) -> String {
        serde_json::from_value::<Trajectory>(body.clone())
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn a_circle_takes_its_speed_from_the_period() {
        let circle: Trajectory = serde_json::from_value(json!({
            "circle": {"center": {"x_m": 0.0, "y_m": 0.0}, "radius_m": 6.0, "period_s": 62.83},
        }))
        .unwrap();
        assert!((circle.speed_max_m_s() - 0.6).abs() < 1e-3);
    }

    #[test]
    fn a_bad_circle_is_refused_by_the_name_of_its_field() {
        let circle = |radius_m: f64, turns: f64, speed_m_s: f64| {
            json!({"circle": {"center": {"x_m": 0.0, "y_m": 0.0}, "radius_m": radius_m,
                              "turns": turns, "speed_m_s": speed_m_s}})
        };
        assert!(refusal(&circle(0.0, 1.0, 0.5)).contains("radius_m"));
        assert!(refusal(&circle(1.0, 0.0, 0.5)).contains("turns"));
        assert!(refusal(&circle(1.0, 1.0, -0.5)).contains("speed"));
        let mut both = circle(1.0, 1.0, 0.5);
        both["circle"]["period_s"] = json!(3.0);
        assert!(refusal(&both).contains("either speed_m_s or period_s"));
        assert!(refusal(&json!({"square": {}})).contains("square"));
    }

    #[test]
    fn options_are_checked_and_absent_ones_are_not_written() {
        let circle = |options: serde_json::Value| {
            json!({"circle": {"center": {"x_m": 0.0, "y_m": 0.0}, "radius_m": 2.0,
                              "speed_m_s": 0.5, "options": options}})
        };
        let plain: Trajectory = serde_json::from_value(circle(json!({}))).unwrap();
        assert!(!serde_json::to_string(&plain).unwrap().contains("options"));
        let excitation = serde_json::from_value::<Trajectory>(circle(json!({"excitation": {}})));
        let asked = excitation.unwrap().options().excitation;
        assert_eq!(asked, Some(Excitation::default()));
        for (options, field) in [
            (json!({"excitation": {"depth_ratio": 0.9}}), "depth_ratio"),
            (json!({"excitation": {"depth_ratio": 0.0}}), "depth_ratio"),
            (json!({"excitation": {"period_s": 0.5}}), "period_s"),
            (json!({"approach_speed_m_s": -1.0}), "approach_speed_m_s"),
        ] {
            assert!(refusal(&circle(options)).contains(field), "{field}");
        }
    }

    #[test]
    fn a_bad_path_is_refused_by_the_number_of_its_point() {
        let path =
            |points: serde_json::Value| json!({"waypoints": {"points": points, "speed_m_s": 0.5}});
        let point = |x_m: f64| json!({"x_m": x_m, "y_m": 0.0});
        assert!(refusal(&path(json!([point(0.0)]))).contains("2 to 100000 points"));
        assert!(refusal(&path(json!([point(0.0), point(0.0)]))).contains("points[1] repeats"));
        assert!(refusal(&path(json!([point(0.0), point(2.0e6)]))).contains("points[1]"));
        #[expect(clippy::cast_precision_loss, reason = "far below 2^53")]
        let many: Vec<_> = (0..=WAYPOINTS_MAX)
            .map(|index| point(index as f64))
            .collect();
        assert!(refusal(&path(json!(many))).contains("has 100001"));
    }
}
