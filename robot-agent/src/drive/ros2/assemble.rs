//! Assembles messages to the loop's samples: one sample per message of the wheels, with the others'
//! latest values.
//!
//! Pure, and without allocation: it runs in the loop.

use std::time::Duration;

use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};

use super::reading::{Content, Inertial, Motion, Position, Wheels, wheels_of};
use super::settings::{MotionOf, Ros2Settings};
use crate::drive::{Battery, Feedback, SensorSample, StatedNoise};

/// Largest time between a sample of the wheels and the value of another sensor that is added to it.
const COMPANION_AGE_MAX: Duration = Duration::from_millis(60);

/// A message in the queue to the loop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct QueuedMessage {
    /// Time of measurement, by the agent's monotonic clock.
    pub at: Duration,
    /// Content of the message.
    pub content: Content,
}

/// Sums over the inertial samples since the last message of the wheels.
#[derive(Debug, Clone, Copy, Default)]
struct InertialSums {
    count: f64,
    yaw_rad_s: f64,
    felt_count: f64,
    felt: BodyAcceleration,
}

/// State between two samples.
#[derive(Debug, Clone)]
pub struct Assembler {
    has_imu: bool,
    has_joints: bool,
    motion_of: MotionOf,
    settings: super::settings::CommandSettings,
    sums: InertialSums,
    last_inertial: Option<(Duration, Inertial)>,
    last_motion: Option<(Duration, Motion)>,
    ground_speed_m_s: Option<f64>,
    tilt_rad: Option<f64>,
    battery: Option<Battery>,
    noise: StatedNoise,
}

impl Assembler {
    /// Creates an assembler before the first message.
    pub fn new(settings: &Ros2Settings) -> Self {
        let odometry = settings.odometry.as_ref();
        Self {
            has_imu: settings.imu.is_some(),
            has_joints: settings.joints.is_some(),
            motion_of: odometry.map_or(MotionOf::Ground, |odometry| odometry.motion_of),
            settings: settings.command.clone(),
            sums: InertialSums::default(),
            last_inertial: None,
            last_motion: None,
            ground_speed_m_s: None,
            tilt_rad: None,
            battery: None,
            noise: StatedNoise::default(),
        }
    }

    /// Returns the battery as last reported.
    pub fn battery(&self) -> Option<Battery> {
        self.battery
    }

    /// Returns the noise as last stated by covariances.
    pub fn noise(&self) -> StatedNoise {
        self.noise
    }

    /// Returns the time of the newest yaw rate.
    pub fn turned_at(&self) -> Option<Duration> {
        if self.has_imu {
            self.last_inertial.map(|(at, _)| at)
        } else {
            self.last_motion.map(|(at, _)| at)
        }
    }

    /// Processes a message; returns the wheel speeds if it completes a sample of them.
    pub fn take(
        &mut self,
        arrived: &QueuedMessage,
        feedback: &mut Feedback,
    ) -> Option<WheelSpeeds> {
        match arrived.content {
            Content::Battery(battery) => self.battery = Some(battery),
            Content::Position(position) => feedback.push(fix(arrived.at, &position)),
            Content::Inertial(inertial) => self.add_imu_message(arrived.at, inertial),
            Content::Motion(motion) => {
                if let Some(position) = motion.position {
                    feedback.push(fix(arrived.at, &position));
                }
                self.last_motion = Some((arrived.at, motion));
                if self.motion_of == MotionOf::Ground {
                    self.ground_speed_m_s = Some(motion.forward_m_s);
                    self.noise.body_speed_m_s =
                        motion.forward_std_dev.or(self.noise.body_speed_m_s);
                }
                if !self.has_joints {
                    let speeds = wheels_of(&motion, &self.settings);
                    feedback.push(self.sample(arrived.at, speeds, None));
                    return Some(speeds);
                }
            }
            Content::Wheels(Wheels { speeds, torques }) => {
                feedback.push(self.sample(arrived.at, speeds, torques));
                return Some(speeds);
            }
        }
        None
    }

    fn add_imu_message(&mut self, at: Duration, inertial: Inertial) {
        self.sums.count += 1.0;
        self.sums.yaw_rad_s += inertial.yaw_rate_rad_s;
        if let Some(felt) = inertial.acceleration {
            self.sums.felt_count += 1.0;
            self.sums.felt.forward_m_s2 += felt.forward_m_s2;
            self.sums.felt.left_m_s2 += felt.left_m_s2;
        }
        self.tilt_rad = inertial.tilt_rad;
        self.noise.gyro_rad_s = inertial.yaw_rate_std_dev.or(self.noise.gyro_rad_s);
        let felt = inertial.acceleration_std_dev;
        self.noise.accelerometer_m_s2 = felt.or(self.noise.accelerometer_m_s2);
        self.last_inertial = Some((at, inertial));
    }

    fn sample(
        &mut self,
        at: Duration,
        wheel_speeds: WheelSpeeds,
        wheel_torques: Option<WheelTorques>,
    ) -> SensorSample {
        let is_near = |other: Duration| at.abs_diff(other) <= COMPANION_AGE_MAX;
        let inertial = self.last_inertial.filter(|(other, _)| is_near(*other));
        let inertial = inertial.map(|(_, inertial)| inertial);
        let sums = std::mem::take(&mut self.sums);
        let mean = |sum: f64, count: f64| (count > 0.0).then(|| sum / count);
        let (yaw_rate_rad_s, acceleration) = if self.has_imu {
            // Means since the last sample; without new values the last one.
            let yaw_rate = mean(sums.yaw_rad_s, sums.count);
            let felt = mean(sums.felt.forward_m_s2, sums.felt_count)
                .zip(mean(sums.felt.left_m_s2, sums.felt_count))
                .map(|(forward_m_s2, left_m_s2)| BodyAcceleration {
                    forward_m_s2,
                    left_m_s2,
                });
            let last = inertial.map(|inertial| inertial.yaw_rate_rad_s);
            let felt = felt.or(inertial.and_then(|inertial| inertial.acceleration));
            // A silent inertial unit gives no value, whatever is left in the sums.
            (last.and(yaw_rate.or(last)), felt.filter(|_| last.is_some()))
        } else {
            let motion = self.last_motion.filter(|(other, _)| is_near(*other));
            (motion.map(|(_, motion)| motion.yaw_rate_rad_s), None)
        };
        SensorSample {
            at,
            yaw_rate_rad_s,
            acceleration,
            is_specific_force: inertial.is_some_and(|inertial| inertial.is_specific_force),
            wheel_speeds: Some(wheel_speeds),
            wheel_torques,
            body_speed_m_s: self.ground_speed_m_s.take(),
            tilt_rad: self.tilt_rad.take(),
            position: None,
            position_noise: None,
        }
    }
}

fn fix(at: Duration, position: &Position) -> SensorSample {
    SensorSample {
        at,
        position: Some(position.pose),
        position_noise: position.noise,
        ..SensorSample::default()
    }
}
