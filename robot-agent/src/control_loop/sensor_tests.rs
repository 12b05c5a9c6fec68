//! A simulated robot whose sensors or base break while it drives.

use std::time::Duration;

use jiff::Timestamp;
use tread_api::geometry::{Point, Polygon};
use tread_api::ids::StopId;
use tread_api::wire::safety::Stop;
use tread_control::consistency::{Kind, Subject};
use tread_control::gate::GateCause;
use tread_control::geometry::Pose;
use uuid::Uuid;

use super::channels::EndReason;
use super::tests::{CIRCLE, LINE, ORIGIN, bench_at, one_ground, site_of};
use crate::sim::drive::{Individual, SimMode, SimulatedDrive};
use crate::sim::faults::{Channel, Fault, FaultKind};
use crate::sim::scenario::{Scenario, ScenarioText};
use crate::testing::{Bench, PERIOD};

const SECOND: Duration = Duration::from_secs(1);
/// On the circle, where wheels, gyro and position are excited.
const BREAKS_AT_S: f64 = 14.0;

/// A robot on firm ground with these faults.
fn bench_with(stiffness: f64, seed: u64, kinds: &[FaultKind]) -> Bench {
    let scenario = one_ground(stiffness);
    let start = Pose {
        x_m: 10.0,
        y_m: 6.0,
        heading_rad: std::f64::consts::FRAC_PI_2,
    };
    let mut bench = bench_at(&scenario, start, seed);
    let model = tread_control::robot::RobotModel::yi2007();
    let individual = Individual::of_seed(seed);
    let drive = SimulatedDrive::new(&scenario, model, start, individual, SimMode::Explicit);
    let faults = kinds
        .iter()
        .map(|&kind| Fault {
            after_s: BREAKS_AT_S,
            until_s: None,
            kind,
        })
        .collect();
    bench.drive = drive.unwrap().with_faults(faults);
    bench.send_site(site_of(&scenario)).unwrap();
    bench.run_for(Duration::from_millis(500));
    bench
}

fn stop_now(bench: &Bench) {
    bench.safety.stop_now(&Stop {
        stop: StopId::from_uuid(Uuid::from_u128(77)),
        by: "a test".to_owned(),
        reason: "to see it stand".to_owned(),
        at: Timestamp::UNIX_EPOCH,
    });
}

#[test]
fn each_fault_on_a_mission_is_named_holds_it_within_two_seconds_and_ends_it_if_it_lasts() {
    let frozen = |channel| FaultKind::Frozen { channel };
    let cases = [
        (frozen(Channel::Gyro), Subject::Gyro, Some(Kind::Frozen)),
        (
            FaultKind::Inverted {
                channel: Channel::Gyro,
            },
            Subject::Gyro,
            None,
        ),
        (
            FaultKind::Biased {
                channel: Channel::Gyro,
                by: 0.2,
            },
            Subject::Gyro,
            None,
        ),
        (
            frozen(Channel::Position),
            Subject::Position,
            Some(Kind::Frozen),
        ),
        (
            FaultKind::PositionJumped { by_m: 5.0 },
            Subject::Position,
            Some(Kind::Jumped),
        ),
        (
            FaultKind::PositionRotated,
            Subject::Position,
            Some(Kind::Jumped),
        ),
        (frozen(Channel::All), Subject::Position, Some(Kind::Frozen)),
        (FaultKind::LeftWheelsLocked, Subject::LeftWheels, None),
    ];
    for (fault, subject, kind) in cases {
        let mut bench = bench_with(2.5, 3, &[fault]);
        let mission = bench.start(1, CIRCLE, None);
        while bench.now.as_secs_f64() < BREAKS_AT_S {
            bench.tick();
            let findings = bench.ends.shared.snapshot().findings;
            assert_eq!(findings.iter().count(), 0, "{fault:?}: {findings:?}");
        }
        let findings = |bench: &Bench| bench.ends.shared.snapshot().findings;
        while findings(&bench).about(subject).is_none() {
            bench.tick();
            let late_s = bench.now.as_secs_f64() - BREAKS_AT_S;
            assert!(late_s < 2.0, "{fault:?}: {:?}", findings(&bench));
        }
        let found = *findings(&bench).about(subject).unwrap();
        assert!(kind.is_none_or(|kind| kind == found.kind), "{found:?}");
        bench.run_for(SECOND);
        let gate = bench.ends.shared.snapshot().gate;
        let allowed = [GateCause::SensorFault, GateCause::StalePosition];
        assert!(
            gate.target_rests || gate.cause.is_some_and(|cause| allowed.contains(&cause)),
            "{fault:?}: {gate:?}"
        );
        bench.run_for(17 * SECOND);
        let ended = bench.ended.last().copied();
        assert_eq!(ended, Some((mission, EndReason::SensorFault)), "{fault:?}");
        assert!(bench.drive.truth().forward_m_s.abs() < 0.05, "{fault:?}");
    }
}

