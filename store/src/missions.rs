//! Missions, and what is known of open ones.

use jiff::Timestamp;
use tread_api::ids::{BootId, MissionId, PlanHash, RobotId, SiteId};
use tread_api::mission::{Cause, LinkPolicy, Mission, MissionState, PlanSummary};
use tread_api::rights::Scope;
use tread_api::robot::MissionProgress;

/// A mission with the database key of its robot.
#[derive(Debug, Clone, PartialEq)]
pub struct MissionRow {
    /// Database key of the robot.
    pub robot_pk: i64,
    /// The mission, with the progress that was last reported durably.
    pub mission: Mission,
}

/// State in which a mission is inserted.
#[derive(Debug, Clone, Copy)]
pub struct Inserted<'reason> {
    /// The state.
    pub state: MissionState,
    /// Why it is in this state.
    pub cause: Cause,
    /// The same for people.
    pub reason: Option<&'reason str>,
}

/// Transition of a mission from one state to another.
#[derive(Debug, Clone, Copy)]
pub struct Transition<'reason> {
    /// State that is left.
    pub from: MissionState,
    /// State that is entered.
    pub to: MissionState,
    /// Why it is entered.
    pub cause: Cause,
    /// The same for people.
    pub reason: Option<&'reason str>,
}

/// Filter of a list of missions.
#[derive(Debug, Clone, Default)]
pub struct MissionFilter {
    /// Only those of this site.
    pub site: Option<SiteId>,
    /// Only those of robots of this name.
    pub robot: Option<RobotId>,
    /// Only those in this state.
    pub state: Option<MissionState>,
    /// Only those older than this one (cursor).
    pub before: Option<MissionId>,
    /// Only those of sites and robots in this scope.
    pub within: Scope,
}

/// Facts from a robot's answer or report; `None` leaves the stored value unchanged.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Facts {
    /// Run of the agent that accepted it.
    pub boot: Option<BootId>,
    /// Summary of the robot's plan.
    pub plan: Option<PlanSummary>,
    /// Progress.
    pub progress: Option<MissionProgress>,
    /// Time at which it began; only the first value counts.
    pub started_at: Option<Timestamp>,
    /// Time at which it ended; only the first value counts.
    pub ended_at: Option<Timestamp>,
}

/// State of an open mission, without its trajectory, which may be long.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenMission {
    /// The mission.
    pub id: MissionId,
    /// The robot's site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// Its state.
    pub state: MissionState,
    /// Reason of that state.
    pub reason: Option<String>,
    /// Run of the agent that accepted it.
    pub boot: Option<BootId>,
    /// Whether it is to be paused.
    pub pause_requested: bool,
    /// Priority; higher ones are driven first.
    pub priority: i32,
    /// Present revision and its plan hash.
    pub content: (u32, PlanHash),
    /// Revision that the robot does not have completely yet, and its plan hash.
    pub replacement: Option<(u32, PlanHash)>,
    /// Time since which its robot has not been heard; `None` while it is heard.
    pub silent_since: Option<Timestamp>,
    /// Time for which its robot may be unheard before the mission is lost, seconds; `None` for the
    /// default.
    pub lost_after_s: Option<f64>,
    /// Behaviour of its robot without a connection to the server.
    pub link_policy: LinkPolicy,
    /// Duration of the robot's plan, seconds.
    pub duration_s: Option<f64>,
}

impl From<&Mission> for OpenMission {
    fn from(mission: &Mission) -> Self {
        Self {
            id: mission.id,
            site: mission.site.clone(),
            robot: mission.robot.clone(),
            state: mission.state,
            reason: mission.reason.clone(),
            boot: mission.boot,
            pause_requested: mission.pause_requested,
            priority: mission.priority,
            content: (mission.revision, mission.plan_hash),
            replacement: mission
                .replacement
                .as_ref()
                .map(|replacement| (replacement.revision, replacement.plan_hash)),
            silent_since: None,
            lost_after_s: mission.lost_after_s,
            link_policy: mission.link_policy,
            duration_s: mission.plan.map(|plan| plan.duration_s),
        }
    }
}
