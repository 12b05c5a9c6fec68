//! Missions: runs of a trajectory on one robot, with their state, history and quality.

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

/// Maximum length of a reason or detail in a mission's history, characters.
pub const REASON_LENGTH_MAX: usize = 500;
/// Minimum priority of a mission.
pub const PRIORITY_MIN: i32 = -100;
/// Maximum priority of a mission.
pub const PRIORITY_MAX: i32 = 100;
/// Minimum silence of the server after which [`LinkPolicy::StopAfter`] may stop a robot, seconds;
/// several heartbeats.
pub const LINK_SILENCE_MIN_S: f64 = 1.0;
/// Maximum silence of the server in [`LinkPolicy::StopAfter`], and maximum `lost_after_s` of a
/// mission, seconds.
pub const LINK_SILENCE_MAX_S: f64 = 86_400.0;
/// Maximum number of points of a driven path; a longer path is simplified further.
pub const DRIVEN_POINTS_MAX: usize = 2_000;
/// Maximum number of samples of θ in a quality report; a longer series is thinned out.
pub const THETA_SAMPLES_MAX: usize = 64;

/// State of a mission. The last five states are terminal: a mission never leaves them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum MissionState {
    /// Waits in the queue of its robot.
    Queued,
    /// Sent to the robot, which has not answered yet.
    Offered,
    /// Being driven by the robot.
    Active,
    /// Paused; the robot has stopped on the path.
    Paused,
    /// Cancellation requested; the robot has not confirmed it yet.
    Cancelling,
    /// Driven to the end.
    Succeeded,
    /// Ended by a failure.
    Failed,
    /// Ended by request.
    Cancelled,
    /// Refused by the robot.
    Rejected,
    /// Ended because it had not begun by its latest start.
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

    /// Whether the state is terminal.
    pub const fn is_terminal(self) -> bool {
        matches!(
            self,
            Self::Succeeded | Self::Failed | Self::Cancelled | Self::Rejected | Self::Expired
        )
    }

    /// Returns the state's name on the wire and in the database.
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

    /// Returns the state with this name; `None` if there is none.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.as_str() == name)
    }
}

/// Body of `POST /v1/missions`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CreateMission {
    /// Site of the robot.
    pub site: SiteId,
    /// Robot that is to drive.
    pub robot: RobotId,
    /// Trajectory to drive.
    pub trajectory: Trajectory,
    /// Latest time at which the mission may start; it expires then if it has not begun. Without
    /// limit when absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latest_start: Option<Timestamp>,
    /// Priority in the robot's queue: a higher one is driven first, equal ones in the order of
    /// creation; 0 when absent.
    #[serde(default)]
    #[schema(minimum = -100, maximum = 100)]
    pub priority: i32,
    /// Effect on the robot's other missions; when absent, this mission waits behind them.
    #[serde(default)]
    pub start_policy: StartPolicy,
    /// Behaviour of the robot when the server is silent; it continues the mission when absent.
    #[serde(default)]
    pub link_policy: LinkPolicy,
    /// Time for which the robot may be offline before the mission fails with the cause
    /// `robot_lost`, seconds. When absent: the remaining planned time, or the silence of
    /// `link_policy`, and a margin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1.0, maximum = 86_400.0)]
    pub lost_after_s: Option<f64>,
}

/// Behaviour of a robot during a mission when the server is silent.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LinkPolicy {
    /// Continues the mission to its end.
    #[default]
    Continue,
    /// Brakes along the path and ends the mission as failed when the server was silent for this
    /// time.
    StopAfter {
        /// Silence of the server after which the robot brakes, seconds, 1 to 86 400.
        #[schema(minimum = 1.0, maximum = 86_400.0)]
        silence_s: f64,
    },
}

impl LinkPolicy {
    /// Checks that the silence is within its range.
    ///
    /// # Errors
    /// A message for people, if it is not.
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

/// Body of `POST /v1/missions/{mission}/replace`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ReplaceMission {
    /// New trajectory, which the robot drives from its position at that time.
    pub trajectory: Trajectory,
}

