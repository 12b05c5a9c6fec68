//! Measuring θ on the free plant with noisy sensors, unknown rolling radii and torque constants.

mod common;

use common::{LOOP_S, SimRobot, curve};
use tread_control::follower::{Follower, FollowerConfig, FollowerStatus};
use tread_control::geometry::{Point, Pose, Twist};
use tread_control::plan::Plan;
use tread_control::plant::Ground;
use tread_control::trajectory::{CircleSpec, Direction, Trajectory, Waypoint, WaypointsSpec};

/// One stretch: for how long, how fast, how curved.
type Stretch = (f64, f64, f64);

const STRAIGHT_THEN_CIRCLES: [Stretch; 3] = [
    (10.0, 0.6, 0.0),
    (25.0, 0.6, 1.0 / 3.0),
    (25.0, 0.6, -1.0 / 3.0),
];

/// Drives stretches open loop, from and to rest through the gate's ramp.
fn drive(robot: &mut SimRobot, stretches: &[Stretch]) {
    for &(duration_s, linear_m_s, curvature_1_m) in stretches {
        let twist = Twist {
            linear_m_s,
            angular_rad_s: linear_m_s * curvature_1_m,
        };
        let wheels = robot.model.wheel_speeds_from_twist(twist);
        let mut time_s = 0.0;
        while time_s < duration_s {
            robot.act(wheels);
            time_s += LOOP_S;
        }
    }
}

#[test]
fn intervals_hold_and_errors_are_a_few_percent() {
    let (mut held, mut measured, mut runs) = (0, 0, 0);
    let stiffnesses = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0];
    let mut squares = [0.0; 6];
    for seed in 0..120_u64 {
        let index = usize::try_from(seed % 6).unwrap();
        let theta = 1.0 / stiffnesses[index];
        let mut robot = SimRobot::new(Pose::default(), stiffnesses[index], seed, true);
        drive(&mut robot, &STRAIGHT_THEN_CIRCLES);
        runs += 1;
        let estimate = robot.estimator.estimate();
        let Some(found) = estimate.theta else {
            continue;
        };
        measured += 1;
        squares[index] += ((found.theta - theta) / theta).powi(2);
        if (found.theta - theta).abs() < 1.96 * found.std_dev {
            held += 1;
        }
        assert_eq!(robot.ground_changes, 0, "seed {seed}: a false alarm");
    }
    let rms = squares.map(|sum| (sum / 20.0_f64).sqrt());
    eprintln!("held {held} of {measured} measured of {runs}; relative RMS {rms:?}");
    assert_eq!(measured, runs, "every run is excited");
    assert!(
        f64::from(held) > 0.90 * f64::from(measured),
        "{held} of {measured}"
    );
    for (rms, stiffness) in rms.into_iter().zip(stiffnesses) {
        assert!(rms < 0.05, "K {stiffness}: {rms}");
    }
}

#[test]
fn without_torque_there_is_no_measurement() {
    for seed in 0..5 {
        let mut robot = SimRobot::new(Pose::default(), 2.0, seed, true);
        robot.torque = false;
        drive(&mut robot, &STRAIGHT_THEN_CIRCLES);
        let estimate = robot.estimator.estimate();
        assert!(estimate.theta.is_none() && estimate.no_new_information);
        assert!(estimate.mu_peak_lower_bound.is_none());
        assert!(robot.estimator.close_segment().theta_information <= 0.0);
    }
}

#[test]
fn steady_straight_driving_tells_nothing_about_the_ground() {
    let mut abstained = 0;
    for seed in 0..20 {
        let mut robot = SimRobot::new(Pose::default(), 2.0, seed, true);
        let points = [0.0, 30.0].map(|x_m| Waypoint::from(Point { x_m, y_m: 0.0 }));
        let line = Trajectory::Waypoints(WaypointsSpec {
            points: points.to_vec(),
            speed_m_s: 0.6,
        });
        let plan = Plan::new(&line, Pose::default(), &robot.model).unwrap();
        let mut follower = Follower::new(plan, robot.model, FollowerConfig::default()).unwrap();
        // Gathering speed and braking are excitation; both are left out.
        let mut steady = false;
        loop {
            // With the true pose the wheels run smoothly; a noisy one would excite them.
            let output = follower.step(&robot.true_motion(), None, LOOP_S);
            robot.act(output.wheel_speeds);
            if output.progress_m > 3.0 && !steady {
                steady = true;
                robot.estimator.close_segment();
                robot.estimator.begin_ground();
            }
            if output.progress_m > 26.0 {
                break;
            }
            assert!(!output.status.is_final(), "{output:?}");
        }
        let estimate = robot.estimator.estimate();
        abstained += u32::from(estimate.theta.is_none());
        // The radii are learned all the same.
        assert!(
            estimate.radius_difference.std_dev < 0.004,
            "{:?}",
            estimate.radius_difference
        );
    }
    assert_eq!(abstained, 20);
}

#[test]
fn segments_add_up_to_the_truth_once_the_offsets_are_known() {
    for (seed, stiffness) in [(1_u64, 0.5), (2, 2.0), (3, 10.0)] {
        let mut robot = SimRobot::new(Pose::default(), stiffness, seed, true);
        drive(&mut robot, &[(10.0, 0.6, 0.0), (10.0, 0.6, 0.3)]);
        robot.estimator.close_segment();
        let (mut information, mut weighted) = (0.0, 0.0);
        for _ in 0..12 {
            drive(&mut robot, &[(2.0, 0.6, -0.3)]);
            let segment = robot.estimator.close_segment();
            assert!(segment.samples >= 8, "{segment:?}");
            information += segment.theta_information;
            weighted += segment.theta_weighted;
        }
        let theta: f64 = weighted / information;
        let error = (theta * stiffness - 1.0).abs();
        assert!(error < 0.08, "K {stiffness}: θ {theta}, {error} off");
    }
}

