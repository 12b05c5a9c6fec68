//! Additive sums over blocks, independent of their order.

use super::ValueWithStdDev;
use super::block::Block;
use super::demonstrated_friction::DemonstratedFriction;
use super::offsets::OffsetKnowledge;
use super::rows::{Channel, Row, index};

/// Minimum number of blocks of straight driving for an estimate of rolling resistance.
const RESISTANCE_BLOCKS_MIN: f64 = 10.0;
/// Relative standard deviation above which there is no estimate of the effective track width.
const TRACK_STD_DEV_MAX: f64 = 0.1;

/// Additive sums over blocks.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Sums {
    /// Number of blocks in the linear range with a row.
    pub(super) blocks: u64,
    pub(super) duration_s: f64,
    /// Sums of the rows of the sides' difference, from measured torques.
    difference: Channel,
    /// Sums of the rows of the sides' mean, from measured torques.
    mean: Channel,
    /// Sums of the rows of the moment balance, from measured accelerations.
    turning: Channel,
    /// Sums of the innovations of the forward speed, scaled to unit variance.
    longitudinal: Channel,
    /// Sums of the rows' squared force over their variance, and of the square of that.
    signal: f64,
    signal_2: f64,
    /// Number of blocks with sufficient speed, and of those beyond the linear range.
    fast_blocks: f64,
    saturated_blocks: f64,
    friction: DemonstratedFriction,
    /// Sum of the squares of the blocks' slip.
    slip_square: f64,
    /// Regression of `u_R − u_L` on Wφ̇: square and product, products with the regressors of `δ_c`
    /// and `δ_d`, noise variance, and number of blocks.
    track_square: f64,
    track_product: f64,
    track_offset: [f64; 2],
    track_noise: f64,
    track_count: f64,
    /// Sums of the rolling resistance coefficients, their number, and their variances.
    resistance: f64,
    resistance_count: f64,
    resistance_noise: f64,
}

impl Sums {
    /// Adds a block.
    pub(super) fn add(&mut self, block: &Block) {
        self.fast_blocks += 1.0;
        if block.force.is_some() {
            self.friction.add(block.mu_demonstrated);
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
        let Some(row) = block.differential_row() else {
            return;
        };
        self.blocks += 1;
        self.duration_s += block.duration_s;
        self.slip_square += block.slip * block.slip;
        self.add_signal(&row, row.innovation_variance);
        if block.force.is_some() {
            self.difference.add(&row);
            if let Some(row) = block.mean_row() {
                self.mean.add(&row);
            }
        } else {
            self.turning.add(&row);
        }
        if let Some(resistance) = block.rolling_resistance {
            self.resistance += resistance.value;
            self.resistance_noise += resistance.std_dev.powi(2);
            self.resistance_count += 1.0;
        }
    }

    /// Adds the covariance of a block's row with that of the block directly before.
    pub(super) fn add_neighbour_covariance(&mut self, row: &Row, before: &Row) {
        self.turning.add_neighbour_covariance(row, before);
    }

    /// Adds an innovation of the forward speed, with its weight at `theta`.
    pub(super) fn add_longitudinal(&mut self, row: &Row, theta: f64) {
        self.longitudinal.add_standardised(row, theta);
        self.add_signal(row, row.innovation_variance);
    }

    fn add_signal(&mut self, row: &Row, innovation_variance: f64) {
        let signal = row.regressors[index::THETA].powi(2) / innovation_variance;
        self.signal += signal;
        self.signal_2 += signal * signal;
    }

    /// Returns the sums over the blocks of both operands.
    pub(super) fn plus(&self, other: &Self) -> Self {
        Self {
            blocks: self.blocks + other.blocks,
            duration_s: self.duration_s + other.duration_s,
            difference: self.difference.plus(&other.difference),
            mean: self.mean.plus(&other.mean),
            turning: self.turning.plus(&other.turning),
            longitudinal: self.longitudinal.plus(&other.longitudinal),
            signal: self.signal + other.signal,
            signal_2: self.signal_2 + other.signal_2,
            fast_blocks: self.fast_blocks + other.fast_blocks,
            saturated_blocks: self.saturated_blocks + other.saturated_blocks,
            friction: self.friction.plus(&other.friction),
            slip_square: self.slip_square + other.slip_square,
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
            resistance_noise: self.resistance_noise + other.resistance_noise,
        }
    }

    /// Returns the sums of all kinds of rows.
    pub(super) fn channels(&self) -> [&Channel; 4] {
        [
            &self.difference,
            &self.mean,
            &self.turning,
            &self.longitudinal,
        ]
    }

    /// Returns the root mean square of the blocks' slip.
    #[expect(clippy::cast_precision_loss, reason = "blocks of a fifth of a second")]
    pub(super) fn slip_rms(&self) -> f64 {
        (self.slip_square / self.blocks.max(1) as f64).sqrt()
    }

    /// Returns whether any row is from measured torques.
    pub(super) fn has_torque(&self) -> bool {
        self.difference.count > 0.0
    }

    /// Returns the effective number of rows, weighted by their information on θ.
    pub(super) fn effective_samples(&self) -> f64 {
        if self.signal_2 > 0.0 {
            self.signal * self.signal / self.signal_2
        } else {
            0.0
        }
    }

    /// Returns the lower bound of the peak friction coefficient; `None` before any force.
    pub(super) fn mu_peak(&self) -> Option<f64> {
        self.friction.lower_bound()
    }

    /// Returns the fraction of blocks beyond the linear range.
    pub(super) fn saturation_share(&self) -> f64 {
        if self.fast_blocks > 0.0 {
            self.saturated_blocks / self.fast_blocks
        } else {
            0.0
        }
    }

    /// Returns the rolling resistance coefficient; `None` before enough straight driving. Its
    /// standard deviation includes that of the accelerometer's offset over gravity, `offset_mu`,
    /// which does not average out.
    pub(super) fn rolling_resistance(&self, offset_mu: f64) -> Option<ValueWithStdDev> {
        (self.resistance_count >= RESISTANCE_BLOCKS_MIN).then(|| ValueWithStdDev {
            value: self.resistance / self.resistance_count,
            std_dev: (self.resistance_noise.sqrt() / self.resistance_count).hypot(offset_mu),
        })
    }

    /// Returns the ratio of effective to geometric track width; `None` before enough turning.
    pub(super) fn effective_track(&self, offsets: &OffsetKnowledge) -> Option<ValueWithStdDev> {
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
        (std_dev < TRACK_STD_DEV_MAX * value).then_some(ValueWithStdDev { value, std_dev })
    }
}
