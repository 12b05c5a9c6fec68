//! Teleoperation commands before the gate: limited to the robot's speeds and accelerations.
//!
//! Late commands slow the robot down: above an age of [`AGE_FULL_S`] the allowed fraction of speed
//! falls linearly to [`RATIO_MIN`] at [`AGE_LEAST_S`]. [`AgeMeter`] keeps the worst recent age,
//! so that one quick command does not make up for many late ones.
//!
//! In the last [`STEADY_BEFORE_END_S`] of a command the robot gains no more speed, and wheels that
//! run faster than the robot by slip are slowed to its speed. If the driver falls silent, the robot
//! brakes from the speed that it had when the command ended.

use super::SLIP_LEAST_M_S;
use crate::geometry::Twist;
use crate::robot::RobotModel;
use crate::twist_limits::{Change, Slowing, TwistLimits};

/// Age of commands up to which the full speed is allowed, seconds.
pub const AGE_FULL_S: f64 = 0.15;
/// Age of commands from which only [`RATIO_MIN`] is allowed, seconds.
pub const AGE_LEAST_S: f64 = 0.5;
/// Minimum fraction of the speed that late commands allow.
pub const RATIO_MIN: f64 = 0.2;
/// Maximum speed of teleoperating a robot without a position, metres per second.
pub const BLIND_MAX_M_S: f64 = 0.3;
/// Time before the end of a command in which it no longer accelerates the robot, seconds: twice the
/// lag of a wheel servo, so that robot and wheels have the same speed when it ends.
pub const STEADY_BEFORE_END_S: f64 = 0.1;
/// Fraction of the difference to the worst age by which each command of a smaller age lowers it.
const FORGOTTEN_SHARE: f64 = 0.05;

/// Worst recent age of commands: rises at once, decays with each command of a smaller age.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct AgeMeter {
    worst_s: Option<f64>,
}

impl AgeMeter {
    /// Adds the age of one command, seconds: a larger age replaces the worst one, a smaller one
    /// lowers it by [`FORGOTTEN_SHARE`] of the difference. A negative age counts as 0.
    pub fn record(&mut self, age_s: f64) {
        // A non-finite age counts as [`AGE_LEAST_S`].
        let age_s = if age_s.is_finite() {
            age_s.max(0.0)
        } else {
            AGE_LEAST_S
        };
        self.worst_s = Some(match self.worst_s {
            Some(worst_s) if worst_s > age_s => worst_s + FORGOTTEN_SHARE * (age_s - worst_s),
            Some(_) | None => age_s,
        });
    }

    /// Returns the worst recent age, seconds; None before the first command.
    pub fn worst_s(&self) -> Option<f64> {
        self.worst_s
    }

    /// Returns the allowed fraction of the speed, [`RATIO_MIN`] to 1; 1 before the first command.
    pub fn speed_ratio(&self) -> f64 {
        self.worst_s.map_or(1.0, speed_ratio)
    }
}

/// Returns the fraction of the speed allowed for an age of commands, [`RATIO_MIN`] to 1.
pub fn speed_ratio(age_s: f64) -> f64 {
    if !age_s.is_finite() {
        return RATIO_MIN;
    }
    let late = ((age_s - AGE_FULL_S) / (AGE_LEAST_S - AGE_FULL_S)).clamp(0.0, 1.0);
    (1.0 - late * (1.0 - RATIO_MIN)).max(RATIO_MIN)
}

/// Scales a twist down to the robot's limits of forward speed, turn rate, lateral acceleration and
/// wheel speed, keeping its curvature. Returns it, and whether it exceeded a limit. A twist that is
/// not finite becomes zero and counts as exceeding one.
pub fn within_limits(twist: Twist, model: &RobotModel) -> (Twist, bool) {
    if !twist.is_finite() {
        return (Twist::default(), true);
    }
    let limits = model.limits();
    let over = |value: f64, most: f64| {
        if value.abs() > most {
            value.abs() / most
        } else {
            1.0
        }
    };
    let mut over_ratio = over(twist.linear_m_s, limits.linear_max_m_s)
        .max(over(twist.angular_rad_s, limits.angular_max_rad_s));
    // Lateral acceleration v·ω scales with the square of the factor.
    let lateral_m_s2 = twist.linear_m_s * twist.angular_rad_s;
    over_ratio = over_ratio.max(over(lateral_m_s2, limits.lateral_acceleration_max_m_s2).sqrt());
    let wheels = model.wheel_speeds_from_twist(twist).magnitude_max_rad_s();
    over_ratio = over_ratio.max(over(wheels, limits.wheel_speed_max_rad_s));
    let within = Twist {
        linear_m_s: twist.linear_m_s / over_ratio,
        angular_rad_s: twist.angular_rad_s / over_ratio,
    };
    (within, over_ratio > 1.0)
}

/// Returns the twist one tick of `dt_s` seconds after `change.from` on the way to `change.to`,
/// within the robot's acceleration limits; decelerations may be twice as large.
pub fn approach(change: Change<Twist>, model: &RobotModel, dt_s: f64) -> Twist {
    let dt_s = if dt_s.is_finite() { dt_s.max(0.0) } else { 0.0 };
    let slowing = Slowing {
        linear_m_s2: 2.0 * model.limits().linear_acceleration_max_m_s2,
        angular_rad_s2: 2.0 * model.angular_acceleration_max_rad_s2(),
    };
    TwistLimits::of(model).step(change, slowing, dt_s)
}

