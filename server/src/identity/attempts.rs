//! Counts failed authentication attempts by client address and by token prefix, and locks sources
//! with too many failures.
//!
//! ```text
//!  free ──10 failures within a minute──► locked 30 s ──again──► 60 s ──► … ──► 15 min
//!   ▲                                                                              │
//!   └──────────────── an hour without a failure ◄──────────────────────────────────┘
//! ```
//!
//! A lock changes only the answer to invalid tokens; a valid token is accepted from every address.
//! An attacker behind the same proxy can therefore not lock operators out of Stop, nor can one do
//! so after a restart. [`crate::app::identity`] bounds the cost of guessing by the number of
//! concurrent look-ups of secrets.

use std::collections::HashMap;
use std::net::IpAddr;
use std::time::Duration;

use super::address::network_of;

/// Number of failures within [`WINDOW`] that locks a source.
pub const FAILURES_MAX: u32 = 10;
/// Length of the window in which failures are counted.
pub const WINDOW: Duration = Duration::from_mins(1);
/// Duration of the first lock of a source; each further lock lasts twice as long as the one before.
pub const LOCK_FIRST: Duration = Duration::from_secs(30);
/// Maximum duration of a lock.
pub const LOCK_MAX: Duration = Duration::from_mins(15);
/// Time without a failure after which the record of a source is reset.
pub const FORGOTTEN_AFTER: Duration = Duration::from_hours(1);
/// Maximum number of sources in memory. Beyond it the source with the oldest last failure is dropped;
/// locked sources are dropped only if all are locked.
pub const REMEMBERED_MAX: usize = 20_000;

/// Key by which failures are counted.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum Source {
    /// Client address; for IPv6 the /64 network, see [`network_of`].
    Address(IpAddr),
    /// First digits of the token that was presented, regardless of the client address.
    Prefix(String),
}

impl Source {
    /// Returns the source to count for a client address.
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

/// Failure counts and locks of at most [`REMEMBERED_MAX`] sources. All times `now` are durations
/// since the origin of one monotonic clock.
#[derive(Debug, Default)]
pub struct Attempts {
    records: HashMap<Source, Record>,
}

impl Attempts {
    /// Returns the remaining duration of the lock of `source`; `None` if it is not locked.
    pub fn locked_for(&self, source: &Source, now: Duration) -> Option<Duration> {
        let record = self.records.get(source)?;
        record
            .locked_until
            .checked_sub(now)
            .filter(|left| !left.is_zero())
    }

    /// Counts a failure of `source`, and locks it after [`FAILURES_MAX`] failures within
    /// [`WINDOW`].
    pub fn failed(&mut self, source: Source, now: Duration) {
        if self.records.len() >= REMEMBERED_MAX && !self.records.contains_key(&source) {
            self.make_room(now);
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

    /// Makes room for a record: drops those without a failure for [`FORGOTTEN_AFTER`]; if there are
    /// none, drops the one whose last failure is oldest.
    fn make_room(&mut self, now: Duration) {
        self.records
            .retain(|_, record| now.saturating_sub(record.failed_last) < FORGOTTEN_AFTER);
        if self.records.len() < REMEMBERED_MAX {
            return;
        }
        let oldest = self.records.iter().min_by_key(|(_, record)| {
            // Locked sources are dropped last.
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
