//! Sensor models with the errors of data sheets: quantisation, drift, delay, outliers.
//!
//! Joint states and inertial data have a rate of 100 Hz, as from the robots' drivers. Wheel speeds
//! are quantised by encoder counts. The gyro's offset is a random walk. Positions have a delay, a
//! slowly varying error and occasional outliers.

use std::collections::VecDeque;
use std::time::Duration;

use serde::Serialize;
use tread_agent::drive::{Feedback, SensorSample};
use tread_control::geometry::{Pose, wrap_angle_rad};
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use tread_control::robot::{GRAVITY_M_S2, RobotModel};

use super::means::Means;
use super::plant::Truth;
use super::width::{Middle, Width};
use crate::random::Random;

/// Time between two samples of the fast sensors.
pub const SAMPLE_PERIOD: Duration = Duration::from_millis(10);
/// Correlation time of the slow position error, in seconds.
pub const POSITION_WANDERS_S: f64 = 20.0;
/// Middle of the drawn sampling periods of positions, in seconds.
const PERIOD_MIDDLE_S: Middle = Middle(0.1);
/// Geometric middle of the shortest and the longest delay of positions, in seconds.
const DELAY_MIDDLE_S: Middle = Middle(0.0447);
/// Maximum delay of the fast sensors, in seconds.
pub const DELAY_MAX_S: f64 = 0.08;
/// Range of the drawn delays of inertial unit and wheels, and the standard deviation of the
/// accelerometer's delay relative to the gyro's, in seconds.
const FAST_DELAY_S: std::ops::Range<f64> = 0.0..0.015;
const ACCELEROMETER_LAGS_S: f64 = 0.002;
/// Error of an outlier, in metres.
const OUTLIER_M: f64 = 1.0;

/// Errors of a robot's sensors; values are standard deviations unless stated otherwise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SensorSpec {
    /// Encoder counts per revolution of a wheel.
    pub counts_per_turn: f64,
    /// White noise of the wheel speeds, radians per second per sample: 0 for encoders; a filter or
    /// an analogue sensor has it.
    pub wheel_speed_rad_s: f64,
    /// White noise of the gyro, radians per second per sample.
    pub gyro_rad_s: f64,
    /// Initial offset of the gyro, radians per second.
    pub gyro_offset_rad_s: f64,
    /// Random walk of the gyro's offset, radians per second per √s.
    pub gyro_walk_rad_s: f64,
    /// White noise of the accelerometer, metres per second squared per sample.
    pub acceleration_m_s2: f64,
    /// Offset of the accelerometer, metres per second squared.
    pub acceleration_offset_m_s2: f64,
    /// Whether the inertial unit has an attitude, by which gravity is removed from the acceleration.
    pub has_attitude: bool,
    /// Delay of the gyro that its time stamps do not include, seconds, from 0 to [`DELAY_MAX_S`].
    pub gyro_delay_s: f64,
    /// The same of the accelerometer.
    pub acceleration_delay_s: f64,
    /// The same of wheel speeds and torques.
    pub wheel_delay_s: f64,
    /// White noise of the torque of one side, as a friction coefficient.
    pub torque_mu: f64,
    /// Whether torque is measured.
    pub has_torque: bool,
    /// White noise of the speed over ground, metres per second.
    pub body_speed_m_s: f64,
    /// Sampling period of the speed over ground.
    pub body_speed_period: Duration,
    /// White noise of a position, per axis, metres.
    pub position_m: f64,
    /// White noise of the heading of a position, radians.
    pub heading_rad: f64,
    /// Slow error of a position, per axis, metres.
    pub position_wander_m: f64,
    /// Sampling period of positions.
    pub position_period: Duration,
    /// Delay of positions.
    pub position_delay: Duration,
    /// Fraction of positions that are outliers.
    pub outlier_share: f64,
}

