//! Recursive Gauss–Newton estimation of all parameters from one starting value of K.
//!
//! A prediction-error method (Ljung, System Identification, 2nd ed., ch. 11): the model is driven
//! by the measured wheel speeds, and its outputs are compared with the other sensors. The residuals
//! r of a block b are linearised about the parameters `p_b` that were in use during the block:
//! `r(p) = r_b − J_b (p − p_b)`. Earlier blocks lose weight when ln K moves away from the value at
//! which they were linearised: a step Δ of ln K multiplies their weights by
//!
//! ```text
//! exp(−3 Δ² / (R² + σ²/2))      R = LINEAR_RANGE, σ² = variance of ln K before the step
//! ```
//!
//! R is the range in which the expansion is accurate; it is larger where noise of the wheel speeds is
//! subtracted, to which most steps are then due. σ is added because the true ln K is expected
//! at the squared distance `σ² + Δ²` from `p_b`, and at σ² from the new value. As long as Δ is
//! below σ, the old expansion is nearly as close to the truth as a new one, and its information is
//! worth keeping. With R alone an estimate with little information, as on tyres that slide most of
//! the time, would never converge: each block would move it by more than R, which would delete all
//! earlier blocks, and so would the next one.
//!
//! With `C = (Σ Jᵀ W J + prior information)⁻¹` the covariance is the
//! robust one, `C (Σ g gᵀ + prior information) C`: the empirical scatter of the blocks' scores
//! `g = Jᵀ W r` replaces the assumption of white residuals and a true model. The residuals of a score
//! are those at the solution with its block.

use super::fast_changes::FastChanges;
use super::model::{CHANNELS, Input, State};
use super::parameters::{Number, Prior, Values, index, ln_stiffness_gradient};
use super::physical::Robot;
use super::scale::{BlockEnd, ChannelResidual, Residual, TimeScale};
use super::scales::TimeScales;
use super::simulation::{ChannelOutput, Predicted, Simulation, delays_s};
use crate::robot::RobotModel;

/// Channels of the accelerations.
const ACCELERATIONS: std::ops::RangeInclusive<usize> = 1..=2;
/// R, the change of a precisely known ln K that multiplies the weights of older blocks by e⁻³.
const LINEAR_RANGE: f64 = 0.1;
/// Number of blocks in which a large step of ln K is that of a starting value to the true one;
/// later ones are due to noise of the wheel speeds.
const SETTLING_BLOCKS: u32 = 6;
/// Fraction of the variance σ² that is added to R². With all of it, first expansions would be kept
/// that took noise of the wheel speeds for slip, before it is known and subtracted.
const VARIANCE_SHARE: f64 = 0.5;
/// R and that fraction where noise of the wheel speeds is subtracted. Steps of ln K are then due to
/// noise for the most part, and say little about the accuracy of earlier expansions.
const NOISY_LINEAR_RANGE: f64 = 0.3;
const NOISY_VARIANCE_SHARE: f64 = 1.0;
/// Factors of the blocks' weights below which the variance of ln K is computed again, and the
/// number of blocks in which the first one applies. Later expansions are close to each other, so
/// that the variance hardly changes and can wait for the next block; the first ones can be far
/// apart.
const REFRESH_BELOW_EARLY: f64 = 0.9;
const REFRESH_BELOW: f64 = 0.01;
/// Number of blocks in which an estimate converges from its starting value, so that residuals and steps
/// can be large.
const CONVERGES_BLOCKS: u32 = 15;
/// Factor of the last step on the weights of the blocks, from which the former weights can be
/// restored.
const RESTORE_ABOVE: f64 = 1.0e-3;
/// Maximum magnitude of the change of ln K at the end of one block.
const STEP_MAX: f64 = 0.4;
/// Minimum of that maximum once the estimate has converged.
const CONVERGED_STEP_MIN: f64 = 0.03;
/// Maximum squared standardised residual in the cost.
const COST_MAX: f64 = 25.0;
/// Factor by which each later block multiplies the cost so far.
const COST_DECAY: f64 = 0.95;

