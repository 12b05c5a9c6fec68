//! The interface to a base: what is read from it and written to it once per tick.
//!
//! A drive hands over every sensor sample since the last tick (up to [`SAMPLES_MAX`]), so that the
//! estimator sees all of a 200 Hz sensor in a 100 Hz loop. Neither call may block or allocate.

pub mod ros2;
pub mod simulated;

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::thread::Thread;
use std::time::Duration;

use tread_control::geometry::Pose;
use tread_control::localisation::FixNoise;
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};

/// Most samples of one tick: a 20 Hz loop with 200 Hz sensors, with room for jitter.
pub const SAMPLES_MAX: usize = 16;

/// Longest silence of any base with which it does not count as silent.
pub const SILENT_AFTER_MAX: Duration = Duration::from_millis(200);

/// What the base's sensors said at one moment; absent where a sensor said nothing then.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SensorSample {
    /// When it was measured, by the agent's monotonic clock.
    pub at: Duration,
    /// Turn rate from the gyro, radians per second.
    pub yaw_rate_rad_s: Option<f64>,
    /// Acceleration without gravity.
    pub acceleration: Option<BodyAcceleration>,
    /// Wheel speeds as measured, never as commanded.
    pub wheel_speeds: Option<WheelSpeeds>,
    /// Drive torques.
    pub wheel_torques: Option<WheelTorques>,
    /// Speed of the body over ground, ahead, metres per second.
    pub body_speed_m_s: Option<f64>,
    /// How far the robot leans from level, radians.
    pub tilt_rad: Option<f64>,
    /// A position fix in the site's frame.
    pub position: Option<Pose>,
    /// How good that fix is, where the base says so.
    pub position_noise: Option<FixNoise>,
}

/// How good the base says that its sensors are: one standard deviation each, where it says so.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StatedNoise {
    /// Gyro, radians per second.
    pub gyro_rad_s: Option<f64>,
    /// Accelerometer, metres per second squared.
    pub accelerometer_m_s2: Option<f64>,
    /// Speed of the body over ground, metres per second.
    pub body_speed_m_s: Option<f64>,
}

/// Word of new samples, for a loop that waits for them.
#[derive(Debug, Default)]
pub struct Arrivals {
    count: AtomicU64,
    waiting: OnceLock<Thread>,
}

impl Arrivals {
    /// From now on the calling thread is woken.
    pub fn attend(&self) {
        // A second thread would be a mistake of the program's; the first goes on.
        let _ = self.waiting.set(std::thread::current());
    }

    /// A sample has come.
    pub fn ring(&self) {
        self.count.fetch_add(1, Ordering::Release);
        if let Some(waiting) = self.waiting.get() {
            waiting.unpark();
        }
    }

    /// How many have come.
    pub fn count(&self) -> u64 {
        self.count.load(Ordering::Acquire)
    }
}

/// Everything that the base said since the last tick, oldest first.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Feedback {
    samples: [SensorSample; SAMPLES_MAX],
    count: usize,
    lost: u32,
}

impl Feedback {
    /// Adds a sample; the oldest gives way when there are too many.
    pub fn push(&mut self, sample: SensorSample) {
        if self.count == SAMPLES_MAX {
            self.samples.rotate_left(1);
            self.count -= 1;
            self.lost = self.lost.saturating_add(1);
        }
        self.samples[self.count] = sample;
        self.count += 1;
    }

    /// The same with so many more samples that gave way.
    #[must_use]
    pub fn with_lost(mut self, lost: u32) -> Self {
        self.lost = self.lost.saturating_add(lost);
        self
    }

    /// The samples, oldest first.
    pub fn samples(&self) -> &[SensorSample] {
        &self.samples[..self.count]
    }

    /// Takes the newest back.
    pub fn pop(&mut self) {
        self.count = self.count.saturating_sub(1);
    }

    /// Samples that gave way.
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

/// A base.
pub trait Drive: Send {
    /// Everything that the sensors said since the last call.
    fn read(&mut self, now: Duration) -> Feedback;

    /// Commands the wheels; the base keeps this until the next call.
    fn write(&mut self, command: WheelSpeeds);

    /// The battery; none if the base does not measure it.
    fn battery(&self) -> Option<Battery> {
        None
    }

    /// How good the sensors are, as far as the base says so.
    fn noise(&self) -> StatedNoise {
        StatedNoise::default()
    }

    /// Oldest word of the base with which it does not count as silent, at most
    /// [`SILENT_AFTER_MAX`].
    fn silent_after(&self) -> Duration {
        SILENT_AFTER_MAX
    }

    /// Whether the base itself is commanded to rest, because no message of it arrives.
    fn is_silent(&self) -> bool {
        false
    }

    /// What tells of new samples, if they are to set the loop's pace.
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
