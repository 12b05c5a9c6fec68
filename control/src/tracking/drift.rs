//! Sideslip that does not come from the turn: of a slope, and of a rotation centre off the middle.
//!
//! On ground that falls by s (fall over run, a vector in the site frame that points downhill)
//! gravity drives the robot downhill: it has the sideslip `β = d·n`, with `d = θs` and n the unit
//! vector to its left. A robot that rotates about a point `x_c` ahead of the middle of its wheels
//! has the sideslip `β = −κ x_c` there. Both are linear in what is not known, so both are adapted
//! by the gradient of the law's Lyapunov function, as θ̂ is: `ḋ̂ = −γ_d e_y v n` and
//! `x̂̇_c = γ_c e_y v κ`. An error by a slope changes its sign with the heading; the integral would
//! have to follow it, d̂ need not. The product of θ and s is adapted as one, so that a wrong θ̂
//! does not disturb it.

use crate::reference::ReferenceSample;

use super::config::TrackerConfig;

/// Lower bound of the speed in the denominator of the curvature's rate, metres per second.
const SPEED_MIN_M_S: f64 = 0.05;
/// Maximum magnitude of d̂'s rate of change, radians per second.
const SLOPE_RATE_MAX_RAD_S: f64 = 0.1;
/// Maximum magnitude of the rotation centre's rate of change, metres per second.
const CENTER_RATE_MAX_M_S: f64 = 0.05;

/// Adapted sideslip by the slope, and adapted rotation centre.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Drift {
    /// Sideslip d̂ of a robot across the slope, as a vector along the site's axes that points
    /// downhill, radians.
    pub(super) slope_rad: [f64; 2],
    /// Rotation centre `x̂_c` ahead of the middle of the wheels, metres.
    pub(super) center_forward_m: f64,
}

/// Sideslip of a reference by slope and rotation centre, with its derivatives.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct DriftSideslip {
    /// Course minus heading β, radians, counter-clockwise positive.
    pub(super) angle_rad: f64,
    /// Rate of β, radians per second.
    pub(super) rate_rad_s: f64,
    /// Drift to the right per d̂ along each of the site's axes, metres per second.
    pub(super) per_slope_m_s: [f64; 2],
    /// Drift to the right per metre of the rotation centre, per second.
    pub(super) per_center_1_s: f64,
}

/// One tick of adaptation.
#[derive(Debug, Clone, Copy)]
pub(super) struct AdaptationTick {
    /// Cross-track error times the share of the gains, metres.
    pub(super) error_m: f64,
    /// Duration, seconds.
    pub(super) dt_s: f64,
}

impl Drift {
    /// Moves both towards zero by a fraction, 0 to 1.
    pub(super) fn decay(&mut self, share: f64) {
        let kept = 1.0 - share;
        self.slope_rad = self.slope_rad.map(|slope_rad| kept * slope_rad);
        self.center_forward_m *= kept;
    }

    /// Computes the sideslip of a reference.
    pub(super) fn sideslip(&self, reference: &ReferenceSample) -> DriftSideslip {
        let (sin, cos) = reference.pose.heading_rad.sin_cos();
        let [x_rad, y_rad] = self.slope_rad;
        let (left_rad, forward_rad) = (cos * y_rad - sin * x_rad, cos * x_rad + sin * y_rad);
        let speed_m_s = reference.speed_m_s;
        let curvature_rate_1_m_s = (reference.turn_acceleration_rad_s2
            - reference.curvature_1_m * reference.acceleration_m_s2)
            / speed_m_s.max(SPEED_MIN_M_S);
        DriftSideslip {
            angle_rad: left_rad - reference.curvature_1_m * self.center_forward_m,
            rate_rad_s: -reference.turn_rad_s * forward_rad
                - curvature_rate_1_m_s * self.center_forward_m,
            per_slope_m_s: [speed_m_s * sin, -speed_m_s * cos],
            per_center_1_s: reference.turn_rad_s,
        }
    }

    /// Moves both along the gradient, bounded in rate and range.
    pub(super) fn adapt(
        &mut self,
        sideslip: &DriftSideslip,
        config: &TrackerConfig,
        tick: AdaptationTick,
    ) {
        let AdaptationTick { error_m, dt_s } = tick;
        let rates = sideslip
            .per_slope_m_s
            .map(|drift_m_s| config.slope_gain_1_m2 * error_m * drift_m_s);
        let shrink = shrink_to(rates, SLOPE_RATE_MAX_RAD_S);
        for (slope_rad, rate_rad_s) in self.slope_rad.iter_mut().zip(rates) {
            *slope_rad += shrink * rate_rad_s * dt_s;
        }
        let shrink = shrink_to(self.slope_rad, config.slope_drift_max_rad);
        self.slope_rad = self.slope_rad.map(|slope_rad| shrink * slope_rad);
        let rate_m_s = (config.center_gain * error_m * sideslip.per_center_1_s)
            .clamp(-CENTER_RATE_MAX_M_S, CENTER_RATE_MAX_M_S);
        self.center_forward_m = (self.center_forward_m + rate_m_s * dt_s)
            .clamp(-config.center_max_m, config.center_max_m);
    }
}

/// Returns the factor, at most 1, that brings a vector within a magnitude.
fn shrink_to(vector: [f64; 2], most: f64) -> f64 {
    let size = vector[0].hypot(vector[1]);
    if size > most { most / size } else { 1.0 }
}
