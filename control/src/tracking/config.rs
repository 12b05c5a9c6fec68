//! Gains and bounds of the law, checked once.

use thiserror::Error;

use crate::friction::FrictionCurve;

/// Gains across the path; in metres driven, so that the speed does not change their damping. Only
/// the inner loop's is not.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CrossGains {
    /// Cross-track gain `k_y`, per metre squared.
    pub cross_1_m2: f64,
    /// Heading gain `k_θ`, per metre.
    pub heading_1_m: f64,
    /// Integral gain `k_I` on the cross-track error over the distance driven, per metre cubed.
    pub integral_1_m3: f64,
    /// Gain from the gap between the wanted and the measured turn rate to the command; below 1, so
    /// that no lag or delay of the base can make this inner loop unstable.
    pub yaw_rate: f64,
}

impl CrossGains {
    /// A mean of two sets; `share` of the first.
    pub(super) fn blend(first: Self, second: Self, share: f64) -> Self {
        let mix = |one: f64, other: f64| other + share * (one - other);
        Self {
            cross_1_m2: mix(first.cross_1_m2, second.cross_1_m2),
            heading_1_m: mix(first.heading_1_m, second.heading_1_m),
            integral_1_m3: mix(first.integral_1_m3, second.integral_1_m3),
            yaw_rate: mix(first.yaw_rate, second.yaw_rate),
        }
    }
}

/// Gains and bounds of the law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerConfig {
    /// Along-track gain `k_x`, per second.
    pub along_track_gain_1_s: f64,
    /// Gains across the path while the pose is quiet.
    pub quiet: CrossGains,
    /// Gains across the path while the pose is noisy.
    pub noisy: CrossGains,
    /// Noise of the pose half-way between both, as density `σ√T` of white noise, m·√s.
    pub noise_middle_m_sqrt_s: f64,
    /// The same as the position's standard deviation, metres: a filter's noise is no white one.
    pub position_middle_m: f64,
    /// Largest turn of the path's curvature by the integral, per metre.
    pub integral_max_1_m: f64,
    /// First-order lag of the wheel servo that is led, seconds.
    pub servo_lag_s: f64,
    /// Adaptation gain ρ.
    pub adaptation_gain: f64,
    /// Friction curve, for the loss beyond its peak; of this curve only the shape counts, never the
    /// stiffness.
    pub friction_curve: FrictionCurve,
    /// Adaptation gain of the share of that loss which shows.
    pub beyond_gain: f64,
    /// Fastest change of θ̂, per second.
    pub adaptation_rate_max_1_s: f64,
    /// Pull of θ̂ to a θ that is known, per second, at full confidence: so little that errors may
    /// lead it off.
    pub adaptation_pull_1_s: f64,
    /// The same farther from it than it may be led off.
    pub adaptation_return_1_s: f64,
    /// How far θ̂ may be led off a known θ, as a share of that and beside its standard deviation.
    pub adaptation_band_ratio: f64,
    /// Largest θ̂.
    pub theta_max: f64,
    /// Age of the pose beyond which adaptation and integral are held, seconds.
    pub pose_age_max_s: f64,
}

impl Default for TrackerConfig {
    fn default() -> Self {
        Self {
            along_track_gain_1_s: 3.0,
            quiet: CrossGains {
                cross_1_m2: 20.0,
                heading_1_m: 8.0,
                integral_1_m3: 26.0,
                yaw_rate: 0.7,
            },
            noisy: CrossGains {
                cross_1_m2: 14.0,
                heading_1_m: 9.0,
                integral_1_m3: 7.0,
                yaw_rate: 0.6,
            },
            noise_middle_m_sqrt_s: 7.0e-4,
            position_middle_m: 4.0e-3,
            integral_max_1_m: 0.5,
            servo_lag_s: 0.05,
            adaptation_gain: 2800.0,
            friction_curve: FrictionCurve::yi2007(),
            beyond_gain: 8_000.0,
            adaptation_rate_max_1_s: 0.3,
            adaptation_pull_1_s: 1.0,
            adaptation_return_1_s: 10.0,
            adaptation_band_ratio: 0.3,
            theta_max: 4.0,
            pose_age_max_s: 0.3,
        }
    }
}

/// Why gains were refused.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum TrackerError {
    /// A figure is NaN, infinite or out of its range.
    #[error("`{field}` is out of its range: {value}")]
    OutOfRange {
        /// The field's name.
        field: &'static str,
        /// What it held.
        value: f64,
    },
}

impl TrackerConfig {
    /// Refuses gains that are out of range by name.
    pub(super) fn check(&self) -> Result<(), TrackerError> {
        let positive = [
            ("along_track_gain_1_s", self.along_track_gain_1_s),
            ("quiet.cross_1_m2", self.quiet.cross_1_m2),
            ("quiet.heading_1_m", self.quiet.heading_1_m),
            ("noisy.cross_1_m2", self.noisy.cross_1_m2),
            ("noisy.heading_1_m", self.noisy.heading_1_m),
            ("noise_middle_m_sqrt_s", self.noise_middle_m_sqrt_s),
            ("position_middle_m", self.position_middle_m),
            ("theta_max", self.theta_max),
            ("pose_age_max_s", self.pose_age_max_s),
        ];
        let at_least_zero = [
            ("quiet.yaw_rate", self.quiet.yaw_rate),
            ("noisy.yaw_rate", self.noisy.yaw_rate),
            ("quiet.integral_1_m3", self.quiet.integral_1_m3),
            ("noisy.integral_1_m3", self.noisy.integral_1_m3),
            ("integral_max_1_m", self.integral_max_1_m),
            ("servo_lag_s", self.servo_lag_s),
            ("adaptation_gain", self.adaptation_gain),
            ("beyond_gain", self.beyond_gain),
            ("adaptation_rate_max_1_s", self.adaptation_rate_max_1_s),
            ("adaptation_pull_1_s", self.adaptation_pull_1_s),
            ("adaptation_return_1_s", self.adaptation_return_1_s),
            ("adaptation_band_ratio", self.adaptation_band_ratio),
        ];
        for (field, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(TrackerError::OutOfRange { field, value });
            }
        }
        for (field, value) in at_least_zero {
            if !(value.is_finite() && value >= 0.0) {
                return Err(TrackerError::OutOfRange { field, value });
            }
        }
        for (integral, yaw_rate, gains) in [
            ("quiet.integral_1_m3", "quiet.yaw_rate", self.quiet),
            ("noisy.integral_1_m3", "noisy.yaw_rate", self.noisy),
        ] {
            if gains.yaw_rate >= 1.0 {
                return Err(TrackerError::OutOfRange {
                    field: yaw_rate,
                    value: gains.yaw_rate,
                });
            }
            // Routh's criterion of the loop across the path, `s³ + k_θ s² + k_y s + k_I`.
            if gains.integral_1_m3 >= gains.heading_1_m * gains.cross_1_m2 {
                return Err(TrackerError::OutOfRange {
                    field: integral,
                    value: gains.integral_1_m3,
                });
            }
        }
        Ok(())
    }
}
