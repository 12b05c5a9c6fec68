//! Reads the demands of stops, leases, limits and the loop's rate once in each tick.
//!
//! The view of [`crate::safety`] is copied unless it is being written; in that case the copy of an
//! earlier tick is used. Its entries contain their expiry, so an old copy extends none of them.

use std::time::Duration;

use crate::control_loop::channels::Shared;
use crate::control_loop::overrun::{Overrun, OverrunWatch};
use crate::safety::LoopView;

/// Demands in this tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Demands {
    /// The number of the stop in force; 0 for none.
    pub(super) stop: u64,
    /// Time since the last message from the server.
    pub(super) server_silence: Duration,
    pub(super) view: LoopView,
    /// Lateness of the loop while the robot is held for it.
    pub(super) overrun: Option<Overrun>,
}

impl Demands {
    /// Whether a stop is in force.
    pub(super) fn is_stopped(&self) -> bool {
        self.stop != 0
    }

    /// Whether the lease of teleoperation is taken.
    pub(super) fn is_leased(&self, now_us: u64) -> bool {
        self.view.teleoperation.is_leased(now_us)
    }
}

/// Reads the demands of each tick.
#[derive(Debug, Default)]
pub(super) struct DemandReader {
    view: LoopView,
    /// Watch of the loop's rate, if its period is set.
    overrun: Option<OverrunWatch>,
}

impl DemandReader {
    /// Watches whether the loop keeps this period.
    pub(super) fn set_period(&mut self, period: Duration) {
        self.overrun = Some(OverrunWatch::new(period));
    }

    /// Reads the demands at `now`, by the monotonic clock.
    pub(super) fn read(&mut self, now: Duration, shared: &Shared) -> Demands {
        if let Some(watch) = &mut self.overrun {
            watch.record(now);
        }
        let stop = shared.safety.stop();
        let server_silence = shared.server_silence(now);
        if let Some(view) = shared.safety.try_view() {
            self.view = view;
        }
        Demands {
            stop,
            server_silence,
            view: self.view,
            overrun: self.overrun.as_ref().and_then(OverrunWatch::overrun),
        }
    }
}
