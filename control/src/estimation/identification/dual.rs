//! Forward-mode automatic differentiation by dual numbers: values with their derivatives with
//! respect to all parameters.
//!
//! Arrays of fixed size, so that the control loop allocates nothing and the compiler can vectorise.

#![expect(
    clippy::inline_always,
    reason = "an operator that is not inlined copies its arguments, which takes longer than the sum"
)]

use std::ops::{Add, Div, Mul, Neg, Sub};

/// Arithmetic that the model needs, on plain numbers or on [`Dual`] ones.
pub(super) trait Real:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + Add<f64, Output = Self>
    + Sub<f64, Output = Self>
    + Mul<f64, Output = Self>
{
    /// Creates a constant, whose derivatives are zero.
    fn constant(value: f64) -> Self;
    /// Returns the value without its derivatives.
    fn value(&self) -> f64;
    /// Returns e to the power of this value.
    fn exp(self) -> Self;
    /// Returns the natural logarithm; the value must be above 0.
    fn ln(self) -> Self;
    /// Returns the square root; the value must be above 0, where the slope is finite.
    fn sqrt(self) -> Self;
    /// Returns the reciprocal; the value must not be 0.
    fn recip(self) -> Self;

    /// Returns the magnitude; at 0 the slope is that of positive values.
    fn abs(self) -> Self {
        if self.value() < 0.0 { -self } else { self }
    }
}

impl Real for f64 {
    fn constant(value: f64) -> Self {
        value
    }

    fn value(&self) -> f64 {
        *self
    }

    fn exp(self) -> Self {
        self.exp()
    }

    fn ln(self) -> Self {
        self.ln()
    }

    fn sqrt(self) -> Self {
        self.sqrt()
    }

    fn recip(self) -> Self {
        self.recip()
    }
}

/// A value and its derivatives with respect to `N` parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Dual<const N: usize> {
    /// The value.
    pub(super) value: f64,
    /// Partial derivatives, in the order of the parameters.
    pub(super) derivatives: [f64; N],
}

impl<const N: usize> Dual<N> {
    /// Creates the parameter of this index, below `N`: its derivative with respect to itself is 1.
    #[inline(always)]
    pub(super) fn parameter(value: f64, index: usize) -> Self {
        let mut derivatives = [0.0; N];
        derivatives[index] = 1.0;
        Self { value, derivatives }
    }

    /// Returns the derivatives of a function by the chain rule, given its slope at this value.
    #[inline(always)]
    fn chained(mut self, slope: f64) -> [f64; N] {
        for derivative in &mut self.derivatives {
            *derivative *= slope;
        }
        self.derivatives
    }

    #[inline(always)]
    fn zip(self, other: Self, value: f64, combine: impl Fn(f64, f64) -> f64) -> Self {
        let mut derivatives = self.derivatives;
        for (own, other) in derivatives.iter_mut().zip(other.derivatives) {
            *own = combine(*own, other);
        }
        Self { value, derivatives }
    }
}

impl<const N: usize> Add for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, self.value + other.value, |own, other| own + other)
    }
}

impl<const N: usize> Sub for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, self.value - other.value, |own, other| own - other)
    }
}

impl<const N: usize> Mul for Dual<N> {
    type Output = Self;

    #[expect(clippy::suspicious_arithmetic_impl, reason = "the product rule")]
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        let (a, b) = (self.value, other.value);
        self.zip(other, a * b, |own, other| own * b + a * other)
    }
}

impl<const N: usize> Div for Dual<N> {
    type Output = Self;

    #[expect(clippy::suspicious_arithmetic_impl, reason = "the quotient rule")]
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        let (ratio, recip) = (self.value / other.value, other.value.recip());
        self.zip(other, ratio, |own, other| (own - ratio * other) * recip)
    }
}

impl<const N: usize> Neg for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn neg(self) -> Self {
        Self {
            value: -self.value,
            derivatives: self.chained(-1.0),
        }
    }
}

impl<const N: usize> Add<f64> for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn add(mut self, other: f64) -> Self {
        self.value += other;
        self
    }
}

impl<const N: usize> Sub<f64> for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn sub(mut self, other: f64) -> Self {
        self.value -= other;
        self
    }
}

impl<const N: usize> Mul<f64> for Dual<N> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: f64) -> Self {
        Self {
            value: self.value * other,
            derivatives: self.chained(other),
        }
    }
}

impl<const N: usize> Real for Dual<N> {
    #[inline(always)]
    fn constant(value: f64) -> Self {
        Self {
            value,
            derivatives: [0.0; N],
        }
    }

    #[inline(always)]
    fn value(&self) -> f64 {
        self.value
    }

    #[inline(always)]
    fn exp(self) -> Self {
        let value = self.value.exp();
        let derivatives = self.chained(value);
        Self { value, derivatives }
    }

    #[inline(always)]
    fn ln(self) -> Self {
        Self {
            value: self.value.ln(),
            derivatives: self.chained(self.value.recip()),
        }
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        let value = self.value.sqrt();
        let derivatives = self.chained(0.5 / value);
        Self { value, derivatives }
    }

    #[inline(always)]
    fn recip(self) -> Self {
        let value = self.value.recip();
        let derivatives = self.chained(-value * value);
        Self { value, derivatives }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn of<T: Real>(x: T, y: T) -> T {
        let root = (x * x + y * y + 1.0).sqrt();
        (x.exp() * 0.5 - y.ln() / root + (-x).abs() - 2.0) * y.recip()
    }

    proptest! {
        #[test]
        fn derivatives_are_those_of_finite_differences(x in 0.1..2.0_f64, y in 0.2..3.0_f64) {
            let found = of(Dual::<2>::parameter(x, 0), Dual::parameter(y, 1));
            let step = 1.0e-6;
            let slopes = [
                (of(x + step, y) - of(x - step, y)) / (2.0 * step),
                (of(x, y + step) - of(x, y - step)) / (2.0 * step),
            ];
            prop_assert!((found.value - of(x, y)).abs() < 1.0e-12);
            for (found, slope) in found.derivatives.into_iter().zip(slopes) {
                prop_assert!((found - slope).abs() < 1.0e-5 * (1.0 + slope.abs()));
            }
        }
    }
}
