//! Random figures from one seed.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A source of random figures; equal seeds give equal figures.
#[derive(Debug, Clone)]
pub struct Random(ChaCha8Rng);

impl Random {
    /// The source of a seed.
    pub fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Uniform from `low` to `high`.
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.random::<f64>()
    }

    /// Uniform in the logarithm, both bounds above zero.
    pub fn log_uniform(&mut self, low: f64, high: f64) -> f64 {
        self.uniform(low.ln(), high.ln()).exp()
    }

    /// Normal with mean zero.
    pub fn normal(&mut self, std_dev: f64) -> f64 {
        // The first is in (0, 1], so that its logarithm is finite (Box and Muller).
        let radius = (-2.0 * (1.0 - self.0.random::<f64>()).ln()).sqrt();
        std_dev * radius * (std::f64::consts::TAU * self.0.random::<f64>()).cos()
    }

    /// True with that probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.0.random::<f64>() < probability
    }

    /// One of them; none of an empty list.
    pub fn one_of<T: Copy>(&mut self, of: &[T]) -> Option<T> {
        let index = self.0.random_range(0..of.len().max(1));
        of.get(index).copied()
    }
}
