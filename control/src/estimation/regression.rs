//! Regression of slip on force with errors in variables.
//!
//! The rows are defined in [`super`] and [`super::longitudinal`]. With the known variance `σ_x²` of
//! the force regressor, the corrected normal matrix, summed over the channels c, is
//! `M = Σ_c (X_cᵀX_c − n σ_x² e₁e₁ᵀ)/s_c²` with `s_c² = σ_y² + θ²σ_x²` (found by iteration). The
//! variance of θ is `[M⁻¹]₁₁ + [M⁻¹]₁₁² Σ_c n (σ_x² s_c² + θ²σ_x⁴)/s_c⁴` (Fuller, Measurement Error
//! Models, 1987). The covariance of response and regressor noise, mainly of `u_R − u_L` in the
//! regressor of `δ_c`, is subtracted from their product; otherwise θ would be too small by up to a
//! third of its standard deviation.

use super::offsets::OffsetKnowledge;
use super::rows::{
    Channel, OFFSETS, ParameterMatrix, Parameters, RegressorMatrix, Regressors, Tangent, index,
};
use super::sums::Sums;
use super::{BLOCKS_MIN, RELATIVE_STD_DEV_MAX, ROLLING_STD_DEV, THETA_RANGE, TyrePrior};
use crate::estimation::block::Block;

/// Maximum number of iterations on the weights.
const ROUNDS: usize = 5;
/// Relative step of θ below which the iteration on the weights ends.
const CONVERGED: f64 = 1.0e-4;
/// Relative model error of a force's effect that does not count as a change of the ground.
const MODEL_SHARE: f64 = 0.05;
/// Signal-to-noise ratio below which the force regressor counts as unexcited.
const SIGNIFICANCE_MIN: f64 = 6.0;
/// Minimum number of rows for testing the assumed noise by the residuals.
const INFLATION_ROWS: f64 = 15.0;
/// Relative model error of the effect of curvature in rows on accelerations, which use the measured
/// variation of slip within their time, and κ to second order.
const CURVATURE_SHARE: f64 = 0.04;
/// Relative model error of the effect of curvature in rows on torques, which use the mean slip
/// only.
const CURVATURE_SHARE_TORQUE: f64 = 0.05;
/// Maximum fraction of a variance that the correlation of neighbouring rows may subtract.
const NEIGHBOURS_SHARE_MAX: f64 = 0.9;
/// Relative change of the inflation of residuals below which its iteration ends.
const INFLATION_SETTLED: f64 = 0.1;
/// Minimum fraction of the variance without the tyres' error in the total variance.
const OWN_SHARE_MIN: f64 = 0.01;
/// Minimum standard deviation of θκ, which keeps the matrix regular.
const CURVATURE_STD_DEV_MIN: f64 = 2.0e-4;

/// Normal equations `M p = b` of the parameters p for given weights.
pub(super) struct Normal {
    /// M, corrected for the noise of the regressors.
    pub(super) matrix: ParameterMatrix,
    /// b, the right side.
    pub(super) right: Parameters,
    /// `Σ n (σ_x² s² + θ²σ_x⁴)/s⁴`.
    excess: f64,
    /// Standard deviation of the noise in the corrected `M₁₁`.
    pub(super) noise_std_dev: f64,
    /// Prior information on θκ.
    curvature_weight: f64,
}

impl Normal {
    /// Sums the channels with weights at `theta`, linearised by `tangent`, and adds the prior of
    /// the tyres. `inflation` multiplies the variance of residuals.
    pub(super) fn of(
        channels: &[&Channel],
        theta: f64,
        tangent: Tangent,
        (tyres, inflation): (&TyrePrior, f64),
    ) -> Self {
        let mut normal = Self {
            matrix: ParameterMatrix::zeros(),
            right: Parameters::zeros(),
            excess: 0.0,
            noise_std_dev: 0.0,
            curvature_weight: tyres.curvature_std_dev.max(CURVATURE_STD_DEV_MIN).powi(-2),
        };
        let mut noise_variance = 0.0;
        let (mut square, mut product) = (RegressorMatrix::zeros(), Regressors::zeros());
        for channel in channels {
            if channel.count < 1.0 {
                continue;
            }
            let innovation_variance = channel.innovation_variance(theta) * inflation;
            let force_noise = channel.force_variance();
            channel.add_corrected(innovation_variance.recip(), &mut square, &mut product);
            normal.excess += channel.count
                * (force_noise * innovation_variance + (theta * force_noise).powi(2))
                / (innovation_variance * innovation_variance);
            noise_variance += 2.0 * channel.count * (force_noise / innovation_variance).powi(2);
        }
        // Both are linear, so that one reduction of the sums is enough.
        normal.matrix = tangent.of_pairs(&square);
        normal.right = tangent.of_parameters(&product);
        normal.noise_std_dev = noise_variance.sqrt();
        let known = normal.curvature_weight;
        normal.matrix[(index::CURVATURE, index::CURVATURE)] += known;
        normal.right[index::CURVATURE] += known * tyres.curvature;
        for (parameter, mean, std_dev) in drivetrain_priors(tyres) {
            let known = (theta * std_dev).powi(-2);
            normal.matrix[(parameter, parameter)] += known;
            normal.right[parameter] += known * theta * mean;
        }
        normal
    }

