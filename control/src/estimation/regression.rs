//! The regression of slip on force with errors in variables.
//!
//! Rows are in [`super`] and [`super::along`]. For known noise `σ_x²` of the force regressor the
//! corrected normal matrix is `M = Σ_c (X_cᵀX_c − n σ_x² e₁e₁ᵀ)/s_c²` with `s_c² = σ_y² + θ²σ_x²`
//! (found by iteration), and the variance of θ is
//! `[M⁻¹]₁₁ + [M⁻¹]₁₁² Σ_c n (σ_x² s_c² + θ²σ_x⁴)/s_c⁴` (Fuller, Measurement Error Models, 1987).
//! Noise that the response shares with another regressor, `u_R − u_L` beside `δ_c` above all, is
//! taken out of their product: θ would read low by up to a third of its deviation.

use nalgebra::{SMatrix, SVector};

use super::offsets::OffsetKnowledge;
use super::sums::Sums;
use super::{BLOCKS_MIN, RELATIVE_STD_DEV_MAX, THETA_RANGE, TyrePrior};
use crate::estimation::block::Block;

/// Number of parameters.
pub(super) const PARAMETERS: usize = 9;
/// Number of the parameters that all segments of a ground share, which follow θ: the robot's own,
/// and the rolling resistance.
pub(super) const OFFSETS: usize = 7;
/// A value for each parameter.
pub(super) type Parameters = SVector<f64, PARAMETERS>;
/// A value for each pair of parameters.
pub(super) type ParameterMatrix = SMatrix<f64, PARAMETERS, PARAMETERS>;

/// Which parameter stands where.
pub(super) mod index {
    /// θ.
    pub(in crate::estimation) const THETA: usize = 0;
    /// `δ_c`, mean share by which nominal radii are too large.
    pub(in crate::estimation) const RADIUS_OFFSET: usize = 1;
    /// `δ_d`, right minus left of the same.
    pub(in crate::estimation) const RADIUS_DIFFERENCE: usize = 2;
    /// `ε_w`, by which `W_eff/W − 1` differs from `(L/W)²`, as a share of the latter.
    pub(in crate::estimation) const TRACK: usize = 3;
    /// `b_g`, the gyro's offset, radians per second.
    pub(in crate::estimation) const GYRO_OFFSET: usize = 4;
    /// `b_a`, the accelerometer's offset ahead, metres per second squared.
    pub(in crate::estimation) const AHEAD_OFFSET: usize = 5;
    /// Share by which the accelerometer reads too little.
    pub(in crate::estimation) const AHEAD_SCALE: usize = 6;
    /// `θf`, θ times the rolling resistance over load that measured torques hold. It is the
    /// ground's: new ground forgets it.
    pub(in crate::estimation) const RESISTANCE: usize = 7;
    /// θκ, θ times the tyre's curvature per slip.
    pub(in crate::estimation) const CURVATURE: usize = 8;
}

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
/// Share of the effect of curved tyres that the rows may miss: they hold it to second order.
const BEND_SHARE: f64 = 0.05;
/// Most of a variance that neighbouring rows may take from it.
const NEIGHBOURS_SHARE_MAX: f64 = 0.9;
/// Least spread of a tyre's curvature, so that the matrix stays regular.
const CURVATURE_SPREAD_MIN: f64 = 1.0e-3;

/// One equation, linear in the parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Row {
    pub(super) regressors: Parameters,
    pub(super) response: f64,
    /// Variance of the response, with that of the force at the θ of the time.
    pub(super) spread: f64,
    /// Variance of the force regressor.
    pub(super) force_noise: f64,
    /// The force's share in the regressor of θκ, which has the same noise.
    pub(super) bend: f64,
    /// Covariance of the other regressors' noise with that of the response: rim speeds and turn
    /// rate stand on both sides.
    pub(super) common_noise: Parameters,
    /// The part of the force's variance that is the gyro's over two ramps, each shared with a
    /// neighbouring row with the other sign.
    pub(super) ramp_noise: f64,
}