impl SensorSpec {
    /// Returns typical sensors: poses of 2 cm at 10 Hz with a delay of 50 ms, and the inertial data
    /// of a small MEMS unit.
    pub fn usual(has_torque: bool) -> Self {
        Self {
            counts_per_turn: 16_384.0,
            wheel_speed_rad_s: 0.0,
            gyro_rad_s: 0.003,
            gyro_offset_rad_s: 0.002,
            gyro_walk_rad_s: 1.0e-4,
            acceleration_m_s2: 0.05,
            acceleration_offset_m_s2: 0.02,
            has_attitude: true,
            gyro_delay_s: 0.0,
            acceleration_delay_s: 0.0,
            wheel_delay_s: 0.0,
            torque_mu: 0.01,
            has_torque,
            body_speed_m_s: 0.02,
            body_speed_period: Duration::from_millis(100),
            position_m: 0.02,
            heading_rad: 0.01,
            position_wander_m: 0.01,
            position_period: Duration::from_millis(100),
            position_delay: Duration::from_millis(50),
            outlier_share: 0.0,
        }
    }

    /// Draws the sensors of one robot of the population.
    pub fn drawn(random: &mut Random, has_torque: bool) -> Self {
        Self::drawn_wider(random, has_torque, Width::default())
    }

    /// Draws the sensors of one robot from distributions that are wider than those of the
    /// population: standard deviations of errors are larger, too.
    pub fn drawn_wider(random: &mut Random, has_torque: bool, width: Width) -> Self {
        let period_s = random.one_of(&[0.2, 0.1, 0.05]).unwrap_or(0.1);
        let period_s = width.log_value(period_s, PERIOD_MIDDLE_S);
        let usual = Self::usual(has_torque);
        Self {
            counts_per_turn: random.log_uniform(width.log_range(4_096.0..80_000.0)),
            gyro_rad_s: width.std_dev(usual.gyro_rad_s),
            gyro_offset_rad_s: width.std_dev(usual.gyro_offset_rad_s),
            gyro_walk_rad_s: random.log_uniform(width.log_range(3.0e-5..3.0e-4)),
            acceleration_m_s2: width.std_dev(usual.acceleration_m_s2),
            acceleration_offset_m_s2: width.std_dev(usual.acceleration_offset_m_s2),
            torque_mu: width.std_dev(usual.torque_mu),
            body_speed_m_s: width.std_dev(usual.body_speed_m_s),
            heading_rad: width.std_dev(usual.heading_rad),
            position_wander_m: width.std_dev(usual.position_wander_m),
            position_m: random.log_uniform(width.log_range(0.005..0.03)),
            position_period: Duration::from_secs_f64(period_s),
            position_delay: Duration::from_secs_f64(width.log_value(
                random.one_of(&[0.02, 0.05, 0.1]).unwrap_or(0.05),
                DELAY_MIDDLE_S,
            )),
            outlier_share: width
                .value(random.one_of(&[0.0, 0.002]).unwrap_or(0.0), Middle(0.001))
                .max(0.0),
            ..usual
        }
    }

    /// Draws whether the inertial unit has an attitude, and delays of unit and wheels that their time
    /// stamps do not include.
    ///
    /// Low-pass filters of inertial units delay gyro and accelerometer about equally, by 1 to 14 ms
    /// (MPU-6050 register map, rev. 4.2, register 26); speeds from encoder counts are late by half of
    /// their period, and buses and time stamps of reception add some milliseconds to both.
    #[must_use]
    pub fn with_drawn_inertial_unit(self, random: &mut Random, width: Width) -> Self {
        let mut delay_s = || random.uniform(width.range(FAST_DELAY_S)).max(0.0);
        let (gyro_delay_s, wheel_delay_s) = (delay_s(), delay_s());
        let lag_s = random.normal(width.std_dev(ACCELEROMETER_LAGS_S));
        Self {
            gyro_delay_s,
            acceleration_delay_s: (gyro_delay_s + lag_s).max(0.0),
            wheel_delay_s,
            has_attitude: random.chance(0.5),
            ..self
        }
    }
}

