//! Recursive Gauss–Newton estimation of all parameters from one starting value of K.
//!
//! A prediction-error method (Ljung, System Identification, 2nd ed., ch. 11): the model is driven
//! by the measured wheel speeds, and its outputs are compared with the other sensors. The residuals
//! r of a block b are linearised about the parameters `p_b` that were in use during the block:
//! `r(p) = r_b − J_b (p − p_b)`. Earlier blocks lose weight when ln K moves away from the value at
//! which they were linearised. With `C = (Σ Jᵀ W J + prior information)⁻¹` the covariance is the
//! robust one, `C (Σ g gᵀ + prior information) C`: the empirical scatter of the blocks' scores
//! `g = Jᵀ W r` replaces the assumption of white residuals and a true model.

use super::dual::{Dual, Real};
use super::model::{Input, Output, State};
use super::parameters::{PARAMETERS, Robot, SHAPE_MIN, Square, Values, index};
use crate::robot::RobotModel;

/// Channels: turn rate, acceleration (forward, left), torque (left, right), body speed.
pub(super) const CHANNELS: usize = 6;
/// Change of ln K that makes older linearisations count e⁻³ times as much.
const LINEAR_RANGE: f64 = 0.1;
/// Fraction of its information that a block loses with each later block, because sensor offsets
/// drift.
const BLOCK_FORGETS: f64 = 0.002;
/// Maximum magnitude of the change of ln K at the end of one block.
const STEP_MAX: f64 = 0.4;
/// Range in which parameters stay, in standard deviations of their prior.
const PRIOR_RANGE: f64 = 5.0;
/// Standardised residual above which Huber's weight falls below 1.
const HUBER: f64 = 3.0;
/// Weight of each new squared residual in the exponentially weighted mean square of its channel.
const SQUARE_GAIN: f64 = 0.005;
/// Maximum squared standardised residual in that mean, and in the cost.
const SQUARE_MAX: f64 = 100.0;
const COST_MAX: f64 = 25.0;
/// Minimum number of blocks from whose scatter the variance of innovations is estimated.
const INNOVATION_BLOCKS_MIN: u32 = 15;
/// Factor by which each later block multiplies the cost so far.
const COST_KEEPS: f64 = 0.95;

/// Value with its derivatives with respect to all parameters.
pub(super) type Number = Dual<PARAMETERS>;

/// Normal prior of the parameters at the start of a ground, in the units of [`index`].
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Prior {
    /// Mean.
    pub(super) mean: Values,
    /// Information matrix, the inverse of the covariance.
    pub(super) information: Square,
    /// Standard deviations of the initial prior, before any measurement. They scale the maximum
    /// step and the range of each parameter.
    pub(super) std_devs: Values,
    /// Mean of the initial prior, the middle of each parameter's range.
    pub(super) first_mean: Values,
}

impl Prior {
    /// Creates the initial prior of independent parameters.
    pub(super) fn new(mean: Values, std_devs: Values) -> Self {
        Self {
            mean,
            information: Square::from_diagonal(&std_devs.map(|std_dev| std_dev.powi(-2))),
            std_devs,
            first_mean: mean,
        }
    }
}

/// Weighted sums over linearised blocks of measurements.
#[derive(Debug, Clone, PartialEq)]
struct Blocks {
    /// `A = Σ Jᵀ W J`, the information matrix, and `b = Σ (Jᵀ W J p_b + g)`, the right side of the
    /// normal equations `A p = b`.
    information: Square,
    preferred: Values,
    /// `Σ g gᵀ` of the scores `g = Jᵀ W r`.
    scores: Square,
    /// Sum of the blocks' weights, each at most 1.
    count: f64,
}

impl Blocks {
    fn none() -> Self {
        Self {
            information: Square::zeros(),
            preferred: Values::zeros(),
            scores: Square::zeros(),
            count: 0.0,
        }
    }

    fn scale(&mut self, ratio: f64) {
        self.information *= ratio;
        self.preferred *= ratio;
        self.scores *= ratio;
        self.count *= ratio;
    }

    fn add(&mut self, other: &Self, ratio: f64) {
        self.information += other.information * ratio;
        self.preferred += other.preferred * ratio;
        self.scores += other.scores * ratio;
        self.count += other.count * ratio;
    }
}

/// Estimate of ln K from one segment, and the two parts of its variance.
#[derive(Debug, Clone, Copy)]
pub(super) struct OfSegment {
    /// Estimate of ln K.
    pub(super) ln_stiffness: f64,
    /// Variance of ln K from the measurement noise of the segment's own blocks; independent between
    /// segments.
    pub(super) own: f64,
    /// Variance of ln K from the uncertainty of all other parameters, which come from the ground's
    /// other blocks and the prior; common to the segments of a robot.
    pub(super) known: f64,
}

