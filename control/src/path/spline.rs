//! Minimum-jerk quintic spline through given points.
//!
//! Minimises `∫ |p‴|²` over the parameter, which advances by `chord^α` from knot to knot: with α =
//! 1 the parameter speed is even, a smaller α slows down on short chords and bulges less beside
//! them. The minimiser is a quintic spline, C⁴ at every knot whose tangent is free and C³ where it
//! is given. Its first and second derivatives at the knots solve one block-tridiagonal system, so
//! planning is linear in the number of points.

use nalgebra::{Matrix2, Matrix4, Vector4};

use super::Polynomial;
use super::polynomial::Ends;
use crate::geometry::Point;

/// Point that the spline passes through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Knot {
    /// Position in the site frame.
    pub(crate) point: Point,
    /// Heading of the path at this point, radians counter-clockwise from x; None leaves it free.
    pub(crate) heading_rad: Option<f64>,
}

/// Returns half of `∂²/∂(v₀,a₀,v₁,a₁)²` of `∫₀¹ (p‴)²` and of its coupling to the gap `p₁ − p₀`, on
/// the unit interval.
fn unit_cost() -> (Matrix4<f64>, Vector4<f64>) {
    // c₃, c₄, c₅ of the quintic as rows over (gap, v₀, a₀, v₁, a₁).
    const ROWS: [[f64; 5]; 3] = [
        [10.0, -6.0, -1.5, -4.0, 0.5],
        [-15.0, 8.0, 1.5, 7.0, -1.0],
        [6.0, -3.0, -0.5, -3.0, 0.5],
    ];
    // ∫ (6c₃ + 24c₄s + 60c₅s²)² as a quadratic form.
    const FORM: [[f64; 3]; 3] = [
        [36.0, 72.0, 120.0],
        [72.0, 192.0, 360.0],
        [120.0, 360.0, 720.0],
    ];
    let entry = |left: usize, right: usize| {
        let mut sum = 0.0;
        for row in 0..3 {
            for column in 0..3 {
                sum += ROWS[row][left] * FORM[row][column] * ROWS[column][right];
            }
        }
        sum
    };
    (
        Matrix4::from_fn(|row, column| entry(row + 1, column + 1)),
        Vector4::from_fn(|row, _| entry(row + 1, 0)),
    )
}

/// Returns one polynomial per pair of neighbouring knots, which must differ in position; `exponent`
/// is α.
pub(crate) fn min_jerk_spline(knots: &[Knot], exponent: f64) -> Vec<Polynomial> {
    let count = knots.len();
    if count < 2 {
        return Vec::new();
    }
    let chords_m: Vec<f64> = knots
        .windows(2)
        .map(|pair| pair[0].point.distance_m(pair[1].point))
        .collect();
    let spans: Vec<f64> = chords_m
        .iter()
        .map(|chord_m| chord_m.powf(exponent))
        .collect();
    let (unit, unit_gap) = unit_cost();
    let mut system = System {
        diagonal: vec![Matrix2::zeros(); count],
        above: vec![Matrix2::zeros(); count - 1],
        right: vec![Matrix2::zeros(); count],
    };
    for (index, &span) in spans.iter().enumerate() {
        let scale = Vector4::new(span, span * span, span, span * span);
        let factor = span.powi(-5);
        let block = Matrix4::from_fn(|row, column| {
            factor * scale[row] * unit[(row, column)] * scale[column]
        });
        let (start, end) = (knots[index].point, knots[index + 1].point);
        let gap = [end.x_m - start.x_m, end.y_m - start.y_m];
        system.diagonal[index] += block.fixed_view::<2, 2>(0, 0);
        system.diagonal[index + 1] += block.fixed_view::<2, 2>(2, 2);
        system.above[index] += block.fixed_view::<2, 2>(0, 2);
        let right = &mut system.right;
        for row in 0..2 {
            for (axis, gap) in gap.iter().enumerate() {
                right[index][(row, axis)] -= factor * scale[row] * unit_gap[row] * gap;
                right[index + 1][(row, axis)] -= factor * scale[row + 2] * unit_gap[row + 2] * gap;
            }
        }
    }
    let pace = |index: usize| {
        let near = index.saturating_sub(1)..(index + 1).min(spans.len());
        chords_m[near.clone()].iter().sum::<f64>() / spans[near].iter().sum::<f64>()
    };
    system.fix_tangents(knots, pace);
    let solution = system.solve();
    let state = |index: usize| {
        let values: &Matrix2<f64> = &solution[index];
        [
            knots[index].point,
            Point {
                x_m: values[(0, 0)],
                y_m: values[(0, 1)],
            },
            Point {
                x_m: values[(1, 0)],
                y_m: values[(1, 1)],
            },
        ]
    };
    spans
        .iter()
        .enumerate()
        .map(|(index, &span)| {
            let ends = Ends {
                start: state(index),
                end: state(index + 1),
            };
            Polynomial::quintic(&ends, span)
        })
        .collect()
}

/// Symmetric positive definite block-tridiagonal system.
#[derive(Debug, Clone)]
struct System {
    diagonal: Vec<Matrix2<f64>>,
    above: Vec<Matrix2<f64>>,
    /// Right-hand side; columns are x and y.
    right: Vec<Matrix2<f64>>,
}

impl System {
    /// Replaces the unknown tangents of knots with given headings; their length is the mean
    /// parameter speed of the adjacent chords.
    fn fix_tangents(&mut self, knots: &[Knot], pace: impl Fn(usize) -> f64) {
        let Self {
            diagonal,
            above,
            right,
        } = self;
        for (index, knot) in knots.iter().enumerate() {
            let Some(heading_rad) = knot.heading_rad else {
                continue;
            };
            let (sin, cos) = heading_rad.sin_cos();
            let pace = pace(index);
            for (axis, value) in [pace * cos, pace * sin].into_iter().enumerate() {
                right[index][(1, axis)] -= diagonal[index][(1, 0)] * value;
                right[index][(0, axis)] = value;
                for row in 0..2 {
                    if index > 0 {
                        right[index - 1][(row, axis)] -= above[index - 1][(row, 0)] * value;
                    }
                    if index + 1 < knots.len() {
                        right[index + 1][(row, axis)] -= above[index][(0, row)] * value;
                    }
                }
            }
            // The row becomes `tangent = value`. Rows already replaced are zero here, so that a
            // fixed neighbour stays fixed.
            diagonal[index][(0, 0)] = 1.0;
            diagonal[index][(0, 1)] = 0.0;
            diagonal[index][(1, 0)] = 0.0;
            if index > 0 {
                above[index - 1][(0, 0)] = 0.0;
                above[index - 1][(1, 0)] = 0.0;
            }
            if index + 1 < knots.len() {
                above[index][(0, 0)] = 0.0;
                above[index][(0, 1)] = 0.0;
            }
        }
    }

    /// Solves the system by block elimination.
    fn solve(self) -> Vec<Matrix2<f64>> {
        let Self {
            mut diagonal,
            above,
            mut right,
        } = self;
        let invert = |block: &Matrix2<f64>| block.try_inverse().unwrap_or_else(Matrix2::zeros);
        for index in 1..diagonal.len() {
            let factor = above[index - 1].transpose() * invert(&diagonal[index - 1]);
            let reduced = factor * above[index - 1];
            diagonal[index] -= reduced;
            let carried = factor * right[index - 1];
            right[index] -= carried;
        }
        for index in (0..diagonal.len()).rev() {
            if index + 1 < right.len() {
                let known = above[index] * right[index + 1];
                right[index] -= known;
            }
            right[index] = invert(&diagonal[index]) * right[index];
        }
        right
    }
}
