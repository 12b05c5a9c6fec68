//! What a trajectory would ask of a robot, computed before anything moves.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::Trajectory;
use crate::geometry::{Point, Pose};
use crate::ids::{MissionId, RobotId, SiteId};
use crate::start_policy::StartPolicy;

/// The body of `POST /v1/trajectories/check`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CheckTrajectory {
    /// The robot's site.
    pub site: SiteId,
    /// The robot whose model and limits count.
    pub robot: RobotId,
    /// What would be driven.
    pub trajectory: Trajectory,
    /// From where. When absent: the expected end of the last mission that is driven before it; the
    /// robot's last known pose if there is none; the start of the path if that is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<Pose>,
    /// The priority that the mission would have: queued missions of a lower one are driven after it.
    #[serde(default)]
    #[schema(minimum = -100, maximum = 100)]
    pub priority: i32,
    /// What would become of the robot's other missions; it waits behind them when absent.
    #[serde(default)]
    pub start_policy: StartPolicy,
    /// The mission of this robot whose trajectory it would replace; it is driven in that one's
    /// place then, and priority and policy do not count.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replaces: Option<MissionId>,
    /// Assumed θ of the ground, for the accuracy to expect; what the robot measures now when
    /// absent, and [`THETA_ASSUMED`] if it measures nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(exclusive_minimum = 0.0, example = 0.2)]
    pub theta: Option<f64>,
}

/// θ that a check assumes where nothing is known: firm ground.
pub const THETA_ASSUMED: f64 = 0.2;

/// How well friction would be measured on a trajectory, by the robot's own estimator.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ExpectedMeasurement {
    /// The θ of the ground that was assumed.
    pub theta_assumed: f64,
    /// Whether the base measures wheel torque.
    pub wheel_torque: bool,
    /// Expected standard deviation of θ at the end, as a ratio of θ; `null` where the trajectory
    /// excites too little for a measurement.
    pub relative_sd: Option<f64>,
    /// Driving time until the first measurement, seconds.
    pub first_after_s: Option<f64>,
}

/// What a trajectory would ask of a robot, planned by the robot's own planner.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TrajectoryCheck {
    /// From where it was planned.
    pub start: Pose,
    /// What `start` is.
    pub start_source: StartSource,
    /// The mission whose expected end `start` is, if it is one.
    pub after_mission: Option<MissionId>,
    /// Length including the approach, metres.
    pub length_m: f64,
    /// Length of the approach, metres.
    pub approach_length_m: f64,
    /// Time from rest to rest when nothing slows the robot, seconds.
    pub duration_s: f64,
    /// Fastest speed, m/s.
    pub speed_peak_m_s: f64,
    /// Highest longitudinal acceleration or braking, m/s².
    pub linear_acceleration_peak_m_s2: f64,
    /// Highest lateral acceleration, m/s².
    pub lateral_acceleration_peak_m_s2: f64,
    /// Fastest turn, rad/s.
    pub angular_peak_rad_s: f64,
    /// Where a limit makes the robot slower than requested, in driving order; at most
    /// [`BINDINGS_MAX`].
    pub bindings: Vec<Binding>,
    /// Depth of the requested excitation, as a ratio of the speed: less than requested where the
    /// robot's limits leave less.
    pub excitation_depth_ratio: Option<f64>,
    /// How well friction would be measured.
    pub measurement: ExpectedMeasurement,
    /// The path that would be driven, including the approach.
    pub path: PlannedPath,
}

/// From where a trajectory was planned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum StartSource {
    /// From the pose that the request says.
    Request,
    /// From the expected end of the last mission that is driven before.
    Mission,
    /// From where the robot is now: nothing is driven before.
    Robot,
    /// From the start of the trajectory: nobody knows where the robot is.
    Trajectory,
}

/// Most points of a planned path.
pub const PLANNED_POINTS_MAX: usize = 1_000;

/// The smooth path that the planner computes.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct PlannedPath {
    /// Distance between consecutive points, metres, along the path.
    pub step_m: f64,
    /// Points in driving order, at most [`PLANNED_POINTS_MAX`]. Further turns of a circle go where
    /// the first one went and are left out.
    pub points: Vec<Point>,
}

/// Most stretches that a check names.
pub const BINDINGS_MAX: usize = 1_000;

/// A stretch of a path on which one limit decides how fast the robot goes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Binding {
    /// Which limit.
    pub limit: BindingLimit,
    /// Where it begins.
    pub from: Place,
    /// Where it ends.
    pub to: Place,
    /// Slowest speed of the stretch, m/s.
    pub speed_min_m_s: f64,
}

/// A limit that slows a robot below the requested speed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum BindingLimit {
    /// Acceleration across the path.
    LateralAcceleration,
    /// Yaw rate.
    AngularSpeed,
    /// Wheel speed.
    WheelSpeed,
    /// Wheel acceleration where the bend changes.
    WheelAcceleration,
    /// Acceleration or braking along the path, up to the next slower place.
    LinearAcceleration,
    /// Traction limit of the ground, longitudinal or lateral; during the approach a cautious one where
    /// nothing is known.
    Traction,
}

/// A place along a path.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Place {
    /// Arc length from the start, metres, where it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arc_m: Option<f64>,
    /// Index of the waypoint at or before it, from 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waypoint: Option<usize>,
    /// Where it is.
    pub point: Point,
}
