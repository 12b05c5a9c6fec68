//! The last word before the wheels: it can only reduce a command.
//!
//! A stop, a stale base or a command that is not finite asks for rest; limits cut what is left.
//! Speeding up is bounded by the wheels' acceleration, slowing down by the braking limit, so rest
//! is met on a ramp. The strictest cause is reported: the order of [`GateCause`].

use crate::measured::WheelSpeeds;
use crate::robot::RobotModel;

/// Why a command was reduced; later ones are stricter.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum GateCause {
    /// The command changed faster than the wheels may.
    Acceleration,
    /// The command was above the wheels' speed limit.
    Speed,
    /// The command was not a number.
    NotFinite,
    /// There was no command.
    NoCommand,
    /// The base has not been heard for too long.
    StaleFeedback,
    /// A stop is in force.
    Stop,
}

/// Bounds of the gate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateLimits {
    /// Fastest wheel, radians per second.
    pub wheel_speed_max_rad_s: f64,
    /// Fastest speeding up of a wheel, radians per second squared.
    pub wheel_acceleration_max_rad_s2: f64,
    /// Fastest slowing down of a wheel, radians per second squared.
    pub wheel_braking_max_rad_s2: f64,
    /// Oldest feedback of the base that is trusted, seconds.
    pub feedback_age_max_s: f64,
}

impl GateLimits {
    /// Limits of a robot; it brakes no harder along the path than twice its planned braking, so
    /// that a turn can be undone at the same time.
    pub fn of(model: &RobotModel) -> Self {
        let limits = model.limits();
        let braking = 2.0 * limits.linear_acceleration_max_m_s2 / model.wheel_radius_m();
        Self {
            wheel_speed_max_rad_s: limits.wheel_speed_max_rad_s,
            wheel_acceleration_max_rad_s2: limits.wheel_acceleration_max_rad_s2,
            wheel_braking_max_rad_s2: braking.min(limits.wheel_acceleration_max_rad_s2),
            feedback_age_max_s: 0.2,
        }
    }
}

/// What the gate looks at in one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateInput {
    /// What is wanted; none asks for rest.
    pub command: Option<WheelSpeeds>,
    /// What the gate let through last.
    pub previous: WheelSpeeds,
    /// Whether a stop is in force.
    pub stop: bool,
    /// Age of the last word from the base, seconds.
    pub feedback_age_s: f64,
    /// Time since the gate's last word, seconds.
    pub dt_s: f64,
}

/// What the gate lets through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateOutput {
    /// Wheel speeds for the base.
    pub wheel_speeds: WheelSpeeds,
    /// The strictest cause of a reduction; none when the command passed whole.
    pub cause: Option<GateCause>,
}

/// Lets a command through, reduced where it must be.
pub fn gate(input: &GateInput, limits: &GateLimits) -> GateOutput {
    let mut cause: Option<GateCause> = None;
    let mut note = |new: GateCause| cause = cause.max(Some(new));
    let fresh =
        input.feedback_age_s.is_finite() && input.feedback_age_s <= limits.feedback_age_max_s;
    let rest = WheelSpeeds::default();
    let mut target = match input.command {
        None => {
            note(GateCause::NoCommand);
            rest
        }
        Some(command) if !command.is_finite() => {
            note(GateCause::NotFinite);
            rest
        }
        Some(command) => command,
    };
    if !fresh {
        note(GateCause::StaleFeedback);
        target = rest;
    }
    if input.stop {
        note(GateCause::Stop);
        target = rest;
    }
    // Both sides are scaled alike, so that a cut command bends the same way.
    let fastest_rad_s = target.magnitude_max_rad_s();
    if fastest_rad_s > limits.wheel_speed_max_rad_s {
        note(GateCause::Speed);
        let share = limits.wheel_speed_max_rad_s / fastest_rad_s;
        target.left_rad_s *= share;
        target.right_rad_s *= share;
    }
    let previous = if input.previous.is_finite() {
        input.previous
    } else {
        rest
    };
    let dt_s = if input.dt_s.is_finite() {
        input.dt_s.max(0.0)
    } else {
        0.0
    };
    // While the command stands, both sides may change at the wheels' rate, for turning back and
    // forth; on the way to rest the braking ramp holds.
    let to_rest = target == rest;
    let down = if to_rest {
        limits.wheel_braking_max_rad_s2
    } else {
        limits.wheel_acceleration_max_rad_s2
    } * dt_s;
    let up = limits.wheel_acceleration_max_rad_s2 * dt_s;
    let left_rad_s = ramp(previous.left_rad_s, target.left_rad_s, up, down);
    let right_rad_s = ramp(previous.right_rad_s, target.right_rad_s, up, down);
    if (left_rad_s - target.left_rad_s).abs() > 1.0e-9
        || (right_rad_s - target.right_rad_s).abs() > 1.0e-9
    {
        note(GateCause::Acceleration);
    }
    GateOutput {
        wheel_speeds: WheelSpeeds {
            left_rad_s,
            right_rad_s,
        },
        cause,
    }
}