/// True values of the fast sensors at the last samples, the newest first.
#[derive(Debug, Clone, Default)]
struct FastHistory {
    samples: VecDeque<FastValues>,
}

/// What the fast sensors measure.
#[derive(Debug, Clone, Copy)]
struct FastValues {
    yaw_rate_rad_s: f64,
    acceleration_m_s2: [f64; 2],
    turned_rad: [f64; 2],
    torques_n_m: [f64; 2],
}

impl FastHistory {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a small whole number"
    )]
    fn add(&mut self, values: FastValues) {
        let kept = (DELAY_MAX_S / SAMPLE_PERIOD.as_secs_f64()).ceil() as usize + 1;
        self.samples.truncate(kept);
        self.samples.push_front(values);
    }

    /// Returns a value of `delay_s` seconds ago, interpolated between samples; before the first sample
    /// that of the first one.
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a small number, not below 0"
    )]
    fn late<const N: usize>(&self, delay_s: f64, of: impl Fn(&FastValues) -> [f64; N]) -> [f64; N] {
        let periods = delay_s / SAMPLE_PERIOD.as_secs_f64();
        let whole = periods.floor();
        let at = |index: usize| {
            let sample = self.samples.get(index).or_else(|| self.samples.back());
            sample.map_or([0.0; N], &of)
        };
        let (newer, older) = (at(whole as usize), at(whole as usize + 1));
        let share = periods - whole;
        std::array::from_fn(|place| newer[place] + share * (older[place] - newer[place]))
    }
}

/// Simulated sensors of one robot.
#[derive(Debug, Clone)]
pub struct Sensors {
    spec: SensorSpec,
    random: Random,
    gyro_offset_rad_s: f64,
    acceleration_offset: [f64; 2],
    wander_m: [f64; 2],
    counts: [f64; 2],
    torque_noise_n_m: f64,
    fast: FastHistory,
    next_speed_at: Duration,
    next_position_at: Duration,
    late: VecDeque<(Duration, SensorSample)>,
}

impl Sensors {
    /// Creates the sensors of a robot of this model.
    pub fn new(spec: SensorSpec, model: &RobotModel, mut random: Random) -> Self {
        let load_n = 0.5 * model.mass_kg() * GRAVITY_M_S2;
        Self {
            gyro_offset_rad_s: random.normal(spec.gyro_offset_rad_s),
            acceleration_offset: [
                random.normal(spec.acceleration_offset_m_s2),
                random.normal(spec.acceleration_offset_m_s2),
            ],
            wander_m: [
                random.normal(spec.position_wander_m),
                random.normal(spec.position_wander_m),
            ],
            counts: [0.0; 2],
            torque_noise_n_m: spec.torque_mu * load_n * model.wheel_radius_m(),
            fast: FastHistory::default(),
            next_speed_at: Duration::ZERO,
            next_position_at: Duration::ZERO,
            late: VecDeque::new(),
            spec,
            random,
        }
    }

    fn wheels(&mut self, turned_rad: [f64; 2]) -> WheelSpeeds {
        let per_rad = self.spec.counts_per_turn / std::f64::consts::TAU;
        let counts = turned_rad.map(|turned| (turned * per_rad).floor());
        let before = std::mem::replace(&mut self.counts, counts);
        let noise_rad_s = self.spec.wheel_speed_rad_s;
        let mut speed = |side: usize| {
            let counted = (counts[side] - before[side]) / per_rad / SAMPLE_PERIOD.as_secs_f64();
            // Encoders draw nothing, so that their other errors stay those of the seed.
            let noise = (noise_rad_s > 0.0).then(|| self.random.normal(noise_rad_s));
            counted + noise.unwrap_or(0.0)
        };
        WheelSpeeds {
            left_rad_s: speed(0),
            right_rad_s: speed(1),
        }
    }

