//! Missions on the free plant: 50 ms wheel lag, 100 Hz loop, gate in between.

mod common;

use std::f64::consts::{PI, TAU};

use common::{SimRobot, circle, follower};
use proptest::prelude::*;
use tread_control::follower::{FailureReason, FollowerStatus};
use tread_control::geometry::{Point, Pose, wrap_angle_rad};
use tread_control::plant::Ground;
use tread_control::trajectory::{Direction, Trajectory, Waypoint, WaypointsSpec};

fn figure_8() -> Trajectory {
    let points = (0..=24)
        .map(|index| {
            let angle_rad = f64::from(index) / 24.0 * TAU;
            Waypoint::from(Point {
                x_m: 4.0 * angle_rad.sin(),
                y_m: 2.0 * (2.0 * angle_rad).sin(),
            })
        })
        .collect();
    Trajectory::Waypoints(WaypointsSpec {
        points,
        speed_m_s: 0.6,
    })
}

/// Root mean square and largest cross-track error on the trajectory itself, metres.
fn drive(trajectory: &Trajectory, start: Pose, stiffness: f64, noisy: bool) -> (f64, f64) {
    let mut robot = SimRobot::new(start, stiffness, 7, noisy);
    let mut follower = follower(trajectory, start);
    let bound_s = 2.0 * follower.plan().duration_s() + 40.0;
    let (mut sum, mut count, mut most, mut before_m) = (0.0, 0.0_f64, 0.0_f64, 0.0);
    let last = robot.drive(&mut follower, bound_s, |_, output, robot| {
        assert!(output.progress_m >= before_m, "progress fell");
        before_m = output.progress_m;
        if output.status == FollowerStatus::Tracking {
            let true_pose = robot.plant.state().pose;
            let cross_track_m = output.reference.pose.body_from_site(true_pose.point()).y_m;
            sum += cross_track_m * cross_track_m;
            count += 1.0;
            most = most.max(cross_track_m.abs());
        }
    });
    assert_eq!(
        last.status,
        FollowerStatus::Done,
        "K {stiffness}, start {start:?}: {last:?}"
    );
    assert!((last.progress_m - last.length_m).abs() < 1.0e-6);
    ((sum / count.max(1.0)).sqrt(), most)
}

#[test]
fn a_circle_and_a_figure_8_are_driven_on_every_ground() {
    let start = Pose {
        x_m: 0.0,
        y_m: 0.0,
        heading_rad: 0.7,
    };
    for (stiffness, circle_m, figure_m) in [
        (0.5, 0.02, 0.06),
        (1.0, 0.01, 0.03),
        (2.0, 0.008, 0.02),
        (5.0, 0.005, 0.01),
        (20.0, 0.005, 0.01),
    ] {
        let (rms_m, _) = drive(
            &circle(Direction::CounterClockwise, 1.0),
            start,
            stiffness,
            false,
        );
        assert!(rms_m < circle_m, "circle, K {stiffness}: {rms_m} m");
        let (rms_m, _) = drive(&figure_8(), start, stiffness, false);
        assert!(rms_m < figure_m, "figure-8, K {stiffness}: {rms_m} m");
    }
}

#[test]
fn noisy_sensors_cost_less_than_three_centimetres() {
    let start = Pose {
        x_m: 0.0,
        y_m: 0.0,
        heading_rad: 0.7,
    };
    for (stiffness, bound_m) in [(0.5, 0.07), (2.0, 0.03), (20.0, 0.03)] {
        let (rms_m, _) = drive(&circle(Direction::Clockwise, 1.0), start, stiffness, true);
        assert!(rms_m < 0.03, "circle, K {stiffness}: {rms_m} m");
        let (rms_m, _) = drive(&figure_8(), start, stiffness, true);
        assert!(rms_m < bound_m, "figure-8, K {stiffness}: {rms_m} m");
    }
}

