//! Missions on the robot: what is held, what has ended, and what to answer.
//!
//! ```text
//!            offer                    report of the loop
//! (unknown) ───────► held ──────────────────────────────► ended
//!     │              │ ▲ └ cancel: held, braking ──────────▲
//!     │              └─┘ offer of a higher revision        │
//!     └ cancel ────────────────────────────────────────────┘
//! ```
//!
//! [`Holder`] is pure: it decides, others act. An ended mission never comes back, whatever is
//! offered late; [`memory`] keeps that over a restart of the agent.

pub mod memory;

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};
use tread_api::ids::{MissionId, PlanHash};
use tread_api::mission::PlanSummary;
use tread_api::wire::command::{Offer, OfferRefusal};
use tread_api::wire::ingest::MissionPhase;

/// Ended missions that are remembered; the oldest is forgotten first.
pub const ENDED_MAX: usize = 1_000;

/// A mission that the robot has taken and not ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Held {
    /// The mission.
    pub mission: MissionId,
    /// Its revision.
    pub revision: u32,
    /// What exactly is driven.
    pub plan_hash: PlanHash,
    /// What was planned.
    pub plan: PlanSummary,
    /// Whether the server was told that it is cancelled; then it ends as that and nothing else.
    #[serde(default)]
    pub is_cancelled: bool,
}

/// A mission that has ended here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ended {
    /// The mission.
    pub mission: MissionId,
    /// How it ended.
    pub phase: MissionPhase,
}

/// What the robot knows of missions.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Holder {
    held: Option<Held>,
    ended: VecDeque<Ended>,
    /// How the active mission ends, while that is being written.
    #[serde(skip)]
    ending: Option<MissionPhase>,
}

/// What to do about an offer.
#[derive(Debug, Clone, PartialEq)]
pub enum OfferDecision {
    /// It is new: plan it, hand it to the loop, then [`Holder::take`] it.
    Plan,
    /// It is a new revision of what is held: plan it from where the robot comes to stand, then
    /// [`Holder::replace`] the old one and hand it to the loop.
    Replace,
    /// It is held already: say so again.
    AcceptAgain(PlanSummary),
    /// No, and why.
    Refuse(OfferRefusal, String),
}

/// What to do about a cancellation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CancelDecision {
    /// It is held: brake, along its path.
    Brake,
    /// It was cancelled before.
    CancelledBefore,
    /// It ended otherwise before.
    EndedBefore(MissionPhase),
    /// It was never seen here; should its offer still come, it is refused.
    Unknown,
}

impl Holder {
    /// The active mission.
    pub fn held(&self) -> Option<&Held> {
        self.held.as_ref()
    }

    /// The missions that have ended here, oldest first.
    pub fn ended(&self) -> impl Iterator<Item = &Ended> {
        self.ended.iter()
    }

    fn ended_phase(&self, mission: MissionId) -> Option<MissionPhase> {
        self.ended
            .iter()
            .find(|ended| ended.mission == mission)
            .map(|ended| ended.phase)
    }

    /// What to do about an offer.
    pub fn offer(&self, offer: &Offer) -> OfferDecision {
        let refuse = |code, detail: String| OfferDecision::Refuse(code, detail);
        let mission = offer.mission;
        if let Some(phase) = self.ended_phase(mission) {
            let detail = format!(
                "mission {mission} has ended here before: {}",
                name_of(phase)
            );
            return refuse(OfferRefusal::Ended, detail);
        }
        match &self.held {
            None => OfferDecision::Plan,
            Some(held) if held.mission == mission && held.is_cancelled => refuse(
                OfferRefusal::Ended,
                format!("mission {mission} is being cancelled"),
            ),
            Some(held) if held.mission != mission => {
                let detail = format!("mission {} is being driven", held.mission);
                refuse(OfferRefusal::Busy, detail)
            }
            Some(held) if held.revision == offer.revision && held.plan_hash == offer.plan_hash => {
                OfferDecision::AcceptAgain(held.plan)
            }
            Some(held) if held.revision < offer.revision => OfferDecision::Replace,
            Some(held) => {
                let detail = format!(
                    "mission {mission} is held as revision {} with plan hash {}",
                    held.revision, held.plan_hash
                );
                refuse(OfferRefusal::Conflict, detail)
            }
        }
    }

    /// Makes a mission the active one; false, and nothing changes, where [`Holder::offer`] would not
    /// say [`OfferDecision::Plan`].
    #[must_use]
    pub fn take(&mut self, held: Held) -> bool {
        let is_free = self.held.is_none() && self.ended_phase(held.mission).is_none();
        if is_free {
            self.held = Some(held);
        }
        is_free
    }

