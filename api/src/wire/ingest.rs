//! Upload of records that must not be lost, with acknowledgement.
//!
//! A robot keeps each record on its disk until the server has acknowledged it. `(robot, boot, seq)`
//! identifies a record permanently, so that a repeated upload is counted once.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::friction::Segment;
use crate::ids::{BootId, MissionId, PlanHash, RobotId};
use crate::mission::{DrivenPath, MissionQuality};
use crate::robot::MissionProgress;

/// Maximum number of records of one batch.
pub const BATCH_RECORDS_MAX: usize = 1_000;

/// Batch of records of one run of one agent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Batch {
    /// Identifier of the robot; must equal the one in the key.
    pub robot: RobotId,
    /// Run of the agent that created the records; it may be a former run.
    pub boot: BootId,
    /// Wall clock of the robot at sending. The server corrects the times of the records by its
    /// offset; without it they are not corrected.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot_time: Option<Timestamp>,
    /// Records in ascending order of `seq`, at most [`BATCH_RECORDS_MAX`].
    pub records: Vec<Record>,
}

/// Record that must not be lost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Sequence number of the record within its run, from 0.
    pub seq: u64,
    /// Content of the record.
    pub content: RecordContent,
}

/// Content of a record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordContent {
    /// Measurement of friction.
    Segment(Segment),
    /// Change of phase of a mission.
    Mission(MissionReport),
}

/// Change of phase of a mission on the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MissionReport {
    /// Identifier of the mission.
    pub mission: MissionId,
    /// Revision of the mission.
    pub revision: u32,
    /// Hash of the trajectory that was driven.
    pub plan_hash: PlanHash,
    /// Time of the change, by the robot's clock.
    pub at: Timestamp,
    /// New phase.
    pub phase: MissionPhase,
    /// Time when the stop or lease that paused the mission began, by the robot's clock; the robot
    /// came to rest after it. Absent for other phases and pauses.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub since: Option<Timestamp>,
    /// Reason, for people; absent without one.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::mission::REASON_LENGTH_MAX}>"
    )]
    pub reason: Option<String>,
    /// Progress at that time; absent if unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<MissionProgress>,
    /// Quality of the run; present only when the mission has ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality: Option<MissionQuality>,
    /// Path that the robot drove; present only when the mission has ended.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub driven: Option<DrivenPath>,
}

/// Phase of a mission on the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MissionPhase {
    /// The first wheel command was given.
    Started,
    /// The robot has paused the mission and is at rest.
    Paused,
    /// The robot drives the mission again after a pause.
    Resumed,
    /// The robot drives the new revision that the report names.
    Replaced,
    /// The mission was driven to its end.
    Succeeded,
    /// The robot gave the mission up.
    Failed,
    /// The mission ended by request.
    Cancelled,
    /// The mission had not begun by its latest start.
    Expired,
}

/// Answer of the server to a batch, after its commit. Every record that is not in `refused` is
/// stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Receipt {
    /// Number of records that are new to the server.
    pub committed: u64,
    /// Number of records that the server had already.
    pub duplicates: u64,
    /// Records that the server refuses for good.
    pub refused: Vec<RefusedRecord>,
}

/// Record that the server refuses for good.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusedRecord {
    /// Sequence number of the record.
    pub seq: u64,
    /// Reason, for people.
    pub reason: String,
}
