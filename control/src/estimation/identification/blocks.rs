//! Sums over linearised blocks of measurements.

use super::parameters::{PARAMETERS, Square, Values};
use super::random_walk::RandomWalk;

/// Weighted sums over linearised blocks of measurements.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Blocks {
    /// `A = Σ Jᵀ W J`, the information matrix, and `b = Σ (Jᵀ W J p_b + g_b)`, the right side of the
    /// normal equations `A p = b`, with the scores `g_b = Jᵀ W r` at the parameters `p_b` of the blocks.
    pub(super) information: Square,
    pub(super) information_vector: Values,
    /// Sum of the blocks' weights, each at most 1.
    pub(super) count: f64,
}

impl Blocks {
    /// Returns the sums over no blocks.
    pub(super) fn none() -> Self {
        Self {
            information: Square::zeros(),
            information_vector: Values::zeros(),
            count: 0.0,
        }
    }

    /// Removes all blocks.
    pub(super) fn clear(&mut self) {
        let Self {
            information,
            information_vector,
            count,
        } = self;
        information.fill(0.0);
        information_vector.fill(0.0);
        *count = 0.0;
    }

    /// Multiplies the weights of all blocks.
    pub(super) fn multiply(&mut self, ratio: f64) {
        multiply(self.information.as_mut_slice(), ratio);
        multiply(self.information_vector.as_mut_slice(), ratio);
        self.count *= ratio;
    }

    /// Replaces each sum by what `combine` makes of it and of that of `other`. In place, because
    /// copies of the matrices would take most of the time.
    pub(super) fn combine(&mut self, other: &Self, combine: impl Fn(f64, f64) -> f64) {
        let all = |own: &mut [f64], other: &[f64]| {
            for (own, other) in own.iter_mut().zip(other) {
                *own = combine(*own, *other);
            }
        };
        all(
            self.information.as_mut_slice(),
            other.information.as_slice(),
        );
        all(
            self.information_vector.as_mut_slice(),
            other.information_vector.as_slice(),
        );
        self.count = combine(self.count, other.count);
    }

    /// Adds a random walk of a parameter since these blocks.
    pub(super) fn add_walk(&mut self, walk: &RandomWalk) {
        walk.add_to(&mut self.information, &mut self.information_vector);
    }

    /// Adds the sums of other blocks.
    pub(super) fn add(&mut self, other: &Self) {
        self.combine(other, |own, other| own + other);
    }

    /// Subtracts the sums of some of these blocks.
    pub(super) fn subtract(&mut self, other: &Self) {
        self.combine(other, |own, other| own - other);
    }
}

/// Multiplies values in place. On slices, because the iterators of matrices are not vectorised.
pub(super) fn multiply(values: &mut [f64], ratio: f64) {
    for value in values {
        *value *= ratio;
    }
}

/// Adds `weight · v vᵀ` to a matrix, in slices likewise: most of a comparison's time goes here.
pub(super) fn add_outer_square(matrix: &mut Square, weight: f64, vector: &Values) {
    let columns = matrix.as_mut_slice().chunks_exact_mut(PARAMETERS);
    for (column, factor) in columns.zip(vector.as_slice()) {
        let weighted = weight * factor;
        for (sum, value) in column.iter_mut().zip(vector.as_slice()) {
            *sum += weighted * value;
        }
    }
}