/// A measurement of one channel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Measured {
    /// Index of the channel, below [`CHANNELS`].
    pub(super) channel: usize,
    /// Measured value in the channel's unit: rad/s, m/s², N m or m/s.
    pub(super) value: f64,
    /// Standard deviation of sensor noise and model error together, in the same unit.
    pub(super) std_dev: f64,
}

/// Estimator that started at one value of K: the model's state, the estimated parameters and their
/// normal equations.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Hypothesis {
    values: Values,
    state: State<Number>,
    /// All complete blocks of this ground.
    ground: Blocks,
    /// Complete blocks of the open segment except the last one, which may already be of the next
    /// ground.
    segment: Blocks,
    last: Blocks,
    /// `Jᵀ W J` and `g` of the open block.
    block_information: Square,
    block_score: Values,
    /// Mean outputs since the last comparison.
    mean: Output<Number>,
    /// Mean square of each channel's standardised residuals.
    squares: [f64; CHANNELS],
    cost: f64,
    /// Column of C for ln K: covariances of ln K with all parameters.
    of_stiffness: Values,
    /// `of_stiffnessᵀ g` of the open block at the last call of [`Hypothesis::innovation`].
    score_taken: f64,
    /// Variance of `of_stiffnessᵀ g` of one block, from the scatter of the blocks.
    block_variance: f64,
    /// Number of complete blocks.
    age: u32,
}

impl Hypothesis {
    /// Creates an estimator at the prior's mean with another ln K; the robot moves as in `state`.
    pub(super) fn new(prior: &Prior, ln_stiffness: f64, state: State<f64>) -> Self {
        let mut values = prior.mean;
        values[index::STIFFNESS] = ln_stiffness;
        let mut hypothesis = Self {
            values,
            state: State::rolling(0.0, 0.0),
            ground: Blocks::none(),
            segment: Blocks::none(),
            last: Blocks::none(),
            block_information: Square::zeros(),
            block_score: Values::zeros(),
            mean: Output::zero(),
            squares: [1.0; CHANNELS],
            cost: 0.0,
            of_stiffness: Values::zeros(),
            score_taken: 0.0,
            block_variance: 0.0,
            age: 0,
        };
        hypothesis.restart(state);
        hypothesis
    }

    /// Continues from a given state of motion after a gap in the samples; drops the open block.
    pub(super) fn restart(&mut self, state: State<f64>) {
        let [forward_m_s, left_m_s] = state.speed_m_s;
        self.state = State::rolling(forward_m_s, state.turn_rad_s);
        self.state.speed_m_s[1] = Number::constant(left_m_s);
        self.mean = Output::zero();
        self.drop_block();
    }

    /// Returns the standardised innovation of ln K since the last call: the Gauss–Newton step of ln
    /// K from the measurements since then, over its standard deviation. That follows from the
    /// scatter of whole blocks and `per_block`, the number of calls per block. Positive if K is
    /// larger than estimated; None before [`INNOVATION_BLOCKS_MIN`] blocks.
    pub(super) fn innovation(&mut self, per_block: f64) -> Option<f64> {
        let score = self.of_stiffness.dot(&self.block_score);
        let new = score - std::mem::replace(&mut self.score_taken, score);
        (self.age >= INNOVATION_BLOCKS_MIN && self.block_variance > 0.0)
            .then(|| new / (self.block_variance / per_block).sqrt())
    }

    /// Drops the measurements of the open block.
    pub(super) fn drop_block(&mut self) {
        self.score_taken = 0.0;
        self.block_information = Square::zeros();
        self.block_score = Values::zeros();
    }

    /// Returns the estimated parameters, in the units of [`index`].
    pub(super) fn values(&self) -> &Values {
        &self.values
    }

    /// Returns the sum of squared standardised residuals, each at most [`COST_MAX`]; older blocks
    /// count less. A lower cost is a better fit.
    pub(super) fn cost(&self) -> f64 {
        self.cost
    }

    /// Returns the number of complete blocks.
    pub(super) fn age(&self) -> u32 {
        self.age
    }

    /// Returns the largest of the channels' mean squares of standardised residuals; about 1 if
    /// noise and model are as assumed.
    pub(super) fn worst_square(&self) -> f64 {
        self.squares.into_iter().fold(0.0, f64::max)
    }

