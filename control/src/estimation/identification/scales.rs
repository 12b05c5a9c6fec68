//! The normal equations at all time scales, and the choice of one of them.

use super::parameters::{Prior, Values};
use super::scale::{Blocks, ChannelResidual, TimeScale};

/// Numbers of comparisons in the means of the time scales: 0.05, 0.2 and 0.5 s.
const LENGTHS: [u32; 3] = [1, 4, 10];

/// The normal equations at each time scale.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TimeScales {
    scales: [TimeScale; LENGTHS.len()],
    used: usize,
    /// Whether the last normal equations could be solved at any time scale; otherwise noise of the
    /// wheel speeds dominates the measurements.
    is_determined: bool,
}

impl TimeScales {
    /// Creates the equations without measurements.
    pub(super) fn new() -> Self {
        Self {
            scales: LENGTHS.map(TimeScale::new),
            used: 0,
            is_determined: true,
        }
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
        self.scales.iter_mut().for_each(TimeScale::end_comparison);
    }

    /// Drops the measurements of the open block.
    pub(super) fn drop_block(&mut self) {
        self.scales.iter_mut().for_each(TimeScale::drop_block);
    }

    /// Drops the last block, which may contain samples of two grounds.
    pub(super) fn drop_last_block(&mut self) {
        self.scales.iter_mut().for_each(TimeScale::drop_last_block);
    }

    /// Multiplies the weights of all complete blocks.
    pub(super) fn scale_weights(&mut self, ratio: f64) {
        for scale in &mut self.scales {
            scale.scale_weights(ratio);
        }
    }

    /// Computes the variances of the used scale again, from the weights that the blocks have now.
    pub(super) fn update_variances(&mut self, prior: &Prior) {
        self.scales[self.used].update_variances(prior);
    }

    /// Takes the blocks of the open segment at the used scale; the ground keeps them.
    pub(super) fn take_segment(&mut self) -> Blocks {
        let [first, second, third] = self.scales.each_mut().map(TimeScale::take_segment);
        match self.used {
            0 => first,
            1 => second,
            _ => third,
        }
    }

    /// Ends the open block, which was linearised about `values`, and solves the normal equations.
    /// Returns the solution of the scale that is used from now on; None if no scale has one. Once the
    /// estimate `has_converged`, blocks with large residuals get less weight.
    pub(super) fn end_block(
        &mut self,
        values: &Values,
        prior: &Prior,
        has_converged: bool,
    ) -> Option<Values> {
        let solutions = self
            .scales
            .each_mut()
            .map(|scale| scale.end_block(values, prior, has_converged));
        self.choose(&solutions, prior)
    }

    /// Solves the normal equations again. Returns the solution of the scale that is used from now
    /// on; None if no scale has one.
    pub(super) fn solve(&mut self, prior: &Prior) -> Option<Values> {
        let solutions = self.scales.each_mut().map(|scale| scale.solve(prior));
        self.choose(&solutions, prior)
    }

    /// Chooses the shortest time scale that agrees with the next longer one, or for which that one
    /// has no solution. Returns its solution.
    fn choose(
        &mut self,
        solutions: &[Option<Values>; LENGTHS.len()],
        prior: &Prior,
    ) -> Option<Values> {
        let is_trusted = |place: usize| {
            let next = place + 1;
            let is_last = next == LENGTHS.len();
            let agrees = || self.scales[place].agrees_with(&self.scales[next], prior);
            solutions[place].is_some() && (is_last || solutions[next].is_none() || agrees())
        };
        let trusted = (0..LENGTHS.len()).find(|&place| is_trusted(place));
        self.is_determined = trusted.is_some();
        self.used = trusted.unwrap_or(LENGTHS.len() - 1);
        solutions[self.used]
    }
}
