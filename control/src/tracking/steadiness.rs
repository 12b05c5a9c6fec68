//! How steady the sideslip of the path is.
//!
//! The law rejects the part of the sideslip that its model does not explain. This disturbance is a
//! fraction of the sideslip, so it changes with the sideslip: where the curvature of the path changes,
//! and across a slope. Where the sideslip is constant, adaptation and integral compensate it
//! after a few metres. The remaining error is noise of the pose, which small gains amplify least.

use crate::reference::ReferenceSample;
use crate::robot::GRAVITY_M_S2;

use super::config::TrackerConfig;
use super::drift::DriftSideslip;
use super::sideslip::AdaptedGround;

/// Distance after which a change of the sideslip is forgotten by a factor e, metres.
const MEMORY_M: f64 = 3.0;
/// Change of the sideslip that is assumed at the start, radians.
const AT_START_RAD: f64 = 0.05;
/// Minimum θ in computing the sideslip of the path, because θ̂ starts at zero.
const THETA_MIN: f64 = 0.3;

/// Recent change of the path's sideslip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Steadiness {
    change_rad: f64,
}

impl Default for Steadiness {
    fn default() -> Self {
        Self {
            change_rad: AT_START_RAD,
        }
    }
}

impl Steadiness {
    /// Updates the change and returns the weight, 0 to 1, of the gains for a steady path.
    pub(super) fn update(
        &mut self,
        reference: &ReferenceSample,
        adapted_ground: AdaptedGround,
        drift: &DriftSideslip,
        config: &TrackerConfig,
        dt_s: f64,
    ) -> f64 {
        let speed_m_s = reference.speed_m_s;
        // Rate of θv²κ/g = θvω/g.
        let lateral_jerk_m_s3 = reference.acceleration_m_s2 * reference.turn_rad_s
            + speed_m_s * reference.turn_acceleration_rad_s2;
        let bend_rad_s = adapted_ground.theta.max(THETA_MIN) * lateral_jerk_m_s3 / GRAVITY_M_S2;
        let rate_rad_s = bend_rad_s.abs() + drift.rate_rad_s.abs();
        let forgotten = (speed_m_s * dt_s / MEMORY_M).min(1.0);
        self.change_rad += rate_rad_s * dt_s - forgotten * self.change_rad;
        1.0 / (1.0 + (self.change_rad / config.steady_middle_rad).powi(2))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPEED_M_S: f64 = 0.6;
    const DT_S: f64 = 0.01;

    /// Drives a path whose curvature is a function of the distance, for a distance; returns the
    /// largest and the last weight after the first metre.
    fn driven(distance_m: f64, curvature_1_m: impl Fn(f64) -> f64, drift_rad_s: f64) -> (f64, f64) {
        let mut steadiness = Steadiness::default();
        let drift = DriftSideslip {
            rate_rad_s: drift_rad_s,
            ..DriftSideslip::default()
        };
        let config = TrackerConfig::default();
        let adapted_ground = AdaptedGround {
            theta: 0.0,
            beyond: 1.0,
        };
        let (mut arc_m, mut most, mut last) = (0.0, 0.0_f64, 0.0);
        while arc_m < distance_m {
            let next_m = arc_m + SPEED_M_S * DT_S;
            let reference = ReferenceSample {
                speed_m_s: SPEED_M_S,
                turn_rad_s: SPEED_M_S * curvature_1_m(next_m),
                turn_acceleration_rad_s2: SPEED_M_S
                    * (curvature_1_m(next_m) - curvature_1_m(arc_m))
                    / DT_S,
                ..ReferenceSample::default()
            };
            arc_m = next_m;
            last = steadiness.update(&reference, adapted_ground, &drift, &config, DT_S);
            if arc_m > 1.0 {
                most = most.max(last);
            }
        }
        (most, last)
    }

    #[test]
    fn a_circle_becomes_steady_within_ten_metres() {
        let (_, last) = driven(10.0, |_| 1.0 / 3.0, 0.0);
        assert!(last > 0.8, "{last}");
    }

    #[test]
    fn bends_and_a_slope_are_not_steady() {
        let (most, _) = driven(30.0, |arc_m| 0.7 * (0.8 * arc_m).sin(), 0.0);
        assert!(most < 0.6, "{most}");
        // On a circle of 3 m across a slope of 2° on K 0.7.
        let (most, _) = driven(30.0, |_| 1.0 / 3.0, 0.05 * SPEED_M_S / 3.0);
        assert!(most < 0.2, "{most}");
    }
}
