//! Steady-state friction coefficient μ(λ) over slip, by four models of the literature.

use serde::Serialize;

/// Friction model of a contact.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum Shape {
    /// Linear up to the peak, constant beyond it: Yi et al. (2007), eq. (7).
    Linear,
    /// Brush model with parabolic pressure: Pacejka, Tire and Vehicle Dynamics, 3rd ed., eq. (3.8).
    Brush,
    /// Magic Formula: Pacejka, 3rd ed., eq. (4.49), with the shape of a truck tyre on a rough road.
    MagicFormula,
    /// `LuGre` model averaged over the contact patch: Canudas de Wit et al., Vehicle System
    /// Dynamics 39 (2003).
    LuGre,
}

impl Shape {
    /// All shapes.
    pub const ALL: [Self; 4] = [Self::Linear, Self::Brush, Self::MagicFormula, Self::LuGre];

    /// Returns the name for reports.
    pub fn text(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Brush => "brush",
            Self::MagicFormula => "Magic Formula",
            Self::LuGre => "LuGre",
        }
    }
}

/// Shape factor C of the Magic Formula's longitudinal force.
const MAGIC_C: f64 = 1.6;
/// Curvature factor E of the Magic Formula's longitudinal force.
const MAGIC_E: f64 = 0.2;
/// Ratio of sliding to static friction of the `LuGre` model.
const LUGRE_SLIDING_RATIO: f64 = 0.85;
/// Stribeck speed of the `LuGre` model, in metres per second.
const LUGRE_STRIBECK_M_S: f64 = 2.0;
/// Slip below which a curve is replaced by its tangent at zero.
const SLIP_SMALL: f64 = 1.0e-9;

/// Slip of a contact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ContactSlip {
    /// Slip λ, ≥ 0.
    pub slip: f64,
    /// Sliding speed, ≥ 0, in metres per second.
    pub sliding_m_s: f64,
}

/// Friction curve of one ground and tyre.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Curve {
    /// Friction model.
    pub shape: Shape,
    /// Friction stiffness K: slope at zero slip, friction coefficient per slip, above 0.
    pub stiffness: f64,
    /// Peak friction coefficient (for `LuGre` the static one), above 0.
    pub mu_peak: f64,
}

impl Curve {
    /// Returns the slip compliance θ = 1/K.
    pub fn theta(&self) -> f64 {
        self.stiffness.recip()
    }

    /// Returns the slip at the peak, or near it for curves that only approach their peak.
    pub fn peak_slip(&self) -> f64 {
        let straight = self.mu_peak / self.stiffness;
        match self.shape {
            Shape::Linear => straight,
            Shape::Brush => 3.0 * straight,
            Shape::MagicFormula => 2.5 * straight,
            Shape::LuGre => 5.0 * straight,
        }
    }

    /// Returns the ratio μ/λ. The sliding speed matters for `LuGre` only.
    pub fn mu_over_slip(&self, contact: ContactSlip) -> f64 {
        let ContactSlip { slip, sliding_m_s } = contact;
        if slip < SLIP_SMALL {
            return self.stiffness;
        }
        let (peak, stiffness) = (self.mu_peak, self.stiffness);
        let mu = match self.shape {
            Shape::Linear => (stiffness * slip).min(peak),
            Shape::Brush => {
                let z = (stiffness * slip / (3.0 * peak)).min(1.0);
                peak * z * (3.0 - 3.0 * z + z * z)
            }
            Shape::MagicFormula => {
                let b = stiffness / (MAGIC_C * peak);
                let argument = b * slip;
                let bracket = argument - MAGIC_E * (argument - argument.atan());
                peak * (MAGIC_C * bracket.atan()).sin()
            }
            Shape::LuGre => {
                let falls = (-(sliding_m_s / LUGRE_STRIBECK_M_S).sqrt()).exp();
                let sliding = peak * LUGRE_SLIDING_RATIO;
                let friction = sliding + (peak - sliding) * falls;
                // Bristles of stiffness 2K over the patch give a mean force with the slope K.
                let share = 2.0 * stiffness * slip / friction;
                friction * (1.0 + (-share).exp_m1() / share)
            }
        };
        mu / slip
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn curve() -> impl Strategy<Value = Curve> {
        (0..4_usize, 0.5..20.0, 0.2..1.0).prop_map(|(shape, stiffness, mu_peak)| Curve {
            shape: Shape::ALL[shape],
            stiffness,
            mu_peak,
        })
    }

    proptest! {
        #[test]
        fn every_curve_rises_with_its_stiffness_and_never_passes_its_peak(
            curve in curve(), slip in 0.0..3.0_f64, sliding_m_s in 0.0..2.0_f64,
        ) {
            let small = 1.0e-5;
            let slope = curve.mu_over_slip(ContactSlip { slip: small, sliding_m_s: 0.0 });
            prop_assert!((slope / curve.stiffness - 1.0).abs() < 1.0e-3, "slope {slope}");
            let mu = slip * curve.mu_over_slip(ContactSlip { slip, sliding_m_s });
            prop_assert!((0.0..=curve.mu_peak * (1.0 + 1.0e-9)).contains(&mu), "{mu}");
        }

        #[test]
        fn nearly_all_of_the_peak_is_there_at_the_slip_that_is_said(curve in curve()) {
            let slip = curve.peak_slip();
            let mu = slip * curve.mu_over_slip(ContactSlip { slip, sliding_m_s: 0.0 });
            prop_assert!(mu > 0.85 * curve.mu_peak, "{mu} of {}", curve.mu_peak);
        }
    }
}
