//! Growth of the database file.

use std::collections::VecDeque;
use std::time::Duration;

/// Time over which the growth of the database is measured, and interval of its samples.
const GROWTH_SPAN: Duration = Duration::from_hours(1);
const GROWTH_EVERY: Duration = Duration::from_mins(1);
/// Time from which the growth is stated: a shorter one says little of an hour.
const GROWTH_MEASURED_AFTER: Duration = Duration::from_mins(10);

/// Sizes of the database in the last hour, one a minute.
#[derive(Debug, Default)]
pub(super) struct Growth(VecDeque<(Duration, u64)>);

impl Growth {
    /// Takes in a size, and returns the growth in bytes per hour if it has been measured for long
    /// enough.
    pub(super) fn record(&mut self, now: Duration, bytes: u64) -> Option<i64> {
        let is_old = |&(at, _): &(Duration, u64)| now.saturating_sub(at) > GROWTH_SPAN;
        while self.0.front().is_some_and(is_old) {
            self.0.pop_front();
        }
        let is_due = |&(at, _): &(Duration, u64)| now.saturating_sub(at) >= GROWTH_EVERY;
        if self.0.back().is_none_or(is_due) {
            self.0.push_back((now, bytes));
        }
        let &(since, before) = self.0.front()?;
        let span = now.saturating_sub(since);
        if span < GROWTH_MEASURED_AFTER {
            return None;
        }
        let grown = i128::from(bytes) - i128::from(before);
        let per_hour = grown * 3_600_000 / i128::try_from(span.as_millis()).ok()?;
        i64::try_from(per_hour).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_growth_of_the_database_is_that_of_the_last_hour() {
        let mut growth = Growth::default();
        let at = |minute: u64| Duration::from_secs(60 * minute);
        for minute in 0..10 {
            assert_eq!(growth.record(at(minute), 1_000 + minute), None, "{minute}");
        }
        assert_eq!(growth.record(at(10), 1_010), Some(60));
        for minute in 11..200 {
            growth.record(at(minute), 5_000);
            assert!(growth.0.len() <= 62, "{}", growth.0.len());
        }
        assert_eq!(growth.record(at(200), 4_000), Some(-1_000));
    }
}