impl Row {
    /// A row whose regressors are known.
    pub(super) fn white(regressors: Parameters, response: f64, spread: f64) -> Self {
        Self {
            regressors,
            response,
            spread,
            force_noise: 0.0,
            bend: 0.0,
            common_noise: Parameters::zeros(),
            ramp_noise: 0.0,
        }
    }
}

/// Sums of one kind of row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Channel {
    pub(super) count: f64,
    square: ParameterMatrix,
    product: Parameters,
    response: f64,
    /// Sum of the force regressor's variances.
    force_noise: f64,
    /// The same times the share in θκ's regressor, and times its square.
    bent_noise: [f64; 2],
    common_noise: Parameters,
    /// `Σ (x xᵀ′ + x′ xᵀ) cov` over neighbouring rows x, x′ whose force noise has this covariance.
    neighbours: ParameterMatrix,
    /// Sum of the response's variances.
    response_noise: f64,
}

impl Default for Channel {
    fn default() -> Self {
        Self {
            count: 0.0,
            square: ParameterMatrix::zeros(),
            product: Parameters::zeros(),
            response: 0.0,
            force_noise: 0.0,
            bent_noise: [0.0; 2],
            common_noise: Parameters::zeros(),
            neighbours: ParameterMatrix::zeros(),
            response_noise: 0.0,
        }
    }
}

impl Channel {
    /// Adds a row; its `spread` is that of the response alone.
    pub(super) fn add(&mut self, row: &Row) {
        self.count += 1.0;
        self.square += row.regressors * row.regressors.transpose();
        self.product += row.regressors * row.response;
        self.response += row.response * row.response;
        self.force_noise += row.force_noise;
        self.bent_noise[0] += row.force_noise * row.bend;
        self.bent_noise[1] += row.force_noise * row.bend * row.bend;
        self.common_noise += row.common_noise;
        self.response_noise += row.spread;
    }

    /// Notes that a row that was added stands next to another one: they share a ramp.
    pub(super) fn note_neighbour(&mut self, row: &Row, before: &Row) {
        let covariance = -0.5 * (row.ramp_noise * before.ramp_noise).sqrt();
        let product = row.regressors * before.regressors.transpose();
        self.neighbours += (product + product.transpose()) * covariance;
    }

    /// Adds a row in units of its own spread, which holds the force's noise at this θ.
    pub(super) fn add_standardised(&mut self, row: &Row, theta: f64) {
        let force_noise = row.force_noise / row.spread;
        let scale = row.spread.sqrt().recip();
        self.add(&Row {
            common_noise: row.common_noise * (scale * scale),
            regressors: row.regressors * scale,
            response: row.response * scale,
            spread: (1.0 - theta * theta * force_noise).max(0.1),
            force_noise,
            bend: row.bend,
            ramp_noise: 0.0,
        });
    }

    pub(super) fn plus(&self, other: &Self) -> Self {
        Self {
            count: self.count + other.count,
            square: self.square + other.square,
            product: self.product + other.product,
            response: self.response + other.response,
            force_noise: self.force_noise + other.force_noise,
            bent_noise: [
                self.bent_noise[0] + other.bent_noise[0],
                self.bent_noise[1] + other.bent_noise[1],
            ],
            common_noise: self.common_noise + other.common_noise,
            neighbours: self.neighbours + other.neighbours,
            response_noise: self.response_noise + other.response_noise,
        }
    }

    /// `s²` at a θ.
    fn spread(&self, theta: f64) -> f64 {
        (self.response_noise + theta * theta * self.force_noise) / self.count
    }
}

/// Normal equations at one choice of weights.
pub(super) struct Normal {
    pub(super) matrix: ParameterMatrix,
    pub(super) right: Parameters,
    /// `Σ n (σ_x² s² + θ²σ_x⁴)/s⁴`.
    excess: f64,
    /// Standard deviation of the noise in the corrected `M₁₁`.
    pub(super) noise_std_dev: f64,
}

