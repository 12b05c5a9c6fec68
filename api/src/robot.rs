//! Robots: their models and capabilities, and their live state.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::friction::LiveFriction;
use crate::geometry::{Point, Pose, Twist};
use crate::ids::{
    AlertCode, AlertId, BootId, ConfigurationId, DERIVED_NAMESPACE, MissionId, PlanHash, RobotId,
    SiteId, Tag,
};
use crate::link::LinkQuality;
use crate::safety::SafetyStatus;

/// Model and tyres of a robot, as its agent declares them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotModel {
    /// Name of the model, for people.
    pub name: String,
    /// Name of the tyres; measurements with different tyres are never combined.
    pub tyres: String,
    /// Configured mass, usually that of the data sheet, kg; payload comes on top of it.
    pub mass_kg: f64,
    /// Track width W: lateral distance between the wheels' contact points, metres.
    pub track_width_m: f64,
    /// Wheelbase L: longitudinal distance between the wheels' contact points, metres.
    pub wheelbase_m: f64,
    /// Wheel radius r, metres.
    pub wheel_radius_m: f64,
    /// Yaw inertia `I_G`: moment of inertia about the vertical axis through the centre of mass, kg
    /// m².
    pub yaw_inertia_kg_m2: f64,
    /// Motion limits of the base.
    pub limits: RobotLimits,
}

/// Motion limits of a base, all positive.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotLimits {
    /// Maximum speed, forward and backward, m/s.
    pub linear_max_m_s: f64,
    /// Maximum yaw rate, rad/s.
    pub angular_max_rad_s: f64,
    /// Maximum longitudinal acceleration and braking, m/s².
    pub linear_acceleration_max_m_s2: f64,
    /// Maximum lateral acceleration, m/s².
    pub lateral_acceleration_max_m_s2: f64,
    /// Maximum longitudinal jerk, m/s³.
    pub linear_jerk_max_m_s3: f64,
    /// Maximum angular speed of a wheel, rad/s.
    pub wheel_speed_max_rad_s: f64,
    /// Maximum angular acceleration of a wheel, rad/s².
    pub wheel_acceleration_max_rad_s2: f64,
}

impl RobotModel {
    /// Returns the identifier of this model with these tyres.
    pub fn configuration(&self) -> ConfigurationId {
        let description = serde_json::to_vec(self).unwrap_or_default();
        ConfigurationId::from_uuid(Uuid::new_v5(&DERIVED_NAMESPACE, &description))
    }
}

/// Operating mode of an agent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum RobotMode {
    /// Stopped, ready for a mission.
    Idle,
    /// Driving a mission.
    Tracking,
    /// Teleoperated.
    Teleoperated,
    /// Stopped by a latched stop, until a person clears it.
    Stopped,
    /// Out of order; `fault` contains the reason.
    Fault,
}

/// Link state of a robot, from the time since the last heartbeat of its control loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LinkState {
    /// The last heartbeat is recent.
    Online,
    /// Some heartbeats are missing.
    Stale,
    /// Not connected, or without a heartbeat for more than a second.
    Offline,
}

impl LinkState {
    /// Every link state.
    pub const ALL: [Self; 3] = [Self::Online, Self::Stale, Self::Offline];

    /// Returns the link state's name on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Online => "online",
            Self::Stale => "stale",
            Self::Offline => "offline",
        }
    }
}

/// Reason why a robot is not online.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LinkCause {
    /// It is connected, but its first heartbeat has not arrived yet.
    Joining,
    /// It disconnected while its heartbeats arrived: its agent or the whole robot is off.
    RobotOff,
    /// Its heartbeats stopped before it disconnected: the network to the server is down.
    LinkDown,
    /// Its agent sends states, but its control loop has stopped.
    LoopStopped,
    /// The server was restarted, and no heartbeat has arrived since.
    ServerRestarted,
}

