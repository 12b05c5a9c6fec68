//! Detects a loop that does not keep its rate; the robot is then held. Pure.
//!
//! ```text
//!           overload: a tick far too late, several late ones in a row, or many of the newest
//! on time ────────────────────────────────────────────────────────────────────────────────► held
//!    ▲                                                                                        │
//!    └── for RELEASE_AFTER no overload, and at most LATE_ISOLATED_MAX late ticks ─────────────┘
//! ```
//! One or two isolated late ticks per second neither begin nor prolong a hold.
//!
//! Every bound on the robot's reaction time (to a silent driver, a stop, a fence) assumes that
//! ticks are on time, so the robot does not drive while they are not. Lateness is computed from the
//! times of the ticks alone, so a replayed record gives the same result.

use std::time::Duration;

/// Excess of the interval between two ticks over the period from which the tick counts as late.
pub(crate) const LATE_AFTER: Duration = Duration::from_millis(40);
/// Excess of the interval between two ticks over the period from which one tick holds the robot.
pub(crate) const LATE_MAX: Duration = Duration::from_millis(120);
/// Number of consecutive late ticks that holds the robot.
pub(crate) const LATE_IN_A_ROW_MAX: u32 = 3;
/// Number of newest ticks in which late ones are counted for [`LATE_IN_WINDOW_MAX`]: one bit each.
pub(crate) const WINDOW_TICKS: u32 = u64::BITS;
/// Number of late ticks among the newest [`WINDOW_TICKS`] that holds the robot: one in eight.
pub(crate) const LATE_IN_WINDOW_MAX: u32 = WINDOW_TICKS / 8;
/// Time without overload after which the hold ends.
pub(crate) const RELEASE_AFTER: Duration = Duration::from_secs(1);
/// Largest number of late ticks within [`RELEASE_AFTER`] that does not prolong a hold.
pub(crate) const LATE_ISOLATED_MAX: usize = 2;

/// Lateness of the loop during a hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Overrun {
    /// Largest excess of an interval between ticks over the period since the hold began.
    pub(crate) late: Duration,
    /// Largest number of late ticks among the newest [`WINDOW_TICKS`] since the hold began.
    pub(crate) late_ticks: u32,
}

/// Detects overload from the times of the ticks.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OverrunWatch {
    period: Duration,
    last_tick: Option<Duration>,
    /// One bit for each of the newest ticks, set if late; the newest is the lowest bit.
    late: u64,
    in_a_row: u32,
    /// Times of the newest late ticks, newest first; one more than may be isolated.
    late_at: [Option<Duration>; LATE_ISOLATED_MAX + 1],
    overloaded_at: Duration,
    overrun: Option<Overrun>,
}

impl OverrunWatch {
    /// Creates a watch for a loop of this period, before its first tick.
    pub(crate) fn new(period: Duration) -> Self {
        Self {
            period,
            last_tick: None,
            late: 0,
            in_a_row: 0,
            late_at: [None; LATE_ISOLATED_MAX + 1],
            overloaded_at: Duration::ZERO,
            overrun: None,
        }
    }

    /// Records a tick at `now`, by the monotonic clock.
    pub(crate) fn record(&mut self, now: Duration) {
        let since = self
            .last_tick
            .replace(now)
            .map_or(Duration::ZERO, |last| now.saturating_sub(last));
        let late = since.saturating_sub(self.period);
        let is_late = late > LATE_AFTER;
        self.late = (self.late << 1) | u64::from(is_late);
        self.in_a_row = if is_late { self.in_a_row + 1 } else { 0 };
        let late_ticks = self.late.count_ones();
        let is_overload = is_late
            && (late >= LATE_MAX
                || self.in_a_row >= LATE_IN_A_ROW_MAX
                || late_ticks >= LATE_IN_WINDOW_MAX);
        if is_late {
            self.late_at.rotate_right(1);
            self.late_at[0] = Some(now);
        }
        if is_overload {
            self.overloaded_at = now;
        }
        match &mut self.overrun {
            Some(overrun) => {
                overrun.late = overrun.late.max(late);
                overrun.late_ticks = overrun.late_ticks.max(late_ticks);
                let is_long_ago = |at: Duration| now.saturating_sub(at) >= RELEASE_AFTER;
                let is_isolated = self.late_at[LATE_ISOLATED_MAX].is_none_or(is_long_ago);
                if is_long_ago(self.overloaded_at) && is_isolated {
                    self.overrun = None;
                    self.late = 0;
                }
            }
            None if is_overload => self.overrun = Some(Overrun { late, late_ticks }),
            None => {}
        }
    }

