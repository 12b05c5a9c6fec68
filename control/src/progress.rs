//! Whether a mission makes progress: the robot itself, not its reference.
//!
//! The robot's place is its measured position projected on the path. Progress counts from the
//! farthest place that has counted before, in gains that noise does not give: neither a reference
//! that creeps on, nor a robot that moves to and fro, nor many gains too small to count end the
//! time without progress. A robot that may drive slowly needs a smaller gain. Time in which it must
//! not drive does not count, and does not make up for what counted before.
//!
//! A robot that makes no progress and whose feedback drives it faster than its plan all the while
//! drives blindly, or digs: that is bounded by the way commanded, sooner than by the time.

/// Bounds of what counts as no progress.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProgressBounds {
    /// Longest time without progress in which the robot may drive, seconds.
    pub time_max_s: f64,
    /// Gain along the path that counts as progress, metres.
    pub gain_m: f64,
    /// Longest distance commanded beyond the plan without progress, metres.
    pub beyond_plan_max_m: f64,
}

/// Share of the distance that the robot may drive that counts as progress, where it is less than
/// the gain.
const GAIN_SHARE: f64 = 0.25;
/// Speed below which a robot is not to drive, metres per second.
const ALLOWED_MIN_M_S: f64 = 1.0e-3;

/// What is known in one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ProgressTick {
    /// Arc length of the robot's measured position projected on its path, metres.
    pub(crate) robot_m: f64,
    /// Speed that plan, pace and speed limits allow, were the robot at its reference, metres per
    /// second.
    pub(crate) allowed_m_s: f64,
    /// Speed ahead that is commanded, metres per second.
    pub(crate) commanded_m_s: f64,
    /// Speed of the reference, metres per second.
    pub(crate) reference_m_s: f64,
    /// Time since the tick before, seconds.
    pub(crate) dt_s: f64,
}

/// Watches one mission.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct ProgressMonitor {
    /// Farthest place that has counted, metres; none before the first tick.
    best_m: Option<f64>,
    /// Time in which the robot might have driven since, seconds.
    idle_s: f64,
    /// Distance that it might have driven in that time, metres.
    allowed_m: f64,
    /// Distance commanded beyond the plan in that time, metres.
    beyond_plan_m: f64,
}

impl ProgressMonitor {
    /// One tick; true once the robot has made no progress for too long.
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
        // A slow robot is looked at when its time is over: a share of a short distance is no
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
