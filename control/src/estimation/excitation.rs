//! Detects whether the motion of the last seconds excites θ.
//!
//! Without excitation the square of the force regressor over its noise variance has the mean 1;
//! excitation is detected by the running mean of this square. Without torque the regressor is an
//! acceleration: its mean is subtracted first, because the accelerometer's offset is no excitation.

use super::rows::{Row, index};

/// Time constant of the running means, in blocks.
const MEMORY_BLOCKS: f64 = 10.0;
/// Running mean above which there is excitation. Noise alone exceeds it less than once in 10⁸
/// blocks.
const PRESENT: f64 = 6.0;
/// Limit of the square of one block, so that one outlier is no excitation.
const SQUARE_MAX: f64 = 30.0;

/// Running means of the squares.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Excitation {
    turning: f64,
    turning_mean: f64,
    turning_blocks: f64,
    longitudinal: f64,
    longitudinal_sum: f64,
    longitudinal_rows: f64,
}

impl Excitation {
    /// Adds the differential row of a block.
    pub(super) fn add_block(&mut self, row: &Row, has_torque: bool) {
        let scaled = row.regressors[index::THETA] / row.force_noise.sqrt().max(f64::MIN_POSITIVE);
        self.turning_blocks = (self.turning_blocks + 1.0).min(2.0 * MEMORY_BLOCKS);
        let centred = if has_torque {
            scaled
        } else if self.turning_blocks <= 1.0 {
            self.turning_mean = scaled;
            0.0
        } else {
            scaled - self.turning_mean
        };
        self.turning_mean += (scaled - self.turning_mean) / self.turning_blocks;
        self.turning += ((centred * centred).min(SQUARE_MAX) - self.turning) / MEMORY_BLOCKS;
    }

    /// Adds a row of the forward speed.
    pub(super) fn add_longitudinal_row(&mut self, row: &Row) {
        if row.force_noise > 0.0 {
            self.longitudinal_sum += row.regressors[index::THETA].powi(2) / row.force_noise;
            self.longitudinal_rows += 1.0;
        }
    }

    /// Ends a block, also one at rest.
    pub(super) fn end_block(&mut self) {
        let square = if self.longitudinal_rows > 0.0 {
            self.longitudinal_sum / self.longitudinal_rows
        } else {
            0.0
        };
        self.longitudinal += (square.min(SQUARE_MAX) - self.longitudinal) / MEMORY_BLOCKS;
        self.longitudinal_sum = 0.0;
        self.longitudinal_rows = 0.0;
    }

    /// Returns whether there is excitation now.
    pub(super) fn is_present(&self) -> bool {
        self.turning.max(self.longitudinal) > PRESENT
    }
}