impl Normal {
    /// Of these channels, with what is known about the tyres.
    pub(super) fn of(channels: &[&Channel], theta: f64, tyres: &TyrePrior) -> Self {
        let mut normal = Self {
            matrix: ParameterMatrix::zeros(),
            right: Parameters::zeros(),
            excess: 0.0,
            noise_std_dev: 0.0,
        };
        let mut noise_variance = 0.0;
        for channel in channels {
            if channel.count < 1.0 {
                continue;
            }
            let spread = channel.spread(theta);
            let force_noise = channel.force_noise / channel.count;
            normal.matrix += channel.square / spread;
            normal.matrix[(index::THETA, index::THETA)] -= channel.force_noise / spread;
            let [cross, bent] = channel.bent_noise.map(|noise| noise / spread);
            normal.matrix[(index::THETA, index::CURVATURE)] -= cross;
            normal.matrix[(index::CURVATURE, index::THETA)] -= cross;
            normal.matrix[(index::CURVATURE, index::CURVATURE)] -= bent;
            normal.right += (channel.product - channel.common_noise) / spread;
            normal.excess += channel.count * (force_noise * spread + (theta * force_noise).powi(2))
                / (spread * spread);
            noise_variance += 2.0 * channel.count * (force_noise / spread).powi(2);
        }
        normal.noise_std_dev = noise_variance.sqrt();
        // θκ is κ₀θ, give or take.
        let curvature_std_dev = theta * tyres.curvature_spread.max(CURVATURE_SPREAD_MIN);
        let mut bend = Parameters::zeros();
        bend[index::THETA] = -tyres.curvature / curvature_std_dev;
        bend[index::CURVATURE] = 1.0 / curvature_std_dev;
        normal.matrix += bend * bend.transpose();
        normal
    }

