//! Trajectories that a user requests from a robot: a circle or waypoints.

mod check;
mod rules;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

pub use self::check::{
    BINDINGS_MAX, Binding, BindingLimit, CheckTrajectory, ExpectedMeasurement, PLANNED_POINTS_MAX,
    Place, PlannedPath, StartSource, THETA_ASSUMED, TrajectoryCheck,
};
pub use self::rules::InvalidTrajectory;
use self::rules::{CircleFields, WaypointsFields};
use crate::geometry::{Point, Pose};

/// Minimum number of waypoints of a path.
pub const WAYPOINTS_MIN: usize = 2;
/// Maximum number of waypoints of a path.
pub const WAYPOINTS_MAX: usize = 100_000;
/// Minimum distance between neighbouring waypoints, metres; closer ones are refused as duplicates.
pub const WAYPOINT_SPACING_MIN_M: f64 = 1.0e-3;
/// Minimum radius of a circle, metres.
pub const RADIUS_MIN_M: f64 = 0.05;
/// Maximum radius of a circle, metres.
pub const RADIUS_MAX_M: f64 = 10_000.0;
/// Minimum speed of a trajectory, m/s.
pub const SPEED_MIN_M_S: f64 = 0.01;
/// Maximum speed of a trajectory, m/s; each robot's own limit is lower.
pub const SPEED_MAX_M_S: f64 = 50.0;
/// Minimum number of turns of a circle.
pub const TURNS_MIN: f64 = 0.05;
/// Maximum number of turns of a circle.
pub const TURNS_MAX: f64 = 1_000.0;
/// Maximum depth of an excitation, as a ratio of the speed.
pub const EXCITATION_DEPTH_MAX: f64 = 0.8;
/// Minimum period of an excitation, seconds.
pub const EXCITATION_PERIOD_MIN_S: f64 = 1.0;
/// Maximum period of an excitation, seconds.
pub const EXCITATION_PERIOD_MAX_S: f64 = 20.0;
/// Maximum distance from the expected start at which a robot plans from it, metres.
pub const START_TOLERANCE_M: f64 = 0.05;
/// Maximum heading difference from the expected start at which a robot plans from it, rad.
pub const START_TOLERANCE_RAD: f64 = 0.1;

/// Trajectory to drive, as a user requests it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Trajectory {
    /// Circle, driven for a number of turns.
    Circle(Circle),
    /// Smooth path through points, driven without stopping at them.
    Waypoints(Waypoints),
}

/// Direction of travel on a circle, seen from above.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Direction {
    /// The heading increases.
    #[default]
    CounterClockwise,
    /// The heading decreases.
    Clockwise,
}

/// Circle, driven for a number of turns.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "CircleFields")]
pub struct Circle {
    /// Centre of the circle in the site frame.
    pub center: Point,
    /// Radius, metres.
    #[schema(minimum = 0.05, maximum = 10_000.0, example = 3.0)]
    pub radius_m: f64,
    /// Speed along the circle, m/s; give either this or `period_s`.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.01, maximum = 50.0, example = 0.6)]
    pub speed_m_s: Option<f64>,
    /// Time for one turn, seconds; give either this or `speed_m_s`. The resulting speed must be
    /// 0.01 to 50 m/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub period_s: Option<f64>,
    /// Direction of travel; counter-clockwise when absent.
    #[serde(default)]
    pub direction: Direction,
    /// Number of turns; 1 when absent.
    #[serde(default = "one_turn")]
    #[schema(minimum = 0.05, maximum = 1000.0, default = 1.0)]
    pub turns: f64,
    /// Approach speed, excitation and expected start; none is required.
    #[serde(default, skip_serializing_if = "TrajectoryOptions::is_none")]
    pub options: TrajectoryOptions,
}

impl Circle {
    /// Returns the speed along the circle, m/s, given directly or by the period.
    pub fn speed_m_s(&self) -> f64 {
        let from_period =
            || std::f64::consts::TAU * self.radius_m / self.period_s.unwrap_or(f64::INFINITY);
        self.speed_m_s.unwrap_or_else(from_period)
    }
}

fn one_turn() -> f64 {
    1.0
}

/// Smooth path through points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "WaypointsFields")]
pub struct Waypoints {
    /// Points in driving order, 2 to 100 000; neighbours at least 1 mm apart.
    #[schema(min_items = 2, max_items = 100_000)]
    pub points: Vec<Waypoint>,
    /// Speed where a point has none of its own, m/s.
    #[schema(minimum = 0.01, maximum = 50.0, example = 0.6)]
    pub speed_m_s: f64,
    /// Approach speed, excitation and expected start; none is required.
    #[serde(default, skip_serializing_if = "TrajectoryOptions::is_none")]
    pub options: TrajectoryOptions,
}

