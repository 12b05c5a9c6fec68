//! The robot's motion of the last second, over which late fixes are propagated.
//!
//! A fix of the age a shows where the robot was. Its pose now is that pose with the measured motion
//! since then (Larsen et al., Incorporation of time delayed measurements in a discrete-time Kalman
//! filter, 1998, method of extrapolation). The present motion alone would not do: a robot that enters a
//! turn with 1 rad/s² turns by `½a²` less in the age a.

use nalgebra::Matrix3x6;

use crate::geometry::{Pose, wrap_angle_rad};

/// Maximum number of steps; with [`STEP_MIN_S`] they last longer than the maximum age of a fix.
const STEPS: usize = 128;
/// Minimum duration of a step, seconds: shorter periods of the loop are taken together.
const STEP_MIN_S: f64 = 0.008;

/// Measured motion in one step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Step {
    /// Duration, seconds.
    pub(super) time_s: f64,
    /// Turn, radians, and distance by the wheels, metres.
    pub(super) turn_rad: f64,
    pub(super) forward_m: f64,
}

impl Step {
    fn add(&mut self, other: &Self) {
        self.time_s += other.time_s;
        self.turn_rad += other.turn_rad;
        self.forward_m += other.forward_m;
    }

    /// Returns the last `time_s` seconds of this step, at constant rates.
    fn last(&self, time_s: f64) -> Self {
        let share = time_s / self.time_s;
        Self {
            time_s,
            turn_rad: share * self.turn_rad,
            forward_m: share * self.forward_m,
        }
    }
}

/// Errors of the measured motion: speeds that the wheels do not show, metres per second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Unmeasured {
    pub(super) forward_m_s: f64,
    pub(super) left_m_s: f64,
}

/// A fix propagated to the present.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Propagated {
    pub(super) pose: Pose,
    /// Derivatives of the measurement (x, y, φ) by the state of the filter: errors of the unmeasured speeds
    /// and of the gyro's bias move the pose of a late fix.
    pub(super) observe: Matrix3x6<f64>,
}

/// Measured motion of the last second; a ring of steps.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PastMotion {
    steps: [Step; STEPS],
    newest: usize,
}

impl PastMotion {
    /// Creates a history of no motion.
    pub(super) fn new() -> Self {
        Self {
            steps: [Step::default(); STEPS],
            newest: 0,
        }
    }

    /// Adds the motion of one period.
    pub(super) fn add(&mut self, step: &Step) {
        if self.steps[self.newest].time_s >= STEP_MIN_S {
            self.newest = (self.newest + 1) % STEPS;
            self.steps[self.newest] = Step::default();
        }
        self.steps[self.newest].add(step);
    }

