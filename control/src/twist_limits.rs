//! Limits of a commanded twist, and one rate-limited step of a command towards a target.
//!
//! The *commanded twist* follows from the commanded wheel speeds by the kinematics of the
//! configured model: `v = r (ω_l + ω_r)/2` and `ω = r (ω_r − ω_l)/W_eff`. In each step the
//! magnitudes of v, ω and both wheel speeds grow by at most their acceleration limit times the time
//! step. The caller gives the limit of slowing down ([`Slowing`]). Motion beyond the kinematics
//! (slip, unequal rolling radii, a slope) is not limited here.

use crate::geometry::Twist;
use crate::measured::WheelSpeeds;
use crate::robot::RobotModel;

/// Maximum deceleration of a command, positive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slowing {
    /// Deceleration of v, metres per second squared.
    pub linear_m_s2: f64,
    /// Deceleration of ω, radians per second squared.
    pub angular_rad_s2: f64,
}

/// Change of a command, or of one of its speeds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Change<T> {
    /// The present command.
    pub from: T,
    /// The requested command.
    pub to: T,
}

impl<T> Change<T> {
    /// Applies a conversion to both commands.
    pub fn map<U>(self, convert: impl Fn(T) -> U) -> Change<U> {
        Change {
            from: convert(self.from),
            to: convert(self.to),
        }
    }
}

/// Speed and acceleration limits of a commanded twist and of its wheel speeds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwistLimits {
    model: RobotModel,
}

impl TwistLimits {
    /// Creates the limits of a robot model.
    pub fn of(model: &RobotModel) -> Self {
        Self { model: *model }
    }

    /// Returns the deceleration of v alone, or ω alone, at the wheels' acceleration limit.
    pub fn slowing_by_wheels(&self) -> Slowing {
        let rim_m_s2 =
            self.model.limits().wheel_acceleration_max_rad_s2 * self.model.wheel_radius_m();
        Slowing {
            linear_m_s2: rim_m_s2,
            angular_rad_s2: rim_m_s2 / (0.5 * self.model.effective_track_m()),
        }
    }

    /// Returns the factor in (0, 1] that scales a twist to within every speed limit (v, ω, wheels).
    pub fn share_within(&self, twist: Twist) -> f64 {
        let limits = self.model.limits();
        let wheels_rad_s = self
            .model
            .wheel_speeds_from_twist(twist)
            .magnitude_max_rad_s();
        let share = |value: f64, most: f64| {
            if value.abs() > most {
                most / value.abs()
            } else {
                1.0
            }
        };
        share(twist.linear_m_s, limits.linear_max_m_s)
            .min(share(twist.angular_rad_s, limits.angular_max_rad_s))
            .min(share(wheels_rad_s, limits.wheel_speed_max_rad_s))
    }

    /// Returns the command after `dt_s` seconds of a change: v and ω speed up within the
    /// acceleration limits, slow down within `slowing`, and every wheel keeps its own limits. The
    /// requested twist is not passed.
    ///
    /// Both twists must be finite and the requested one within the speed limits. If the present one is
    /// within the speed limits, the result is too.
    pub fn step(&self, change: Change<Twist>, slowing: Slowing, dt_s: f64) -> Twist {
        let limits = self.model.limits();
        let free = Twist {
            linear_m_s: Step {
                up_max: limits.linear_acceleration_max_m_s2 * dt_s,
                down_max: slowing.linear_m_s2 * dt_s,
            }
            .towards(change.map(|twist| twist.linear_m_s)),
            angular_rad_s: Step {
                up_max: self.model.angular_acceleration_max_rad_s2() * dt_s,
                down_max: slowing.angular_rad_s2 * dt_s,
            }
            .towards(change.map(|twist| twist.angular_rad_s)),
        };
        let Change { from, .. } = change;
        let wheels =
            Change { from, to: free }.map(|twist| self.model.wheel_speeds_from_twist(twist));
        let share = self.wheel_share(wheels, dt_s);
        if share >= 1.0 {
            return free;
        }
        Twist {
            linear_m_s: from.linear_m_s + share * (free.linear_m_s - from.linear_m_s),
            angular_rad_s: from.angular_rad_s + share * (free.angular_rad_s - from.angular_rad_s),
        }
    }

