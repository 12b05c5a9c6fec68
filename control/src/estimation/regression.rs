//! The regression of slip on force with errors in variables.
//!
//! Rows are in [`super`] and [`super::longitudinal`]. For known noise `σ_x²` of the force regressor the
//! corrected normal matrix is `M = Σ_c (X_cᵀX_c − n σ_x² e₁e₁ᵀ)/s_c²` with `s_c² = σ_y² + θ²σ_x²`
//! (found by iteration), and the variance of θ is
//! `[M⁻¹]₁₁ + [M⁻¹]₁₁² Σ_c n (σ_x² s_c² + θ²σ_x⁴)/s_c⁴` (Fuller, Measurement Error Models, 1987).
//! Noise that the response shares with another regressor, `u_R − u_L` beside `δ_c` above all, is
//! taken out of their product: θ would read low by up to a third of its standard deviation.

use super::offsets::OffsetKnowledge;
use super::rows::{Channel, OFFSETS, ParameterMatrix, Parameters, Tangent, index};
use super::sums::Sums;
use super::{BLOCKS_MIN, RELATIVE_STD_DEV_MAX, THETA_RANGE, TyrePrior};
use crate::estimation::block::Block;

/// Rounds of the iteration on the weights.
const ROUNDS: usize = 5;
/// Relative step of θ at which that iteration ends.
const CONVERGED: f64 = 1.0e-4;
/// Share of a force's effect that the model may miss without the ground having changed.
const MODEL_SHARE: f64 = 0.05;
/// Signal over its own noise below which the regressor counts as unexcited.
const SIGNIFICANCE_MIN: f64 = 6.0;
/// Rows from which on the residuals tell whether the assumed noise is too small.
const INFLATION_ROWS: f64 = 15.0;
/// How large rolling resistance over load may be, one standard deviation.
const ROLLING_SPREAD: f64 = 0.02;
/// Share of the effect of curved tyres that rows on accelerations may miss: they hold what swings
/// in their time by its measured shape, and κ to second order.
const BEND_SHARE: f64 = 0.04;
/// The same of rows on torques, which know their slip by its mean only.
const BEND_SHARE_TORQUE: f64 = 0.05;
/// Most of a variance that neighbouring rows may take from it.
const NEIGHBOURS_SHARE_MAX: f64 = 0.9;
/// Relative change of how much larger residuals are at which the search for it ends.
const INFLATION_SETTLED: f64 = 0.1;
/// Least share of a variance that is the estimate's own.
const OWN_SHARE_MIN: f64 = 0.01;
/// Least standard deviation of θκ, so that the matrix stays regular.
const CURVATURE_STD_DEV_MIN: f64 = 2.0e-4;

/// Normal equations at one choice of weights.
pub(super) struct Normal {
    pub(super) matrix: ParameterMatrix,
    pub(super) right: Parameters,
    /// `Σ n (σ_x² s² + θ²σ_x⁴)/s⁴`.
    excess: f64,
    /// Standard deviation of the noise in the corrected `M₁₁`.
    pub(super) noise_std_dev: f64,
    /// Information on θκ that was there before.
    curvature_weight: f64,
}

impl Normal {
    /// Of these channels, with what is known about the tyres, at this θ and near this κ.
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
        for channel in channels {
            if channel.count < 1.0 {
                continue;
            }
            let innovation_variance = channel.innovation_variance(theta) * inflation;
            let force_noise = channel.force_variance();
            normal.matrix += channel.corrected_square(tangent) / innovation_variance;
            normal.right += channel.corrected_product(tangent) / innovation_variance;
            normal.excess += channel.count
                * (force_noise * innovation_variance + (theta * force_noise).powi(2))
                / (innovation_variance * innovation_variance);
            noise_variance += 2.0 * channel.count * (force_noise / innovation_variance).powi(2);
        }
        normal.noise_std_dev = noise_variance.sqrt();
        let known = normal.curvature_weight;
        normal.matrix[(index::CURVATURE, index::CURVATURE)] += known;
        normal.right[index::CURVATURE] += known * tyres.curvature;
        for (parameter, mean, std_dev) in drive_known(tyres) {
            let known = (theta * std_dev).powi(-2);
            normal.matrix[(parameter, parameter)] += known;
            normal.right[parameter] += known * theta * mean;
        }
        normal
    }

    /// Adds how large rolling resistance may be at this θ, where this ground has not shown it yet.
    pub(super) fn with_resistance(mut self, offsets: &OffsetKnowledge, theta: f64) -> Self {
        if !offsets.knows_resistance {
            let resistance = (index::RESISTANCE, index::RESISTANCE);
            self.matrix[resistance] += (theta * ROLLING_SPREAD).powi(-2);
        }
        self
    }

    /// Adds what is known about the robot's own parameters.
    pub(super) fn with_offsets(mut self, offsets: &OffsetKnowledge) -> Self {
        let mut block = self.matrix.fixed_view_mut::<OFFSETS, OFFSETS>(1, 1);
        block += offsets.information;
        let mut right = self.right.fixed_rows_mut::<OFFSETS>(1);
        right += offsets.weighted;
        self
    }
}

