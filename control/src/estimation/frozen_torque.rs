//! Wheel torques that do not change any more.
//!
//! A driver that loses its current sensor often repeats the last torque, or reports zero. Measured
//! torque has noise, so a torque that stays the same to the last bit while the turn rate does not is
//! no measurement. θ from such torques would be wrong, and its interval narrow.

use super::SensorSample;
use super::payload::STANDING_M_S;
use crate::measured::WheelTorques;
use crate::robot::RobotModel;

/// Time of equal torques from which they are frozen, seconds; longer than the period of drivers that
/// read torques less often than wheel speeds.
const FROZEN_AFTER_S: f64 = 0.5;

/// Time for which the wheel torques have been the same.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct FrozenTorque {
    last: Option<(WheelTorques, f64)>,
    repeated_s: f64,
    /// The part of that time in which a wheel turned.
    driven_s: f64,
}

impl FrozenTorque {
    /// Returns the sample, taken `time_s` seconds after the one before, without its torques if they
    /// are frozen and a wheel of the robot turns.
    pub(super) fn without(
        &mut self,
        sample: &SensorSample,
        model: &RobotModel,
        time_s: f64,
    ) -> SensorSample {
        let gyro_rad_s = sample.gyro_rad_s;
        let rim_m_s = sample.wheel_speeds.magnitude_max_rad_s() * model.wheel_radius_m();
        let is_moving = rim_m_s > STANDING_M_S;
        let now = sample.wheel_torques.map(|torques| (torques, gyro_rad_s));
        let last = std::mem::replace(&mut self.last, now);
        match (now, last) {
            (Some((torques, _)), Some((before, turned_rad_s))) if torques == before => {
                // A simulation without noise repeats all of its values at a steady state.
                if gyro_rad_s.to_bits() != turned_rad_s.to_bits() {
                    self.repeated_s += time_s;
                    self.driven_s += if is_moving { time_s } else { 0.0 };
                }
            }
            _ => (self.repeated_s, self.driven_s) = (0.0, 0.0),
        }
        let is_frozen = self.repeated_s >= FROZEN_AFTER_S && is_moving;
        SensorSample {
            wheel_torques: sample.wheel_torques.filter(|_| !is_frozen),
            ..*sample
        }
    }

    /// Returns the torques that have been the same for half a second of driving; they stay frozen while
    /// the robot stands, until they change. Torques at rest may well be the same.
    pub(super) fn frozen(&self) -> Option<WheelTorques> {
        let (torques, _) = self.last?;
        (self.driven_s >= FROZEN_AFTER_S).then_some(torques)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measured::WheelSpeeds;

    const TIME_S: f64 = 0.01;

    /// A second of samples; whether the torque of the last one is used.
    fn is_used(rad_s: f64, torque: impl Fn(f64) -> f64, gyro: impl Fn(f64) -> f64) -> bool {
        let mut check = FrozenTorque::default();
        let mut used = None;
        for tick in 0..100_u32 {
            let at_s = TIME_S * f64::from(tick);
            let sample = SensorSample {
                wheel_speeds: WheelSpeeds {
                    left_rad_s: rad_s,
                    right_rad_s: rad_s,
                },
                gyro_rad_s: gyro(at_s),
                wheel_torques: Some(WheelTorques {
                    left_n_m: torque(at_s),
                    right_n_m: 0.0,
                }),
                ..SensorSample::default()
            };
            used = check
                .without(&sample, &RobotModel::yi2007(), TIME_S)
                .wheel_torques;
        }
        used.is_some()
    }

    #[test]
    fn torques_that_stay_the_same_while_the_turn_rate_changes_are_not_used() {
        let turns = |at_s: f64| 0.1 * at_s;
        assert!(!is_used(5.0, |_| 0.0, turns));
        assert!(!is_used(-5.0, |_| 1.3, turns));
        // A side that does not change beside one that does.
        assert!(is_used(5.0, |at_s| at_s, turns));
        // Read every 0.3 s.
        assert!(is_used(5.0, |at_s| (at_s / 0.3).floor(), turns));
        // At rest, and a simulation without noise.
        assert!(is_used(0.0, |_| 0.0, turns));
        assert!(is_used(5.0, |_| 1.3, |_| 0.2));
    }

    #[test]
    fn torques_are_reported_frozen_after_half_a_second_of_driving_until_they_change() {
        let mut check = FrozenTorque::default();
        let mut tick = 0.0;
        let mut after = |seconds: f64, rad_s: f64, left_n_m: f64| {
            let until = tick + seconds;
            while tick < until {
                tick += TIME_S;
                let sample = SensorSample {
                    wheel_speeds: WheelSpeeds {
                        left_rad_s: rad_s,
                        right_rad_s: rad_s,
                    },
                    gyro_rad_s: tick,
                    wheel_torques: Some(WheelTorques {
                        left_n_m,
                        right_n_m: 0.0,
                    }),
                    ..SensorSample::default()
                };
                check.without(&sample, &RobotModel::yi2007(), TIME_S);
            }
            check.frozen().map(|torques| torques.left_n_m)
        };
        assert_eq!(after(5.0, 0.0, 0.0), None, "it stands");
        assert_eq!(after(0.3, 5.0, 0.0), None, "not for long enough");
        assert_eq!(after(0.4, 5.0, 0.0), Some(0.0));
        assert_eq!(after(5.0, 0.0, 0.0), Some(0.0), "it stands again");
        assert_eq!(after(0.1, 5.0, 0.7), None);
    }
}
