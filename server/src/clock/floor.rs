//! Derives a non-decreasing wall time from a wall clock that may step back and a monotonic clock.
//! Pure.

use std::time::Duration;

/// Maximum step back of the machine's clock that is bridged by slowing down; a larger one is
/// followed at once.
pub const STEP_BACK_HELD_MAX: Duration = Duration::from_hours(24);
/// Minimum size of a step that is logged and counted.
pub const STEP_NOTED_MIN: Duration = Duration::from_millis(500);
/// Factor by which the returned time advances more slowly while the machine's clock is behind it.
const HELD_PACE: u128 = 2;

/// Step of the machine's clock; `by_us` is its size in microseconds, positive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    /// Step back; the returned time slows down until the machine's clock has caught up.
    BackHeld { by_us: i64 },
    /// Step back by more than [`STEP_BACK_HELD_MAX`]; the returned time follows it.
    BackFollowed { by_us: i64 },
    /// Step forward: wall time advanced by more than monotonic time.
    Forward { by_us: i64 },
    /// The machine's clock has reached the returned time again.
    CaughtUp,
    /// The newest time in the database is ahead by more than [`STEP_BACK_HELD_MAX`].
    DatabaseAhead { by_us: i64 },
}

/// Steps of the machine's clock since the start of the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ClockSteps {
    /// Number of steps back.
    pub back: u64,
    /// Number of steps forward.
    pub forward: u64,
    /// Lead of the server's time over the machine's clock at the last reading.
    pub ahead: Duration,
}

/// Simultaneous readings of wall clock (microseconds since 1970) and monotonic clock.
#[derive(Debug, Clone, Copy)]
pub(super) struct Mark {
    pub(super) wall_us: i64,
    pub(super) elapsed: Duration,
}

/// State of the non-decreasing wall time.
#[derive(Debug, Default)]
pub(super) struct Floor {
    last_issued_us: Option<i64>,
    /// Last reading of the machine's clocks.
    machine: Option<Mark>,
    /// Start of the slowed-down phase, in returned time; `None` if the machine's clock is not
    /// behind.
    held_from: Option<Mark>,
    /// Whether the step back of the current slowed-down phase was logged.
    is_noted: bool,
    steps: ClockSteps,
}

fn micros(span: Duration) -> i64 {
    i64::try_from(span.as_micros()).unwrap_or(i64::MAX)
}

impl Floor {
    /// Returns the time to use, in microseconds since 1970, for a reading of the machine's clocks,
    /// and the step to log, if any. Steps forward are detected only if `has_one_pace`, that is, if
    /// both clocks advance at the same rate.
    pub(super) fn issue(
        &mut self,
        wall_us: i64,
        elapsed: Duration,
        has_one_pace: bool,
    ) -> (i64, Option<Step>) {
        let before = self.machine.replace(Mark { wall_us, elapsed });
        let stepped_us = before.map_or(0, |before| {
            let expected_us = if has_one_pace {
                micros(elapsed.saturating_sub(before.elapsed))
            } else {
                0
            };
            wall_us
                .saturating_sub(before.wall_us)
                .saturating_sub(expected_us)
        });
        let noted_us = micros(STEP_NOTED_MIN);
        let mut step = None;
        if has_one_pace && stepped_us >= noted_us {
            self.steps.forward += 1;
            step = Some(Step::Forward { by_us: stepped_us });
        } else if stepped_us <= -noted_us {
            self.steps.back += 1;
        }
        let last_us = self.last_issued_us.unwrap_or(wall_us);
        let behind_us = last_us.saturating_sub(wall_us);
        if behind_us > micros(STEP_BACK_HELD_MAX) {
            (self.held_from, self.is_noted) = (None, false);
            self.last_issued_us = Some(wall_us);
            self.steps.ahead = Duration::ZERO;
            return (wall_us, Some(Step::BackFollowed { by_us: behind_us }));
        }
        if behind_us <= 0 {
            let was_noted = std::mem::take(&mut self.is_noted);
            self.held_from = None;
            self.last_issued_us = Some(wall_us);
            self.steps.ahead = Duration::ZERO;
            return (wall_us, step.or(was_noted.then_some(Step::CaughtUp)));
        }
        let from = *self.held_from.get_or_insert(Mark {
            wall_us: last_us,
            elapsed,
        });
        if !self.is_noted && behind_us >= noted_us {
            self.is_noted = true;
            step = Some(Step::BackHeld { by_us: behind_us });
        }
        let passed_us = elapsed.saturating_sub(from.elapsed).as_micros() / HELD_PACE;
        let passed_us = i64::try_from(passed_us).unwrap_or(i64::MAX);
        let issued_us = from.wall_us.saturating_add(passed_us).max(last_us);
        self.last_issued_us = Some(issued_us);
        let ahead_us = u64::try_from(issued_us - wall_us).unwrap_or(0);
        self.steps.ahead = Duration::from_micros(ahead_us);
        (issued_us, step)
    }