/// Optional capabilities of a base and its agent, beyond driving missions to their end.
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is an ability of its own, under its own name on the wire"
)]
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct Capabilities {
    /// Whether it can pause and resume a mission.
    #[serde(default)]
    pub pause: bool,
    /// Whether it can replace a mission's trajectory while driving.
    #[serde(default)]
    pub replace: bool,
    /// Whether it measures its battery.
    #[serde(default)]
    pub battery: bool,
    /// Whether it measures wheel torque, so that friction is measurable in steady driving too.
    #[serde(default)]
    pub wheel_torque: bool,
    /// Whether it supports latched stops, geofences and external limits.
    #[serde(default)]
    pub stop: bool,
    /// Whether it can be teleoperated.
    #[serde(default)]
    pub teleop: bool,
    /// Rate of the control loop, Hz.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// Kind of base, for people.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::site::NAME_LENGTH_MAX}>"
    )]
    pub base: Option<String>,
}

/// State of a robot's battery.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Battery {
    /// State of charge, 0 to 1.
    pub charge_ratio: f64,
    /// Voltage, volts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub voltage_v: Option<f64>,
    /// Whether it is being charged.
    #[serde(default)]
    pub charging: bool,
}

/// Maximum number of alerts that one robot reports at a time.
pub const ALERTS_MAX: usize = 32;
/// Maximum length of the text of an alert, characters.
pub const ALERT_TEXT_MAX: usize = 300;
/// Maximum length of a robot's `fault` text, characters; the rest is cut off.
pub const FAULT_TEXT_MAX: usize = 300;
/// Maximum length of an agent's version, characters; the rest is cut off.
pub const VERSION_TEXT_MAX: usize = 100;

/// Severity of an alert.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// A person should check it.
    Warning,
    /// The robot cannot continue without a person.
    Critical,
}

impl Severity {
    /// Returns the severity's name on the wire and in the database.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Warning => "warning",
            Self::Critical => "critical",
        }
    }

    /// Returns the severity with this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Warning, Self::Critical]
            .into_iter()
            .find(|severity| severity.as_str() == name)
    }
}

/// Condition that needs a person's attention, as a robot reports it while it lasts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AlertReport {
    /// Kind of the alert, for programs: `[a-z0-9-]{1,63}`, such as `battery-low`.
    #[serde(deserialize_with = "crate::alert_kind::deserialize_present")]
    pub code: AlertCode,
    /// Severity.
    pub severity: Severity,
    /// Description, for people; at most 300 characters.
    #[serde(deserialize_with = "crate::text::bounded::<_, {ALERT_TEXT_MAX}>")]
    pub text: String,
}

/// Alert as the server stores it. It is raised, acknowledged and cleared at most once each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Alert {
    /// Identifier of the alert. The same code raised again later is another alert.
    pub id: AlertId,
    /// Site of the robot; `null` for an alert about the server itself.
    pub site: Option<SiteId>,
    /// Robot; `null` for an alert about the server itself.
    pub robot: Option<RobotId>,
    /// Kind of the alert, for programs.
    pub code: AlertCode,
    /// Severity.
    pub severity: Severity,
    /// Description, for people.
    pub text: String,
    /// Mission that it is about, or that the robot drove when it was raised; `null` without one.
    #[serde(default)]
    pub mission: Option<MissionId>,
    /// Position of the robot in the site frame when it was raised; `null` if unknown.
    #[serde(default)]
    pub place: Option<Point>,
    /// Time when the server raised it.
    pub raised_at: Timestamp,
    /// Time when a person acknowledged it; `null` before that.
    pub acknowledged_at: Option<Timestamp>,
    /// Time when its cause ended; `null` before that.
    pub cleared_at: Option<Timestamp>,
}

impl Alert {
    /// Returns the subject of the alert, for people: the robot's identifier, or `server`.
    pub fn about(&self) -> &str {
        self.robot.as_ref().map_or("server", RobotId::as_str)
    }

