//! Means over one step of the simulated base.

use super::{PlantMeans, PlantState};
use crate::measured::{BodyAcceleration, WheelSpeeds};

/// Integrals over one call of [`super::Plant::step`], from which [`PlantMeans`] are computed.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct MeanSums {
    start: PlantState,
    /// State up to which the integrals are computed.
    last: PlantState,
    left_rad: f64,
    right_rad: f64,
    yaw_rad: f64,
    /// `∫ẏφ̇ dt` here and `∫ẋφ̇ dt` below, metres per second.
    left_turned_m_s: f64,
    forward_turned_m_s: f64,
}

impl MeanSums {
    /// Begins at a state.
    pub(super) fn new(start: PlantState) -> Self {
        Self {
            start,
            last: start,
            ..Self::default()
        }
    }

    /// Integrates up to the state after `step_s` more seconds.
    pub(super) fn add(&mut self, next: &PlantState, step_s: f64) {
        let half_s = 0.5 * step_s;
        let last = std::mem::replace(&mut self.last, *next);
        for state in [&last, next] {
            self.left_rad += half_s * state.wheel_speeds.left_rad_s;
            self.right_rad += half_s * state.wheel_speeds.right_rad_s;
            self.yaw_rad += half_s * state.yaw_rate_rad_s;
            self.left_turned_m_s += half_s * state.left_m_s * state.yaw_rate_rad_s;
            self.forward_turned_m_s += half_s * state.forward_m_s * state.yaw_rate_rad_s;
        }
    }

    /// Returns the means over `span_s` seconds, the whole time up to the last state.
    pub(super) fn means(&self, span_s: f64) -> PlantMeans {
        let (start, end) = (&self.start, &self.last);
        PlantMeans {
            wheel_speeds: WheelSpeeds {
                left_rad_s: self.left_rad / span_s,
                right_rad_s: self.right_rad / span_s,
            },
            yaw_rate_rad_s: self.yaw_rad / span_s,
            acceleration: BodyAcceleration {
                forward_m_s2: (end.forward_m_s - start.forward_m_s - self.left_turned_m_s) / span_s,
                left_m_s2: (end.left_m_s - start.left_m_s + self.forward_turned_m_s) / span_s,
            },
        }
    }
}
