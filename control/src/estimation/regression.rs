//! Additive sums of blocks, and the regression of slip on force with errors in variables.
//!
//! Parameters are `(θ, δ_c, δ_d)`; the rows are in the module above. For known noise `σ_x²` of the
//! force regressor the corrected normal matrix is `M = Σ_c (X_cᵀX_c − n σ_x² e₁e₁ᵀ)/s_c²` with
//! `s_c² = σ_y² + θ²σ_x²` (found by iteration), and the variance of θ is
//! `[M⁻¹]₁₁ + [M⁻¹]₁₁² Σ_c n (σ_x² s_c² + θ²σ_x⁴)/s_c⁴` (Fuller, Measurement Error Models, 1987).

use nalgebra::{Matrix3, Vector3};

use super::offsets::OffsetKnowledge;
use super::{
    BLOCKS_MIN, RELATIVE_STD_DEV_MAX, SLIP_LINEAR_FIRST_MAX, SLIP_LINEAR_MAX, THETA_FIRST,
    THETA_RANGE, ValueWithDeviation,
};

/// Rounds of the iteration on the weights.
const ROUNDS: usize = 5;
/// Share of a force's effect that the model may miss without the ground having changed.
const MODEL_SHARE: f64 = 0.05;
/// Signal over its own noise below which a regressor counts as unexcited.
const SIGNIFICANCE_MIN: f64 = 4.0;
/// Blocks from which on the residuals tell whether the assumed noise is too small.
const INFLATION_BLOCKS: f64 = 10.0;
/// Blocks of straight driving for a rolling resistance.
const RESISTANCE_BLOCKS_MIN: f64 = 10.0;

/// Force regressors of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Force {
    /// `μ_R u_R − μ_L u_L`, metres per second.
    pub(super) difference_m_s: f64,
    /// `(μ_R u_R + μ_L u_L)/2`, metres per second.
    pub(super) mean_m_s: f64,
    /// Variance of the former; that of the latter is a quarter of it.
    pub(super) difference_noise: f64,
}

/// Means over one block of samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Block {
    pub(super) duration_s: f64,
    /// Whether slip was in the linear range.
    pub(super) is_linear: bool,
    /// Geometric slip across of the slower side's wheels.
    pub(super) slip_lateral: f64,
    /// Larger friction coefficient along of both sides, measured.
    pub(super) mu_side: f64,
    /// Rim speed of the slower side, metres per second.
    pub(super) slower_m_s: f64,
    /// `u_R − u_L − Wφ̇`, metres per second, and its variance.
    pub(super) difference_m_s: f64,
    pub(super) difference_noise: f64,
    /// `(u_R + u_L)/2 − v`, metres per second, where body speed was new, and its variance.
    pub(super) slip_m_s: Option<f64>,
    pub(super) slip_noise: f64,
    /// `u_R − u_L`, metres per second.
    pub(super) rim_difference_m_s: f64,
    /// `(u_R + u_L)/2`, metres per second.
    pub(super) rim_mean_m_s: f64,
    pub(super) force: Option<Force>,
    /// `Wφ̇`, metres per second, and its variance.
    pub(super) turn_m_s: f64,
    pub(super) turn_noise: f64,
    /// Friction coefficient seen, less two standard deviations.
    pub(super) mu_seen: f64,
    pub(super) rolling_resistance: Option<f64>,
}

impl Block {
    /// How far the force difference stands out of its noise.
    pub(super) fn force_signal(&self) -> f64 {
        self.force.map_or(0.0, |force| {
            force.difference_m_s.abs() / force.difference_noise.sqrt().max(f64::MIN_POSITIVE)
        })
    }

