//! The normal equations at all time scales, and the choice of one of them.
//!
//! Where the shortest scale agrees with the next one, or that one has no solution, the equations of the longest one are solved
//! later, when the caller has time for it, because all three solutions together take most of a
//! tick. Results are the same to the last bit.

use super::blocks::Blocks;
use super::parameters::{Prior, Values};
use super::scale::{BlockEnd, ChannelResidual, TimeScale};

/// Numbers of comparisons in the means of the time scales: 0.05, 0.2 and 0.5 s.
const LENGTHS: [u32; 3] = [1, 4, 10];

/// The normal equations at each time scale. They are large and so on the heap; later hypotheses use them
/// again, because the control loop allocates nothing.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TimeScales {
    scales: [Box<TimeScale>; LENGTHS.len()],
    used: usize,
    /// Whether the last normal equations could be solved at any time scale; otherwise noise of the
    /// wheel speeds dominates the measurements.
    is_determined: bool,
    /// While there is one, the shortest scale is used.
    deferred: Option<Deferred>,
}

/// Deferred solution with the last block at the longest time scale.
#[derive(Debug, Clone, PartialEq)]
struct Deferred {
    /// Parameters about which the block was linearised.
    values: Values,
    /// Factor of the blocks' weights since the end of the block.
    weight_factor: f64,
}

impl TimeScales {
    /// Creates the equations without measurements.
    pub(super) fn new() -> Self {
        Self {
            scales: LENGTHS.map(|length| Box::new(TimeScale::new(length))),
            used: 0,
            is_determined: true,
            deferred: None,
        }
    }

    /// Removes all measurements.
    pub(super) fn clear(&mut self) {
        self.scales.iter_mut().for_each(|scale| scale.clear());
        self.used = 0;
        self.is_determined = true;
        self.deferred = None;
    }

    /// Returns the normal equations at the time scale that is used.
    pub(super) fn used(&self) -> &TimeScale {
        &self.scales[self.used]
    }

    /// Returns whether the last normal equations could be solved at any time scale.
    pub(super) fn is_determined(&self) -> bool {
        self.is_determined
    }

    /// Returns the factor, at least 1, by which a channel's residuals exceed their standard
    /// deviation, at the shortest scale.
    pub(super) fn residual_ratio(&self, channel: usize) -> f64 {
        self.scales[0].residual_ratio(channel)
    }

    /// Adds a comparison to the open means of its channel.
    pub(super) fn add(&mut self, channel: usize, compared: &ChannelResidual) {
        for scale in &mut self.scales {
            scale.add(channel, compared);
        }
    }

    /// Ends a comparison, of which all channels were added.
    pub(super) fn end_comparison(&mut self) {
        self.scales
            .iter_mut()
            .for_each(|scale| scale.end_comparison());
    }

    /// Drops the measurements of the open block.
    pub(super) fn drop_block(&mut self) {
        self.scales.iter_mut().for_each(|scale| scale.drop_block());
    }

    /// Drops the last block, which may contain samples of two grounds.
    pub(super) fn drop_last_block(&mut self) {
        debug_assert!(self.deferred.is_none());
        self.scales
            .iter_mut()
            .for_each(|scale| scale.drop_last_block());
    }

    /// Multiplies the weights of all complete blocks.
    pub(super) fn scale_weights(&mut self, ratio: f64) {
        let [first, second, third] = &mut self.scales;
        first.scale_weights(ratio);
        second.scale_weights(ratio);
        match &mut self.deferred {
            Some(deferred) => deferred.weight_factor *= ratio,
            None => third.scale_weights(ratio),
        }
    }

    /// Computes the variances of the used scale again, from the weights that the blocks have now.
    pub(super) fn update_variances(&mut self, prior: &Prior) {
        self.scales[self.used].update_variances(prior);
    }

    /// Takes the blocks of the open segment at the used scale; the ground keeps them.
    pub(super) fn take_segment(&mut self) -> Blocks {
        debug_assert!(self.deferred.is_none());
        let [first, second, third] = self.scales.each_mut().map(|scale| scale.take_segment());
        match self.used {
            0 => first,
            1 => second,
            _ => third,
        }
    }

    /// Ends the open block, which was linearised about `values`, and solves the normal equations.
    /// Returns the solution of the scale that is used from now on; None if no scale has one. Once the
    /// estimate `has_converged`, blocks with large residuals get less weight.
    ///
    /// The caller calls [`Self::solve_deferred`] before it drops or takes blocks.
    pub(super) fn end_block(
        &mut self,
        values: &Values,
        prior: &Prior,
        end: &BlockEnd,
        has_converged: bool,
    ) -> Option<Values> {
        self.solve_deferred(prior);
        for scale in &mut self.scales {
            scale.close_block(values, end, has_converged);
        }
        let [first, second, _] = &mut self.scales;
        let [of_first, of_second] =
            [first, second].map(|scale| scale.solve_with_block(values, prior));
        if self.is_trusted(0, &[of_first, of_second, None]) {
            self.used = 0;
            self.is_determined = true;
            self.deferred = Some(Deferred {
                values: *values,
                weight_factor: 1.0,
            });
            return of_first;
        }
        let [.., third] = &mut self.scales;
        let of_third = third.solve_with_block(values, prior);
        self.choose(&[of_first, of_second, of_third])
    }

