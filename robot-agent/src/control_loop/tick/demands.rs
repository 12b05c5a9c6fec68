//! What stops, leases, limits and the loop's rate ask for in a tick.
//!
//! The view of [`crate::safety`] is copied once in each tick, if nobody is writing it; the last copy
//! carries its own ends, so that nothing lasts longer for being read late.

use std::time::Duration;

use crate::control_loop::channels::Shared;
use crate::control_loop::overrun::{Overrun, OverrunWatch};
use crate::safety::LoopView;

/// What is asked for in this tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Demands {
    /// The number of the stop in force; 0 for none.
    pub(super) stop: u64,
    /// How long the server has been silent.
    pub(super) server_silence: Duration,
    pub(super) view: LoopView,
    /// How far the loop is from its rate, while the robot is held for it.
    pub(super) overrun: Option<Overrun>,
}

impl Demands {
    /// Whether a stop is in force.
    pub(super) fn is_stopped(&self) -> bool {
        self.stop != 0
    }

    /// Whether somebody has the lease of teleoperation.
    pub(super) fn is_leased(&self, now_us: u64) -> bool {
        self.view.teleoperation.is_leased(now_us)
    }
}

/// Reads them.
#[derive(Debug, Default)]
pub(super) struct DemandReader {
    view: LoopView,
    /// Whether the loop keeps its rate, where that is known.
    overrun: Option<OverrunWatch>,
}

impl DemandReader {
    /// Watches whether the loop keeps this period.
    pub(super) fn set_period(&mut self, period: Duration) {
        self.overrun = Some(OverrunWatch::new(period));
    }

    /// Reads what is asked for now.
    pub(super) fn read(&mut self, now: Duration, shared: &Shared) -> Demands {
        if let Some(watch) = &mut self.overrun {
            watch.note(now);
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