    /// Returns the steps of the last `age_s` seconds, from the oldest on; where they are shorter, `rates`,
    /// the motion of one second, fills the time before.
    fn steps(&self, age_s: f64, rates: &Step) -> impl Iterator<Item = Step> + '_ {
        let mut left_s = age_s;
        let mut count = 0;
        while count < STEPS && left_s > 0.0 {
            left_s -= self.back(count).time_s;
            count += 1;
        }
        let before = (left_s > 0.0).then(|| rates.last(left_s));
        let past = (0..count).rev().map(move |back| {
            let step = self.back(back);
            // The oldest one counts as far as it is not older than the fix.
            if back + 1 == count && left_s < 0.0 {
                step.last(step.time_s + left_s)
            } else {
                *step
            }
        });
        before.into_iter().chain(past)
    }

    /// Returns the step so many before the newest one.
    fn back(&self, count: usize) -> &Step {
        &self.steps[(self.newest + STEPS - count) % STEPS]
    }

    /// Propagates the pose of a fix, `age_s` seconds old, to the present.
    pub(super) fn propagate(
        &self,
        pose: Pose,
        age_s: f64,
        unmeasured: Unmeasured,
        rates: &Step,
    ) -> Propagated {
        let (mut x_m, mut y_m, mut heading_rad) = (pose.x_m, pose.y_m, pose.heading_rad);
        let mut observe = Matrix3x6::identity();
        for step in self.steps(age_s, rates) {
            let (sin, cos) = (heading_rad + 0.5 * step.turn_rad).sin_cos();
            let forward_m = step.forward_m + unmeasured.forward_m_s * step.time_s;
            let left_m = unmeasured.left_m_s * step.time_s;
            x_m += forward_m * cos - left_m * sin;
            y_m += forward_m * sin + left_m * cos;
            heading_rad += step.turn_rad;
            observe[(0, 3)] -= step.time_s * cos;
            observe[(1, 3)] -= step.time_s * sin;
            observe[(0, 4)] += step.time_s * sin;
            observe[(1, 4)] -= step.time_s * cos;
            observe[(2, 5)] += step.time_s;
        }
        Propagated {
            pose: Pose {
                x_m,
                y_m,
                heading_rad: wrap_angle_rad(heading_rad),
            },
            observe,
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const STRAIGHT: Unmeasured = Unmeasured {
        forward_m_s: 0.0,
        left_m_s: 0.0,
    };

    /// Motion of one period with these rates.
    fn step(time_s: f64, turn_rad_s: f64, forward_m_s: f64) -> Step {
        Step {
            time_s,
            turn_rad: turn_rad_s * time_s,
            forward_m: forward_m_s * time_s,
        }
    }

    #[test]
    fn a_fix_from_before_a_turn_is_propagated_by_the_motion_of_then() {
        let mut past = PastMotion::new();
        for _ in 0..50 {
            past.add(&step(0.01, 0.0, 1.0));
        }
        for _ in 0..10 {
            past.add(&step(0.01, 1.0, 1.0));
        }
        let rates = step(1.0, 1.0, 1.0);
        let now = past.propagate(Pose::default(), 0.3, STRAIGHT, &rates).pose;
        // 0.2 m straight on, and 0.1 m on a circle of 1 m.
        let expected = Pose {
            x_m: 0.2 + 0.1_f64.sin(),
            y_m: 1.0 - 0.1_f64.cos(),
            heading_rad: 0.1,
        };
        assert!((now.x_m - expected.x_m).abs() < 1.0e-5, "{now:?}");
        assert!((now.y_m - expected.y_m).abs() < 1.0e-5, "{now:?}");
        assert!(
            (now.heading_rad - expected.heading_rad).abs() < 1.0e-12,
            "{now:?}"
        );
    }

    #[test]
    fn a_fast_loop_keeps_a_second_of_motion() {
        let mut past = PastMotion::new();
        for _ in 0..3_000 {
            past.add(&step(0.001, 0.0, 1.0));
        }
        let standing = Step::default();
        let now = past
            .propagate(Pose::default(), 1.0, STRAIGHT, &standing)
            .pose;
        assert!((now.x_m - 1.0).abs() < 1.0e-9, "{now:?}");
    }

    #[test]
    fn time_before_the_first_step_has_the_present_motion() {
        let mut past = PastMotion::new();
        past.add(&step(0.1, 0.0, 1.0));
        let now = past.propagate(Pose::default(), 0.5, STRAIGHT, &step(1.0, 0.0, 2.0));
        assert!((now.pose.x_m - 0.9).abs() < 1.0e-12, "{now:?}");
    }

    proptest! {
        #[test]
        fn a_propagated_fix_depends_on_unmeasured_speeds_as_stated(
            rates in prop::collection::vec((-2.0..2.0_f64, -1.0..1.0_f64), 1..40), age_s in 0.0..0.4,
            forward_m_s in -0.1..0.1, left_m_s in -0.1..0.1,
        ) {
            let mut past = PastMotion::new();
            for (turn_rad_s, forward_m_s) in rates {
                past.add(&step(0.01, turn_rad_s, forward_m_s));
            }
            let standing = Step { time_s: 1.0, ..Step::default() };
            let of = |unmeasured| past.propagate(Pose::default(), age_s, unmeasured, &standing);
            let none = of(STRAIGHT);
            let some = of(Unmeasured { forward_m_s, left_m_s });
            let by = |row: usize| {
                none.observe[(row, 3)] * forward_m_s + none.observe[(row, 4)] * left_m_s
            };
            // More speed since the fix moves its propagated pose ahead, and the measurement back.
            prop_assert!((none.pose.x_m - some.pose.x_m - by(0)).abs() < 1.0e-12);
            prop_assert!((none.pose.y_m - some.pose.y_m - by(1)).abs() < 1.0e-12);
            prop_assert!((none.observe[(2, 5)] - age_s).abs() < 1.0e-12);
        }
    }
}
