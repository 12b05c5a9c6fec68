//! Missions that make no progress end; slow, held and waiting ones do not.

mod common;

use common::{LOOP_S, SimRobot, circle, follower};
use proptest::prelude::*;
use tread_control::follower::{FailureReason, Follower, FollowerStatus};
use tread_control::geometry::Pose;
use tread_control::measured::Measured;
use tread_control::trajectory::Direction;

const ON_CIRCLE: Pose = Pose {
    x_m: 7.0,
    y_m: -2.0,
    heading_rad: std::f64::consts::FRAC_PI_2,
};

fn on_circle(turns: f64) -> (SimRobot, Follower) {
    (
        SimRobot::new(ON_CIRCLE, 2.0, 3, false),
        follower(&circle(Direction::CounterClockwise, turns), ON_CIRCLE),
    )
}

/// Drives with what `seen` makes of what is measured; the status when it ends, or after `most_s`,
/// and when.
fn drive(
    robot: &mut SimRobot,
    follower: &mut Follower,
    most_s: f64,
    mut seen: impl FnMut(f64, &mut Follower, Measured) -> Measured,
) -> (FollowerStatus, f64) {
    let mut time_s = 0.0;
    loop {
        let measured = seen(time_s, follower, robot.measured());
        let output = follower.step(&measured, None, LOOP_S);
        robot.act(output.wheel_speeds);
        time_s += LOOP_S;
        if output.status.is_final() || time_s > most_s {
            return (output.status, time_s);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]
    #[test]
    fn feedback_that_is_frozen_ends_the_mission_and_the_robot_does_not_go_far(
        frozen_s in 0.5..20.0_f64, noise_m in 0.0..0.03_f64,
    ) {
        let (mut robot, mut follower) = on_circle(1.0);
        let mut frozen: Option<(Measured, f64)> = None;
        let mut tick = 0_u32;
        let (status, ended_s) = drive(&mut robot, &mut follower, 60.0, |time_s, _, measured| {
            if time_s < frozen_s {
                return measured;
            }
            tick += 1;
            let (mut said, _) = *frozen.get_or_insert((measured, time_s));
            // As noisy as a position is: the reference creeps on whenever the lag seems smaller.
            said.pose.x_m += noise_m * f64::from(tick).sin();
            said.pose.y_m += noise_m * (1.7 * f64::from(tick)).sin();
            said
        });
        prop_assert_eq!(status, FollowerStatus::Failed(FailureReason::Stuck));
        prop_assert!(ended_s - frozen_s < 22.0, "after {} s", ended_s - frozen_s);
        let (said, _) = frozen.unwrap();
        let went_m = said.pose.point().distance_m(robot.plant.state().pose.point());
        prop_assert!(went_m < 7.0, "{} m", went_m);
    }
}

#[test]
fn a_robot_that_moves_to_and_fro_makes_no_progress() {
    let (mut robot, mut follower) = on_circle(1.0);
    let (status, ended_s) = drive(&mut robot, &mut follower, 60.0, |time_s, _, measured| {
        let mut said = measured;
        if time_s > 3.0 {
            said.pose = ON_CIRCLE;
            said.pose.y_m += 1.2 + 0.12 * time_s.sin();
        }
        said
    });
    assert_eq!(status, FollowerStatus::Failed(FailureReason::Stuck));
    assert!(ended_s < 30.0, "after {ended_s} s");
}

#[test]
fn missions_that_are_slow_paused_or_limited_are_not_failed() {
    // A crawl.
    let (mut robot, mut follower) = on_circle(0.02);
    follower.set_speed_limit(Some(0.004));
    let (status, _) = drive(&mut robot, &mut follower, 120.0, |_, _, measured| measured);
    assert_eq!(status, FollowerStatus::Tracking, "as slow as it is to be");
    follower.set_speed_limit(None);
    let (status, _) = drive(&mut robot, &mut follower, 120.0, |_, _, measured| measured);
    assert_eq!(status, FollowerStatus::Done);

    // Paused for a minute, again and again; then at a low pace.
    let (mut robot, mut follower) = on_circle(0.1);
    let (status, ended_s) = drive(
        &mut robot,
        &mut follower,
        600.0,
        |time_s, follower, measured| {
            let is_paused = time_s < 190.0 && time_s % 63.0 > 2.0;
            follower.set_pace(if is_paused { 0.0 } else { 0.05 });
            measured
        },
    );
    assert_eq!(status, FollowerStatus::Done);
    assert!(ended_s > 190.0, "{ended_s} s");

    // Nothing at all is allowed for a while.
    let (mut robot, mut follower) = on_circle(0.05);
    let (status, _) = drive(
        &mut robot,
        &mut follower,
        300.0,
        |time_s, follower, measured| {
            follower.set_speed_limit((time_s < 60.0).then_some(0.0));
            measured
        },
    );
    assert_eq!(status, FollowerStatus::Done);
}