    /// Returns the site and identifier of the robot; `None` for an alert about the server itself.
    pub fn robot_key(&self) -> Option<(SiteId, RobotId)> {
        Some((self.site.clone()?, self.robot.clone()?))
    }
}

/// Maximum number of tags of a robot.
pub const TAGS_MAX: usize = 16;

/// Body of `PATCH /v1/sites/{site}/robots/{robot}`; absent fields stay unchanged.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct UpdateRobot {
    /// New name, for people. The robot's identifier never changes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// Whether the robot is retired. A retired robot gets no missions and is omitted from lists by
    /// default; its measurements stay.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retired: Option<bool>,
    /// New tags, which replace all present ones, at most 16; repeated ones count once.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tags: Option<Vec<Tag>>,
}

/// Value with its age at the time of the message.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Aged<T> {
    /// The value.
    pub value: T,
    /// Time since the value was measured, milliseconds, by monotonic clocks.
    pub age_ms: u64,
}

impl<T> Aged<T> {
    /// Returns the same value, older by `elapsed_ms` milliseconds.
    #[must_use]
    pub fn older_by(self, elapsed_ms: u64) -> Self {
        Self {
            age_ms: self.age_ms.saturating_add(elapsed_ms),
            ..self
        }
    }
}

/// Robot as the server stores it, with its live state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Robot {
    /// Identifier of the robot within its site.
    pub id: RobotId,
    /// Name for people; equal to the identifier until the robot is renamed.
    pub name: String,
    /// Tags by which people group the fleet, in alphabetical order.
    #[serde(default)]
    pub tags: Vec<Tag>,
    /// Time when it was retired; `null` if it is not retired.
    pub retired_at: Option<Timestamp>,
    /// Time since which no mission is sent to it, because the server was restored from a backup and
    /// does not know what happened since; an operator releases it. `null` if missions are sent to
    /// it.
    #[serde(default)]
    pub awaits_release_since: Option<Timestamp>,
    /// Site of the robot.
    pub site: SiteId,
    /// Model and tyres as its agent declared them last.
    pub model: RobotModel,
    /// Identifier of the configuration: of `model` with its tyres.
    pub configuration: ConfigurationId,
    /// Capabilities of the base and its agent.
    pub capabilities: Capabilities,
    /// Version of the agent.
    pub agent_version: String,
    /// Time of its first connection.
    pub first_seen_at: Timestamp,
    /// Time of its latest connection.
    pub last_hello_at: Timestamp,
    /// Measurements that the server has not put on the friction map.
    pub measurements: UnmappedMeasurements,
    /// Link state.
    pub link: LinkState,
    /// Reason why it is not online; `null` while it is online.
    pub link_cause: Option<LinkCause>,
    /// Quality of its link in the last hour; `null` before it has connected to this run of the
    /// server.
    #[serde(default)]
    pub link_quality: Option<LinkQuality>,
    /// Alerts that have not cleared.
    pub alerts: Vec<Alert>,
    /// Last state that the robot sent; `null` if it has sent none since the server started.
    pub live: Option<RobotLive>,
}

/// Measurements of a robot that are not on the friction map.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct UnmappedMeasurements {
    /// Number of measurements refused for good, because they are implausible.
    pub refused: u64,
    /// Reason of the last refusal, for people; `null` if there was none.
    pub refusal_reason: Option<String>,
    /// Number of measurements with times in the future, kept until the clock of their run is known.
    pub deferred: u64,
}

