//! Gains and bounds of the tracking law, with their validation.

use thiserror::Error;

use crate::friction::FrictionCurve;

/// Gains across the path. All but `yaw_rate` act per distance driven, so that damping does not
/// depend on speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CrossGains {
    /// Cross-track gain `k_y`, per metre squared, above 0.
    pub cross_1_m2: f64,
    /// Heading gain `k_θ`, per metre, above 0.
    pub heading_1_m: f64,
    /// Integral gain `k_I` on the cross-track error over the distance driven, per metre cubed, 0 to
    /// below `k_θ k_y`: that of the integral and of the adaptation together.
    pub integral_1_m3: f64,
    /// Inner-loop gain `k_r` from turn rate error (requested minus measured) to the turn rate command,
    /// 0 to below 1, so that no lag or delay of the base can make the loop unstable.
    pub yaw_rate: f64,
}

impl CrossGains {
    /// Returns the weighted mean with another set, which has the weight `share`, 0 to 1; this one
    /// has the weight 1 − `share`.
    pub(super) fn towards(self, other: Self, share: f64) -> Self {
        let mix = |own: f64, other: f64| own + share * (other - own);
        Self {
            cross_1_m2: mix(self.cross_1_m2, other.cross_1_m2),
            heading_1_m: mix(self.heading_1_m, other.heading_1_m),
            integral_1_m3: mix(self.integral_1_m3, other.integral_1_m3),
            yaw_rate: mix(self.yaw_rate, other.yaw_rate),
        }
    }
}

/// Gains and bounds of the law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerConfig {
    /// Along-track gain `k_x`, per second, above 0.
    pub along_track_gain_1_s: f64,
    /// Gains across the path for a pose without noise.
    pub quiet: CrossGains,
    /// Gains across the path for a noisy pose.
    pub noisy: CrossGains,
    /// Gains across the path for a noisy pose on a path of constant sideslip.
    pub steady: CrossGains,
    /// Change of the sideslip over the last metres at which `noisy` and `steady` have equal weight,
    /// radians, above 0.
    pub steady_middle_rad: f64,
    /// Pose noise at which both gain sets have equal weight, as amplitude density `σ√T` of white
    /// noise, m·√s, above 0.
    pub noise_middle_m_sqrt_s: f64,
    /// Standard deviation of the position at which both gain sets have equal weight, metres, above
    /// 0; it covers filtered noise, which is not white.
    pub position_middle_m: f64,
    /// Maximum magnitude of the integral term, as curvature, per metre, at least 0.
    pub integral_max_1_m: f64,
    /// First-order lag of the wheel servo that the law compensates, seconds, at least 0.
    pub servo_lag_s: f64,
    /// Adaptation gain ρ of θ̂, per metre squared, at least 0.
    pub adaptation_gain: f64,
    /// Friction curve that gives the loss beyond the peak. Only its shape (`λ_m`, α) is used, not
    /// its stiffness.
    pub friction_curve: FrictionCurve,
    /// Adaptation gain `ρ_χ` of χ̂, the fraction of that loss that shows, per metre squared.
    pub beyond_gain: f64,
    /// Maximum magnitude of θ̂̇ by the gradient, per second, at least 0.
    pub adaptation_rate_max_1_s: f64,
    /// Rate p of the pull of θ̂ to a known θ, per second: `c p (c θ − θ̂)` for 2 s with the
    /// confidence c. Which θ pulls is decided when knowledge is applied.
    pub adaptation_pull_1_s: f64,
    /// Maximum θ̂, above 0.
    pub theta_max: f64,
    /// Adaptation gain `γ_d` of d̂, the sideslip by a slope, per metre squared, at least 0.
    pub slope_gain_1_m2: f64,
    /// Maximum magnitude of d̂, radians, at least 0; θ times the slope as fall over run.
    pub slope_drift_max_rad: f64,
    /// Adaptation gain `γ_c` of the rotation centre `x̂_c`, without a unit, at least 0.
    pub center_gain: f64,
    /// Maximum distance of the rotation centre from the middle of the wheels, metres, at least 0.
    pub center_max_m: f64,
    /// Maximum part of the integral action `k_I` that the adaptation of all values together has, 0
    /// to 1. The adaptation gains are scaled down to it, and the integral has the rest.
    pub adaptation_share_max: f64,
    /// Pose age above which adaptation and integral are held, seconds, above 0.
    pub pose_age_max_s: f64,
}

