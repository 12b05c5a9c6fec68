//! Records what the control loop takes and gives, and runs records again.
//!
//! ```text
//! loop ──notes (bounded, never waited for)──► thread ──► run-….mcap, the oldest gives way
//! ```
//! A record holds the loop's own values to the bit ([`codec`]), so that `tread-agent replay` can run
//! controller and estimator on it again, and beside them the same in messages of ROS ([`views`]),
//! for Foxglove and ROS's tools. A disk that is full or dead costs the record alone.

mod codec;
pub(crate) mod frame;
mod read;
pub(crate) mod replay;
pub(crate) mod report;
pub(crate) mod salvage;
pub(crate) mod views;
mod writer;

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tread_api::ids::{BootId, MissionId, RobotId, SiteId};
use tread_api::robot::RobotModel;
use tread_api::wire::hello::SiteDefinition;
use tread_control::estimation::EstimatorPrior;

use crate::config::AgentConfig;
use crate::control_loop::active::Hold;
use crate::control_loop::origin::JobOrigin;
use crate::safety::LoopView;
use frame::NotedCommand;
pub(crate) use writer::RecordWriter;

/// The version of what is written here. Format 1 had JSON messages, a tick without
/// [`LoopTick::judged_ns`](tread_ros2::messages::tread::LoopTick), and a loop that did not watch its
/// own rate.
pub(crate) const FORMAT: u32 = 2;
/// Versions that are read.
pub(crate) const FORMATS_READ: std::ops::RangeInclusive<u32> = 1..=FORMAT;
/// The version of this agent.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");
/// Smallest and largest file, MiB.
pub const FILE_MIB_RANGE: std::ops::RangeInclusive<u64> = 1..=4_096;
/// Fewest and most files.
pub const FILES_RANGE: std::ops::RangeInclusive<usize> = 2..=1_000;
/// A file unless it is said otherwise, MiB.
pub(crate) const FILE_MIB_DEFAULT: u64 = 64;
/// Files unless it is said otherwise.
pub(crate) const FILES_DEFAULT: usize = 16;

/// Topics of a record.
pub(crate) mod topics {
    /// Once at the head of each file: see [`super::RunHead`].
    pub(crate) const RUN: &str = "/tread/run";
    /// Commands that the loop took.
    pub(crate) const COMMAND: &str = "/tread/command";
    /// Leases, teleoperation commands, limits from outside; when they change.
    pub(crate) const SAFETY: &str = "/tread/safety";
    /// Ticks.
    pub(crate) const TICK: &str = "/tread/tick";
    /// Where the robot is believed to be.
    pub(crate) const ODOMETRY: &str = "/tread/odometry";
    /// What is commanded.
    pub(crate) const COMMANDED: &str = "/tread/cmd_vel";
    /// What the inertial unit said.
    pub(crate) const IMU: &str = "/tread/imu";
    /// What the wheels said.
    pub(crate) const JOINTS: &str = "/tread/joint_states";
    /// Position fixes.
    pub(crate) const POSE: &str = "/tread/pose";
    /// Plans, when they begin.
    pub(crate) const PLAN: &str = "/tread/plan";
    /// How the agent is.
    pub(crate) const DIAGNOSTICS: &str = "/tread/diagnostics";
}

/// Where records go, and how many.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingConfig {
    /// The folder.
    pub folder: PathBuf,
    /// Size from which a file is followed by the next, bytes.
    pub file_bytes: u64,
    /// Files that are kept, of all runs together.
    pub files: usize,
}

/// What a file begins with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct RunHead {
    /// See [`FORMAT`].
    pub(crate) format: u32,
    /// Version of the agent.
    pub(crate) version: String,
    pub(crate) boot: BootId,
    pub(crate) site: SiteId,
    pub(crate) robot: RobotId,
    /// Number of the file within the run, from zero on.
    pub(crate) part: u32,
    pub(crate) model: RobotModel,
    pub(crate) blind_within_fence: bool,
    /// Oldest word of the base with which it does not count as silent.
    pub(crate) silent_after: Duration,
    /// Rate of the loop, Hz.
    pub(crate) rate_hz: f64,
    /// What was known beforehand of the robot; records without it are of agents that took it for
    /// exactly as its model says.
    #[serde(default = "EstimatorPrior::exact")]
    pub(crate) prior: EstimatorPrior,
}

impl RunHead {
    /// The first file of a run, and where it goes; none if nothing is to be recorded.
    pub(crate) fn of(
        config: &AgentConfig,
        boot: BootId,
        silent_after: Duration,
    ) -> Option<(RecordingConfig, Self)> {
        let head = Self {
            format: FORMAT,
            version: VERSION.to_owned(),
            boot,
            site: config.site.clone(),
            robot: config.robot.clone(),
            part: 0,
            model: config.model.clone(),
            blind_within_fence: config.blind_within_fence,
            silent_after,
            rate_hz: config.rate_hz,
            prior: config.prior,
        };
        Some((config.recording.clone()?, head))
    }
}

/// A command in a record.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum CommandRecord {
    /// Drive this.
    Start(JobOrigin),
    /// End this mission.
    Cancel { mission: MissionId },
    /// Hold it.
    Hold { mission: MissionId, hold: Hold },
    /// Let it go on.
    Release { mission: MissionId, hold: Hold },
    /// Drive this revision instead.
    Replace(JobOrigin),
    /// The site is like this.
    Site {
        definition: SiteDefinition,
        /// Whether its fence leaves no room.
        is_without_room: bool,
    },
}

impl From<&NotedCommand> for CommandRecord {
    fn from(noted: &NotedCommand) -> Self {
        match noted {
            NotedCommand::Start(origin) => Self::Start(origin.as_ref().clone()),
            NotedCommand::Cancel(mission) => Self::Cancel { mission: *mission },
            NotedCommand::Hold(mission, hold) => Self::Hold {
                mission: *mission,
                hold: *hold,
            },
            NotedCommand::Release(mission, hold) => Self::Release {
                mission: *mission,
                hold: *hold,
            },
            NotedCommand::Replace(origin) => Self::Replace(origin.as_ref().clone()),
            NotedCommand::Site(site) => Self::Site {
                definition: site.definition().clone(),
                is_without_room: site.is_without_room(),
            },
        }
    }
}

/// On [`topics::COMMAND`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct CommandMessage {
    /// The tick that took it.
    pub(crate) tick: u64,
    pub(crate) command: CommandRecord,
}

/// On [`topics::SAFETY`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct SafetyMessage {
    /// The first tick that saw it.
    pub(crate) tick: u64,
    pub(crate) view: LoopView,
}

#[cfg(test)]
mod mission_tests;
#[cfg(test)]
mod tests;
