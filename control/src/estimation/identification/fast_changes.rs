//! Estimates which part of the fast changes of an output is noise of the wheel speeds.
//!
//! The model is driven by the measured wheel speeds, and its accelerations y follow their fast
//! changes whether these are true motion or noise. The accelerometer m measures true motion alone.
//! Where the model has the right parameters, `y = y₀ + e` and `m = y₀ + s`, with the error e that
//! noise of the wheel speeds causes and the noise s of the accelerometer, which are independent. So
//! the mean of `(y − m) y` is the variance of e, whatever the variance of s is (the reliability
//! ratio of regressions with errors in the variables: Fuller, Measurement Error Models, 1987, ch.
//! 1).
//!
//! Third differences of successive means are taken, which pass next to nothing of a manoeuvre, and
//! most of what is near the resonance of the contacts, 5 to 10 Hz. An accelerometer that is late by
//! 30 ms or more, or filtered below 5 Hz, does not measure such motion at the same time, so that
//! the motion counts as noise.

use super::recent::RecentBlocks;

/// Coefficients of the third difference, and the sum of their squares.
const THIRD: [f64; 4] = [-1.0, 3.0, -3.0, 1.0];
const THIRD_SQUARE: f64 = 20.0;
/// Accelerations: forward and to the left.
const ACCELERATIONS: usize = 2;
/// Share of noise in the output's fast changes from which noise is taken into account. Wrong
/// parameters of the model look like noise of a smaller share once they have settled.
const SHARE_MIN: f64 = 0.6;
/// Standard errors by which the noise must exceed that share: the accelerometer's own noise and
/// bumps make the share of few blocks uncertain where the wheels are smooth.
const SIGNIFICANT: f64 = 3.0;
/// Variance of the output's error, relative to the assumed one of the residual, from which the
/// noise is taken into account.
const VARIANCE_MIN: f64 = 0.004;
/// Minimum number of blocks before noise is taken into account.
const BLOCKS_MIN: usize = 6;
/// Minimum number of products in a block that counts.
const PRODUCTS_MIN: f64 = 10.0;

/// The newest standardised values of one acceleration: measured, the output, and what the added
/// noise adds to it.
type Newest = [[f64; THIRD.len()]; 3];

/// Mean products of the fast changes of accelerations.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FastChanges {
    newest: [Newest; ACCELERATIONS],
    /// Number of values of each acceleration since the last gap, as far as it matters.
    known: [usize; ACCELERATIONS],
    /// Sums over the open block of `(y − m) y`, of the square of what the added noise adds, and of
    /// `(y − m) y − s y²` with s = [`SHARE_MIN`]; and number of terms.
    open: [f64; 3],
    count: f64,
    /// Means of these three over each of the last blocks.
    error: RecentBlocks,
    added: RecentBlocks,
    excess: RecentBlocks,
}

impl FastChanges {
    /// Creates the means without values.
    pub(super) fn new() -> Self {
        Self {
            newest: [[[0.0; THIRD.len()]; 3]; ACCELERATIONS],
            known: [0; ACCELERATIONS],
            open: [0.0; 3],
            count: 0.0,
            error: RecentBlocks::new(),
            added: RecentBlocks::new(),
            excess: RecentBlocks::new(),
        }
    }

    /// Adds the next values of an acceleration: measured, output, and change of the output by the
    /// added noise, each over the assumed standard deviation of the residual.
    pub(super) fn add(&mut self, acceleration: usize, values: [f64; 3]) {
        let newest = &mut self.newest[acceleration];
        for (values, value) in newest.iter_mut().zip(values) {
            values.rotate_left(1);
            values[THIRD.len() - 1] = value;
        }
        let known = &mut self.known[acceleration];
        *known = (*known + 1).min(THIRD.len());
        if *known < THIRD.len() {
            return;
        }
        let [measured, output, added] = newest.map(|values| {
            let terms = THIRD.iter().zip(values);
            terms.map(|(c, value)| c * value).sum::<f64>()
        });
        let error = (output - measured) * output;
        let products = [error, added.powi(2), error - SHARE_MIN * output.powi(2)];
        for (sum, product) in self.open.iter_mut().zip(products) {
            *sum += product / THIRD_SQUARE;
        }
        self.count += 1.0;
    }

