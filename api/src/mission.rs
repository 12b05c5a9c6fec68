//! Missions: one run of a trajectory on one robot, with its whole history.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::ids::{BootId, MissionId, PlanHash, RobotId, SiteId};
use crate::robot::MissionProgress;
use crate::trajectory::Trajectory;

/// Longest reason or detail in a mission's history, in characters.
pub const REASON_LENGTH_MAX: usize = 500;

/// Where a mission stands. The last five are terminal: they never change again.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum MissionState {
    /// Waits for its robot.
    Queued,
    /// Sent to the robot, not answered yet.
    Offered,
    /// The robot drives it.
    Active,
    /// The robot holds it, standing.
    Paused,
    /// A cancellation is wanted, the robot has not confirmed it yet.
    Cancelling,
    /// Driven to its end.
    Succeeded,
    /// Ended by something that went wrong.
    Failed,
    /// Ended by request.
    Cancelled,
    /// Refused by the robot.
    Rejected,
    /// Its latest start passed before it began.
    Expired,
}

impl MissionState {
    /// Every state.
    pub const ALL: [Self; 10] = [
        Self::Queued,
        Self::Offered,
        Self::Active,
        Self::Paused,
        Self::Cancelling,
        Self::Succeeded,
        Self::Failed,
        Self::Cancelled,
        Self::Rejected,
        Self::Expired,
    ];

    /// Whether the mission has ended for good.
    pub const fn is_terminal(self) -> bool {
        matches!(
            self,
            Self::Succeeded | Self::Failed | Self::Cancelled | Self::Rejected | Self::Expired
        )
    }

    /// The state's name on the wire and in the database.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Offered => "offered",
            Self::Active => "active",
            Self::Paused => "paused",
            Self::Cancelling => "cancelling",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Rejected => "rejected",
            Self::Expired => "expired",
        }
    }

    /// The state of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.as_str() == name)
    }
}

/// The body of `POST /v1/missions`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CreateMission {
    /// The robot's site.
    pub site: SiteId,
    /// The robot that is to drive.
    pub robot: RobotId,
    /// What it is to drive.
    pub trajectory: Trajectory,
    /// Past this time it never starts; it may wait for ever when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latest_start: Option<Timestamp>,
}

/// A mission as the server keeps it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Mission {
    /// The mission's identifier; ids sort by creation.
    pub id: MissionId,
    /// The robot's site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// Where it stands.
    pub state: MissionState,
    /// Why it stands there, for people.
    pub reason: Option<String>,
    /// Counts changes of what is to be driven.
    pub revision: u32,
    /// What exactly is to be driven.
    pub plan_hash: PlanHash,
    /// What is to be driven.
    pub trajectory: Trajectory,
    /// Past this time it never starts.
    pub latest_start: Option<Timestamp>,
    /// The run of the agent that took it.
    pub boot: Option<BootId>,
    /// What the robot planned.
    pub plan: Option<PlanSummary>,
    /// How far the robot has come, by its last word while the mission was its present one.
    pub progress: Option<MissionProgress>,
    /// When it was asked for.
    pub created_at: Timestamp,
    /// When the robot began.
    pub started_at: Option<Timestamp>,
    /// When it ended.
    pub ended_at: Option<Timestamp>,
}

/// A mission with its history.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MissionDetail {
    /// The mission.
    #[serde(flatten)]
    pub mission: Mission,
    /// What happened to it, oldest first.
    pub events: Vec<MissionEvent>,
}

/// What a robot planned for a mission.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PlanSummary {
    /// Length with the approach, metres.
    pub length_m: f64,
    /// Time that it takes when nothing slows the robot, seconds.
    pub duration_s: f64,
    /// Fastest planned speed, m/s.
    pub speed_peak_m_s: f64,
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
    /// Why, for people.
    pub reason: Option<String>,
}
