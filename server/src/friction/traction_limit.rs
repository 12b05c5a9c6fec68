//! Computes the traction limit for planning from an estimate of the map.

use tread_control::friction::SLIP_LINEAR;
use tread_control::plan::TRACTION_LIMIT_UNKNOWN_MU;

/// Estimate of a place, as far as it is known.
#[derive(Debug, Clone, Copy)]
pub struct TractionEstimate {
    /// Lower bound of the recent peak friction coefficient.
    pub mu_peak: Option<f64>,
    /// Upper bound of θ.
    pub theta_upper_95: Option<f64>,
}

/// Returns the friction coefficient up to which a plan may use traction: the larger of the recent
/// peak friction and a cautious default, limited to the value that needs [`SLIP_LINEAR`] slip at
/// the upper bound of θ.
pub fn traction_limit_mu(estimate: TractionEstimate) -> f64 {
    let limit_mu = estimate.mu_peak.unwrap_or(0.0);
    let limit_mu = limit_mu.max(TRACTION_LIMIT_UNKNOWN_MU);
    let upper = estimate.theta_upper_95;
    upper.map_or(limit_mu, |upper| limit_mu.min(SLIP_LINEAR * upper.recip()))
}
