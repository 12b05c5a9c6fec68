//! The friction coefficient to plan with, from what the map knows.

use tread_control::friction::SLIP_LINEAR;
use tread_control::plan::TRACTION_LIMIT_UNKNOWN_MU;

/// The larger of what was shown of late and a cautious value, within what needs no more than linear
/// slip where θ is at its upper bound.
pub fn traction_limit_mu(mu_peak: Option<f64>, theta_upper_95: Option<f64>) -> f64 {
    let limit_mu = mu_peak.unwrap_or(0.0).max(TRACTION_LIMIT_UNKNOWN_MU);
    theta_upper_95.map_or(limit_mu, |upper| limit_mu.min(SLIP_LINEAR * upper.recip()))
}