    /// Adds how large rolling resistance may be at this θ, where the ground has not told yet.
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

/// How much larger the residuals are than the assumed noise; never below one.
pub(super) fn inflation(channels: &[&Channel], parameters: &Parameters, theta: f64) -> f64 {
    let mut squares = 0.0;
    let mut count = 0.0;
    for channel in channels {
        if channel.count < 1.0 {
            continue;
        }
        let fitted = (channel.square * parameters).dot(parameters);
        let sum = channel.response - 2.0 * channel.product.dot(parameters) + fitted;
        squares += sum / channel.spread(theta);
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
fn neighbours(channels: &[&Channel], direction: &Parameters, theta: f64) -> f64 {
    let of_channel = |channel: &&Channel| {
        if channel.count < 1.0 {
            return 0.0;
        }
        let scale = theta / channel.spread(theta);
        (channel.neighbours * direction).dot(direction) * scale * scale
    };
    channels.iter().map(of_channel).sum()
}

/// How large the regressor of θκ is beside that of θ.
fn bend_ratio(channels: &[&Channel]) -> f64 {
    let sum = |parameter: usize| {
        let squares = channels.iter().map(|channel| {
            let noise = (channel.response_noise / channel.count.max(1.0)).max(f64::MIN_POSITIVE);
            channel.square[(parameter, parameter)] / noise
        });
        squares.sum::<f64>()
    };
    let own = sum(index::THETA);
    if own > 0.0 {
        (sum(index::CURVATURE) / own).sqrt()
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
    for round in 1..=ROUNDS {
        let normal = Normal::of(&channels, theta_weights, input.tyres)
            .with_resistance(input.offsets, theta_weights)
            .with_offsets(input.offsets);
        let covariance = normal.matrix.cholesky()?.inverse();
        let parameters = covariance * normal.right;
        let theta = parameters[index::THETA];
        let next = theta.clamp(*THETA_RANGE.start(), *THETA_RANGE.end());
        let is_settled = (next - theta_weights).abs() < CONVERGED * theta_weights;
        if input.theta_given.is_some() || round == ROUNDS || is_settled {
            let inflation = inflation(&channels, &parameters, theta_weights);
            let base = covariance[(index::THETA, index::THETA)];
            let (theta, scale) = if sums.has_torque() {
                (theta, 0.0)
            } else {
                // Force over load is then an acceleration, and the slip that stands for it is
                // reckoned with a radius too large by δ_c: what is estimated is θ(1 − δ_c). Torque
                // reads too high by just that share.
                (theta * (1.0 + parameters[index::RADIUS_OFFSET]), theta)
            };
            let across = covariance[(index::THETA, index::RADIUS_OFFSET)];
            let own = covariance[(index::RADIUS_OFFSET, index::RADIUS_OFFSET)];
            let scaled = (2.0 * scale * across + scale * scale * own).max(-0.5 * base);
            let mut of_theta = Parameters::zeros();
            of_theta[index::THETA] = 1.0;
            of_theta[index::RADIUS_OFFSET] = scale;
            let direction = covariance * of_theta;
            let neighbours =
                neighbours(&channels, &direction, theta_weights).max(-NEIGHBOURS_SHARE_MAX * base);
            let missed = BEND_SHARE * parameters[index::CURVATURE] * bend_ratio(&channels);
            return Some(Solution {
                theta,
                parameters,
                covariance: covariance * inflation,
                inflation,
                of_theta,
                variance: (base + scaled + neighbours) * inflation
                    + base * base * normal.excess
                    + missed * missed,
                missed,
                significance: 1.0 / (base * normal.noise_std_dev.max(f64::MIN_POSITIVE)),
            });
        }
        theta_weights = next;
    }
    None
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
    /// Share of the covariance by which residuals were larger than assumed.
    inflation: f64,
    /// How θ follows from the parameters.
    of_theta: Parameters,
    /// What rows to second order may miss of curved tyres, in θ; alike everywhere.
    missed: f64,
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
    ) -> f64 {
        let mine = self.covariance * self.of_theta;
        let its = later.covariance * later.of_theta / later.inflation;
        let followed = offsets.information * its.fixed_rows::<OFFSETS>(1);
        let of_offsets = followed.dot(&mine.fixed_rows::<OFFSETS>(1));
        // θκ = κθ give or take: what moves κ moves θ by as much as that prior weighs.
        let theta = self.parameters[index::THETA];
        let curvature = self.parameters[index::CURVATURE] / theta;
        let bend = (mine[index::CURVATURE] - curvature * mine[index::THETA]) / theta;
        let width = theta * tyres.curvature_spread.max(CURVATURE_SPREAD_MIN);
        let gain =
            (its[index::CURVATURE] - tyres.curvature * its[index::THETA]) * theta / (width * width);
        of_offsets + gain * bend + self.missed * later.missed
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
        let variance = self.covariance[(index::CURVATURE, index::CURVATURE)];
        let cross = self.covariance[(index::CURVATURE, index::THETA)];
        let own = self.covariance[(index::THETA, index::THETA)];
        let curvature = self.parameters[index::CURVATURE] / self.parameters[index::THETA];
        let of_ratio = variance - 2.0 * curvature * cross + curvature * curvature * own;
        let spread = of_ratio.max(0.0).sqrt() / self.parameters[index::THETA].abs();
        if curvature.is_finite() && spread.is_finite() && spread < known.curvature_spread {
            TyrePrior {
                curvature,
                curvature_spread: spread,
                ..*known
            }
        } else {
            *known
        }
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
        let error = row.response - row.regressors.dot(&self.parameters);
        let missed = MODEL_SHARE * self.theta * (force.abs() + block.mean_force_m_s());
        let variance = row.spread
            + self.theta.powi(2) * row.force_noise
            + (self.covariance * row.regressors).dot(&row.regressors)
            + missed * missed;
        Some(error * force.signum() / variance.sqrt())
    }
}