/// Options of a trajectory besides its path and speed.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct TrajectoryOptions {
    /// Speed of the approach to the trajectory, m/s; the speed of the trajectory when absent.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "rules::read_approach_speed"
    )]
    #[schema(minimum = 0.01, maximum = 50.0)]
    pub approach_speed_m_s: Option<f64>,
    /// Excitation: variation of the speed along the path, so that friction is measurable without
    /// torque sensing. No excitation when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub excitation: Option<Excitation>,
    /// Pose from which a dry run planned this trajectory, the `start` of its response. A robot that
    /// stands within 5 cm and 0.1 rad of this pose plans from it, so that its plan equals that of
    /// the dry run. Otherwise a difference of millimetres could lead to another approach of similar
    /// length. No effect when absent, or if the robot stands elsewhere.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "rules::read_expected_start"
    )]
    pub expected_start: Option<Pose>,
}

/// Periodic variation of the speed: the speed falls by the depth and recovers. It never exceeds the
/// requested speed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Excitation {
    /// Maximum decrease of the speed, as a ratio of it; less where the robot's limits require it.
    #[serde(
        default = "default_depth",
        deserialize_with = "rules::read_excitation_depth"
    )]
    #[schema(exclusive_minimum = 0.0, maximum = 0.8, default = 0.5)]
    pub depth_ratio: f64,
    /// Period of the variation, seconds.
    #[serde(
        default = "default_period",
        deserialize_with = "rules::read_excitation_period"
    )]
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
    /// Whether no option is set.
    pub fn is_none(&self) -> bool {
        self.approach_speed_m_s.is_none()
            && self.excitation.is_none()
            && self.expected_start.is_none()
    }

    /// Returns the pose from which a robot at `actual` plans: the expected start if it is near, else
    /// `actual`.
    pub fn planning_start(&self, actual: Pose) -> Pose {
        let is_near = |expected: &Pose| {
            let turn_rad = expected.heading_rad - actual.heading_rad;
            expected.position().distance_m(actual.position()) <= START_TOLERANCE_M
                && turn_rad.sin().atan2(turn_rad.cos()).abs() <= START_TOLERANCE_RAD
        };
        self.expected_start.filter(is_near).unwrap_or(actual)
    }

    /// Checks that every option is within its range.
    ///
    /// # Errors
    /// [`InvalidTrajectory`] names the first option that is not.
    pub fn validate(&self) -> Result<(), InvalidTrajectory> {
        rules::check_approach_speed(self.approach_speed_m_s)?;
        rules::check_expected_start(self.expected_start)?;
        let Some(excitation) = self.excitation else {
            return Ok(());
        };
        rules::check_excitation_depth(excitation.depth_ratio)?;
        rules::check_excitation_period(excitation.period_s)
    }
}

/// Point of a path, in the site frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Waypoint {
    /// East-like coordinate, metres.
    pub x_m: f64,
    /// North-like coordinate, metres.
    pub y_m: f64,
    /// Speed from this point to the next, m/s; the speed of the path when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed_m_s: Option<f64>,
    /// Direction of the path at this point, radians counter-clockwise from x; free when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub heading_rad: Option<f64>,
}

impl Waypoint {
    /// Returns the position without speed and heading.
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
        let circle: Circle = serde_json::from_value(json!({
            "center": {"x_m": 0.0, "y_m": 0.0}, "radius_m": 6.0, "period_s": 62.83,
        }))
        .unwrap();
        assert!((circle.speed_m_s() - 0.6).abs() < 1e-3);
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
            (
                json!({"expected_start": {"x_m": 2e6, "y_m": 0.0, "heading_rad": 0.0}}),
                "expected_start",
            ),
        ] {
            assert!(refusal(&circle(options)).contains(field), "{field}");
        }
    }

    #[test]
    fn a_robot_near_the_expected_start_plans_from_it() {
        let pose = |x_m: f64, heading_rad: f64| Pose {
            x_m,
            y_m: 1.0,
            heading_rad,
        };
        let options = TrajectoryOptions {
            expected_start: Some(pose(2.0, 3.12)),
            ..TrajectoryOptions::default()
        };
        // Headings on both sides of π are near.
        for near in [pose(2.049, 3.12), pose(1.96, 3.03), pose(2.0, -3.11)] {
            assert_eq!(options.planning_start(near), pose(2.0, 3.12), "{near:?}");
        }
        for far in [pose(2.051, 3.12), pose(2.0, 3.0), pose(2.0, -3.0)] {
            assert_eq!(options.planning_start(far), far);
        }
        let none = TrajectoryOptions::default();
        assert_eq!(none.planning_start(pose(2.0, 3.0)), pose(2.0, 3.0));
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