    /// Puts a higher revision in place of the active one and gives the old one back; `None`, and
    /// nothing changes, where [`Holder::offer`] would not say [`OfferDecision::Replace`].
    #[must_use]
    pub fn replace(&mut self, next: Held) -> Option<Held> {
        let held = self.held.as_mut()?;
        let is_next = held.mission == next.mission
            && held.revision < next.revision
            && !held.is_cancelled
            && self.ending.is_none();
        is_next.then(|| std::mem::replace(held, next))
    }

    /// Goes back to a former revision, if the later one could not be handed to the loop.
    pub fn restore(&mut self, former: Held) {
        if let Some(held) = self
            .held
            .as_mut()
            .filter(|held| held.mission == former.mission)
        {
            *held = former;
        }
    }

    /// Whether a mission is held in this revision, to be paused or resumed.
    ///
    /// # Errors
    /// Why not, for the server.
    pub fn check_held(
        &self,
        mission: MissionId,
        revision: u32,
    ) -> Result<(), (OfferRefusal, String)> {
        if let Some(phase) = self.ended_phase(mission) {
            let detail = format!("it has ended before: {}", name_of(phase));
            return Err((OfferRefusal::Ended, detail));
        }
        match &self.held {
            Some(held) if held.mission == mission && held.is_cancelled => {
                Err((OfferRefusal::Ended, "it is being cancelled".to_owned()))
            }
            Some(held) if held.mission == mission && held.revision == revision => Ok(()),
            Some(held) if held.mission == mission => Err((
                OfferRefusal::Conflict,
                format!("it is held as revision {}", held.revision),
            )),
            Some(_) | None => Err((OfferRefusal::Unknown, "it is not held here".to_owned())),
        }
    }

    /// Lets go of a mission that was taken but could not be handed to the loop.
    pub fn release(&mut self, mission: MissionId) {
        self.held.take_if(|held| held.mission == mission);
    }

