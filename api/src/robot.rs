//! Robots: what they are, and what is known of them now.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;

use crate::friction::LiveFriction;
use crate::geometry::{Pose, Twist};
use crate::ids::{
    AlertCode, AlertId, BootId, ConfigurationId, DERIVED_NAMESPACE, MissionId, PlanHash, RobotId,
    SiteId,
};
use crate::safety::SafetyStatus;

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
    /// Teleoperated.
    Teleoperated,
    /// Stopped and latched until an operator clears it.
    Stopped,
    /// Something is broken; the text in `fault` says what.
    Fault,
}

/// Whether a robot's heartbeat, which its control loop sends, arrives at the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LinkState {
    /// Heard a moment ago.
    Online,
    /// Some heartbeats are missing.
    Stale,
    /// Off the network, or silent for more than a second.
    Offline,
}

impl LinkState {
    /// Every state.
    pub const ALL: [Self; 3] = [Self::Online, Self::Stale, Self::Offline];

    /// The state's name on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Online => "online",
            Self::Stale => "stale",
            Self::Offline => "offline",
        }
    }
}

/// Why no heartbeat of a robot arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LinkCause {
    /// It is on the network, and its first heartbeat has not come yet.
    Joining,
    /// It left the network while it was heard: its agent or the whole robot is off.
    RobotOff,
    /// It went silent first: the network between it and the server is down.
    LinkDown,
    /// Its agent speaks, and its control loop stands still.
    LoopStopped,
    /// The server itself was down, and has not heard it since.
    ServerRestarted,
}

/// What a base and its agent can do beyond driving missions to their end.
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is an ability of its own, under its own name on the wire"
)]
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct Capabilities {
    /// It can pause a mission and drive it on.
    #[serde(default)]
    pub pause: bool,
    /// It can swap a mission for a new revision while it drives.
    #[serde(default)]
    pub replace: bool,
    /// It measures its battery.
    #[serde(default)]
    pub battery: bool,
    /// It measures wheel torque, so that friction shows in steady driving too.
    #[serde(default)]
    pub wheel_torque: bool,
    /// It latches stops, keeps to geofences and takes external limits.
    #[serde(default)]
    pub stop: bool,
    /// It can be teleoperated.
    #[serde(default)]
    pub teleop: bool,
    /// Rate of the control loop, Hz.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate_hz: Option<f64>,
    /// The kind of base, for people.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::site::NAME_LENGTH_MAX}>"
    )]
    pub base: Option<String>,
}

/// A robot's battery.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Battery {
    /// Charge, 0 to 1.
    pub charge_ratio: f64,
    /// Voltage, volts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub voltage_v: Option<f64>,
    /// Whether it is being charged.
    #[serde(default)]
    pub charging: bool,
}

/// Most alerts of one robot at a time.
pub const ALERTS_MAX: usize = 32;
/// Longest text of an alert, in characters.
pub const ALERT_TEXT_MAX: usize = 300;
/// Longest text of what is broken on a robot, in characters; what is longer is cut.
pub const FAULT_TEXT_MAX: usize = 300;
/// Longest version of an agent, in characters; what is longer is cut.
pub const VERSION_TEXT_MAX: usize = 100;

/// How much an alert matters.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Worth a look.
    Warning,
    /// The robot cannot go on without a person.
    Critical,
}

impl Severity {
    /// The severity's name on the wire and in the database.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Warning => "warning",
            Self::Critical => "critical",
        }
    }

    /// The severity of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Warning, Self::Critical]
            .into_iter()
            .find(|severity| severity.as_str() == name)
    }
}

/// Something that needs a person's attention now, as the robot says it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct AlertReport {
    /// What it is, stable, for programs: `[a-z0-9-]{1,63}`, such as `battery-low`.
    pub code: AlertCode,
    /// How much it matters.
    pub severity: Severity,
    /// What it is, for people; at most [`ALERT_TEXT_MAX`] characters.
    #[serde(deserialize_with = "crate::text::bounded::<_, {ALERT_TEXT_MAX}>")]
    pub text: String,
}

/// An alert as the server keeps it: raised, acknowledged, cleared, each once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Alert {
    /// The alert's identifier; a code that is raised again later is another alert.
    pub id: AlertId,
    /// The robot's site; null for an alert about the server itself.
    pub site: Option<SiteId>,
    /// The robot; null for an alert about the server itself.
    pub robot: Option<RobotId>,
    /// What it is, for programs.
    pub code: AlertCode,
    /// How much it matters.
    pub severity: Severity,
    /// What it is, for people.
    pub text: String,
    /// When the server raised it first.
    pub raised_at: Timestamp,
    /// When a person acknowledged it.
    pub acknowledged_at: Option<Timestamp>,
    /// When its cause was gone.
    pub cleared_at: Option<Timestamp>,
}

