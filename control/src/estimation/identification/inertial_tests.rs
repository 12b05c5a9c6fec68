//! Tests of what an inertial unit does to the identification: delays, and gravity.

use std::collections::VecDeque;

use super::tests::{SAMPLE_S, Simulated, identification};
use super::*;

/// Delays of gyro and accelerometer, in samples.
#[derive(Debug, Clone, Copy)]
struct Late {
    gyro: usize,
    accelerometer: usize,
}

/// Drives a minute without measured torque. `gyro_offset_rad_s` is added to the turn rate.
fn drive(robot: &mut Simulated, late: Late, gyro_offset_rad_s: f64) -> Identification {
    let mut identification = identification();
    let mut newest = VecDeque::new();
    for _ in 0..6_000 {
        newest.push_front(robot.sample());
        newest.truncate(1 + late.gyro.max(late.accelerometer));
        let of = |delay: usize| *newest.get(delay).unwrap_or(&newest[newest.len() - 1]);
        let sample = SensorSample {
            gyro_rad_s: of(late.gyro).gyro_rad_s + gyro_offset_rad_s,
            acceleration: of(late.accelerometer).acceleration,
            wheel_torques: None,
            ..newest[0]
        };
        identification.update(&sample, &SensorNoise::default(), SAMPLE_S);
    }
    identification
}

/// Returns ln of estimated over true θ, and the standard deviation of the estimate.
fn error(identification: &Identification, stiffness: f64) -> (f64, f64) {
    let found = identification.identified().expect("θ is excited");
    let own = found.own_ratio.hypot(found.robot_ratio);
    ((found.theta * stiffness).ln(), own.hypot(found.tyres_ratio))
}

#[test]
fn delays_of_gyro_and_accelerometer_are_identified_and_do_not_bias_theta() {
    let delays = [(0, 0), (2, 0), (0, 2), (2, 2), (3, 3)];
    for (gyro, accelerometer) in delays {
        let stiffness = 2.0_f64;
        let mut robot = Simulated::new(|values| {
            values[index::STIFFNESS] = stiffness.ln();
            values[index::RELAXATION] = 0.03_f64.sqrt();
        });
        let late = Late {
            gyro,
            accelerometer,
        };
        let identification = drive(&mut robot, late, 0.0);
        let (error, std_dev) = error(&identification, stiffness);
        assert!(
            error.abs() < 1.96 * std_dev && error.abs() < 0.08,
            "{late:?}: {error}, {std_dev}"
        );
        let values = identification.best().expect("it drove").values();
        let gyro_s = values[index::GYRO_DELAY];
        let accelerometer_s = gyro_s + values[index::ACCELEROMETER_DELAY];
        #[expect(clippy::cast_precision_loss, reason = "a small number")]
        let of = |samples: usize| samples as f64 * SAMPLE_S;
        assert!(
            (gyro_s - of(gyro)).abs() < 6.0e-3
                && (accelerometer_s - of(accelerometer)).abs() < 6.0e-3,
            "{late:?}: {gyro_s}, {accelerometer_s}"
        );
    }
}

#[test]
fn gravity_in_the_acceleration_is_no_misfit_on_a_slope() {
    let none = Late {
        gyro: 0,
        accelerometer: 0,
    };
    for (is_specific_force, gyro_offset_rad_s) in [(false, 0.0), (true, 0.0), (true, 0.01)] {
        let stiffness = 2.0_f64;
        let mut robot = Simulated::new(|values| {
            values[index::STIFFNESS] = stiffness.ln();
            values[index::SLOPE_X] = 0.1;
        });
        robot.is_specific_force = is_specific_force;
        let identification = drive(&mut robot, none, gyro_offset_rad_s);
        let (error, std_dev) = error(&identification, stiffness);
        assert!(
            error.abs() < 1.96 * std_dev && error.abs() < 0.08,
            "{is_specific_force}, {gyro_offset_rad_s}: {error}, {std_dev}"
        );
        let best = identification.best().expect("it drove");
        assert!(best.worst_square() < 2.0, "{}", best.worst_square());
    }
}

/// Returns the estimated offset of the gyro, radians per second, after a minute in which it grew steadily by
/// `grown_rad_s`.
fn offset_after_drift(noise: &SensorNoise, grown_rad_s: f64) -> f64 {
    let mut robot = Simulated::new(|_| {});
    let prior = EstimatorPrior::default();
    let mut identification = Identification::new(RobotModel::yi2007(), noise, &prior)
        .expect("the default prior is uncertain");
    for tick in 1..=6_000 {
        let mut sample = robot.sample();
        sample.gyro_rad_s += grown_rad_s * f64::from(tick) / 6_000.0;
        identification.update(&sample, noise, SAMPLE_S);
    }
    let best = identification.best().expect("it drove");
    best.values()[index::GYRO_OFFSET]
}

#[test]
fn an_offset_of_the_gyro_that_drifts_is_followed() {
    let grown_rad_s = 0.003;
    let walking = SensorNoise::default();
    let constant = SensorNoise {
        gyro_offset_walk: 0.0,
        ..walking
    };
    let [followed, averaged] =
        [walking, constant].map(|noise| offset_after_drift(&noise, grown_rad_s));
    assert!((followed - grown_rad_s).abs() < 7.0e-4, "{followed}");
    assert!((averaged - grown_rad_s).abs() > 9.0e-4, "{averaged}");
}