    /// Advances the model by one sample and adds its outputs to the mean with the weight `share`.
    /// Returns the forward speed at the sample's end, metres per second.
    pub(super) fn advance(&mut self, model: &RobotModel, input: &Input, share: f64) -> Number {
        let values = std::array::from_fn(|place| Number::parameter(self.values[place], place));
        let output = Robot::new(&values, model).advance(&mut self.state, input);
        let add = |mean: &mut Number, value: Number| *mean = *mean + value * share;
        add(&mut self.mean.turn_rad_s, output.turn_rad_s);
        for axis in 0..2 {
            add(
                &mut self.mean.acceleration_m_s2[axis],
                output.acceleration_m_s2[axis],
            );
            add(&mut self.mean.torques_n_m[axis], output.torques_n_m[axis]);
        }
        output.forward_m_s
    }

    /// Returns the weighted mean outputs since the last call, in the order of the channels without
    /// the body speed, and begins a new mean.
    pub(super) fn take_mean(&mut self) -> [Number; CHANNELS - 1] {
        let mean = std::mem::replace(&mut self.mean, Output::zero());
        let [forward, left] = mean.acceleration_m_s2;
        let [torque_left, torque_right] = mean.torques_n_m;
        [mean.turn_rad_s, forward, left, torque_left, torque_right]
    }

    /// Adds the residual of an output to the open block, with Huber's weight. A residual that is
    /// not finite is ignored.
    pub(super) fn compare(&mut self, output: &Number, measured: Measured) {
        let residual = measured.value - output.value;
        let square = (residual / measured.std_dev).powi(2);
        if !square.is_finite() {
            return;
        }
        let seen = &mut self.squares[measured.channel];
        let std_dev = measured.std_dev * seen.max(1.0).sqrt();
        *seen += SQUARE_GAIN * (square.min(SQUARE_MAX) - *seen);
        let standardised = residual.abs() / std_dev;
        let weight = std_dev.powi(-2) * (HUBER / standardised.max(HUBER));
        let slopes = Values::from_row_slice(&output.derivatives);
        self.block_information.ger(weight, &slopes, &slopes, 1.0);
        self.block_score.axpy(weight * residual, &slopes, 1.0);
        self.cost += square.min(COST_MAX);
    }

    /// Ends the open block and takes a bounded Gauss–Newton step from all blocks of the ground and
    /// the prior. Returns false if the normal equations cannot be solved or a parameter is not
    /// finite.
    pub(super) fn end_block(&mut self, prior: &Prior) -> bool {
        let score = self.block_score;
        self.segment.add(&self.last, 1.0);
        self.ground.scale(1.0 - BLOCK_FORGETS);
        self.segment.scale(1.0 - BLOCK_FORGETS);
        self.last = Blocks {
            information: self.block_information,
            preferred: score + self.block_information * self.values,
            scores: score * score.transpose(),
            count: 1.0,
        };
        self.ground.add(&self.last, 1.0);
        self.drop_block();
        self.age = self.age.saturating_add(1);
        self.cost *= COST_KEEPS;
        let Some(cholesky) = (self.ground.information + prior.information).cholesky() else {
            return false;
        };
        let mut stiffness = Values::zeros();
        stiffness[index::STIFFNESS] = 1.0;
        self.of_stiffness = cholesky.solve(&stiffness);
        if self.ground.count >= 5.0 {
            let scatter = (self.ground.scores * self.of_stiffness).dot(&self.of_stiffness);
            self.block_variance = scatter / self.ground.count;
        }
        let wanted = cholesky.solve(&(self.ground.preferred + prior.information * prior.mean));
        let mut step = wanted - self.values;
        let largest = step
            .zip_map(&prior.std_devs, |step, std_dev| step.abs() / std_dev)
            .max();
        step /= largest
            .max(step[index::STIFFNESS].abs() / STEP_MAX)
            .max(1.0);
        let before = self.values;
        self.values += step;
        for place in 0..PARAMETERS {
            let most = PRIOR_RANGE * prior.std_devs[place];
            let mean = prior.first_mean[place];
            self.values[place] = self.values[place].clamp(mean - most, mean + most);
        }
        self.values[index::SHAPE] = self.values[index::SHAPE].max(SHAPE_MIN);
        self.values[index::BEND] = self.values[index::BEND].max(0.0);
        let step = self.values - before;
        self.shift_state(&step);
        let keeps = (-3.0 * (step[index::STIFFNESS] / LINEAR_RANGE).powi(2)).exp();
        self.ground.scale(keeps);
        self.segment.scale(keeps);
        self.last.scale(keeps);
        self.values.iter().all(|value| value.is_finite())
    }

    /// Moves the model's state, to first order, to that of the parameters after `step`.
    fn shift_state(&mut self, step: &Values) {
        let shift = |number: &mut Number| {
            let slopes = number.derivatives.iter().zip(step.iter());
            number.value += slopes.map(|(slope, step)| slope * step).sum::<f64>();
        };
        self.state.speed_m_s.iter_mut().for_each(shift);
        shift(&mut self.state.turn_rad_s);
        self.state.deflections.iter_mut().flatten().for_each(shift);
    }

