//! Sensors of the simulated robot: noise, offsets and rates, all from one seed.

use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tread_control::geometry::Pose;
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use tread_control::plant::Plant;
use tread_control::robot::RobotModel;

use crate::drive::SensorSample;

/// Sampling period of the fast sensors: 200 Hz.
pub const SAMPLE_PERIOD: Duration = Duration::from_millis(5);
/// Samples per body speed: 10 Hz.
const SAMPLES_PER_BODY_SPEED: u64 = 20;
/// Samples per position fix: 20 Hz.
const SAMPLES_PER_POSITION: u64 = 10;

/// Accuracy of the sensors; standard deviations of white noise unless stated otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorSpec {
    /// Gyro, rad/s.
    pub gyro_rad_s: f64,
    /// Accelerometer, m/s².
    pub acceleration_m_s2: f64,
    /// Bound of the accelerometer's constant offset per axis, which is drawn uniformly from ± this
    /// value, m/s².
    pub acceleration_bias_m_s2: f64,
    /// Wheel speed, rad/s.
    pub wheel_speed_rad_s: f64,
    /// Body speed, m/s.
    pub body_speed_m_s: f64,
    /// Position, each coordinate, metres.
    pub position_m: f64,
    /// Standard deviation of the heading of a position fix, radians.
    pub heading_rad: f64,
    /// Bound of the constant relative error of the torque scale, drawn uniformly from ± this value.
    pub torque_scale_ratio: f64,
    /// Torque of one side, as a friction coefficient: over the side's load and the wheel radius.
    pub torque_mu: f64,
    /// Bound of the relative difference of each side's rolling radius from the model's, drawn
    /// uniformly from ± this value.
    pub radius_ratio: f64,
}

impl Default for SensorSpec {
    fn default() -> Self {
        Self {
            gyro_rad_s: 0.003,
            acceleration_m_s2: 0.05,
            acceleration_bias_m_s2: 0.02,
            wheel_speed_rad_s: 0.02,
            body_speed_m_s: 0.02,
            position_m: 0.01,
            heading_rad: 0.005,
            torque_scale_ratio: 0.02,
            torque_mu: 0.01,
            radius_ratio: 0.01,
        }
    }
}

/// Sensors of one robot: its constant errors, and the source of its noise.
#[derive(Debug, Clone)]
pub struct Sensors {
    spec: SensorSpec,
    random: ChaCha8Rng,
    samples: u64,
    bias: BodyAcceleration,
    torque_scale: f64,
    torque_noise_n_m: f64,
    radius_ratios: (f64, f64),
}

impl Sensors {
    /// Creates the sensors of one robot; equal seeds give equal sensors.
    pub fn new(spec: SensorSpec, model: &RobotModel, seed: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut within = |most: f64| most * (2.0 * random.random::<f64>() - 1.0);
        let bias = BodyAcceleration {
            forward_m_s2: within(spec.acceleration_bias_m_s2),
            left_m_s2: within(spec.acceleration_bias_m_s2),
        };
        let torque_scale = 1.0 + within(spec.torque_scale_ratio);
        let radius_ratios = (
            1.0 + within(spec.radius_ratio),
            1.0 + within(spec.radius_ratio),
        );
        let torque_noise_n_m = spec.torque_mu * model.side_load_n() * model.wheel_radius_m();
        Self {
            spec,
            random,
            samples: 0,
            bias,
            torque_scale,
            torque_noise_n_m,
            radius_ratios,
        }
    }

    /// Returns the ratio of the true rolling radii to the model's, as `(left, right)`.
    pub fn radius_ratios(&self) -> (f64, f64) {
        self.radius_ratios
    }

    /// A sample of the standard normal distribution (Box and Muller).
    fn normal(&mut self) -> f64 {
        // The first is in (0, 1], so that its logarithm is finite.
        let radius = (-2.0 * (1.0 - self.random.random::<f64>()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.random.random::<f64>()).cos()
    }

    fn noise(&mut self, std_dev: f64) -> f64 {
        std_dev * self.normal()
    }

    /// Samples the sensors of the base.
    pub fn sample(&mut self, plant: &Plant, at: Duration) -> SensorSample {
        let spec = self.spec;
        let state = *plant.state();
        // Encoders count and inertial sensors integrate: each gives the mean since the last sample.
        let means = *plant.means();
        let (acceleration, torques) = (means.acceleration, plant.wheel_torques());
        let index = self.samples;
        self.samples += 1;
        let wheel_noise = spec.wheel_speed_rad_s;
        let body_speed_m_s = index
            .is_multiple_of(SAMPLES_PER_BODY_SPEED)
            .then(|| state.forward_m_s + self.noise(spec.body_speed_m_s));
        let position = index.is_multiple_of(SAMPLES_PER_POSITION).then(|| Pose {
            x_m: state.pose.x_m + self.noise(spec.position_m),
            y_m: state.pose.y_m + self.noise(spec.position_m),
            heading_rad: state.pose.heading_rad + self.noise(spec.heading_rad),
        });
        let torque_noise_n_m = self.torque_noise_n_m;
        SensorSample {
            at,
            yaw_rate_rad_s: Some(means.yaw_rate_rad_s + self.noise(spec.gyro_rad_s)),
            acceleration: Some(BodyAcceleration {
                forward_m_s2: acceleration.forward_m_s2
                    + self.bias.forward_m_s2
                    + self.noise(spec.acceleration_m_s2),
                left_m_s2: acceleration.left_m_s2
                    + self.bias.left_m_s2
                    + self.noise(spec.acceleration_m_s2),
            }),
            is_specific_force: false,
            wheel_speeds: Some(WheelSpeeds {
                left_rad_s: means.wheel_speeds.left_rad_s + self.noise(wheel_noise),
                right_rad_s: means.wheel_speeds.right_rad_s + self.noise(wheel_noise),
            }),
            wheel_torques: Some(WheelTorques {
                left_n_m: torques.left_n_m * self.torque_scale + self.noise(torque_noise_n_m),
                right_n_m: torques.right_n_m * self.torque_scale + self.noise(torque_noise_n_m),
            }),
            body_speed_m_s,
            tilt_rad: None,
            position,
            position_noise: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_has_the_standard_deviation_that_was_asked_for() {
        let mut sensors = Sensors::new(SensorSpec::default(), &RobotModel::yi2007(), 5);
        let count = 20_000;
        let values: Vec<f64> = (0..count).map(|_| 3.0 + sensors.noise(0.5)).collect();
        let mean = values.iter().sum::<f64>() / f64::from(count);
        let variance = values
            .iter()
            .map(|value| (value - mean).powi(2))
            .sum::<f64>()
            / f64::from(count);
        assert!((mean - 3.0).abs() < 0.02, "mean {mean}");
        assert!(
            (variance.sqrt() - 0.5).abs() < 0.02,
            "deviation {}",
            variance.sqrt()
        );
    }

    #[test]
    fn equal_seeds_give_equal_robots_and_others_do_not() {
        let model = RobotModel::yi2007();
        let ratios = |seed| Sensors::new(SensorSpec::default(), &model, seed).radius_ratios();
        assert_eq!(ratios(1), ratios(1));
        assert_ne!(ratios(1), ratios(2));
    }
}