#[test]
fn odometry_that_is_wrong_is_no_longer_believed_and_the_mission_goes_on() {
    for fault in [
        FaultKind::OdometryInWorldFrame,
        FaultKind::Scaled {
            channel: Channel::Odometry,
            factor: 1.5,
        },
    ] {
        let mut bench = bench_with(2.5, 4, &[fault]);
        bench.start(1, CIRCLE, None);
        let mut named_at_s = None;
        while bench.ended.is_empty() {
            bench.tick();
            let findings = bench.ends.shared.snapshot().findings;
            for found in findings.iter() {
                assert_eq!(found.subject, Subject::Odometry, "{fault:?}: {found:?}");
                named_at_s = named_at_s.or(Some(bench.now.as_secs_f64()));
            }
        }
        let named_at_s = named_at_s.expect("it is named");
        assert!(
            named_at_s < BREAKS_AT_S + 8.0,
            "{fault:?} at {named_at_s} s"
        );
        assert_eq!(bench.ended[0].1, EndReason::Reached);
    }
}

#[test]
fn a_robot_whose_sensors_are_right_is_never_doubted() {
    for (stiffness, seed) in [(0.7, 1), (2.5, 2), (8.0, 3)] {
        let scenario = one_ground(stiffness);
        let mut bench = bench_at(&scenario, ORIGIN, seed);
        bench.send_site(site_of(&scenario)).unwrap();
        bench.run_for(Duration::from_millis(500));
        for (number, asked) in [(1, LINE), (2, CIRCLE)] {
            bench.start(number, asked, None);
            let before = bench.ended.len();
            while bench.ended.len() == before {
                bench.tick();
                let findings = bench.ends.shared.snapshot().findings;
                assert_eq!(findings.iter().count(), 0, "K {stiffness}: {findings:?}");
            }
        }
    }
}

#[test]
fn a_mission_that_a_sensor_held_goes_on_when_the_sensor_is_right_again() {
    let scenario = one_ground(2.5);
    let mut bench = bench_with(2.5, 5, &[]);
    let model = tread_control::robot::RobotModel::yi2007();
    let start = bench.drive.truth().pose;
    let drive = SimulatedDrive::new(
        &scenario,
        model,
        start,
        Individual::of_seed(5),
        SimMode::Explicit,
    );
    bench.drive = drive.unwrap().with_faults(vec![Fault {
        after_s: BREAKS_AT_S,
        until_s: Some(BREAKS_AT_S + 4.0),
        kind: FaultKind::PositionJumped { by_m: 5.0 },
    }]);
    bench.start(1, CIRCLE, None);
    let mut was_on_hold = false;
    while bench.ended.is_empty() {
        bench.tick();
        was_on_hold |= bench.ends.shared.snapshot().is_on_hold;
    }
    assert!(was_on_hold);
    assert_eq!(bench.ended[0].1, EndReason::Reached);
}

