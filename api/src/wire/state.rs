//! What a robot publishes about itself; the latest counts, losses do no harm.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::enrolment::TrustId;
use crate::friction::LiveFriction;
use crate::geometry::{Pose, Twist};
use crate::ids::{BootId, RobotId};
use crate::robot::{
    Aged, AlertReport, Battery, LoopStatus, MissionProgress, OutboxStatus, RobotMode,
};
use crate::safety::SafetyStatus;
use crate::site::Cell;
use crate::terrain::TerrainRef;

/// A robot's state, published on its `state` key.
///
/// Ages are by the robot's monotonic clock at the time of sending.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RobotState {
    /// Who speaks; the same as in the key.
    pub robot: RobotId,
    /// This run of the agent.
    pub boot: BootId,
    /// Counts the states of this run.
    pub seq: u64,
    /// The robot's wall clock; it may be wrong.
    pub robot_time: Timestamp,
    /// The agent's monotonic clock at sending, microseconds: end times for this run are on this
    /// clock. An older agent has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub monotonic_us: Option<u64>,
    /// What the agent is doing.
    pub mode: RobotMode,
    /// What is broken, if anything.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::robot::FAULT_TEXT_MAX}>"
    )]
    pub fault: Option<String>,
    /// Where it is.
    pub pose: Option<Aged<Pose>>,
    /// How fast it moves.
    pub twist: Option<Aged<Twist>>,
    /// The mission it drives.
    pub mission: Option<MissionProgress>,
    /// The revision of the site's terrains that the robot holds.
    pub terrain_revision: Option<u64>,
    /// Measurements that wait for the server.
    pub outbox: OutboxStatus,
    /// The control loop. A robot whose ticks stand still is not alive, whatever else it says.
    pub control_loop: LoopStatus,
    /// The battery, if the base measures it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub battery: Option<Battery>,
    /// What needs a person's attention now, at most
    /// [`ALERTS_MAX`](crate::robot::ALERTS_MAX), each code once.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub alerts: Vec<AlertReport>,
    /// The agent ends by itself, and this is its last word. Nobody misses it then.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub leaving: bool,
    /// What may only slow the robot down. Absent from an older agent.
    #[serde(default)]
    pub safety: SafetyStatus,
}

/// The server's pulse, published every [`PULSE_PERIOD_MS`] milliseconds on the site's `pulse` key.
///
/// A robot measures by it how long it has not heard the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServerPulse {
    /// The server's wall clock.
    pub server_time: Timestamp,
    /// Which authorities robots are to trust; a robot that trusts others renews its certificate.
    /// Absent where robots need no certificates, and from an older server.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trust: Option<TrustId>,
}

/// How often the server's pulse comes, milliseconds.
pub const PULSE_PERIOD_MS: u64 = 250;

/// Both friction estimates of a robot, published on its `friction` key.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrictionReport {
    /// Who speaks; the same as in the key.
    pub robot: RobotId,
    /// This run of the agent.
    pub boot: BootId,
    /// Counts the reports of this run.
    pub seq: u64,
    /// The robot's wall clock; it may be wrong.
    pub robot_time: Timestamp,
    /// Where the robot is.
    pub cell: Option<Cell>,
    /// What ground it is on.
    pub terrain: Option<TerrainRef>,
    /// The estimates.
    pub friction: LiveFriction,
}
