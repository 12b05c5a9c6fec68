//! Division of the integral action between the integral and the adaptation.
//!
//! Every adapted value moves the modelled sideslip by the integral of the cross-track error over
//! the distance driven: `dβ̂/ds = −Γ e_y`, with `Γ = Σ γ_i (∂β/∂p_i)²` over the adapted values
//! `p_i` of gains `γ_i`. Through the heading gain that is an integral term of gain `k_θ Γ`. On a
//! path of constant curvature all of them and the integral do the same, and their sum is what noise
//! and slow tyres see. So `k_I` is the gain of all together: the adaptation gets its gains up to
//! the share [`TrackerConfig::adaptation_share_max`] of `k_I`, and the integral gets what is left.

use crate::reference::ReferenceSample;

use super::config::{CrossGains, TrackerConfig};
use super::drift::DriftSideslip;
use super::sideslip::Sideslip;

/// Lower bound of the speed by which drifts are divided, metres per second. Nothing is adapted at
/// lower speeds.
const SPEED_MIN_M_S: f64 = 0.05;

/// Which values can follow the present error. One at its bound, or one that is returning to its
/// initial value, cannot: its share of the integral action would be lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CanFollow {
    /// θ̂.
    pub(super) theta: bool,
    /// χ̂.
    pub(super) beyond: bool,
    /// Slope and rotation centre.
    pub(super) drift: bool,
}

/// Gains of integral and adaptation in one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct IntegralAction {
    /// Gain of the integral, per metre cubed.
    pub(super) integral_1_m3: f64,
    /// Fraction, 0 to 1, of the adaptation gains.
    pub(super) adaptation_share: f64,
}

impl IntegralAction {
    /// Divides the integral action among the values that can follow the error.
    pub(super) fn divide(
        gains: &CrossGains,
        config: &TrackerConfig,
        reference: &ReferenceSample,
        (sideslip, drift): (&Sideslip, &DriftSideslip),
        free: CanFollow,
    ) -> Self {
        let speed_m_s = reference.speed_m_s.max(SPEED_MIN_M_S);
        let square = |drift_m_s: f64| (drift_m_s / speed_m_s).powi(2);
        let of = |is_free: bool, per_e_1_m2: f64| if is_free { per_e_1_m2 } else { 0.0 };
        let per_e_1_m2 = of(
            free.theta,
            config.adaptation_gain * square(sideslip.drift_per_theta_m_s),
        ) + of(
            free.beyond,
            config.beyond_gain * square(sideslip.drift_per_beyond_m_s),
        ) + of(
            free.drift,
            config.slope_gain_1_m2 * drift.per_slope_m_s.map(square).iter().sum::<f64>()
                + config.center_gain * square(drift.per_center_1_s),
        );
        let wanted_1_m3 = gains.heading_1_m * per_e_1_m2;
        let most_1_m3 = config.adaptation_share_max * gains.integral_1_m3;
        let adaptation_share = if wanted_1_m3 > most_1_m3 {
            most_1_m3 / wanted_1_m3
        } else {
            1.0
        };
        Self {
            integral_1_m3: gains.integral_1_m3 - adaptation_share * wanted_1_m3,
            adaptation_share,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_that_cannot_follow_leaves_its_share_to_the_others() {
        let config = TrackerConfig::default();
        let gains = config.quiet;
        let reference = ReferenceSample {
            speed_m_s: 0.6,
            ..ReferenceSample::default()
        };
        let sideslip = Sideslip {
            drift_per_theta_m_s: 0.005,
            drift_per_beyond_m_s: 0.03,
            ..Sideslip::default()
        };
        let drift = DriftSideslip::default();
        let divide =
            |free| IntegralAction::divide(&gains, &config, &reference, (&sideslip, &drift), free);
        let all = CanFollow {
            theta: true,
            beyond: true,
            drift: true,
        };
        let bounded = CanFollow {
            beyond: false,
            ..all
        };
        // Together they want more than the integral action.
        assert!(divide(all).integral_1_m3 < 1.0e-9, "{:?}", divide(all));
        let found = divide(bounded);
        assert!(found.integral_1_m3 > 0.5 * gains.integral_1_m3, "{found:?}");
        assert!(found.adaptation_share > 0.99, "{found:?}");
    }
}