#[test]
fn within_a_fence_a_robot_whose_position_was_wrong_goes_on_by_itself_without_moving_blind() {
    let scenario = one_ground(2.5);
    let mut bench = bench_with(2.5, 5, &[]);
    let corner = |x_m: f64, y_m: f64| Point { x_m, y_m };
    let mut definition = site_of(&scenario);
    let yard = Polygon::new(vec![
        corner(-20.0, -20.0),
        corner(40.0, -20.0),
        corner(40.0, 40.0),
        corner(-20.0, 40.0),
    ]);
    definition.geofence.keep_in.push(yard.unwrap());
    bench.send_site(definition).unwrap();
    let model = tread_control::robot::RobotModel::yi2007();
    let start = bench.drive.truth().pose;
    let individual = Individual::of_seed(5);
    let drive = SimulatedDrive::new(&scenario, model, start, individual, SimMode::Explicit);
    // Too little for a leap, and enough to contradict the gyro for a moment.
    bench.drive = drive.unwrap().with_faults(vec![Fault {
        after_s: BREAKS_AT_S,
        until_s: Some(BREAKS_AT_S + 1.5),
        kind: FaultKind::Biased {
            channel: Channel::Position,
            by: 0.3,
        },
    }]);
    bench.start(1, CIRCLE, None);
    let (mut held, mut blind_m) = (Duration::ZERO, 0.0_f64);
    while bench.ended.is_empty() {
        bench.tick();
        let snapshot = bench.ends.shared.snapshot();
        let is_doubted = [Subject::Position, Subject::Motion]
            .into_iter()
            .any(|subject| snapshot.findings.about(subject).is_some());
        if is_doubted {
            held += PERIOD;
            assert!(snapshot.gate.target_rests, "{:?}", snapshot.gate);
            blind_m += bench.drive.truth().forward_m_s.abs() * PERIOD.as_secs_f64();
        }
        assert!(
            bench.now < Duration::from_mins(3),
            "{:?}",
            snapshot.findings
        );
    }
    assert_eq!(bench.ended[0].1, EndReason::Reached);
    assert!(held > 10 * SECOND, "held for {held:?}");
    assert!(blind_m < 0.5, "it brakes and stands: {blind_m} m");
}

#[test]
fn a_base_that_ignores_a_stop_is_said_not_to_stand_and_one_that_obeys_to_stand() {
    for ignores in [true, false] {
        let faults: &[FaultKind] = if ignores {
            &[FaultKind::IgnoresCommands]
        } else {
            &[]
        };
        let mut bench = bench_with(2.5, 6, faults);
        bench.start(1, CIRCLE, None);
        while bench.now.as_secs_f64() < BREAKS_AT_S + 1.0 {
            bench.tick();
        }
        let speed_m_s = bench.drive.truth().forward_m_s;
        assert!(speed_m_s > 0.5, "{speed_m_s} m/s");
        stop_now(&bench);
        bench.run_for(3 * SECOND);
        let report = bench.ends.shared.snapshot().standstill;
        assert!(report.is_rest_commanded);
        assert_eq!(
            report.standstill_not_reached.is_some(),
            ignores,
            "{report:?}"
        );
        assert_eq!(report.standstill.is_none(), ignores, "{report:?}");
        if let Some((_, took)) = report.standstill {
            assert!(took < 2 * SECOND && !took.is_zero(), "{took:?}");
        }
    }
}

#[test]
fn the_scenario_file_breaks_a_robot() {
    let text = r#"
site = "bench"
cell_m = 1.0
terrains = []
[[robots]]
id = "rover-1"
x_m = 0
y_m = 0
heading_rad = 0
seed = 1
faults = [
  { after_s = 3.0, kind = "frozen", channel = "gyro" },
  { after_s = 5.0, until_s = 6.0, kind = "scaled", channel = "odometry", factor = 1.5 },
  { after_s = 9.0, kind = "ignores_commands" },
]
"#;
    let scenario = Scenario::parse(ScenarioText {
        file: "bench",
        text,
    })
    .unwrap();
    let faults = &scenario.robots[0].faults;
    assert_eq!(faults.len(), 3);
    assert_eq!(
        faults[0].kind,
        FaultKind::Frozen {
            channel: Channel::Gyro
        }
    );
    let unknown = text.replace("ignores_commands", "ignores_everything");
    let refused = Scenario::parse(ScenarioText {
        file: "bench",
        text: &unknown,
    })
    .unwrap_err()
    .to_string();
    assert!(refused.contains("ignores_everything"), "{refused}");
}