    /// Adds the prior of rolling resistance, unless it was added for this ground before.
    pub(super) fn with_resistance(mut self, offsets: &OffsetKnowledge, theta: f64) -> Self {
        if !offsets.knows_resistance {
            let resistance = (index::RESISTANCE, index::RESISTANCE);
            self.matrix[resistance] += (theta * ROLLING_STD_DEV).powi(-2);
        }
        self
    }

    /// Adds the information on the shared parameters.
    pub(super) fn with_offsets(mut self, offsets: &OffsetKnowledge) -> Self {
        let mut block = self.matrix.fixed_view_mut::<OFFSETS, OFFSETS>(1, 1);
        block += offsets.information;
        let mut right = self.right.fixed_rows_mut::<OFFSETS>(1);
        right += offsets.weighted;
        self
    }
}

/// Returns the priors of relaxation length, rotor inertia and load difference: the index of the
/// parameter, and mean and standard deviation of the parameter over θ.
pub(super) fn drivetrain_priors(tyres: &TyrePrior) -> [(usize, f64, f64); 3] {
    [
        (
            index::RELAXATION,
            tyres.relaxation_m,
            tyres.relaxation_std_dev_m.max(1.0e-5),
        ),
        (
            index::ROTORS,
            tyres.rotor_ratio,
            tyres.rotor_std_dev_ratio.max(1.0e-5),
        ),
        (index::LOADS, 0.0, tyres.load_difference_std_dev.max(1.0e-5)),
    ]
}

/// Returns the ratio of the residuals' variance to the assumed one if it is significantly above 1,
/// else 1.
pub(super) fn inflation(
    channels: &[&Channel],
    parameters: &Parameters,
    theta: f64,
    tangent: Tangent,
) -> f64 {
    let mut squares = 0.0;
    let mut count = 0.0;
    let coefficients = tangent.of_regressors(parameters);
    for channel in channels {
        if channel.count < 1.0 {
            continue;
        }
        squares += channel.squared_residuals(&coefficients) / channel.innovation_variance(theta);
        count += channel.count;
    }
    if count < INFLATION_ROWS {
        return 1.0;
    }
    // The standard deviation of the ratio is √(2/n).
    let freedom = count - 3.0;
    let ratio = squares / freedom;
    if ratio > 1.0 + 2.0 * (2.0 / freedom).sqrt() {
        ratio
    } else {
        1.0
    }
}

/// Returns the contribution of correlated neighbouring rows to the variance in the direction
/// `M⁻¹v`. It is negative for slowly varying forces, because the noise of a shared ramp enters both
/// rows with opposite signs.
fn neighbours(channels: &[&Channel], direction: &Parameters, theta: f64, tangent: Tangent) -> f64 {
    let coefficients = tangent.of_regressors(direction);
    let of_channel = |channel: &&Channel| {
        if channel.count < 1.0 {
            return 0.0;
        }
        let scale = theta / channel.innovation_variance(theta);
        channel.neighbours(&coefficients) * scale * scale
    };
    channels.iter().map(of_channel).sum()
}

/// Returns the ratio of the effect of curvature to that of θ alone.
fn curvature_effect_ratio(channels: &[&Channel], tangent: Tangent, curvature: f64) -> f64 {
    let mut sums = [0.0; 2];
    for channel in channels {
        let squares = channel.force_and_curvature(tangent, curvature);
        sums[0] += squares[0];
        sums[1] += squares[1];
    }
    if sums[0] > 0.0 {
        (sums[1] / sums[0]).sqrt()
    } else {
        0.0
    }
}

/// Input of [`solve`].
#[derive(Debug, Clone, Copy)]
pub(super) struct SolveInput<'known> {
    /// Information on the parameters that segments share.
    pub(super) offsets: &'known OffsetKnowledge,
    /// Prior of the tyres.
    pub(super) tyres: &'known TyrePrior,
    /// Fixed θ for the weights; `None` iterates it.
    pub(super) theta_given: Option<f64>,
    /// Initial θ of the iteration on the weights.
    pub(super) theta_start: f64,
}