    fn position(&mut self, truth: Pose) -> Pose {
        let spec = self.spec;
        let period_s = spec.position_period.as_secs_f64();
        let keeps = (-period_s / POSITION_WANDERS_S).exp();
        let fresh = (1.0 - keeps * keeps).sqrt() * spec.position_wander_m;
        for wander_m in &mut self.wander_m {
            *wander_m = keeps * *wander_m + self.random.normal(fresh);
        }
        let mut off_m = [
            self.wander_m[0] + self.random.normal(spec.position_m),
            self.wander_m[1] + self.random.normal(spec.position_m),
        ];
        if self.random.chance(spec.outlier_share) {
            let angle = self.random.uniform(0.0..std::f64::consts::TAU);
            off_m[0] += OUTLIER_M * angle.cos();
            off_m[1] += OUTLIER_M * angle.sin();
        }
        Pose {
            x_m: truth.x_m + off_m[0],
            y_m: truth.y_m + off_m[1],
            heading_rad: wrap_angle_rad(truth.heading_rad + self.random.normal(spec.heading_rad)),
        }
    }

    /// Appends the samples of the time `at` to `to`. `means` are the means since the sample before.
    pub fn sample(&mut self, truth: &Truth, means: &Means, at: Duration, to: &mut Feedback) {
        let (spec, state) = (self.spec, truth.state);
        self.gyro_offset_rad_s += self
            .random
            .normal(spec.gyro_walk_rad_s * SAMPLE_PERIOD.as_secs_f64().sqrt());
        let body_speed_m_s = (at >= self.next_speed_at).then(|| {
            self.next_speed_at = at + spec.body_speed_period;
            state.forward_m_s + self.random.normal(spec.body_speed_m_s)
        });
        let kept = if spec.has_attitude {
            [0.0; 2]
        } else {
            truth.gravity_m_s2
        };
        self.fast.add(FastValues {
            yaw_rate_rad_s: means.yaw_rate_rad_s,
            acceleration_m_s2: [
                means.acceleration.forward_m_s2 - kept[0],
                means.acceleration.left_m_s2 - kept[1],
            ],
            turned_rad: truth.turned_rad,
            torques_n_m: [means.torques.left_n_m, means.torques.right_n_m],
        });
        let fast = &self.fast;
        let [yaw_rate_rad_s] = fast.late(spec.gyro_delay_s, |values| [values.yaw_rate_rad_s]);
        let acceleration = fast.late(spec.acceleration_delay_s, |values| values.acceleration_m_s2);
        let turned_rad = fast.late(spec.wheel_delay_s, |values| values.turned_rad);
        let torques = fast.late(spec.wheel_delay_s, |values| values.torques_n_m);
        let scale = truth.torque_scale;
        let noise_n_m = self.torque_noise_n_m;
        let wheel_torques = spec.has_torque.then(|| WheelTorques {
            left_n_m: scale[0] * torques[0] + self.random.normal(noise_n_m),
            right_n_m: scale[1] * torques[1] + self.random.normal(noise_n_m),
        });
        let offset = self.acceleration_offset;
        to.push(SensorSample {
            at,
            yaw_rate_rad_s: Some(
                yaw_rate_rad_s + self.gyro_offset_rad_s + self.random.normal(spec.gyro_rad_s),
            ),
            acceleration: Some(BodyAcceleration {
                forward_m_s2: acceleration[0]
                    + offset[0]
                    + self.random.normal(spec.acceleration_m_s2),
                left_m_s2: acceleration[1] + offset[1] + self.random.normal(spec.acceleration_m_s2),
            }),
            is_specific_force: !spec.has_attitude,
            wheel_speeds: Some(self.wheels(turned_rad)),
            wheel_torques,
            body_speed_m_s,
            tilt_rad: Some(truth.tilt_rad),
            position: None,
            position_noise: None,
        });
        if at >= self.next_position_at {
            self.next_position_at = at + spec.position_period;
            let fix = SensorSample {
                at,
                position: Some(self.position(state.pose)),
                ..SensorSample::default()
            };
            self.late.push_back((at + spec.position_delay, fix));
        }
        while let Some((_, fix)) = self.late.pop_front_if(|(due, _)| *due <= at) {
            to.push(fix);
        }
    }
}
