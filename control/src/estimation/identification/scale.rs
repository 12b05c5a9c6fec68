//! Normal equations of one time scale.
//!
//! The residuals of all channels are compared as means over a number of comparisons. Short means
//! hold the most information. Noise of the wheel speeds, by which the model is driven, and
//! vibration disturb them the most: the noise of an output is correlated with that of its slopes,
//! which biases the estimates (errors in the variables: Söderström, Errors-in-Variables Methods in
//! System Identification, 2018). In longer means both average out. So the same equations are kept
//! at more than one scale, and the shorter scale is used only as long as its estimate agrees with
//! that of the longer one (the specification test of Hausman, Econometrica 46, 1978).

use super::blocks::{Blocks, add_outer_square, multiply};
use super::model::CHANNELS;
use super::parameters::{Prior, Square, Values, index, ln_stiffness_gradient};
use super::random_walk::RandomWalk;
use super::regimes::{Regime, Regimes};

/// Fraction of its information that a block loses with each later block, because sensor offsets
/// drift.
pub(super) const BLOCK_DECAY: f64 = 0.002;
/// Standardised residual above which Huber's weight falls below 1.
const HUBER: f64 = 3.0;
/// Weight of each new squared residual in the exponentially weighted mean square of its channel.
const SQUARE_GAIN: f64 = 0.005;
/// Maximum squared standardised residual in that mean.
const SQUARE_MAX: f64 = 100.0;
/// Mean square of a block's residuals, in standard deviations that include the running mean square of
/// their channel, above which the block's weight falls.
const BLOCK_SQUARE_MAX: f64 = 2.0;
/// Maximum difference of the estimates of two scales that agree, in its standard deviations.
const AGREEMENT_STD_DEVS: f64 = 2.0;
/// Minimum variance of that difference, relative to the variance at the longer scale.
const DIFFERENCE_MIN: f64 = 0.2;

/// A residual or a mean of residuals, with the slopes of the output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Residual {
    pub(super) value: f64,
    pub(super) slopes: Values,
}

impl Residual {
    pub(super) fn none() -> Self {
        Self {
            value: 0.0,
            slopes: Values::zeros(),
        }
    }

    fn add(&mut self, other: &Self) {
        self.value += other.value;
        self.slopes += other.slopes;
    }

    fn times(&self, ratio: f64) -> Self {
        Self {
            value: self.value * ratio,
            slopes: self.slopes * ratio,
        }
    }
}

/// Residual of one channel in one comparison, with what weights it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ChannelResidual {
    /// Measurement minus output.
    pub(super) residual: Residual,
    /// Change of the output by the noise added to the wheel speeds, multiplied by the square root
    /// of the noise's variance over that of the added noise; 0 without noise.
    pub(super) noise: Residual,
    /// Standard deviation of the residual without that noise.
    pub(super) std_dev: f64,
    /// Minimum of the mean square of standardised residuals in the weights: residuals that are
    /// smaller than sensors and model errors are assumed to make them get more weight, but not
    /// without bound.
    pub(super) square_min: f64,
}

/// End of a block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct BlockEnd {
    /// Regime of motion in the block.
    pub(super) regime: Regime,
    /// Random walk of the gyro's offset since the block before.
    pub(super) gyro_walk: RandomWalk,
}

/// Sums of one channel over the open mean.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Mean {
    residual: Residual,
    noise: Residual,
    std_dev: f64,
    square_min: f64,
    count: u32,
}

impl Mean {
    fn none() -> Self {
        Self {
            residual: Residual::none(),
            noise: Residual::none(),
            std_dev: 1.0,
            square_min: 1.0,
            count: 0,
        }
    }
}

/// The normal equations of all blocks at one time scale.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TimeScale {
    /// Number of comparisons in one mean.
    length: u32,
    means: [Mean; CHANNELS],
    compared: u32,
    /// `Jᵀ W J` and `g` of the open block.
    information: Square,
    pub(super) score: Values,
    /// Mean square of the open block's standardised residuals: sum, and number of residuals.
    squares_of_block: (f64, f64),
    /// All complete blocks of this ground.
    pub(super) ground: Blocks,
    /// The same by regime of motion.
    regimes: Regimes,
    /// `Σ g gᵀ` of these blocks' scores g, each at the parameters that were the solution with its
    /// block.
    pub(super) scores: Square,
    last_score: Values,
    /// Complete blocks of the open segment except the last one, which may already be of the next
    /// ground.
    segment: Blocks,
    last: Blocks,
    /// Mean square of each channel's standardised residuals.
    squares: [f64; CHANNELS],
    /// Nominal covariances of ln K with all parameters: the column of C for ln K, with C as in the
    /// module `hypothesis`.
    pub(super) stiffness_covariance: Values,
    /// Solution of the normal equations for ln K.
    ln_stiffness: f64,
    /// Variance of ln K at that solution, with the weights that the blocks had then.
    variance: f64,
}