/// What is known of relaxation, rotors and loads: which parameter over θ, its mean and standard deviation.
pub(super) fn drive_known(tyres: &TyrePrior) -> [(usize, f64, f64); 3] {
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

/// How much larger the residuals are than the assumed noise; never below one.
pub(super) fn inflation(
    channels: &[&Channel],
    parameters: &Parameters,
    theta: f64,
    tangent: Tangent,
) -> f64 {
    let mut squares = 0.0;
    let mut count = 0.0;
    for channel in channels {
        if channel.count < 1.0 {
            continue;
        }
        let fitted = (channel.square(tangent) * parameters).dot(parameters);
        let sum = channel.response - 2.0 * channel.product(tangent).dot(parameters) + fitted;
        squares += sum / channel.innovation_variance(theta);
        count += channel.count;
    }
    if count < INFLATION_ROWS {
        return 1.0;
    }
    // Chance alone makes the ratio vary by √(2/n).
    let freedom = count - 3.0;
    let ratio = squares / freedom;
    if ratio > 1.0 + 2.0 * (2.0 / freedom).sqrt() {
        ratio
    } else {
        1.0
    }
}

/// What neighbouring rows add to the variance in the direction `M⁻¹v`; below zero where the force
/// changes slowly, since what one row has too much of a ramp the next has too little.
fn neighbours(channels: &[&Channel], direction: &Parameters, theta: f64, tangent: Tangent) -> f64 {
    let of_channel = |channel: &&Channel| {
        if channel.count < 1.0 {
            return 0.0;
        }
        let scale = theta / channel.innovation_variance(theta);
        (channel.neighbours(tangent) * direction).dot(direction) * scale * scale
    };
    channels.iter().map(of_channel).sum()
}

/// How large the effect of the bend is beside that of θ alone.
fn bend_ratio(channels: &[&Channel], tangent: Tangent, curvature: f64) -> f64 {
    let mut sums = [0.0; 2];
    for channel in channels {
        let squares = channel.force_and_bend(tangent, curvature);
        sums[0] += squares[0];
        sums[1] += squares[1];
    }
    if sums[0] > 0.0 {
        (sums[1] / sums[0]).sqrt()
    } else {
        0.0
    }
}

/// What a solution starts from.
#[derive(Debug, Clone, Copy)]
pub(super) struct SolveInput<'known> {
    pub(super) offsets: &'known OffsetKnowledge,
    pub(super) tyres: &'known TyrePrior,
    /// Weights of this θ and no other; `None` finds its own.
    pub(super) theta_given: Option<f64>,
    /// Where the search for weights starts.
    pub(super) theta_start: f64,
}

