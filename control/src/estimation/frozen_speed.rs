//! Speeds over ground that do not change any more.
//!
//! A receiver or a filter that hangs often repeats its last speed. A measured speed has noise, so one that
//! stays the same to the last bit is no measurement of a robot that moves, and θ would be wrong by what
//! it hides. A speed in coarse steps may repeat for a moment; it is used again as soon as it changes.

use std::time::Duration;

use super::SensorSample;
use crate::repeats::Repeats;

/// Time and number of equal speeds from which they are frozen: a slow receiver repeats none.
const FROZEN_AFTER: Duration = Duration::from_secs(1);
const FROZEN_COUNT: u32 = 4;

/// Equal speeds over ground.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct FrozenSpeed {
    repeats: Repeats,
    /// Time since the first sample.
    at: Duration,
}

impl FrozenSpeed {
    /// Returns the sample, taken `time_s` seconds after the one before, without its speed over ground if
    /// that is frozen.
    pub(super) fn without(&mut self, sample: &SensorSample, time_s: f64) -> SensorSample {
        self.at += Duration::from_secs_f64(time_s);
        if let Some(speed_m_s) = sample.body_speed_m_s {
            self.repeats.take(self.at, [speed_m_s, 0.0, 0.0]);
        }
        let is_frozen = self.repeats.have_lasted(FROZEN_AFTER, FROZEN_COUNT);
        SensorSample {
            body_speed_m_s: sample.body_speed_m_s.filter(|_| !is_frozen),
            ..*sample
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measured::WheelSpeeds;

    /// Feeds 3 s of samples at 100 Hz, and returns at how many of the last second's there was a speed.
    fn used(speed_m_s: impl Fn(u32) -> Option<f64>) -> usize {
        let mut check = FrozenSpeed::default();
        let used = (0..300).map(|tick| {
            let sample = SensorSample {
                wheel_speeds: WheelSpeeds {
                    left_rad_s: 6.0,
                    right_rad_s: 6.0,
                },
                gyro_rad_s: 0.0,
                acceleration: None,
                is_specific_force: false,
                body_speed_m_s: speed_m_s(tick),
                wheel_torques: None,
            };
            check.without(&sample, 0.01).body_speed_m_s.is_some()
        });
        used.skip(200).filter(|is_used| *is_used).count()
    }

    #[test]
    fn a_frozen_speed_is_not_used() {
        assert_eq!(used(|_| Some(0.6)), 0);
        assert_eq!(used(|tick| tick.is_multiple_of(10).then_some(0.6)), 0);
    }

    #[test]
    fn a_speed_that_changes_is_used() {
        assert_eq!(used(|tick| Some(0.6 + 0.001 * f64::from(tick % 2))), 100);
        // Each speed is repeated eight times, in steps of a centimetre per second.
        let stepped = |tick: u32| {
            tick.is_multiple_of(10)
                .then_some(0.6 + 0.01 * f64::from(tick / 80))
        };
        assert_eq!(used(stepped), 10);
        // Once a second.
        assert_eq!(
            used(|tick| tick
                .is_multiple_of(100)
                .then_some(0.6 + 0.01 * f64::from(tick))),
            1
        );
    }

    #[test]
    fn a_speed_that_changes_again_is_used_at_once() {
        let speed = |tick: u32| {
            Some(if tick < 250 {
                0.6
            } else {
                0.6 + 0.001 * f64::from(tick)
            })
        };
        assert_eq!(used(speed), 50);
    }
}