impl TimeScale {
    /// Creates the equations without measurements, for means over `length` comparisons.
    pub(super) fn new(length: u32) -> Self {
        Self {
            length,
            means: [Mean::none(); CHANNELS],
            compared: 0,
            information: Square::zeros(),
            score: Values::zeros(),
            squares_of_block: (0.0, 0.0),
            ground: Blocks::none(),
            regimes: Regimes::new(),
            scores: Square::zeros(),
            last_score: Values::zeros(),
            segment: Blocks::none(),
            last: Blocks::none(),
            squares: [1.0; CHANNELS],
            stiffness_covariance: Values::zeros(),
            ln_stiffness: 0.0,
            variance: 0.0,
        }
    }

    /// Removes all measurements, in place because the equations are large.
    pub(super) fn clear(&mut self) {
        self.drop_block();
        let Self {
            length: _,
            means,
            compared: _,
            information: _,
            score: _,
            squares_of_block: _,
            ground,
            regimes,
            scores,
            last_score,
            segment,
            last,
            squares,
            stiffness_covariance,
            ln_stiffness,
            variance,
        } = self;
        *means = [Mean::none(); CHANNELS];
        for blocks in [ground, segment, last] {
            blocks.clear();
        }
        regimes.clear();
        scores.fill(0.0);
        last_score.fill(0.0);
        *squares = [1.0; CHANNELS];
        stiffness_covariance.fill(0.0);
        *ln_stiffness = 0.0;
        *variance = 0.0;
    }

    /// Returns the largest of the channels' mean squares of standardised residuals; about 1 if
    /// noise and model are as assumed.
    pub(super) fn worst_square(&self) -> f64 {
        self.squares.into_iter().fold(0.0, f64::max)
    }

    /// Returns the factor, at least 1, by which a channel's residuals exceed their standard
    /// deviation.
    pub(super) fn residual_ratio(&self, channel: usize) -> f64 {
        self.squares[channel].max(1.0).sqrt()
    }

    /// Adds a comparison to the open mean of its channel.
    pub(super) fn add(&mut self, channel: usize, compared: &ChannelResidual) {
        if self.length == 1 || channel == CHANNELS - 1 {
            // The body speed is no mean.
            self.compare(channel, compared);
            return;
        }
        let mean = &mut self.means[channel];
        mean.residual.add(&compared.residual);
        mean.noise.add(&compared.noise);
        mean.std_dev = compared.std_dev;
        mean.square_min = compared.square_min;
        mean.count += 1;
    }

    /// Ends a comparison, of which all channels were added.
    pub(super) fn end_comparison(&mut self) {
        self.compared += 1;
        if self.compared >= self.length {
            self.end_mean();
        }
    }

    /// Adds the means of the channels to the open block, except those of channels that were not
    /// measured in every comparison.
    fn end_mean(&mut self) {
        let compared = std::mem::take(&mut self.compared);
        for channel in 0..CHANNELS - 1 {
            let mean = std::mem::replace(&mut self.means[channel], Mean::none());
            if mean.count > 0 && mean.count == compared {
                let share = f64::from(compared).recip();
                let compared = ChannelResidual {
                    residual: mean.residual.times(share),
                    noise: mean.noise.times(share),
                    std_dev: mean.std_dev,
                    square_min: mean.square_min,
                };
                self.compare(channel, &compared);
            }
        }
    }

