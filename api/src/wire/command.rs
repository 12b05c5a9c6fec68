//! Commands about missions, from the server to a robot.
//!
//! Each is a zenoh query; what a robot replies is in [`reply`](super::reply). No reply means not
//! delivered: the server sends the same again, and the robot takes the same twice without harm.

use serde::{Deserialize, Serialize};
use uuid::Uuid;

use super::reply::{Acknowledgement, Command, OfferReply};
use crate::friction::{ROBOT_BIAS_RATIO, THETA_MAX};
use crate::ids::{DERIVED_NAMESPACE, MissionId, PlanHash};
use crate::keys::Verb;
use crate::mission::LinkPolicy;
use crate::site::Cell;
use crate::trajectory::Trajectory;

/// `cmd/offer`: drive this mission.
///
/// A higher revision of the active mission replaces it: the robot plans the new one from where
/// it is and swaps only when it holds it whole; until its answer the old one goes on, and after a
/// refusal too.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Offer {
    /// The mission.
    pub mission: MissionId,
    /// Its revision.
    pub revision: u32,
    /// What exactly is to be driven; see [`Offer::plan_hash_of`].
    pub plan_hash: PlanHash,
    /// What is to be driven.
    pub trajectory: Trajectory,
    /// How long from now the mission may still start, milliseconds; `None` for ever.
    pub start_within_ms: Option<u64>,
    /// What to do when the server is no longer heard.
    #[serde(default)]
    pub link_policy: LinkPolicy,
    /// What the map knows along the path; absent when it knows nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prior: Option<PathPrior>,
    /// Whether it is to stand at its start until it is resumed: whoever paused it, or stopped the
    /// robot before it was taken, has not let it go on. Counts only when the mission is taken.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub on_hold: bool,
}

/// Most cells of a prior.
pub const PRIOR_CELLS_MAX: usize = 4_096;

/// What the map knows along a path. It helps the robot to drive and never goes into what it
/// measures; nor is it part of what is to be driven.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PathPrior {
    /// The grid that cuts the cells.
    pub grid_revision: u32,
    /// Friction coefficient to plan with: the lowest along the path, above zero.
    #[serde(alias = "grip_mu")]
    pub traction_limit_mu: f64,
    /// Standard deviation of one robot's own θ around that of all robots as a share of it, 0 to 1.
    #[serde(default = "robot_bias_ratio")]
    pub robot_bias_ratio: f64,
    /// Cells of one ground of which θ is known, at most [`PRIOR_CELLS_MAX`].
    pub cells: Vec<CellPrior>,
    /// Friction coefficient to plan with by place, for cells along the path, at most
    /// [`PRIOR_CELLS_MAX`]; `traction_limit_mu` holds away from them, and everywhere where there
    /// are none.
    #[serde(default, alias = "grips", skip_serializing_if = "Vec::is_empty")]
    pub traction_limits: Vec<CellTractionLimit>,
}

/// Traction limit of a cell, for a plan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CellTractionLimit {
    /// The cell.
    pub cell: Cell,
    /// Friction coefficient, above zero: a lower bound of the peak.
    pub mu: f64,
}

/// Default of servers.
const fn robot_bias_ratio() -> f64 {
    ROBOT_BIAS_RATIO
}

/// What the map knows of a cell.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CellPrior {
    /// The cell.
    pub cell: Cell,
    /// θ for the robot's model, above zero.
    pub theta: f64,
    /// Its standard deviation, with age and biases, above zero.
    pub std_dev: f64,
}

impl PathPrior {
    /// Whether every number is possible and there are not too many.
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
    /// The hash of a request: of its trajectory and revision, never of samples.
    pub fn plan_hash_of(mission: MissionId, revision: u32, trajectory: &Trajectory) -> PlanHash {
        let request = serde_json::to_vec(&(mission, revision, trajectory)).unwrap_or_default();
        PlanHash::from_uuid(Uuid::new_v5(&DERIVED_NAMESPACE, &request))
    }
}

/// `cmd/cancel`: end this mission, braking along its path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cancel {
    /// The mission.
    pub mission: MissionId,
    /// Why, for people.
    #[serde(deserialize_with = "crate::text::bounded::<_, {crate::mission::REASON_LENGTH_MAX}>")]
    pub reason: String,
}

/// `cmd/pause`: brake along the path of this mission and hold it, standing.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pause {
    /// The mission.
    pub mission: MissionId,
    /// Its revision.
    pub revision: u32,
}

/// `cmd/resume`: drive this mission on from where it was paused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Resume {
    /// The mission.
    pub mission: MissionId,
    /// Its revision.
    pub revision: u32,
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
