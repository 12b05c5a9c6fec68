//! Rows of the regression, and their additive sums.

use nalgebra::{SMatrix, SVector};

use super::types::Curvature;

/// Number of parameters.
pub(super) const PARAMETERS: usize = 12;
/// Number of parameters that all segments of a ground share: the robot's own and the rolling
/// resistance. They have the indices 1 to [`OFFSETS`].
pub(super) const OFFSETS: usize = 7;
/// Vector of parameters.
pub(super) type Parameters = SVector<f64, PARAMETERS>;
/// Matrix over pairs of parameters.
pub(super) type ParameterMatrix = SMatrix<f64, PARAMETERS, PARAMETERS>;
/// Number of regressors: those of the parameters, and of further products of θ and κ.
const REGRESSORS: usize = PARAMETERS + 3;
/// Vector of regressors.
pub(super) type Regressors = SVector<f64, REGRESSORS>;
/// Matrix over pairs of regressors.
pub(super) type RegressorMatrix = SMatrix<f64, REGRESSORS, REGRESSORS>;

/// Indices of parameters and regressors.
pub(super) mod index {
    /// θ.
    pub(in crate::estimation) const THETA: usize = 0;
    /// `δ_c`, mean relative error of the nominal rolling radii; positive if they are too large.
    pub(in crate::estimation) const RADIUS_OFFSET: usize = 1;
    /// `δ_d`, right minus left relative error of the nominal rolling radii.
    pub(in crate::estimation) const RADIUS_DIFFERENCE: usize = 2;
    /// `ε_w`, relative difference of `W_eff/W − 1` from `(L/W)²`.
    pub(in crate::estimation) const TRACK: usize = 3;
    /// `b_g`, the gyro's offset, radians per second.
    pub(in crate::estimation) const GYRO_OFFSET: usize = 4;
    /// `b_a`, the accelerometer's forward offset, metres per second squared.
    pub(in crate::estimation) const LONGITUDINAL_OFFSET: usize = 5;
    /// Relative scale error of the accelerometer; positive if it reads too little.
    pub(in crate::estimation) const LONGITUDINAL_SCALE: usize = 6;
    /// `θf`, θ times the rolling resistance coefficient in measured torques. It belongs to the
    /// ground and is reset on new ground.
    pub(in crate::estimation) const RESISTANCE: usize = 7;
    /// θκ, θ times the tyre's curvature per slip.
    pub(in crate::estimation) const CURVATURE: usize = 8;
    /// θℓ, θ times the contacts' relaxation length, metres: a rising force needs additional slip.
    pub(in crate::estimation) const RELAXATION: usize = 9;
    /// θj, θ times the inertia of rotors and wheels over the mass; its torque does not reach the
    /// contacts.
    pub(in crate::estimation) const ROTORS: usize = 10;
    /// θε, θ times the difference of the sides' loads over their sum, left minus right. The side
    /// with more load slips less.
    pub(in crate::estimation) const LOADS: usize = 11;
    /// θκ²; this and the following indices are of regressors only.
    pub(in crate::estimation) const CURVATURE_SQUARE: usize = 12;
    /// κ.
    pub(in crate::estimation) const CURVATURE_ALONE: usize = 13;
    /// θ²κ.
    pub(in crate::estimation) const THETA_CURVATURE: usize = 14;
}

/// Regressors that contain the noise of the force.
const FORCED: [usize; 4] = [
    index::THETA,
    index::CURVATURE,
    index::CURVATURE_SQUARE,
    index::THETA_CURVATURE,
];

/// Change of κ per slip, or of its square, below which its iteration ends.
const SETTLED: f64 = 1.0e-2;

/// Linearisation of products of θ and κ in the parameters θ and θκ. For κ with mean κ₀ and standard
/// deviation σ, `θκ² = 2κ₀·θκ + (σ² − κ₀²)·θ` on average.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Tangent {
    square_by_theta: f64,
    square_by_curvature: f64,
    theta: f64,
}