/// New revision of a mission that the robot has not accepted yet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Replacement {
    /// Number of the new revision.
    pub revision: u32,
    /// Hash of the new trajectory with its revision.
    pub plan_hash: PlanHash,
    /// Trajectory of the new revision.
    pub trajectory: Trajectory,
}

/// Mission as the server stores it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Mission {
    /// Identifier of the mission; identifiers sort by creation.
    pub id: MissionId,
    /// Site of the robot.
    pub site: SiteId,
    /// Robot that drives the mission.
    pub robot: RobotId,
    /// Present state.
    pub state: MissionState,
    /// Reason of the present state, for people; `null` without one.
    pub reason: Option<String>,
    /// Cause of the present state, for programs.
    pub cause: Cause,
    /// Whether a pause is requested. While this differs from `state`, the robot has not confirmed
    /// it yet.
    #[serde(alias = "pause_wanted")]
    pub pause_requested: bool,
    /// Number of the present revision of the trajectory.
    pub revision: u32,
    /// Hash of the trajectory with its revision.
    pub plan_hash: PlanHash,
    /// Trajectory to drive.
    pub trajectory: Trajectory,
    /// New revision that the robot has not accepted yet; `null` without one.
    pub replacement: Option<Replacement>,
    /// Latest time at which the mission may start; `null` without a limit.
    pub latest_start: Option<Timestamp>,
    /// Priority in the robot's queue, −100 to 100; a higher one is driven first.
    pub priority: i32,
    /// Behaviour of the robot when the server is silent.
    pub link_policy: LinkPolicy,
    /// Time for which the robot may be offline before the mission fails, seconds; `null` for the
    /// default.
    pub lost_after_s: Option<f64>,
    /// Run of the agent that accepted the mission; `null` before that.
    pub boot: Option<BootId>,
    /// Summary of the robot's plan; `null` before the robot has reported it.
    pub plan: Option<PlanSummary>,
    /// Progress that the robot reported last while this was its active mission; `null` before that.
    pub progress: Option<MissionProgress>,
    /// Time when the mission was requested.
    pub created_at: Timestamp,
    /// Time when the robot began to drive; `null` before that.
    pub started_at: Option<Timestamp>,
    /// Time when the mission ended; `null` before that.
    pub ended_at: Option<Timestamp>,
}

/// Mission with its history and the results of its run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MissionDetail {
    /// The mission.
    #[serde(flatten)]
    pub mission: Mission,
    /// Steps of its history, the oldest first.
    pub events: Vec<MissionEvent>,
    /// Quality of the run; `null` until the robot has reported it.
    pub quality: Option<MissionQuality>,
    /// Path that the robot drove, as it measured it; `null` until the robot has reported it.
    pub driven: Option<DrivenPath>,
}

/// Quality of a mission's run, measured by the robot.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct MissionQuality {
    /// Time from the first wheel command to the end, including pauses, seconds.
    pub duration_s: f64,
    /// Time for which the mission was paused with the robot stopped, seconds.
    pub paused_s: f64,
    /// Distance travelled, metres.
    pub distance_m: f64,
    /// Root mean square of the cross-track error, metres.
    pub cross_track_rms_m: f64,
    /// Maximum absolute cross-track error, metres.
    pub cross_track_max_m: f64,
    /// Fraction of the control ticks in which a wheel was at its limit, 0 to 1.
    pub saturated_ratio: f64,
    /// Number of sudden losses of traction: changes of friction, and slip beyond the model.
    pub slip_events: u32,
    /// Fraction of the control ticks in which the safety gate reduced the command, 0 to 1.
    pub gate_reduced_ratio: f64,
    /// Number of times that the safety gate began to hold the robot.
    pub gate_stops: u32,
    /// Samples of θ along the driven path, at most 64.
    pub theta: Vec<ThetaSample>,
    /// Value of the friction map's prior for this mission; absent when the map had no data along
    /// the path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prior: Option<PriorGain>,
}

