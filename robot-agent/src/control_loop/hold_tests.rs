//! Missions that are held, replaced, and cut short, on the whole loop with the simulated base.

use std::time::Duration;

use tread_api::ids::MissionId;
use tread_api::trajectory::Trajectory;
use tread_api::wire::ingest::MissionPhase;
use tread_control::geometry::Pose;
use tread_control::plan::Plan;
use tread_control::robot::RobotModel;

use super::channels::{EndReason, LoopCommand};
use crate::geometry::control_trajectory;
use crate::sim::scenario::Scenario;
use crate::testing::{Bench, site_of};

const START: Pose = Pose {
    x_m: 4.0,
    y_m: 3.0,
    heading_rad: 0.0,
};
const LINE: &str = r#"{"waypoints":{"speed_m_s":0.8,
    "points":[{"x_m":4,"y_m":3},{"x_m":8,"y_m":3.2},{"x_m":11,"y_m":4.5}]}}"#;
const OTHER: &str = r#"{"waypoints":{"speed_m_s":0.6,
    "points":[{"x_m":7,"y_m":4},{"x_m":8,"y_m":6},{"x_m":7,"y_m":8}]}}"#;
const SECOND: Duration = Duration::from_secs(1);
const MISSION_MAX: Duration = Duration::from_mins(2);

fn trajectory(text: &str) -> Trajectory {
    serde_json::from_str(text).unwrap()
}

/// A robot that has driven for three seconds, with the plan that it drives.
pub(crate) fn driving() -> (Bench, MissionId, Plan) {
    let scenario = Scenario::built_in().unwrap();
    let mut bench = Bench::new(&scenario, START, 5).unwrap();
    bench.send_site(site_of(&scenario).unwrap()).unwrap();
    bench.run_for(SECOND);
    let (pose, _) = bench.ends.shared.snapshot().pose.unwrap();
    let line = trajectory(LINE);
    let plan = Plan::new(&control_trajectory(&line), pose, &RobotModel::yi2007()).unwrap();
    let mission = bench.begin(1, &line, None).unwrap();
    bench.run_for(3 * SECOND);
    assert!(bench.drive.truth().twist().linear_m_s > 0.4);
    (bench, mission, plan)
}

fn run_to_end(bench: &mut Bench) -> EndReason {
    let until = bench.now + MISSION_MAX;
    while bench.now < until {
        bench.tick();
        if let Some(&(_, reason)) = bench.ended.last() {
            return reason;
        }
    }
    panic!(
        "the mission did not end: {:?}",
        bench.ends.shared.snapshot()
    );
}

#[test]
fn a_paused_mission_stands_still_on_its_path_and_goes_on_from_there() {
    let (mut bench, mission, _) = driving();
    bench.pause(mission, true).unwrap();
    bench.pause(mission, true).unwrap();
    let began = bench.now;
    while bench.phase_changes.is_empty() {
        bench.tick();
        assert!(bench.now < began + 5 * SECOND, "it did not come to stand");
    }
    assert_eq!(bench.phase_changes, [MissionPhase::Paused]);
    bench.run_for(SECOND / 2);
    let stood_at = bench.drive.truth().pose;
    let before = bench.ends.shared.snapshot().mission.unwrap();
    assert!(
        before.paused && before.cross_track_m.abs() < 0.1,
        "{before:?}"
    );
    bench.run_for(60 * SECOND);
    let moved_m = stood_at
        .point()
        .distance_m(bench.drive.truth().pose.point());
    assert!(moved_m < 0.01, "it crept {moved_m} m while paused");
    assert!(bench.ended.is_empty());

    bench.pause(mission, false).unwrap();
    assert_eq!(run_to_end(&mut bench), EndReason::Reached);
    assert_eq!(
        bench.phase_changes,
        [MissionPhase::Paused, MissionPhase::Resumed]
    );
    let end = bench.drive.truth().pose;
    assert!(
        (end.x_m - 11.0).hypot(end.y_m - 4.5) < 0.15,
        "ended at {end:?}"
    );
    let quality = bench.last_driven.as_ref().unwrap().quality();
    assert!((59.0..64.0).contains(&quality.paused_s), "{quality:?}");
    assert!(quality.duration_s > quality.paused_s + 8.0, "{quality:?}");
    assert!(quality.cross_track_max_m < 0.2 && quality.cross_track_rms_m > 0.0);
    assert!(
        !quality.theta.is_empty() && quality.gate_stops == 0,
        "{quality:?}"
    );
    let path = bench.last_driven.as_ref().unwrap().path();
    let last = path.points.last().unwrap();
    assert!((last.x_m - 11.0).hypot(last.y_m - 4.5) < 0.3, "{last:?}");
}

