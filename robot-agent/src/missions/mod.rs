//! State of the robot's missions: the active one, those that have ended, and the answers to
//! commands.
//!
//! ```text
//!            offer                    report of the loop
//! (unknown) ───────► active ────────────────────────────► ended
//!     │              │ ▲ └ cancel: active, braking ────────▲
//!     │              └─┘ offer of a higher revision        │
//!     └ cancel ────────────────────────────────────────────┘
//! ```
//!
//! [`MissionSlot`] is pure: it decides, its callers act. An ended mission never becomes active
//! again, even by a late offer; [`memory`] keeps that over restarts of the agent.

pub mod memory;
mod stored_ends;
#[cfg(test)]
pub(crate) mod tests;

use std::collections::{HashSet, VecDeque};

use serde::{Deserialize, Serialize};
use tread_api::ids::{MissionId, PlanHash};
use tread_api::mission::PlanSummary;
use tread_api::wire::command::Offer;
use tread_api::wire::ingest::{MissionPhase, MissionReport};
use tread_api::wire::reply::{
    AcceptedMission, CommandRefusal, CommandRefusalCode, EndedMission, MissionOutcomes,
};

use self::stored_ends::StoredEnds;
pub use self::stored_ends::UNRECORDED_ENDS_MAX;

/// Number of ended missions that are remembered; the oldest is dropped first.
pub const ENDED_MAX: usize = 1_000;

/// A mission that the robot has accepted and that has not ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ActiveMission {
    /// The mission.
    pub mission: MissionId,
    /// Its revision.
    pub revision: u32,
    /// Hash of the plan that is driven.
    pub plan_hash: PlanHash,
    /// Summary of the plan.
    pub plan: PlanSummary,
    /// Whether its cancellation was answered to the server; it then ends as cancelled.
    #[serde(default)]
    pub is_cancelled: bool,
}

/// A mission that has ended on this robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ended {
    /// The mission.
    pub mission: MissionId,
    /// How it ended.
    pub phase: MissionPhase,
}

/// The active mission and the ended ones.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MissionSlot {
    #[serde(alias = "held")]
    active: Option<ActiveMission>,
    ended: VecDeque<Ended>,
    /// Newest of the missions that were dropped from `ended`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    forgotten: Option<MissionId>,
    /// Phase of the active mission's end, while that is being recorded.
    #[serde(skip)]
    ending: Option<MissionPhase>,
    /// Reports of ends until the outbox has them on disk, at most [`UNRECORDED_ENDS_MAX`]. Each is
    /// saved before the outbox gets it, so that an agent that is killed in between reports this end
    /// and no other one.
    #[serde(
        default,
        alias = "unrecorded_end",
        skip_serializing_if = "StoredEnds::is_empty"
    )]
    unrecorded_ends: StoredEnds,
}

/// Decision on an offer.
#[derive(Debug, Clone, PartialEq)]
pub enum OfferDecision {
    /// It is new: plan it, send it to the loop, then [`MissionSlot::take`] it.
    Plan,
    /// It is a new revision of the active mission: plan it from where the robot stops, then
    /// [`MissionSlot::replace`] the old one and send it to the loop.
    Replace,
    /// It is active already: answer with the same plan.
    AcceptAgain(PlanSummary),
    /// It is refused, with the reason.
    Refuse(CommandRefusal),
}

/// Decision on a cancellation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CancelDecision {
    /// The mission is active: brake along its path.
    Brake,
    /// It was cancelled before.
    CancelledBefore,
    /// It ended in another phase before.
    EndedBefore(MissionPhase),
    /// It was never offered here; a later offer of it is refused.
    Unknown,
}

impl MissionSlot {
    /// Returns the active mission.
    pub fn active(&self) -> Option<&ActiveMission> {
        self.active.as_ref()
    }

    /// Returns the missions that have ended here, oldest first.
    pub fn ended(&self) -> impl Iterator<Item = &Ended> {
        self.ended.iter()
    }

