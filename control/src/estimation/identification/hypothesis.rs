//! Recursive Gauss–Newton estimation of all parameters from one starting value of K.
//!
//! A prediction-error method (Ljung, System Identification, 2nd ed., ch. 11): the model is driven
//! by the measured wheel speeds, and its outputs are compared with the other sensors. Residuals are
//! linear in the parameters about those of their block: `r(p) = r_b − J_b (p − p_b)`. What was
//! linearised elsewhere is forgotten. The covariance is the sandwich `C Σ g gᵀ C`, in which the
//! scores g of blocks scatter as they do, whether or not residuals are white and the model true.

use super::dual::{Dual, Real};
use super::model::{Input, Output, State};
use super::parameters::{PARAMETERS, Robot, SHAPE_MIN, Square, Values, index};
use crate::robot::RobotModel;

/// Channels: turn rate, acceleration (forward, left), torque (left, right), body speed.
pub(super) const CHANNELS: usize = 6;
/// Change of ln K that makes older linearisations count e⁻³ times as much.
const LINEAR_RANGE: f64 = 0.1;
/// Share of its information that a block loses with each later block: offsets drift.
const BLOCK_FORGETS: f64 = 0.002;
/// Largest change of ln K in one block.
const STEP_MAX: f64 = 0.4;
/// Range in which parameters stay, in standard deviations of their prior.
const PRIOR_RANGE: f64 = 5.0;
/// Residual over its standard deviation from which on it counts less (Huber).
const HUBER: f64 = 3.0;
/// Share by which each residual updates the mean square of its channel.
const SQUARE_GAIN: f64 = 0.005;
/// Largest square of a residual in that mean, and in the cost.
const SQUARE_MAX: f64 = 100.0;
const COST_MAX: f64 = 25.0;
/// Blocks whose scatter says how innovations scatter.
const INNOVATION_BLOCKS_MIN: u32 = 15;
/// Share of the cost that is left after another block.
const COST_KEEPS: f64 = 0.95;

/// A dual number of the parameters.
pub(super) type Number = Dual<PARAMETERS>;

/// What is known before a ground is driven on.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Prior {
    pub(super) mean: Values,
    pub(super) information: Square,
    /// Standard deviations before anything was measured, for the steps' size.
    pub(super) std_devs: Values,
    /// The means that belong to them.
    pub(super) first_mean: Values,
}

impl Prior {
    pub(super) fn new(mean: Values, std_devs: Values) -> Self {
        Self {
            mean,
            information: Square::from_diagonal(&std_devs.map(|std_dev| std_dev.powi(-2))),
            std_devs,
            first_mean: mean,
        }
    }
}

/// Blocks of measurements, linearised about the present values.
#[derive(Debug, Clone, PartialEq)]
struct Blocks {
    /// Their information, and its product with the values that they prefer.
    information: Square,
    preferred: Values,
    /// Sum of the squares of their scores.
    scores: Square,
    /// Blocks that still count.
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

/// ln K of one segment, and variances of it.
#[derive(Debug, Clone, Copy)]
pub(super) struct OfSegment {
    pub(super) ln_stiffness: f64,
    /// By the segment's own blocks.
    pub(super) own: f64,
    /// By the robot's other parameters, as all other blocks and the prior know them.
    pub(super) known: f64,
}

/// A measurement of one channel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Measured {
    pub(super) channel: usize,
    pub(super) value: f64,
    pub(super) std_dev: f64,
}

/// One sequence of estimates.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Hypothesis {
    values: Values,
    state: State<Number>,
    /// All blocks of this ground.
    ground: Blocks,
    /// Those of the open segment but the last one, which may be of the next ground already.
    segment: Blocks,
    last: Blocks,
    /// Of the open block.
    block_information: Square,
    block_score: Values,
    /// Mean outputs since the last comparison.
    mean: Output<Number>,
    /// Mean square of each channel's standardised residuals.
    squares: [f64; CHANNELS],
    cost: f64,
    /// Covariances of ln K with all parameters.
    of_stiffness: Values,
    /// Score of the open block in that direction, as far as it was taken as an innovation.
    score_taken: f64,
    /// Variance of a block's score in that direction.
    block_variance: f64,
    /// Blocks since it began.
    age: u32,
}

