//! Watchdog of the loop: logs when no tick has run for [`LOG_AFTER`], and ends the agent after
//! [`END_AFTER`].
//!
//! The base has a watchdog of its own and stops the wheels without commands; ending the process
//! makes the service manager start a new one. Runs on its own thread, independent of a starved
//! async runtime.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tracing::{error, info};

use crate::clock::SharedClock;
use crate::control_loop::channels::Shared;

/// Interval of the checks.
pub(crate) const CHECK_EVERY: Duration = Duration::from_millis(100);
/// Time without a tick after which it is logged.
pub(crate) const LOG_AFTER: Duration = Duration::from_millis(500);
/// Time without a tick after which the agent ends.
pub(crate) const END_AFTER: Duration = Duration::from_secs(2);

/// Longest interval between two checks by which the loop is judged.
pub(crate) const OWN_GAP_MAX: Duration = Duration::from_millis(300);

/// Result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Finding {
    /// The loop ticks, or its silence is too short or logged already.
    Fine,
    /// No tick for [`LOG_AFTER`], found for the first time.
    StandsStill,
    /// The loop ticks again after it was reported.
    TicksAgain,
    /// No tick for [`END_AFTER`].
    GiveUp,
}

/// Judges the loop by its number of ticks. Pure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TickWatch {
    ticks: u64,
    since: Duration,
    looked: Duration,
    is_said: bool,
}

impl TickWatch {
    pub(crate) fn new(now: Duration) -> Self {
        Self {
            ticks: 0,
            since: now,
            looked: now,
            is_said: false,
        }
    }

    /// Runs one check. After an interval above [`OWN_GAP_MAX`] the time without ticks restarts: the
    /// whole process was suspended or starved, and the loop must have the chance to tick first.
    pub(crate) fn check(&mut self, ticks: u64, now: Duration) -> Finding {
        let gap = now.saturating_sub(std::mem::replace(&mut self.looked, now));
        if gap > OWN_GAP_MAX {
            self.since = now;
        }
        if ticks != self.ticks {
            let was_said = self.is_said;
            *self = Self {
                ticks,
                since: now,
                looked: now,
                is_said: false,
            };
            return if was_said {
                Finding::TicksAgain
            } else {
                Finding::Fine
            };
        }
        let stood = now.saturating_sub(self.since);
        if stood >= END_AFTER {
            Finding::GiveUp
        } else if stood >= LOG_AFTER && !self.is_said {
            self.is_said = true;
            Finding::StandsStill
        } else {
            Finding::Fine
        }
    }
}

/// Runs until the loop is requested to stop; returns early when the loop has not ticked for
/// [`END_AFTER`].
pub(crate) fn run(shared: &Arc<Shared>, clock: &SharedClock) {
    let mut watch = TickWatch::new(clock.monotonic());
    while !shared.stop.load(Ordering::Relaxed) {
        std::thread::sleep(CHECK_EVERY);
        let ticks = shared.ticks.load(Ordering::Relaxed);
        match watch.check(ticks, clock.monotonic()) {
            Finding::Fine => {}
            Finding::StandsStill => error!(ticks, "the control loop stands still"),
            Finding::TicksAgain => info!(ticks, "the control loop ticks again"),
            Finding::GiveUp => {
                error!(ticks, "the control loop stands still for good");
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Looks every 100 ms at a loop with so many ticks; the last finding that is not fine.
    fn check_until(watch: &mut TickWatch, ticks: u64, from_ms: u64, to_ms: u64) -> Vec<Finding> {
        let looks = (from_ms..=to_ms).step_by(100).map(Duration::from_millis);
        let findings = looks.map(|now| watch.check(ticks, now));
        findings
            .filter(|finding| *finding != Finding::Fine)
            .collect()
    }

    #[test]
    fn the_loop_watchdog_says_once_that_it_stands_still_and_then_gives_up() {
        let mut watch = TickWatch::new(Duration::ZERO);
        assert_eq!(check_until(&mut watch, 1, 100, 500), []);
        assert_eq!(check_until(&mut watch, 1, 600, 900), [Finding::StandsStill]);
        assert_eq!(
            check_until(&mut watch, 2, 1_000, 1_400),
            [Finding::TicksAgain]
        );
        assert_eq!(
            check_until(&mut watch, 2, 1_500, 2_900),
            [Finding::StandsStill]
        );
        assert_eq!(check_until(&mut watch, 2, 3_000, 3_000), [Finding::GiveUp]);
    }

    #[test]
    fn a_process_that_was_frozen_as_a_whole_is_not_given_up() {
        let mut watch = TickWatch::new(Duration::ZERO);
        assert_eq!(check_until(&mut watch, 1, 100, 300), []);
        assert_eq!(check_until(&mut watch, 1, 60_000, 60_400), []);
        assert_eq!(check_until(&mut watch, 2, 60_500, 60_500), []);
    }
}