    /// Adds a comparison to the open block, with Huber's weight relative to the channel's
    /// residuals.
    ///
    /// The noise e of an output and its slopes ∂e/∂p are correlated, which adds the mean of
    /// −e ∂e/∂p to the score. That of the added noise, which is independent, cancels it.
    fn compare(&mut self, channel: usize, compared: &ChannelResidual) {
        let Residual { value, slopes } = &compared.residual;
        let square = (value / compared.std_dev).powi(2);
        let seen = &mut self.squares[channel];
        let std_dev = compared.std_dev * seen.max(compared.square_min).sqrt();
        *seen += SQUARE_GAIN * f64::from(self.length) * (square.min(SQUARE_MAX) - *seen);
        let standardised = value.abs() / std_dev;
        self.squares_of_block.0 += standardised.powi(2).min(SQUARE_MAX);
        self.squares_of_block.1 += 1.0;
        let weight = std_dev.powi(-2) * (HUBER / standardised.max(HUBER));
        add_outer_square(&mut self.information, weight, slopes);
        self.score.axpy(weight * value, slopes, 1.0);
        let Residual { value, slopes } = &compared.noise;
        if *value != 0.0 {
            add_outer_square(&mut self.information, -weight, slopes);
            self.score.axpy(weight * value, slopes, 1.0);
        }
    }

    /// Drops the measurements of the open block.
    pub(super) fn drop_block(&mut self) {
        self.information.as_mut_slice().fill(0.0);
        self.score.as_mut_slice().fill(0.0);
        self.squares_of_block = (0.0, 0.0);
        self.compared = 0;
        if self.length > 1 {
            self.means = [Mean::none(); CHANNELS];
        }
    }

    /// Ends the open block, which was linearised about `values`, and adds it to the ground. Once the
    /// estimate `has_converged`, a block with large residuals gets less weight.
    pub(super) fn close_block(&mut self, values: &Values, end: &BlockEnd, has_converged: bool) {
        if self.compared > 0 {
            self.end_mean();
        }
        let weight = self.block_weight();
        if has_converged && weight < 1.0 {
            multiply(self.information.as_mut_slice(), weight);
            multiply(self.score.as_mut_slice(), weight);
        }
        let keeps = 1.0 - BLOCK_DECAY;
        self.segment
            .combine(&self.last, |own, last| (own + last) * keeps);
        self.segment.add_walk(&end.gyro_walk);
        let last = &mut self.last;
        std::mem::swap(&mut last.information, &mut self.information);
        last.information_vector = self.score;
        last.information_vector
            .gemv(1.0, &last.information, values, 1.0);
        last.count = 1.0;
        self.ground.multiply(keeps);
        self.ground.add_walk(&end.gyro_walk);
        self.ground.add(&self.last);
        self.regimes.multiply(keeps);
        self.regimes.add(&self.last, end.regime);
        self.drop_block();
    }

    /// Solves the normal equations with the last block, which was linearised about `values`, and
    /// adds its score. Returns the solution; None if there is none.
    pub(super) fn solve_with_block(&mut self, values: &Values, prior: &Prior) -> Option<Values> {
        let solution = self.solve_equations(prior);
        // The score at the solution: where a block begins far from it, as the first ones do,
        // residuals there are due to the wrong parameters, and are no noise.
        self.last_score = self.last.information_vector;
        self.last_score.gemv(
            -1.0,
            &self.last.information,
            &solution.unwrap_or(*values),
            1.0,
        );
        self.scores
            .ger(1.0, &self.last_score, &self.last_score, 1.0 - BLOCK_DECAY);
        self.variance = self.variances(prior).0;
        solution
    }

    /// Returns the weight of the open block, at most 1: less where its residuals are much larger
    /// than usual, as when the robot stops at once.
    fn block_weight(&self) -> f64 {
        let (sum, count) = self.squares_of_block;
        if sum > BLOCK_SQUARE_MAX * count {
            (BLOCK_SQUARE_MAX * count / sum).powi(2)
        } else {
            1.0
        }
    }

    /// Solves the normal equations of the ground's blocks and the prior again. Returns the parameters
    /// under their limits; None if the equations cannot be solved.
    pub(super) fn solve(&mut self, prior: &Prior) -> Option<Values> {
        let solution = self.solve_equations(prior);
        self.variance = self.variances(prior).0;
        solution
    }

    fn solve_equations(&mut self, prior: &Prior) -> Option<Values> {
        let cholesky = (self.ground.information + prior.information).cholesky()?;
        self.stiffness_covariance = cholesky.solve(&ln_stiffness_gradient());
        let solution = cholesky.solve(&(self.ground.information_vector + prior.information_vector));
        let solution = prior.limited(solution, |gradient| cholesky.solve(gradient));
        self.ln_stiffness = solution[index::STIFFNESS];
        Some(solution)
    }

