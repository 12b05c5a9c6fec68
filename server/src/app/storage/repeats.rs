//! Failures that repeat: each reason is logged at once, and then at intervals with a count.

use std::time::Duration;

/// Minimum interval between log entries about the same failure: a full disk fails the same
/// transactions many times a second.
const LOG_EVERY: Duration = Duration::from_secs(30);
/// Maximum number of reasons of one kind of failure that are distinguished within that time: texts of other
/// programs may differ every time.
const REASONS_MAX: usize = 8;

/// A failure: what failed, and why.
#[derive(Debug, Clone, Copy)]
pub(super) struct Failure<'text> {
    pub(super) what: &'static str,
    pub(super) reason: &'text str,
}

/// Failures that were logged.
#[derive(Debug, Default)]
pub(super) struct Repeats {
    logged: Vec<Logged>,
}

#[derive(Debug)]
struct Logged {
    what: &'static str,
    reason: String,
    at: Duration,
    left_out: u64,
}

impl Repeats {
    /// Returns how many failures like this were left out since the last entry if it is to be logged now.
    pub(super) fn record(&mut self, now: Duration, failure: Failure<'_>) -> Option<u64> {
        let Failure { what, reason } = failure;
        let is_recent = |one: &Logged| now.saturating_sub(one.at) < LOG_EVERY;
        let known = self
            .logged
            .iter_mut()
            .find(|one| one.what == what && one.reason == reason);
        if let Some(known) = known {
            if is_recent(known) {
                known.left_out += 1;
                return None;
            }
            known.at = now;
            return Some(std::mem::take(&mut known.left_out));
        }
        // A reason that was left out keeps its count until it is logged again or makes room.
        let of_kind = self.logged.iter().filter(|one| one.what == what);
        if of_kind.count() >= REASONS_MAX {
            let mut of_kind = self.logged.iter_mut().filter(|one| one.what == what);
            let Some(old) = of_kind.find(|one| !is_recent(one)) else {
                if let Some(last) = self.logged.iter_mut().rfind(|one| one.what == what) {
                    last.left_out += 1;
                }
                return None;
            };
            reason.clone_into(&mut old.reason);
            old.at = now;
            return Some(std::mem::take(&mut old.left_out));
        }
        self.logged.push(Logged {
            what,
            reason: reason.to_owned(),
            at: now,
            left_out: 0,
        });
        Some(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);
    const CLOCK: Failure<'_> = Failure {
        what: "sign in",
        reason: "wrong clock",
    };
    const SECRET: Failure<'_> = Failure {
        reason: "wrong secret",
        ..CLOCK
    };
    const READ: Failure<'_> = Failure {
        what: "read",
        ..CLOCK
    };

    #[test]
    fn each_reason_is_logged_at_once_and_its_repeats_are_counted() {
        let mut repeats = Repeats::default();
        assert_eq!(repeats.record(SECOND, CLOCK), Some(0));
        for _ in 0..5 {
            assert_eq!(repeats.record(2 * SECOND, CLOCK), None);
        }
        assert_eq!(repeats.record(2 * SECOND, SECRET), Some(0));
        assert_eq!(repeats.record(2 * SECOND, READ), Some(0));
        assert_eq!(repeats.record(31 * SECOND, CLOCK), Some(5));
        assert_eq!(repeats.record(32 * SECOND, CLOCK), None);
    }

    #[test]
    fn reasons_that_always_differ_are_limited_and_none_is_uncounted() {
        let mut repeats = Repeats::default();
        let (mut logged, mut left_out, failures) = (0, 0, 10_000_u64);
        for failure in 0..failures {
            let now = SECOND * u32::try_from(failure / 100).unwrap();
            let failure = Failure {
                reason: &failure.to_string(),
                ..CLOCK
            };
            if let Some(count) = repeats.record(now, failure) {
                logged += 1;
                left_out += count;
            }
        }
        assert_eq!(repeats.logged.len(), REASONS_MAX);
        assert!(logged <= 4 * REASONS_MAX as u64, "{logged}");
        let waiting: u64 = repeats.logged.iter().map(|one| one.left_out).sum();
        assert_eq!(logged + left_out + waiting, failures);
    }
}