#[test]
fn a_paused_mission_can_be_cancelled_and_a_resumption_before_it_stands_is_no_pause() {
    let (mut bench, mission, _) = driving();
    bench.pause(mission, true).unwrap();
    bench.run_for(SECOND / 5);
    bench.pause(mission, false).unwrap();
    bench.run_for(SECOND);
    assert!(bench.phase_changes.is_empty());
    bench.pause(mission, true).unwrap();
    bench.run_for(5 * SECOND);
    assert_eq!(bench.phase_changes, [MissionPhase::Paused]);
    bench
        .ends
        .commands
        .send(LoopCommand::Cancel(mission))
        .unwrap();
    assert_eq!(run_to_end(&mut bench), EndReason::Cancelled);
}

#[test]
fn a_new_revision_takes_over_where_the_robot_comes_to_stand() {
    for is_paused in [false, true] {
        let (mut bench, mission, plan) = driving();
        if is_paused {
            bench.pause(mission, true).unwrap();
        }
        bench.replace(1, 2, &plan, &trajectory(OTHER)).unwrap();
        let began = bench.now;
        while !bench.phase_changes.contains(&MissionPhase::Replaced) {
            bench.tick();
            assert!(bench.now < began + 5 * SECOND, "it was not replaced");
        }
        let progress = bench.ends.shared.snapshot().mission.unwrap();
        assert_eq!((progress.revision, progress.paused), (2, is_paused));
        assert!(
            bench.drive.truth().twist().linear_m_s.abs() < 0.1,
            "it was swapped in full drive"
        );
        if is_paused {
            bench.run_for(5 * SECOND);
            assert!(bench.drive.truth().twist().linear_m_s.abs() < 0.01);
            bench.pause(mission, false).unwrap();
        }
        assert_eq!(run_to_end(&mut bench), EndReason::Reached);
        let end = bench.drive.truth().pose;
        assert!(
            (end.x_m - 7.0).hypot(end.y_m - 8.0) < 0.15,
            "ended at {end:?}"
        );
        let path = bench.last_driven.as_ref().unwrap().path();
        let first = path.points.first().unwrap();
        assert!(
            (first.x_m - START.x_m).hypot(first.y_m - START.y_m) < 0.3,
            "the path before the new revision is lost: {first:?}"
        );
    }
}

#[test]
fn a_revision_that_comes_at_the_very_end_is_driven_and_one_that_does_not_come_holds_nothing_up() {
    let (mut bench, mission, plan) = driving();
    let length_m = plan.length_m();
    while bench.ends.shared.snapshot().mission.unwrap().driven_m < length_m - 0.05 {
        bench.tick();
    }
    bench.replace(1, 2, &plan, &trajectory(OTHER)).unwrap();
    assert_eq!(run_to_end(&mut bench), EndReason::Reached);
    let end = bench.drive.truth().pose;
    assert!(
        (end.x_m - 7.0).hypot(end.y_m - 8.0) < 0.15,
        "ended at {end:?}"
    );
    assert_eq!(bench.ended.len(), 1);

    let (mut bench, other, _) = driving();
    assert_eq!(other, mission);
    let hold = LoopCommand::Hold(mission, super::channels::Hold::Replacement);
    bench.ends.commands.send(hold).unwrap();
    bench.run_for(5 * SECOND);
    assert!(bench.drive.truth().twist().linear_m_s.abs() < 0.01);
    assert_eq!(run_to_end(&mut bench), EndReason::Reached);
    assert!(bench.phase_changes.is_empty());
}

