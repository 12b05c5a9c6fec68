//! Friction over slip in the steady state, by four models of the literature.

use serde::Serialize;

/// Which model a contact follows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub enum Shape {
    /// Straight to the peak, constant beyond it: the model of Yi et al. (2007), eq. (7).
    Linear,
    /// A brush with parabolic pressure: Pacejka, Tire and Vehicle Dynamics, 3rd ed., eq. (3.8).
    Brush,
    /// The Magic Formula: ibid., eq. (4.49), with the shape of a truck tyre on a rough road.
    MagicFormula,
    /// `LuGre`, averaged over the patch: Canudas de Wit et al., Vehicle System Dynamics 39 (2003).
    LuGre,
}

impl Shape {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Linear, Self::Brush, Self::MagicFormula, Self::LuGre];

    /// For people.
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
/// Its curvature factor E.
const MAGIC_E: f64 = 0.2;
/// Sliding over static friction of the `LuGre` model.
const LUGRE_SLIDING_RATIO: f64 = 0.85;
/// Its Stribeck speed, metres per second.
const LUGRE_STRIBECK_M_S: f64 = 2.0;
/// Slip below which curves are taken as their tangent.
const SLIP_SMALL: f64 = 1.0e-9;

/// Friction over slip of one ground and tyre.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Curve {
    /// Its model.
    pub shape: Shape,
    /// Slope K at zero slip, friction coefficient per slip, above 0.
    pub stiffness: f64,
    /// Greatest friction coefficient (of `LuGre`, the static one), above 0.
    pub mu_peak: f64,
}

impl Curve {
    /// θ = 1/K.
    pub fn theta(&self) -> f64 {
        self.stiffness.recip()
    }

    /// Slip of the peak, or of nearly all of it where the curve only approaches it.
    pub fn peak_slip(&self) -> f64 {
        let straight = self.mu_peak / self.stiffness;
        match self.shape {
            Shape::Linear => straight,
            Shape::Brush => 3.0 * straight,
            Shape::MagicFormula => 2.5 * straight,
            Shape::LuGre => 5.0 * straight,
        }
    }

    /// Friction coefficient over slip, for a slip ≥ 0 and a sliding speed ≥ 0, metres per second.
    pub fn mu_over_slip(&self, slip: f64, sliding_m_s: f64) -> f64 {
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
                let bent = argument - MAGIC_E * (argument - argument.atan());
                peak * (MAGIC_C * bent.atan()).sin()
            }
            Shape::LuGre => {
                let falls = (-(sliding_m_s / LUGRE_STRIBECK_M_S).sqrt()).exp();
                let sliding = peak * LUGRE_SLIDING_RATIO;
                let friction = sliding + (peak - sliding) * falls;
                // Bristles of stiffness 2K over the patch: their mean rises with slope K.
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
            let slope = curve.mu_over_slip(small, 0.0);
            prop_assert!((slope / curve.stiffness - 1.0).abs() < 1.0e-3, "slope {slope}");
            let mu = slip * curve.mu_over_slip(slip, sliding_m_s);
            prop_assert!((0.0..=curve.mu_peak * (1.0 + 1.0e-9)).contains(&mu), "{mu}");
        }

        #[test]
        fn nearly_all_of_the_peak_is_there_at_the_slip_that_is_said(curve in curve()) {
            let slip = curve.peak_slip();
            let mu = slip * curve.mu_over_slip(slip, 0.0);
            prop_assert!(mu > 0.85 * curve.mu_peak, "{mu} of {}", curve.mu_peak);
        }
    }
}