    /// Returns the variance of ln K, and the part of it that the prior contributes. The first is at
    /// least the nominal variance, the diagonal element of C.
    pub(super) fn variances(&self, prior: &Prior) -> (f64, f64) {
        let of_stiffness = self.of_stiffness;
        let scattered = self.scattered();
        let known = (prior.information * of_stiffness).dot(&of_stiffness);
        let nominal = of_stiffness[index::STIFFNESS];
        ((scattered + known).max(nominal), known)
    }

    /// Returns the part of ln K's variance that the scatter of the blocks' scores contributes.
    fn scattered(&self) -> f64 {
        // The scatter of few scores underestimates their variance.
        let few = 1.0 + 2.0 / self.ground.count.max(1.0);
        few * (self.ground.scores * self.of_stiffness).dot(&self.of_stiffness)
    }

    /// Returns the robust variances of linear functions of the parameters, given their gradients.
    /// None if the normal equations cannot be solved.
    pub(super) fn variances_of<const COUNT: usize>(
        &self,
        prior: &Prior,
        slopes: &[Values; COUNT],
    ) -> Option<[f64; COUNT]> {
        let cholesky = (self.ground.information + prior.information).cholesky()?;
        let few = 1.0 + 2.0 / self.ground.count.max(1.0);
        Some(slopes.map(|slopes| {
            let covariances = cholesky.solve(&slopes);
            let scattered = few * (self.ground.scores * covariances).dot(&covariances);
            let known = (prior.information * covariances).dot(&covariances);
            (scattered + known).max(covariances.dot(&slopes))
        }))
    }

    /// Drops the last block and the open one, which may contain samples of two grounds.
    pub(super) fn drop_last_block(&mut self) {
        self.ground.add(&self.last, -1.0);
        self.last = Blocks::none();
        self.drop_block();
    }

    /// Ends the segment and returns ln K from its own blocks.
    ///
    /// The ground's other blocks and the prior contribute the other parameters only: ln K is
    /// marginalised from them. So K may differ between segments, and the segments' own errors are
    /// independent. None if the segment has no blocks, or its normal equations cannot be solved.
    pub(super) fn close_segment(&mut self, prior: &Prior) -> Option<OfSegment> {
        let mut segment = std::mem::replace(&mut self.segment, Blocks::none());
        segment.add(&self.last, 1.0);
        self.last = Blocks::none();
        if segment.count <= 0.0 {
            return None;
        }
        let mut others = self.ground.information - segment.information + prior.information;
        let mut wanted = self.ground.preferred - segment.preferred + prior.information * prior.mean;
        // K of the other blocks is marginalised.
        let of_stiffness: Values = others.column(index::STIFFNESS).into();
        let most = of_stiffness[index::STIFFNESS];
        wanted -= of_stiffness * (wanted[index::STIFFNESS] / most);
        others.ger(-most.recip(), &of_stiffness, &of_stiffness, 1.0);
        let cholesky = (others + segment.information).cholesky()?;
        let values = cholesky.solve(&(wanted + segment.preferred));
        let mut stiffness = Values::zeros();
        stiffness[index::STIFFNESS] = 1.0;
        let of_stiffness = cholesky.solve(&stiffness);
        // The segment has too few blocks for a scatter of its own: that of the whole ground is
        // used.
        let whole = (self.ground.information * self.of_stiffness).dot(&self.of_stiffness);
        let scatter = (self.scattered() / whole).max(1.0);
        let own = scatter * (segment.information * of_stiffness).dot(&of_stiffness);
        let found = OfSegment {
            ln_stiffness: values[index::STIFFNESS],
            own,
            known: (others * of_stiffness).dot(&of_stiffness).max(0.0),
        };
        let is_known = found.ln_stiffness.is_finite() && found.known.is_finite() && own > 0.0;
        (is_known && own.is_finite()).then_some(found)
    }

    /// Returns the posterior as the prior of the next ground or load: the parameters `changed` are
    /// reset to the initial prior, all others keep mean and covariance. None if it cannot be
    /// computed.
    pub(super) fn prior_without(&self, prior: &Prior, changed: &[usize]) -> Option<Prior> {
        let mut covariance = (self.ground.information + prior.information)
            .cholesky()?
            .inverse();
        let mut mean = self.values;
        for &place in changed {
            covariance.column_mut(place).fill(0.0);
            covariance.row_mut(place).fill(0.0);
            covariance[(place, place)] = prior.std_devs[place].powi(2);
            mean[place] = prior.first_mean[place];
        }
        let information = covariance.cholesky()?.inverse();
        let is_known = information.iter().all(|value| value.is_finite());
        is_known.then(|| Prior {
            mean,
            information,
            ..prior.clone()
        })
    }
}