#[test]
fn a_robot_on_the_circle_makes_no_detour() {
    let start = Pose {
        x_m: 7.0,
        y_m: -2.0,
        heading_rad: PI / 2.0,
    };
    let follower = follower(&circle(Direction::CounterClockwise, 1.0), start);
    assert!((follower.plan().length_m() - TAU * 6.0).abs() < 1.0e-6);
    assert_eq!(follower.status(), FollowerStatus::Tracking);
}

#[test]
fn a_stop_brakes_along_the_path_and_ends() {
    let start = Pose {
        x_m: 7.0,
        y_m: -2.0,
        heading_rad: PI / 2.0,
    };
    let mut robot = SimRobot::new(start, 2.0, 3, true);
    let mut follower = follower(&circle(Direction::CounterClockwise, 1.0), start);
    let mut stopped_at_m = None;
    let last = robot.drive(&mut follower, 60.0, |follower, output, _| {
        if output.progress_m > 5.0 && stopped_at_m.is_none() {
            stopped_at_m = Some(output.progress_m);
            follower.stop();
        }
    });
    assert_eq!(last.status, FollowerStatus::Stopped);
    let braking_m = last.progress_m - stopped_at_m.unwrap();
    assert!((0.1..0.8).contains(&braking_m), "{braking_m} m");
}

#[test]
fn a_pause_holds_and_a_resume_goes_on() {
    let start = Pose {
        x_m: 7.0,
        y_m: -2.0,
        heading_rad: PI / 2.0,
    };
    let mut robot = SimRobot::new(start, 2.0, 3, false);
    let mut follower = follower(&circle(Direction::CounterClockwise, 0.3), start);
    let mut ticks = 0;
    let mut held_m = Vec::new();
    let last = robot.drive(&mut follower, 120.0, |follower, output, _| {
        ticks += 1;
        match ticks {
            500 => follower.set_pace(0.0),
            4000 => follower.set_pace(1.0),
            1000..4000 => held_m.push(output.progress_m),
            _ => {}
        }
    });
    assert_eq!(last.status, FollowerStatus::Done);
    assert!((held_m.last().unwrap() - held_m[0]).abs() < 1.0e-3);
}

#[test]
fn a_robot_that_is_carried_away_fails_and_says_why() {
    let start = Pose {
        x_m: 7.0,
        y_m: -2.0,
        heading_rad: PI / 2.0,
    };
    let mut robot = SimRobot::new(start, 2.0, 3, false);
    let mut follower = follower(&circle(Direction::CounterClockwise, 1.0), start);
    for tick in 0..3000 {
        let mut measured = robot.measured();
        if tick > 500 {
            measured.pose.x_m += 5.0;
            measured.pose.y_m += 5.0;
        }
        let output = follower.step(&measured, None, common::LOOP_S);
        robot.act(output.wheel_speeds);
        if output.status.is_final() {
            assert_eq!(
                output.status,
                FollowerStatus::Failed(FailureReason::LeftPath)
            );
            return;
        }
    }
    panic!("never failed: {:?}", follower.status());
}

#[test]
fn a_lost_pose_stops_and_then_fails_the_mission() {
    let start = Pose {
        x_m: 7.0,
        y_m: -2.0,
        heading_rad: PI / 2.0,
    };
    let mut robot = SimRobot::new(start, 2.0, 3, false);
    let mut follower = follower(&circle(Direction::CounterClockwise, 1.0), start);
    for tick in 0..3000 {
        let mut measured = robot.measured();
        if tick > 500 {
            measured.pose.x_m = f64::NAN;
        }
        let output = follower.step(&measured, None, common::LOOP_S);
        if tick > 500 {
            assert!(output.wheel_speeds.magnitude_max_rad_s() <= 0.0);
        }
        robot.act(output.wheel_speeds);
        if output.status.is_final() {
            assert_eq!(
                output.status,
                FollowerStatus::Failed(FailureReason::PoseLost)
            );
            return;
        }
    }
    panic!("never failed: {:?}", follower.status());
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]
    #[test]
    fn every_start_pose_ends_well(
        x_m in -8.0..8.0_f64, y_m in -8.0..8.0_f64, heading_rad in -PI..PI,
        stiffness in 0.5..20.0_f64, round: bool,
    ) {
        let start = Pose { x_m, y_m, heading_rad };
        let trajectory = if round { circle(Direction::Clockwise, 0.5) } else { figure_8() };
        let (rms_m, most_m) = drive(&trajectory, start, stiffness, true);
        prop_assert!(rms_m < 0.1 && most_m < 0.3, "{rms_m} m, {most_m} m");
    }
}

