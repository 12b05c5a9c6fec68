//! What may happen to a mission, recorded on the bench and run again to the bit.

use jiff::Timestamp;
use tempfile::TempDir;
use tread_api::ids::{MissionId, StopId};
use tread_api::trajectory::Trajectory;
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::safety::Stop;
use tread_control::plan::Plan;
use tread_control::robot::RobotModel;
use uuid::Uuid;

use super::replay::replay;
use super::report;
use super::tests::{SECOND, bench, config, files};
use crate::control_loop::channels::{EndReason, LoopCommand};
use crate::geometry::control_trajectory;
use crate::testing::Bench;

const LINE: &str = r#"{"waypoints":{"speed_m_s":0.8,
    "points":[{"x_m":4,"y_m":3},{"x_m":8,"y_m":3.2},{"x_m":11,"y_m":4.5}]}}"#;
const OTHER: &str = r#"{"waypoints":{"speed_m_s":0.6,
    "points":[{"x_m":7,"y_m":4},{"x_m":8,"y_m":6},{"x_m":7,"y_m":8}]}}"#;
const MISSION_S_MAX: u32 = 60;

fn trajectory(text: &str) -> Trajectory {
    serde_json::from_str(text).unwrap()
}

/// Three seconds of a mission along the line, and its plan.
fn driving(bench: &mut Bench) -> (MissionId, Plan) {
    let (pose, _) = bench.ends.shared.snapshot().pose.unwrap();
    let line = trajectory(LINE);
    let plan = Plan::new(&control_trajectory(&line), pose, &RobotModel::yi2007()).unwrap();
    let mission = bench.begin(1, &line, None).unwrap();
    bench.run_for(3 * SECOND);
    let progress = bench.ends.shared.snapshot().mission.unwrap();
    assert!(progress.driven_m > 0.5, "{progress:?}");
    (mission, plan)
}

fn run_to_end(bench: &mut Bench) -> EndReason {
    for _ in 0..MISSION_S_MAX {
        if let Some(&(_, reason)) = bench.ended.last() {
            return reason;
        }
        bench.run_for(SECOND);
    }
    panic!("no end: {:?}", bench.ends.shared.snapshot());
}

/// Lives through this from the mission's third second on, and runs the record of it again.
fn recorded(live: impl FnOnce(&mut Bench, MissionId, &Plan)) {
    let folder = TempDir::new().unwrap();
    let mut bench = bench(config(folder.path()));
    let (mission, plan) = driving(&mut bench);
    live(&mut bench, mission, &plan);
    bench.run_for(SECOND);
    let ticks = bench.ends.shared.snapshot().ticks;
    assert_eq!(bench.end_record(), 0, "nothing was lost on the way");
    let found = replay(&files(folder.path())).unwrap();
    assert!(report::holds(&found), "{}", report::text(&found));
    assert_eq!((found.ticks, found.differing), (ticks, 0));
    assert!(found.driving_ticks > 250, "{}", found.driving_ticks);
}

#[test]
fn a_cancelled_mission_runs_again_to_the_bit() {
    recorded(|bench, mission, _| {
        let cancel = LoopCommand::Cancel(mission);
        bench.ends.commands.send(cancel).unwrap();
        assert_eq!(run_to_end(bench), EndReason::Cancelled);
        // What the loop kept of it shows in the next one.
        bench.begin(2, &trajectory(OTHER), None).unwrap();
        bench.run_for(3 * SECOND);
        assert_eq!(bench.starts.len(), 2);
    });
}

#[test]
fn a_replaced_mission_runs_again_to_the_bit() {
    recorded(|bench, _, plan| {
        bench.replace(1, 2, plan, &trajectory(OTHER)).unwrap();
        assert_eq!(run_to_end(bench), EndReason::Reached);
        assert_eq!(bench.phase_changes, [MissionPhase::Replaced]);
    });
}

#[test]
fn a_paused_mission_runs_again_to_the_bit() {
    recorded(|bench, mission, _| {
        bench.pause(mission, true).unwrap();
        bench.run_for(5 * SECOND);
        bench.pause(mission, false).unwrap();
        assert_eq!(run_to_end(bench), EndReason::Reached);
        assert_eq!(
            bench.phase_changes,
            [MissionPhase::Paused, MissionPhase::Resumed]
        );
    });
}

#[test]
fn a_stop_in_the_middle_of_a_mission_runs_again_to_the_bit() {
    recorded(|bench, _, _| {
        bench.safety.stop_now(&Stop {
            stop: StopId::from_uuid(Uuid::from_u128(9)),
            by: "somebody".to_owned(),
            reason: "to see it".to_owned(),
            at: Timestamp::UNIX_EPOCH,
        });
        bench.run_for(3 * SECOND);
        assert!(bench.is_standing());
        assert!(bench.drive.truth().twist().linear_m_s.abs() < 0.01);
    });
}