/// Estimate of ln K from one segment, and the parts of its variance.
#[derive(Debug, Clone, Copy)]
pub(super) struct SegmentEstimate {
    /// Estimate of ln K.
    pub(super) ln_stiffness: f64,
    /// Variance of ln K from the measurement noise of the segment's own blocks; independent between
    /// segments.
    pub(super) own: f64,
    /// Variance of ln K from the uncertainty of all other parameters, which come from the ground's
    /// other blocks and the prior, without that from the tyres' prior; common to the segments of a
    /// robot.
    pub(super) of_robot: f64,
    /// Variance of ln K from the prior of the tyres.
    pub(super) of_tyres: f64,
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
    /// Minimum of the mean square of the channel's standardised residuals in its weights.
    pub(super) square_min: f64,
}

/// Estimator that started at one value of K: the model's state, the estimated parameters and their
/// normal equations.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Hypothesis {
    values: Values,
    /// The same in SI units; None since they changed.
    robot: Option<Robot<Number>>,
    model: Simulation<Number>,
    /// The same with noise added to the wheel speeds; None if they have none.
    perturbed: Option<Simulation<Number>>,
    pub(super) scales: TimeScales,
    /// Fast changes of the accelerations: measured, in the output, and by the added noise.
    fast: FastChanges,
    cost: f64,
    /// Factor by which the step after the last block multiplied the weights of all blocks.
    last_weight_factor: f64,
    /// Variance of ln K with the weights that the blocks had before that step.
    variance_before_step: f64,
    /// Number of complete blocks.
    age: u32,
}

impl Hypothesis {
    /// Creates an estimator at the prior's mean with another ln K; the robot moves as in `state`.
    /// Clears the equations `scales` and uses them.
    pub(super) fn new(
        prior: &Prior,
        ln_stiffness: f64,
        state: State<f64>,
        mut scales: TimeScales,
    ) -> Self {
        scales.clear();
        let mut values = prior.mean;
        values[index::STIFFNESS] = ln_stiffness;
        Self {
            values,
            robot: None,
            model: Simulation::new(state.constants()),
            perturbed: None,
            scales,
            fast: FastChanges::new(),
            cost: 0.0,
            last_weight_factor: 1.0,
            variance_before_step: f64::INFINITY,
            age: 0,
        }
    }

    /// Continues from a given state of motion after a gap in the samples; drops the open block.
    pub(super) fn restart(&mut self, state: State<f64>) {
        self.model = Simulation::new(state.constants());
        self.perturbed = None;
        self.drop_block();
    }

    /// Returns the state of motion, without derivatives.
    pub(super) fn motion(&self) -> State<f64> {
        self.model.motion()
    }

    /// Returns the factor, at least 1, by which a channel's residuals exceed their standard deviation.
    pub(super) fn residual_ratio(&self, channel: usize) -> f64 {
        self.scales.residual_ratio(channel)
    }

    /// Drops the measurements of the open block.
    pub(super) fn drop_block(&mut self) {
        self.fast.drop_block();
        self.scales.drop_block();
    }

    /// Returns the normal equations at the time scale that is used.
    pub(super) fn scale(&self) -> &TimeScale {
        self.scales.used()
    }

