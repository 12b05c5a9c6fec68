//! Lower bound of the ground's peak friction coefficient from the friction that was used.
//!
//! A wheel or body that hits something shows a force that the ground did not give, in a block or
//! two. The bound is therefore a friction coefficient that several blocks used, not the largest;
//! while there are fewer blocks, it is the smallest of them. The blocks need not follow each other.

/// Number of blocks that must have used a friction coefficient: 0.8 s of driving, longer than a hit
/// and its rebound, and no longer than a pass through a cell.
const BLOCKS: usize = 4;

/// The largest friction coefficients used in blocks, in descending order; 0 where there is none.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct DemonstratedFriction {
    largest: [f64; BLOCKS],
}

impl DemonstratedFriction {
    /// Adds the friction coefficient used in a block.
    pub(super) fn add(&mut self, mu: f64) {
        let place = self.largest.partition_point(|larger| *larger >= mu);
        if let Some(smaller @ [_, ..]) = self.largest.get_mut(place..) {
            smaller.rotate_right(1);
            smaller[0] = mu;
        }
    }

    /// Returns the largest friction coefficients of the blocks of both operands.
    pub(super) fn plus(&self, other: &Self) -> Self {
        let mut both = *self;
        for mu in other.largest {
            both.add(mu);
        }
        both
    }

    /// Returns the largest friction coefficient that at least [`BLOCKS`] blocks reached; with fewer
    /// blocks that used friction, the smallest of theirs; `None` without any.
    pub(super) fn lower_bound(&self) -> Option<f64> {
        self.largest.into_iter().rev().find(|mu| *mu > 0.0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn of(used: &[f64]) -> DemonstratedFriction {
        let mut found = DemonstratedFriction::default();
        for mu in used {
            found.add(*mu);
        }
        found
    }

    fn used() -> impl Strategy<Value = Vec<f64>> {
        prop::collection::vec(0.0..1.5_f64, 0..20)
    }

    proptest! {
        #[test]
        fn the_bound_is_the_fourth_largest_or_the_smallest_of_fewer_in_any_order(
            mut all in used(), cut in 0..20_usize,
        ) {
            let cut = cut.min(all.len());
            let merged = of(&all[..cut]).plus(&of(&all[cut..]));
            prop_assert_eq!(merged, of(&all[cut..]).plus(&of(&all[..cut])));
            all.retain(|mu| *mu > 0.0);
            all.sort_by(f64::total_cmp);
            let expected = all.get(all.len().saturating_sub(BLOCKS)).copied();
            prop_assert_eq!(merged.lower_bound(), expected);
        }

        #[test]
        fn hits_in_fewer_blocks_do_not_raise_it_above_the_driving(
            driving in prop::collection::vec(0.01..0.3_f64, 1..20), hits in 1..BLOCKS,
        ) {
            let mut all = driving.clone();
            all.extend(std::iter::repeat_n(40.0, hits));
            let most = driving.iter().copied().fold(0.0, f64::max);
            prop_assert!(of(&all).lower_bound().unwrap() <= most);
        }
    }
}
