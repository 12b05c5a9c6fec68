//! Which part of the fast changes of an output is noise of the wheel speeds.
//!
//! The model is driven by the measured wheel speeds, and its accelerations y follow their fast changes
//! whether these are true motion or noise. The accelerometer m feels true motion alone. Where the
//! model has the right parameters, `y = y₀ + e` and `m = y₀ + s`, with the error e that noise of the
//! wheel speeds causes and the noise s of the accelerometer, which are independent. So the mean of
//! `(y − m) y` is the variance of e, whatever the variance of s is (the reliability ratio of
//! regressions with errors in the variables: Fuller, Measurement Error Models, 1987, ch. 1).
//!
//! Third differences of successive means are taken, which pass half of the power between 5 and 10 Hz,
//! near the resonance of the contacts, and next to none of a manoeuvre.

use super::recent::RecentBlocks;

/// Coefficients of the third difference, and the sum of their squares.
const THIRD: [f64; 4] = [-1.0, 3.0, -3.0, 1.0];
const THIRD_SQUARE: f64 = 20.0;
/// Accelerations: forward and to the left.
const ACCELERATIONS: usize = 2;
/// Share of noise in the output's fast changes from which it is taken into account. Wrong parameters
/// of the model look like noise of a smaller share, or like less than none.
const SHARE_MIN: f64 = 0.6;
/// Standardised variance of the output's error from which it is: below, it biases θ by less than 2 %.
const VARIANCE_MIN: f64 = 0.004;

/// The newest standardised values of one acceleration: measured, the output, and what the added
/// noise adds to it.
type Newest = [[f64; THIRD.len()]; 3];

/// Mean products of the fast changes of accelerations.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FastChanges {
    newest: [Newest; ACCELERATIONS],
    /// Number of values of each acceleration since the last gap, as far as it matters.
    known: [usize; ACCELERATIONS],
    /// Sums over the open block of `(y − m) y`, y² and of the square of what the added noise adds, and
    /// their number.
    open: [f64; 3],
    count: f64,
    blocks: [RecentBlocks; 3],
}

impl FastChanges {
    /// Creates the means without values.
    pub(super) fn new() -> Self {
        Self {
            newest: [[[0.0; THIRD.len()]; 3]; ACCELERATIONS],
            known: [0; ACCELERATIONS],
            open: [0.0; 3],
            count: 0.0,
            blocks: [const { RecentBlocks::new() }; 3],
        }
    }

    /// Adds the next values of an acceleration: measured, output, and what the added noise changes,
    /// each over the assumed standard deviation of the residual.
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
        let products = [(output - measured) * output, output.powi(2), added.powi(2)];
        for (sum, product) in self.open.iter_mut().zip(products) {
            *sum += product / THIRD_SQUARE;
        }
        self.count += 1.0;
    }

    /// Ends the open block.
    pub(super) fn end_block(&mut self) {
        if self.count > 0.0 {
            for (blocks, sum) in self.blocks.iter_mut().zip(self.open) {
                blocks.add(sum / self.count);
            }
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

    /// Returns the medians of the blocks; None before the first one.
    fn medians(&self) -> Option<[f64; 3]> {
        let [error, output, added] = &self.blocks;
        Some([error.median()?, output.median()?, added.median()?])
    }

    /// Returns whether the output's fast changes are noise for the most part, and large enough to
    /// matter.
    pub(super) fn is_noise(&self) -> bool {
        self.medians()
            .is_some_and(|[error, output, _]| error > (SHARE_MIN * output).max(VARIANCE_MIN))
    }

    /// Returns the standard deviation of the output's noise over that of the added noise, 0 to 1; 0
    /// before it is known.
    pub(super) fn noise_ratio(&self) -> f64 {
        match self.medians() {
            Some([error, _, added]) if added > 0.0 => (error / added).clamp(0.0, 1.0).sqrt(),
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Sixty seconds of outputs whose noise and true fast motion have these standard deviations, of an
    /// accelerometer with noise of 0.5, and of added noise with twice the standard deviation.
    fn after(noise: f64, motion: f64) -> FastChanges {
        let mut random = ChaCha8Rng::seed_from_u64(9);
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