    /// Computes the variances of ln K again, from the weights that the blocks have now. They stay
    /// if the normal equations cannot be solved.
    pub(super) fn update_variances(&mut self, prior: &Prior) {
        if let Some(cholesky) = (self.ground.information + prior.information).cholesky() {
            self.stiffness_covariance = cholesky.solve(&ln_stiffness_gradient());
        }
    }

    /// Returns whether the last solution agrees with that of the longer scale `other`.
    pub(super) fn agrees_with(&self, other: &Self) -> bool {
        let (own, of_other) = (self.variance, other.variance);
        // That of the difference to an efficient estimate is the difference of the variances.
        let variance = (of_other - own).max(DIFFERENCE_MIN * of_other);
        (self.ln_stiffness - other.ln_stiffness).powi(2) <= AGREEMENT_STD_DEVS.powi(2) * variance
    }

    /// Multiplies the weights of all complete blocks.
    pub(super) fn scale_weights(&mut self, ratio: f64) {
        self.ground.multiply(ratio);
        self.regimes.multiply(ratio);
        self.segment.multiply(ratio);
        self.last.multiply(ratio);
        multiply(self.scores.as_mut_slice(), ratio);
        self.last_score *= ratio.sqrt();
    }

    /// Returns the increase of the variance of ln K if the bend of the friction curve has the standard
    /// deviation that intervals assume instead of that of the prior.
    ///
    /// An error e of a prior mean with the standard deviation σ is an error `C_b e / σ²` of ln K,
    /// with the covariance `C_b` of both. The estimate stays, so no other error changes.
    pub(super) fn bend_variance_inflation(&self, prior: &Prior) -> f64 {
        let assumed = prior.std_devs[index::BEND].powi(2);
        let added = (prior.interval_bend_std_dev.powi(2) - assumed).max(0.0);
        (self.stiffness_covariance[index::BEND] / assumed).powi(2) * added
    }

    /// Takes the next step of the comparison of the regimes of motion, about as long as a solution of the
    /// normal equations.
    pub(super) fn compare_regimes(&mut self, prior: &Prior) {
        self.regimes.compare_next(prior);
    }

    /// Returns the variance of ln K by the disagreement of regimes of motion beyond noise.
    pub(super) fn regime_variance(&self) -> f64 {
        self.regimes.variance()
    }

    /// Returns the part of ln K's variance that the prior of the tyres contributes.
    pub(super) fn tyre_variance(&self, prior: &Prior) -> f64 {
        prior.tyre_variance(&self.stiffness_covariance)
    }

    /// Returns the variance of ln K, and the part of it that the prior contributes. The first is at
    /// least the nominal variance, the diagonal element of C.
    pub(super) fn variances(&self, prior: &Prior) -> (f64, f64) {
        let stiffness_covariance = self.stiffness_covariance;
        let known = (prior.information * stiffness_covariance).dot(&stiffness_covariance);
        let nominal = self.nominal_variance();
        ((self.scattered() + known).max(nominal), known)
    }

    /// Returns the variance of ln K at the last solution, with the weights that the blocks had then.
    pub(super) fn variance(&self) -> f64 {
        self.variance
    }

    /// Returns the nominal variance of ln K at the last solution, the diagonal element of C.
    pub(super) fn nominal_variance(&self) -> f64 {
        self.stiffness_covariance[index::STIFFNESS].max(0.0)
    }

    /// Returns the part of ln K's variance that the scatter of the blocks' scores contributes.
    pub(super) fn scattered(&self) -> f64 {
        // The scatter of few scores underestimates their variance.
        let few = 1.0 + 2.0 / self.ground.count.max(1.0);
        few * (self.scores * self.stiffness_covariance).dot(&self.stiffness_covariance)
    }

    /// Drops the last block, which may contain samples of two grounds.
    pub(super) fn drop_last_block(&mut self) {
        self.ground.subtract(&self.last);
        self.regimes.subtract_last(&self.last);
        self.last = Blocks::none();
        self.scores
            .ger(-1.0, &self.last_score, &self.last_score, 1.0);
        self.last_score.fill(0.0);
    }

    /// Takes the blocks of the open segment; the ground keeps them.
    pub(super) fn take_segment(&mut self) -> Blocks {
        let mut segment = std::mem::replace(&mut self.segment, Blocks::none());
        segment.add(&self.last);
        self.last = Blocks::none();
        self.last_score.fill(0.0);
        segment
    }
}
