//! What a mission needs, for what its robot says.

use tread_api::ids::{BootId, MissionId};
use tread_api::robot::{LoopStatus, MissionProgress, OutboxStatus, RobotMode};
use tread_api::wire::state::RobotState;
use uuid::Uuid;

use super::*;
use crate::fleet::presence::Presences;

const NOW: Duration = Duration::from_secs(100);
const JUST: Duration = Duration::from_millis(99_900);
const LONG_AGO: Duration = Duration::from_secs(10);

fn boot(number: u128) -> BootId {
    BootId::from_uuid(Uuid::from_u128(number))
}

fn mission(state: MissionState, boot: Option<BootId>) -> Standing {
    Standing {
        id: MissionId::from_uuid(Uuid::from_u128(7)),
        site: "yard".parse().unwrap(),
        robot: "rover-1".parse().unwrap(),
        state,
        reason: None,
        boot,
    }
}

/// A robot that was first heard at one time and last heard just now.
struct Said {
    boot: u128,
    since: Duration,
    drives: bool,
    pending: u64,
}

fn presence(said: &Said) -> Presence {
    let of = mission(MissionState::Queued, None);
    let key = (of.site, of.robot.clone());
    let progress = MissionProgress {
        id: of.id,
        revision: 1,
        plan_hash: tread_api::ids::PlanHash::from_uuid(Uuid::nil()),
        driven_m: 1.0,
        length_m: 2.0,
        cross_track_m: 0.0,
    };
    let state = RobotState {
        robot: of.robot,
        boot: boot(said.boot),
        seq: 1,
        robot_time: "2026-11-01T00:00:00Z".parse().unwrap(),
        mode: RobotMode::Idle,
        fault: None,
        pose: None,
        twist: None,
        mission: said.drives.then_some(progress),
        terrain_revision: None,
        outbox: OutboxStatus {
            pending: said.pending,
            ..OutboxStatus::default()
        },
        control_loop: LoopStatus::default(),
    };
    let presences = Presences::default();
    presences.token_appeared(key.clone(), boot(said.boot), said.since);
    presences.hello(key.clone(), state.boot, JUST);
    presences.state(&key, state, JUST);
    presences.get(&key)
}

fn need(state: MissionState, taken_by: Option<u128>, said: &Said) -> Need {
    decide(
        &mission(state, taken_by.map(boot)),
        &presence(said),
        Memory::default(),
        NOW,
    )
}

const IDLE: Said = Said {
    boot: 1,
    since: LONG_AGO,
    drives: false,
    pending: 0,
};

#[test]
fn a_mission_is_offered_only_to_a_robot_that_is_heard() {
    assert_eq!(need(MissionState::Queued, None, &IDLE), Need::Offer);
    let nobody = Presence::default();
    for state in MissionState::ALL {
        let standing = mission(state, Some(boot(1)));
        assert_eq!(
            decide(&standing, &nobody, Memory::default(), NOW),
            Need::Wait,
            "{state:?}"
        );
    }
}

#[test]
fn an_offer_whose_answer_was_lost_is_repeated_until_the_robot_shows_it() {
    assert_eq!(need(MissionState::Offered, None, &IDLE), Need::Offer);
    let driving = Said {
        drives: true,
        ..IDLE
    };
    let settled = need(MissionState::Offered, None, &driving);
    assert!(
        matches!(settled, Need::Settle(Change::Accept, _)),
        "{settled:?}"
    );
}

#[test]
fn a_restart_loses_a_mission_only_after_the_old_records_had_their_say() {
    let active = |said: &Said| need(MissionState::Active, Some(1), said);
    assert_eq!(active(&IDLE), Need::Wait, "the same run still has it");
    let restarted = Said {
        boot: 2,
        since: JUST,
        drives: false,
        pending: 1,
    };
    assert_eq!(
        active(&restarted),
        Need::Wait,
        "its records are still coming"
    );
    assert!(matches!(
        active(&Said {
            pending: 0,
            ..restarted
        }),
        Need::Settle(Change::Fail, _)
    ));
    let patient = Said {
        since: LONG_AGO,
        pending: 9,
        ..restarted
    };
    assert!(matches!(active(&patient), Need::Settle(Change::Fail, _)));
    let resumed = Said {
        drives: true,
        pending: 0,
        ..restarted
    };
    assert_eq!(active(&resumed), Need::Wait, "the new run drives on");
}

#[test]
fn a_cancellation_is_sent_until_answered_and_ends_with_a_restart() {
    assert_eq!(need(MissionState::Cancelling, Some(1), &IDLE), Need::Cancel);
    assert_eq!(need(MissionState::Cancelling, None, &IDLE), Need::Cancel);
    let restarted = Said { boot: 2, ..IDLE };
    let settled = need(MissionState::Cancelling, Some(1), &restarted);
    assert!(
        matches!(settled, Need::Settle(Change::Cancel, _)),
        "{settled:?}"
    );
}

#[test]
fn a_mission_that_ended_on_the_robot_without_a_record_does_not_stay_open() {
    let since = |ended_since| Memory {
        ended_since: Some(ended_since),
    };
    let offered = mission(MissionState::Offered, None);
    let robot = presence(&IDLE);
    assert_eq!(decide(&offered, &robot, since(JUST), NOW), Need::Offer);
    let settled = decide(&offered, &robot, since(LONG_AGO), NOW);
    assert!(
        matches!(settled, Need::Settle(Change::Fail, _)),
        "{settled:?}"
    );
}

#[test]
fn what_has_ended_needs_nothing() {
    for state in MissionState::ALL
        .into_iter()
        .filter(|state| state.is_terminal())
    {
        assert_eq!(need(state, Some(9), &IDLE), Need::Wait, "{state:?}");
    }
}