    fn ended_phase(&self, mission: MissionId) -> Option<MissionPhase> {
        self.ended
            .iter()
            .find(|ended| ended.mission == mission)
            .map(|ended| ended.phase)
    }

    /// Returns how missions ended here, for a server that does not know.
    pub fn outcomes(&self, requested: &[MissionId]) -> MissionOutcomes {
        let requested: HashSet<MissionId> = requested.iter().copied().collect();
        let ended = self
            .ended
            .iter()
            .filter(|it| requested.contains(&it.mission));
        let ended = ended.map(|&Ended { mission, phase }| EndedMission { mission, phase });
        let accepted = |active: &ActiveMission| AcceptedMission {
            mission: active.mission,
            revision: active.revision,
            plan_hash: active.plan_hash,
        };
        MissionOutcomes {
            ended: ended.collect(),
            active: self.active.as_ref().map(accepted),
            forgotten: self.forgotten,
        }
    }

    /// Decides on an offer; changes nothing.
    pub fn offer(&self, offer: &Offer) -> OfferDecision {
        let refuse =
            |code, detail: String| OfferDecision::Refuse(CommandRefusal::new(code, detail));
        let mission = offer.mission;
        if let Some(phase) = self.ended_phase(mission) {
            let detail = format!(
                "mission {mission} has ended here before: {}",
                name_of(phase)
            );
            return refuse(CommandRefusalCode::Ended, detail);
        }
        match &self.active {
            None => OfferDecision::Plan,
            Some(active) if active.mission == mission && active.is_cancelled => refuse(
                CommandRefusalCode::Ended,
                format!("mission {mission} is being cancelled"),
            ),
            Some(active) if active.mission != mission => {
                let detail = format!("mission {} is being driven", active.mission);
                refuse(CommandRefusalCode::Busy, detail)
            }
            Some(active)
                if active.revision == offer.revision && active.plan_hash == offer.plan_hash =>
            {
                OfferDecision::AcceptAgain(active.plan)
            }
            Some(active) if active.revision < offer.revision => OfferDecision::Replace,
            Some(active) => {
                let detail = format!(
                    "mission {mission} is active as revision {} with plan hash {}",
                    active.revision, active.plan_hash
                );
                refuse(CommandRefusalCode::Conflict, detail)
            }
        }
    }

    /// Makes a mission the active one; false, without a change, if a mission is active or this one
    /// has ended.
    #[must_use]
    pub fn take(&mut self, active: ActiveMission) -> bool {
        let is_free = self.active.is_none() && self.ended_phase(active.mission).is_none();
        if is_free {
            self.active = Some(active);
        }
        is_free
    }

    /// Replaces the active revision by a higher one and returns the old one; `None`, without a
    /// change, if the mission is not active, is cancelled or is ending.
    #[must_use]
    pub fn replace(&mut self, next: ActiveMission) -> Option<ActiveMission> {
        let active = self.active.as_mut()?;
        let is_next = active.mission == next.mission
            && active.revision < next.revision
            && !active.is_cancelled
            && self.ending.is_none();
        is_next.then(|| std::mem::replace(active, next))
    }

    /// Restores a former revision, if the later one could not be sent to the loop.
    pub fn restore(&mut self, former: ActiveMission) {
        if let Some(active) = self
            .active
            .as_mut()
            .filter(|active| active.mission == former.mission)
        {
            *active = former;
        }
    }

    /// Checks whether a mission is active in this revision, to be paused or resumed.
    ///
    /// # Errors
    /// The refusal for the server.
    pub fn check_active(&self, mission: MissionId, revision: u32) -> Result<(), CommandRefusal> {
        let refuse = |code, detail: String| Err(CommandRefusal::new(code, detail));
        if let Some(phase) = self.ended_phase(mission) {
            let detail = format!("it has ended before: {}", name_of(phase));
            return refuse(CommandRefusalCode::Ended, detail);
        }
        match &self.active {
            Some(active) if active.mission == mission && active.is_cancelled => refuse(
                CommandRefusalCode::Ended,
                "it is being cancelled".to_owned(),
            ),
            Some(active) if active.mission == mission && active.revision == revision => Ok(()),
            Some(active) if active.mission == mission => {
                let detail = format!("it is active as revision {}", active.revision);
                refuse(CommandRefusalCode::Conflict, detail)
            }
            Some(_) | None => refuse(
                CommandRefusalCode::Unknown,
                "it is not active here".to_owned(),
            ),
        }
    }

