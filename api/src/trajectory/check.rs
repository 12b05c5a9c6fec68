//! Check of a trajectory before anything moves: the plan, and what it demands of the robot.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::Trajectory;
use crate::geometry::{Point, Pose};
use crate::ids::{MissionId, RobotId, SiteId};
use crate::start_policy::StartPolicy;

/// Body of `POST /v1/trajectories/check`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CheckTrajectory {
    /// Site of the robot.
    pub site: SiteId,
    /// Robot whose model and limits apply.
    pub robot: RobotId,
    /// Trajectory to check.
    pub trajectory: Trajectory,
    /// Pose from which to plan. When absent: the expected end of the last mission before this one,
    /// else the robot's last known pose, else the start of the path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<Pose>,
    /// Priority that the mission would have; queued missions of a lower priority are driven after
    /// it.
    #[serde(default)]
    #[schema(minimum = -100, maximum = 100)]
    pub priority: i32,
    /// Effect that the mission would have on the robot's other missions; when absent, it would wait
    /// behind them.
    #[serde(default)]
    pub start_policy: StartPolicy,
    /// Mission of this robot whose trajectory this one would replace. It is driven in place of that
    /// mission, and `priority` and `start_policy` are ignored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replaces: Option<MissionId>,
    /// Assumed θ of the ground, from which `measurement` is predicted. When absent: the θ that the
    /// robot measures now, else 0.2.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(exclusive_minimum = 0.0, example = 0.2)]
    pub theta: Option<f64>,
}

/// θ that a check assumes where no θ is known; corresponds to firm ground.
pub const THETA_ASSUMED: f64 = 0.2;

/// Predicted accuracy of a friction measurement on a trajectory, from a run of the robot's own
/// estimator along the plan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ExpectedMeasurement {
    /// Assumed θ of the ground.
    pub theta_assumed: f64,
    /// Whether the base measures wheel torque.
    pub wheel_torque: bool,
    /// Expected standard deviation of θ at the end, as a ratio of θ; `null` if the excitation does
    /// not suffice for a measurement.
    pub relative_std_dev: Option<f64>,
    /// Driving time until the first measurement, seconds; `null` if there is none.
    pub first_after_s: Option<f64>,
}

/// Result of the check of a trajectory, from a plan of the robot's own planner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrajectoryCheck {
    /// Pose from which it was planned.
    pub start: Pose,
    /// Origin of `start`.
    pub start_source: StartSource,
    /// Mission whose expected end is `start`; `null` for any other origin.
    pub after_mission: Option<MissionId>,
    /// Length including the approach, metres.
    pub length_m: f64,
    /// Length of the approach, metres.
    pub approach_length_m: f64,
    /// Duration from standstill to standstill, seconds, if nothing slows the robot.
    pub duration_s: f64,
    /// Maximum speed, m/s.
    pub speed_peak_m_s: f64,
    /// Maximum longitudinal acceleration or braking, m/s².
    pub linear_acceleration_peak_m_s2: f64,
    /// Maximum lateral acceleration, m/s².
    pub lateral_acceleration_peak_m_s2: f64,
    /// Maximum yaw rate, rad/s.
    pub angular_peak_rad_s: f64,
    /// Sections on which a limit reduces the speed below the requested one, in driving order; at
    /// most 1 000.
    pub bindings: Vec<Binding>,
    /// Achieved depth of the requested excitation, as a ratio of the speed; less than requested
    /// where the robot's limits require it. `null` without excitation.
    pub excitation_depth_ratio: Option<f64>,
    /// Predicted accuracy of a friction measurement.
    pub measurement: ExpectedMeasurement,
    /// Planned path, including the approach.
    pub path: PlannedPath,
}

/// Origin of the pose from which a trajectory was planned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum StartSource {
    /// The pose in the request.
    Request,
    /// The expected end of the last mission before this one.
    Mission,
    /// The present pose of the robot; no mission comes before.
    Robot,
    /// The start of the trajectory; the pose of the robot is unknown.
    Trajectory,
}

/// Maximum number of points of a planned path.
pub const PLANNED_POINTS_MAX: usize = 1_000;

/// Smooth path that the planner computed.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct PlannedPath {
    /// Distance between consecutive points along the path, metres.
    pub step_m: f64,
    /// Points in driving order, at most 1 000. Further turns of a circle repeat the first one and
    /// are left out.
    pub points: Vec<Point>,
}

/// Maximum number of sections in the result of a check.
pub const BINDINGS_MAX: usize = 1_000;

/// Section of a path on which one limit determines the speed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Binding {
    /// Limit that determines the speed.
    pub limit: BindingLimit,
    /// Start of the section.
    pub from: Place,
    /// End of the section.
    pub to: Place,
    /// Minimum speed within the section, m/s.
    pub speed_min_m_s: f64,
}

/// Limit that reduces the speed below the requested one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum BindingLimit {
    /// Lateral acceleration.
    LateralAcceleration,
    /// Yaw rate.
    AngularSpeed,
    /// Wheel speed.
    WheelSpeed,
    /// Wheel acceleration, where the curvature changes.
    WheelAcceleration,
    /// Longitudinal acceleration or braking, up to the next slower place.
    LinearAcceleration,
    /// Traction limit of the ground, longitudinal or lateral; on the approach a cautious default
    /// where no friction is known.
    Traction,
}

/// Place along a path.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Place {
    /// Arc length from the start, metres; absent if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arc_m: Option<f64>,
    /// Index of the waypoint at or before the place, from 0; absent if there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waypoint: Option<usize>,
    /// Position in the site frame.
    pub point: Point,
}
