//! Counts how long a channel has repeated the same value to the last bit, which a sensor with noise
//! never does.

use std::time::Duration;

/// Minimum time of equal values that counts as frozen.
const FROZEN_AFTER: Duration = Duration::from_millis(350);
/// Minimum number of equal values that counts as frozen.
const FROZEN_COUNT: u32 = 4;

/// Minimum time and number of equal values that count as repeating, and may prove to be frozen.
const REPEATING_AFTER: Duration = Duration::from_millis(150);
const REPEATING_COUNT: u32 = 3;

/// Consecutive equal values of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Repeats {
    words: [u64; 3],
    since: Option<Duration>,
    count: u32,
    duration: Duration,
}

impl Repeats {
    /// Adds the next measurement of the channel: up to three values, the others 0.
    pub(crate) fn take(&mut self, at: Duration, values: [f64; 3]) {
        let words = values.map(f64::to_bits);
        if self.since.is_none() || words != self.words {
            *self = Self {
                words,
                since: Some(at),
                count: 1,
                duration: Duration::ZERO,
            };
        } else {
            self.count = self.count.saturating_add(1);
            self.duration = at.saturating_sub(self.since.unwrap_or(at));
        }
    }

    /// Returns whether the values have been equal for [`FROZEN_AFTER`].
    pub(crate) fn is_frozen(&self) -> bool {
        self.have_lasted(FROZEN_AFTER, FROZEN_COUNT)
    }

    /// Returns whether the values have been equal for [`REPEATING_AFTER`], and may prove to be
    /// frozen.
    pub(crate) fn is_repeating(&self) -> bool {
        self.have_lasted(REPEATING_AFTER, REPEATING_COUNT)
    }

    /// Returns whether at least `count` values have been equal, over at least `duration`.
    pub(crate) fn have_lasted(&self, duration: Duration, count: u32) -> bool {
        self.count >= count && self.duration >= duration
    }

    /// Returns the time of the first of the equal values.
    pub(crate) fn since(&self) -> Option<Duration> {
        self.since
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_words_freeze_a_channel_and_one_other_word_ends_it() {
        let mut repeats = Repeats::default();
        for tick in 0..40_u32 {
            repeats.take(tick * Duration::from_millis(10), [0.3, 0.0, 0.0]);
            assert_eq!(repeats.is_frozen(), tick >= 35, "{tick}");
        }
        repeats.take(Duration::from_millis(400), [0.3 + 1.0e-12, 0.0, 0.0]);
        assert!(!repeats.is_frozen());
    }
}
