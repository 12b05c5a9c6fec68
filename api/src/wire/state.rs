//! What a robot publishes about itself; the latest counts, losses do no harm.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::friction::LiveFriction;
use crate::geometry::{Pose, Twist};
use crate::ids::{BootId, RobotId};
use crate::robot::{Aged, LoopStatus, MissionProgress, OutboxStatus, RobotMode};
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
    /// What the agent is doing.
    pub mode: RobotMode,
    /// What is broken, if anything.
    #[serde(default, skip_serializing_if = "Option::is_none")]
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
    /// The control loop.
    pub control_loop: LoopStatus,
}

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
