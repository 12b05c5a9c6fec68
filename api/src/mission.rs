//! Missions: one run of a trajectory on one robot, with its whole history.

use jiff::Timestamp;
mod event;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

pub use self::event::{Actor, Cause, MissionEvent};
use crate::geometry::{Point, Pose};
use crate::ids::{BootId, MissionId, PlanHash, RobotId, SiteId};
use crate::robot::MissionProgress;
pub use crate::start_policy::StartPolicy;
use crate::trajectory::Trajectory;

/// Longest reason or detail in a mission's history, in characters.
pub const REASON_LENGTH_MAX: usize = 500;
/// Lowest priority of a mission.
pub const PRIORITY_MIN: i32 = -100;
/// Highest priority of a mission.
pub const PRIORITY_MAX: i32 = 100;
/// Shortest silence after which a mission may make its robot stop, seconds: several heartbeats.
pub const LINK_SILENCE_MIN_S: f64 = 1.0;
/// Longest silence after which a mission may make its robot stop, and longest bound of a lost robot,
/// seconds.
pub const LINK_SILENCE_MAX_S: f64 = 86_400.0;
/// Most points of a driven path; a longer one is thinned further.
pub const DRIVEN_POINTS_MAX: usize = 2_000;
/// Most samples of θ in a quality report; the rest is thinned.
pub const THETA_SAMPLES_MAX: usize = 64;

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
    /// Missions of a higher priority are driven first, equal ones in their order; 0 when absent.
    #[serde(default)]
    #[schema(minimum = -100, maximum = 100)]
    pub priority: i32,
    /// What becomes of the robot's other missions; it waits behind them when absent.
    #[serde(default)]
    pub start_policy: StartPolicy,
    /// What the robot does when nothing more of the server arrives; it goes on when absent.
    #[serde(default)]
    pub link_policy: LinkPolicy,
    /// How long the robot may stay away before its mission fails as `robot_lost`, seconds. When
    /// absent: what was left of the plan and a margin, or the silence after which it stops and a
    /// margin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1.0, maximum = 86_400.0)]
    pub lost_after_s: Option<f64>,
}

/// What a robot does with its mission when nothing more of the server arrives.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LinkPolicy {
    /// It goes on to the end of the mission.
    #[default]
    Continue,
    /// It brakes along its path and ends the mission as failed after this long without contact.
    StopAfter {
        /// The silence, seconds, [`LINK_SILENCE_MIN_S`] to [`LINK_SILENCE_MAX_S`].
        #[schema(minimum = 1.0, maximum = 86_400.0)]
        silence_s: f64,
    },
}

impl LinkPolicy {
    /// Checks its figure.
    ///
    /// # Errors
    /// A sentence, if the silence is out of range.
    pub fn validate(&self) -> Result<(), String> {
        match *self {
            Self::StopAfter { silence_s }
                if !(LINK_SILENCE_MIN_S..=LINK_SILENCE_MAX_S).contains(&silence_s) =>
            {
                Err(format!(
                    "silence_s must be {LINK_SILENCE_MIN_S} to {LINK_SILENCE_MAX_S}, not {silence_s}"
                ))
            }
            Self::Continue | Self::StopAfter { .. } => Ok(()),
        }
    }
}

/// The body of `POST /v1/missions/{mission}/replace`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ReplaceMission {
    /// What is to be driven from where the robot is then.
    pub trajectory: Trajectory,
}

/// A new revision of a mission that its robot does not hold whole yet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Replacement {
    /// The revision that it will be.
    pub revision: u32,
    /// What exactly it is.
    pub plan_hash: PlanHash,
    /// What is to be driven.
    pub trajectory: Trajectory,
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
    /// Why it stands there, for programs.
    pub cause: Cause,
    /// Whether it is to be paused; the robot has not answered yet while the state differs.
    pub pause_wanted: bool,
    /// Counts changes of what is to be driven.
    pub revision: u32,
    /// What exactly is to be driven.
    pub plan_hash: PlanHash,
    /// What is to be driven.
    pub trajectory: Trajectory,
    /// A new revision that the robot does not hold whole yet.
    pub replacement: Option<Replacement>,
    /// Past this time it never starts.
    pub latest_start: Option<Timestamp>,
    /// Missions of a higher priority are driven first.
    pub priority: i32,
    /// What the robot does when nothing more of the server arrives.
    pub link_policy: LinkPolicy,
    /// How long the robot may stay away before it counts as lost, seconds, if that was given.
    pub lost_after_s: Option<f64>,
    /// The run of the agent that took it.
    pub boot: Option<BootId>,
    /// What the robot planned.
    pub plan: Option<PlanSummary>,
    /// How far the robot has come, by its last report while the mission was its present one.
    pub progress: Option<MissionProgress>,
    /// When it was requested.
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
    /// How well it was driven, once the robot has reported it.
    pub quality: Option<MissionQuality>,
    /// Where the robot really was, once it has reported it.
    pub driven: Option<DrivenPath>,
}

