//! One control tick allocates nothing, and fits a small stack.

mod common;

use std::alloc::System;
use std::f64::consts::PI;

use common::{LOOP_S, SimRobot};
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use tread_control::estimation::{Estimator, EstimatorPrior, SensorNoise};
use tread_control::follower::{Follower, FollowerConfig};
use tread_control::geometry::{Point, Pose, Twist};
use tread_control::plan::Plan;
use tread_control::trajectory::{Trajectory, Waypoint, WaypointsSpec};

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

const START: Pose = Pose {
    x_m: 0.0,
    y_m: 0.0,
    heading_rad: PI,
};

#[test]
fn a_tick_with_estimator_localisation_law_and_gate_allocates_nothing() {
    drive(SimRobot::new(START, 2.0, 5, true));
}

#[test]
fn a_tick_of_a_robot_that_is_identified_allocates_nothing() {
    let mut robot = SimRobot::new(START, 2.0, 5, true);
    let (noise, prior) = (SensorNoise::default(), EstimatorPrior::default());
    robot.estimator = Estimator::with_prior(robot.model, noise, prior);
    drive(robot);
}

/// An eighth of the stack that Rust gives a thread, because callers need most of it.
const STACK_BYTES: usize = 256 * 1024;

#[test]
fn an_estimator_is_created_and_updated_on_a_small_stack() {
    let on_small_stack = || {
        let mut robot = SimRobot::new(START, 2.0, 5, true);
        let (noise, prior) = (SensorNoise::default(), EstimatorPrior::default());
        robot.estimator = Estimator::with_prior(robot.model, noise, prior);
        for _ in 0..500 {
            robot.act(robot.model.wheel_speeds_from_twist(Twist {
                linear_m_s: 0.6,
                angular_rad_s: 0.5,
            }));
        }
    };
    std::thread::Builder::new()
        .stack_size(STACK_BYTES)
        .spawn(on_small_stack)
        .expect("a thread")
        .join()
        .expect("a drive");
}

/// Drives a mission, and asserts that its ticks allocate nothing.
fn drive(mut robot: SimRobot) {
    let points = [(1.0, 1.0), (4.0, 2.0), (6.0, -1.0), (2.0, -2.0)]
        .map(|(x_m, y_m)| Waypoint::from(Point { x_m, y_m }));
    let trajectory = Trajectory::Waypoints(WaypointsSpec {
        points: points.to_vec(),
        speed_m_s: 0.6,
    });
    let plan = Plan::new(&trajectory, START, &robot.model).expect("a plan");
    let mut follower =
        Follower::new(plan, robot.model, FollowerConfig::default()).expect("valid gains");
    let mut ticks = 0;
    let mut allocating = 0;
    loop {
        let region = Region::new(ALLOCATOR);
        let output = follower.step(&robot.measured(), robot.knowledge(), LOOP_S);
        robot.act(output.wheel_speeds);
        ticks += 1;
        if ticks % 200 == 0 {
            robot.estimator.close_segment();
        }
        let change = region.change();
        allocating += u32::from(change.allocations + change.reallocations > 0);
        if output.status.is_final() {
            break;
        }
        assert!(ticks < 20_000, "{output:?}");
    }
    // The counter is the process's: the test harness's own thread may hit a tick or two. What is
    // measured here happens in every tick, or, closing a segment, in every 200th.
    assert!(allocating <= 2, "{allocating} of {ticks} ticks allocate");
    assert!(ticks > 1000);
    let region = Region::new(ALLOCATOR);
    drop(std::hint::black_box(Box::new(ticks)));
    assert!(
        region.change().allocations > 0,
        "the allocator does not count"
    );
}
