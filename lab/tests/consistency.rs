//! The consistency monitor against a robot that shares nothing with the plant: each fault is named,
//! and nothing is without one.

#[path = "../src/bin/consistency/figures.rs"]
#[expect(dead_code, reason = "the report program prints what is checked here")]
mod figures;
#[path = "../src/bin/consistency/generator.rs"]
mod generator;

use std::alloc::System;
use std::time::Duration;

use figures::{CASES, quiet, trial};
use generator::{Equipment, Fault, Make, Robot};
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use tread_control::consistency::{Consequence, Monitor, Sample, Subject};
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Trials of each fault; the report program runs more.
const TRIALS: u64 = 12;

const KIT: Equipment = Equipment {
    has_odometry: true,
    has_accelerometer: true,
    meets_ice: false,
    make: Make::Usual,
};

#[test]
fn every_fault_is_named_and_no_other_channel_is_blamed() {
    let mut blamed = Vec::new();
    for case in CASES {
        let mut named = 0;
        for seed in 5_000..5_000 + TRIALS {
            let result = trial(case, Make::Usual, seed);
            blamed.extend(result.wrong.map(|wrong| (case.name, seed, wrong)));
            named += u64::from(result.named_s.is_some());
        }
        #[expect(clippy::cast_precision_loss, reason = "few trials")]
        let share = named as f64 / TRIALS as f64;
        let least = case.goals.named_share_min - 0.1;
        assert!(share >= least, "{}: named in {share}", case.name);
    }
    // The report program counts each fault's share over more trials.
    assert!(blamed.len() <= 1, "{blamed:?}");
}

#[test]
fn an_hour_with_ice_low_batteries_and_wild_fixes_blames_nothing() {
    for has_odometry in [false, true] {
        let kit = Equipment {
            has_odometry,
            meets_ice: true,
            ..KIT
        };
        let found = quiet(1_800.0, 77, kit);
        assert_eq!((found.blamed, found.slip_off_ice), (0, 0), "{found:?}");
        assert!(found.slip_on_ice > 0, "slip is said: {found:?}");
    }
}

#[test]
fn a_finding_ends_when_the_channel_agrees_in_motion_again() {
    let mut robot = Robot::new(3, KIT);
    while robot.time_s() < 10.0 {
        robot.step();
    }
    robot.break_with(Fault::GyroInverted);
    let mut steps = 0;
    while robot.monitor.findings().about(Subject::Gyro).is_none() {
        robot.step();
        steps += 1;
        assert!(steps < 3_000);
    }
    let findings = robot.monitor.findings();
    assert_eq!(findings.consequence(), Some(Consequence::Hold));
    robot.repair();
    let mut steps = 0;
    while robot.monitor.findings().about(Subject::Gyro).is_some() {
        robot.step();
        steps += 1;
        assert!(steps < 6_000, "{:?}", robot.monitor.findings());
    }
    assert!(
        steps > 100,
        "not before it agreed for a while: {steps} steps"
    );
    assert_eq!(robot.monitor.findings().iter().count(), 0);
}

/// Steps of a second.
const SECOND: u32 = 100;

/// Steps until a finding about this stands, or no longer does.
fn steps_until(robot: &mut Robot, subject: Subject, stands: bool, most: u32) -> u32 {
    for step in 0..most {
        if robot.monitor.findings().about(subject).is_some() == stands {
            return step;
        }
        robot.step();
    }
    panic!("{subject:?}: {:?}", robot.monitor.findings());
}

fn drive_for(robot: &mut Robot, steps: u32) {
    for _ in 0..steps {
        robot.step();
    }
}

#[test]
fn a_finding_on_the_position_ends_at_rest_and_is_back_at_once_if_motion_shows_it() {
    let kit = Equipment {
        has_odometry: true,
        ..KIT
    };
    let fault = Fault::PositionScaled(2.0);
    let mut relapsed = 0;
    for seed in 0..6 {
        let mut robot = Robot::new(seed, kit);
        drive_for(&mut robot, 15 * SECOND);
        robot.break_with(fault);
        steps_until(&mut robot, Subject::Position, true, 60 * SECOND);
        robot.rest(true);
        let steps = steps_until(&mut robot, Subject::Position, false, 40 * SECOND);
        assert!(steps >= 10 * SECOND, "seed {seed}: {steps} steps");
        drive_for(&mut robot, 3 * SECOND);
        assert_eq!(robot.monitor.findings().iter().count(), 0, "seed {seed}");
        // It is still wrong, and motion shows it.
        robot.rest(false);
        let (mut excited, mut steps) = (0, 0);
        while robot.monitor.findings().about(Subject::Position).is_none() {
            robot.step();
            excited += u32::from(robot.is_excited());
            steps += 1;
            assert!(steps < 60 * SECOND, "seed {seed}");
        }
        assert!(
            excited <= 3 * SECOND / 2,
            "seed {seed}: {excited} steps of such motion"
        );
        // From now on it takes twice as long.
        robot.rest(true);
        drive_for(&mut robot, 15 * SECOND);
        assert!(robot.monitor.findings().about(Subject::Position).is_some());
        relapsed += 1;
        steps_until(&mut robot, Subject::Position, false, 60 * SECOND);
        // A position that is right again in motion is as good as new.
        robot.repair();
        robot.rest(false);
        drive_for(&mut robot, 60 * SECOND);
        assert_eq!(robot.monitor.findings().iter().count(), 0, "seed {seed}");
    }
    assert_eq!(relapsed, 6);
}

