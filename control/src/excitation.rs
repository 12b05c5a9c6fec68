//! Excitation: a bounded variation of speed along a path, so that a base without torque sensing can
//! measure θ.
//!
//! Friction is observable only under acceleration. The plan's time τ advances at the rate
//! `w(t) = 1 − ½A(1 − cos Ωt)`, so `τ(t) = (1 − ½A)t + (A/2Ω) sin Ωt`: the speed varies between
//! `1 − A` and 1 times the plan's speed. The path is unchanged.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Maximum depth A, as a fraction of the speed.
pub const DEPTH_MAX: f64 = 0.8;
/// Minimum period, seconds.
pub const PERIOD_MIN_S: f64 = 1.0;
/// Maximum period, seconds.
pub const PERIOD_MAX_S: f64 = 20.0;
/// Fraction of the acceleration limit that an excitation may use.
const ACCELERATION_SHARE: f64 = 0.5;
/// Fraction of the jerk limit that the excitation alone may use.
const JERK_SHARE: f64 = 0.35;
/// Fraction of the jerk limit that the product of excitation and plan acceleration may use.
const CROSS_JERK_SHARE: f64 = 0.25;
/// Number of bisection steps in inverting τ(t).
const BISECTIONS: u32 = 80;

/// Requested excitation, not yet checked.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExcitationSpec {
    /// Depth A: maximum reduction of the speed as a fraction of it, above 0, at most [`DEPTH_MAX`].
    pub depth_ratio: f64,
    /// Period 2π/Ω, [`PERIOD_MIN_S`] to [`PERIOD_MAX_S`], seconds.
    pub period_s: f64,
}

impl Default for ExcitationSpec {
    fn default() -> Self {
        Self {
            depth_ratio: 0.5,
            period_s: 3.0,
        }
    }
}

/// Parameter of an excitation that is out of its range.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ExcitationError {
    /// The depth is not above zero, or above [`DEPTH_MAX`].
    #[error("`depth_ratio` must be above 0 and at most {DEPTH_MAX}, not {0}")]
    Depth(f64),
    /// The period is outside [`PERIOD_MIN_S`] to [`PERIOD_MAX_S`].
    #[error("`period_s` must be between {PERIOD_MIN_S} and {PERIOD_MAX_S}, not {0}")]
    Period(f64),
}

/// Limits of plan and robot that bound an excitation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ExcitationLimits {
    /// Maximum speed of the plan, metres per second.
    pub(crate) speed_m_s: f64,
    /// Minimum of the acceleration limit along the path, metres per second squared.
    pub(crate) acceleration_m_s2: f64,
    /// Jerk limit, metres per second cubed.
    pub(crate) jerk_m_s3: f64,
}

/// Checked excitation, with its depth reduced to what the limits allow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Excitation {
    depth: f64,
    rate_rad_s: f64,
}

/// Plan time and its derivatives at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PlanTime {
    /// τ, plan seconds.
    pub(crate) plan_s: f64,
    /// w = dτ/dt, plan seconds per second.
    pub(crate) rate: f64,
    /// ẇ, per second.
    pub(crate) rate_slope_1_s: f64,
}

impl Excitation {
    /// Checks an excitation and reduces its depth to what the limits allow.
    ///
    /// # Errors
    /// [`ExcitationError`] if depth or period is out of its range.
    pub(crate) fn within(
        spec: ExcitationSpec,
        limits: ExcitationLimits,
    ) -> Result<Self, ExcitationError> {
        if !(spec.depth_ratio > 0.0 && spec.depth_ratio <= DEPTH_MAX) {
            return Err(ExcitationError::Depth(spec.depth_ratio));
        }
        if !(PERIOD_MIN_S..=PERIOD_MAX_S).contains(&spec.period_s) {
            return Err(ExcitationError::Period(spec.period_s));
        }
        let rate = TAU / spec.period_s;
        let depth = spec
            .depth_ratio
            .min(ACCELERATION_SHARE * limits.acceleration_m_s2 / (0.5 * rate * limits.speed_m_s))
            .min(JERK_SHARE * limits.jerk_m_s3 / (0.5 * rate * rate * limits.speed_m_s))
            .min(CROSS_JERK_SHARE * limits.jerk_m_s3 / (1.5 * rate * limits.acceleration_m_s2));
        Ok(Self {
            depth,
            rate_rad_s: rate,
        })
    }

