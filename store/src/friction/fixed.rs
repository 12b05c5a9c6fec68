//! Fixed-point sums, which do not depend on the order of their addends.
//!
//! A value is `hi + lo / 2³²` with `0 ≤ lo < 2³²`. Sums of floating-point numbers depend on their
//! order, sums of integers do not. Each addend is rounded once, to 2.3·10⁻¹⁰.

use std::iter::Sum;
use std::ops::{Add, AddAssign};

/// Steps per unit, 2³².
const SCALE: f64 = 4_294_967_296.0;

/// A fixed-point number in steps of 2⁻³². Additions saturate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Hash)]
pub struct Fixed(i128);

impl Fixed {
    /// Rounds a number to fixed point; `None` if it is not finite or beyond ±9·10¹⁸.
    pub fn from_f64(value: f64) -> Option<Self> {
        let steps = (value * SCALE).round();
        let bound = SCALE * 9.0e18;
        #[expect(clippy::cast_possible_truncation, reason = "below 2^95")]
        (steps.abs() <= bound).then_some(Self(steps as i128))
    }

    /// Returns the number of this many whole units, the first one of [`Self::halves`].
    pub fn from_units(units: i64) -> Self {
        Self(i128::from(units) << 32)
    }

    /// Returns the number of this many steps, the second one of [`Self::halves`].
    pub fn from_steps(steps: i64) -> Self {
        Self(steps.into())
    }

    /// Splits the number into whole units, rounded down, and the rest in steps, 0 to 2³² − 1.
    ///
    /// Returns `None` if the whole units exceed 64 bits, the range of the database.
    pub fn halves(self) -> Option<(i64, i64)> {
        let hi = i64::try_from(self.0 >> 32).ok()?;
        let lo = i64::try_from(self.0 & 0xFFFF_FFFF).ok()?;
        Some((hi, lo))
    }

    /// Splits the number as [`Self::halves`] does, with whole units beyond 64 bits brought to the end of
    /// the range: a sum that overflows in the database becomes the same.
    pub fn clamped_halves(self) -> (i64, i64) {
        let end = if self.0 < 0 { i64::MIN } else { i64::MAX };
        let hi = i64::try_from(self.0 >> 32).unwrap_or(end);
        (hi, i64::try_from(self.0 & 0xFFFF_FFFF).unwrap_or_default())
    }

    /// Returns the nearest floating-point number.
    #[expect(
        clippy::cast_precision_loss,
        reason = "rounding once is what is wanted"
    )]
    pub fn to_f64(self) -> f64 {
        self.0 as f64 / SCALE
    }
}

impl Add for Fixed {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self(self.0.saturating_add(other.0))
    }
}

impl AddAssign for Fixed {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl Sum for Fixed {
    fn sum<I: Iterator<Item = Self>>(parts: I) -> Self {
        parts.fold(Self::default(), Add::add)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_sum_does_not_depend_on_the_order_of_its_parts(
            (parts, shuffled) in prop::collection::vec(-5.0e11_f64..5.0e11, 0..60)
                .prop_flat_map(|parts| (Just(parts.clone()), Just(parts).prop_shuffle())),
        ) {
            let sum = |parts: &[f64]| -> Fixed {
                parts.iter().map(|&part| Fixed::from_f64(part).unwrap()).sum()
            };
            prop_assert_eq!(sum(&parts), sum(&shuffled));
        }

        #[test]
        fn halves_give_back_the_whole(value in -5.0e11_f64..5.0e11) {
            let fixed = Fixed::from_f64(value).unwrap();
            let (hi, lo) = fixed.halves().unwrap();
            prop_assert!((0..1_i64 << 32).contains(&lo));
            prop_assert_eq!(Fixed::from_units(hi) + Fixed::from_steps(lo), fixed);
            prop_assert!((fixed.to_f64() - value).abs() <= 2.0_f64.powi(-33) + value.abs() * 1e-15);
        }
    }

    #[test]
    fn what_is_no_number_has_no_fixed_point() {
        for bad in [f64::NAN, f64::INFINITY, -1.0e19] {
            assert_eq!(Fixed::from_f64(bad), None);
        }
    }
}
