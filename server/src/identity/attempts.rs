//! How many wrong tokens are borne: by address and by the first digits of what was shown.
//!
//! ```text
//!  free ──10 failures within a minute──► locked 30 s ──again──► 60 s ──► … ──► 15 min
//!   ▲                                                                              │
//!   └──────────────── an hour without a failure ◄──────────────────────────────────┘
//! ```
//!
//! The lock changes the answer to what is wrong, and nothing else: a good token is let in from
//! wherever it comes. So a stranger cannot take the Stop button away from people by failing beside
//! them or behind the same proxy, after a restart either. What guessing costs the server is bounded
//! by how many secrets are looked up at once ([`crate::app::identity`]).

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::Duration;

use super::address::network_of;

/// Failures within [`WINDOW`] that lock.
pub const FAILURES_MAX: u32 = 10;
/// The time within which failures are counted.
pub const WINDOW: Duration = Duration::from_mins(1);
/// How long the first lock holds; each further one twice as long.
pub const LOCK_FIRST: Duration = Duration::from_secs(30);
/// How long a lock holds at the most.
pub const LOCK_MAX: Duration = Duration::from_mins(15);
/// After so long without a failure all is forgotten.
pub const FORGOTTEN_AFTER: Duration = Duration::from_hours(1);
/// Most addresses and prefixes that are remembered.
pub const REMEMBERED_MAX: usize = 20_000;

/// What failures are counted by.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Source {
    /// An address; a whole /64 for IPv6, which is what one machine gets.
    Address(IpAddr),
    /// The first digits of a token, from wherever it is tried.
    Prefix(String),
}

impl Source {
    /// The source of an address.
    pub fn of_address(address: IpAddr) -> Self {
        Self::Address(network_of(address))
    }
}

#[derive(Debug, Clone, Copy)]
struct Record {
    failures: u32,
    window_began: Duration,
    failed_last: Duration,
    locks: u32,
    locked_until: Duration,
}

/// Failures, remembered within bounds. Times are those of one monotonic clock.
#[derive(Debug, Default)]
pub struct Attempts {
    records: HashMap<Source, Record>,
}

impl Attempts {
    /// How long this source is still locked; `None` if it is not.
    pub fn locked_for(&self, source: &Source, now: Duration) -> Option<Duration> {
        let record = self.records.get(source)?;
        record
            .locked_until
            .checked_sub(now)
            .filter(|left| !left.is_zero())
    }

    /// Notes a failure.
    pub fn failed(&mut self, source: Source, now: Duration) {
        if self.records.len() >= REMEMBERED_MAX && !self.records.contains_key(&source) {
            self.forget(now);
        }
        let fresh = Record {
            failures: 0,
            window_began: now,
            failed_last: now,
            locks: 0,
            locked_until: Duration::ZERO,
        };
        let record = self.records.entry(source).or_insert(fresh);
        if now.saturating_sub(record.failed_last) >= FORGOTTEN_AFTER {
            *record = fresh;
        }
        if now.saturating_sub(record.window_began) >= WINDOW {
            record.window_began = now;
            record.failures = 0;
        }
        record.failures += 1;
        record.failed_last = now;
        if record.failures >= FAILURES_MAX {
            let doubled = LOCK_FIRST.saturating_mul(1 << record.locks.min(16));
            record.locked_until = now + doubled.min(LOCK_MAX);
            record.locks += 1;
            record.failures = 0;
            record.window_began = now;
        }
    }

    /// Makes room: forgets what is old, and if nothing is, the one that failed longest ago.
    fn forget(&mut self, now: Duration) {
        self.records
            .retain(|_, record| now.saturating_sub(record.failed_last) < FORGOTTEN_AFTER);
        if self.records.len() < REMEMBERED_MAX {
            return;
        }
        let oldest = self.records.iter().min_by_key(|(_, record)| {
            // One that is locked is forgotten last.
            (record.locked_until > now, record.failed_last)
        });
        if let Some(oldest) = oldest.map(|(source, _)| source.clone()) {
            self.records.remove(&oldest);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(text: &str) -> Source {
        Source::of_address(text.parse().unwrap())
    }

    #[test]
    fn ten_failures_lock_and_each_further_lock_holds_twice_as_long() {
        let (mut attempts, source) = (Attempts::default(), address("192.0.2.1"));
        let mut now = Duration::from_secs(1_000);
        let mut held = LOCK_FIRST;
        for _ in 0..8 {
            for _ in 0..FAILURES_MAX {
                assert_eq!(attempts.locked_for(&source, now), None);
                attempts.failed(source.clone(), now);
            }
            assert_eq!(attempts.locked_for(&source, now), Some(held));
            now += held;
            held = (2 * held).min(LOCK_MAX);
        }
        assert_eq!(attempts.locked_for(&source, now), None);
        assert_eq!(attempts.locked_for(&address("192.0.2.2"), now), None);
    }

    #[test]
    fn failures_that_are_far_apart_do_not_lock() {
        let (mut attempts, source) = (Attempts::default(), address("192.0.2.1"));
        for minute in 0..100 {
            for second in 0..9 {
                let now = Duration::from_secs(60 * minute + second);
                attempts.failed(source.clone(), now);
                assert_eq!(attempts.locked_for(&source, now), None);
            }
        }
    }

    #[test]
    fn one_machine_has_a_whole_network_of_ipv6_and_one_address_of_ipv4() {
        assert_eq!(address("2001:db8::1"), address("2001:db8::ffff:1"));
        assert_ne!(address("2001:db8::1"), address("2001:db8:0:1::1"));
        assert_eq!(address("::ffff:192.0.2.1"), address("192.0.2.1"));
        assert_ne!(address("192.0.2.1"), address("192.0.2.2"));
    }

    #[test]
    fn however_many_fail_the_memory_is_bounded_and_the_newest_is_in_it() {
        let mut attempts = Attempts::default();
        let source = |number: u32| Source::of_address(IpAddr::from(number.to_be_bytes()));
        let bound = u32::try_from(REMEMBERED_MAX).unwrap();
        for number in 0..bound + 50 {
            attempts.failed(source(number), Duration::from_millis(u64::from(number)));
        }
        assert_eq!(attempts.records.len(), REMEMBERED_MAX);
        assert!(attempts.records.contains_key(&source(bound + 49)));
        assert!(!attempts.records.contains_key(&source(0)));
    }
}