    /// Does a part of the work that the end of the last block left: first the solution of deferred
    /// equations, then the comparison of the regimes of motion, step by step.
    pub(super) fn continue_deferred(&mut self, prior: &Prior) {
        if self.deferred.is_some() {
            self.solve_deferred(prior);
        } else {
            self.scales[self.used].compare_regimes(prior);
        }
    }

    /// Solves the equations that were deferred at the end of the last block.
    pub(super) fn solve_deferred(&mut self, prior: &Prior) {
        if let Some(deferred) = self.deferred.take() {
            let [.., third] = &mut self.scales;
            third.solve_with_block(&deferred.values, prior);
            third.scale_weights(deferred.weight_factor);
        }
    }

    /// Solves the normal equations again. Returns the solution of the scale that is used from now
    /// on; None if no scale has one.
    pub(super) fn solve(&mut self, prior: &Prior) -> Option<Values> {
        debug_assert!(self.deferred.is_none());
        let solutions = self.scales.each_mut().map(|scale| scale.solve(prior));
        self.choose(&solutions)
    }

    /// Chooses the shortest time scale that agrees with the next longer one, or for which that one
    /// has no solution. Returns its solution.
    fn choose(&mut self, solutions: &[Option<Values>; LENGTHS.len()]) -> Option<Values> {
        let trusted = (0..LENGTHS.len()).find(|&place| self.is_trusted(place, solutions));
        self.is_determined = trusted.is_some();
        self.used = trusted.unwrap_or(LENGTHS.len() - 1);
        solutions[self.used]
    }

    /// Returns whether a scale has a solution that agrees with that of the next longer one, if there
    /// is one.
    fn is_trusted(&self, place: usize, solutions: &[Option<Values>; LENGTHS.len()]) -> bool {
        let next = place + 1;
        let is_last = next == LENGTHS.len();
        let agrees = || self.scales[place].agrees_with(&self.scales[next]);
        solutions[place].is_some() && (is_last || solutions[next].is_none() || agrees())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::model::CHANNELS;
    use super::super::parameters::{self, index};
    use super::super::random_walk::RandomWalk;
    use super::super::regimes::Regime;
    use super::super::scale::Residual;
    use super::*;
    use crate::estimation::{EstimatorPrior, SensorNoise};

    /// A comparison of a channel with slopes that depend on `phase`.
    fn compared(value: f64, phase: f64) -> ChannelResidual {
        let mut slopes = Values::zeros();
        slopes[index::STIFFNESS] = phase.sin();
        slopes[index::MASS] = 0.5 * phase.cos();
        slopes[index::RADIUS] = 0.3;
        ChannelResidual {
            residual: Residual { value, slopes },
            noise: Residual {
                value: 0.0,
                slopes: Values::zeros(),
            },
            std_dev: 0.1,
            square_min: 0.3,
        }
    }

    proptest! {
        #[test]
        fn a_deferred_solution_is_that_at_the_end_of_the_block(
            blocks in prop::collection::vec(
                (prop::collection::vec(-0.2..0.2, 20), -0.2..0.2, 0.2..1.0), 1..5,
            ),
        ) {
            let prior = parameters::prior(&EstimatorPrior::default(), &SensorNoise::default());
            let (mut at_once, mut late) = (TimeScales::new(), TimeScales::new());
            let mut values = prior.mean;
            let mut was_deferred = false;
            for (residuals, speed, weight_factor) in blocks {
                for (turn, residual) in (0_u32..).zip(residuals) {
                    for scales in [&mut at_once, &mut late] {
                        scales.add(0, &compared(residual, 0.3 * f64::from(turn)));
                        scales.end_comparison();
                    }
                }
                let end = BlockEnd {
                    regime: Regime::TurnEntry,
                    gyro_walk: RandomWalk::of_gyro(&prior, 1.0),
                };
                let solution = at_once.end_block(&values, &prior, &end, false);
                at_once.solve_deferred(&prior);
                prop_assert_eq!(late.end_block(&values, &prior, &end, false), solution);
                was_deferred |= late.deferred.is_some();
                // The body speed of the next block comes before the solution.
                for scales in [&mut at_once, &mut late] {
                    scales.scale_weights(weight_factor);
                    scales.add(CHANNELS - 1, &compared(speed, 1.0));
                }
                late.solve_deferred(&prior);
                prop_assert_eq!(&late, &at_once);
                values = solution.unwrap_or(values);
            }
            prop_assert!(was_deferred);
        }
    }
}