/// Estimates all parameters; `None` without blocks or if the equations are singular.
pub(super) fn solve(sums: &Sums, input: SolveInput<'_>) -> Option<Solution> {
    if sums.blocks == 0 {
        return None;
    }
    let channels = sums.channels();
    let mut theta_weights = input.theta_given.unwrap_or(input.theta_start);
    let mut tyres = *input.tyres;
    let mut inflated = 1.0;
    let is_exact = input.tyres.unexplained_ratio <= 0.0;
    for round in 1..=ROUNDS {
        let tangent = Tangent::at(theta_weights, tyres.at(theta_weights));
        let normal = Normal::of(&channels, theta_weights, tangent, (input.tyres, inflated))
            .with_resistance(input.offsets, theta_weights)
            .with_offsets(input.offsets);
        let factors = normal.matrix.cholesky()?;
        let parameters = factors.solve(&normal.right);
        let theta = parameters[index::THETA];
        let next = theta.clamp(*THETA_RANGE.start(), *THETA_RANGE.end());
        if input.theta_given.is_none() {
            let mut curvature = Parameters::zeros();
            curvature[index::CURVATURE] = 1.0;
            let variance = factors.solve(&curvature)[index::CURVATURE];
            tyres = learned_tyres(&parameters, variance, input.tyres);
        }
        // Residuals larger than the noise reduce the weight of rows relative to the priors.
        let inflation = inflation(&channels, &parameters, theta_weights, tangent);
        let is_weighed = is_exact || (inflation - inflated).abs() <= INFLATION_SETTLED * inflated;
        let is_settled = (next - theta_weights).abs() < CONVERGED * theta_weights
            && Tangent::at(next, tyres.at(next)).is_near(tangent);
        if round == ROUNDS || is_weighed && (input.theta_given.is_some() || is_settled) {
            let covariance = factors.inverse();
            let base = covariance[(index::THETA, index::THETA)];
            let (theta, scale) = if sums.has_torque() {
                (theta, 0.0)
            } else {
                // Without torque the force is an acceleration, and slip is computed with a radius
                // that is too large by δ_c, so the estimated value is θ(1 − δ_c). With torque the
                // force is too large by the same ratio.
                (theta * (1.0 + parameters[index::RADIUS_OFFSET]), theta)
            };
            let cross = covariance[(index::THETA, index::RADIUS_OFFSET)];
            let own = covariance[(index::RADIUS_OFFSET, index::RADIUS_OFFSET)];
            let scaled = (2.0 * scale * cross + scale * scale * own).max(-0.5 * base);
            let mut of_theta = Parameters::zeros();
            of_theta[index::THETA] = 1.0;
            of_theta[index::RADIUS_OFFSET] = scale;
            let direction = covariance * of_theta;
            let neighbours = neighbours(&channels, &direction, theta_weights, tangent)
                .max(-NEIGHBOURS_SHARE_MAX * base);
            let curvature = parameters[index::CURVATURE] / parameters[index::THETA];
            let share = if sums.has_torque() {
                CURVATURE_SHARE_TORQUE
            } else {
                CURVATURE_SHARE
            };
            let of_curvature = share
                * parameters[index::THETA]
                * curvature_effect_ratio(&channels, tangent, curvature);
            // Residuals beyond the noise are model errors, which do not average out.
            let unexplained = input.tyres.unexplained_ratio
                * parameters[index::THETA]
                * (1.0 - inflated.recip()).sqrt();
            // With an exact model, larger residuals mean that the noise is larger than assumed.
            let noise_inflation = if is_exact { inflation } else { 1.0 };
            let model_error = of_curvature.hypot(unexplained);
            return Some(Solution {
                theta,
                parameters,
                covariance: covariance * noise_inflation,
                noise_inflation,
                of_theta,
                tangent,
                variance: (base + scaled + neighbours * inflated) * noise_inflation
                    + base * base * normal.excess
                    + model_error * model_error,
                model_error,
                tyre_variance: (direction[index::CURVATURE] * normal.curvature_weight.sqrt())
                    .powi(2)
                    * noise_inflation
                    + model_error * model_error,
                significance: 1.0 / (base * normal.noise_std_dev.max(f64::MIN_POSITIVE)),
            });
        }
        if !is_exact {
            inflated = inflation;
        }
        if input.theta_given.is_none() {
            theta_weights = next;
        }
    }
    None
}

/// Returns the tyres with the estimated curvature, given the variance of θκ, or `known` if the
/// estimate is not more precise.
fn learned_tyres(parameters: &Parameters, variance: f64, known: &TyrePrior) -> TyrePrior {
    let (curvature, std_dev) = (parameters[index::CURVATURE], variance.max(0.0).sqrt());
    if curvature.is_finite() && std_dev < known.curvature_std_dev {
        TyrePrior {
            curvature,
            curvature_std_dev: std_dev,
            ..*known
        }
    } else {
        *known
    }
}