    /// Whether slip was in the linear range, combined from along and across. Along it is θμ where
    /// θ is known, and above the peak μ stays high enough for that to tell. Before θ is known it
    /// comes from the body speed, which is coarse, so the bound is tighter.
    pub(super) fn slips_little(&self, theta: Option<f64>) -> bool {
        let (along, bound) = match (theta, self.slip_m_s) {
            (Some(theta), _) => (theta * self.mu_side, SLIP_LINEAR_MAX),
            (None, slip_m_s) => {
                let fastest_m_s = slip_m_s.unwrap_or(0.0).abs() + 0.5 * self.difference_m_s.abs();
                (fastest_m_s / self.slower_m_s, SLIP_LINEAR_FIRST_MAX)
            }
        };
        along.hypot(self.slip_lateral) < bound
    }

    fn difference_row(&self, force: &Force) -> Vector3<f64> {
        Vector3::new(
            force.difference_m_s,
            self.rim_difference_m_s,
            self.rim_mean_m_s,
        )
    }
}

/// Sums of one kind of row.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Channel {
    count: f64,
    square: Matrix3<f64>,
    product: Vector3<f64>,
    response: f64,
    /// Sum of the force regressor's variances.
    force_noise: f64,
    /// Sum of the response's variances.
    response_noise: f64,
}

impl Default for Channel {
    fn default() -> Self {
        Self {
            count: 0.0,
            square: Matrix3::zeros(),
            product: Vector3::zeros(),
            response: 0.0,
            force_noise: 0.0,
            response_noise: 0.0,
        }
    }
}

impl Channel {
    fn add(&mut self, row: Vector3<f64>, response: f64, force_noise: f64, response_noise: f64) {
        self.count += 1.0;
        self.square += row * row.transpose();
        self.product += row * response;
        self.response += response * response;
        self.force_noise += force_noise;
        self.response_noise += response_noise;
    }

    fn plus(&self, other: &Self) -> Self {
        Self {
            count: self.count + other.count,
            square: self.square + other.square,
            product: self.product + other.product,
            response: self.response + other.response,
            force_noise: self.force_noise + other.force_noise,
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
    pub(super) matrix: Matrix3<f64>,
    pub(super) right: Vector3<f64>,
    /// `Σ n (σ_x² s² + θ²σ_x⁴)/s⁴`.
    excess: f64,
    /// Standard deviation of the noise in the corrected `M₁₁`.
    pub(super) noise_std_dev: f64,
}

/// Additive sums over blocks.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Sums {
    /// Blocks that carry force in the linear range.
    pub(super) blocks: u64,
    pub(super) duration_s: f64,
    difference: Channel,
    mean: Channel,
    force_2: f64,
    force_4: f64,
    fast_blocks: f64,
    saturated_blocks: f64,
    mu_seen: f64,
    track_square: f64,
    track_product: f64,
    track_offset: [f64; 2],
    track_noise: f64,
    track_count: f64,
    resistance: f64,
    resistance_count: f64,
}

impl Sums {
    /// Adds a block.
    pub(super) fn add(&mut self, block: &Block) {
        self.fast_blocks += 1.0;
        if block.force.is_some() {
            self.mu_seen = self.mu_seen.max(block.mu_seen);
        }
        if !block.is_linear {
            self.saturated_blocks += 1.0;
            return;
        }
        // `u_R − u_L = (W_eff/W)·Wφ̇` plus what the offsets add.
        self.track_square += block.turn_m_s * block.turn_m_s - block.turn_noise;
        self.track_product += block.turn_m_s * block.rim_difference_m_s;
        self.track_offset[0] += block.turn_m_s * block.rim_difference_m_s;
        self.track_offset[1] += block.turn_m_s * block.rim_mean_m_s;
        self.track_noise += block.difference_noise;
        self.track_count += 1.0;
        let Some(force) = block.force else { return };
        self.blocks += 1;
        self.duration_s += block.duration_s;
        self.difference.add(
            block.difference_row(&force),
            block.difference_m_s,
            force.difference_noise,
            block.difference_noise,
        );
        if let Some(slip_m_s) = block.slip_m_s {
            let row = Vector3::new(
                force.mean_m_s,
                block.rim_mean_m_s,
                0.25 * block.rim_difference_m_s,
            );
            self.mean.add(
                row,
                slip_m_s,
                0.25 * force.difference_noise,
                block.slip_noise,
            );
        }
        self.force_2 += force.difference_m_s.powi(2);
        self.force_4 += force.difference_m_s.powi(4);
        if let Some(resistance) = block.rolling_resistance {
            self.resistance += resistance;
            self.resistance_count += 1.0;
        }
    }

