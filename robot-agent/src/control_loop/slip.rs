//! Computes the longitudinal slip of each side for display; the control law does not use it.
//!
//! Equation (3) of the paper for each side, `λ = (rω − v)/(rω)`, low-pass filtered over
//! [`MEMORY_S`]. While the wheels of a base without a speed sensor accelerate, the speed from fixes
//! lags behind the wheels, which would look like slip; the slip is undefined then.

use tread_api::friction::SideSlip;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;
use tread_control::slip::{BodyVelocity, SideSlips};

/// Time constant of the low-pass filter, seconds: several samples of sensor noise, far less than
/// the time in which the ground changes.
const MEMORY_S: f64 = 0.5;
/// Smallest rim speed at which the slip is defined, m/s.
const RIM_MIN_M_S: f64 = 0.05;

/// Largest difference of a rim's speed from its filtered value, m/s, up to which the slip is
/// defined.
const STEADY_M_S: f64 = 0.06;

/// Filtered slip of both sides.
#[derive(Debug, Default)]
pub(crate) struct SlipMeter {
    smooth: Option<SideSlips>,
    /// Filtered wheel speeds.
    wheels: WheelSpeeds,
}

impl SlipMeter {
    /// Processes one tick of `dt_s`: velocity of the body and wheel speeds, `None` while the base
    /// is silent.
    pub(crate) fn step(
        &mut self,
        measured: Option<(BodyVelocity, WheelSpeeds)>,
        model: &RobotModel,
        dt_s: f64,
    ) {
        let share = (dt_s / MEMORY_S).clamp(0.0, 1.0);
        let toward = |before: f64, now: f64| before + share * (now - before);
        let now = measured.and_then(|(velocity, wheels)| {
            let mean = &mut self.wheels;
            mean.left_rad_s = toward(mean.left_rad_s, wheels.left_rad_s);
            mean.right_rad_s = toward(mean.right_rad_s, wheels.right_rad_s);
            let off_rad_s = (wheels.left_rad_s - mean.left_rad_s)
                .abs()
                .max((wheels.right_rad_s - mean.right_rad_s).abs());
            let slowest = wheels.left_rad_s.abs().min(wheels.right_rad_s.abs());
            let is_defined = slowest * model.wheel_radius_m() >= RIM_MIN_M_S
                && off_rad_s * model.wheel_radius_m() <= STEADY_M_S;
            let slips = is_defined.then(|| SideSlips::of(&velocity, wheels, model))?;
            (slips.left.is_finite() && slips.right.is_finite()).then_some(slips)
        });
        self.smooth = match (self.smooth, now) {
            (Some(before), Some(now)) => Some(SideSlips {
                left: toward(before.left, now.left),
                right: toward(before.right, now.right),
            }),
            (None, now) => now,
            (Some(_), None) => None,
        };
    }

    /// Returns the filtered slip; `None` while it is undefined.
    pub(crate) fn slip(&self) -> Option<SideSlip> {
        self.smooth.map(|slips| SideSlip {
            left_ratio: slips.left,
            right_ratio: slips.right,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> RobotModel {
        RobotModel::yi2007()
    }

    /// Both sides at a rim speed, the body at a share of it.
    fn moving(rim_m_s: f64, share: f64) -> (BodyVelocity, WheelSpeeds) {
        let rad_s = rim_m_s / model().wheel_radius_m();
        let velocity = BodyVelocity {
            forward_m_s: share * rim_m_s,
            ..BodyVelocity::default()
        };
        let wheels = WheelSpeeds {
            left_rad_s: rad_s,
            right_rad_s: rad_s,
        };
        (velocity, wheels)
    }

    #[test]
    fn wheels_that_turn_faster_than_the_ground_passes_slip_by_that_share_either_way() {
        for rim_m_s in [0.5, -0.5] {
            let mut meter = SlipMeter::default();
            meter.step(Some(moving(rim_m_s, 0.9)), &model(), 0.01);
            assert_eq!(meter.slip(), None, "it has just begun to move");
            for _ in 0..200 {
                meter.step(Some(moving(rim_m_s, 0.9)), &model(), 0.01);
            }
            let slip = meter.slip().expect("they turn");
            assert!((slip.left_ratio - 0.1).abs() < 1.0e-9, "{slip:?}");
            // Braking: the ground passes faster than the rim, and the meter comes there in time.
            for _ in 0..500 {
                meter.step(Some(moving(rim_m_s, 1.2)), &model(), 0.01);
            }
            let slip = meter.slip().expect("they turn");
            assert!((slip.right_ratio + 0.2).abs() < 1.0e-3, "{slip:?}");
        }
    }

    #[test]
    fn at_rest_on_a_silent_base_or_with_nonsense_there_is_no_slip() {
        let mut meter = SlipMeter::default();
        for _ in 0..200 {
            meter.step(Some(moving(0.5, 0.9)), &model(), 0.01);
        }
        assert!(meter.slip().is_some());
        meter.step(None, &model(), 0.01);
        assert_eq!(meter.slip(), None);
        meter.step(Some(moving(0.01, 0.5)), &model(), 0.01);
        assert_eq!(meter.slip(), None);
        meter.step(Some(moving(0.5, f64::NAN)), &model(), 0.01);
        assert_eq!(meter.slip(), None);
    }
}