    fn set_values(&mut self, values: Values) {
        self.values = values;
        self.robot = None;
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

    /// Returns whether the estimate had time to converge from its starting value.
    pub(super) fn has_converged(&self) -> bool {
        self.age > CONVERGES_BLOCKS
    }

    /// Returns the factor by which the last step multiplied the weights of all blocks.
    #[cfg(test)]
    pub(super) fn weight_factor(&self) -> f64 {
        self.last_weight_factor
    }

    /// Returns the largest of the channels' mean squares of standardised residuals; about 1 if
    /// noise and model are as assumed.
    pub(super) fn worst_square(&self) -> f64 {
        self.scale().worst_square()
    }

    /// Advances the model by one sample and adds its outputs to the mean with the weight `share`;
    /// likewise the model with noise, if there is a `perturbed` input.
    pub(super) fn advance(
        &mut self,
        model: &RobotModel,
        input: &Input,
        perturbed: Option<&Input>,
        share: f64,
    ) {
        let values = &self.values;
        let robot = self.robot.get_or_insert_with(|| {
            let numbers = std::array::from_fn(|place| Number::parameter(values[place], place));
            Robot::new(&numbers, model)
        });
        match perturbed {
            Some(input) => {
                let own = self.perturbed.get_or_insert_with(|| self.model.clone());
                own.advance(robot, input, share);
            }
            // Noise that is none for a time begins with the state of the robot of then.
            None => self.perturbed = None,
        }
        self.model.advance(robot, input, share);
    }

    /// Returns the forward speed at the end of the last sample, metres per second; None before the
    /// first one.
    pub(super) fn forward_speed(&self) -> Option<ChannelOutput> {
        let of = |own: &Simulation<Number>| own.forward_m_s().map(Predicted::of);
        of(&self.model).map(|output| ChannelOutput {
            output,
            perturbed: self.perturbed.as_ref().and_then(of),
        })
    }

    /// Returns the mean outputs since the last call, `compared_s` seconds ago, in the order of the
    /// channels without the body speed, and begins a new mean.
    pub(super) fn take_outputs(&mut self, compared_s: f64) -> [ChannelOutput; CHANNELS - 1] {
        let delays_s = delays_s(&self.values);
        let take = |own: &mut Simulation<Number>| own.take_outputs(compared_s).measured(delays_s);
        let outputs = take(&mut self.model);
        let perturbed = self.perturbed.as_mut().map(take);
        std::array::from_fn(|channel| ChannelOutput {
            output: outputs[channel],
            perturbed: perturbed.map(|perturbed| perturbed[channel]),
        })
    }

    /// Adds the residual of an output to the open block. A residual that is not finite is ignored.
    pub(super) fn compare(&mut self, predicted: &ChannelOutput, measured: Measured) {
        let ChannelOutput { output, perturbed } = predicted;
        let (channel, std_dev) = (measured.channel, measured.std_dev);
        let residual = Residual {
            value: measured.value - output.value,
            slopes: output.slopes,
        };
        let square = (residual.value / std_dev).powi(2);
        if !square.is_finite() {
            return;
        }
        let mut noise = Residual {
            value: 0.0,
            slopes: Values::zeros(),
        };
        let changed = perturbed.map_or(0.0, |perturbed| perturbed.value - output.value);
        if let Some(place) = ACCELERATIONS.into_iter().position(|own| own == channel) {
            self.fast.add(
                place,
                [measured.value, output.value, changed].map(|value| value / std_dev),
            );
        }
        if let Some(perturbed) = perturbed {
            let off = (changed / std_dev).powi(2).min(COST_MAX);
            let ratio = self.fast.noise_ratio();
            noise.value = ratio * changed;
            noise.slopes = (perturbed.slopes - residual.slopes) * ratio;
            self.cost -= ratio * ratio * off;
        }
        let compared = ChannelResidual {
            residual,
            noise,
            std_dev,
            square_min: measured.square_min,
        };
        self.scales.add(channel, &compared);
        self.cost += square.min(COST_MAX);
    }

    /// Ends a comparison of the means since the last call.
    pub(super) fn end_comparison(&mut self) {
        self.scales.end_comparison();
    }

    /// Ends the open block and takes a bounded Gauss–Newton step from all blocks of the ground and
    /// the prior. Returns false if a parameter is not finite.
    pub(super) fn end_block(&mut self, prior: &Prior, end: &BlockEnd) -> bool {
        let values = self.values;
        self.last_weight_factor = 1.0;
        self.fast.end_block();
        self.age = self.age.saturating_add(1);
        self.cost *= COST_DECAY;
        let has_converged = self.has_converged();
        let Some(solution) = self.scales.end_block(&values, prior, end, has_converged) else {
            // The same values are used until the equations can be solved.
            return true;
        };
        let mut step = solution - self.values;
        let largest = step
            .zip_map(&prior.std_devs, |step, std_dev| step.abs() / std_dev)
            .max();
        step /= largest
            .max(step[index::STIFFNESS].abs() / self.step_max())
            .max(1.0);
        let before = self.values;
        self.set_values(prior.in_range(before + step));
        let step = self.values - before;
        for own in std::iter::once(&mut self.model).chain(&mut self.perturbed) {
            own.shift(&step);
        }
        let (range, share) = if self.perturbed.is_some() {
            (NOISY_LINEAR_RANGE, NOISY_VARIANCE_SHARE)
        } else {
            (LINEAR_RANGE, VARIANCE_SHARE)
        };
        let range_square = range.powi(2) + share * self.scale().nominal_variance();
        let weight_factor = (-3.0 * step[index::STIFFNESS].powi(2) / range_square).exp();
        self.variance_before_step = self.scale().variance();
        self.scales.scale_weights(weight_factor);
        let limit = if self.age <= CONVERGES_BLOCKS {
            REFRESH_BELOW_EARLY
        } else {
            REFRESH_BELOW
        };
        if weight_factor < limit {
            self.scales.update_variances(prior);
        }
        self.last_weight_factor = weight_factor;
        if self.age <= SETTLING_BLOCKS && step[index::STIFFNESS].abs() > LINEAR_RANGE {
            self.fast.clear();
        }
        self.values.iter().all(|value| value.is_finite())
    }

    /// Does a part of the work that the end of the last block left, about as long as a solution of the
    /// normal equations.
    pub(super) fn continue_deferred(&mut self, prior: &Prior) {
        self.scales.continue_deferred(prior);
    }

    /// Solves the equations that were deferred at the end of the last block.
    pub(super) fn solve_deferred(&mut self, prior: &Prior) {
        self.scales.solve_deferred(prior);
    }

    /// Returns the maximum magnitude of the change of ln K at the end of a block. Once the estimate
    /// has converged that is its nominal standard deviation: a larger change is due to outliers, or to a change of the
    /// ground that was not detected, which takes more blocks to follow.
    fn step_max(&self) -> f64 {
        if self.age <= CONVERGES_BLOCKS {
            return STEP_MAX;
        }
        let std_dev = self.scale().nominal_variance().sqrt();
        std_dev.clamp(CONVERGED_STEP_MIN, STEP_MAX)
    }

    /// Returns whether the last normal equations could be solved at any time scale.
    pub(super) fn is_determined(&self) -> bool {
        self.scales.is_determined()
    }

    /// Returns whether most of the output's fast changes are noise of the wheel speeds, which the
    /// accelerometer does not measure.
    pub(super) fn is_noisy(&self) -> bool {
        self.fast.is_noise()
    }

    /// Returns the variance of ln K, and the part of it that the prior contributes. The first is at
    /// least the nominal variance, the diagonal element of C.
    pub(super) fn variances(&self, prior: &Prior) -> (f64, f64) {
        self.scale().variances(prior)
    }

    /// Returns the variance of ln K before the step at the end of the last block, infinite before
    /// the first one. The detection of changes needs it: the step by a block of new ground deletes
    /// most information on the old one.
    pub(super) fn variance_before_step(&self) -> f64 {
        self.variance_before_step
    }

    /// Returns the robust variances of linear functions of the parameters, given their gradients.
    /// None if the normal equations cannot be solved.
    pub(super) fn variances_of<const COUNT: usize>(
        &self,
        prior: &Prior,
        slopes: &[Values; COUNT],
    ) -> Option<[f64; COUNT]> {
        let ground = &self.scale().ground;
        let cholesky = (ground.information + prior.information).cholesky()?;
        let few = 1.0 + 2.0 / ground.count.max(1.0);
        Some(slopes.map(|slopes| {
            let covariances = cholesky.solve(&slopes);
            let scattered = few * (self.scale().scores * covariances).dot(&covariances);
            let known = (prior.information * covariances).dot(&covariances);
            (scattered + known).max(covariances.dot(&slopes))
        }))
    }

    /// Drops the last block and the open one, which may contain samples of two grounds, and takes
    /// the parameters from the other blocks with their former weights, because those after the last
    /// block may be of the next ground.
    pub(super) fn drop_last_block(&mut self, prior: &Prior) {
        self.scales.drop_last_block();
        self.drop_block();
        if self.last_weight_factor >= RESTORE_ABOVE {
            let restored = self.last_weight_factor.recip();
            self.scales.scale_weights(restored);
            self.last_weight_factor = 1.0;
        }
        if let Some(values) = self.scales.solve(prior) {
            self.set_values(prior.in_range(values));
        }
    }

    /// Ends the segment and returns ln K from its own blocks.
    ///
    /// The ground's other blocks and the prior contribute the other parameters only: ln K is
    /// marginalised from them. So K may differ between segments, and the segments' own errors are
    /// independent. None if the segment has no blocks, or its normal equations cannot be solved.
    pub(super) fn close_segment(&mut self, prior: &Prior) -> Option<SegmentEstimate> {
        let segment = self.scales.take_segment();
        let scale = self.scale();
        let ground = &scale.ground;
        if segment.count <= 0.0 {
            return None;
        }
        let mut others = ground.information - segment.information + prior.information;
        let mut information_vector =
            ground.information_vector - segment.information_vector + prior.information_vector;
        // K of the other blocks is marginalised.
        let of_stiffness: Values = others.column(index::STIFFNESS).into();
        let most = of_stiffness[index::STIFFNESS];
        information_vector -= of_stiffness * (information_vector[index::STIFFNESS] / most);
        others.ger(-most.recip(), &of_stiffness, &of_stiffness, 1.0);
        let cholesky = (others + segment.information).cholesky()?;
        let values = cholesky.solve(&(information_vector + segment.information_vector));
        let values = prior.limited(values, |gradient| cholesky.solve(gradient));
        let of_stiffness = cholesky.solve(&ln_stiffness_gradient());
        // The segment has too few blocks for a scatter of its own: that of the whole ground is
        // used.
        let whole =
            (ground.information * scale.stiffness_covariance).dot(&scale.stiffness_covariance);
        let scatter = (scale.scattered() / whole).max(1.0);
        let own = scatter * (segment.information * of_stiffness).dot(&of_stiffness);
        let known = (others * of_stiffness).dot(&of_stiffness);
        let of_tyres = prior.tyre_variance(&of_stiffness);
        let found = SegmentEstimate {
            ln_stiffness: values[index::STIFFNESS],
            own,
            of_robot: (known - of_tyres).max(0.0),
            of_tyres,
        };
        let is_known = found.ln_stiffness.is_finite() && known.is_finite() && own > 0.0;
        (is_known && own.is_finite()).then_some(found)
    }

    /// Returns the posterior as the prior of the next ground or load: the parameters `changed` are
    /// reset to the initial prior, all others keep mean and covariance. None if it cannot be
    /// computed.
    pub(super) fn prior_without(&self, prior: &Prior, changed: &[usize]) -> Option<Prior> {
        let mut covariance = (self.scale().ground.information + prior.information)
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
        is_known.then(|| {
            let mut posterior = prior.clone();
            posterior.set(&mean, &information);
            posterior
        })
    }
}
