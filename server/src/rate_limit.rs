//! How often something may happen: a burst at once, then one in each interval.
//!
//! The generic cell rate algorithm: a bucket is one time, up to which what has happened is paid
//! for. In integers, so that no rounding adds up.

use std::time::Duration;

/// A rate with a burst.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RateLimit {
    /// How many may come at once.
    pub(crate) burst: u32,
    /// The interval in which one more may come.
    pub(crate) interval: Duration,
}

/// What of a limit is used; the default is nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Bucket {
    /// When all that has been taken is earned again.
    full_at: Duration,
}

impl Bucket {
    /// How long until one may be taken.
    fn delay(self, limit: RateLimit, now: Duration) -> Duration {
        let owed = self.full_at.saturating_sub(now) + limit.interval;
        owed.saturating_sub(limit.interval * limit.burst)
    }

    /// Whether one may be taken now.
    pub(crate) fn has_one(self, limit: RateLimit, now: Duration) -> bool {
        self.delay(limit, now).is_zero()
    }

    /// Takes one, if it may be taken now.
    pub(crate) fn take(&mut self, limit: RateLimit, now: Duration) -> bool {
        let has_one = self.has_one(limit, now);
        if has_one {
            self.full_at = self.full_at.max(now) + limit.interval;
        }
        has_one
    }

    /// Takes one that may be used after the delay that is given. Who would have to wait for `delay_max`
    /// takes none and waits for that long.
    pub(crate) fn take_delayed(
        &mut self,
        limit: RateLimit,
        now: Duration,
        delay_max: Duration,
    ) -> Duration {
        let delay = self.delay(limit, now).min(delay_max);
        if delay < delay_max {
            self.full_at = self.full_at.max(now) + limit.interval;
        }
        delay
    }

    /// Takes some that have been used already, also more than there are: how long until that is paid for.
    pub(crate) fn charge(&mut self, limit: RateLimit, now: Duration, count: u32) -> Duration {
        let owed = self.full_at.saturating_sub(now) + limit.interval * count;
        self.full_at = now + owed;
        owed.saturating_sub(limit.interval * limit.burst)
    }

    /// Whether nothing of the limit is used.
    pub(crate) fn is_full(self, now: Duration) -> bool {
        self.full_at <= now
    }

    /// Since when nothing of the limit is used, or when that will be so.
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
                // It refuses no more than it must: a whole burst was taken not long ago.
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
            let delay_max = Duration::from_secs(1);
            let (mut asked, mut used) = (Bucket::default(), Bucket::default());
            let mut now = Duration::ZERO;
            for gap_ms in gaps_ms {
                now += Duration::from_millis(gap_ms);
                let is_free = asked.has_one(limit, now);
                let delay = asked.take_delayed(limit, now, delay_max);
                prop_assert!(delay <= delay_max && is_free == delay.is_zero());
                if delay < delay_max {
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
                // Nobody waits for what is there.
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
