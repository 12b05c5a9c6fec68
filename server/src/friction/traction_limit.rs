//! Computes the traction limit for planning from an estimate of the map.

use tread_control::friction::SLIP_LINEAR;
use tread_control::plan::TRACTION_LIMIT_UNKNOWN_MU;

/// Returns the friction coefficient up to which a plan may use traction: the larger of the recent
/// peak friction and a cautious default, limited to the value that needs [`SLIP_LINEAR`] slip at
/// the upper bound of θ.
pub fn traction_limit_mu(mu_peak: Option<f64>, theta_upper_95: Option<f64>) -> f64 {
    let limit_mu = mu_peak.unwrap_or(0.0).max(TRACTION_LIMIT_UNKNOWN_MU);
    theta_upper_95.map_or(limit_mu, |upper| limit_mu.min(SLIP_LINEAR * upper.recip()))
}