    /// Ends the open block; one with fewer than [`PRODUCTS_MIN`] products is not used.
    pub(super) fn end_block(&mut self) {
        if self.count >= PRODUCTS_MIN {
            let [error, added, excess] = self.open.map(|sum| sum / self.count);
            self.error.add(error);
            self.added.add(added);
            self.excess.add(excess);
        }
        self.open = [0.0; 3];
        self.count = 0.0;
    }

    /// Drops the open block and begins anew after a gap.
    pub(super) fn drop_block(&mut self) {
        self.known = [0; ACCELERATIONS];
        self.open = [0.0; 3];
        self.count = 0.0;
    }

    /// Deletes all blocks, whose outputs were those of other parameters.
    pub(super) fn clear(&mut self) {
        let newest = self.newest;
        *self = Self {
            newest,
            known: self.known,
            ..Self::new()
        };
    }

    /// Returns whether the output's fast changes are noise for the most part, and large enough to
    /// matter.
    pub(super) fn is_noise(&self) -> bool {
        let is_large = self
            .error
            .median()
            .is_some_and(|error| error > VARIANCE_MIN);
        let least = SIGNIFICANT * self.excess.std_error();
        let is_most = self.excess.median().is_some_and(|excess| excess > least);
        self.excess.count() >= BLOCKS_MIN && is_large && is_most
    }

    /// Returns the standard deviation of the output's noise over that of the added noise, 0 to 1;
    /// of the open block before the first one, and 0 before that.
    pub(super) fn noise_ratio(&self) -> f64 {
        let [error, added, _] = self.open;
        let error = self.error.median().unwrap_or(error);
        let added = self.added.median().unwrap_or(added);
        if added > 0.0 {
            (error / added).clamp(0.0, 1.0).sqrt()
        } else {
            0.0
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Sixty seconds of outputs whose noise and true fast motion have these standard deviations, of
    /// an accelerometer with noise of 0.5, and of added noise with twice the standard deviation.
    fn after(noise: f64, motion: f64) -> FastChanges {
        after_seed(noise, motion, 9)
    }

    fn after_seed(noise: f64, motion: f64, seed: u64) -> FastChanges {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut normal =
            |std_dev: f64| (0..12).map(|_| random.random::<f64>() - 0.5).sum::<f64>() * std_dev;
        let mut fast = FastChanges::new();
        for tick in 0..1_200 {
            let slow = 5.0 * (f64::from(tick) * 0.05).sin();
            for acceleration in 0..ACCELERATIONS {
                let truth = slow + normal(motion);
                let values = [
                    truth + normal(0.5),
                    truth + normal(noise),
                    normal(2.0 * noise),
                ];
                fast.add(acceleration, values);
            }
            if tick % 20 == 19 {
                fast.end_block();
            }
        }
        fast
    }

    #[test]
    fn noise_is_distinguished_from_motion_that_the_accelerometer_feels() {
        for (noise, motion, is_noise) in [
            (0.2, 0.0, true),
            (0.2, 0.1, true),
            (0.2, 0.4, false),
            (0.0, 0.4, false),
            (0.0, 0.0, false),
            (0.03, 0.0, false),
        ] {
            let fast = after(noise, motion);
            assert_eq!(fast.is_noise(), is_noise, "{noise} of {motion}");
        }
    }

    #[test]
    fn the_accelerometers_noise_is_not_taken_for_that_of_smooth_wheels() {
        let seeds = 0..200;
        let found = seeds.filter(|&seed| after_seed(0.0, 0.08, seed).is_noise());
        // One-sided, so 0.1 % of independent normal medians.
        assert!(found.count() <= 4);
    }

    #[test]
    fn the_ratio_is_that_of_the_noise_to_the_added_one() {
        for motion in [0.0, 0.2] {
            let ratio = after(0.2, motion).noise_ratio();
            assert!((0.4..0.6).contains(&ratio), "{motion}: {ratio}");
        }
        assert!(after(0.0, 0.4).noise_ratio() < 0.01);
    }

    #[test]
    fn a_gap_is_no_fast_change() {
        let mut fast = FastChanges::new();
        for (value, gap) in [(0.0, true), (9.0, false)] {
            for _ in 0..20 {
                fast.add(0, [0.0, value, 0.0]);
            }
            fast.end_block();
            if gap {
                fast.drop_block();
            }
        }
        assert!(!fast.is_noise());
    }
}
