//! The loop thread: runs [`tick::LoopCore`] at a fixed rate with absolute deadlines.
//!
//! It owns the drive and all control state ([`tick`]) and exchanges data with the other threads
//! through [`channels`] without blocking, so a dead network cannot delay a tick. Its only I/O is
//! that of the drive.

pub(crate) mod active;
pub(crate) mod channels;
pub(crate) mod driven;
pub(crate) mod frame;
mod gain;
pub(crate) mod job;
mod outgoing;
pub(crate) mod overrun;
mod pace;
pub(crate) mod prior;
mod progress;
pub(crate) mod segments;
pub(crate) mod site_view;
pub(crate) mod slip;
pub(crate) mod standstill;
pub(crate) mod surface;
pub(crate) mod tick;
pub(crate) mod watchdog;

use std::time::Duration;

use tracing::{info, warn};

use crate::clock::SharedClock;
use crate::drive::Drive;
use pace::Pace;
use segments::Moment;
use tick::LoopCore;

/// Longest time to wait for zero velocity once the loop is requested to stop; the loop then ends
/// even if the robot still moves.
pub(crate) const BRAKING_MAX: Duration = Duration::from_secs(5);
/// Number of consecutive ticks at zero velocity after which the robot counts as stopped.
const STANDING_TICKS: u32 = 5;

/// Runs the loop until it is requested to stop and the robot has stopped, at most [`BRAKING_MAX`]
/// after the request.
pub(crate) fn run(
    mut core: LoopCore,
    mut drive: Box<dyn Drive>,
    clock: &SharedClock,
    period: Duration,
) {
    info!(
        period_us = u64::try_from(period.as_micros()).unwrap_or(0),
        "control loop runs"
    );
    let mut pace = Pace::new(period, drive.arrivals(), clock);
    let mut stop_requested_at = None;
    let mut standing_ticks = 0;
    loop {
        let began = clock.monotonic();
        if pace.begin(began) {
            core.count_overrun();
        }
        let stop = core.stop_requested();
        let now = Moment {
            monotonic: began,
            wall: clock.wall(),
        };
        core.tick_by(now, &|| clock.monotonic(), stop, drive.as_mut());
        let ended = clock.monotonic();
        core.record_tick_time(ended.saturating_sub(began));
        if stop {
            let since = *stop_requested_at.get_or_insert(began);
            standing_ticks = if core.is_standing() {
                standing_ticks + 1
            } else {
                0
            };
            let has_stopped = standing_ticks >= STANDING_TICKS && core.flush();
            let is_overdue = began.saturating_sub(since) > BRAKING_MAX;
            if has_stopped {
                info!("the robot stands, the control loop ends");
                return;
            }
            if is_overdue {
                warn!("the robot did not stand in time, the control loop ends");
                return;
            }
        }
        pace.wait(clock);
    }
}

#[cfg(test)]
pub(crate) mod hold_tests;
#[cfg(test)]
mod overrun_tests;
#[cfg(test)]
mod prior_tests;
#[cfg(test)]
mod sensor_tests;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod watch_tests;
