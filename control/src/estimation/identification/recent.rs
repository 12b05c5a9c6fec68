//! Median of the newest blocks' values.
//!
//! A wheel that is stopped at once, or one that starts with a jerk, gives one block values that are
//! hundreds of times those of the others. A mean would keep them for minutes; a median does not
//! see them (Huber, Robust Statistics, 1981, ch. 5).

/// Number of blocks that are remembered; odd, so that the median is one of them.
const BLOCKS_MAX: usize = 31;
/// Standard deviation over the median absolute deviation of normal values.
const NORMAL_MAD: f64 = 1.4826;
/// Variance of the median over that of the mean of normal values.
const MEDIAN_VARIANCE: f64 = 1.57;

/// The newest values, one for each block.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct RecentBlocks {
    values: [f64; BLOCKS_MAX],
    count: usize,
    next: usize,
    /// The same values in ascending order.
    sorted: [f64; BLOCKS_MAX],
}

impl RecentBlocks {
    /// Creates the memory without values.
    pub(super) const fn new() -> Self {
        Self {
            values: [0.0; BLOCKS_MAX],
            count: 0,
            next: 0,
            sorted: [0.0; BLOCKS_MAX],
        }
    }

    /// Adds the value of a block; the oldest of more than 31 is dropped. A value that is not
    /// finite is ignored.
    pub(super) fn add(&mut self, value: f64) {
        if !value.is_finite() {
            return;
        }
        let oldest = std::mem::replace(&mut self.values[self.next], value);
        self.next = (self.next + 1) % BLOCKS_MAX;
        if self.count == BLOCKS_MAX {
            let place = self.place(oldest);
            self.sorted.copy_within(place + 1.., place);
            self.count -= 1;
        }
        let place = self.place(value);
        self.sorted.copy_within(place..self.count, place + 1);
        self.sorted[place] = value;
        self.count += 1;
    }

    /// Returns the place of a value among the sorted ones.
    fn place(&self, value: f64) -> usize {
        self.known()
            .partition_point(|known| known.total_cmp(&value).is_lt())
    }

    fn known(&self) -> &[f64] {
        &self.sorted[..self.count]
    }

    /// Returns the number of remembered values, at most 31.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// Returns the median of the remembered values; None without any.
    pub(super) fn median(&self) -> Option<f64> {
        let upper = *self.known().get(self.count / 2)?;
        Some(if self.count % 2 == 1 {
            upper
        } else {
            0.5 * (self.sorted[self.count / 2 - 1] + upper)
        })
    }

    /// Returns the smallest remembered value that at least this share of all values, 0 to 1, does not exceed;
    /// None without any.
    pub(super) fn quantile(&self, share: f64) -> Option<f64> {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            clippy::cast_precision_loss,
            reason = "at most 31"
        )]
        let rank = (share * self.count as f64).ceil() as usize;
        self.known().get(rank.saturating_sub(1)).copied()
    }

    /// Returns the standard error of the median, from the median absolute deviation; infinite with
    /// less than two values.
    pub(super) fn std_error(&self) -> f64 {
        match self.median() {
            Some(median) if self.count > 1 => {
                let std_dev = NORMAL_MAD * self.median_deviation(median);
                #[expect(clippy::cast_precision_loss, reason = "at most 31")]
                let count = self.count as f64;
                std_dev * (MEDIAN_VARIANCE / count).sqrt()
            }
            _ => f64::INFINITY,
        }
    }

    /// Returns the median of the distances of all values from their `median`.
    fn median_deviation(&self, median: f64) -> f64 {
        let (mut below, mut above) = self.known().split_at(self.place(median));
        let (mut last, mut before_last) = (0.0, 0.0);
        for _ in 0..=self.count / 2 {
            let under = below.last().map_or(f64::INFINITY, |value| median - value);
            let over = above.first().map_or(f64::INFINITY, |value| value - median);
            before_last = last;
            if under < over {
                last = under;
                below = &below[..below.len() - 1];
            } else {
                last = over;
                above = &above[1..];
            }
        }
        if self.count % 2 == 1 {
            last
        } else {
            0.5 * (before_last + last)
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Median of values in any order.
    fn median_of(mut values: Vec<f64>) -> f64 {
        values.sort_by(f64::total_cmp);
        let middle = values.len() / 2;
        if values.len() % 2 == 1 {
            values[middle]
        } else {
            0.5 * (values[middle - 1] + values[middle])
        }
    }

    proptest! {
        #[test]
        fn median_and_error_are_those_of_the_newest_values(
            values in prop::collection::vec(prop_oneof![-1.0e3..1.0e3, Just(2.0), Just(-0.0)], 2..90),
        ) {
            let mut recent = RecentBlocks::new();
            for value in &values {
                recent.add(*value);
            }
            let newest = &values[values.len().saturating_sub(BLOCKS_MAX)..];
            let median = median_of(newest.to_vec());
            prop_assert_eq!(recent.median(), Some(median));
            prop_assert_eq!(recent.count(), newest.len());
            let off = newest.iter().map(|value| (value - median).abs()).collect();
            let count = f64::from(u8::try_from(newest.len()).expect("at most 31"));
            let error = NORMAL_MAD * median_of(off) * (MEDIAN_VARIANCE / count).sqrt();
            prop_assert_eq!(recent.std_error().to_bits(), error.to_bits());
        }
    }

    #[test]
    fn a_value_far_off_moves_the_median_to_a_neighbour_at_most() {
        let mut recent = RecentBlocks::new();
        assert_eq!(recent.median(), None);
        for value in [3.0, 1.0, 2.0, 5.0] {
            recent.add(value);
        }
        assert_eq!(recent.median(), Some(2.5));
        recent.add(1.0e9);
        assert_eq!(recent.median(), Some(3.0));
        recent.add(f64::NAN);
        assert_eq!((recent.median(), recent.count()), (Some(3.0), 5));
    }

    #[test]
    fn a_quantile_is_the_value_that_this_share_does_not_exceed() {
        let mut recent = RecentBlocks::new();
        assert_eq!(recent.quantile(0.8), None);
        for value in [4.0, 1.0, 5.0, 3.0, 2.0] {
            recent.add(value);
        }
        let found = [0.0, 0.2, 0.21, 0.8, 1.0].map(|share| recent.quantile(share));
        assert_eq!(found, [1.0, 1.0, 2.0, 4.0, 5.0].map(Some));
    }

    #[test]
    fn old_values_are_forgotten_and_the_error_falls_with_the_number() {
        let mut recent = RecentBlocks::new();
        let spread = |place: u32| f64::from(place % 5) - 2.0;
        for place in 0..10 {
            recent.add(spread(place));
        }
        let of_ten = recent.std_error();
        assert!(of_ten.is_finite() && of_ten > 0.0);
        for place in 0..30 {
            recent.add(spread(place));
        }
        assert!(recent.std_error() < of_ten);
        for _ in 0..BLOCKS_MAX {
            recent.add(7.0);
        }
        assert_eq!((recent.median(), recent.std_error()), (Some(7.0), 0.0));
    }
}