    /// Returns the depth A after reduction, as a fraction of the speed.
    pub fn depth_ratio(&self) -> f64 {
        self.depth
    }

    /// Returns the period, seconds.
    pub fn period_s(&self) -> f64 {
        TAU / self.rate_rad_s
    }

    /// Returns the maximum acceleration of the excitation alone at a plan speed, `½AΩv`, metres per
    /// second squared.
    pub fn acceleration_m_s2(&self, speed_m_s: f64) -> f64 {
        0.5 * self.depth * self.rate_rad_s * speed_m_s
    }

    /// Returns the fraction of the jerk limit that is left for the plan.
    pub(crate) fn jerk_left_ratio() -> f64 {
        1.0 - JERK_SHARE - CROSS_JERK_SHARE
    }

    /// Returns τ, w and ẇ at a time since the start, seconds.
    pub(crate) fn plan_time(&self, time_s: f64) -> PlanTime {
        let (sin, cos) = (self.rate_rad_s * time_s).sin_cos();
        PlanTime {
            plan_s: (1.0 - 0.5 * self.depth) * time_s + 0.5 * self.depth / self.rate_rad_s * sin,
            rate: 1.0 - 0.5 * self.depth * (1.0 - cos),
            rate_slope_1_s: -0.5 * self.depth * self.rate_rad_s * sin,
        }
    }

    /// Returns the time t since the start, seconds, at which the plan time τ(t) is `plan_s`, by
    /// bisection.
    pub(crate) fn time_s(&self, plan_s: f64) -> f64 {
        let (mut early_s, mut late_s) = (0.0, plan_s / (1.0 - self.depth));
        for _ in 0..BISECTIONS {
            let middle_s = 0.5 * (early_s + late_s);
            if self.plan_time(middle_s).plan_s < plan_s {
                early_s = middle_s;
            } else {
                late_s = middle_s;
            }
        }
        late_s
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn plan_time_grows_at_the_stated_rate_and_is_found_again(
            depth_ratio in 0.01..DEPTH_MAX, period_s in PERIOD_MIN_S..PERIOD_MAX_S,
            time_s in 0.0..500.0_f64,
        ) {
            let limits = ExcitationLimits {
                speed_m_s: 0.6,
                acceleration_m_s2: 50.0,
                jerk_m_s3: 5_000.0,
            };
            let spec = ExcitationSpec { depth_ratio, period_s };
            let excitation = Excitation::within(spec, limits).unwrap();
            let slope = |value: &dyn Fn(f64) -> f64| {
                (value(time_s + 1.0e-4) - value(time_s - 1.0e-4)) / 2.0e-4
            };
            let found = excitation.plan_time(time_s);
            prop_assert!(found.rate > 1.0 - DEPTH_MAX - 1.0e-9 && found.rate <= 1.0 + 1.0e-12);
            prop_assert!((slope(&|t| excitation.plan_time(t).plan_s) - found.rate).abs() < 1.0e-6);
            let rate_slope_1_s = slope(&|t| excitation.plan_time(t).rate);
            prop_assert!((rate_slope_1_s - found.rate_slope_1_s).abs() < 1.0e-4);
            prop_assert!((excitation.time_s(found.plan_s) - time_s).abs() < 1.0e-6);
        }
    }

    #[test]
    fn an_excitation_out_of_range_is_refused_by_name() {
        let limits = ExcitationLimits {
            speed_m_s: 0.6,
            acceleration_m_s2: 0.8,
            jerk_m_s3: 4.0,
        };
        for bad in [0.0, -1.0, 0.9, f64::NAN] {
            let spec = ExcitationSpec {
                depth_ratio: bad,
                ..ExcitationSpec::default()
            };
            let error = Excitation::within(spec, limits).unwrap_err();
            assert!(error.to_string().contains("depth_ratio"), "{error}");
        }
        let spec = ExcitationSpec {
            period_s: f64::NAN,
            ..ExcitationSpec::default()
        };
        assert!(Excitation::within(spec, limits).is_err());
    }
}