impl Default for TrackerConfig {
    fn default() -> Self {
        Self {
            along_track_gain_1_s: 3.0,
            quiet: CrossGains {
                cross_1_m2: 21.0,
                heading_1_m: 8.5,
                integral_1_m3: 28.0,
                yaw_rate: 0.55,
            },
            noisy: CrossGains {
                cross_1_m2: 18.0,
                heading_1_m: 9.4,
                integral_1_m3: 12.0,
                yaw_rate: 0.75,
            },
            steady: CrossGains {
                cross_1_m2: 4.0,
                heading_1_m: 5.0,
                integral_1_m3: 0.3,
                yaw_rate: 0.6,
            },
            steady_middle_rad: 1.0e-2,
            noise_middle_m_sqrt_s: 7.0e-4,
            position_middle_m: 4.0e-3,
            integral_max_1_m: 0.5,
            servo_lag_s: 0.05,
            adaptation_gain: 1400.0,
            friction_curve: FrictionCurve::yi2007(),
            beyond_gain: 22_000.0,
            adaptation_rate_max_1_s: 0.3,
            adaptation_pull_1_s: 10.0,
            theta_max: 4.0,
            slope_gain_1_m2: 0.6,
            slope_drift_max_rad: 0.15,
            center_gain: 1.0,
            center_max_m: 0.1,
            adaptation_share_max: 1.0,
            pose_age_max_s: 0.3,
        }
    }
}

/// Gain or bound that is out of its range.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum TrackerError {
    /// A value is NaN, infinite or out of its range.
    #[error("`{field}` is out of its range: {value}")]
    OutOfRange {
        /// Name of the field.
        field: &'static str,
        /// Rejected value.
        value: f64,
    },
}

impl TrackerConfig {
    /// Checks all ranges.
    ///
    /// # Errors
    /// [`TrackerError::OutOfRange`] names the first value out of its range.
    pub(super) fn check(&self) -> Result<(), TrackerError> {
        let positive = [
            ("along_track_gain_1_s", self.along_track_gain_1_s),
            ("quiet.cross_1_m2", self.quiet.cross_1_m2),
            ("quiet.heading_1_m", self.quiet.heading_1_m),
            ("noisy.cross_1_m2", self.noisy.cross_1_m2),
            ("noisy.heading_1_m", self.noisy.heading_1_m),
            ("steady.cross_1_m2", self.steady.cross_1_m2),
            ("steady.heading_1_m", self.steady.heading_1_m),
            ("steady_middle_rad", self.steady_middle_rad),
            ("noise_middle_m_sqrt_s", self.noise_middle_m_sqrt_s),
            ("position_middle_m", self.position_middle_m),
            ("theta_max", self.theta_max),
            ("pose_age_max_s", self.pose_age_max_s),
        ];
        let at_least_zero = [
            ("quiet.yaw_rate", self.quiet.yaw_rate),
            ("noisy.yaw_rate", self.noisy.yaw_rate),
            ("steady.yaw_rate", self.steady.yaw_rate),
            ("quiet.integral_1_m3", self.quiet.integral_1_m3),
            ("noisy.integral_1_m3", self.noisy.integral_1_m3),
            ("steady.integral_1_m3", self.steady.integral_1_m3),
            ("integral_max_1_m", self.integral_max_1_m),
            ("servo_lag_s", self.servo_lag_s),
            ("adaptation_gain", self.adaptation_gain),
            ("beyond_gain", self.beyond_gain),
            ("adaptation_rate_max_1_s", self.adaptation_rate_max_1_s),
            ("adaptation_pull_1_s", self.adaptation_pull_1_s),
            ("slope_gain_1_m2", self.slope_gain_1_m2),
            ("slope_drift_max_rad", self.slope_drift_max_rad),
            ("center_gain", self.center_gain),
            ("center_max_m", self.center_max_m),
            ("adaptation_share_max", self.adaptation_share_max),
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
        if self.adaptation_share_max > 1.0 {
            return Err(TrackerError::OutOfRange {
                field: "adaptation_share_max",
                value: self.adaptation_share_max,
            });
        }
        for (integral, yaw_rate, gains) in [
            ("quiet.integral_1_m3", "quiet.yaw_rate", self.quiet),
            ("noisy.integral_1_m3", "noisy.yaw_rate", self.noisy),
            ("steady.integral_1_m3", "steady.yaw_rate", self.steady),
        ] {
            if gains.yaw_rate >= 1.0 {
                return Err(TrackerError::OutOfRange {
                    field: yaw_rate,
                    value: gains.yaw_rate,
                });
            }
            // Routh criterion of the loop across the path, s³ + k_θ s² + k_y s + k_I.
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
