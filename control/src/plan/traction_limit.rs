//! Lower bound of the peak friction coefficient by position.

use crate::geometry::Point;

/// Square of a grid with its peak friction coefficient.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TractionLimitCell {
    /// Index along x: floor of the coordinate over the side length, site frame.
    pub ix: i32,
    /// Index along y: floor of the coordinate over the side length, site frame.
    pub iy: i32,
    /// Lower bound of the peak friction coefficient, above zero.
    pub mu: f64,
}

/// Content of a [`TractionLimitMap`].
#[derive(Debug, Clone, PartialEq)]
pub struct TractionLimitMapSpec {
    /// Side length of a square, metres.
    pub square_m: f64,
    /// Known squares, in any order.
    pub squares: Vec<TractionLimitCell>,
    /// Lower bound of the peak friction coefficient away from all squares.
    pub elsewhere_mu: f64,
}

/// Lower bounds of the peak friction coefficient by position, on a grid of squares in the site
/// frame.
#[derive(Debug, Clone, PartialEq)]
pub struct TractionLimitMap {
    /// The squares are sorted by `(iy, ix)`.
    spec: TractionLimitMapSpec,
}

impl TractionLimitMap {
    /// Creates a map. Returns None if a value is not finite or not above zero.
    pub fn new(mut spec: TractionLimitMapSpec) -> Option<Self> {
        let is_possible = |value: f64| value.is_finite() && value > 0.0;
        let all = is_possible(spec.square_m)
            && is_possible(spec.elsewhere_mu)
            && spec.squares.iter().all(|square| is_possible(square.mu));
        spec.squares.sort_by_key(|square| (square.iy, square.ix));
        all.then_some(Self { spec })
    }

    /// Returns the minimum over the square at a point and its eight neighbours, so that a robot
    /// slows down before any wheel is on slippery ground; `elsewhere_mu` if none of the nine is
    /// known.
    pub fn at(&self, point: Point) -> f64 {
        #[expect(
            clippy::cast_possible_truncation,
            reason = "saturates, and no plan is as far away"
        )]
        let index = |coordinate_m: f64| (coordinate_m / self.spec.square_m).floor() as i32;
        let (ix, iy) = (index(point.x_m), index(point.y_m));
        let mut least = f64::INFINITY;
        for row in iy.saturating_sub(1)..=iy.saturating_add(1) {
            let from = (row, ix.saturating_sub(1));
            let squares = &self.spec.squares;
            let first = squares.partition_point(|square| (square.iy, square.ix) < from);
            let near = squares[first..]
                .iter()
                .take_while(|square| square.iy == row && square.ix <= ix.saturating_add(1));
            least = near.fold(least, |least, square| least.min(square.mu));
        }
        if least.is_finite() {
            least
        } else {
            self.spec.elsewhere_mu
        }
    }

    /// Returns the minimum over all squares and `elsewhere_mu`.
    pub fn least(&self) -> f64 {
        let squares = self.spec.squares.iter().map(|square| square.mu);
        squares.fold(self.spec.elsewhere_mu, f64::min)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_place_has_the_lowest_traction_limit_of_all_squares_that_touch_its_own(
            squares in prop::collection::btree_map((-6..6_i32, -6..6_i32), 0.01..1.0_f64, 0..40),
            x_m in -8.0..8.0_f64, y_m in -8.0..8.0_f64, square_m in 0.5..2.0_f64,
        ) {
            let list = squares.iter().map(|(&(ix, iy), &mu)| TractionLimitCell { ix, iy, mu });
            let squares_list = list.collect();
            let spec =
                TractionLimitMapSpec { square_m, squares: squares_list, elsewhere_mu: 0.14 };
            let map = TractionLimitMap::new(spec).unwrap();
            let (ix, iy) = ((x_m / square_m).floor(), (y_m / square_m).floor());
            let near = squares.iter().filter(|((column, row), _)| {
                (f64::from(*column) - ix).abs() < 1.5 && (f64::from(*row) - iy).abs() < 1.5
            });
            let least = near.map(|(_, &mu)| mu).fold(f64::INFINITY, f64::min);
            let expected = if least.is_finite() { least } else { 0.14 };
            let found = map.at(Point { x_m, y_m });
            prop_assert!((found - expected).abs() < 1.0e-12);
            prop_assert!(map.least() <= expected);
        }
    }

    #[test]
    fn what_is_no_traction_limit_makes_no_map() {
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            let square = TractionLimitCell {
                ix: 0,
                iy: 0,
                mu: bad,
            };
            let good = TractionLimitMapSpec {
                square_m: 1.0,
                squares: Vec::new(),
                elsewhere_mu: 0.14,
            };
            for spec in [
                TractionLimitMapSpec {
                    squares: vec![square],
                    ..good.clone()
                },
                TractionLimitMapSpec {
                    square_m: bad,
                    ..good.clone()
                },
                TractionLimitMapSpec {
                    elsewhere_mu: bad,
                    ..good.clone()
                },
            ] {
                assert_eq!(TractionLimitMap::new(spec), None);
            }
        }
    }
}
