//! Planar polynomial curve of degree nine or less.

use std::ops::Range;

use nalgebra::{SMatrix, SVector};

use super::PathSample;
use crate::geometry::{Point, Pose};

/// Number of coefficients of one coordinate, lowest power first.
const COEFFICIENTS: usize = 10;
/// Nodes and weights of the five-point Gauss-Legendre rule on [−1, 1].
const GAUSS: [(f64, f64); 5] = [
    (0.0, 0.568_888_888_888_888_9),
    (0.538_469_310_105_683_1, 0.478_628_670_499_366_47),
    (-0.538_469_310_105_683_1, 0.478_628_670_499_366_47),
    (0.906_179_845_938_664, 0.236_926_885_056_189_08),
    (-0.906_179_845_938_664, 0.236_926_885_056_189_08),
];

/// Position, and its first four derivatives with respect to the parameter.
pub(crate) type Derivatives = [Point; 5];

/// Position, and `N` − 1 derivatives with respect to the parameter, at both ends of a curve.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ends<const N: usize> {
    pub(crate) start: [Point; N],
    pub(crate) end: [Point; N],
}

/// Planar curve, polynomial in a parameter of 0 to `span`. Coefficients are in metres, lowest power
/// first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Polynomial {
    x: [f64; COEFFICIENTS],
    y: [f64; COEFFICIENTS],
    degree: usize,
    span: f64,
}

impl Polynomial {
    /// Returns the quintic with given position, first and second derivative at both ends.
    pub(crate) fn quintic(ends: &Ends<3>, span: f64) -> Self {
        let Ends { start, end } = ends;
        let axis = |of: fn(&Point) -> f64| {
            let [p_0, v_0, a_0] = [
                of(&start[0]),
                of(&start[1]) * span,
                of(&start[2]) * span * span,
            ];
            let [p_1, v_1, a_1] = [of(&end[0]), of(&end[1]) * span, of(&end[2]) * span * span];
            let gap = p_1 - p_0;
            let mut unit = [0.0; COEFFICIENTS];
            unit[0] = p_0;
            unit[1] = v_0;
            unit[2] = 0.5 * a_0;
            unit[3] = 10.0 * gap - 6.0 * v_0 - 4.0 * v_1 - 1.5 * a_0 + 0.5 * a_1;
            unit[4] = -15.0 * gap + 8.0 * v_0 + 7.0 * v_1 + 1.5 * a_0 - a_1;
            unit[5] = 6.0 * gap - 3.0 * (v_0 + v_1) + 0.5 * (a_1 - a_0);
            unscaled(unit, span)
        };
        Self {
            x: axis(|point| point.x_m),
            y: axis(|point| point.y_m),
            degree: 5,
            span,
        }
    }

    /// Returns the polynomial of degree nine with given derivatives up to the fourth at both ends;
    /// None if the linear system cannot be solved.
    pub(crate) fn nonic(ends: &Ends<5>, span: f64) -> Option<Self> {
        const FACTORIALS: [f64; 5] = [1.0, 1.0, 2.0, 6.0, 24.0];
        let falling = |power: usize, order: usize| {
            (0..order)
                .map(|step| (power - step) as f64)
                .product::<f64>()
        };
        let matrix = SMatrix::<f64, 5, 5>::from_fn(|order, column| falling(column + 5, order));
        let solver = matrix.lu();
        let axis = |of: fn(&Point) -> f64| -> Option<[f64; COEFFICIENTS]> {
            let mut unit = [0.0; COEFFICIENTS];
            let mut scale = 1.0;
            for order in 0..5 {
                unit[order] = of(&ends.start[order]) * scale / FACTORIALS[order];
                scale *= span;
            }
            let mut scale = 1.0;
            let mut right = SVector::<f64, 5>::zeros();
            for order in 0..5 {
                let low: f64 = (order..5)
                    .map(|power| unit[power] * falling(power, order))
                    .sum();
                right[order] = of(&ends.end[order]) * scale - low;
                scale *= span;
            }
            let high = solver.solve(&right)?;
            unit[5..].copy_from_slice(high.as_slice());
            Some(unscaled(unit, span))
        };
        Some(Self {
            x: axis(|point| point.x_m)?,
            y: axis(|point| point.y_m)?,
            degree: 9,
            span,
        })
    }

