//! Detects that a robot makes no progress along its path, whatever its reference does.
//!
//! The robot's measured position is projected on the path. Progress counts from the largest arc
//! length that has counted before, in gains larger than noise: a reference that creeps on, a robot
//! that moves to and fro, and gains too small to count do not reset the time without progress. A
//! robot that is only allowed to drive slowly needs a smaller gain. Time in which it must not drive
//! is left out of the sum.
//!
//! A robot without progress whose feedback commands more speed than the plan drives blindly, or its
//! wheels dig in. The distance commanded beyond the plan bounds this case, sooner than the time
//! does.

/// Bounds beyond which a robot counts as stuck.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProgressBounds {
    /// Maximum time without progress in which the robot may drive, seconds.
    pub time_max_s: f64,
    /// Gain of arc length that counts as progress, metres.
    pub gain_m: f64,
    /// Maximum distance commanded beyond the plan without progress, metres.
    pub beyond_plan_max_m: f64,
}

/// Fraction of the allowed distance that counts as progress once the time is over, where it is less
/// than [`ProgressBounds::gain_m`].
const GAIN_SHARE: f64 = 0.25;
/// Allowed speed below which the robot must not drive, metres per second.
const ALLOWED_MIN_M_S: f64 = 1.0e-3;

/// Input of the monitor in one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ProgressTick {
    /// Arc length of the robot's measured position projected on its path, metres.
    pub(crate) robot_m: f64,
    /// Speed that plan, rate cap and speed limit allow a robot without lag, metres per second.
    pub(crate) allowed_m_s: f64,
    /// Commanded forward speed, metres per second.
    pub(crate) commanded_m_s: f64,
    /// Speed of the reference, metres per second.
    pub(crate) reference_m_s: f64,
    /// Time since the previous tick, seconds.
    pub(crate) dt_s: f64,
}

/// Progress monitor of one mission.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct ProgressMonitor {
    /// Largest arc length that has counted as progress, metres; None before the first tick.
    best_m: Option<f64>,
    /// Time since then in which the robot was allowed to drive, seconds.
    idle_s: f64,
    /// Distance that the robot was allowed to drive since then, metres.
    allowed_m: f64,
    /// Distance commanded beyond the plan since then, metres.
    beyond_plan_m: f64,
}

impl ProgressMonitor {
    /// Updates the monitor with one tick; returns true once the robot is stuck.
    pub(crate) fn step(&mut self, tick: &ProgressTick, bounds: &ProgressBounds) -> bool {
        let best_m = *self.best_m.get_or_insert(tick.robot_m);
        if tick.allowed_m_s >= ALLOWED_MIN_M_S {
            self.idle_s += tick.dt_s;
            self.allowed_m += tick.allowed_m_s * tick.dt_s;
            let beyond_m_s = tick.commanded_m_s - tick.reference_m_s;
            self.beyond_plan_m += beyond_m_s.max(0.0) * tick.dt_s;
        }
        let gained_m = tick.robot_m - best_m;
        let is_over = self.idle_s > bounds.time_max_s;
        // The smaller gain applies only once the time is over: a fraction of a short distance is no
        // progress.
        let needed_m = if is_over {
            bounds.gain_m.min(GAIN_SHARE * self.allowed_m)
        } else {
            bounds.gain_m
        };
        if gained_m >= needed_m {
            *self = Self {
                best_m: Some(tick.robot_m),
                ..Self::default()
            };
            return false;
        }
        is_over || self.beyond_plan_m > bounds.beyond_plan_max_m
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::follower::FollowerConfig;

    const DT_S: f64 = 0.02;

    fn bounds() -> ProgressBounds {
        FollowerConfig::default().progress
    }

    fn tick(robot_m: f64, allowed_m_s: f64) -> ProgressTick {
        ProgressTick {
            robot_m,
            allowed_m_s,
            commanded_m_s: allowed_m_s,
            reference_m_s: allowed_m_s,
            dt_s: DT_S,
        }
    }

    proptest! {
        #[test]
        fn noise_swings_pauses_and_small_gains_do_not_put_off_the_end(
            places in prop::collection::vec(-0.14..0.14_f64, 1..50),
            pauses in prop::collection::vec(any::<bool>(), 1..50),
        ) {
            let mut monitor = ProgressMonitor::default();
            let mut driving_s = 0.0;
            for index in 0..10_000 {
                let may_drive = pauses[index / 20 % pauses.len()] || index % 20 == 0;
                let allowed_m_s = if may_drive { 0.6 } else { 0.0 };
                driving_s += if may_drive { DT_S } else { 0.0 };
                let is_stuck =
                    monitor.step(&tick(places[index % places.len()], allowed_m_s), &bounds());
                prop_assert!(!is_stuck || driving_s > 19.9);
                if is_stuck {
                    return Ok(());
                }
                prop_assert!(driving_s < 20.1, "still active after {} s", driving_s);
            }
        }

        #[test]
        fn a_robot_that_drives_half_as_fast_as_it_may_is_never_stuck(
            allowed_m_s in 0.002..2.0_f64, share in 0.5..1.0_f64,
        ) {
            let (mut monitor, mut robot_m) = (ProgressMonitor::default(), 0.0);
            for _ in 0..5_000 {
                robot_m += share * allowed_m_s * DT_S;
                prop_assert!(!monitor.step(&tick(robot_m, allowed_m_s), &bounds()));
            }
        }
    }

    #[test]
    fn a_distance_commanded_beyond_the_plan_without_progress_ends_sooner() {
        let mut monitor = ProgressMonitor::default();
        let mut time_s = 0.0;
        let blind = ProgressTick {
            commanded_m_s: 0.5,
            reference_m_s: 0.0,
            ..tick(0.0, 0.6)
        };
        while !monitor.step(&blind, &bounds()) {
            time_s += DT_S;
            assert!(time_s < 11.0);
        }
        assert!(time_s > 9.0, "{time_s} s");
    }
}
