//! How long a channel has said the same to the last bit: what a sensor with noise never does.

use std::time::Duration;

/// Shortest time of equal words that counts as frozen.
const FROZEN_AFTER: Duration = Duration::from_millis(350);
/// Fewest equal words that count as frozen.
const FROZEN_COUNT: u32 = 4;

/// The same of those that may turn out to be frozen.
const REPEATING_AFTER: Duration = Duration::from_millis(150);
const REPEATING_COUNT: u32 = 3;

/// Equal words in a row.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Repeats {
    words: [u64; 3],
    since: Option<Duration>,
    count: u32,
    for_long: Duration,
}

impl Repeats {
    /// Takes the next word.
    pub(super) fn take(&mut self, at: Duration, values: [f64; 3]) {
        let words = values.map(f64::to_bits);
        if self.since.is_none() || words != self.words {
            *self = Self {
                words,
                since: Some(at),
                count: 1,
                for_long: Duration::ZERO,
            };
        } else {
            self.count = self.count.saturating_add(1);
            self.for_long = at.saturating_sub(self.since.unwrap_or(at));
        }
    }

    /// Whether they have been equal for long.
    pub(super) fn is_frozen(&self) -> bool {
        self.count >= FROZEN_COUNT && self.for_long >= FROZEN_AFTER
    }

    /// Whether they may turn out to be frozen: they have been equal for a while.
    pub(super) fn is_repeating(&self) -> bool {
        self.count >= REPEATING_COUNT && self.for_long >= REPEATING_AFTER
    }

    /// When the first of the equal words came.
    pub(super) fn since(&self) -> Option<Duration> {
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
