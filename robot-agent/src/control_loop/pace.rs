//! Schedules the ticks: at a fixed rate, or triggered by the samples of the base.
//!
//! At a free phase, a sample that arrives asynchronously would wait for up to a period. So a sample
//! triggers the tick, but no sooner than [`EARLY_SHARE`] of a period after the previous one;
//! without a sample the loop ticks after [`LATE_SHARE`] of a period. The rate stays bounded both
//! ways.

use std::sync::Arc;
use std::time::Duration;

use crate::clock::SharedClock;
use crate::drive::Arrivals;

/// Earliest tick after the previous one, as a fraction of the period.
const EARLY_SHARE: f64 = 0.5;
/// Latest tick after the previous one, as a fraction of the period.
const LATE_SHARE: f64 = 1.5;
/// Lag in periods beyond which missed ticks are skipped.
const LAG_PERIODS_MAX: u32 = 10;

/// Schedule of the ticks.
#[derive(Debug)]
pub(super) struct Pace {
    period: Duration,
    arrivals: Option<Arc<Arrivals>>,
    /// Number of samples that had arrived at the last tick.
    seen: u64,
    deadline: Duration,
}

impl Pace {
    /// Creates the schedule; the calling thread is the one that samples wake.
    pub(super) fn new(
        period: Duration,
        arrivals: Option<Arc<Arrivals>>,
        clock: &SharedClock,
    ) -> Self {
        if let Some(arrivals) = &arrivals {
            arrivals.register_thread();
        }
        Self {
            period,
            seen: 0,
            arrivals,
            deadline: clock.monotonic(),
        }
    }

    /// Records the begin of a tick; returns whether it is more than a period late.
    pub(super) fn begin(&mut self, now: Duration) -> bool {
        if let Some(arrivals) = &self.arrivals {
            self.seen = arrivals.count();
            // Time is counted from here, since the next sample does not make up for a late one.
            let is_late = now > self.deadline + self.period;
            self.deadline = now;
            return is_late;
        }
        now > self.deadline + self.period
    }

    /// Waits for the next tick.
    pub(super) fn wait(&mut self, clock: &SharedClock) {
        let Some(arrivals) = &self.arrivals else {
            let now = clock.monotonic();
            self.deadline += self.period;
            if now > self.deadline + LAG_PERIODS_MAX * self.period {
                // The process was suspended or starved: missed ticks are skipped.
                self.deadline = now;
            }
            clock.sleep_until(self.deadline);
            return;
        };
        let earliest = self.deadline + self.period.mul_f64(EARLY_SHARE);
        let latest = self.deadline + self.period.mul_f64(LATE_SHARE);
        // Bounded by `latest`; each iteration ends the loop or waits.
        loop {
            let now = clock.monotonic();
            let has_new = arrivals.count() != self.seen;
            let due = if has_new { earliest } else { latest };
            if now >= due {
                break;
            }
            if has_new {
                std::thread::sleep(due.saturating_sub(now));
            } else {
                std::thread::park_timeout(due.saturating_sub(now));
            }
        }
        self.deadline = latest;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::SystemClock;

    const PERIOD: Duration = Duration::from_millis(10);

    #[test]
    fn a_loop_without_a_base_that_tells_keeps_its_own_rate() {
        let clock = SystemClock::shared();
        let mut pace = Pace::new(PERIOD, None, &clock);
        let began = clock.monotonic();
        for _ in 0..10 {
            pace.begin(clock.monotonic());
            pace.wait(&clock);
        }
        assert!(clock.monotonic().saturating_sub(began) >= 10 * PERIOD);
    }

    #[test]
    fn a_sample_brings_the_tick_on_and_silence_does_not_stop_it() {
        let clock = SystemClock::shared();
        let arrivals = Arc::new(Arrivals::default());
        let mut pace = Pace::new(PERIOD, Some(Arc::clone(&arrivals)), &clock);
        // One that is there already is waited for only as long as the rate wants it.
        pace.begin(clock.monotonic());
        let began = clock.monotonic();
        arrivals.notify();
        pace.wait(&clock);
        assert!(clock.monotonic().saturating_sub(began) >= PERIOD.mul_f64(0.45));
        // None at all: the loop goes on.
        pace.begin(clock.monotonic());
        let began = clock.monotonic();
        pace.wait(&clock);
        assert!(clock.monotonic().saturating_sub(began) >= PERIOD.mul_f64(1.4));
    }

    #[test]
    fn a_sample_wakes_a_loop_that_waits() {
        let clock = SystemClock::shared();
        let arrivals = Arc::new(Arrivals::default());
        let slow = Duration::from_millis(400);
        let mut pace = Pace::new(slow, Some(Arc::clone(&arrivals)), &clock);
        let began = clock.monotonic();
        pace.begin(began);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(slow.mul_f64(0.8));
                arrivals.notify();
            });
            pace.wait(&clock);
        });
        let waited = clock.monotonic().saturating_sub(began);
        assert!(
            (slow.mul_f64(0.8)..slow.mul_f64(1.4)).contains(&waited),
            "{waited:?}"
        );
    }
}
