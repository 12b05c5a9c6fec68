//! Tests of the robot's memory of its missions.

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
        on_hold: false,
    }
}

proptest! {
    #[test]
    fn whatever_arrives_late_or_twice_no_ended_mission_comes_back(steps in steps()) {
        let mut slot = MissionSlot::default();
        let mut over: Vec<MissionId> = Vec::new();
        for step in steps {
            let before = slot.clone();
            match step {
                Step::Offer { mission, revision } => {
                    let offer = offer(mission, revision);
                    let decision = slot.offer(&offer);
                    let refused = match &decision {
                        OfferDecision::Refuse(refusal) => Some(refusal.code),
                        OfferDecision::Plan
                        | OfferDecision::Replace
                        | OfferDecision::AcceptAgain(_) => None,
                    };
                    let active = ActiveMission {
                        mission: offer.mission,
                        revision,
                        plan_hash: offer.plan_hash,
                        plan: PLAN,
                        is_cancelled: false,
                    };
                    let is_over = over.contains(&offer.mission);
                    match before.active() {
                        _ if is_over => {
                            prop_assert_eq!(refused, Some(CommandRefusalCode::Ended));
                        }
                        None => prop_assert_eq!(&decision, &OfferDecision::Plan),
                        Some(now) if now.mission == active.mission && now.is_cancelled => {
                            prop_assert_eq!(refused, Some(CommandRefusalCode::Ended));
                        }
                        Some(now) if *now == active => {
                            prop_assert_eq!(&decision, &OfferDecision::AcceptAgain(PLAN));
                        }
                        Some(now)
                            if now.mission == offer.mission && now.revision < revision =>
                        {
                            prop_assert_eq!(&decision, &OfferDecision::Replace);
                        }
                        Some(now) if now.mission == offer.mission => {
                            prop_assert_eq!(refused, Some(CommandRefusalCode::Conflict));
                        }
                        Some(_) => prop_assert_eq!(refused, Some(CommandRefusalCode::Busy)),
                    }
                    if decision == OfferDecision::Replace {
                        let former = slot.replace(active.clone());
                        prop_assert_eq!(former.as_ref(), before.active());
                        prop_assert_eq!(slot.active(), Some(&active));
                        prop_assert!(slot.check_active(active.mission, revision).is_ok());
                    } else {
                        prop_assert_eq!(slot.replace(active.clone()), None);
                    }
                    prop_assert_eq!(slot.take(active), decision == OfferDecision::Plan);
                }
                Step::Cancel { mission } => {
                    let decision = slot.cancel(id(mission));
                    if before.active().is_some_and(|active| active.mission == id(mission)) {
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
                        .active()
                        .is_some_and(|active| active.mission == id(mission) && active.is_cancelled);
                    let phase = slot.begin_end(id(mission), phase);
                    prop_assert_eq!(phase == MissionPhase::Cancelled, was_cancelled);
                    if before.active().is_some_and(|active| active.mission == id(mission))
                        && !was_cancelled
                    {
                        // Too late now.
                        let late = slot.cancel(id(mission));
                        prop_assert_eq!(late, CancelDecision::EndedBefore(phase));
                    }
                    if slot.end(id(mission), phase).is_some() {
                        prop_assert!(!over.contains(&id(mission)));
                        over.push(id(mission));
                    } else {
                        prop_assert_eq!(&before, &slot);
                    }
                }
            }
            prop_assert!(slot.active().is_none_or(|active| !over.contains(&active.mission)));
            let asked: Vec<MissionId> = (0..4).map(id).collect();
            let outcomes = slot.outcomes(&asked);
            let said: Vec<MissionId> = outcomes.ended.iter().map(|it| it.mission).collect();
            prop_assert_eq!(&said, &over);
            let active = outcomes.active.map(|active| active.mission);
            prop_assert_eq!(active, slot.active().map(|active| active.mission));
        }
    }

    #[test]
    fn the_memory_of_ended_missions_is_bounded(count in prop::sample::select(vec![0, 1, 999, 1_000, 1_001, 1_300_u128])) {
        let mut slot = MissionSlot::default();
        for mission in 0..count {
            slot.cancel(id(mission));
        }
        prop_assert_eq!(slot.ended().count() as u128, count.min(ENDED_MAX as u128));
        let forgotten = slot.outcomes(&[]).forgotten;
        let last = count.checked_sub(ENDED_MAX as u128 + 1);
        prop_assert_eq!(forgotten, last.map(id));
        let newest = slot.ended().last().map(|ended| ended.mission);
        prop_assert_eq!(newest, count.checked_sub(1).map(id));
    }
}

/// The report of a mission that succeeded.
pub(crate) fn succeeded(mission: MissionId) -> MissionReport {
    MissionReport {
        mission,
        revision: 1,
        plan_hash: PlanHash::from_uuid(mission.as_uuid()),
        at: jiff::Timestamp::UNIX_EPOCH,
        phase: MissionPhase::Succeeded,
        since: None,
        reason: None,
        progress: None,
        quality: None,
        driven: None,
    }
}

#[test]
fn the_ends_that_wait_for_the_outbox_are_bounded_and_the_newest_stay() {
    let report = |number| succeeded(id(number));
    let mut slot = MissionSlot::default();
    let count = UNRECORDED_ENDS_MAX as u128 + 3;
    for mission in 0..count {
        slot.store_end(report(mission));
        // A report that is kept again takes no further place.
        slot.store_end(report(mission));
    }
    let kept: Vec<MissionId> = slot.unrecorded_ends().map(|kept| kept.mission).collect();
    assert_eq!(kept, (3..count).map(id).collect::<Vec<_>>());
    let again: MissionSlot = serde_json::from_slice(&serde_json::to_vec(&slot).unwrap()).unwrap();
    assert_eq!(again, slot);
    slot.ends_are_recorded();
    assert_eq!(slot, MissionSlot::default());
}