    /// Sums of both.
    pub(super) fn plus(&self, other: &Self) -> Self {
        Self {
            blocks: self.blocks + other.blocks,
            duration_s: self.duration_s + other.duration_s,
            difference: self.difference.plus(&other.difference),
            mean: self.mean.plus(&other.mean),
            force_2: self.force_2 + other.force_2,
            force_4: self.force_4 + other.force_4,
            fast_blocks: self.fast_blocks + other.fast_blocks,
            saturated_blocks: self.saturated_blocks + other.saturated_blocks,
            mu_seen: self.mu_seen.max(other.mu_seen),
            track_square: self.track_square + other.track_square,
            track_product: self.track_product + other.track_product,
            track_offset: [
                self.track_offset[0] + other.track_offset[0],
                self.track_offset[1] + other.track_offset[1],
            ],
            track_noise: self.track_noise + other.track_noise,
            track_count: self.track_count + other.track_count,
            resistance: self.resistance + other.resistance,
            resistance_count: self.resistance_count + other.resistance_count,
        }
    }

    pub(super) fn normal(&self, theta: f64) -> Normal {
        let mut normal = Normal {
            matrix: Matrix3::zeros(),
            right: Vector3::zeros(),
            excess: 0.0,
            noise_std_dev: 0.0,
        };
        let mut noise_variance = 0.0;
        for channel in [&self.difference, &self.mean] {
            if channel.count < 1.0 {
                continue;
            }
            let spread = channel.spread(theta);
            let force_noise = channel.force_noise / channel.count;
            normal.matrix += channel.square / spread;
            normal.matrix[(0, 0)] -= channel.force_noise / spread;
            normal.right += channel.product / spread;
            normal.excess += channel.count * (force_noise * spread + (theta * force_noise).powi(2))
                / (spread * spread);
            noise_variance += 2.0 * channel.count * (force_noise / spread).powi(2);
        }
        normal.noise_std_dev = noise_variance.sqrt();
        normal
    }

    /// Estimates all parameters with what is known about the offsets; none without any force.
    pub(super) fn solve(&self, offsets: &OffsetKnowledge) -> Option<Solution> {
        self.solve_from(offsets, None)
    }

    /// As [`Self::solve`], with the weights of a given θ.
    pub(super) fn solve_from(
        &self,
        offsets: &OffsetKnowledge,
        theta_given: Option<f64>,
    ) -> Option<Solution> {
        if self.blocks == 0 {
            return None;
        }
        let mut theta_weights = theta_given.unwrap_or(THETA_FIRST);
        for round in 0..ROUNDS {
            let normal = self.normal(theta_weights);
            let mut matrix = normal.matrix;
            let mut right = normal.right;
            for row in 0..2 {
                right[row + 1] += offsets.weighted[row];
                for column in 0..2 {
                    matrix[(row + 1, column + 1)] += offsets.information[(row, column)];
                }
            }
            let covariance = matrix.cholesky()?.inverse();
            let parameters = covariance * right;
            let theta = parameters[0];
            if theta_given.is_some() || round + 1 == ROUNDS {
                let inflation = self.inflation(&parameters, theta_weights);
                let base = covariance[(0, 0)];
                return Some(Solution {
                    theta,
                    parameters,
                    covariance: covariance * inflation,
                    variance: base * inflation + base * base * normal.excess,
                    significance: 1.0 / (base * normal.noise_std_dev.max(f64::MIN_POSITIVE)),
                });
            }
            theta_weights = theta.clamp(*THETA_RANGE.start(), *THETA_RANGE.end());
        }
        None
    }

