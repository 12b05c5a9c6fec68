//! Why there is no estimate of θ, while robots drive.

mod common;

use common::{LOOP_S, SimRobot};
use tread_control::estimation::manoeuvre::NoEstimate;
use tread_control::estimation::{Estimator, EstimatorPrior, SensorNoise};
use tread_control::geometry::{Pose, Twist};

/// A robot without wheel torques whose model is not exact.
fn robot() -> SimRobot {
    let mut robot = SimRobot::new(Pose::default(), 3.0, 1, true);
    robot.torque = false;
    let (noise, prior) = (SensorNoise::default(), EstimatorPrior::default());
    robot.estimator = Estimator::with_prior(robot.model, noise, prior);
    robot
}

/// Drives for a time, with a turn rate by the time in radians per second.
fn drive(robot: &mut SimRobot, duration_s: f64, turn_rad_s: impl Fn(f64) -> f64) {
    let mut time_s = 0.0;
    while time_s < duration_s {
        let twist = Twist {
            linear_m_s: (0.5 * time_s).min(0.6),
            angular_rad_s: turn_rad_s(time_s),
        };
        robot.act(robot.model.wheel_speeds_from_twist(twist));
        time_s += LOOP_S;
    }
}

#[test]
fn a_robot_is_asked_for_what_it_has_not_driven_until_theta_is_known() {
    let mut robot = robot();
    let why = |robot: &SimRobot| robot.estimator.estimate().no_estimate;
    assert_eq!(why(&robot), Some(NoEstimate::Short));
    drive(&mut robot, 4.0, |_| 0.0);
    assert_eq!(why(&robot), Some(NoEstimate::Short));
    drive(&mut robot, 20.0, |_| 0.0);
    assert_eq!(why(&robot), Some(NoEstimate::NoTurns));
    drive(&mut robot, 40.0, |time_s| 0.4 * (0.8 * time_s).sin());
    assert_eq!(why(&robot), None, "{:?}", robot.estimator.estimate().theta);
    robot.estimator.begin_ground();
    assert_eq!(why(&robot), Some(NoEstimate::Short));
}
