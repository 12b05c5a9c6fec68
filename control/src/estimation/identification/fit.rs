//! Whether the newest blocks fit the present estimate.
//!
//! Once an estimate has converged, old blocks outweigh a new one. On ground that has changed, or with a
//! sensor that has failed, the estimate and its interval stay for many blocks what they were, though the
//! newest measurements contradict them. Their residuals show it at once: mean squares over a block are
//! compared with those of earlier blocks, channel by channel. A quantile above the median is usual, since
//! residuals grow in each tight turn. One block proves nothing, since a bump or a hard stop makes its
//! residuals large too.

use super::change::COMPARED;
use super::recent::RecentBlocks;

/// Mean square of a channel's residuals in a block, relative to the usual one, above which the block does
/// not fit.
const RATIO_MAX: f64 = 2.0;
/// Share of the earlier blocks that the usual mean square exceeds.
const USUAL_SHARE: f64 = 0.7;
/// Number of newest blocks that are judged, and of those that do not fit from which the estimate does not.
const JUDGED: usize = 5;
const MISFITS_MIN: usize = 3;
/// Minimum of the usual mean square: residuals as small as sensors and model are assumed to make them.
const USUAL_MIN: f64 = 1.0;
/// Minimum number of earlier blocks.
const BLOCKS_MIN: usize = 5;
/// Maximum squared standardised residual in a mean.
const SQUARE_MAX: f64 = 100.0;

/// Mean squares of the standardised residuals in blocks, by channel.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fit {
    /// Sums over the open block, and numbers of residuals.
    open: [(f64, f64); COMPARED],
    /// Mean squares of the last block, which are not among the usual ones yet.
    last: [Option<f64>; COMPARED],
    usual: [RecentBlocks; COMPARED],
    /// Largest ratio of a mean square to the usual one, for each of the newest blocks.
    ratios: [f64; JUDGED],
}

impl Fit {
    /// Creates the comparison without blocks.
    pub(super) const fn new() -> Self {
        Self {
            open: [(0.0, 0.0); COMPARED],
            last: [None; COMPARED],
            usual: [const { RecentBlocks::new() }; COMPARED],
            ratios: [0.0; JUDGED],
        }
    }

    /// Adds the standardised residual of a channel to the open block. One that is not finite is ignored.
    pub(super) fn add(&mut self, channel: usize, standardised: f64) {
        let square = standardised * standardised;
        if square.is_finite() {
            let (sum, count) = &mut self.open[channel];
            *sum += square.min(SQUARE_MAX);
            *count += 1.0;
        }
    }

    /// Ends a comparison: one channel of the last block is added to the usual ones, because all of them in
    /// one tick would make that tick longer.
    pub(super) fn end_comparison(&mut self) {
        let mut waiting = self.last.iter_mut().zip(&mut self.usual);
        if let Some((last, usual)) = waiting.find(|(last, _)| last.is_some()) {
            usual.add(last.take().unwrap_or_default());
        }
    }

    /// Ends the open block.
    pub(super) fn end_block(&mut self) {
        self.ratios.rotate_left(1);
        let mut ratio = 0.0_f64;
        for channel in 0..COMPARED {
            let (sum, count) = std::mem::take(&mut self.open[channel]);
            if count <= 0.0 {
                continue;
            }
            let square = sum / count;
            let usual = &self.usual[channel];
            let known = usual.quantile(USUAL_SHARE);
            if let Some(usual) = known.filter(|_| usual.count() >= BLOCKS_MIN) {
                ratio = ratio.max(square / usual.max(USUAL_MIN));
            }
            self.last[channel] = Some(square);
        }
        self.ratios[JUDGED - 1] = ratio;
    }

    /// Drops the open block.
    pub(super) fn drop_block(&mut self) {
        self.open = [(0.0, 0.0); COMPARED];
    }

    /// Returns the largest factor by which residuals of one of the newest blocks exceed the usual ones, as a
    /// ratio of root mean squares, if these blocks do not fit the estimate.
    pub(super) fn misfit_ratio(&self) -> Option<f64> {
        let misfits = self.ratios.iter().filter(|ratio| **ratio > RATIO_MAX);
        let largest = self.ratios.into_iter().fold(0.0, f64::max);
        (misfits.count() >= MISFITS_MIN).then(|| largest.sqrt())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Adds a block of twenty comparisons with residuals of this root mean square in one channel, and of
    /// one standard deviation in the others.
    fn add_block(fit: &mut Fit, channel: usize, root: f64) {
        for turn in 0..20 {
            for other in 0..COMPARED {
                let sign = if turn % 2 == 0 { 1.0 } else { -1.0 };
                fit.add(other, sign * if other == channel { root } else { 1.0 });
            }
            fit.end_comparison();
        }
        fit.end_block();
    }

    #[test]
    fn three_of_five_blocks_with_larger_residuals_do_not_fit() {
        for channel in 0..COMPARED {
            let mut fit = Fit::new();
            let mut fits_after = |roots: &[f64]| {
                for root in roots {
                    add_block(&mut fit, channel, *root);
                }
                fit.misfit_ratio().is_none()
            };
            assert!(fits_after(&[1.0; 20]));
            assert!(fits_after(&[3.0, 1.0, 3.0, 1.0, 1.0, 1.0]));
            assert!(fits_after(&[3.0, 3.0]));
            assert!(!fits_after(&[1.0, 3.0]));
            assert!(fits_after(&[1.0, 1.0, 1.0]));
        }
    }

    #[test]
    fn the_ratio_is_that_of_the_worst_of_the_newest_blocks() {
        let mut fit = Fit::new();
        for root in [[1.0; 12].as_slice(), &[3.0, 4.0, 3.0, 1.0]].concat() {
            add_block(&mut fit, 2, root);
        }
        assert_eq!(fit.misfit_ratio(), Some(4.0));
    }

    #[test]
    fn residuals_that_stay_large_become_usual() {
        let mut fit = Fit::new();
        for root in [[1.0; 20], [3.0; 20]].concat() {
            add_block(&mut fit, 0, root);
        }
        assert_eq!(fit.misfit_ratio(), None);
    }

    #[test]
    fn residuals_that_grow_in_each_turn_fit() {
        let mut fit = Fit::new();
        for second in 0..60 {
            let is_turn = second % 12 < 5;
            add_block(&mut fit, 0, if is_turn { 2.5 } else { 1.0 });
            assert_eq!(fit.misfit_ratio().filter(|_| second > 15), None, "{second}");
        }
    }

    proptest! {
        #[test]
        fn residuals_below_their_standard_deviation_always_fit(
            roots in prop::collection::vec(0.0..1.4, 1..60),
        ) {
            let mut fit = Fit::new();
            for root in roots {
                add_block(&mut fit, 1, root);
                prop_assert_eq!(fit.misfit_ratio(), None);
            }
        }
    }
}