    /// Returns the lateness of the loop while the robot is held for it.
    pub(crate) fn overrun(&self) -> Option<Overrun> {
        self.overrun
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PERIOD: Duration = Duration::from_millis(10);

    /// A watch and its clock.
    struct Loop {
        watch: OverrunWatch,
        now: Duration,
    }

    impl Loop {
        fn new() -> Self {
            let mut watch = OverrunWatch::new(PERIOD);
            watch.record(Duration::ZERO);
            Self {
                watch,
                now: Duration::ZERO,
            }
        }

        /// Ticks after a time, and says whether the robot is held then.
        fn tick_after(&mut self, gap_ms: u64) -> bool {
            self.now += Duration::from_millis(gap_ms);
            self.watch.record(self.now);
            self.watch.overrun().is_some()
        }
    }

    #[test]
    fn one_tick_that_is_far_too_late_holds_the_robot_and_a_second_on_time_lets_it_go() {
        let mut ticking = Loop::new();
        assert!(!ticking.tick_after(129));
        assert!(ticking.tick_after(130));
        let found = ticking.watch.overrun().unwrap();
        assert_eq!(found.late, LATE_MAX);
        for tick in 1..100 {
            assert!(ticking.tick_after(10), "tick {tick}");
        }
        assert!(!ticking.tick_after(10));
    }

    #[test]
    fn late_ticks_in_a_row_hold_the_robot_and_isolated_ones_do_not_prolong_it() {
        let mut ticking = Loop::new();
        assert!(!ticking.tick_after(60));
        assert!(!ticking.tick_after(60));
        assert!(!ticking.tick_after(10), "not in a row");
        assert!(!ticking.tick_after(60));
        assert!(!ticking.tick_after(60));
        assert!(ticking.tick_after(60));
        for _ in 0..80 {
            assert!(ticking.tick_after(10));
        }
        assert!(ticking.tick_after(60), "late again");
        for _ in 0..13 {
            assert!(ticking.tick_after(10));
        }
        assert!(!ticking.tick_after(10));
    }

    #[test]
    fn one_hiccup_in_each_second_lets_the_robot_go_and_an_overload_does_not() {
        // Milliseconds of the late tick in each round, ticks on time behind it, and whether the
        // robot is held throughout.
        let table = [
            (55, 95, false),
            (129, 87, false),
            (55, 45, false),
            (55, 25, true),
            (130, 87, true),
            (55, 6, true),
        ];
        for (late_ms, on_time, stays) in table {
            let mut ticking = Loop::new();
            assert!(ticking.tick_after(500));
            let mut released_ms = None;
            while ticking.now < Duration::from_secs(20) {
                let mut is_on_hold = ticking.tick_after(late_ms);
                for _ in 0..on_time {
                    is_on_hold &= ticking.tick_after(10);
                }
                if !is_on_hold {
                    released_ms = released_ms.or(Some(ticking.now.as_millis()));
                }
            }
            assert_eq!(
                released_ms.is_none(),
                stays,
                "{late_ms} ms, {on_time} ticks"
            );
            assert!(released_ms.is_none_or(|at| at < 3_000), "{released_ms:?}");
        }
    }

    #[test]
    fn many_late_ticks_of_the_newest_hold_the_robot() {
        let mut ticking = Loop::new();
        let mut held_after = None;
        for round in 1..=20 {
            // One of six is late.
            let mut is_on_hold = ticking.tick_after(60);
            for _ in 0..5 {
                is_on_hold |= ticking.tick_after(10);
            }
            if is_on_hold {
                held_after = Some(round);
                break;
            }
        }
        assert_eq!(held_after, Some(LATE_IN_WINDOW_MAX));
        assert_eq!(
            ticking.watch.overrun().unwrap().late_ticks,
            LATE_IN_WINDOW_MAX
        );
    }

    proptest! {
        #[test]
        fn a_loop_that_is_a_little_late_now_and_then_is_let_drive(
            gaps_ms in prop::collection::vec(0..=50_u64, 1..400),
        ) {
            let mut ticking = Loop::new();
            for gap_ms in gaps_ms {
                prop_assert!(!ticking.tick_after(gap_ms));
            }
        }

        #[test]
        fn whoever_is_let_go_has_had_no_overload_and_few_late_ticks_for_a_second(
            gaps_ms in prop::collection::vec(prop_oneof![8 => 5..15_u64, 1 => 40..200_u64], 1..600),
        ) {
            let mut ticking = Loop::new();
            let (mut late_at_ms, mut was_on_hold) = (Vec::new(), false);
            let (mut now_ms, mut far_late_at_ms) = (0, None);
            for gap_ms in gaps_ms {
                now_ms += gap_ms;
                let is_on_hold = ticking.tick_after(gap_ms);
                if gap_ms > 50 {
                    late_at_ms.push(now_ms);
                }
                if gap_ms >= 130 {
                    far_late_at_ms = Some(now_ms);
                }
                prop_assert!(is_on_hold || gap_ms < 130);
                let of_late = late_at_ms.iter().filter(|at_ms| now_ms - **at_ms < 1_000).count();
                let is_calm = of_late <= LATE_ISOLATED_MAX
                    && far_late_at_ms.is_none_or(|at_ms| now_ms - at_ms >= 1_000);
                if was_on_hold && !is_on_hold {
                    prop_assert!(is_calm);
                }
                was_on_hold = is_on_hold;
            }
        }

        #[test]
        fn a_hold_ends_however_isolated_hiccups_go_on(
            hiccups in prop::collection::vec((51..130_u64, 50..100_usize), 8..30),
        ) {
            let mut ticking = Loop::new();
            prop_assert!(ticking.tick_after(400));
            // At most two of them are within a second: each comes at least half of one behind the
            // last.
            let mut is_on_hold = true;
            for (late_ms, on_time) in hiccups {
                is_on_hold = ticking.tick_after(late_ms);
                for _ in 0..on_time {
                    is_on_hold = ticking.tick_after(10);
                }
            }
            prop_assert!(!is_on_hold);
        }
    }
}
