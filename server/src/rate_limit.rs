//! Rate limiter with a burst: up to `burst` events at once, then one per interval.
//!
//! Implements the generic cell rate algorithm (GCRA). The state of a bucket is one time, at which
//! all events so far are earned back. Times are integers, so rounding errors do not accumulate.

use std::time::Duration;

/// Maximum delay of an event by [`Bucket::take_delayed`].
const DELAY_MAX: Duration = Duration::from_secs(1);

/// Rate limit with a burst.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RateLimit {
    /// Maximum number of events at once.
    pub(crate) burst: u32,
    /// Time in which one further event is allowed.
    pub(crate) interval: Duration,
}

impl RateLimit {
    /// Creates a limit.
    pub(crate) const fn new(burst: u32, interval: Duration) -> Self {
        Self { burst, interval }
    }
}

/// Used part of a rate limit; the default is unused. All times are durations since one monotonic
/// origin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Bucket {
    /// Time at which the bucket is unused again.
    full_at: Duration,
}

impl Bucket {
    /// Returns the time until the next event is allowed.
    fn delay(self, limit: RateLimit, now: Duration) -> Duration {
        let backlog = self.full_at.saturating_sub(now) + limit.interval;
        backlog.saturating_sub(limit.interval * limit.burst)
    }

    /// Returns whether an event is allowed now.
    pub(crate) fn has_one(self, limit: RateLimit, now: Duration) -> bool {
        self.delay(limit, now).is_zero()
    }

    /// Counts an event if it is allowed now, and returns whether it is.
    pub(crate) fn take(&mut self, limit: RateLimit, now: Duration) -> bool {
        let has_one = self.has_one(limit, now);
        if has_one {
            self.full_at = self.full_at.max(now) + limit.interval;
        }
        has_one
    }

    /// Returns the delay after which an event may take place, at most [`DELAY_MAX`]. Counts the event
    /// if its delay is below it.
    pub(crate) fn take_delayed(&mut self, limit: RateLimit, now: Duration) -> Duration {
        let delay = self.delay(limit, now).min(DELAY_MAX);
        if delay < DELAY_MAX {
            self.full_at = self.full_at.max(now) + limit.interval;
        }
        delay
    }

    /// Counts `count` events that have taken place, also beyond the limit. Returns the time until
    /// the limit is met again.
    pub(crate) fn charge(&mut self, limit: RateLimit, now: Duration, count: u32) -> Duration {
        let backlog = self.full_at.saturating_sub(now) + limit.interval * count;
        self.full_at = now + backlog;
        backlog.saturating_sub(limit.interval * limit.burst)
    }

    /// Returns whether the limit is unused at `now`.
    pub(crate) fn is_full(self, now: Duration) -> bool {
        self.full_at <= now
    }

    /// Returns the time at which the limit became or becomes unused.
    pub(crate) fn full_at(self) -> Duration {
        self.full_at
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn no_more_are_taken_than_at_once_and_one_in_each_interval(
            gaps_ms in prop::collection::vec(0..20_000_u64, 1..300),
            burst in 1..20_u32,
            interval_ms in 1..30_000_u64,
        ) {
            let interval = Duration::from_millis(interval_ms);
            let limit = RateLimit { burst, interval };
            let mut bucket = Bucket::default();
            let (mut now, mut taken) = (Duration::ZERO, 0_u128);
            for gap_ms in gaps_ms {
                now += Duration::from_millis(gap_ms);
                let earned = u128::from(burst) + now.as_millis() / u128::from(interval_ms);
                let is_taken = bucket.take(limit, now);
                taken += u128::from(is_taken);
                prop_assert!(taken <= earned);
                // A refusal is necessary: a whole burst was taken shortly before.
                prop_assert!(is_taken || bucket.full_at() + interval > now + interval * burst);
            }
        }

        #[test]
        fn whoever_waits_for_the_delay_keeps_the_limit_and_no_delay_is_longer_than_asked(
            gaps_ms in prop::collection::vec(0..200_u64, 1..300),
            burst in 1..20_u32,
            interval_ms in 1..300_u64,
        ) {
            let limit = RateLimit { burst, interval: Duration::from_millis(interval_ms) };
            let (mut asked, mut used) = (Bucket::default(), Bucket::default());
            let mut now = Duration::ZERO;
            for gap_ms in gaps_ms {
                now += Duration::from_millis(gap_ms);
                let is_free = asked.has_one(limit, now);
                let delay = asked.take_delayed(limit, now);
                prop_assert!(delay <= DELAY_MAX && is_free == delay.is_zero());
                if delay < DELAY_MAX {
                    prop_assert!(used.take(limit, now + delay));
                }
            }
        }

        #[test]
        fn whoever_waits_until_it_is_paid_for_keeps_the_rate(
            counts in prop::collection::vec(0..2_000_u32, 1..300),
            burst in 1..5_000_u32,
        ) {
            let limit = RateLimit { burst, interval: Duration::from_micros(10) };
            let mut bucket = Bucket::default();
            let (mut now, mut used) = (Duration::ZERO, 0_u128);
            for count in counts {
                let delay = bucket.charge(limit, now, count);
                used += u128::from(count);
                now += delay;
                let earned = u128::from(burst) + now.as_micros() / 10;
                prop_assert!(used <= earned);
                // An event that is allowed now is not delayed.
                prop_assert!(delay.is_zero() || used == earned);
            }
        }

        #[test]
        fn who_waits_long_enough_has_the_whole_burst_again(burst in 1..50_u32, now_ms in 0..1_000_000_u64) {
            let limit = RateLimit { burst, interval: Duration::from_millis(250) };
            let mut bucket = Bucket::default();
            let mut now = Duration::from_millis(now_ms);
            for _ in 0..2 {
                prop_assert!(bucket.is_full(now));
                let taken = (0..2 * burst).filter(|_| bucket.take(limit, now)).count();
                prop_assert_eq!(taken, usize::try_from(burst)?);
                prop_assert!(!bucket.has_one(limit, now) && !bucket.is_full(now));
                now += limit.interval * burst;
            }
        }
    }
}