#[test]
fn a_revision_announced_while_another_waits_keeps_the_hold_after_that_one_took_over() {
    let (mut bench, mission, plan) = driving();
    bench.replace(1, 2, &plan, &trajectory(OTHER)).unwrap();
    bench.tick();
    let hold = LoopCommand::Hold(mission, super::channels::Hold::Replacement);
    bench.ends.commands.send(hold).unwrap();
    let snapshot = |bench: &Bench| bench.ends.shared.snapshot();
    let until = bench.now + 3 * SECOND;
    while snapshot(&bench).mission.unwrap().revision == 1 {
        bench.tick();
        assert!(bench.now < until, "the second revision did not take over");
    }
    // The planner of the third one waits for just this.
    assert!(snapshot(&bench).is_on_hold);
    let release = LoopCommand::Release(mission, super::channels::Hold::Replacement);
    bench.ends.commands.send(release).unwrap();
    assert_eq!(run_to_end(&mut bench), EndReason::Reached);
}

#[test]
fn a_revision_that_waits_takes_over_though_the_one_announced_after_it_does_not_come() {
    let (mut bench, mission, plan) = driving();
    bench.replace(1, 2, &plan, &trajectory(OTHER)).unwrap();
    bench.tick();
    for command in [LoopCommand::Hold, LoopCommand::Release] {
        let command = command(mission, super::channels::Hold::Replacement);
        bench.ends.commands.send(command).unwrap();
        bench.tick();
    }
    let until = bench.now + 3 * SECOND;
    while bench.ends.shared.snapshot().mission.unwrap().revision == 1 {
        bench.tick();
        assert!(bench.now < until, "the second revision did not take over");
    }
    assert_eq!(run_to_end(&mut bench), EndReason::Reached);
}

#[test]
fn the_mission_link_watchdog_ends_a_mission_that_minds_silence_and_no_other() {
    for (silence_s, expected) in [
        (None, EndReason::Reached),
        (Some(2), EndReason::ServerSilent),
    ] {
        let scenario = Scenario::built_in().unwrap();
        let mut bench = Bench::new(&scenario, START, 5).unwrap();
        bench.run_for(SECOND);
        bench.silence_max = silence_s.map(Duration::from_secs);
        bench.ends.shared.record_server_message(bench.now);
        bench.begin(1, &trajectory(LINE), None).unwrap();
        for _ in 0..300 {
            bench.tick();
            bench.ends.shared.record_server_message(bench.now);
        }
        let silent_from = bench.now;
        assert_eq!(run_to_end(&mut bench), expected);
        if let Some(silence_s) = silence_s {
            let took = bench.now.saturating_sub(silent_from).as_secs_f64();
            // The silence, and the braking.
            let bound = f64::from(u32::try_from(silence_s).unwrap()) + 3.0;
            assert!((2.0..bound).contains(&took), "{took} s");
        }
    }
}

#[test]
fn a_mission_whose_base_is_silent_for_a_while_is_held_and_goes_on_when_it_is_heard_again() {
    let (mut bench, _, _) = driving();
    let is_on_hold = |bench: &Bench| bench.ends.shared.snapshot().is_on_hold;
    assert!(!is_on_hold(&bench));
    let silent_since = bench.now;
    while bench.now < silent_since + SECOND {
        bench.tick_without_base();
    }
    assert!(is_on_hold(&bench));
    // Heard for a moment only: that is not enough.
    bench.run_for(SECOND / 4);
    assert!(is_on_hold(&bench));
    bench.run_for(SECOND / 2);
    assert!(!is_on_hold(&bench));
    assert_eq!(run_to_end(&mut bench), EndReason::Reached);
}

#[test]
fn a_base_that_is_heard_again_says_at_once_where_the_robot_is() {
    let (mut bench, _, _) = driving();
    let silent_until = bench.now + 11 * SECOND / 5;
    while bench.now < silent_until {
        bench.tick_unheard();
    }
    bench.run_for(SECOND / 5);
    let (_, fixed_at) = bench.ends.shared.snapshot().pose.unwrap();
    let age = bench.now.saturating_sub(fixed_at);
    assert!(age < SECOND / 5, "{age:?}");
    assert_eq!(run_to_end(&mut bench), EndReason::Reached);
}
