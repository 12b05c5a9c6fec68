//! A bounded variation of the speed along a path, so that a base without torque sensing can measure θ.
//!
//! Friction shows only where something accelerates. The plan's time is run through at the pace
//! `w(t) = 1 − ½A(1 − cos Ωt)`, so `τ(t) = (1 − ½A)t + (A/2Ω) sin Ωt`: the speed falls to `1 − A` of
//! the plan's and comes back, and never exceeds it. The path stays the path.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Deepest excitation, share of the speed.
pub const DEPTH_MAX: f64 = 0.8;
/// Shortest period, seconds.
pub const PERIOD_MIN_S: f64 = 1.0;
/// Longest period, seconds.
pub const PERIOD_MAX_S: f64 = 20.0;
/// Share of the acceleration limit that an excitation may take.
const ACCELERATION_SHARE: f64 = 0.5;
/// Share of the jerk limit that the excitation alone may take.
const JERK_SHARE: f64 = 0.35;
/// Share of the jerk limit that its product with the plan's acceleration may take.
const CROSS_JERK_SHARE: f64 = 0.25;
/// Steps of the search for the time at which the plan's own time is reached.
const BISECTIONS: u32 = 80;

/// What was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExcitationSpec {
    /// By which share the speed falls at most, above 0, at most [`DEPTH_MAX`].
    pub depth_ratio: f64,
    /// Time from one slowing down to the next, [`PERIOD_MIN_S`] to [`PERIOD_MAX_S`], seconds.
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

/// Why an excitation was refused.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ExcitationError {
    /// The depth is not above zero, or too deep.
    #[error("`depth_ratio` must be above 0 and at most {DEPTH_MAX}, not {0}")]
    Depth(f64),
    /// The period is out of its range.
    #[error("`period_s` must be between {PERIOD_MIN_S} and {PERIOD_MAX_S}, not {0}")]
    Period(f64),
}

/// What a robot's limits leave for an excitation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Room {
    /// Fastest speed of the plan, metres per second.
    pub(crate) speed_m_s: f64,
    /// Lowest acceleration limit along the path, metres per second squared.
    pub(crate) acceleration_m_s2: f64,
    /// Jerk limit, metres per second cubed.
    pub(crate) jerk_m_s3: f64,
}

/// A checked excitation, as deep as the limits let it be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Excitation {
    depth: f64,
    rate_rad_s: f64,
}

/// Plan time and its pace at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Warp {
    /// τ, seconds of the plan.
    pub(crate) plan_s: f64,
    /// w, seconds of the plan per second.
    pub(crate) pace: f64,
    /// ẇ, per second.
    pub(crate) pace_rate_1_s: f64,
}

impl Excitation {
    /// Checks an excitation and lessens its depth to what the limits leave.
    pub(crate) fn within(spec: ExcitationSpec, room: Room) -> Result<Self, ExcitationError> {
        if !(spec.depth_ratio > 0.0 && spec.depth_ratio <= DEPTH_MAX) {
            return Err(ExcitationError::Depth(spec.depth_ratio));
        }
        if !(PERIOD_MIN_S..=PERIOD_MAX_S).contains(&spec.period_s) {
            return Err(ExcitationError::Period(spec.period_s));
        }
        let rate = TAU / spec.period_s;
        let depth = spec
            .depth_ratio
            .min(ACCELERATION_SHARE * room.acceleration_m_s2 / (0.5 * rate * room.speed_m_s))
            .min(JERK_SHARE * room.jerk_m_s3 / (0.5 * rate * rate * room.speed_m_s))
            .min(CROSS_JERK_SHARE * room.jerk_m_s3 / (1.5 * rate * room.acceleration_m_s2));
        Ok(Self {
            depth,
            rate_rad_s: rate,
        })
    }

    /// Share by which the speed falls at most.
    pub fn depth_ratio(&self) -> f64 {
        self.depth
    }

    /// Period, seconds.
    pub fn period_s(&self) -> f64 {
        TAU / self.rate_rad_s
    }

    /// Hardest acceleration by the excitation alone at a speed, metres per second squared.
    pub fn acceleration_m_s2(&self, speed_m_s: f64) -> f64 {
        0.5 * self.depth * self.rate_rad_s * speed_m_s
    }

    /// Share of the jerk limit that is left for the plan.
    pub(crate) fn jerk_left_ratio() -> f64 {
        1.0 - JERK_SHARE - CROSS_JERK_SHARE
    }

    /// Where the plan is at a time, seconds.
    pub(crate) fn warp(&self, time_s: f64) -> Warp {
        let (sin, cos) = (self.rate_rad_s * time_s).sin_cos();
        Warp {
            plan_s: (1.0 - 0.5 * self.depth) * time_s + 0.5 * self.depth / self.rate_rad_s * sin,
            pace: 1.0 - 0.5 * self.depth * (1.0 - cos),
            pace_rate_1_s: -0.5 * self.depth * self.rate_rad_s * sin,
        }
    }

    /// When the plan's own time is reached, seconds.
    pub(crate) fn time_s(&self, plan_s: f64) -> f64 {
        let (mut early_s, mut late_s) = (0.0, plan_s / (1.0 - self.depth));
        for _ in 0..BISECTIONS {
            let middle_s = 0.5 * (early_s + late_s);
            if self.warp(middle_s).plan_s < plan_s {
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
        fn plan_time_grows_at_the_stated_pace_and_is_found_again(
            depth_ratio in 0.01..DEPTH_MAX, period_s in PERIOD_MIN_S..PERIOD_MAX_S,
            time_s in 0.0..500.0_f64,
        ) {
            let room = Room { speed_m_s: 0.6, acceleration_m_s2: 50.0, jerk_m_s3: 5_000.0 };
            let spec = ExcitationSpec { depth_ratio, period_s };
            let excitation = Excitation::within(spec, room).unwrap();
            let slope = |value: &dyn Fn(f64) -> f64| {
                (value(time_s + 1.0e-4) - value(time_s - 1.0e-4)) / 2.0e-4
            };
            let found = excitation.warp(time_s);
            prop_assert!(found.pace > 1.0 - DEPTH_MAX - 1.0e-9 && found.pace <= 1.0 + 1.0e-12);
            prop_assert!((slope(&|t| excitation.warp(t).plan_s) - found.pace).abs() < 1.0e-6);
            prop_assert!((slope(&|t| excitation.warp(t).pace) - found.pace_rate_1_s).abs() < 1.0e-4);
            prop_assert!((excitation.time_s(found.plan_s) - time_s).abs() < 1.0e-6);
        }
    }

    #[test]
    fn an_excitation_out_of_range_is_refused_by_name() {
        let room = Room {
            speed_m_s: 0.6,
            acceleration_m_s2: 0.8,
            jerk_m_s3: 4.0,
        };
        for bad in [0.0, -1.0, 0.9, f64::NAN] {
            let spec = ExcitationSpec {
                depth_ratio: bad,
                ..ExcitationSpec::default()
            };
            let error = Excitation::within(spec, room).unwrap_err();
            assert!(error.to_string().contains("depth_ratio"), "{error}");
        }
        let spec = ExcitationSpec {
            period_s: f64::NAN,
            ..ExcitationSpec::default()
        };
        assert!(Excitation::within(spec, room).is_err());
    }
}