/// How well a mission was driven, measured by its robot.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct MissionQuality {
    /// Time from the first wheel command to the end, pauses included, seconds.
    pub duration_s: f64,
    /// Time that it stood paused, seconds.
    pub paused_s: f64,
    /// Distance that the robot travelled, metres.
    pub distance_m: f64,
    /// Root of the mean square of the distance from the path, metres.
    pub cross_track_rms_m: f64,
    /// Largest distance from the path, metres.
    pub cross_track_max_m: f64,
    /// Share of the ticks in which a wheel was at its limit, 0 to 1.
    pub saturated_ratio: f64,
    /// Number of sudden losses of traction: changes of friction, and slip beyond the model.
    pub slip_events: u32,
    /// Share of the ticks in which the safety gate reduced the command, 0 to 1.
    pub gate_reduced_ratio: f64,
    /// How often the safety gate began to hold the robot.
    pub gate_stops: u32,
    /// θ along the driven path, at most [`THETA_SAMPLES_MAX`].
    pub theta: Vec<ThetaSample>,
    /// Value of the map's prior for this mission; absent when the map knew nothing along the path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prior: Option<PriorGain>,
}

/// Value of the map's prior for a mission: on how much of the path it gave the robot θ, and how
/// accurate it was.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct PriorGain {
    /// Friction coefficient that the plan was made with.
    #[serde(alias = "grip_mu")]
    pub traction_limit_mu: f64,
    /// Share of the driven path on cells with known θ, 0 to 1.
    pub known_ratio: f64,
    /// Time in which θ was known to [`THETA_SURE_RATIO`], seconds.
    pub sure_s: f64,
    /// The same if the robot had had only its own measurements, seconds.
    pub sure_alone_s: f64,
    /// Time from the start until the robot's own measurement was as sure, seconds; `null` if it
    /// never was.
    pub first_sure_alone_s: Option<f64>,
    /// Cells that the robot has measured and for which the map had an estimate.
    pub cells_compared: u32,
    /// Of these, cells that contradicted the map.
    pub cells_contradicted: u32,
    /// Mean of measured over expected θ, less one; `null` without any cell.
    pub difference_ratio: Option<f64>,
    /// Root mean square of the differences over their standard deviations: about 1 where the stated
    /// uncertainties are right; `null` without any cell.
    pub difference_rms: Option<f64>,
}

/// Relative standard deviation below which θ counts as known.
pub const THETA_SURE_RATIO: f64 = 0.2;

/// Friction at one place of a mission.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ThetaSample {
    /// Arc length, metres.
    pub driven_m: f64,
    /// θ̂ of the tracking law.
    pub theta_loop: f64,
    /// Measured θ, when it was known.
    pub theta_measured: Option<f64>,
    /// Standard deviation of measured θ.
    pub theta_sd: Option<f64>,
}

/// Where a robot really was during a mission.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct DrivenPath {
    /// No place of the whole path is further than this from the line through the points, metres.
    pub tolerance_m: f64,
    /// The points in their order, at most [`DRIVEN_POINTS_MAX`].
    pub points: Vec<Point>,
    /// When the robot was at each point, seconds since its first wheel command, pauses included;
    /// between two points it went about evenly. Empty from an older agent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub times_s: Vec<f64>,
}

impl DrivenPath {
    /// Whether its times are those of its points, in order.
    pub fn has_possible_times(&self) -> bool {
        self.times_s.is_empty()
            || (self.times_s.len() == self.points.len()
                && self.times_s.iter().all(|time_s| time_s.is_finite())
                && self.times_s.is_sorted())
    }
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
    /// Where the robot was when it planned, and how it was headed. Absent from an older agent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub begin: Option<Pose>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_the_database_are_those_on_the_wire() {
        for cause in Cause::ALL {
            let name = serde_json::to_value(cause).unwrap();
            assert_eq!(name, cause.as_str());
            assert_eq!(Cause::from_name(cause.as_str()), Some(cause));
        }
        for state in MissionState::ALL {
            assert_eq!(serde_json::to_value(state).unwrap(), state.as_str());
            assert_eq!(MissionState::from_name(state.as_str()), Some(state));
        }
    }

    #[test]
    fn a_silence_that_is_no_time_is_refused() {
        for silence_s in [f64::NAN, 0.0, -1.0, 0.9, 1e9] {
            assert!(LinkPolicy::StopAfter { silence_s }.validate().is_err());
        }
        assert!(LinkPolicy::StopAfter { silence_s: 5.0 }.validate().is_ok());
        let said: LinkPolicy = serde_json::from_str("\"continue\"").unwrap();
        assert_eq!(said, LinkPolicy::default());
    }
}
