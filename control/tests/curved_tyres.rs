//! Measuring θ with torque on tyres that rise along a curve of unknown bend.

mod common;

use common::{LOOP_S, SimRobot, curve};
use tread_control::estimation::{Estimator, EstimatorPrior, SensorNoise, TyrePrior};
use tread_control::friction::FrictionSpec;
use tread_control::geometry::{Pose, Twist};
use tread_control::plant::{Ground, Plant, PlantSpec, TyreRise, Tyres};

/// θ of all runs.
const THETA: f64 = 0.25;
/// What the robots are configured with: κ spreads evenly over this much of its mean.
const CURVATURE: f64 = 1.5;
const CURVATURE_HALF_RANGE: f64 = 1.0;

/// A robot on brush tyres, configured with how far κ may spread, with perfect torque constants.
fn brush_robot(seed: u64, curvature: f64, radius_ratios: [f64; 2]) -> SimRobot {
    let mut robot = SimRobot::new(Pose::default(), THETA.recip(), seed, true);
    let spec = PlantSpec {
        left_radius_ratio: radius_ratios[0],
        right_radius_ratio: radius_ratios[1],
        tyres: Tyres {
            rise: TyreRise::Brush,
            ..Tyres::default()
        },
        ..PlantSpec::default()
    };
    robot.plant = Plant::new(robot.model, spec, Pose::default()).expect("a valid plant");
    let ground = FrictionSpec {
        peak_slip: 1.0 / (3.0 * curvature),
        ..curve(THETA.recip()).into()
    };
    robot.ground = Ground::uniform(ground.try_into().expect("a peak between 0 and 1"));
    let configured = TyrePrior {
        curvature: THETA * CURVATURE,
        curvature_std_dev: THETA * CURVATURE_HALF_RANGE / 3.0_f64.sqrt(),
        ..TyrePrior::default()
    };
    let configured = EstimatorPrior {
        tyres: configured,
        ..EstimatorPrior::exact()
    };
    robot.estimator = Estimator::with_prior(robot.model, robot.noise, configured);
    robot.torque_gain = [1.0; 2];
    robot
}

/// Drives a bend for a time; `each` looks at the robot after every tick.
fn drive(
    robot: &mut SimRobot,
    duration_s: f64,
    curvature_1_m: f64,
    mut each: impl FnMut(&SimRobot),
) {
    let wheels = robot.model.wheel_speeds_from_twist(Twist {
        linear_m_s: 0.6,
        angular_rad_s: 0.6 * curvature_1_m,
    });
    let mut time_s = 0.0;
    while time_s < duration_s {
        robot.act(wheels);
        each(robot);
        time_s += LOOP_S;
    }
}

#[test]
fn noise_of_the_slip_itself_does_not_bias_theta() {
    // Equal radii: nothing tells κ, so that only its prior and the noise are left to err by.
    let runs = 64_u32;
    let mut sum = 0.0;
    for run in 0..runs {
        let share = 2.0 * (f64::from(run) + 0.5) / f64::from(runs) - 1.0;
        let curvature = CURVATURE + CURVATURE_HALF_RANGE * share;
        let mut robot = brush_robot(u64::from(run), curvature, [1.0; 2]);
        for curvature_1_m in [0.0, 0.125, -0.125] {
            drive(&mut robot, 15.0, curvature_1_m, |_| ());
        }
        let found = robot
            .estimator
            .estimate()
            .theta
            .expect("every run is excited");
        sum += (found.theta - THETA) / THETA;
    }
    let bias = sum / f64::from(runs);
    assert!(bias.abs() < 0.0025, "{bias}");
}

#[test]
fn radii_are_never_said_to_be_what_no_robot_has_however_little_the_force_varies() {
    // Two sides of that spread, and five standard deviations of their difference.
    let most = 5.0 * std::f64::consts::SQRT_2 * SensorNoise::default().radius_ratio;
    for seed in 0..40 {
        let mut robot = brush_robot(seed, 2.0, [0.985, 1.012]);
        robot.drive_wheel_by_wheel();
        drive(&mut robot, 10.0, 0.0, |robot| {
            let said = robot.estimator.estimate();
            assert!(
                said.radius_difference.value.abs() < most && said.radius_offset.value.abs() < most,
                "seed {seed}: {said:?}"
            );
        });
    }
}
