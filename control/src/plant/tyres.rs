//! Tyre models beyond the paper's: anisotropic stiffness, and a smooth rise to the peak.

use crate::friction::FrictionCurve;

/// Deviation of tyres from the isotropic, piecewise linear friction curve (7).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tyres {
    /// Ratio of lateral to longitudinal stiffness, 0.1 to 10; 1 is isotropic.
    pub lateral_stiffness_ratio: f64,
    /// Shape of the rise to peak friction.
    pub rise: TyreRise,
}

impl Default for Tyres {
    fn default() -> Self {
        Self {
            lateral_stiffness_ratio: 1.0,
            rise: TyreRise::Straight,
        }
    }
}

/// Shape of a tyre's friction over slip up to its peak.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TyreRise {
    /// Piecewise linear as in (7): linear to the peak, then falling.
    #[default]
    Straight,
    /// Brush model: `μ = K λ (1 − z + z²/3)`, `z = λ/(3λ_m)`, with the same initial slope K and the
    /// same peak `K λ_m` as (7), reached at `z = 1` and constant beyond.
    Brush,
}

impl TyreRise {
    /// Returns `μ(|σ|)/|σ|` for a slip magnitude ≥ 0.
    pub(crate) fn mu_over_slip(self, curve: &FrictionCurve, slip: f64) -> f64 {
        match self {
            Self::Straight => curve.mu_over_slip(slip),
            Self::Brush => {
                let share = slip / (3.0 * curve.peak_slip());
                if share < 1.0 {
                    curve.stiffness() * (1.0 - share + share * share / 3.0)
                } else {
                    curve.mu_peak() / slip
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_brush_rises_smoothly_from_the_same_slope_to_the_same_peak() {
        let curve = FrictionCurve::with_stiffness(5.0).unwrap();
        let brush = |slip: f64| slip * TyreRise::Brush.mu_over_slip(&curve, slip);
        assert!((brush(1.0e-6) / 1.0e-6 - 5.0).abs() < 1.0e-4);
        assert!((brush(0.6) - curve.mu_peak()).abs() < 1.0e-12);
        assert!((brush(2.0) - curve.mu_peak()).abs() < 1.0e-12);
        for step in 1..60 {
            let slip = 0.01 * f64::from(step);
            let slope = (brush(slip + 1.0e-6) - brush(slip)) / 1.0e-6;
            assert!((0.0..5.0).contains(&slope), "{slip}: {slope}");
            assert!(brush(slip) < TyreRise::Straight.mu_over_slip(&curve, 0.0) * slip);
        }
    }

    #[test]
    fn a_straight_rise_is_the_ground_s_own_curve() {
        let curve = FrictionCurve::with_stiffness(2.0).unwrap();
        for slip in [0.0, 0.1, 0.2, 0.5, 1.5] {
            let difference =
                TyreRise::Straight.mu_over_slip(&curve, slip) - curve.mu_over_slip(slip);
            assert!(difference.abs() < 1.0e-15);
        }
    }
}
