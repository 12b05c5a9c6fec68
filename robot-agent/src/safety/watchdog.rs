//! Watches the loop: one whose ticks stand still is said so, and soon ends the whole agent.
//!
//! The base has a watchdog of its own and stops the wheels when no command comes; ending the
//! process lets the service manager start a loop that ticks. A thread, because a starved runtime
//! must not silence it.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tracing::{error, info};

use crate::clock::SharedClock;
use crate::control_loop::seam::Shared;

/// Time between two looks.
pub(crate) const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Standstill after which it is said.
pub(crate) const SAY_AFTER: Duration = Duration::from_millis(500);
/// Standstill after which the agent ends.
pub(crate) const END_AFTER: Duration = Duration::from_secs(2);

/// What a look finds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Finding {
    /// It ticks.
    Fine,
    /// It has just stood still for [`SAY_AFTER`].
    StandsStill,
    /// It ticks again.
    TicksAgain,
    /// It has stood still for [`END_AFTER`].
    GiveUp,
}

/// Judges by the number of ticks. Pure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TickWatch {
    ticks: u64,
    since: Duration,
    is_said: bool,
}

impl TickWatch {
    pub(crate) fn new(now: Duration) -> Self {
        Self {
            ticks: 0,
            since: now,
            is_said: false,
        }
    }

    /// One look.
    pub(crate) fn look(&mut self, ticks: u64, now: Duration) -> Finding {
        if ticks != self.ticks {
            let was_said = self.is_said;
            *self = Self {
                ticks,
                since: now,
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
        } else if stood >= SAY_AFTER && !self.is_said {
            self.is_said = true;
            Finding::StandsStill
        } else {
            Finding::Fine
        }
    }
}

/// Watches until the loop is told to stop, or returns early when it stands still.
pub(crate) fn run(shared: &Arc<Shared>, clock: &SharedClock) {
    let mut watch = TickWatch::new(clock.monotonic());
    while !shared.stop.load(Ordering::Relaxed) {
        std::thread::sleep(LOOK_EVERY);
        let ticks = shared.ticks.load(Ordering::Relaxed);
        match watch.look(ticks, clock.monotonic()) {
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

    #[test]
    fn a_loop_that_stands_still_is_said_once_and_then_given_up() {
        let at = Duration::from_millis;
        let mut watch = TickWatch::new(at(0));
        assert_eq!(watch.look(1, at(100)), Finding::Fine);
        assert_eq!(watch.look(1, at(599)), Finding::Fine);
        assert_eq!(watch.look(1, at(600)), Finding::StandsStill);
        assert_eq!(watch.look(1, at(700)), Finding::Fine);
        assert_eq!(watch.look(2, at(800)), Finding::TicksAgain);
        assert_eq!(watch.look(2, at(1_300)), Finding::StandsStill);
        assert_eq!(watch.look(2, at(2_799)), Finding::Fine);
        assert_eq!(watch.look(2, at(2_800)), Finding::GiveUp);
    }
}