impl Hypothesis {
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

    /// Goes on from another state of motion, after a time of which nothing is known.
    pub(super) fn restart(&mut self, state: State<f64>) {
        let [forward_m_s, left_m_s] = state.speed_m_s;
        self.state = State::rolling(forward_m_s, state.turn_rad_s);
        self.state.speed_m_s[1] = Number::constant(left_m_s);
        self.mean = Output::zero();
        self.drop_block();
    }

    /// What the measurements since the last call tell of ln K, over the standard deviation that they
    /// have by the scatter of the blocks, if each block has this many of them. Positive if K is larger
    /// than it was taken for. None before blocks have scattered.
    pub(super) fn innovation(&mut self, per_block: f64) -> Option<f64> {
        let score = self.of_stiffness.dot(&self.block_score);
        let new = score - std::mem::replace(&mut self.score_taken, score);
        (self.age >= INNOVATION_BLOCKS_MIN && self.block_variance > 0.0)
            .then(|| new / (self.block_variance / per_block).sqrt())
    }

    /// Drops what the open block holds.
    pub(super) fn drop_block(&mut self) {
        self.score_taken = 0.0;
        self.block_information = Square::zeros();
        self.block_score = Values::zeros();
    }

    pub(super) fn values(&self) -> &Values {
        &self.values
    }

    pub(super) fn cost(&self) -> f64 {
        self.cost
    }

    pub(super) fn age(&self) -> u32 {
        self.age
    }

    /// Mean square of the standardised residuals of the channel that fits least.
    pub(super) fn worst_square(&self) -> f64 {
        self.squares.into_iter().fold(0.0, f64::max)
    }

    /// Moves the model on by a sample, of which the mean takes this share.
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

    /// The mean outputs since the last call, in the order of the channels.
    pub(super) fn take_mean(&mut self) -> [Number; CHANNELS - 1] {
        let mean = std::mem::replace(&mut self.mean, Output::zero());
        let [forward, left] = mean.acceleration_m_s2;
        let [torque_left, torque_right] = mean.torques_n_m;
        [mean.turn_rad_s, forward, left, torque_left, torque_right]
    }

    /// Compares an output with its measurement.
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

    /// Ends a block: all blocks together give new values. Returns false if they are none.
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

    /// The state of motion that the model would have with values that differ by a step.
    fn shift_state(&mut self, step: &Values) {
        let shift = |number: &mut Number| {
            let slopes = number.derivatives.iter().zip(step.iter());
            number.value += slopes.map(|(slope, step)| slope * step).sum::<f64>();
        };
        self.state.speed_m_s.iter_mut().for_each(shift);
        shift(&mut self.state.turn_rad_s);
        self.state.deflections.iter_mut().flatten().for_each(shift);
    }

    /// Variances of ln K: all of it, and the part that comes from what was known beforehand.
    pub(super) fn variances(&self, prior: &Prior) -> (f64, f64) {
        let of_stiffness = self.of_stiffness;
        let scattered = self.scattered();
        let known = (prior.information * of_stiffness).dot(&of_stiffness);
        let nominal = of_stiffness[index::STIFFNESS];
        ((scattered + known).max(nominal), known)
    }

    /// Variance of ln K by the scatter of the blocks.
    fn scattered(&self) -> f64 {
        // Few scores scatter less than they will.
        let few = 1.0 + 2.0 / self.ground.count.max(1.0);
        few * (self.ground.scores * self.of_stiffness).dot(&self.of_stiffness)
    }

    /// Variances of linear functions of the parameters. Blocks scatter as they do. None if nothing
    /// follows from the blocks.
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

    /// Drops the last block and the open one: they may be of either ground.
    pub(super) fn drop_last_block(&mut self) {
        self.ground.add(&self.last, -1.0);
        self.last = Blocks::none();
        self.drop_block();
    }

    /// Ends the segment. ln K follows from its own blocks, with the robot's other parameters as the
    /// ground's other blocks and the prior know them: those blocks tell nothing of K here, so that K
    /// of segments may differ and their own errors are independent. None if it has no blocks, or
    /// nothing follows from them.
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
        // Blocks scatter as those of the whole ground do.
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

    /// What this tells beforehand where some of the parameters have changed: all others.
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