    /// Returns the fraction, at most 1, of a change of wheel speeds that the wheels' speed and
    /// acceleration limits allow. The speed limits are convex, so every command between two allowed
    /// ones is allowed.
    fn wheel_share(&self, wheels: Change<WheelSpeeds>, dt_s: f64) -> f64 {
        let limits = self.model.limits();
        let change_max_rad_s = limits.wheel_acceleration_max_rad_s2 * dt_s;
        let speed_max_rad_s = limits.wheel_speed_max_rad_s;
        [
            wheels.map(|wheels| wheels.left_rad_s),
            wheels.map(|wheels| wheels.right_rad_s),
        ]
        .into_iter()
        .fold(1.0, |share: f64, Change { from, to }| {
            let change = (to - from).abs();
            let room = if to.abs() > from.abs() {
                (speed_max_rad_s - from * to.signum()).max(0.0)
            } else {
                f64::INFINITY
            };
            let most = change_max_rad_s.min(room);
            if change > most {
                share.min(most / change)
            } else {
                share
            }
        })
    }
}

/// Largest change of a signed speed in one step, in the speed's unit.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Step {
    /// Largest increase of the magnitude.
    up_max: f64,
    /// Largest decrease of the magnitude.
    down_max: f64,
}

impl Step {
    /// Returns `from` moved towards `to`. A change of sign first uses `down_max` to reach zero,
    /// then the rest of the step with `up_max`.
    fn towards(self, Change { from, to }: Change<f64>) -> f64 {
        let Self { up_max, down_max } = self;
        if from * to >= 0.0 {
            let sign = if from.abs() > 0.0 { from } else { to };
            let gap = to.abs() - from.abs();
            return if (-down_max..=up_max).contains(&gap) {
                to
            } else {
                (from.abs() + gap.clamp(-down_max, up_max)).copysign(sign)
            };
        }
        if from.abs() >= down_max {
            return (from.abs() - down_max).copysign(from);
        }
        let left = 1.0 - from.abs() / down_max;
        to.abs().min(up_max * left).copysign(to)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Twists within the speed limits.
    fn twist() -> impl Strategy<Value = Twist> {
        (-1.5..1.5_f64, -3.0..3.0_f64).prop_map(|(linear_m_s, angular_rad_s)| {
            let free = Twist {
                linear_m_s,
                angular_rad_s,
            };
            let share = TwistLimits::of(&RobotModel::yi2007()).share_within(free);
            Twist {
                linear_m_s: share * linear_m_s,
                angular_rad_s: share * angular_rad_s,
            }
        })
    }

    proptest! {
        #[test]
        fn a_step_speeds_up_within_the_acceleration_limits_and_never_passes_its_target(
            from in twist(), to in twist(), dt_s in 0.0..0.2_f64,
        ) {
            let model = RobotModel::yi2007();
            let limits = TwistLimits::of(&model);
            let next = limits.step(Change { from, to }, limits.slowing_by_wheels(), dt_s);
            let linear = model.limits().linear_acceleration_max_m_s2 * dt_s;
            let angular = model.angular_acceleration_max_rad_s2() * dt_s;
            for (before, after, requested, most) in [
                (from.linear_m_s, next.linear_m_s, to.linear_m_s, linear),
                (from.angular_rad_s, next.angular_rad_s, to.angular_rad_s, angular),
            ] {
                prop_assert!(after.abs() <= before.abs() + most + 1.0e-12);
                prop_assert!(before * after >= 0.0 || after.abs() <= most + 1.0e-12);
                prop_assert!(after >= before.min(requested) - 1.0e-12);
                prop_assert!(after <= before.max(requested) + 1.0e-12);
            }
            prop_assert!(limits.share_within(next) > 1.0 - 1.0e-9);
        }

        #[test]
        fn steps_arrive_from_every_command_at_every_other(from in twist(), to in twist()) {
            let limits = TwistLimits::of(&RobotModel::yi2007());
            let mut now = from;
            for _ in 0..600 {
                now = limits.step(Change { from: now, to }, limits.slowing_by_wheels(), 0.01);
            }
            prop_assert!((now.linear_m_s - to.linear_m_s).abs() < 1.0e-9);
            prop_assert!((now.angular_rad_s - to.angular_rad_s).abs() < 1.0e-9);
        }
    }

    #[test]
    fn without_time_nothing_changes() {
        let limits = TwistLimits::of(&RobotModel::yi2007());
        let from = Twist {
            linear_m_s: 0.4,
            angular_rad_s: -0.3,
        };
        let to = Twist {
            linear_m_s: -0.4,
            angular_rad_s: 0.3,
        };
        let change = Change { from, to };
        assert_eq!(limits.step(change, limits.slowing_by_wheels(), 0.0), from);
    }
}