/// Estimated parameters with their covariance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Solution {
    /// Estimated θ.
    pub(super) theta: f64,
    /// Variance of θ, including the errors of the offsets and of the noisy regressor.
    pub(super) variance: f64,
    /// Ratio of the corrected, centred square of the force to the standard deviation of its noise.
    significance: f64,
    parameters: Parameters,
    covariance: ParameterMatrix,
    /// Factor by which the covariance was inflated.
    noise_inflation: f64,
    /// Derivative of θ with respect to the parameters.
    of_theta: Parameters,
    /// Linearisation of products of θ and κ that was used.
    tangent: Tangent,
    /// Model error of θ by curvature and by unexplained residuals, equal in all solutions of a
    /// ground.
    model_error: f64,
    /// Part of the variance that is due to the tyres.
    tyre_variance: f64,
}

/// Covariance of the errors of two estimates of θ.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct SharedCovariance {
    /// Total covariance.
    pub(super) all: f64,
    /// Covariance without the part that a common error of the tyres explains.
    pub(super) own: f64,
}

impl Solution {
    /// Returns the covariance of the error of θ with that of `later`, which was solved from other
    /// rows with the knowledge of robot and tyres from these rows.
    ///
    /// The best estimate from all earlier rows has the same covariance with every unbiased estimate
    /// from a part of them, so the result holds for every part.
    pub(super) fn shared_with(
        &self,
        later: &Self,
        offsets: &OffsetKnowledge,
        tyres: &TyrePrior,
    ) -> SharedCovariance {
        let mine = self.covariance * self.of_theta;
        let its = later.covariance * later.of_theta / later.noise_inflation;
        let followed = offsets.information * its.fixed_rows::<OFFSETS>(1);
        let of_offsets = followed.dot(&mine.fixed_rows::<OFFSETS>(1));
        // An error of θκ changes the later θ by the weight of its prior.
        let width = tyres.curvature_std_dev.max(CURVATURE_STD_DEV_MIN);
        let of_curvature = its[index::CURVATURE] / (width * width) * mine[index::CURVATURE];
        let of_drive: f64 = drivetrain_priors(tyres)
            .iter()
            .map(|&(parameter, _, std_dev)| {
                its[parameter] / (self.theta * std_dev).powi(2) * mine[parameter]
            })
            .sum();
        let of_offsets = of_offsets + of_drive;
        let of_tyres = of_curvature + self.model_error * later.model_error;
        let explained = self.tyre_std_dev() * later.tyre_std_dev();
        SharedCovariance {
            all: of_offsets + of_tyres,
            own: of_offsets + (of_tyres - explained).max(0.0),
        }
    }

    /// Returns the standard deviation of the error that is due to the tyres.
    pub(super) fn tyre_std_dev(&self) -> f64 {
        self.tyre_variance.sqrt()
    }

    /// Returns the variance of θ without the part that is due to the tyres.
    pub(super) fn own_variance(&self) -> f64 {
        (self.variance - self.tyre_variance).max(OWN_SHARE_MIN * self.variance)
    }

    /// Returns whether θ counts as a measurement: the force was excited, enough blocks exist, and
    /// the relative standard deviation is small enough.
    pub(super) fn is_measurement(&self, blocks: u64) -> bool {
        blocks >= BLOCKS_MIN
            && THETA_RANGE.contains(&self.theta)
            && self.variance.is_finite()
            && self.variance.sqrt() < RELATIVE_STD_DEV_MAX * self.theta
            && self.significance > SIGNIFICANCE_MIN
    }

    /// Returns the tyres with the estimated curvature, or `known` if the estimate is not more
    /// precise.
    pub(super) fn tyres(&self, known: &TyrePrior) -> TyrePrior {
        let curvature = (index::CURVATURE, index::CURVATURE);
        learned_tyres(&self.parameters, self.covariance[curvature], known)
    }

    /// Returns whether a segment has information on θ, compared with the ground's `theta_ground`.
    pub(super) fn is_informative(&self, theta_ground: f64) -> bool {
        self.variance.is_finite()
            && self.variance > 0.0
            && self.variance.sqrt() < theta_ground
            && self.significance > SIGNIFICANCE_MIN
    }

    /// Returns the standardised innovation of a block, positive towards larger θ; `None` if the
    /// block is not in the linear range or has no differential row.
    pub(super) fn innovation(&self, block: &Block) -> Option<f64> {
        if !block.is_linear {
            return None;
        }
        let row = block.differential_row()?;
        let force = row.regressors[index::THETA];
        let regressors = self.tangent.of_parameters(&row.regressors);
        let error = row.response - regressors.dot(&self.parameters);
        let model_error = MODEL_SHARE * self.theta * (force.abs() + block.mean_force_m_s());
        let variance = row.innovation_variance
            + self.theta.powi(2) * row.force_noise
            + (self.covariance * regressors).dot(&regressors)
            + model_error * model_error;
        Some(error * force.signum() / variance.sqrt())
    }
}