/// Estimates all parameters; none without any excitation.
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
        let covariance = normal.matrix.cholesky()?.inverse();
        let parameters = covariance * normal.right;
        let theta = parameters[index::THETA];
        let next = theta.clamp(*THETA_RANGE.start(), *THETA_RANGE.end());
        if input.theta_given.is_none() {
            tyres = learned_tyres(&parameters, &covariance, input.tyres);
        }
        // Where residuals are larger than the noise explains, rows say less beside what was known.
        let inflation = inflation(&channels, &parameters, theta_weights, tangent);
        let is_weighed = is_exact || (inflation - inflated).abs() <= INFLATION_SETTLED * inflated;
        let is_settled = (next - theta_weights).abs() < CONVERGED * theta_weights
            && Tangent::at(next, tyres.at(next)).is_near(tangent);
        if round == ROUNDS || is_weighed && (input.theta_given.is_some() || is_settled) {
            let base = covariance[(index::THETA, index::THETA)];
            let (theta, scale) = if sums.has_torque() {
                (theta, 0.0)
            } else {
                // Force over load is then an acceleration, and the slip that stands for it is
                // computed with a radius too large by δ_c: what is estimated is θ(1 − δ_c). Torque
                // reads too high by just that share.
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
                BEND_SHARE_TORQUE
            } else {
                BEND_SHARE
            };
            let bent = share * parameters[index::THETA] * bend_ratio(&channels, tangent, curvature);
            // What residuals show beyond the noise is no noise: it does not average out.
            let unexplained = input.tyres.unexplained_ratio
                * parameters[index::THETA]
                * (1.0 - inflated.recip()).sqrt();
            // Of an exact model, what residuals show is that the noise is larger than assumed.
            let noisier = if is_exact { inflation } else { 1.0 };
            let missed = bent.hypot(unexplained);
            return Some(Solution {
                theta,
                parameters,
                covariance: covariance * noisier,
                noisier,
                of_theta,
                tangent,
                variance: (base + scaled + neighbours * inflated) * noisier
                    + base * base * normal.excess
                    + missed * missed,
                missed,
                tyre_variance: (direction[index::CURVATURE] * normal.curvature_weight.sqrt())
                    .powi(2)
                    * noisier
                    + missed * missed,
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

/// What a solution tells about the tyres' curvature beyond what was known.
fn learned_tyres(
    parameters: &Parameters,
    covariance: &ParameterMatrix,
    known: &TyrePrior,
) -> TyrePrior {
    let variance = covariance[(index::CURVATURE, index::CURVATURE)];
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

/// Estimated parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Solution {
    pub(super) theta: f64,
    /// Variance of θ with that of the offsets and of the noisy regressor.
    pub(super) variance: f64,
    /// Corrected, centred square of the force over its own noise.
    significance: f64,
    parameters: Parameters,
    covariance: ParameterMatrix,
    /// Share by which the covariance was enlarged beside what was known.
    noisier: f64,
    /// How θ follows from the parameters.
    of_theta: Parameters,
    /// θκ² as it was computed with.
    tangent: Tangent,
    /// What rows to second order may miss of curved tyres, in θ; alike everywhere.
    missed: f64,
    /// The part of the variance that comes from what was not known of the tyres.
    tyre_variance: f64,
}

/// What two estimates of θ have in common, as the covariance of their errors.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Shared {
    /// Whatever it comes from.
    pub(super) all: f64,
    /// Without what one error of the tyres explains, as large in each as it says of itself.
    pub(super) own: f64,
}

impl Solution {
    /// Covariance of θ's error here with that of θ of other rows, which were solved with what
    /// these rows tell of the robot and its tyres: what all of them share.
    ///
    /// An estimate that is the best one of all rows before has the same covariance with any
    /// unbiased one of a part of them, so it does not matter which part those others were.
    pub(super) fn shared_with(
        &self,
        later: &Self,
        offsets: &OffsetKnowledge,
        tyres: &TyrePrior,
    ) -> Shared {
        let mine = self.covariance * self.of_theta;
        let its = later.covariance * later.of_theta / later.noisier;
        let followed = offsets.information * its.fixed_rows::<OFFSETS>(1);
        let of_offsets = followed.dot(&mine.fixed_rows::<OFFSETS>(1));
        // What moves θκ moves the later θ by as much as its prior weighs.
        let width = tyres.curvature_std_dev.max(CURVATURE_STD_DEV_MIN);
        let of_curvature = its[index::CURVATURE] / (width * width) * mine[index::CURVATURE];
        let of_drive: f64 = drive_known(tyres)
            .iter()
            .map(|&(parameter, _, std_dev)| {
                its[parameter] / (self.theta * std_dev).powi(2) * mine[parameter]
            })
            .sum();
        let of_offsets = of_offsets + of_drive;
        let of_tyres = of_curvature + self.missed * later.missed;
        let explained = self.tyre_std_dev() * later.tyre_std_dev();
        Shared {
            all: of_offsets + of_tyres,
            own: of_offsets + (of_tyres - explained).max(0.0),
        }
    }

    /// Standard deviation of the error that comes from what was not known of the tyres.
    pub(super) fn tyre_std_dev(&self) -> f64 {
        self.tyre_variance.sqrt()
    }

    /// Variance of θ without that of the tyres.
    pub(super) fn own_variance(&self) -> f64 {
        (self.variance - self.tyre_variance).max(OWN_SHARE_MIN * self.variance)
    }

    /// Whether the force varied enough, apart from the offsets, to call this a measurement.
    pub(super) fn is_measurement(&self, blocks: u64) -> bool {
        blocks >= BLOCKS_MIN
            && THETA_RANGE.contains(&self.theta)
            && self.variance.is_finite()
            && self.variance.sqrt() < RELATIVE_STD_DEV_MAX * self.theta
            && self.significance > SIGNIFICANCE_MIN
    }

    /// What this tells about the tyres' curvature beyond what was known.
    pub(super) fn tyres(&self, known: &TyrePrior) -> TyrePrior {
        learned_tyres(&self.parameters, &self.covariance, known)
    }

    /// Whether a segment's sums carry information at all, judged by the ground's θ.
    pub(super) fn is_informative(&self, theta_ground: f64) -> bool {
        self.variance.is_finite()
            && self.variance > 0.0
            && self.variance.sqrt() < theta_ground
            && self.significance > SIGNIFICANCE_MIN
    }

    /// Standardised innovation of a block in the direction of θ.
    pub(super) fn innovation(&self, block: &Block) -> Option<f64> {
        if !block.is_linear {
            return None;
        }
        let row = block.differential_row()?;
        let force = row.regressors[index::THETA];
        let regressors = self.tangent.of_parameters(&row.regressors);
        let error = row.response - regressors.dot(&self.parameters);
        let missed = MODEL_SHARE * self.theta * (force.abs() + block.mean_force_m_s());
        let variance = row.innovation_variance
            + self.theta.powi(2) * row.force_noise
            + (self.covariance * regressors).dot(&regressors)
            + missed * missed;
        Some(error * force.signum() / variance.sqrt())
    }
}
