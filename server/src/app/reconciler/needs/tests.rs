//! What a mission needs, for what its robot says.

use tread_api::ids::{BootId, MissionId, PlanHash};
use tread_api::robot::{LoopStatus, MissionProgress, OutboxStatus, PauseCause, RobotMode};
use tread_api::wire::state::RobotState;
use uuid::Uuid;

use super::*;
use crate::app::presence::Presences;

const ELAPSED: Duration = Duration::from_secs(100);
const JUST: Duration = Duration::from_millis(99_900);
const LONG_AGO: Duration = Duration::from_secs(10);

fn now() -> Now {
    Now {
        elapsed: ELAPSED,
        wall: "2026-11-01T12:00:00Z".parse().unwrap(),
        answering_since: Duration::ZERO,
    }
}

fn boot(number: u128) -> BootId {
    BootId::from_uuid(Uuid::from_u128(number))
}

fn mission(state: MissionState, boot: Option<BootId>) -> OpenMission {
    OpenMission {
        id: MissionId::from_uuid(Uuid::from_u128(7)),
        site: "yard".parse().unwrap(),
        robot: "rover-1".parse().unwrap(),
        state,
        reason: None,
        boot,
        pause_requested: false,
        priority: 0,
        content: (1, hash(1)),
        replacement: None,
        silent_since: None,
        lost_after_s: None,
        link_policy: LinkPolicy::Continue,
        duration_s: Some(100.0),
    }
}

fn hash(number: u128) -> PlanHash {
    PlanHash::from_uuid(Uuid::from_u128(number))
}

/// A robot that was first heard at one time and last heard just now.
struct Said {
    boot: u128,
    since: Duration,
    drives: bool,
    pending: u64,
    paused: bool,
    paused_by: Option<PauseCause>,
}

fn presence(said: &Said) -> Presence {
    let of = mission(MissionState::Queued, None);
    let key = (of.site, of.robot.clone());
    let progress = MissionProgress {
        id: of.id,
        revision: 1,
        plan_hash: hash(1),
        driven_m: 1.0,
        length_m: 2.0,
        cross_track_m: 0.0,
        paused: said.paused,
        paused_by: said.paused_by,
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
        battery: None,
        alerts: Vec::new(),
        leaving: false,
        monotonic_us: None,
        safety: tread_api::safety::SafetyStatus::default(),
    };
    let presences = Presences::default();
    presences.token_appeared(key.clone(), boot(said.boot), said.since);
    presences.hello(key.clone(), state.boot, JUST);
    presences.state(&key, state, JUST, now().wall);
    presences.get(&key)
}

fn need(state: MissionState, taken_by: Option<u128>, said: &Said) -> Need {
    decide(
        &mission(state, taken_by.map(boot)),
        &presence(said),
        Memory::default(),
        now(),
    )
}

const IDLE: Said = Said {
    boot: 1,
    since: LONG_AGO,
    drives: false,
    pending: 0,
    paused: false,
    paused_by: None,
};

#[test]
fn a_mission_is_offered_only_to_a_robot_that_is_heard() {
    assert_eq!(need(MissionState::Queued, None, &IDLE), Need::Offer);
    let nobody = Presence::default();
    for state in MissionState::ALL {
        let open = mission(state, Some(boot(1)));
        assert_eq!(
            decide(&open, &nobody, Memory::default(), now()),
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
        matches!(settled, Need::Apply(Change::Accept)),
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
        paused: false,
        paused_by: None,
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
        Need::Apply(Change::LoseRun)
    ));
    let patient = Said {
        since: LONG_AGO,
        pending: 9,
        ..restarted
    };
    assert!(matches!(active(&patient), Need::Apply(Change::LoseRun)));
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
        matches!(settled, Need::Apply(Change::LoseRun)),
        "{settled:?}"
    );
}

