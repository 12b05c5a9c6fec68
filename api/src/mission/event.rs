//! What happened to a mission, when and by whom.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::MissionState;

/// Why a mission moved, for programs. Each edge of the server's table has one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// It was asked for.
    #[default]
    Requested,
    /// The server offers it to its robot.
    Offered,
    /// The robot cannot take it now; it waits again.
    Returned,
    /// The robot has taken it.
    Accepted,
    /// The robot will never take it.
    Rejected,
    /// A pause is wanted.
    PauseRequested,
    /// The robot holds it, standing.
    Paused,
    /// It is wanted to go on.
    ResumeRequested,
    /// The robot drives it again.
    Resumed,
    /// Another trajectory is wanted.
    ReplaceRequested,
    /// The robot holds the new revision.
    Replaced,
    /// The robot refused the new revision, or it came too late; the old one stands.
    ReplaceRefused,
    /// Its end is wanted.
    CancelRequested,
    /// Another mission was asked for in its place.
    Superseded,
    /// It ended by request.
    Cancelled,
    /// It was driven to its end.
    Succeeded,
    /// The robot gave it up.
    Failed,
    /// Its latest start passed.
    Expired,
    /// The robot stayed away past the bound.
    RobotLost,
    /// The agent began a new run without it.
    AgentRestarted,
    /// The robot is there, does not have it, and has not said how it ended.
    RobotForgot,
    /// The robot was retired.
    RobotRetired,
    /// Something was only noted, such as a word that came too late.
    Noted,
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
        Self::RobotForgot,
        Self::RobotRetired,
        Self::Noted,
    ];

    /// The cause's name on the wire and in the database.
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
            Self::RobotForgot => "robot_forgot",
            Self::RobotRetired => "robot_retired",
            Self::Noted => "noted",
        }
    }

    /// The cause of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|cause| cause.as_str() == name)
    }
}

/// Who caused an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Actor {
    /// A request over REST.
    Client,
    /// The server itself.
    Server,
    /// The robot.
    Robot,
}

impl Actor {
    /// The actor's name on the wire and in the database.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Client => "client",
            Self::Server => "server",
            Self::Robot => "robot",
        }
    }

    /// The actor of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Client, Self::Server, Self::Robot]
            .into_iter()
            .find(|actor| actor.as_str() == name)
    }
}

/// One step in a mission's history.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MissionEvent {
    /// When the server wrote it.
    pub at: Timestamp,
    /// Who caused it.
    pub actor: Actor,
    /// The state before; `null` for the first.
    pub from: Option<MissionState>,
    /// The state after; the same as before where only something was noted.
    pub to: MissionState,
    /// Why, for programs.
    pub cause: Cause,
    /// Why, for people.
    pub reason: Option<String>,
}