/// Returns `change.to` with each component limited to the magnitude of that of `change.from`; 0
/// where the signs differ.
///
/// Used near the end of a command: a robot that still gains speed when its driver falls silent
/// would otherwise continue to accelerate.
pub fn no_faster(change: Change<Twist>) -> Twist {
    let least = |Change { from, to }: Change<f64>| {
        if from * to > 0.0 {
            to.abs().min(from.abs()).copysign(to)
        } else {
            0.0
        }
    };
    Twist {
        linear_m_s: least(change.map(|twist| twist.linear_m_s)),
        angular_rad_s: least(change.map(|twist| twist.angular_rad_s)),
    }
}

/// Scales a twist down to the measured forward speed, keeping its curvature: wheels that slip to
/// gain speed are slowed to the robot's speed.
pub fn no_faster_than_real(twist: Twist, real_m_s: f64) -> Twist {
    if twist.linear_m_s.abs() < SLIP_LEAST_M_S || !real_m_s.is_finite() {
        return twist;
    }
    let share = (real_m_s / twist.linear_m_s).clamp(0.0, 1.0);
    Twist {
        linear_m_s: share * twist.linear_m_s,
        angular_rad_s: share * twist.angular_rad_s,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_twist_is_only_reduced_and_bends_the_same_way(
            linear_m_s in -9.0..9.0_f64, angular_rad_s in -9.0..9.0_f64,
        ) {
            let model = RobotModel::yi2007();
            let asked = Twist { linear_m_s, angular_rad_s };
            let (within, was_over) = within_limits(asked, &model);
            prop_assert_eq!(was_over, within != asked);
            prop_assert!(within.linear_m_s.abs() <= asked.linear_m_s.abs().min(1.0) + 1.0e-12);
            prop_assert!(within.angular_rad_s.abs() <= asked.angular_rad_s.abs().min(2.0) + 1.0e-12);
            let lateral_m_s2 = (within.linear_m_s * within.angular_rad_s).abs();
            prop_assert!(lateral_m_s2 <= 1.0 + 1.0e-9);
            let cross = within.linear_m_s * angular_rad_s - within.angular_rad_s * linear_m_s;
            prop_assert!(cross.abs() < 1.0e-9);
        }

        #[test]
        fn an_older_command_never_allows_more(age_s in 0.0..2.0_f64, more_s in 0.0..1.0_f64) {
            prop_assert!(speed_ratio(age_s + more_s) <= speed_ratio(age_s));
            prop_assert!((RATIO_MIN..=1.0).contains(&speed_ratio(age_s)));
        }

        #[test]
        fn the_ramp_reaches_its_target_and_never_passes_it(
            from in -1.0..1.0_f64, to in -1.0..1.0_f64,
        ) {
            let model = RobotModel::yi2007();
            let target = Twist { linear_m_s: to, angular_rad_s: -to };
            let mut now = Twist { linear_m_s: from, angular_rad_s: from };
            for _ in 0..300 {
                let next = approach(Change { from: now, to: target }, &model, 0.01);
                let (low, high) = (now.linear_m_s.min(to), now.linear_m_s.max(to));
                prop_assert!((low - 1.0e-12..=high + 1.0e-12).contains(&next.linear_m_s));
                now = next;
            }
            prop_assert!((now.linear_m_s - to).abs() < 1.0e-9);
            prop_assert!((now.angular_rad_s + to).abs() < 1.0e-9);
        }
    }

    proptest! {
        #[test]
        fn near_the_end_of_a_command_nothing_gets_faster_or_turns_back(
            linear_m_s in -1.0..1.0_f64, angular_rad_s in -2.0..2.0_f64,
            wanted_m_s in -1.0..1.0_f64, wanted_rad_s in -2.0..2.0_f64,
            real_m_s in -1.0..1.0_f64,
        ) {
            let from = Twist { linear_m_s, angular_rad_s };
            let to = Twist { linear_m_s: wanted_m_s, angular_rad_s: wanted_rad_s };
            let steady = no_faster(Change { from, to });
            prop_assert!(steady.linear_m_s.abs() <= linear_m_s.abs().min(wanted_m_s.abs()));
            prop_assert!(steady.angular_rad_s.abs() <= angular_rad_s.abs().min(wanted_rad_s.abs()));
            prop_assert!(steady.linear_m_s * linear_m_s >= 0.0);
            let beside = no_faster_than_real(steady, real_m_s);
            prop_assert!(beside.linear_m_s.abs() <= steady.linear_m_s.abs());
            prop_assert!(beside.linear_m_s.abs() <= real_m_s.abs().max(SLIP_LEAST_M_S) + 1.0e-12);
            let cross = beside.linear_m_s * steady.angular_rad_s
                - beside.angular_rad_s * steady.linear_m_s;
            prop_assert!(cross.abs() < 1.0e-9);
            prop_assert_eq!(no_faster_than_real(steady, f64::NAN), steady);
        }
    }

    #[test]
    fn one_quick_command_does_not_make_up_for_late_ones() {
        let mut meter = AgeMeter::default();
        assert!((meter.speed_ratio() - 1.0).abs() < 1.0e-12);
        meter.record(0.5);
        assert!((meter.speed_ratio() - RATIO_MIN).abs() < 1.0e-12);
        meter.record(0.01);
        assert!(meter.speed_ratio() < 0.3);
        for _ in 0..100 {
            meter.record(0.01);
        }
        assert!((meter.speed_ratio() - 1.0).abs() < 1.0e-12);
        meter.record(f64::NAN);
        assert!(meter.speed_ratio() < 0.3, "no number is a bad age");
    }

    #[test]
    fn what_is_no_number_is_rest() {
        let model = RobotModel::yi2007();
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let twist = Twist {
                linear_m_s: bad,
                angular_rad_s: 0.1,
            };
            assert_eq!(within_limits(twist, &model), (Twist::default(), true));
        }
    }
}