#[test]
fn a_mission_that_ended_on_the_robot_without_a_record_does_not_stay_open() {
    let since = |ended_since| Memory {
        ended_since: Some(ended_since),
        ..Memory::default()
    };
    let offered = mission(MissionState::Offered, None);
    let robot = presence(&IDLE);
    assert_eq!(decide(&offered, &robot, since(JUST), now()), Need::Offer);
    let settled = decide(&offered, &robot, since(LONG_AGO), now());
    assert!(
        matches!(settled, Need::Apply(Change::Forget)),
        "{settled:?}"
    );
}

#[test]
fn a_robot_is_not_blamed_for_reports_that_wait_for_the_database() {
    let ended = Memory {
        ended_since: Some(LONG_AGO),
        absent_since: Some(LONG_AGO),
        ..Memory::default()
    };
    let active = mission(MissionState::Active, None);
    let robot = presence(&IDLE);
    let settled = decide(&active, &robot, ended, now());
    assert!(
        matches!(settled, Need::Apply(Change::Forget)),
        "{settled:?}"
    );
    let delayed = Now {
        answering_since: JUST,
        ..now()
    };
    assert_eq!(decide(&active, &robot, ended, delayed), Need::Wait);
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

#[test]
fn what_is_wanted_of_a_mission_in_progress_is_sent_until_the_robot_has_done_it() {
    let driving = Said {
        drives: true,
        ..IDLE
    };
    let holding = Said {
        paused: true,
        ..driving
    };
    let needs = |state, pause_requested, said: &Said, differs_from| {
        let mission = OpenMission {
            pause_requested,
            ..mission(state, Some(boot(1)))
        };
        let presence = presence(said);
        let memory = Memory {
            differs_from: is_held_otherwise(&mission, &presence).then_some(differs_from),
            ..Memory::default()
        };
        decide(&mission, &presence, memory, now())
    };
    let (active, paused) = (MissionState::Active, MissionState::Paused);
    assert_eq!(needs(active, true, &driving, LONG_AGO), Need::Pause);
    assert_eq!(needs(active, false, &driving, LONG_AGO), Need::Wait);
    assert_eq!(needs(paused, true, &holding, LONG_AGO), Need::Wait);
    assert_eq!(needs(paused, false, &holding, LONG_AGO), Need::Resume);
    // The record of it is on its way, or was lost.
    assert_eq!(needs(active, true, &holding, JUST), Need::Pause);
    let pause = Need::Apply(Change::Pause);
    assert_eq!(needs(active, true, &holding, LONG_AGO), pause);
    assert_eq!(needs(paused, false, &driving, JUST), Need::Resume);
    let resume = Need::Apply(Change::Resume);
    assert_eq!(needs(paused, false, &driving, LONG_AGO), resume);
    // A command that came twice or late had its way.
    assert_eq!(needs(active, false, &holding, JUST), Need::Wait);
    assert_eq!(needs(active, false, &holding, LONG_AGO), Need::Resume);
    assert_eq!(needs(paused, true, &driving, LONG_AGO), Need::Pause);
    // Stopped, or teleoperated: nothing goes on before a person wants it.
    for cause in [PauseCause::Stop, PauseCause::Teleoperation] {
        let held = Said {
            paused_by: Some(cause),
            ..holding
        };
        assert_eq!(needs(active, false, &held, JUST), Need::Wait);
        assert_eq!(needs(active, false, &held, LONG_AGO), pause);
        assert_eq!(needs(paused, false, &held, LONG_AGO), Need::Resume);
    }
}

#[test]
fn a_new_revision_is_offered_until_the_robot_shows_that_it_holds_it() {
    let replaced = |next| OpenMission {
        replacement: Some((2, hash(next))),
        ..mission(MissionState::Active, Some(boot(1)))
    };
    let driving = presence(&Said {
        drives: true,
        ..IDLE
    });
    let none = Memory::default();
    assert_eq!(decide(&replaced(2), &driving, none, now()), Need::Replace);
    let shown = OpenMission {
        replacement: Some((1, hash(1))),
        ..replaced(2)
    };
    assert_eq!(decide(&shown, &driving, none, now()), Need::Adopt);
}

#[test]
fn a_robot_that_stays_away_past_its_bound_loses_its_mission_in_progress() {
    let away_s = |state, away_s: i64| {
        let since = now().wall - jiff::SignedDuration::from_secs(away_s);
        let mission = OpenMission {
            silent_since: Some(since),
            ..mission(state, Some(boot(1)))
        };
        let memory = Memory {
            silence: Silence::of(&mission, None, now()),
            ..Memory::default()
        };
        decide(&mission, &Presence::default(), memory, now())
    };
    for state in [
        MissionState::Offered,
        MissionState::Active,
        MissionState::Paused,
        MissionState::Cancelling,
    ] {
        // The plan takes 100 s, and a margin of a minute.
        assert_eq!(away_s(state, 150), Need::Wait, "{state:?}");
        let lost = Need::Apply(Change::LoseRobot);
        assert_eq!(away_s(state, 170), lost, "{state:?}");
    }
    assert_eq!(away_s(MissionState::Queued, 1_000_000), Need::Wait);
}

#[test]
fn a_step_of_the_wall_clock_loses_no_robot_and_keeps_none() {
    let silent = OpenMission {
        silent_since: Some(now().wall),
        ..mission(MissionState::Active, Some(boot(1)))
    };
    let decided = |first: Now, later: Now| {
        let before = Silence::of(&silent, None, first);
        let memory = Memory {
            silence: Silence::of(&silent, before, later),
            ..Memory::default()
        };
        decide(&silent, &Presence::default(), memory, later)
    };
    // The plan takes 100 s, and a margin of a minute.
    for hours in [-5, 0, 5] {
        let after = |passed: u64| Now {
            elapsed: ELAPSED + Duration::from_secs(passed),
            answering_since: Duration::ZERO,
            wall: now().wall + jiff::SignedDuration::from_hours(hours),
        };
        assert_eq!(decided(now(), after(150)), Need::Wait, "{hours} h");
        let lost = Need::Apply(Change::LoseRobot);
        assert_eq!(decided(now(), after(170)), lost, "{hours} h");
    }
}

#[test]
fn the_bound_of_a_lost_robot_follows_what_was_said_and_what_is_left() {
    let of = |link_policy, lost_after_s, duration_s| OpenMission {
        lost_after_s,
        link_policy,
        duration_s,
        ..mission(MissionState::Active, None)
    };
    let half = driven(
        &mission(MissionState::Active, None),
        &presence(&Said {
            drives: true,
            ..IDLE
        }),
    );
    let goes_on = LinkPolicy::Continue;
    let near = |left: f64, right: f64| assert!((left - right).abs() < 1e-9, "{left} {right}");
    near(lost_after_s(&of(goes_on, Some(5.0), Some(9.0)), half), 5.0);
    near(lost_after_s(&of(goes_on, None, Some(100.0)), half), 110.0);
    near(lost_after_s(&of(goes_on, None, None), None), 300.0);
    let stops = LinkPolicy::StopAfter { silence_s: 7.0 };
    near(lost_after_s(&of(stops, None, Some(100.0)), half), 37.0);
}

#[test]
fn a_robot_that_is_there_without_its_mission_has_forgotten_it_after_a_while() {
    let active = mission(MissionState::Active, Some(boot(1)));
    let idle = presence(&IDLE);
    assert!(is_absent(&active, &idle, ELAPSED));
    let taken_unseen = mission(MissionState::Active, None);
    assert!(is_absent(&taken_unseen, &idle, ELAPSED));
    let reporting = presence(&Said { pending: 1, ..IDLE });
    assert!(!is_absent(&active, &reporting, ELAPSED));
    // An offer that is answered after a long time was not forgotten meanwhile.
    let offered = mission(MissionState::Offered, None);
    assert!(!is_absent(&offered, &idle, ELAPSED));
    let since = |absent_since| Memory {
        absent_since: Some(absent_since),
        ..Memory::default()
    };
    assert_eq!(decide(&active, &idle, since(JUST), now()), Need::Wait);
    let forgotten = decide(&active, &idle, since(LONG_AGO), now());
    assert_eq!(forgotten, Need::Apply(Change::Forget));
}
