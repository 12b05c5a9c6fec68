//! Friction coefficient μ of the ground over slip λ, equations (7) to (9) of the paper.
//!
//! `μ(λ) = K (σ₁(λ) + σ₂(λ) λ)` for λ ≥ 0: rises with slope K up to the peak at `λ_m`, then falls
//! linearly to the fraction α of the peak at λ = 1. θ = 1/K is the slip compliance.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Slip up to which friction is assumed proportional to slip (`λ_m` of the paper).
pub const SLIP_LINEAR: f64 = 0.2;

/// The three parameters of a friction curve, not yet checked.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FrictionSpec {
    /// Friction stiffness K: slope at zero slip, finite and above 0.
    pub stiffness: f64,
    /// Slip `λ_m` at the peak, above 0 and below 1.
    pub peak_slip: f64,
    /// Ratio α of friction at full sliding (λ = 1) to peak friction, 0 to 1.
    pub sliding_ratio: f64,
}

/// Parameter of a friction curve that is out of its range.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum FrictionError {
    /// K is not finite or not above zero.
    #[error("`stiffness` must be finite and above zero, not {0}")]
    Stiffness(f64),
    /// `λ_m` is not strictly between 0 and 1.
    #[error("`peak_slip` must be above 0 and below 1, not {0}")]
    PeakSlip(f64),
    /// α is not within 0 to 1.
    #[error("`sliding_ratio` must be between 0 and 1, not {0}")]
    SlidingRatio(f64),
}

/// Friction curve μ(λ) of (7) with checked parameters.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "FrictionSpec", into = "FrictionSpec")]
pub struct FrictionCurve {
    spec: FrictionSpec,
}

impl TryFrom<FrictionSpec> for FrictionCurve {
    type Error = FrictionError;

    fn try_from(spec: FrictionSpec) -> Result<Self, Self::Error> {
        if !spec.stiffness.is_finite() || spec.stiffness <= 0.0 {
            return Err(FrictionError::Stiffness(spec.stiffness));
        }
        if !(spec.peak_slip > 0.0 && spec.peak_slip < 1.0) {
            return Err(FrictionError::PeakSlip(spec.peak_slip));
        }
        if !(0.0..=1.0).contains(&spec.sliding_ratio) {
            return Err(FrictionError::SlidingRatio(spec.sliding_ratio));
        }
        Ok(Self { spec })
    }
}

impl From<FrictionCurve> for FrictionSpec {
    fn from(curve: FrictionCurve) -> Self {
        curve.spec
    }
}

impl FrictionCurve {
    /// Returns the paper's shape, `λ_m` = 0.2 and α = 0.8, with K = 1.
    pub fn yi2007() -> Self {
        Self {
            spec: FrictionSpec {
                stiffness: 1.0,
                peak_slip: 0.2,
                sliding_ratio: 0.8,
            },
        }
    }

    /// Returns a curve of stiffness K with the paper's `λ_m` and α.
    ///
    /// # Errors
    /// [`FrictionError::Stiffness`] if K is not finite or not above zero.
    #[cfg(any(test, feature = "testing"))]
    pub fn with_stiffness(stiffness: f64) -> Result<Self, FrictionError> {
        FrictionSpec {
            stiffness,
            ..Self::yi2007().spec
        }
        .try_into()
    }

    /// Returns the friction stiffness K, the slope at zero slip.
    pub fn stiffness(&self) -> f64 {
        self.spec.stiffness
    }

    /// Returns the slip compliance θ = 1/K.
    pub fn theta(&self) -> f64 {
        self.spec.stiffness.recip()
    }

    /// Returns the slip `λ_m` at peak friction.
    pub fn peak_slip(&self) -> f64 {
        self.spec.peak_slip
    }

    /// Returns the ratio α of friction at full sliding to peak friction.
    pub fn sliding_ratio(&self) -> f64 {
        self.spec.sliding_ratio
    }

    /// Returns the peak friction coefficient `μ_p = K λ_m`.
    pub fn mu_peak(&self) -> f64 {
        self.spec.stiffness * self.spec.peak_slip
    }

    /// Returns the friction coefficient μ(λ) of (7) at a slip of either sign: an odd function,
    /// constant beyond a slip of ±1.
    pub fn mu(&self, slip: f64) -> f64 {
        (self.mu_over_slip(slip.abs()) * slip).clamp(-self.mu_peak(), self.mu_peak())
    }

    /// Returns `μ(|σ|)/|σ|` for a slip magnitude ≥ 0; equals K below `λ_m`, also at zero.
    pub fn mu_over_slip(&self, slip_magnitude: f64) -> f64 {
        let FrictionSpec {
            stiffness,
            peak_slip,
            sliding_ratio,
        } = self.spec;
        if slip_magnitude < peak_slip {
            return stiffness;
        }
        let beyond = (slip_magnitude.min(1.0) - peak_slip) / (1.0 - peak_slip);
        stiffness * peak_slip * (1.0 - (1.0 - sliding_ratio) * beyond) / slip_magnitude
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn friction_is_odd_bounded_and_opposes_slip(
            stiffness in 0.1..50.0_f64, peak_slip in 0.01..0.99_f64,
            sliding_ratio in 0.0..=1.0_f64, slip in -3.0..3.0_f64,
        ) {
            let spec = FrictionSpec { stiffness, peak_slip, sliding_ratio };
            let curve = FrictionCurve::try_from(spec).unwrap();
            let mu = curve.mu(slip);
            prop_assert!((mu + curve.mu(-slip)).abs() < 1.0e-12);
            prop_assert!(mu.abs() <= curve.mu_peak() + 1.0e-12);
            prop_assert!(mu * slip >= 0.0);
        }

        #[test]
        fn the_curve_is_the_papers_closed_form(
            stiffness in 0.1..50.0_f64, peak_slip in 0.01..0.99_f64,
            sliding_ratio in 0.0..=1.0_f64, slip in 0.0..1.0_f64,
        ) {
            let spec = FrictionSpec { stiffness, peak_slip, sliding_ratio };
            let curve = FrictionCurve::try_from(spec).unwrap();
            // Equations (8) and (9).
            let (sigma_1, sigma_2) = if slip < peak_slip {
                (0.0, 1.0)
            } else {
                let fall = (1.0 - peak_slip).recip() * peak_slip;
                ((1.0 - sliding_ratio * peak_slip) * fall, -(1.0 - sliding_ratio) * fall)
            };
            let paper = stiffness * (sigma_1 + sigma_2 * slip);
            prop_assert!((curve.mu(slip) - paper).abs() < 1.0e-9 * stiffness);
        }
    }

    #[test]
    fn figures_outside_their_range_are_refused() {
        let good = FrictionSpec {
            stiffness: 5.0,
            peak_slip: 0.2,
            sliding_ratio: 0.8,
        };
        for bad in [
            FrictionSpec {
                stiffness: 0.0,
                ..good
            },
            FrictionSpec {
                stiffness: f64::NAN,
                ..good
            },
            FrictionSpec {
                peak_slip: 1.0,
                ..good
            },
            FrictionSpec {
                peak_slip: f64::NAN,
                ..good
            },
            FrictionSpec {
                sliding_ratio: 1.1,
                ..good
            },
            FrictionSpec {
                sliding_ratio: f64::NAN,
                ..good
            },
        ] {
            assert!(FrictionCurve::try_from(bad).is_err(), "{bad:?}");
        }
    }
}
