//! Commands about missions, from the server to a robot.
//!
//! Each command is a zenoh query; its replies are in [`reply`](super::reply). Without a reply the
//! command counts as not delivered: the server sends it again. Commands are idempotent on the
//! robot.

use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::reply::{Acknowledgement, Command, OfferReply, OutcomesReply};
use crate::friction::{ROBOT_BIAS_RATIO, THETA_MAX};
use crate::ids::{DERIVED_NAMESPACE, MissionId, PlanHash};
use crate::keys::Verb;
use crate::mission::LinkPolicy;
use crate::site::Cell;
use crate::trajectory::Trajectory;

/// `cmd/offer`: offers a mission to drive.
///
/// A higher revision of the active mission replaces it: the robot plans the new revision from its
/// present position and switches only when the plan is complete. Until its answer, and after a
/// refusal, it keeps driving the old revision.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Offer {
    /// Identifier of the mission.
    pub mission: MissionId,
    /// Revision of the mission.
    pub revision: u32,
    /// Hash of mission, revision and trajectory; see [`Offer::plan_hash_of`].
    pub plan_hash: PlanHash,
    /// Trajectory to drive.
    pub trajectory: Trajectory,
    /// Time from now within which the mission may start, milliseconds; `None` without limit.
    pub start_within_ms: Option<u64>,
    /// Behaviour when the server is silent.
    #[serde(default)]
    pub link_policy: LinkPolicy,
    /// Data of the friction map along the path; absent when the map has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prior: Option<PathPrior>,
    /// Whether the robot holds the mission at its start until it is resumed, because it was paused,
    /// or the robot stopped, before the robot accepted the mission. Ignored for a new revision of
    /// an accepted mission.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub on_hold: bool,
}

/// Maximum number of cells of a prior.
pub const PRIOR_CELLS_MAX: usize = 4_096;

/// Data of the friction map along a path. It is used for planning and tracking only; it never
/// enters a measurement, and it is not part of the plan hash.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PathPrior {
    /// Revision of the grid to which the cells refer.
    pub grid_revision: u32,
    /// Traction limit off the cells of `traction_limits`, a friction coefficient above 0: the
    /// lowest along the path.
    #[serde(alias = "grip_mu")]
    pub traction_limit_mu: f64,
    /// Standard deviation of one robot's θ around the common θ of all robots, as a ratio of it, 0
    /// to 1.
    #[serde(default = "robot_bias_ratio")]
    pub robot_bias_ratio: f64,
    /// Cells with known θ that contain a single terrain, at most [`PRIOR_CELLS_MAX`].
    pub cells: Vec<CellPrior>,
    /// Traction limits of cells along the path, at most [`PRIOR_CELLS_MAX`]. `traction_limit_mu`
    /// applies in all other cells.
    #[serde(default, alias = "grips", skip_serializing_if = "Vec::is_empty")]
    pub traction_limits: Vec<CellTractionLimit>,
}

/// Traction limit of a cell, for planning.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CellTractionLimit {
    /// The cell.
    pub cell: Cell,
    /// Friction coefficient above 0 that a plan may use; a lower bound of the peak.
    pub mu: f64,
}

/// Default for servers that do not send the ratio.
const fn robot_bias_ratio() -> f64 {
    ROBOT_BIAS_RATIO
}

/// θ of the friction map in one cell.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CellPrior {
    /// The cell.
    pub cell: Cell,
    /// θ for the robot's model, above 0.
    pub theta: f64,
    /// Standard deviation of θ, including age and biases, above 0.
    pub std_dev: f64,
}

impl PathPrior {
    /// Whether every number is within its range and the lists are not too long.
    pub fn is_possible(&self) -> bool {
        let is_positive = |value: f64| value.is_finite() && value > 0.0;
        let is_known = |cell: &CellPrior| {
            is_positive(cell.theta) && cell.theta <= THETA_MAX && is_positive(cell.std_dev)
        };
        is_positive(self.traction_limit_mu)
            && (0.0..=1.0).contains(&self.robot_bias_ratio)
            && self.cells.len() <= PRIOR_CELLS_MAX
            && self.cells.iter().all(is_known)
            && self.traction_limits.len() <= PRIOR_CELLS_MAX
            && self
                .traction_limits
                .iter()
                .all(|limit| is_positive(limit.mu))
    }
}

impl Offer {
    /// Returns the hash of a request: of mission, revision and trajectory, not of the planned
    /// samples.
    pub fn plan_hash_of(mission: MissionId, revision: u32, trajectory: &Trajectory) -> PlanHash {
        let request = serde_json::to_vec(&(mission, revision, trajectory)).unwrap_or_default();
        PlanHash::from_uuid(Uuid::new_v5(&DERIVED_NAMESPACE, &request))
    }
}

/// `cmd/cancel`: ends a mission; the robot brakes along its path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cancel {
    /// Identifier of the mission.
    pub mission: MissionId,
    /// Reason, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub reason: String,
}

/// `cmd/pause`: pauses a mission; the robot brakes along its path and holds the mission at rest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pause {
    /// Identifier of the mission.
    pub mission: MissionId,
    /// Revision of the mission.
    pub revision: u32,
}

/// `cmd/resume`: resumes a paused mission from the place where it was paused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Resume {
    /// Identifier of the mission.
    pub mission: MissionId,
    /// Revision of the mission.
    pub revision: u32,
}

/// Maximum number of missions of one [`Outcomes`].
pub const OUTCOMES_MAX: usize = 2_000;

/// `cmd/outcomes`: asks how missions ended on the robot. A server asks that was restored from a
/// backup, and does not know what happened since.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Outcomes {
    /// Missions, at most [`OUTCOMES_MAX`].
    pub missions: Vec<MissionId>,
}

impl Command for Outcomes {
    const VERB: Verb = Verb::Outcomes;
    type Reply = OutcomesReply;
}

impl Command for Offer {
    const VERB: Verb = Verb::Offer;
    type Reply = OfferReply;
}

impl Command for Cancel {
    const VERB: Verb = Verb::Cancel;
    type Reply = Acknowledgement;
}

impl Command for Pause {
    const VERB: Verb = Verb::Pause;
    type Reply = Acknowledgement;
}

impl Command for Resume {
    const VERB: Verb = Verb::Resume;
    type Reply = Acknowledgement;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_plan_hash_tells_requests_apart_and_survives_the_wire() {
        let mission = MissionId::from_uuid(Uuid::from_u128(1));
        let text = r#"{"circle":{"center":{"x_m":0.1,"y_m":0.2},"radius_m":3.3,"speed_m_s":0.7}}"#;
        let trajectory: Trajectory = serde_json::from_str(text).unwrap();
        let hash = Offer::plan_hash_of(mission, 1, &trajectory);
        let again: Trajectory =
            serde_json::from_str(&serde_json::to_string(&trajectory).unwrap()).unwrap();
        assert_eq!(Offer::plan_hash_of(mission, 1, &again), hash);
        assert_ne!(Offer::plan_hash_of(mission, 2, &trajectory), hash);
        let other: Trajectory = serde_json::from_str(&text.replace("3.3", "3.4")).unwrap();
        assert_ne!(Offer::plan_hash_of(mission, 1, &other), hash);
    }
}