    /// Returns the end of the parameter range.
    pub(crate) fn span(&self) -> f64 {
        self.span
    }

    /// Returns the derivative of a given order at a parameter.
    pub(crate) fn derivative(&self, order: usize, parameter: f64) -> Point {
        let axis = |coefficients: &[f64; COEFFICIENTS]| {
            let mut value = 0.0;
            for power in (order..=self.degree).rev() {
                let mut factor = coefficients[power];
                for step in 0..order {
                    factor *= (power - step) as f64;
                }
                value = value * parameter + factor;
            }
            value
        };
        Point {
            x_m: axis(&self.x),
            y_m: axis(&self.y),
        }
    }

    /// Returns the parameter speed `|p'|` at a parameter, metres per parameter unit.
    pub(crate) fn parameter_speed(&self, parameter: f64) -> f64 {
        // Horner's rule on both coordinates at once: most of a reference's computing time is spent
        // here.
        let (mut x, mut y) = (0.0, 0.0);
        for power in (1..=self.degree).rev() {
            let factor = power as f64;
            x = x * parameter + factor * self.x[power];
            y = y * parameter + factor * self.y[power];
        }
        (x * x + y * y).sqrt()
    }

    /// Returns position and the first three derivatives, in one pass of Horner's rule.
    fn jet(&self, parameter: f64) -> [Point; 4] {
        let (mut x, mut y) = ([0.0; 4], [0.0; 4]);
        for power in (0..=self.degree).rev() {
            for (sums, coefficient) in [(&mut x, self.x[power]), (&mut y, self.y[power])] {
                sums[3] = sums[3] * parameter + sums[2];
                sums[2] = sums[2] * parameter + sums[1];
                sums[1] = sums[1] * parameter + sums[0];
                sums[0] = sums[0] * parameter + coefficient;
            }
        }
        // The sums are derivatives over factorials.
        [(0, 1.0), (1, 1.0), (2, 2.0), (3, 6.0)].map(|(order, factorial)| Point {
            x_m: factorial * x[order],
            y_m: factorial * y[order],
        })
    }

    /// Returns the arc length over a range of parameters by five-point Gauss-Legendre quadrature,
    /// metres.
    pub(crate) fn length_m(&self, parameters: Range<f64>) -> f64 {
        let Range { start, end } = parameters;
        let (middle, half) = (0.5 * (start + end), 0.5 * (end - start));
        GAUSS
            .iter()
            .map(|(node, weight)| weight * self.parameter_speed(middle + half * node))
            .sum::<f64>()
            * half
    }

    /// Returns pose, curvature and slope of curvature at a parameter.
    pub(crate) fn sample(&self, parameter: f64) -> PathSample {
        let [position, first, second, third] = self.jet(parameter);
        let parameter_speed_2 =
            (first.x_m * first.x_m + first.y_m * first.y_m).max(f64::MIN_POSITIVE);
        let parameter_speed = parameter_speed_2.sqrt();
        let cross_2 = first.x_m * second.y_m - first.y_m * second.x_m;
        let cross_3 = first.x_m * third.y_m - first.y_m * third.x_m;
        let along_2 = first.x_m * second.x_m + first.y_m * second.y_m;
        PathSample {
            pose: Pose {
                x_m: position.x_m,
                y_m: position.y_m,
                heading_rad: first.y_m.atan2(first.x_m),
            },
            curvature_1_m: cross_2 / (parameter_speed_2 * parameter_speed),
            curvature_slope_1_m2: (cross_3 * parameter_speed_2 - 3.0 * cross_2 * along_2)
                / (parameter_speed_2 * parameter_speed_2 * parameter_speed_2),
        }
    }
}

/// Converts coefficients over the parameter range 0 to 1 to those over 0 to `span`.
fn unscaled(mut unit: [f64; COEFFICIENTS], span: f64) -> [f64; COEFFICIENTS] {
    let mut scale = 1.0;
    for coefficient in &mut unit {
        *coefficient /= scale;
        scale *= span;
    }
    unit
}