impl Tangent {
    /// Linearises at a θ above zero and a κ with its standard deviation.
    pub(super) fn at(theta: f64, known: Curvature) -> Self {
        Self {
            square_by_theta: known.std_dev.powi(2) - known.mean.powi(2),
            square_by_curvature: 2.0 * known.mean,
            theta,
        }
    }

    /// Returns whether κ of both linearisations differs by less than the convergence limit.
    pub(super) fn is_near(self, other: Self) -> bool {
        (self.square_by_curvature - other.square_by_curvature).abs() < SETTLED
            && (self.square_by_theta - other.square_by_theta).abs() < SETTLED
    }

    /// Returns the products of θ and κ as linear combinations of the parameters: index of the
    /// product, index of the parameter, coefficient.
    fn product_terms(self) -> [(usize, usize, f64); 4] {
        [
            (index::CURVATURE_SQUARE, index::THETA, self.square_by_theta),
            (
                index::CURVATURE_SQUARE,
                index::CURVATURE,
                self.square_by_curvature,
            ),
            (index::CURVATURE_ALONE, index::CURVATURE, self.theta.recip()),
            (index::THETA_CURVATURE, index::CURVATURE, self.theta),
        ]
    }

    /// Reduces regressors to those of the parameters.
    pub(super) fn of_parameters(self, regressors: &Regressors) -> Parameters {
        let mut found = regressors.fixed_rows::<PARAMETERS>(0).into_owned();
        for (from, to, by) in self.product_terms() {
            found[to] += by * regressors[from];
        }
        found
    }

    /// Extends parameters to coefficients of all regressors: the transpose of
    /// [`Tangent::of_parameters`].
    pub(super) fn of_regressors(self, parameters: &Parameters) -> Regressors {
        let mut found = Regressors::zeros();
        found.fixed_rows_mut::<PARAMETERS>(0).copy_from(parameters);
        for (from, to, by) in self.product_terms() {
            found[from] += by * parameters[to];
        }
        found
    }

    /// Reduces a matrix over pairs of regressors to one over pairs of parameters.
    pub(super) fn of_pairs(self, square: &RegressorMatrix) -> ParameterMatrix {
        let mut columns = *square;
        for (from, to, by) in self.product_terms() {
            for row in 0..REGRESSORS {
                columns[(row, to)] += by * square[(row, from)];
            }
        }
        let mut found = columns
            .fixed_view::<PARAMETERS, PARAMETERS>(0, 0)
            .into_owned();
        for column in 0..PARAMETERS {
            for (from, to, by) in self.product_terms() {
                found[(to, column)] += by * columns[(from, column)];
            }
        }
        found
    }
}

/// Regressors of a row that involve the curvature.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct CurvatureRegressors {
    /// Regressors of θκ and θκ².
    pub(super) curvature: [f64; 2],
    /// Regressors of κ and θ²κ.
    pub(super) theta: [f64; 2],
}

impl CurvatureRegressors {
    /// Writes the regressors to their indices.
    pub(super) fn write_to(&self, regressors: &mut Regressors) {
        regressors[index::CURVATURE] = self.curvature[0];
        regressors[index::CURVATURE_SQUARE] = self.curvature[1];
        regressors[index::CURVATURE_ALONE] = self.theta[0];
        regressors[index::THETA_CURVATURE] = self.theta[1];
    }
}

/// One linear equation: response = regressors · parameters + noise. By default the regressors are
/// free of noise.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Row {
    pub(super) regressors: Regressors,
    /// Slip, or innovation of the forward speed, metres per second; turn rate of a stopped robot,
    /// radians per second.
    pub(super) response: f64,
    /// Variance of the noise of the response, in its unit squared; in rows of the forward speed it
    /// includes that of the force.
    pub(super) innovation_variance: f64,
    /// Variance of the noise of the force, the regressor of θ, (m/s)².
    pub(super) force_noise: f64,
    /// Ratios of the regressors of θκ, θκ² and θ²κ to the force; they share its noise.
    pub(super) curvature_ratio: [f64; 3],
    /// Covariance of the other regressors' noise with that of the response: both contain rim speeds
    /// and turn rate.
    pub(super) common_noise: Regressors,
    /// Part of the force's variance by the gyro over the two ramps; each ramp is shared with a
    /// neighbouring row with the opposite sign.
    pub(super) ramp_noise: f64,
    /// Variance of the force's rate, the regressor of θℓ.
    pub(super) rate_noise: f64,
}

