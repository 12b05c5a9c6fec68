//! Simulated time that several loops share, as fast as the machine allows.
//!
//! Each loop has a [`PacedClock`] of one [`PacedTime`]. Time stands still while any of them
//! computes; when all wait, it jumps to the earliest deadline. So no loop is ever late, and the
//! result of a run does not depend on the machine's speed or load. A pace limits the ratio of
//! simulated to real time, so that networks and disks, which work in real time, keep up.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use jiff::Timestamp;

use crate::clock::Clock;

/// Permitted ratio of simulated to real time.
pub const PACE_RANGE: std::ops::RangeInclusive<f64> = 0.01..=1_000.0;

#[derive(Debug)]
struct State {
    now: Duration,
    pace: f64,
    loops: usize,
    /// Deadlines of the waiting loops.
    waiting: Vec<Duration>,
    /// Whether a loop waits for the pace before it advances the time.
    is_leaping: bool,
    /// Real time of the last advance.
    leapt_at: Option<Instant>,
}

#[derive(Debug)]
struct Inner {
    wall_origin: Timestamp,
    state: Mutex<State>,
    changed: Condvar,
}

impl Inner {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wall(&self, now: Duration) -> Timestamp {
        // Saturates at the last year of RFC 3339.
        self.wall_origin.checked_add(now).unwrap_or(Timestamp::MAX)
    }
}

/// Common time of the loops of a simulated site.
#[derive(Debug, Clone)]
pub struct PacedTime {
    inner: Arc<Inner>,
}

impl PacedTime {
    /// Creates a time that stays at zero, and at `wall_origin`, until loops wait for it. `pace` is
    /// the largest ratio of simulated to real time, clamped to [`PACE_RANGE`].
    pub fn new(wall_origin: Timestamp, pace: f64) -> Self {
        let state = State {
            now: Duration::ZERO,
            pace: bounded(pace),
            loops: 0,
            waiting: Vec::new(),
            is_leaping: false,
            leapt_at: None,
        };
        Self {
            inner: Arc::new(Inner {
                wall_origin,
                state: Mutex::new(state),
                changed: Condvar::new(),
            }),
        }
    }

    /// Returns the time since the origin.
    pub fn now(&self) -> Duration {
        self.inner.state().now
    }

    /// Returns the wall time.
    pub fn wall(&self) -> Timestamp {
        self.inner.wall(self.now())
    }

    /// Sets the largest ratio of simulated to real time, clamped to [`PACE_RANGE`].
    pub fn set_pace(&self, pace: f64) {
        self.inner.state().pace = bounded(pace);
    }

    /// Creates a clock for one more loop. Until the clock is dropped, time advances only while that
    /// loop waits.
    pub fn clock(&self) -> PacedClock {
        self.inner.state().loops += 1;
        PacedClock {
            inner: Arc::clone(&self.inner),
        }
    }
}

fn bounded(pace: f64) -> f64 {
    pace.max(*PACE_RANGE.start()).min(*PACE_RANGE.end())
}

/// The clock of one loop.
#[derive(Debug)]
pub struct PacedClock {
    inner: Arc<Inner>,
}

impl PacedClock {
    /// Advances time to the earliest deadline, once the pace allows it.
    fn leap<'state>(
        &'state self,
        mut state: MutexGuard<'state, State>,
    ) -> MutexGuard<'state, State> {
        #[expect(
            clippy::disallowed_methods,
            reason = "the pace is one over the machine's time"
        )]
        let real_now = Instant::now;
        let next = state.waiting.iter().min().copied().unwrap_or(state.now);
        let took = next.saturating_sub(state.now).div_f64(state.pace);
        let since = state.leapt_at.map_or(Duration::MAX, |at| real_now() - at);
        let early = took.saturating_sub(since);
        if !early.is_zero() {
            state.is_leaping = true;
            drop(state);
            std::thread::sleep(early);
            state = self.inner.state();
            state.is_leaping = false;
        }
        // A loop that was added meanwhile computes: time waits for it too.
        if state.waiting.len() == state.loops {
            state.now = state.now.max(next);
            let now = state.now;
            state.waiting.retain(|deadline| *deadline > now);
            state.leapt_at = Some(real_now());
        }
        self.inner.changed.notify_all();
        state
    }
}

impl Clock for PacedClock {
    fn monotonic(&self) -> Duration {
        self.inner.state().now
    }

    fn wall(&self) -> Timestamp {
        self.inner.wall(self.monotonic())
    }

    fn sleep_until(&self, deadline: Duration) {
        let mut state = self.inner.state();
        if deadline <= state.now {
            return;
        }
        state.waiting.push(deadline);
        while state.now < deadline {
            state = if state.waiting.len() == state.loops && !state.is_leaping {
                self.leap(state)
            } else {
                let waited = self.inner.changed.wait(state);
                waited.unwrap_or_else(PoisonError::into_inner)
            };
        }
    }
}

impl Drop for PacedClock {
    fn drop(&mut self) {
        self.inner.state().loops -= 1;
        self.inner.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Duration = Duration::from_millis(10);

    #[test]
    fn loops_go_through_time_together_and_one_that_leaves_holds_nobody() {
        let time = PacedTime::new(Timestamp::UNIX_EPOCH, 1_000.0);
        let clocks: Vec<PacedClock> = (0..4).map(|_| time.clock()).collect();
        let threads = clocks.into_iter().zip(1_u32..).map(|(clock, number)| {
            std::thread::spawn(move || {
                // Each goes for another number of steps, and sees every one of them.
                for step in 1..=100 * number {
                    clock.sleep_until(step * STEP);
                    assert_eq!(clock.monotonic(), step * STEP);
                }
            })
        });
        for thread in threads.collect::<Vec<_>>() {
            thread.join().unwrap();
        }
        assert_eq!(time.now(), 400 * STEP);
        assert_eq!(time.wall(), Timestamp::UNIX_EPOCH + 400 * STEP);
    }

    #[test]
    fn time_goes_no_faster_than_its_pace() {
        let time = PacedTime::new(Timestamp::UNIX_EPOCH, 20.0);
        let clock = time.clock();
        #[expect(clippy::disallowed_methods, reason = "real time is what is tested")]
        let began = Instant::now();
        for step in 1..=100 {
            clock.sleep_until(step * STEP);
        }
        // The first step is free.
        assert!(began.elapsed() >= 99 * STEP / 20, "{:?}", began.elapsed());
    }
}