/// From `previous` towards `target`: away from zero by `up` at most, towards zero by `down`; a
/// change of sign stops at zero for a tick.
fn ramp(previous: f64, target: f64, up: f64, down: f64) -> f64 {
    if previous * target < 0.0 {
        return (previous.abs() - down).max(0.0).copysign(previous);
    }
    let sign = if previous.abs() > 0.0 {
        previous
    } else {
        target
    };
    let (from, to) = (previous.abs(), target.abs());
    (from + (to - from).clamp(-down, up)).copysign(sign)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn speed() -> impl Strategy<Value = f64> {
        prop_oneof![8 => -60.0..60.0_f64, 1 => Just(f64::NAN), 1 => Just(f64::INFINITY)]
    }

    proptest! {
        #[test]
        fn the_gate_only_reduces(
            left in speed(), right in speed(), before_left in -20.0..20.0_f64,
            before_right in -20.0..20.0_f64, stop: bool, age_s in 0.0..0.4_f64,
            present: bool, dt_s in 0.001..0.05_f64,
        ) {
            let limits = GateLimits::of(&RobotModel::yi2007());
            let command = present.then_some(WheelSpeeds { left_rad_s: left, right_rad_s: right });
            let previous = WheelSpeeds { left_rad_s: before_left, right_rad_s: before_right };
            let input = GateInput { command, previous, stop, feedback_age_s: age_s, dt_s };
            let output = gate(&input, &limits);
            let wanted = command.filter(|wanted| wanted.is_finite()).unwrap_or_default();
            for (got, want, before) in [
                (output.wheel_speeds.left_rad_s, wanted.left_rad_s, before_left),
                (output.wheel_speeds.right_rad_s, wanted.right_rad_s, before_right),
            ] {
                // Never beyond both what was wanted and what the wheels already do.
                prop_assert!(got.abs() <= want.abs().max(before.abs()) + 1.0e-12);
                prop_assert!(got.abs() <= limits.wheel_speed_max_rad_s.max(before.abs()) + 1.0e-9);
                let change = (got - before).abs();
                prop_assert!(change <= limits.wheel_acceleration_max_rad_s2 * dt_s + 1.0e-9);
                if stop || !present || age_s > limits.feedback_age_max_s {
                    prop_assert!(got.abs() <= before.abs());
                    prop_assert!(change <= limits.wheel_braking_max_rad_s2 * dt_s + 1.0e-9);
                }
            }
            if stop {
                prop_assert_eq!(output.cause, Some(GateCause::Stop));
            }
        }

        #[test]
        fn silence_means_rest(
            before_left in -20.0..20.0_f64, before_right in -20.0..20.0_f64,
        ) {
            let limits = GateLimits::of(&RobotModel::yi2007());
            let mut previous = WheelSpeeds { left_rad_s: before_left, right_rad_s: before_right };
            for _ in 0..110 {
                let input = GateInput {
                    command: None, previous, stop: false, feedback_age_s: 0.0, dt_s: 0.01,
                };
                previous = gate(&input, &limits).wheel_speeds;
            }
            prop_assert!(previous.magnitude_max_rad_s() <= 0.0);
        }
    }

    #[test]
    fn a_command_within_all_limits_passes_whole() {
        let limits = GateLimits::of(&RobotModel::yi2007());
        let command = WheelSpeeds {
            left_rad_s: 5.0,
            right_rad_s: 5.2,
        };
        let input = GateInput {
            command: Some(command),
            previous: WheelSpeeds {
                left_rad_s: 4.9,
                right_rad_s: 5.1,
            },
            stop: false,
            feedback_age_s: 0.01,
            dt_s: 0.01,
        };
        assert_eq!(
            gate(&input, &limits),
            GateOutput {
                wheel_speeds: command,
                cause: None
            }
        );
    }
}