/// Value of the friction map's prior for a mission: coverage of the path, and accuracy of its θ.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct PriorGain {
    /// Traction limit with which the plan was made, a friction coefficient.
    #[serde(alias = "grip_mu")]
    pub traction_limit_mu: f64,
    /// Fraction of the driven distance on cells for which the map had θ, 0 to 1.
    pub known_ratio: f64,
    /// Time for which θ was known, from the prior and the robot's measurements, with a relative
    /// standard deviation of at most 20 %, seconds.
    #[serde(alias = "sure_s")]
    pub known_s: f64,
    /// Time for which θ was known that accurately from the robot's own measurements alone, seconds.
    #[serde(alias = "sure_alone_s")]
    pub known_alone_s: f64,
    /// Time from the start until the robot's own measurement reached that accuracy, seconds; `null`
    /// if it never did.
    #[serde(alias = "first_sure_alone_s")]
    pub first_known_alone_s: Option<f64>,
    /// Number of cells with θ from the map in which the robot measured θ too.
    pub cells_compared: u32,
    /// Number of compared cells in which the measurement contradicted the map.
    pub cells_contradicted: u32,
    /// Mean of (measured θ / θ of the map) − 1 over the compared cells; `null` if there are none.
    pub difference_ratio: Option<f64>,
    /// Root mean square, over the compared cells, of the difference of θ over its standard
    /// deviation: about 1 if the stated uncertainties are right; `null` if there are no compared
    /// cells.
    pub difference_rms: Option<f64>,
}

/// Relative standard deviation up to which θ counts as known.
pub const THETA_SURE_RATIO: f64 = 0.2;

/// Sample of θ at one place of a mission.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ThetaSample {
    /// Arc length driven, metres.
    pub driven_m: f64,
    /// Adapted estimate θ̂ of the tracking law.
    pub theta_loop: f64,
    /// Measured θ; `null` where it was unknown.
    pub theta_measured: Option<f64>,
    /// Standard deviation of measured θ; `null` where it was unknown.
    #[serde(alias = "theta_sd")]
    pub theta_std_dev: Option<f64>,
}

/// Path that a robot drove during a mission, as it measured it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, ToSchema)]
pub struct DrivenPath {
    /// Tolerance of the simplification, metres: the maximum distance of the full path from the
    /// polyline through `points`.
    pub tolerance_m: f64,
    /// Points in driving order, in the site frame; at most 2 000.
    pub points: Vec<Point>,
    /// Time at each point since the first wheel command, pauses included, seconds; interpolate
    /// linearly between points. Empty from an older agent.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub times_s: Vec<f64>,
}

impl DrivenPath {
    /// Whether `times_s` is empty, or has one finite time per point in ascending order.
    pub fn has_possible_times(&self) -> bool {
        self.times_s.is_empty()
            || (self.times_s.len() == self.points.len()
                && self.times_s.iter().all(|time_s| time_s.is_finite())
                && self.times_s.is_sorted())
    }
}

/// Summary of a robot's plan for a mission.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PlanSummary {
    /// Length including the approach, metres.
    pub length_m: f64,
    /// Planned duration, seconds, if nothing slows the robot.
    pub duration_s: f64,
    /// Maximum planned speed, m/s.
    pub speed_peak_m_s: f64,
    /// Pose from which the robot planned. Absent from an older agent.
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
        for (former, cause) in [
            ("robot_forgot", Cause::RobotLostMission),
            ("noted", Cause::Recorded),
        ] {
            assert_eq!(Cause::from_name(former), Some(cause));
            assert_eq!(
                serde_json::from_value::<Cause>(former.into()).unwrap(),
                cause
            );
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

    /// Missions that ended before the fields were renamed are stored with the former names.
    #[test]
    fn a_gain_that_is_stored_under_former_names_is_read() {
        let stored = r#"{"traction_limit_mu": 0.2, "known_ratio": 0.5, "sure_s": 3.0, "sure_alone_s": 1.0,
            "first_sure_alone_s": 2.0, "cells_compared": 4, "cells_contradicted": 1}"#;
        let read: PriorGain = serde_json::from_str(stored).unwrap();
        let expected = PriorGain {
            traction_limit_mu: 0.2,
            known_ratio: 0.5,
            known_s: 3.0,
            known_alone_s: 1.0,
            first_known_alone_s: Some(2.0),
            cells_compared: 4,
            cells_contradicted: 1,
            ..PriorGain::default()
        };
        assert_eq!(read, expected);
    }
}
