//! Rate at which the agent publishes its state: its own, or a higher one that the server requested.
//!
//! ```text
//! own rate ──request──► requested rate ──time over, connection lost──► own rate
//! ```
//!
//! Ends are by the runtime's clock, which also times the publishing.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::time::Instant;
use tread_api::wire::reply::{CommandRefusal, CommandRefusalCode};
use tread_api::wire::state::{STATE_RATE_FOR_MAX_MS, STATE_RATE_MAX_HZ, StateRate};

/// A request that was taken, reduced to the permitted rate and duration.
#[derive(Debug, Clone, Copy)]
struct Requested {
    rate_hz: f64,
    until: Instant,
}

/// Present rate of published states.
#[derive(Debug)]
pub(crate) struct PublishRate {
    own_hz: f64,
    requested: Mutex<Option<Requested>>,
    raised: Notify,
}

impl PublishRate {
    /// Creates the configured rate, Hz, above 0.
    pub(crate) fn new(own_hz: f64) -> Self {
        Self {
            own_hz,
            requested: Mutex::default(),
            raised: Notify::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Option<Requested>> {
        self.requested
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a request that arrives now, which replaces the one before.
    ///
    /// # Errors
    /// [`CommandRefusalCode::Impossible`] for a rate that is not finite or not above 0.
    pub(crate) fn request(&self, request: StateRate) -> Result<(), CommandRefusal> {
        self.request_at(request, Instant::now())
    }

    fn request_at(&self, request: StateRate, now: Instant) -> Result<(), CommandRefusal> {
        request
            .validate()
            .map_err(|detail| CommandRefusal::new(CommandRefusalCode::Impossible, detail))?;
        let before_hz = self.rate_hz(now);
        let lasting = Duration::from_millis(request.for_ms.min(STATE_RATE_FOR_MAX_MS));
        *self.lock() = Some(Requested {
            rate_hz: request.rate_hz.min(STATE_RATE_MAX_HZ).max(self.own_hz),
            until: now + lasting,
        });
        if self.rate_hz(now) > before_hz {
            self.raised.notify_one();
        }
        Ok(())
    }

    /// Ends a request before its time, because whoever sent it is not connected any more.
    pub(crate) fn end_request(&self) {
        *self.lock() = None;
    }

    /// Returns the rate at a time, Hz.
    fn rate_hz(&self, now: Instant) -> f64 {
        let requested = *self.lock();
        let in_force = requested.filter(|requested| now < requested.until);
        in_force.map_or(self.own_hz, |requested| requested.rate_hz)
    }

    /// Returns the time from one state to the next.
    fn period(&self, now: Instant) -> Duration {
        Duration::from_secs_f64(self.rate_hz(now).recip())
    }
}

/// Times of published states, at a rate that may change in between. Late ones are not made up for.
#[derive(Debug)]
pub(crate) struct PublishTimes<'rate> {
    rate: &'rate PublishRate,
    due: Instant,
}

impl<'rate> PublishTimes<'rate> {
    /// Begins at once.
    pub(crate) fn new(rate: &'rate PublishRate) -> Self {
        let due = Instant::now();
        Self { rate, due }
    }

    /// Waits until the next state is due. A future that is dropped loses nothing.
    pub(crate) async fn next(&mut self) {
        loop {
            tokio::select! {
                () = tokio::time::sleep_until(self.due) => break,
                () = self.rate.raised.notified() => self.expedite(Instant::now()),
            }
        }
        self.published(Instant::now());
    }

    /// Brings the next state forward, after the rate was raised.
    fn expedite(&mut self, now: Instant) {
        self.due = self.due.min(now + self.rate.period(now));
    }

    /// Sets the time of the state after the one that is due.
    fn published(&mut self, now: Instant) {
        let period = self.rate.period(now);
        self.due += period;
        if self.due <= now {
            self.due = now + period;
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const OWN_HZ: f64 = 5.0;
    const SECOND: Duration = Duration::from_secs(1);

    fn asked(rate_hz: f64, for_ms: u64) -> StateRate {
        StateRate { rate_hz, for_ms }
    }

    /// Publishes until a time, without waiting, and returns the number of states.
    fn states_until(times: &mut PublishTimes<'_>, end: Instant) -> usize {
        let mut count = 0;
        while times.due < end {
            count += 1;
            times.published(times.due);
        }
        count
    }

    #[test]
    fn a_request_raises_the_rate_at_once_and_for_its_time_alone() {
        // Its own period is ten seconds.
        let rate = PublishRate::new(0.1);
        let mut times = PublishTimes::new(&rate);
        let begin = times.due;
        assert_eq!(states_until(&mut times, begin + SECOND), 1);
        rate.request_at(asked(10.0, 2_000), begin + SECOND).unwrap();
        times.expedite(begin + SECOND);
        let raised = states_until(&mut times, begin + 3 * SECOND);
        assert!((19..=20).contains(&raised), "{raised}");
        assert!(states_until(&mut times, begin + 13 * SECOND) <= 2);
        rate.request_at(asked(10.0, 5_000), begin + 13 * SECOND)
            .unwrap();
        rate.end_request();
        times.expedite(begin + 13 * SECOND);
        assert!(states_until(&mut times, begin + 23 * SECOND) <= 1);
    }

    #[test]
    fn requests_that_are_repeated_keep_the_rate_even() {
        let rate = PublishRate::new(OWN_HZ);
        let mut times = PublishTimes::new(&rate);
        let begin = times.due;
        for tenths in (0..100).step_by(7) {
            let now = begin + tenths * SECOND / 10;
            rate.request_at(asked(10.0, 5_000), now).unwrap();
            times.expedite(now);
            let count = states_until(&mut times, now + 7 * SECOND / 10);
            assert!((6..=8).contains(&count), "{count} after {tenths}");
        }
    }

    #[test]
    fn a_request_never_lasts_longer_than_permitted() {
        let rate = PublishRate::new(OWN_HZ);
        let begin = Instant::now();
        let longest = Duration::from_millis(STATE_RATE_FOR_MAX_MS);
        rate.request_at(asked(10.0, u64::MAX), begin).unwrap();
        let at_end = begin + longest;
        assert!(rate.rate_hz(at_end - Duration::from_millis(1)) > 9.0);
        assert!(rate.rate_hz(at_end) <= OWN_HZ);
        rate.request_at(asked(10.0, 5_000), begin).unwrap();
        rate.request_at(asked(10.0, 0), begin).unwrap();
        assert!(rate.rate_hz(begin) <= OWN_HZ, "0 ends it");
    }

    #[tokio::test]
    async fn a_wait_for_the_next_state_ends_early_when_the_rate_is_raised() {
        let rate = PublishRate::new(0.1);
        let mut times = PublishTimes::new(&rate);
        times.next().await;
        let begin = Instant::now();
        rate.request(asked(STATE_RATE_MAX_HZ, 5_000)).unwrap();
        times.next().await;
        assert!(begin.elapsed() < 5 * SECOND, "{:?}", begin.elapsed());
    }

    proptest! {
        #[test]
        fn no_request_leaves_the_permitted_range(
            own_hz in 0.1..50.0_f64,
            rates_hz in proptest::collection::vec(any::<f64>(), 1..8),
        ) {
            let rate = PublishRate::new(own_hz);
            let now = Instant::now();
            for rate_hz in rates_hz {
                let is_possible = rate_hz.is_finite() && rate_hz > 0.0;
                let taken = rate.request_at(asked(rate_hz, 1_000), now);
                let code = taken.map_err(|refused| refused.code);
                let expected = if is_possible {
                    Ok(())
                } else {
                    Err(CommandRefusalCode::Impossible)
                };
                prop_assert_eq!(code, expected);
                let most_hz = own_hz.max(STATE_RATE_MAX_HZ);
                prop_assert!((own_hz..=most_hz).contains(&rate.rate_hz(now)));
            }
        }
    }
}
