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
    median: f64,
    std_error: f64,
}

impl RecentBlocks {
    /// Creates the memory without values.
    pub(super) const fn new() -> Self {
        Self {
            values: [0.0; BLOCKS_MAX],
            count: 0,
            next: 0,
            median: 0.0,
            std_error: f64::INFINITY,
        }
    }

    /// Adds the value of a block; the oldest of more than 31 is dropped. A value that is not
    /// finite is ignored.
    pub(super) fn add(&mut self, value: f64) {
        if !value.is_finite() {
            return;
        }
        self.values[self.next] = value;
        self.next = (self.next + 1) % BLOCKS_MAX;
        self.count = (self.count + 1).min(BLOCKS_MAX);
        let known = &self.values[..self.count];
        self.median = median(known.iter().copied(), self.count);
        let off = known.iter().map(|value| (value - self.median).abs());
        let std_dev = NORMAL_MAD * median(off, self.count);
        #[expect(clippy::cast_precision_loss, reason = "at most 31")]
        let count = self.count as f64;
        self.std_error = if self.count > 1 {
            std_dev * (MEDIAN_VARIANCE / count).sqrt()
        } else {
            f64::INFINITY
        };
    }

    /// Returns the number of remembered values, at most 31.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// Returns the median of the remembered values; None without any.
    pub(super) fn median(&self) -> Option<f64> {
        (self.count > 0).then_some(self.median)
    }

    /// Returns the standard error of that median, from the median absolute deviation; infinite with
    /// less than two values.
    pub(super) fn std_error(&self) -> f64 {
        self.std_error
    }
}

/// Returns the median of `count` values, of which there are 1 to [`BLOCKS_MAX`].
fn median(values: impl Iterator<Item = f64>, count: usize) -> f64 {
    let mut sorted = [f64::INFINITY; BLOCKS_MAX];
    for (place, value) in sorted.iter_mut().zip(values) {
        *place = value;
    }
    sorted.sort_unstable_by(f64::total_cmp);
    let upper = sorted[count / 2];
    if count % 2 == 1 {
        upper
    } else {
        0.5 * (sorted[count / 2 - 1] + upper)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