impl Alert {
    /// What it is about, for people: the robot's name, or `server`.
    pub fn about(&self) -> &str {
        self.robot.as_ref().map_or("server", RobotId::as_str)
    }

    /// Site and name of the robot that it is about, if it is about one.
    pub fn robot_key(&self) -> Option<(SiteId, RobotId)> {
        Some((self.site.clone()?, self.robot.clone()?))
    }
}

/// The body of `PATCH /v1/sites/{site}/robots/{robot}`; what is absent stays as it is.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct ChangeRobot {
    /// Another name for people. The identifier never changes: it is in every key and record.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// A retired robot gets no missions and is not listed; what it measured stays.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub retired: Option<bool>,
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
    /// Display name; the identifier until it is renamed.
    pub name: String,
    /// When it was retired, if it was.
    pub retired_at: Option<Timestamp>,
    /// The site it belongs to.
    pub site: SiteId,
    /// Model and tyres as last declared.
    pub model: RobotModel,
    /// The identifier of that model and those tyres.
    pub configuration: ConfigurationId,
    /// What the base and its agent can do.
    pub capabilities: Capabilities,
    /// Version of the agent.
    pub agent_version: String,
    /// First hello.
    pub first_seen_at: Timestamp,
    /// Last hello.
    pub last_hello_at: Timestamp,
    /// What became of its measurements.
    pub measurements: MeasurementsTaken,
    /// Whether its heartbeat arrives at the server now.
    pub link: LinkState,
    /// Why its heartbeat does not arrive; `null` while it is online.
    pub link_cause: Option<LinkCause>,
    /// Alerts that have not cleared.
    pub alerts: Vec<Alert>,
    /// Its newest report; `null` if none has come since the server started.
    pub live: Option<RobotLive>,
}

/// What became of a robot's measurements, beside those that are on the map.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct MeasurementsTaken {
    /// How many were impossible and will never be taken.
    pub refused: u64,
    /// Why the last of them was.
    pub refused_why: Option<String>,
    /// How many are from a time that has not come, and wait until the clock of their run is known.
    pub deferred: u64,
}

/// A robot's newest report, each value with its age.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RobotLive {
    /// The agent's run.
    pub boot: BootId,
    /// Time since the server received the last state, milliseconds.
    pub heard_age_ms: u64,
    /// The robot's own wall clock in that state; it may be wrong.
    pub robot_time: Timestamp,
    /// Offset of the robot's wall clock from the server's, milliseconds, to within the network
    /// latency of a heartbeat. Both may be wrong.
    pub clock_offset_ms: i64,
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
    /// The battery, if the base measures it.
    pub battery: Option<Battery>,
    /// What may only slow the robot down.
    pub safety: SafetyStatus,
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
    /// Whether the robot stands with the mission on hold until it is resumed; while this is false
    /// it may still be braking.
    #[serde(default)]
    pub paused: bool,
    /// What holds it so; absent while nothing does. It is here while the robot still brakes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paused_by: Option<PauseCause>,
}

impl MissionProgress {
    /// Whether the robot paused it of itself, for a stop or for teleoperation: then only a
    /// person lets it go on.
    pub fn is_paused_for_safety(&self) -> bool {
        let is_for_safety = |cause| matches!(cause, PauseCause::Stop | PauseCause::Teleoperation);
        self.paused && self.paused_by.is_some_and(is_for_safety)
    }
}

/// What paused a mission. Whatever it was, only a request resumes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum PauseCause {
    /// A request to pause it.
    Request,
    /// The robot is teleoperated.
    Teleoperation,
    /// The robot was stopped.
    Stop,
    /// Any cause of a newer peer.
    #[serde(other)]
    Other,
}

/// The state of a robot's durable store of measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, ToSchema)]
pub struct OutboxStatus {
    /// Records that the server has not answered for.
    pub pending: u64,
    /// Records lost since the store was made, because it was full.
    pub dropped: u64,
    /// Records that the server refused, moved to the dead letters.
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
    /// Segments lost since the start, because they were not taken from the control loop in time.
    #[serde(default)]
    pub lost_segments: u64,
    /// Measurements since the start that belong to no cell, for want of a site or a position.
    #[serde(default)]
    pub unplaced_blocks: u64,
    /// Samples of the base lost since the start, because newer ones came before a tick.
    #[serde(default)]
    pub lost_samples: u64,
    /// Commands of the server lost since the start for want of room; the server sends them again.
    #[serde(default)]
    pub lost_commands: u64,
}