#[test]
fn a_position_that_is_still_frozen_or_creeps_is_not_believed_for_standing_still() {
    let mut robot = Robot::new(4, KIT);
    drive_for(&mut robot, 15 * SECOND);
    robot.break_with(Fault::PositionFrozen);
    steps_until(&mut robot, Subject::Position, true, 60 * SECOND);
    robot.rest(true);
    drive_for(&mut robot, 120 * SECOND);
    assert!(robot.monitor.findings().about(Subject::Position).is_some());

    let mut monitor = Monitor::new(RobotModel::yi2007());
    let mut found_at_s = None;
    for tick in 0..6_000_u32 {
        let at = tick * Duration::from_millis(10);
        let noise = 1.0e-3 * f64::from(tick % 7);
        // It walks off at 0.3 m/s, and then creeps on.
        let walked_s = (at.as_secs_f64() - 5.0).max(0.0);
        let pose = Pose {
            x_m: 0.3 * walked_s.min(3.0) + 0.05 * (walked_s - 3.0).max(0.0) + noise,
            ..Pose::default()
        };
        monitor.take(&Sample {
            at,
            gyro_rad_s: Some(noise),
            wheel_speeds: Some(WheelSpeeds::default()),
            odometry_m_s: tick.is_multiple_of(5).then_some(noise),
            position: tick.is_multiple_of(10).then_some(pose),
            ..Sample::default()
        });
        monitor.command(WheelSpeeds::default());
        let stands = monitor.findings().consequence() == Some(Consequence::Hold);
        if stands {
            found_at_s = found_at_s.or(Some(at.as_secs_f64()));
        }
        assert_eq!(
            stands,
            found_at_s.is_some(),
            "at {at:?}: {:?}",
            monitor.findings()
        );
    }
    assert!(found_at_s.is_some_and(|at_s| at_s < 7.0), "{found_at_s:?}");
}

#[test]
fn while_odometry_is_wrong_the_findings_about_others_end_and_its_own_does_not() {
    let kit = Equipment {
        has_odometry: true,
        ..KIT
    };
    let mut robot = Robot::new(5, kit);
    drive_for(&mut robot, 15 * SECOND);
    robot.scale_odometry(1.8);
    steps_until(&mut robot, Subject::Odometry, true, 60 * SECOND);
    for fault in [Fault::GyroInverted, Fault::PositionJumps] {
        let subject = if fault == Fault::GyroInverted {
            Subject::Gyro
        } else {
            Subject::Position
        };
        robot.break_with(fault);
        steps_until(&mut robot, subject, true, 60 * SECOND);
        robot.repair();
        steps_until(&mut robot, subject, false, 60 * SECOND);
        assert!(robot.monitor.findings().about(Subject::Odometry).is_some());
        drive_for(&mut robot, 60 * SECOND);
        let findings = robot.monitor.findings();
        assert_eq!(findings.iter().count(), 1, "{findings:?}");
        assert!(findings.about(Subject::Odometry).is_some());
    }
    robot.scale_odometry(1.0);
    steps_until(&mut robot, Subject::Odometry, false, 60 * SECOND);
}

#[test]
fn a_position_that_comes_back_after_a_jump_is_believed_again_and_one_that_stays_away_later() {
    let model = RobotModel::yi2007();
    let at_rest = |jump_m: &dyn Fn(f64) -> f64| {
        let mut monitor = Monitor::new(model);
        let mut standing = Vec::new();
        for tick in 0..3_000_u32 {
            let at = tick * Duration::from_millis(10);
            let wheels = Some(WheelSpeeds::default());
            let noise = 1.0e-3 * f64::from(tick % 7);
            let pose = Pose {
                x_m: jump_m(at.as_secs_f64()) + noise,
                ..Pose::default()
            };
            monitor.take(&Sample {
                at,
                gyro_rad_s: Some(noise),
                wheel_speeds: wheels,
                position: tick.is_multiple_of(10).then_some(pose),
                ..Sample::default()
            });
            monitor.command(WheelSpeeds::default());
            standing.push(monitor.findings().about(Subject::Position).is_some());
        }
        standing
    };
    let back = at_rest(&|at_s| if (5.0..8.0).contains(&at_s) { 5.0 } else { 0.0 });
    assert!(!back[499] && back[550] && back[790] && !back[1_400]);
    let away = at_rest(&|at_s| if at_s >= 5.0 { 5.0 } else { 0.0 });
    assert!(away[550] && away[1_400] && !away[2_500]);
}

#[test]
fn nothing_is_allocated_and_equal_samples_give_equal_monitors() {
    let run = || {
        let mut robot = Robot::new(9, KIT);
        for _ in 0..3_000 {
            robot.step();
        }
        robot.monitor
    };
    assert_eq!(run(), run());
    let mut robot = Robot::new(9, KIT);
    for _ in 0..500 {
        robot.step();
    }
    let region = Region::new(ALLOCATOR);
    for _ in 0..2_000 {
        robot.step();
    }
    // The generator's queue of late poses has its room by now; the harness may allocate a little.
    let change = region.change();
    assert!(change.allocations < 20, "{change:?}");
}