    /// How much larger the residuals are than the assumed noise; never below one.
    pub(super) fn inflation(&self, parameters: &Vector3<f64>, theta: f64) -> f64 {
        let mut squares = 0.0;
        let mut count = 0.0;
        for channel in [&self.difference, &self.mean] {
            if channel.count < 1.0 {
                continue;
            }
            let fitted = (channel.square * parameters).dot(parameters);
            let sum = channel.response - 2.0 * channel.product.dot(parameters) + fitted;
            squares += sum / channel.spread(theta);
            count += channel.count;
        }
        if count < INFLATION_BLOCKS {
            1.0
        } else {
            (squares / (count - 3.0)).max(1.0)
        }
    }

    /// Blocks weighed by their share of the force.
    pub(super) fn effective_samples(&self) -> f64 {
        if self.force_4 > 0.0 {
            self.force_2 * self.force_2 / self.force_4
        } else {
            0.0
        }
    }

    /// Friction coefficient that the ground has given at least.
    pub(super) fn mu_peak(&self) -> Option<f64> {
        (self.mu_seen > 0.0).then_some(self.mu_seen)
    }

    /// Share of blocks beyond the linear range.
    pub(super) fn saturation_share(&self) -> f64 {
        if self.fast_blocks > 0.0 {
            self.saturated_blocks / self.fast_blocks
        } else {
            0.0
        }
    }

    /// Rolling resistance over load.
    pub(super) fn rolling_resistance(&self) -> Option<f64> {
        (self.resistance_count >= RESISTANCE_BLOCKS_MIN)
            .then(|| self.resistance / self.resistance_count)
    }

    /// Effective track over W.
    pub(super) fn effective_track(&self, offsets: &OffsetKnowledge) -> Option<ValueWithDeviation> {
        if self.track_count < 1.0 || self.track_square <= 0.0 {
            return None;
        }
        let (common, difference) = offsets.values();
        let value = (self.track_product
            - common.value * self.track_offset[0]
            - difference.value * self.track_offset[1])
            / self.track_square;
        let noise = self.track_noise / self.track_count * (1.0 + value * value);
        let variance = noise / self.track_square
            + (common.std_dev * self.track_offset[0] / self.track_square).powi(2)
            + (difference.std_dev * self.track_offset[1] / self.track_square).powi(2);
        let std_dev = variance.sqrt();
        (std_dev < 0.1 * value).then_some(ValueWithDeviation { value, std_dev })
    }
}

/// Estimated parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Solution {
    pub(super) theta: f64,
    /// Variance of θ with that of the offsets and of the noisy regressor.
    pub(super) variance: f64,
    /// Corrected square of the force over its own noise.
    significance: f64,
    parameters: Vector3<f64>,
    covariance: Matrix3<f64>,
}

impl Solution {
    /// Whether the force varied enough, apart from the offsets, to call this a measurement.
    pub(super) fn is_measurement(&self, blocks: u64) -> bool {
        blocks >= BLOCKS_MIN
            && THETA_RANGE.contains(&self.theta)
            && self.variance.is_finite()
            && self.variance.sqrt() < RELATIVE_STD_DEV_MAX * self.theta
            && self.significance > SIGNIFICANCE_MIN
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
        let force = block.force.filter(|_| block.is_linear)?;
        let row = block.difference_row(&force);
        let error = block.difference_m_s - row.dot(&self.parameters);
        let missed =
            MODEL_SHARE * self.theta * (force.difference_m_s.abs() + 2.0 * force.mean_m_s.abs());
        let variance = block.difference_noise
            + self.theta.powi(2) * force.difference_noise
            + (self.covariance * row).dot(&row)
            + missed * missed;
        Some(error * force.difference_m_s.signum() / variance.sqrt())
    }
}
