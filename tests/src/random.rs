//! Random numbers that a seed repeats: `SplitMix64`, enough for choosing what to break and when.

use std::ops::Range;

/// A sequence of random numbers.
#[derive(Debug, Clone)]
pub struct Random {
    state: u64,
}

impl Random {
    /// The sequence of a seed.
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// The next number.
    pub fn next_u64(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.state;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    /// A number from 0 to below 1.
    #[expect(clippy::cast_precision_loss, reason = "53 bits are what an f64 holds")]
    pub fn share(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Returns a uniformly distributed number in `range`.
    pub fn between(&mut self, range: Range<f64>) -> f64 {
        range.start + self.share() * (range.end - range.start)
    }

    /// True in so many of all cases.
    pub fn chance(&mut self, share: f64) -> bool {
        self.share() < share
    }

    /// An index below `count`, which must not be 0.
    pub fn index(&mut self, count: usize) -> usize {
        let count = u64::try_from(count).unwrap_or(1).max(1);
        usize::try_from(self.next_u64() % count).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seed_repeats_and_shares_stay_in_their_range() {
        let (mut first, mut second) = (Random::new(7), Random::new(7));
        let mut other = Random::new(8);
        let mut mean = 0.0;
        for _ in 0..1_000 {
            let share = first.share();
            assert!((0.0..1.0).contains(&share));
            assert!((share - second.share()).abs() < f64::EPSILON);
            mean += share / 1_000.0;
            assert!(other.index(3) < 3);
        }
        assert!((mean - 0.5).abs() < 0.05, "{mean}");
    }
}
