//! A parameter that changes as a random walk.

use super::parameters::{PRIOR_RANGE, Prior, Square, Values, index};

/// Random walk of one parameter since the last block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct RandomWalk {
    /// Place of the parameter in [`Values`].
    pub(super) place: usize,
    /// Variance of its change, in its squared unit.
    pub(super) variance: f64,
}

impl RandomWalk {
    /// Creates the walk of the gyro's offset in a time.
    pub(super) fn of_gyro(prior: &Prior, time_s: f64) -> Self {
        Self {
            place: index::GYRO_OFFSET,
            variance: prior.gyro_walk * time_s,
        }
    }

    /// Adds the walk to a prior, whose range for the parameter grows with it.
    pub(super) fn add_to_prior(&self, prior: &mut Prior) {
        self.add_to(&mut prior.information, &mut prior.information_vector);
        let range = &mut prior.ranges[self.place];
        *range = range.hypot(PRIOR_RANGE * self.variance.sqrt());
    }

    /// Adds the walk to an estimate in information form: the estimate stays, and the parameter's variance
    /// grows by that of the walk.
    ///
    /// With the information matrix A, its column a for the parameter and the variance q of the walk, the
    /// covariance `A⁻¹ + q e eᵀ` has the inverse `A − q a aᵀ/(1 + q a_e)` (Sherman and Morrison).
    pub(super) fn add_to(&self, information: &mut Square, vector: &mut Values) {
        let column: Values = information.column(self.place).into();
        let ratio = self.variance / (1.0 + self.variance * column[self.place]);
        vector.axpy(-ratio * vector[self.place], &column, 1.0);
        information.ger(-ratio, &column, &column, 1.0);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::parameters::{self, PARAMETERS};
    use super::*;
    use crate::estimation::{EstimatorPrior, SensorNoise};

    proptest! {
        #[test]
        fn a_walk_adds_its_variance_and_keeps_the_estimate(
            rows in prop::collection::vec(-2.0..2.0, 3 * PARAMETERS), std_devs in 0.0..3.0_f64,
        ) {
            let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
            let (mut information, mut vector) = (prior.information, prior.information_vector);
            for row in rows.chunks(PARAMETERS) {
                let slopes = Values::from_column_slice(row).component_div(&prior.std_devs);
                information.ger(1.0, &slopes, &slopes, 1.0);
                vector += slopes;
            }
            let walk = RandomWalk {
                place: index::GYRO_OFFSET,
                variance: (std_devs * prior.std_devs[index::GYRO_OFFSET]).powi(2),
            };
            let before = information.cholesky().expect("it has the prior").inverse();
            let estimate = before * vector;
            walk.add_to(&mut information, &mut vector);
            let mut expected = before;
            expected[(walk.place, walk.place)] += walk.variance;
            let after = information.cholesky().expect("it has the prior").inverse();
            let moved = after * vector - estimate;
            for row in 0..PARAMETERS {
                prop_assert!(moved[row].abs() < 1.0e-6 * prior.std_devs[row], "{} {}", row, moved[row]);
                for column in 0..PARAMETERS {
                    let unit = prior.std_devs[row] * prior.std_devs[column];
                    let off = (after - expected)[(row, column)].abs();
                    prop_assert!(off < 1.0e-6 * unit, "{} {} {}", row, column, off);
                }
            }
        }
    }
}
