//! Reproducible random numbers from a seed.

use std::ops::Range;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Generator of random numbers; equal seeds give equal sequences.
#[derive(Debug, Clone)]
pub struct Random(ChaCha8Rng);

impl Random {
    /// Creates the generator of a seed.
    pub fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Returns the start of another sequence of the same seed, so that a new draw does not change the others.
    #[must_use]
    pub fn stream(&self, number: u64) -> Self {
        let mut own = self.0.clone();
        own.set_stream(number);
        Self(own)
    }

    /// Returns a uniformly distributed number in `range`.
    pub fn uniform(&mut self, range: Range<f64>) -> f64 {
        range.start + (range.end - range.start) * self.0.random::<f64>()
    }

    /// Returns a number in `range` whose logarithm is uniformly distributed; both bounds must be
    /// above zero.
    pub fn log_uniform(&mut self, range: Range<f64>) -> f64 {
        self.uniform(range.start.ln()..range.end.ln()).exp()
    }

    /// Returns a normally distributed number with mean zero.
    pub fn normal(&mut self, std_dev: f64) -> f64 {
        // Box–Muller transform; the argument of the logarithm is in (0, 1].
        let radius = (-2.0 * (1.0 - self.0.random::<f64>()).ln()).sqrt();
        std_dev * radius * (std::f64::consts::TAU * self.0.random::<f64>()).cos()
    }

    /// Returns true with this probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.0.random::<f64>() < probability
    }

    /// Returns one element of `of` with equal probabilities; `None` if it is empty.
    pub fn one_of<T: Copy>(&mut self, of: &[T]) -> Option<T> {
        let index = self.0.random_range(0..of.len().max(1));
        of.get(index).copied()
    }
}
