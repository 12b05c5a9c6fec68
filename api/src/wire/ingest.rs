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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::encoding::Encoding;
    use crate::wire::{decode_as, encode_as};

    const BATCH: &str = r#"{
        "robot": "rover-1", "boot": "0192f0c1-2b3c-7d4e-8f50-617283940a1b",
        "robot_time": "2026-11-26T08:00:00.123456Z",
        "records": [
            {"seq": 0, "content": {"segment": {
                "configuration": "0192f0c1-2b3c-5d4e-8f50-617283940a1c",
                "mission": "0192f0c1-2b3c-7d4e-8f50-617283940a1d",
                "started_at": "2026-11-26T07:59:50Z", "ended_at": "2026-11-26T08:00:00.000001Z",
                "grid_revision": 1, "cell": {"ix": -3, "iy": 4},
                "terrain": {"id": "gravel", "revision": 2},
                "theta": {"information": 2.5e4, "weighted": 5e3},
                "theta_errors": {"independent_information": 3e4, "robot_ratio": 0.1,
                    "tyre_ratio": 0.2},
                "effective_track_ratio": {"information": 10.0, "weighted": 15.5},
                "rolling_resistance": {"information": 100.0, "weighted": 2.5},
                "mu_peak_lower_bound": 0.3, "samples": 160, "distance_m": 1.0,
                "saturation_ratio": 0.0}}},
            {"seq": 9007199254740991, "content": {"mission": {
                "mission": "0192f0c1-2b3c-7d4e-8f50-617283940a1d", "revision": 1,
                "plan_hash": "0192f0c1-2b3c-5d4e-8f50-617283940a1e",
                "at": "2026-11-26T08:00:00Z", "phase": "failed", "reason": "no way",
                "driven": {"tolerance_m": 0.05, "points": [{"x_m": 1.0, "y_m": -2.5}],
                    "times_s": [0.5]}}}}
        ]
    }"#;

    #[test]
    fn a_batch_is_the_same_in_every_encoding() {
        let batch: Batch = serde_json::from_str(BATCH).unwrap();
        let mut sizes = Vec::new();
        for encoding in [Encoding::Json, Encoding::Cbor] {
            let payload = encode_as(encoding, &batch).unwrap();
            assert_eq!(decode_as::<Batch>(encoding, &payload).unwrap(), batch);
            sizes.push(payload.len());
        }
        assert!(sizes[1] < sizes[0], "{sizes:?}");
    }

    #[test]
    fn another_major_version_is_refused_in_every_encoding() {
        #[derive(Serialize)]
        struct Newer {
            v: u32,
            body: Vec<u8>,
        }
        let newer = Newer {
            v: 9,
            body: Vec::new(),
        };
        for encoding in [Encoding::Json, Encoding::Cbor] {
            let payload = encoding.write(&newer).unwrap();
            let refused = decode_as::<Batch>(encoding, &payload).unwrap_err();
            assert!(
                matches!(refused, crate::wire::WireError::Version(9)),
                "{refused:?}"
            );
        }
    }
}