#[test]
fn a_change_of_ground_is_noticed_within_a_second() {
    for seed in 0..10 {
        let mut robot = SimRobot::new(Pose::default(), 5.0, seed, true);
        drive(&mut robot, &STRAIGHT_THEN_CIRCLES);
        assert_eq!(robot.ground_changes, 0);
        robot.ground = Ground::uniform(curve(2.5));
        drive(&mut robot, &[(1.0, 0.6, -1.0 / 3.0)]);
        assert_eq!(robot.ground_changes, 1, "seed {seed}");
        drive(&mut robot, &[(20.0, 0.6, -1.0 / 3.0)]);
        let found = robot.estimator.estimate().theta.unwrap();
        assert!((found.theta - 0.4).abs() < 3.0 * found.std_dev, "{found:?}");
        assert_eq!(robot.ground_changes, 1, "seed {seed}: a false alarm");
    }
}

#[test]
fn the_effective_track_is_measured() {
    let mut robot = SimRobot::new(Pose::default(), 5.0, 4, true);
    drive(&mut robot, &STRAIGHT_THEN_CIRCLES);
    let ratio = robot.estimator.estimate().effective_track_ratio.unwrap();
    assert!(
        (ratio - robot.model.effective_track_ratio()).abs() < 0.03,
        "{ratio}"
    );
}

#[test]
fn samples_that_are_no_numbers_are_dropped_and_counted() {
    let mut robot = SimRobot::new(Pose::default(), 5.0, 4, true);
    let mut sample = tread_control::estimation::SensorSample {
        gyro_rad_s: f64::NAN,
        ..Default::default()
    };
    robot.estimator.update(&sample, 0.005);
    sample.gyro_rad_s = 0.0;
    sample.wheel_torques = Some(tread_control::measured::WheelTorques {
        left_n_m: f64::INFINITY,
        right_n_m: 0.0,
    });
    robot.estimator.update(&sample, 0.005);
    assert_eq!(robot.estimator.estimate().dropped_samples, 2);
}

#[test]
fn cells_of_a_mission_fuse_to_an_honest_interval() {
    let (mut held, mut runs, mut live_held, mut live) = (0, 0, 0, 0);
    let stiffnesses = [0.7, 2.0, 5.0, 12.0];
    let mut squares = 0.0;
    for seed in 0..60_u64 {
        let stiffness = stiffnesses[usize::try_from(seed % 4).unwrap()];
        let theta = 1.0 / stiffness;
        let start = Pose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.3,
        };
        let mut robot = SimRobot::new(start, stiffness, 1000 + seed, true);
        let trajectory = if seed % 8 < 4 {
            Trajectory::Circle(CircleSpec {
                center: Point { x_m: 4.0, y_m: 1.0 },
                radius_m: 2.5,
                speed_m_s: 0.6,
                direction: Direction::Clockwise,
                turns: 2.0,
            })
        } else {
            let points = [
                (2.0, 0.0),
                (5.0, 2.0),
                (8.0, -1.0),
                (5.0, -4.0),
                (0.0, -3.0),
                (-3.0, 0.0),
            ];
            let points = points
                .map(|(x_m, y_m)| Waypoint::from(Point { x_m, y_m }))
                .to_vec();
            Trajectory::Waypoints(WaypointsSpec {
                points,
                speed_m_s: 0.6,
            })
        };
        let plan = Plan::new(&trajectory, start, &robot.model).unwrap();
        let mut follower = Follower::new(plan, robot.model, FollowerConfig::default()).unwrap();
        let (mut information, mut weighted, mut cell_m) = (0.0, 0.0, 0.0);
        loop {
            let output = follower.step(&robot.measured(), robot.knowledge(), LOOP_S);
            robot.act(output.wheel_speeds);
            if output.progress_m > cell_m + 1.0 || output.status.is_final() {
                cell_m = output.progress_m;
                let segment = robot.estimator.close_segment();
                information += segment.theta_information;
                weighted += segment.theta_weighted;
            }
            if output.status.is_final() {
                assert_eq!(output.status, FollowerStatus::Done);
                break;
            }
        }
        assert_eq!(robot.ground_changes, 0, "seed {seed}: a false alarm");
        assert!(information > 0.0, "seed {seed}: nothing was measured");
        let fused: f64 = weighted / information;
        // The torque constants' error is the robot's own: it is not in its segments.
        let std_dev = information.recip().sqrt().hypot(0.0142 * fused);
        runs += 1;
        held += u32::from((fused - theta).abs() < 1.96 * std_dev);
        squares += (fused / theta - 1.0).powi(2);
        if let Some(found) = robot.estimator.estimate().theta {
            live += 1;
            live_held += u32::from((found.theta - theta).abs() < 1.96 * found.std_dev);
        }
    }
    let rms: f64 = (squares / f64::from(runs)).sqrt();
    eprintln!("fused {held} of {runs}, live {live_held} of {live}, RMS {rms}");
    assert!(held * 100 >= runs * 88 && live_held * 100 >= live * 90);
    assert!(live * 10 >= runs * 9 && rms < 0.06);
}