    /// What to do about a cancellation; one that comes before its offer is remembered.
    pub fn cancel(&mut self, mission: MissionId) -> CancelDecision {
        if let Some(held) = self.held.as_mut().filter(|held| held.mission == mission) {
            if let Some(phase) = self.ending.filter(|_| !held.is_cancelled) {
                return CancelDecision::EndedBefore(phase);
            }
            held.is_cancelled = true;
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

    /// How the active mission ends, before that is reported; from here on it can no longer be
    /// cancelled. One that the server believes cancelled ends as that, whatever came in between.
    pub fn begin_end(&mut self, mission: MissionId, phase: MissionPhase) -> MissionPhase {
        let Some(held) = self.held.as_ref().filter(|held| held.mission == mission) else {
            return phase;
        };
        let phase = if held.is_cancelled {
            MissionPhase::Cancelled
        } else {
            phase
        };
        *self.ending.insert(phase)
    }

    /// Ends the active mission; `None` if it is not this one.
    pub fn end(&mut self, mission: MissionId, phase: MissionPhase) -> Option<Held> {
        self.ending.take_if(|_| {
            self.held
                .as_ref()
                .is_some_and(|held| held.mission == mission)
        });
        let held = self.held.take_if(|held| held.mission == mission)?;
        self.remember(Ended { mission, phase });
        Some(held)
    }

    fn remember(&mut self, ended: Ended) {
        if self.ended.len() >= ENDED_MAX {
            self.ended.pop_front();
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tread_api::mission::LinkPolicy;
    use tread_api::trajectory::Trajectory;
    use uuid::Uuid;

    use super::*;

    const PLAN: PlanSummary = PlanSummary {
        length_m: 1.0,
        duration_s: 2.0,
        speed_peak_m_s: 0.5,
        begin: None,
    };

    #[derive(Debug, Clone, Copy)]
    enum Step {
        Offer { mission: u128, revision: u32 },
        Cancel { mission: u128 },
        End { mission: u128, succeeded: bool },
    }

    fn steps() -> impl Strategy<Value = Vec<Step>> {
        let step = prop_oneof![
            (0..4_u128, 1..3_u32).prop_map(|(mission, revision)| Step::Offer { mission, revision }),
            (0..4_u128).prop_map(|mission| Step::Cancel { mission }),
            (0..4_u128, any::<bool>())
                .prop_map(|(mission, succeeded)| Step::End { mission, succeeded }),
        ];
        prop::collection::vec(step, 0..60)
    }

    fn id(mission: u128) -> MissionId {
        MissionId::from_uuid(Uuid::from_u128(mission))
    }

    fn offer(mission: u128, revision: u32) -> Offer {
        let text = r#"{"circle":{"center":{"x_m":0,"y_m":0},"radius_m":3,"speed_m_s":0.5}}"#;
        let trajectory: Trajectory = serde_json::from_str(text).unwrap();
        let plan_hash = Offer::plan_hash_of(id(mission), revision, &trajectory);
        Offer {
            mission: id(mission),
            revision,
            plan_hash,
            trajectory,
            start_within_ms: None,
            link_policy: LinkPolicy::default(),
            prior: None,
            held: false,
        }
    }

    proptest! {
        #[test]
        fn whatever_arrives_late_or_twice_no_ended_mission_comes_back(steps in steps()) {
            let mut holder = Holder::default();
            let mut over: Vec<MissionId> = Vec::new();
            for step in steps {
                let before = holder.clone();
                match step {
                    Step::Offer { mission, revision } => {
                        let offer = offer(mission, revision);
                        let decision = holder.offer(&offer);
                        let held = Held {
                            mission: offer.mission,
                            revision,
                            plan_hash: offer.plan_hash,
                            plan: PLAN,
                            is_cancelled: false,
                        };
                        let is_over = over.contains(&offer.mission);
                        match before.held() {
                            _ if is_over => prop_assert!(
                                matches!(decision, OfferDecision::Refuse(OfferRefusal::Ended, _))
                            ),
                            None => prop_assert_eq!(&decision, &OfferDecision::Plan),
                            Some(now) if now.mission == held.mission && now.is_cancelled => {
                                prop_assert!(
                                    matches!(decision, OfferDecision::Refuse(OfferRefusal::Ended, _))
                                );
                            }
                            Some(now) if *now == held => {
                                prop_assert_eq!(&decision, &OfferDecision::AcceptAgain(PLAN));
                            }
                            Some(now)
                                if now.mission == offer.mission && now.revision < revision =>
                            {
                                prop_assert_eq!(&decision, &OfferDecision::Replace);
                            }
                            Some(now) if now.mission == offer.mission => prop_assert!(
                                matches!(decision, OfferDecision::Refuse(OfferRefusal::Conflict, _))
                            ),
                            Some(_) => prop_assert!(
                                matches!(decision, OfferDecision::Refuse(OfferRefusal::Busy, _))
                            ),
                        }
                        if decision == OfferDecision::Replace {
                            let former = holder.replace(held.clone());
                            prop_assert_eq!(former.as_ref(), before.held());
                            prop_assert_eq!(holder.held(), Some(&held));
                            prop_assert!(holder.check_held(held.mission, revision).is_ok());
                        } else {
                            prop_assert_eq!(holder.replace(held.clone()), None);
                        }
                        prop_assert_eq!(holder.take(held), decision == OfferDecision::Plan);
                    }
                    Step::Cancel { mission } => {
                        let decision = holder.cancel(id(mission));
                        if before.held().is_some_and(|held| held.mission == id(mission)) {
                            prop_assert_eq!(decision, CancelDecision::Brake);
                        } else {
                            prop_assert_eq!(
                                decision == CancelDecision::Unknown,
                                !over.contains(&id(mission))
                            );
                            if decision == CancelDecision::Unknown {
                                over.push(id(mission));
                            }
                        }
                    }
                    Step::End { mission, succeeded } => {
                        let phase =
                            if succeeded { MissionPhase::Succeeded } else { MissionPhase::Failed };
                        let was_cancelled = before
                            .held()
                            .is_some_and(|held| held.mission == id(mission) && held.is_cancelled);
                        let phase = holder.begin_end(id(mission), phase);
                        prop_assert_eq!(phase == MissionPhase::Cancelled, was_cancelled);
                        if before.held().is_some_and(|held| held.mission == id(mission))
                            && !was_cancelled
                        {
                            // Too late now.
                            let late = holder.cancel(id(mission));
                            prop_assert_eq!(late, CancelDecision::EndedBefore(phase));
                        }
                        if holder.end(id(mission), phase).is_some() {
                            prop_assert!(!over.contains(&id(mission)));
                            over.push(id(mission));
                        } else {
                            prop_assert_eq!(&before, &holder);
                        }
                    }
                }
                prop_assert!(holder.held().is_none_or(|held| !over.contains(&held.mission)));
            }
        }

        #[test]
        fn the_memory_of_ended_missions_is_bounded(count in prop::sample::select(vec![0, 1, 999, 1_000, 1_001, 1_300_u128])) {
            let mut holder = Holder::default();
            for mission in 0..count {
                holder.cancel(id(mission));
            }
            prop_assert_eq!(holder.ended().count() as u128, count.min(ENDED_MAX as u128));
            let newest = holder.ended().last().map(|ended| ended.mission);
            prop_assert_eq!(newest, count.checked_sub(1).map(id));
        }
    }
}