#[test]
fn a_start_beside_the_circle_on_slippery_ground_ends_well() {
    // Found by chance once; the leg to the circle was too quick for the ground.
    for turned_rad in [-0.02, 0.0, 0.02] {
        let start = Pose {
            x_m: 6.3126,
            y_m: 0.0,
            heading_rad: -1.336 + turned_rad,
        };
        let (rms_m, most_m) = drive(&circle(Direction::Clockwise, 0.5), start, 0.5, true);
        assert!(rms_m < 0.1 && most_m < 0.3, "{rms_m} m, {most_m} m");
    }
}

#[test]
fn localisation_is_better_than_the_fixes_it_is_made_of() {
    let start = Pose {
        x_m: 0.0,
        y_m: 0.0,
        heading_rad: 0.7,
    };
    for stiffness in [0.7, 5.0] {
        let mut robot = SimRobot::new(start, stiffness, 11, true);
        let mut follower = follower(&figure_8(), start);
        let (mut position, mut heading, mut count) = (0.0, 0.0, 0.0_f64);
        robot.drive(&mut follower, 120.0, |_, _, robot| {
            let (found, truth) = (robot.measured().pose, robot.plant.state().pose);
            position += found.point().distance_m(truth.point()).powi(2);
            heading += wrap_angle_rad(found.heading_rad - truth.heading_rad).powi(2);
            count += 1.0;
        });
        let (position_m, heading_rad) = ((position / count).sqrt(), (heading / count).sqrt());
        // One fix is 14 mm off in the plane and 5 mrad in heading.
        assert!(position_m < 0.010, "K {stiffness}: {position_m} m");
        assert!(heading_rad < 0.003, "K {stiffness}: {heading_rad} rad");
        assert_eq!(
            robot.localisation.outliers() + robot.localisation.invalid(),
            0
        );
    }
}

#[test]
fn ground_that_changes_under_way_is_noticed_and_does_not_end_the_mission() {
    let start = Pose {
        x_m: 7.0,
        y_m: -2.0,
        heading_rad: PI / 2.0,
    };
    let mut robot = SimRobot::new(start, 5.0, 21, true);
    let mut follower = follower(&circle(Direction::CounterClockwise, 2.0), start);
    let (mut ticks, mut most_m) = (0_u32, 0.0_f64);
    let last = loop {
        let output = follower.step(&robot.measured(), robot.knowledge(), common::LOOP_S);
        robot.act(output.wheel_speeds);
        ticks += 1;
        // Ten seconds of each, after fifteen to learn the radii.
        let slippery = ticks > 1500 && (ticks / 1000) % 2 == 0;
        robot.ground = Ground::uniform(common::curve(if slippery { 0.7 } else { 5.0 }));
        let truth = robot.plant.state().pose.point();
        most_m = most_m.max(output.reference.pose.body_from_site(truth).y_m.abs());
        if output.status.is_final() {
            break output;
        }
        assert!(ticks < 30_000, "{output:?}");
    };
    assert_eq!(last.status, FollowerStatus::Done);
    assert!(most_m < 0.15, "{most_m} m");
    let borders = (ticks - 1500) / 1000;
    let seen = robot.ground_changes;
    assert!(
        seen + 3 >= borders && seen <= borders + 1,
        "{seen} of about {borders}"
    );
}
