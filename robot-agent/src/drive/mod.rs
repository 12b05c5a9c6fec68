//! The interface to a base: what is read from it and written to it once per tick.
//!
//! A drive hands over every sensor sample since the last tick (up to [`SAMPLES_MAX`]), so that the
//! estimator sees all of a 200 Hz sensor in a 100 Hz loop. Neither call may block or allocate.

pub mod ros2;

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::Thread;
use std::time::Duration;

use tread_control::estimation;
use tread_control::geometry::Pose;
use tread_control::localisation::FixNoise;
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};

/// Largest number of samples per tick: a 20 Hz loop with 200 Hz sensors, with room for jitter.
pub const SAMPLES_MAX: usize = 16;

/// Largest age of a base's last sample at which it does not count as silent yet, for any base.
pub const SILENT_AFTER_MAX: Duration = Duration::from_millis(200);

/// Sensor values measured at one time; `None` where a sensor has no value for it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SensorSample {
    /// Time of measurement, by the agent's monotonic clock.
    pub at: Duration,
    /// Yaw rate of the gyro, rad/s, positive to the left.
    pub yaw_rate_rad_s: Option<f64>,
    /// Acceleration along the ground, in the robot frame.
    pub acceleration: Option<BodyAcceleration>,
    /// Whether `acceleration` is the specific force, as of a unit without attitude; otherwise it is
    /// without gravity.
    pub is_specific_force: bool,
    /// Wheel speeds as measured, never as commanded.
    pub wheel_speeds: Option<WheelSpeeds>,
    /// Drive torques of the wheels.
    pub wheel_torques: Option<WheelTorques>,
    /// Forward speed of the body over ground, m/s.
    pub body_speed_m_s: Option<f64>,
    /// Tilt of the robot against the vertical, radians.
    pub tilt_rad: Option<f64>,
    /// A position fix in the site's frame.
    pub position: Option<Pose>,
    /// Standard deviations of the fix, where the base states them.
    pub position_noise: Option<FixNoise>,
}

/// The motion of a sample for the estimator, if gyro and wheels are finite.
pub(crate) fn motion_of(sample: &SensorSample) -> Option<estimation::SensorSample> {
    Some(estimation::SensorSample {
        wheel_speeds: sample.wheel_speeds.filter(|speeds| speeds.is_finite())?,
        gyro_rad_s: sample.yaw_rate_rad_s.filter(|rate| rate.is_finite())?,
        acceleration: sample.acceleration,
        is_specific_force: sample.is_specific_force,
        body_speed_m_s: sample.body_speed_m_s,
        wheel_torques: sample.wheel_torques,
    })
}

/// Standard deviations of the sensors' noise, where the base states them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StatedNoise {
    /// Gyro, rad/s.
    pub gyro_rad_s: Option<f64>,
    /// Accelerometer, m/s².
    pub accelerometer_m_s2: Option<f64>,
    /// Speed of the body over ground, m/s.
    pub body_speed_m_s: Option<f64>,
}

/// Signals new samples to a loop that waits for them.
#[derive(Debug, Default)]
pub struct Arrivals {
    count: AtomicU64,
    waiting: OnceLock<Thread>,
}

impl Arrivals {
    /// Makes [`Arrivals::notify`] wake the calling thread.
    pub fn register_thread(&self) {
        // A second thread would be a programming error; the first one stays registered.
        let _ = self.waiting.set(std::thread::current());
    }

    /// Counts a new sample and wakes the waiting thread.
    pub fn notify(&self) {
        self.count.fetch_add(1, Ordering::Release);
        if let Some(waiting) = self.waiting.get() {
            waiting.unpark();
        }
    }

    /// Returns the number of samples so far.
    pub fn count(&self) -> u64 {
        self.count.load(Ordering::Acquire)
    }
}

/// Samples of the base since the last tick, oldest first.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Feedback {
    samples: [SensorSample; SAMPLES_MAX],
    count: usize,
    lost: u32,
}

impl Feedback {
    /// Adds a sample; drops and counts the oldest one above [`SAMPLES_MAX`].
    pub fn push(&mut self, sample: SensorSample) {
        if self.count == SAMPLES_MAX {
            self.samples.rotate_left(1);
            self.count -= 1;
            self.lost = self.lost.saturating_add(1);
        }
        self.samples[self.count] = sample;
        self.count += 1;
    }

    /// Adds to the number of dropped samples.
    #[must_use]
    pub fn with_lost(mut self, lost: u32) -> Self {
        self.lost = self.lost.saturating_add(lost);
        self
    }

    /// Returns the samples, oldest first.
    pub fn samples(&self) -> &[SensorSample] {
        &self.samples[..self.count]
    }

    /// Removes the newest sample.
    pub fn pop(&mut self) {
        self.count = self.count.saturating_sub(1);
    }

    /// Returns the number of dropped samples.
    pub fn lost(&self) -> u32 {
        self.lost
    }
}

/// A base's battery.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Battery {
    /// Charge, 0 to 1.
    pub charge_ratio: f64,
    /// Voltage, volts.
    pub voltage_v: f64,
}

/// A robot base.
pub trait Drive: Send {
    /// Returns the samples since the last call. Must not block or allocate.
    fn read(&mut self, now: Duration) -> Feedback;

    /// Commands the wheel speeds, in force until the next call. Must not block or allocate.
    fn write(&mut self, command: WheelSpeeds);

    /// Returns the battery; `None` if the base does not measure it.
    fn battery(&self) -> Option<Battery> {
        None
    }

    /// Returns the standard deviations of the sensors, as far as the base states them.
    fn noise(&self) -> StatedNoise {
        StatedNoise::default()
    }

    /// Returns the age of the last sample beyond which the base counts as silent, at most
    /// [`SILENT_AFTER_MAX`].
    fn silent_after(&self) -> Duration {
        SILENT_AFTER_MAX
    }

    /// Whether the drive itself commands zero because no sample of the base arrives.
    fn is_silent(&self) -> bool {
        false
    }

    /// Returns the signal of new samples, if they shall trigger the loop's ticks.
    fn arrivals(&self) -> Option<Arc<Arrivals>> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn feedback_keeps_the_newest_samples() {
        let mut feedback = Feedback::default();
        for index in 0..SAMPLES_MAX as u64 + 3 {
            let at = Duration::from_millis(index);
            feedback.push(SensorSample {
                at,
                ..SensorSample::default()
            });
        }
        assert_eq!(feedback.samples().len(), SAMPLES_MAX);
        assert_eq!(feedback.lost(), 3);
        assert_eq!(feedback.samples()[0].at, Duration::from_millis(3));
    }
}