    /// Removes a mission that was accepted but could not be sent to the loop.
    pub fn release(&mut self, mission: MissionId) {
        self.active.take_if(|active| active.mission == mission);
    }

    /// Decides on a cancellation; one that arrives before its offer is remembered.
    pub fn cancel(&mut self, mission: MissionId) -> CancelDecision {
        if let Some(active) = self
            .active
            .as_mut()
            .filter(|active| active.mission == mission)
        {
            if let Some(phase) = self.ending.filter(|_| !active.is_cancelled) {
                return CancelDecision::EndedBefore(phase);
            }
            active.is_cancelled = true;
            return CancelDecision::Brake;
        }
        match self.ended_phase(mission) {
            Some(MissionPhase::Cancelled) => CancelDecision::CancelledBefore,
            Some(phase) => CancelDecision::EndedBefore(phase),
            None => {
                self.remember(Ended {
                    mission,
                    phase: MissionPhase::Cancelled,
                });
                CancelDecision::Unknown
            }
        }
    }

    /// Begins the end of the active mission, before it is reported; from now on it cannot be
    /// cancelled. Returns the phase, which is cancelled for a mission whose cancellation was
    /// answered.
    pub fn begin_end(&mut self, mission: MissionId, phase: MissionPhase) -> MissionPhase {
        let Some(active) = self
            .active
            .as_ref()
            .filter(|active| active.mission == mission)
        else {
            return phase;
        };
        let phase = if active.is_cancelled {
            MissionPhase::Cancelled
        } else {
            phase
        };
        *self.ending.insert(phase)
    }

    /// Keeps the report of an end until [`MissionSlot::ends_are_recorded`].
    pub fn store_end(&mut self, report: MissionReport) {
        self.unrecorded_ends.keep(report);
    }

    /// Returns the reports of ends that may not be in the outbox, oldest first.
    pub fn unrecorded_ends(&self) -> impl Iterator<Item = &MissionReport> {
        self.unrecorded_ends.reports()
    }

    /// Returns the number of kept reports of ends that this agent cannot read.
    pub fn unreadable_ends(&self) -> usize {
        self.unrecorded_ends.unreadable()
    }

    /// Drops the reports of ends: the outbox has them on disk.
    pub fn ends_are_recorded(&mut self) {
        self.unrecorded_ends = StoredEnds::default();
    }

    /// Ends the active mission; `None` if it is not this one.
    pub fn end(&mut self, mission: MissionId, phase: MissionPhase) -> Option<ActiveMission> {
        self.ending.take_if(|_| {
            self.active
                .as_ref()
                .is_some_and(|active| active.mission == mission)
        });
        let active = self.active.take_if(|active| active.mission == mission)?;
        self.remember(Ended { mission, phase });
        Some(active)
    }

    fn remember(&mut self, ended: Ended) {
        if self.ended.len() >= ENDED_MAX {
            let dropped = self.ended.pop_front().map(|dropped| dropped.mission);
            self.forgotten = self.forgotten.max(dropped);
        }
        self.ended.push_back(ended);
    }
}

fn name_of(phase: MissionPhase) -> &'static str {
    match phase {
        MissionPhase::Started => "started",
        MissionPhase::Paused => "paused",
        MissionPhase::Resumed => "resumed",
        MissionPhase::Replaced => "replaced",
        MissionPhase::Succeeded => "succeeded",
        MissionPhase::Failed => "failed",
        MissionPhase::Cancelled => "cancelled",
        MissionPhase::Expired => "expired",
    }
}
