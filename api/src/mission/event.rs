//! Steps in a mission's history: what happened, when, and who caused it.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::MissionState;

/// Cause of a step in a mission's history, for programs. Each transition of the server's state
/// table has one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// A client requested the mission.
    #[default]
    Requested,
    /// The server offers the mission to its robot.
    Offered,
    /// The robot cannot take the mission now; it returns to the queue.
    Returned,
    /// The robot accepted the mission.
    Accepted,
    /// The robot refused the mission for good.
    Rejected,
    /// A pause was requested.
    PauseRequested,
    /// The robot has stopped and holds the mission.
    Paused,
    /// A resumption was requested.
    ResumeRequested,
    /// The robot drives the mission again.
    Resumed,
    /// A replacement of the trajectory was requested.
    ReplaceRequested,
    /// The robot accepted the new revision.
    Replaced,
    /// The robot refused the new revision, or it came too late; the old revision stays in force.
    ReplaceRefused,
    /// A cancellation was requested.
    CancelRequested,
    /// A newer mission of the robot with start policy `replace` cancelled it.
    Superseded,
    /// The mission ended by request.
    Cancelled,
    /// The mission was driven to its end.
    Succeeded,
    /// The robot gave the mission up.
    Failed,
    /// The mission had not begun by its latest start.
    Expired,
    /// The robot was offline for longer than the mission allows.
    RobotLost,
    /// The agent restarted and no longer has the mission.
    AgentRestarted,
    /// The robot is online, does not have the mission, and has not reported its end.
    #[serde(alias = "robot_forgot")]
    RobotLostMission,
    /// The robot was retired.
    RobotRetired,
    /// Only a record, without a change of state, such as a report that came too late.
    #[serde(alias = "noted")]
    Recorded,
}

impl Cause {
    /// Every cause.
    pub const ALL: [Self; 23] = [
        Self::Requested,
        Self::Offered,
        Self::Returned,
        Self::Accepted,
        Self::Rejected,
        Self::PauseRequested,
        Self::Paused,
        Self::ResumeRequested,
        Self::Resumed,
        Self::ReplaceRequested,
        Self::Replaced,
        Self::ReplaceRefused,
        Self::CancelRequested,
        Self::Superseded,
        Self::Cancelled,
        Self::Succeeded,
        Self::Failed,
        Self::Expired,
        Self::RobotLost,
        Self::AgentRestarted,
        Self::RobotLostMission,
        Self::RobotRetired,
        Self::Recorded,
    ];

    /// Returns the cause's name on the wire and in the database.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Requested => "requested",
            Self::Offered => "offered",
            Self::Returned => "returned",
            Self::Accepted => "accepted",
            Self::Rejected => "rejected",
            Self::PauseRequested => "pause_requested",
            Self::Paused => "paused",
            Self::ResumeRequested => "resume_requested",
            Self::Resumed => "resumed",
            Self::ReplaceRequested => "replace_requested",
            Self::Replaced => "replaced",
            Self::ReplaceRefused => "replace_refused",
            Self::CancelRequested => "cancel_requested",
            Self::Superseded => "superseded",
            Self::Cancelled => "cancelled",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Expired => "expired",
            Self::RobotLost => "robot_lost",
            Self::AgentRestarted => "agent_restarted",
            Self::RobotLostMission => "robot_lost_mission",
            Self::RobotRetired => "robot_retired",
            Self::Recorded => "recorded",
        }
    }

    /// Returns the cause with this name, or with the former name by which a database of an earlier
    /// version has it; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        let name = match name {
            "robot_forgot" => Self::RobotLostMission.as_str(),
            "noted" => Self::Recorded.as_str(),
            present => present,
        };
        Self::ALL.into_iter().find(|cause| cause.as_str() == name)
    }
}

/// Party that caused a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Actor {
    /// A client, by a request over REST.
    Client,
    /// The server.
    Server,
    /// The robot.
    Robot,
}

impl Actor {
    /// Returns the actor's name on the wire and in the database.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Client => "client",
            Self::Server => "server",
            Self::Robot => "robot",
        }
    }

    /// Returns the actor with this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Client, Self::Server, Self::Robot]
            .into_iter()
            .find(|actor| actor.as_str() == name)
    }
}

/// Step in a mission's history.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MissionEvent {
    /// Time when the server recorded it.
    pub at: Timestamp,
    /// Party that caused it.
    pub actor: Actor,
    /// State before the step; `null` for the first step.
    pub from: Option<MissionState>,
    /// State after the step; equal to `from` if the state did not change.
    pub to: MissionState,
    /// Cause, for programs.
    pub cause: Cause,
    /// Reason, for people; `null` without one.
    pub reason: Option<String>,
}
