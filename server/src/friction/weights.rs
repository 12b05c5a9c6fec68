//! How measurements of several robots and times are weighed.

use serde::Deserialize;
use tread_api::friction::ROBOT_BIAS_RATIO;

/// How measurements of several robots and times are weighed.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FrictionConfig {
    /// Standard deviation of one robot's own bias as a share of θ, `s_b`; 0 to 1.
    pub robot_bias_ratio: f64,
    /// Growth of a measurement's variance with its age, `q`, θ² per second; not negative.
    pub drift_variance_per_s: f64,
    /// How long a friction coefficient that was seen says something of the ground, seconds; 1 to
    /// 10⁹.
    pub mu_peak_age_max_s: f64,
}

impl Default for FrictionConfig {
    fn default() -> Self {
        Self {
            robot_bias_ratio: ROBOT_BIAS_RATIO,
            // A standard deviation of 0.02 after a day: a tenth of θ on ordinary ground.
            drift_variance_per_s: 4.6e-9,
            mu_peak_age_max_s: 6.0 * 3_600.0,
        }
    }
}