/// Sums over the rows of one kind.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Channel {
    /// Number of rows.
    pub(super) count: f64,
    /// `Σ xxᵀ` of the regressors x.
    square: RegressorMatrix,
    /// `Σ xy` with the response y.
    product: Regressors,
    /// `Σ y²`.
    pub(super) response: f64,
    /// Sum of the covariances of the regressors [`FORCED`] by the noise of the force.
    force_noise: SMatrix<f64, 4, 4>,
    common_noise: Regressors,
    /// `Σ (x xᵀ′ + x′ xᵀ) cov` over neighbouring rows x, x′ whose force noise has this covariance.
    neighbours: RegressorMatrix,
    /// Sum of the variances of the response.
    response_noise: f64,
    /// Sum of the variances of the force's rate.
    rate_noise: f64,
}

impl Default for Channel {
    fn default() -> Self {
        Self {
            count: 0.0,
            square: RegressorMatrix::zeros(),
            product: Regressors::zeros(),
            response: 0.0,
            force_noise: SMatrix::zeros(),
            common_noise: Regressors::zeros(),
            neighbours: RegressorMatrix::zeros(),
            response_noise: 0.0,
            rate_noise: 0.0,
        }
    }
}

impl Channel {
    /// Adds a row, whose `innovation_variance` must be that of the response alone.
    pub(super) fn add(&mut self, row: &Row) {
        self.count += 1.0;
        self.square += row.regressors * row.regressors.transpose();
        self.product += row.regressors * row.response;
        self.response += row.response * row.response;
        let shares = SVector::from([
            1.0,
            row.curvature_ratio[0],
            row.curvature_ratio[1],
            row.curvature_ratio[2],
        ]);
        self.force_noise += shares * shares.transpose() * row.force_noise;
        self.common_noise += row.common_noise;
        self.response_noise += row.innovation_variance;
        self.rate_noise += row.rate_noise;
    }

    /// Adds the covariance of a row with its predecessor, with which it shares a ramp.
    pub(super) fn add_neighbour_covariance(&mut self, row: &Row, before: &Row) {
        let covariance = -0.5 * (row.ramp_noise * before.ramp_noise).sqrt();
        let product = row.regressors * before.regressors.transpose();
        self.neighbours += (product + product.transpose()) * covariance;
    }

    /// Adds a row scaled to unit innovation variance, which includes the noise of the force at
    /// `theta`.
    pub(super) fn add_standardised(&mut self, row: &Row, theta: f64) {
        let force_noise = row.force_noise / row.innovation_variance;
        let scale = row.innovation_variance.sqrt().recip();
        self.add(&Row {
            common_noise: row.common_noise * (scale * scale),
            regressors: row.regressors * scale,
            response: row.response * scale,
            innovation_variance: (1.0 - theta * theta * force_noise).max(0.1),
            force_noise,
            curvature_ratio: row.curvature_ratio,
            ramp_noise: 0.0,
            rate_noise: row.rate_noise * (scale * scale),
        });
    }

    /// Returns the sums over the rows of both operands.
    pub(super) fn plus(&self, other: &Self) -> Self {
        if other.count == 0.0 {
            return *self;
        }
        Self {
            count: self.count + other.count,
            square: self.square + other.square,
            product: self.product + other.product,
            response: self.response + other.response,
            force_noise: self.force_noise + other.force_noise,
            common_noise: self.common_noise + other.common_noise,
            neighbours: self.neighbours + other.neighbours,
            response_noise: self.response_noise + other.response_noise,
            rate_noise: self.rate_noise + other.rate_noise,
        }
    }

    /// Returns the mean innovation variance of the rows at a θ, `s² = σ_y² + θ²σ_x²`.
    pub(super) fn innovation_variance(&self, theta: f64) -> f64 {
        self.response_noise / self.count + theta * theta * self.force_variance()
    }

