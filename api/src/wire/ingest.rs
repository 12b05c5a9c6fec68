//! What must not be lost: records with acknowledgement.
//!
//! A robot keeps each record on its disk until the server has answered for it. `(robot, boot, seq)`
//! names a record for ever, so that the same may be sent again without counting twice.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use crate::friction::Segment;
use crate::ids::{BootId, MissionId, PlanHash, RobotId};
use crate::mission::{DrivenPath, MissionQuality};
use crate::robot::MissionProgress;

/// Most records of one batch.
pub const BATCH_RECORDS_MAX: usize = 1_000;

/// Records of one run of one agent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Batch {
    /// Who speaks; the same as in the key.
    pub robot: RobotId,
    /// The run of the agent that made the records; not always the present one.
    pub boot: BootId,
    /// The robot's wall clock when it sent this. With it the server puts the records' times right
    /// when the clock is wrong; without it they are taken as they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot_time: Option<Timestamp>,
    /// The records, at most [`BATCH_RECORDS_MAX`], by rising `seq`.
    pub records: Vec<Record>,
}

/// One thing that must not be lost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Counts the records of this boot, from 0.
    pub seq: u64,
    /// What it is.
    pub content: RecordContent,
}

/// What a record is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordContent {
    /// A measurement of friction.
    Segment(Segment),
    /// A mission has begun or ended.
    Mission(MissionReport),
}

/// A mission has begun or ended on the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MissionReport {
    /// The mission.
    pub mission: MissionId,
    /// Its revision.
    pub revision: u32,
    /// What exactly was driven.
    pub plan_hash: PlanHash,
    /// When, by the robot's clock.
    pub at: Timestamp,
    /// What happened.
    pub phase: MissionPhase,
    /// When a stop or a lease began that paused it, by the robot's clock: it stood only later.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub since: Option<Timestamp>,
    /// Why, for people.
    #[serde(
        default,
        skip_serializing_if = "Option::is_none",
        deserialize_with = "crate::text::bounded_option::<_, {crate::mission::REASON_LENGTH_MAX}>"
    )]
    pub reason: Option<String>,
    /// How far it had come.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub progress: Option<MissionProgress>,
    /// How well it was driven, in the report of its end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quality: Option<MissionQuality>,
    /// Where the robot really was, in the report of its end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub driven: Option<DrivenPath>,
}

/// A robot's word on a mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MissionPhase {
    /// The first wheel command was given.
    Started,
    /// Held, standing, by request.
    Paused,
    /// Driven again after a pause.
    Resumed,
    /// A new revision is driven now; the report names it.
    Replaced,
    /// Driven to its end.
    Succeeded,
    /// Given up.
    Failed,
    /// Ended by request.
    Cancelled,
    /// Its latest start passed before it began.
    Expired,
}

/// The server's answer, after its commit. What it does not list as refused is stored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Receipt {
    /// Records that are new to the server.
    pub committed: u64,
    /// Records that it had before.
    pub duplicates: u64,
    /// Records that it will never take.
    pub refused: Vec<RefusedRecord>,
}

/// A record that the server will never take.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusedRecord {
    /// Its number.
    pub seq: u64,
    /// Why, for people.
    pub reason: String,
}