/// Last state that a robot sent, with the age of each value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotLive {
    /// Run of the agent.
    pub boot: BootId,
    /// Time since the server received the last state, milliseconds.
    #[serde(alias = "heard_age_ms")]
    pub state_age_ms: u64,
    /// Wall clock of the robot in that state; it may be wrong.
    pub robot_time: Timestamp,
    /// Offset of the robot's wall clock from the server's, milliseconds, positive if the robot's is
    /// ahead; accurate to the network latency of a heartbeat. Either clock may be wrong.
    pub clock_offset_ms: i64,
    /// Operating mode of the agent.
    pub mode: RobotMode,
    /// Reason of a fault, for people; `null` without one.
    pub fault: Option<String>,
    /// Pose in the site frame; `null` if unknown.
    pub pose: Option<Aged<Pose>>,
    /// Velocity in the robot frame; `null` if unknown.
    pub twist: Option<Aged<Twist>>,
    /// Progress of the active mission; `null` without one.
    pub mission: Option<MissionProgress>,
    /// Friction estimates of the tracking law and of the estimator; `null` if unknown.
    pub friction: Option<Aged<LiveFriction>>,
    /// State of its durable queue of records for the server.
    pub outbox: OutboxStatus,
    /// State of the control loop.
    pub control_loop: LoopStatus,
    /// State of the battery; `null` if the base does not measure it.
    pub battery: Option<Battery>,
    /// Stops, leases, limits and everything else that reduces the robot's speed.
    pub safety: SafetyStatus,
}

/// Progress of a mission on the robot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MissionProgress {
    /// Identifier of the mission.
    pub id: MissionId,
    /// Revision that is being driven.
    pub revision: u32,
    /// Hash of the trajectory that is being driven.
    pub plan_hash: PlanHash,
    /// Arc length driven, metres; never decreases.
    pub driven_m: f64,
    /// Arc length of the whole plan, metres.
    pub length_m: f64,
    /// Cross-track error, metres, positive to the left of the path.
    pub cross_track_m: f64,
    /// Whether the mission is paused and the robot has stopped. It is still false while the robot
    /// brakes.
    #[serde(default)]
    pub paused: bool,
    /// Cause of the pause, already present while the robot brakes; absent while there is no pause.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paused_by: Option<PauseCause>,
}

impl MissionProgress {
    /// Whether the robot itself paused the mission, because of a stop or teleoperation, so that
    /// only a person may resume it.
    pub fn is_paused_for_safety(&self) -> bool {
        let is_for_safety = |cause| matches!(cause, PauseCause::Stop | PauseCause::Teleoperation);
        self.paused && self.paused_by.is_some_and(is_for_safety)
    }
}

/// Cause of a pause of a mission. The mission resumes only on request, whatever the cause.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum PauseCause {
    /// A pause was requested.
    Request,
    /// The robot is teleoperated.
    Teleoperation,
    /// The robot was stopped.
    Stop,
    /// Cause that this version does not know, from a newer peer.
    #[serde(other)]
    Other,
}

/// State of a robot's outbox, its durable queue of records.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct OutboxStatus {
    /// Number of records that the server has not acknowledged.
    pub pending: u64,
    /// Number of records lost since the outbox was created, because it was full.
    pub dropped: u64,
    /// Number of records that the server refused; they are kept as dead letters.
    pub refused: u64,
}

/// State of a robot's control loop.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct LoopStatus {
    /// Nominal rate, Hz.
    pub rate_hz: f64,
    /// Number of ticks since the start of the agent.
    pub ticks: u64,
    /// Number of ticks that began more than one period late.
    pub overruns: u64,
    /// Maximum computing time of a tick since the last report, microseconds.
    pub tick_max_us: u32,
    /// Number of commands refused since the start, because they were malformed or of another
    /// payload version.
    #[serde(default)]
    pub commands_refused: u64,
    /// Number of segments lost since the start, because they were not read from the control loop in
    /// time.
    #[serde(default)]
    pub lost_segments: u64,
    /// Number of measurements since the start that could not be assigned to a cell, because the
    /// site or the position was unknown.
    #[serde(default, alias = "unplaced_blocks")]
    pub unmapped_blocks: u64,
    /// Number of samples of the base lost since the start, because newer ones arrived before a
    /// tick.
    #[serde(default)]
    pub lost_samples: u64,
    /// Number of server commands lost since the start because the queue was full; the server
    /// repeats them.
    #[serde(default)]
    pub lost_commands: u64,
}
