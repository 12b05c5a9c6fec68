//! The way from where a robot stands to its trajectory.

mod common;

use std::f64::consts::PI;

use common::{OFF_CIRCLE, Pause, SimRobot, circle, follower};
use tread_control::follower::{Follower, FollowerConfig, FollowerStatus};
use tread_control::geometry::{Point, Pose};
use tread_control::plan::{Plan, PlanOptions};
use tread_control::robot::RobotModel;
use tread_control::trajectory::Direction;

#[test]
fn from_three_metres_off_the_circle_is_reached_soon() {
    let follower = follower(&circle(Direction::CounterClockwise, 1.0), OFF_CIRCLE);
    let approach_m = follower.plan().approach_length_m();
    assert!((2.9..9.0).contains(&approach_m), "{approach_m} m");
}

#[test]
fn three_metres_off_are_made_good_within_six_seconds_on_slippery_ground_too() {
    let center = Point {
        x_m: 1.0,
        y_m: -2.0,
    };
    for (off_m, heading_rad, softest) in [
        (-3.0, PI / 2.0, 0.5),
        (-3.0, 0.0, 0.5),
        (3.0, PI, 0.5),
        (3.0, PI / 2.0, 1.0),
    ] {
        for stiffness in [softest, 5.0] {
            let start = Pose {
                x_m: center.x_m + 6.0 + off_m,
                y_m: center.y_m,
                heading_rad,
            };
            let options = PlanOptions {
                approach_speed_m_s: Some(1.0),
                ..PlanOptions::default()
            };
            let model = RobotModel::yi2007();
            let trajectory = circle(Direction::CounterClockwise, 1.0);
            let plan = Plan::with_options(&trajectory, start, &model, &options).unwrap();
            let mut follower = Follower::new(plan, model, FollowerConfig::default()).unwrap();
            let mut robot = SimRobot::new(start, stiffness, 1, false);
            let (mut time_s, mut outside_s) = (0.0, 0.0);
            robot.drive(&mut follower, 12.0, |_, _, robot| {
                time_s += common::LOOP_S;
                let place = robot.plant.state().pose.point();
                if (place.distance_m(center) - 6.0).abs() > 0.05 {
                    outside_s = time_s;
                }
            });
            assert!(outside_s < 6.0, "{start:?}, K {stiffness}: {outside_s} s");
        }
    }
}

#[test]
fn a_robot_that_slides_on_its_way_is_paused_goes_on_and_arrives() {
    let mut robot = SimRobot::new(OFF_CIRCLE, 0.5, 3, false);
    let mut follower = follower(&circle(Direction::CounterClockwise, 0.3), OFF_CIRCLE);
    let pause = Pause {
        from: 300,
        at_rest: 1000,
        to: 2000,
    };
    let (paused_in, crept_m, last) = robot.drive_with_pause(&mut follower, &pause);
    assert_eq!(paused_in, Some(FollowerStatus::Approach));
    assert_eq!(last.status, FollowerStatus::Done, "{last:?}");
    assert!(crept_m.abs() < 1.0e-3, "{crept_m} m");
}