    /// Returns the mean variance `σ_x²` of the force regressor.
    pub(super) fn force_variance(&self) -> f64 {
        self.force_noise[(0, 0)] / self.count
    }

    /// Returns the sum of squared residuals of these coefficients of all regressors, including the
    /// noise of the regressors.
    pub(super) fn squared_residuals(&self, coefficients: &Regressors) -> f64 {
        let fitted = (self.square * coefficients).dot(coefficients);
        self.response - 2.0 * self.product.dot(coefficients) + fitted
    }

    /// Adds `Σ xxᵀ` and `Σ xy`, both multiplied by `weight`: the first minus the noise of the force
    /// and of its rate, the second minus the common noise of regressors and response.
    pub(super) fn add_corrected(
        &self,
        weight: f64,
        square: &mut RegressorMatrix,
        product: &mut Regressors,
    ) {
        for (sum, own) in square.as_mut_slice().iter_mut().zip(self.square.as_slice()) {
            *sum += own * weight;
        }
        square[(index::RELAXATION, index::RELAXATION)] -= self.rate_noise * weight;
        for (row, row_of) in FORCED.into_iter().enumerate() {
            for (column, column_of) in FORCED.into_iter().enumerate() {
                square[(row_of, column_of)] -= self.force_noise[(row, column)] * weight;
            }
        }
        *product += (self.product - self.common_noise) * weight;
    }

    /// Returns the variance of a linear function of the regressors, given its coefficients, that
    /// the covariances of neighbouring rows contribute.
    pub(super) fn neighbours(&self, coefficients: &Regressors) -> f64 {
        (self.neighbours * coefficients).dot(coefficients)
    }

    /// Returns the squared effects of the forces by θ alone and by the curvature κ, over the
    /// variance of the response.
    pub(super) fn force_and_curvature(&self, tangent: Tangent, curvature: f64) -> [f64; 2] {
        let noise = (self.response_noise / self.count.max(1.0)).max(f64::MIN_POSITIVE);
        let mut coefficients = Regressors::zeros();
        coefficients[index::CURVATURE] = curvature;
        coefficients[index::CURVATURE_SQUARE] = curvature * curvature;
        coefficients[index::CURVATURE_ALONE] = curvature / tangent.theta;
        coefficients[index::THETA_CURVATURE] = curvature * tangent.theta;
        let square = (self.square * coefficients).dot(&coefficients);
        [
            self.square[(index::THETA, index::THETA)] / noise,
            square / noise,
        ]
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn rows_of_the_parameters_say_what_rows_of_all_regressors_say(
            values in prop::collection::vec(-2.0..2.0_f64, REGRESSORS),
            parameters in prop::collection::vec(-2.0..2.0_f64, PARAMETERS),
            theta in 0.02..4.0_f64, curvature in 0.0..3.0_f64, curvature_spread in 0.0..1.0_f64,
        ) {
            let known = Curvature { mean: curvature, std_dev: curvature_spread };
            let tangent = Tangent::at(theta, known);
            let row = Regressors::from_column_slice(&values);
            let parameters = Parameters::from_column_slice(&parameters);
            let mut all = Regressors::zeros();
            all.fixed_rows_mut::<PARAMETERS>(0).copy_from(&parameters);
            let (of_theta, of_curvature) = (parameters[index::THETA], parameters[index::CURVATURE]);
            all[index::CURVATURE_SQUARE] =
                tangent.square_by_theta * of_theta + tangent.square_by_curvature * of_curvature;
            all[index::CURVATURE_ALONE] = of_curvature / theta;
            all[index::THETA_CURVATURE] = of_curvature * theta;
            let said = row.dot(&all);
            let lean = tangent.of_parameters(&row).dot(&parameters);
            prop_assert!((lean - said).abs() < 1.0e-9 * (1.0 + said.abs()));
            prop_assert!((row.dot(&tangent.of_regressors(&parameters)) - said).abs()
                < 1.0e-9 * (1.0 + said.abs()));
            let square = tangent.of_pairs(&(row * row.transpose()));
            let twice = (square * parameters).dot(&parameters);
            prop_assert!((twice - said * said).abs() < 1.0e-8 * (1.0 + said * said));
        }
    }
}
