//! Records the inputs and outputs of the control loop in MCAP files, and replays such records.
//!
//! ```text
//! loop ──notes (bounded, non-blocking)──► thread ──► tread-….mcap, the oldest file is removed
//! ```
//! A record holds the loop's own values to the bit ([`codec`]), so that `tread-agent replay` can
//! run controller and estimator on it again, and the same data as ROS messages ([`views`]) for
//! Foxglove and ROS tools. A disk that is full or fails costs only the record.

mod codec;
mod read;
pub(crate) mod replay;
pub(crate) mod report;
pub(crate) mod salvage;
pub(crate) mod views;
mod writer;

use std::time::Duration;

use serde::{Deserialize, Serialize};
use tread_api::ids::{BootId, MissionId, RobotId, SiteId};
use tread_api::robot::RobotModel;
use tread_api::wire::hello::SiteDefinition;
use tread_control::estimation::EstimatorPrior;

use crate::config::AgentConfig;
use crate::config::recording::RecordingConfig;
use crate::control_loop::channels::Hold;
use crate::control_loop::frame::RecordedCommand;
use crate::control_loop::job::JobOrigin;
use crate::safety::LoopView;
pub(crate) use writer::RecordWriter;

/// Version of the record format. Format 1 had JSON messages, a tick without
/// [`LoopTick::judged_ns`](tread_ros2::messages::tread::LoopTick), and a loop that did not watch
/// its own rate.
pub(crate) const FORMAT: u32 = 2;
/// Versions of the record format that this agent reads.
pub(crate) const FORMATS_READ: std::ops::RangeInclusive<u32> = 1..=FORMAT;
/// Version of this agent.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Topics of a record.
pub(crate) mod topics {
    /// [`super::RunHead`], once at the head of each file.
    pub(crate) const RUN: &str = "/tread/run";
    /// Commands to the loop.
    pub(crate) const COMMAND: &str = "/tread/command";
    /// Leases, drive commands and external limits, when they change.
    pub(crate) const SAFETY: &str = "/tread/safety";
    /// Ticks.
    pub(crate) const TICK: &str = "/tread/tick";
    /// Estimated pose in the site frame, and twist.
    pub(crate) const ODOMETRY: &str = "/tread/odometry";
    /// Twist of the commanded wheel speeds without slip.
    pub(crate) const COMMANDED: &str = "/tread/cmd_vel";
    /// Samples of the inertial measurement unit.
    pub(crate) const IMU: &str = "/tread/imu";
    /// Samples of wheel speeds and torques.
    pub(crate) const JOINTS: &str = "/tread/joint_states";
    /// Position fixes.
    pub(crate) const POSE: &str = "/tread/pose";
    /// Plans, when they begin.
    pub(crate) const PLAN: &str = "/tread/plan";
    /// State of the loop, once a second.
    pub(crate) const DIAGNOSTICS: &str = "/tread/diagnostics";
}

/// Head of a file: the run, and the configuration of its loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct RunHead {
    /// Format of the record, see [`FORMAT`].
    pub(crate) format: u32,
    /// Version of the agent.
    pub(crate) version: String,
    pub(crate) boot: BootId,
    pub(crate) site: SiteId,
    pub(crate) robot: RobotId,
    /// Number of the file within the run, from zero.
    pub(crate) part: u32,
    pub(crate) model: RobotModel,
    pub(crate) blind_within_fence: bool,
    /// Age of the last sample beyond which the base counts as silent.
    pub(crate) silent_after: Duration,
    /// Rate of the loop, Hz.
    pub(crate) rate_hz: f64,
    /// Estimator's prior of the robot's parameters; records without it are of agents that assumed
    /// the model to be exact.
    #[serde(default = "EstimatorPrior::exact")]
    pub(crate) prior: EstimatorPrior,
}

impl RunHead {
    /// Returns the destination and the head of a run's first file; `None` if recording is off.
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

/// A command to the loop, as recorded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum CommandRecord {
    /// Starts a mission, planned from this origin.
    Start(JobOrigin),
    /// Ends a mission.
    Cancel { mission: MissionId },
    /// Activates a hold of a mission.
    Hold { mission: MissionId, hold: Hold },
    /// Releases a hold of a mission.
    Release { mission: MissionId, hold: Hold },
    /// Replaces the active revision by this one.
    Replace(JobOrigin),
    /// Replaces the definition of the site.
    Site {
        definition: SiteDefinition,
        /// Whether the fence leaves no room anywhere.
        is_without_room: bool,
    },
}

impl From<&RecordedCommand> for CommandRecord {
    fn from(noted: &RecordedCommand) -> Self {
        match noted {
            RecordedCommand::Start(origin) => Self::Start(origin.as_ref().clone()),
            RecordedCommand::Cancel(mission) => Self::Cancel { mission: *mission },
            RecordedCommand::Hold(mission, hold) => Self::Hold {
                mission: *mission,
                hold: *hold,
            },
            RecordedCommand::Release(mission, hold) => Self::Release {
                mission: *mission,
                hold: *hold,
            },
            RecordedCommand::Replace(origin) => Self::Replace(origin.as_ref().clone()),
            RecordedCommand::Site(site) => Self::Site {
                definition: site.definition().clone(),
                is_without_room: site.is_without_room(),
            },
        }
    }
}

/// Message on [`topics::COMMAND`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct CommandMessage {
    /// Number of the tick that took the command.
    pub(crate) tick: u64,
    pub(crate) command: CommandRecord,
}

/// Message on [`topics::SAFETY`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct SafetyMessage {
    /// Number of the first tick with this view.
    pub(crate) tick: u64,
    pub(crate) view: LoopView,
}

#[cfg(test)]
mod mission_tests;
#[cfg(test)]
mod tests;
