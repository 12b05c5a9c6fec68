//! `[friction]`: weights of measurements of several robots and times.

use serde::Deserialize;
use tread_api::friction::ROBOT_BIAS_RATIO;

/// `[friction]`: weights of measurements of several robots and times.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FrictionConfig {
    /// Standard deviation `s_b` of one robot's bias relative to θ; 0 to 1.
    pub robot_bias_ratio: f64,
    /// Growth `q` of a measurement's variance with its age, in θ² per second; 0 to 1.
    pub drift_variance_per_s: f64,
    /// Age up to which a measured peak friction coefficient is used, in seconds; 1 to 10⁹.
    pub mu_peak_age_max_s: f64,
}

impl Default for FrictionConfig {
    fn default() -> Self {
        Self {
            robot_bias_ratio: ROBOT_BIAS_RATIO,
            // Gives a standard deviation of 0.02 after a day, a tenth of θ on ordinary ground.
            drift_variance_per_s: 4.6e-9,
            mu_peak_age_max_s: 6.0 * 3_600.0,
        }
    }
}
