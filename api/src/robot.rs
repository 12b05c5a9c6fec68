//! Robots: what they are, and what is known of them now.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::friction::LiveFriction;
use crate::geometry::{Pose, Twist};
use crate::ids::{
    BootId, ConfigurationId, DERIVED_NAMESPACE, MissionId, PlanHash, RobotId, SiteId,
};

/// A robot's model and tyres, as its agent declares them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotModel {
    /// Name of the model, for people.
    pub name: String,
    /// Tyres; friction measured with other tyres is never mixed in.
    pub tyres: String,
    /// Mass with payload, kg.
    pub mass_kg: f64,
    /// Lateral distance of the wheels' contact points, W, metres.
    pub track_width_m: f64,
    /// Longitudinal distance of the wheels' contact points, L, metres.
    pub wheelbase_m: f64,
    /// Wheel radius r, metres.
    pub wheel_radius_m: f64,
    /// Moment of inertia about the vertical axis `I_G`, kg m².
    pub yaw_inertia_kg_m2: f64,
    /// What the base can do.
    pub limits: RobotLimits,
}

/// What a base can do, each figure positive.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotLimits {
    /// Fastest forward speed, m/s.
    pub linear_max_m_s: f64,
    /// Fastest yaw rate, rad/s.
    pub angular_max_rad_s: f64,
    /// Strongest forward acceleration and braking, m/s².
    pub linear_acceleration_max_m_s2: f64,
    /// Strongest lateral acceleration, m/s².
    pub lateral_acceleration_max_m_s2: f64,
    /// Largest forward jerk, m/s³.
    pub linear_jerk_max_m_s3: f64,
    /// Fastest wheel speed, rad/s.
    pub wheel_speed_max_rad_s: f64,
    /// Strongest wheel acceleration, rad/s².
    pub wheel_acceleration_max_rad_s2: f64,
}

impl RobotModel {
    /// The identifier of this model and these tyres.
    pub fn configuration(&self) -> ConfigurationId {
        let description = serde_json::to_vec(self).unwrap_or_default();
        ConfigurationId::from_uuid(Uuid::new_v5(&DERIVED_NAMESPACE, &description))
    }
}

/// What an agent is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum RobotMode {
    /// Standing, ready for a mission.
    Idle,
    /// Driving a mission.
    Tracking,
    /// Driven by hand.
    Teleoperated,
    /// Stopped and latched until an operator clears it.
    Stopped,
    /// Something is broken; the text in `fault` says what.
    Fault,
}

/// Whether the server hears a robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LinkState {
    /// Heard within the last second and a half.
    Online,
    /// Present on the network, but silent for longer than that.
    Stale,
    /// Not on the network.
    Offline,
}

/// A value with its age when the answer was made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Aged<T> {
    /// The value.
    pub value: T,
    /// Time since it was measured, milliseconds, by monotonic clocks.
    pub age_ms: u64,
}

impl<T> Aged<T> {
    /// The same value, older by `elapsed_ms`.
    #[must_use]
    pub fn older_by(self, elapsed_ms: u64) -> Self {
        Self {
            age_ms: self.age_ms.saturating_add(elapsed_ms),
            ..self
        }
    }
}

/// A robot as the server knows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Robot {
    /// The robot's identifier within its site.
    pub id: RobotId,
    /// The site it belongs to.
    pub site: SiteId,
    /// Model and tyres as last declared.
    pub model: RobotModel,
    /// The identifier of that model and those tyres.
    pub configuration: ConfigurationId,
    /// Version of the agent.
    pub agent_version: String,
    /// First hello.
    pub first_seen_at: Timestamp,
    /// Last hello.
    pub last_hello_at: Timestamp,
    /// Whether the server hears it now.
    pub link: LinkState,
    /// What it said last; `null` if it has said nothing since the server started.
    pub live: Option<RobotLive>,
}

/// What a robot said last, each value with its age.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotLive {
    /// The agent's run.
    pub boot: BootId,
    /// Time since the server received the last state, milliseconds.
    pub heard_age_ms: u64,
    /// The robot's own wall clock in that state; it may be wrong.
    pub robot_time: Timestamp,
    /// What the agent is doing.
    pub mode: RobotMode,
    /// What is broken, if anything.
    pub fault: Option<String>,
    /// Where it is.
    pub pose: Option<Aged<Pose>>,
    /// How fast it moves.
    pub twist: Option<Aged<Twist>>,
    /// The mission it drives.
    pub mission: Option<MissionProgress>,
    /// Both estimates of the friction under it.
    pub friction: Option<Aged<LiveFriction>>,
    /// Its store of measurements that still wait for the server.
    pub outbox: OutboxStatus,
    /// The control loop.
    pub control_loop: LoopStatus,
}

/// How far a mission has come on the robot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MissionProgress {
    /// The mission.
    pub id: MissionId,
    /// Its revision.
    pub revision: u32,
    /// What exactly is driven.
    pub plan_hash: PlanHash,
    /// Arc length driven, metres; never falls.
    pub driven_m: f64,
    /// Arc length of the whole plan, metres.
    pub length_m: f64,
    /// Distance from the path, metres, positive to its left.
    pub cross_track_m: f64,
}

/// The state of a robot's durable store of measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct OutboxStatus {
    /// Records that the server has not answered for.
    pub pending: u64,
    /// Records lost since the store was made, because it was full.
    pub dropped: u64,
    /// Records that the server refused, kept aside.
    pub refused: u64,
}

/// The health of a robot's control loop.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct LoopStatus {
    /// Nominal rate, Hz.
    pub rate_hz: f64,
    /// Ticks since the start.
    pub ticks: u64,
    /// Ticks that began more than one period late.
    pub overruns: u64,
    /// Longest computation of a tick since the last report, microseconds.
    pub tick_max_us: u32,
    /// Commands refused since the start: they did not parse, or were of another version.
    #[serde(default)]
    pub commands_refused: u64,
}
