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

/// Drives arcs from side to side.
fn weave(robot: &mut SimRobot, duration_s: f64) {
    drive(robot, duration_s, |time_s| 0.6 * (0.9 * time_s).sin());
}

#[test]
fn a_gyro_that_becomes_late_withholds_theta_and_is_the_reason() {
    let mut robot = robot();
    weave(&mut robot, 40.0);
    let sound = robot.estimator.estimate();
    assert_eq!(
        (sound.no_estimate, sound.late_sensor),
        (None, None),
        "{sound:?}"
    );
    // 60 ms at 200 Hz.
    robot.gyro_delay_samples = 12;
    let mut reasons = Vec::new();
    for _ in 0..15 {
        weave(&mut robot, 1.0);
        let now = robot.estimator.estimate();
        assert_eq!(now.no_estimate.is_none(), now.theta.is_some());
        reasons.push(now.no_estimate);
    }
    let first = reasons.iter().position(Option::is_some);
    assert!(first.is_some_and(|second| second <= 5), "{reasons:?}");
    let last = robot.estimator.estimate();
    assert_eq!(
        last.no_estimate,
        Some(NoEstimate::LateSensor),
        "{reasons:?}"
    );
    let late = last.late_sensor.expect("it is late");
    assert!(
        late.newest.gyro_s > late.identified.gyro_s.min(0.03),
        "{late:?}"
    );
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
