//! What is shown of robots, by what they say and what they do not say.

use tread_api::robot::{LoopStatus, OutboxStatus, RobotMode};
use tread_api::safety::SafetyStatus;
use uuid::Uuid;

use super::*;

pub(super) fn key() -> RobotKey {
    ("yard".parse().unwrap(), "rover-1".parse().unwrap())
}

pub(super) fn boot(number: u128) -> BootId {
    BootId::from_uuid(Uuid::from_u128(number))
}

pub(super) fn state(boot: BootId, seq: u64) -> RobotState {
    RobotState {
        robot: key().1,
        boot,
        seq,
        robot_time: "2026-11-01T00:00:00Z".parse().unwrap(),
        mode: RobotMode::Idle,
        fault: None,
        pose: None,
        twist: None,
        mission: None,
        terrain_revision: None,
        outbox: OutboxStatus::default(),
        control_loop: LoopStatus {
            ticks: seq,
            ..LoopStatus::default()
        },
        battery: None,
        alerts: Vec::new(),
        leaving: false,
        monotonic_us: None,
        safety: SafetyStatus::default(),
    }
}

pub(super) fn wall() -> Timestamp {
    "2026-11-01T00:00:00Z".parse().unwrap()
}

pub(super) const SECOND: Duration = Duration::from_secs(1);

#[test]
fn silence_is_stale_and_a_lost_token_is_offline() {
    let presences = Presences::default();
    let link = |now| presences.get(&key()).link(now);
    assert_eq!(link(SECOND), LinkState::Offline);
    presences.hello(key(), boot(1), SECOND);
    assert_eq!(link(SECOND), LinkState::Offline);
    presences.token_appeared(key(), boot(1), SECOND);
    assert_eq!(
        link(SECOND),
        LinkState::Offline,
        "present, but not heard yet"
    );
    let cause = |now| presences.get(&key()).link_cause(now);
    assert_eq!(cause(SECOND), Some(LinkCause::Joining));
    presences.state(&key(), state(boot(1), 0), SECOND, wall());
    assert_eq!(link(SECOND + ONLINE_TIMEOUT), LinkState::Online);
    assert_eq!(link(SECOND + OFFLINE_TIMEOUT), LinkState::Stale);
    assert_eq!(
        link(3 * SECOND),
        LinkState::Offline,
        "whatever its token says"
    );
    presences.token_gone(&key(), boot(1), 2 * SECOND);
    assert_eq!(link(SECOND), LinkState::Offline);
}

#[test]
fn a_blip_of_the_token_is_no_restart_and_a_straggler_of_the_old_run_changes_nothing() {
    let presences = Presences::default();
    presences.token_appeared(key(), boot(1), SECOND);
    presences.hello(key(), boot(1), SECOND);
    presences.state(&key(), state(boot(1), 7), SECOND, wall());
    presences.token_gone(&key(), boot(1), 2 * SECOND);
    presences.token_appeared(key(), boot(1), 2 * SECOND);
    assert_eq!(presences.get(&key()).state().unwrap().seq, 7);
    presences.token_appeared(key(), boot(2), 3 * SECOND);
    assert!(presences.get(&key()).state().is_none());
    assert_eq!(
        presences.state(&key(), state(boot(1), 8), 3 * SECOND, wall()),
        MessageEffect::OtherRun
    );
    assert_eq!(presences.get(&key()).boot(), Some((boot(2), 3 * SECOND)));
    assert!(presences.take_duplicate_agents(4 * SECOND).is_empty());
}

#[test]
fn ages_grow_until_the_robot_speaks_again() {
    let presences = Presences::default();
    presences.hello(key(), boot(1), SECOND);
    presences.state(&key(), state(boot(1), 0), SECOND, wall());
    let live = presences.get(&key()).live(4 * SECOND).unwrap();
    assert_eq!(live.state_age_ms, 3_000);
}

#[test]
fn of_a_robot_that_said_no_hello_nothing_is_kept() {
    let presences = Presences::default();
    let heard = presences.state(&key(), state(boot(1), 0), SECOND, wall());
    assert_eq!(heard, MessageEffect::NotWelcomed);
    presences.token_appeared(key(), boot(1), SECOND);
    assert_eq!(
        presences.present_count(&tread_api::rights::Scope::EVERYWHERE),
        0
    );
    assert_eq!(
        presences.state(&key(), state(boot(1), 0), SECOND, wall()),
        MessageEffect::NotWelcomed
    );
    presences.token_gone(&key(), boot(1), SECOND);
    assert!(presences.lock().is_empty());
}

#[test]
fn robot_off_link_down_and_a_loop_that_stands_still_are_distinguished() {
    let presences = Presences::default();
    let cause = |now| presences.get(&key()).link_cause(now);
    assert_eq!(cause(SECOND), Some(LinkCause::ServerRestarted));
    presences.register(key());
    presences.token_appeared(key(), boot(1), SECOND);
    presences.state(&key(), state(boot(1), 1), SECOND, wall());
    assert_eq!(cause(SECOND), None);
    assert_eq!(cause(3 * SECOND), Some(LinkCause::LinkDown));
    // The agent speaks on, and its loop's ticks do not.
    let mut stuck = state(boot(1), 2);
    stuck.control_loop.ticks = 1;
    presences.state(&key(), stuck, 3 * SECOND, wall());
    assert_eq!(presences.get(&key()).link(3 * SECOND), LinkState::Offline);
    assert_eq!(cause(3 * SECOND), Some(LinkCause::LoopStopped));
    presences.state(&key(), state(boot(1), 3), 4 * SECOND, wall());
    presences.token_gone(&key(), boot(1), 4 * SECOND);
    assert_eq!(cause(4 * SECOND), Some(LinkCause::RobotOff));
    presences.token_appeared(key(), boot(1), 5 * SECOND);
    presences.token_gone(&key(), boot(1), 9 * SECOND);
    assert_eq!(cause(9 * SECOND), Some(LinkCause::LinkDown));
}

#[test]
fn the_clock_offset_is_that_of_the_state_with_the_shortest_way() {
    let presences = Presences::default();
    presences.register(key());
    let said = |seq, late_ms: i64| {
        let heard_at = wall() + jiff::SignedDuration::from_millis(late_ms - 3_000);
        presences.state(&key(), state(boot(1), seq), SECOND, heard_at);
    };
    said(1, 40);
    said(2, 2);
    said(3, 900);
    assert_eq!(presences.get(&key()).clock_offset_ms(), 2_998);
}

#[test]
fn an_older_state_that_comes_late_is_not_shown() {
    let presences = Presences::default();
    presences.register(key());
    presences.state(&key(), state(boot(1), 5), SECOND, wall());
    presences.state(&key(), state(boot(1), 4), SECOND, wall());
    assert_eq!(presences.get(&key()).state().unwrap().seq, 5);
}
