//! Limits failed connections per address.
//!
//! Each address may have a burst of failures and a slow rate of further ones; beyond that its
//! connections are refused before anything is read. Only failures count, so a whole fleet behind
//! one address may reconnect at once. The limit is high, so that a stranger behind the same address
//! cannot easily lock the fleet out.

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::Duration;

use crate::rate_limit::{Bucket, RateLimit};

/// Limit of failures per address.
const LIMIT: RateLimit = RateLimit {
    burst: 200,
    interval: Duration::from_millis(50),
};
/// Maximum number of addresses tracked.
const ADDRESSES_MAX: usize = 4_096;

/// Failures by address. Those from the loopback do not count: a local attacker has other means.
#[derive(Debug, Default)]
pub(super) struct Failures(HashMap<IpAddr, Bucket>);

impl Failures {
    /// Returns whether an address has exceeded its limit of failures.
    pub(super) fn is_blocked(&self, address: IpAddr, now: Duration) -> bool {
        let bucket = self.0.get(&address.to_canonical());
        bucket.is_some_and(|bucket| !bucket.has_one(LIMIT, now))
    }

    /// Records a failed connection from an address.
    pub(super) fn failed(&mut self, address: IpAddr, now: Duration) {
        let address = address.to_canonical();
        if address.is_loopback() {
            return;
        }
        if !self.0.contains_key(&address) && self.0.len() >= ADDRESSES_MAX {
            self.0.retain(|_, bucket| !bucket.is_full(now));
            if self.0.len() >= ADDRESSES_MAX {
                // So many addresses at once are an attack; the limits on open connections apply to
                // it.
                return;
            }
        }
        self.0.entry(address).or_default().take(LIMIT, now);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn seconds(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn address(last: u8) -> IpAddr {
        [192, 0, 2, last].into()
    }

    #[test]
    fn who_fails_too_often_is_blocked_for_a_while_and_nobody_else() {
        let mut failures = Failures::default();
        for _ in 0..1_000 {
            failures.failed(address(1), seconds(1));
            failures.failed([127, 0, 0, 1].into(), seconds(1));
        }
        assert!(failures.is_blocked(address(1), seconds(1)));
        assert!(!failures.is_blocked(address(1), seconds(2)));
        assert!(!failures.is_blocked(address(2), seconds(1)));
        assert!(!failures.is_blocked([127, 0, 0, 1].into(), seconds(1)));
    }

    #[test]
    fn what_is_remembered_is_bounded() {
        let mut failures = Failures::default();
        for number in 0..20_000_u32 {
            failures.failed(IpAddr::V4(number.into()), seconds(1));
        }
        assert_eq!(failures.0.len(), ADDRESSES_MAX);
    }

    proptest! {
        #[test]
        fn over_a_long_time_no_more_failures_pass_than_allowed(gaps_ms in prop::collection::vec(0_u64..40, 1..2_000)) {
            let mut failures = Failures::default();
            let (mut now_ms, mut passed) = (0, 0);
            for gap_ms in gaps_ms {
                now_ms += gap_ms;
                let now = Duration::from_millis(now_ms);
                if !failures.is_blocked(address(1), now) {
                    failures.failed(address(1), now);
                    passed += 1;
                }
            }
            let earned = u128::from(now_ms) / LIMIT.interval.as_millis();
            let allowed = u128::from(LIMIT.burst) + earned;
            prop_assert!(passed <= allowed, "{passed} of {allowed}");
        }
    }
}