    /// Continues after the newest time of an earlier run, unless the machine's clock is more than
    /// [`STEP_BACK_HELD_MAX`] behind it. Returns the step to log, if any.
    pub(super) fn continue_after(&mut self, newest_us: i64, machine: Mark) -> Option<Step> {
        let Mark { wall_us, elapsed } = machine;
        let ahead_us = newest_us.saturating_sub(wall_us);
        if ahead_us > micros(STEP_BACK_HELD_MAX) {
            return Some(Step::DatabaseAhead { by_us: ahead_us });
        }
        let last_us = self.last_issued_us.unwrap_or(newest_us);
        self.last_issued_us = Some(last_us.max(newest_us));
        (ahead_us > 0).then(|| self.issue(wall_us, elapsed, false).1)?
    }

    /// Returns the steps that were detected so far.
    pub(super) fn steps(&self) -> ClockSteps {
        self.steps
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SECOND_US: i64 = 1_000_000;

    fn after(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn a_step_back_is_held_at_half_the_pace_until_the_clock_has_caught_up() {
        let mut floor = Floor::default();
        let begin_us = 1_000 * SECOND_US;
        assert_eq!(floor.issue(begin_us, after(0), true), (begin_us, None));
        // A step back of 60 s is caught up after 120 s at half the rate.
        let held = |passed: u64| begin_us + i64::try_from(passed).unwrap() * SECOND_US / 2;
        let machine = |passed: u64| begin_us + (i64::try_from(passed).unwrap() - 60) * SECOND_US;
        let by_us = 60 * SECOND_US;
        let first = floor.issue(machine(0), after(0), true);
        assert_eq!(first, (held(0), Some(Step::BackHeld { by_us })));
        for passed in 1..119 {
            let issued = floor.issue(machine(passed), after(passed), true);
            assert_eq!(issued, (held(passed), None), "{passed} s after the step");
        }
        assert_eq!(floor.steps().back, 1);
        let caught_up = floor.issue(machine(119), after(119), true);
        assert_eq!(caught_up, (machine(119), Some(Step::CaughtUp)));
        assert_eq!(floor.steps().ahead, Duration::ZERO);
        let on = floor.issue(machine(120), after(120), true);
        assert_eq!(on, (machine(120), None));
    }

    #[test]
    fn a_step_beyond_the_bound_is_followed_and_said() {
        let mut floor = Floor::default();
        let begin_us = 400_000 * SECOND_US;
        floor.issue(begin_us, after(0), true);
        let back_us = micros(STEP_BACK_HELD_MAX) + SECOND_US;
        let (issued_us, step) = floor.issue(begin_us - back_us, after(0), true);
        assert_eq!(issued_us, begin_us - back_us);
        assert_eq!(step, Some(Step::BackFollowed { by_us: back_us }));
        let machine = Mark {
            wall_us: begin_us - back_us,
            elapsed: after(0),
        };
        let ahead = floor.continue_after(begin_us, machine);
        assert_eq!(ahead, Some(Step::DatabaseAhead { by_us: back_us }));
    }

    #[test]
    fn a_step_forward_is_followed_at_once_and_said_once() {
        let mut floor = Floor::default();
        floor.issue(0, after(0), true);
        let by_us = 100 * SECOND_US;
        let (issued_us, step) = floor.issue(by_us + SECOND_US, after(1), true);
        assert_eq!(
            (issued_us, step),
            (by_us + SECOND_US, Some(Step::Forward { by_us }))
        );
        assert_eq!(floor.issue(by_us + 2 * SECOND_US, after(2), true).1, None);
        assert_eq!(floor.steps().forward, 1);
    }

    #[test]
    fn a_run_takes_up_after_the_newest_time_of_the_database() {
        let mut floor = Floor::default();
        let newest_us = 5_000 * SECOND_US;
        let machine = Mark {
            wall_us: newest_us - 10 * SECOND_US,
            elapsed: after(0),
        };
        let said = floor.continue_after(newest_us, machine);
        assert_eq!(
            said,
            Some(Step::BackHeld {
                by_us: 10 * SECOND_US
            })
        );
        let (issued_us, _) = floor.issue(newest_us - 8 * SECOND_US, after(2), true);
        assert_eq!(issued_us, newest_us + SECOND_US);
    }

    proptest! {
        #[test]
        fn whatever_the_machines_clock_does_within_the_bound_time_never_goes_back(
            steps in prop::collection::vec((-40_000_000_000_i64..40_000_000_000, 0_u64..10_000), 1..60),
        ) {
            let mut floor = Floor::default();
            let (mut wall_us, mut elapsed) = (2_000_000_000_000_000_i64, Duration::ZERO);
            let mut last_us = i64::MIN;
            for (step_us, passed_ms) in steps {
                let passed = Duration::from_millis(passed_ms);
                elapsed += passed;
                wall_us += step_us + micros(passed);
                let (issued_us, step) = floor.issue(wall_us, elapsed, true);
                if matches!(step, Some(Step::BackFollowed { .. })) {
                    prop_assert!(last_us - wall_us > micros(STEP_BACK_HELD_MAX));
                } else {
                    prop_assert!(issued_us >= last_us);
                }
                prop_assert!(issued_us >= wall_us);
                last_us = issued_us;
            }
        }
    }
}
