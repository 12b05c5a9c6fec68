//! Estimates the noise of the pose while driving.

use crate::geometry::Pose;
use crate::measured::Measured;

/// Time constant of the mean, seconds.
const NOISE_MEMORY_S: f64 = 2.0;
/// Bound of a single jump of the pose, metres.
const NOISE_JUMP_MAX_M: f64 = 0.1;

/// Running estimate of the pose's lateral noise, from the difference of each pose to the pose that
/// is propagated from the previous tick by the measured motion.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct NoiseLevel {
    before: Option<Measured>,
    /// Density of white noise, `σ²T`, metres squared seconds.
    density: f64,
}

impl NoiseLevel {
    /// Updates the estimate with the next pose and returns the density, m²·s.
    pub(super) fn update(&mut self, measured: &Measured, dt_s: f64) -> f64 {
        if let Some(before) = self.before.replace(*measured) {
            let motion = before.twist;
            let turned_rad = before.pose.heading_rad + 0.5 * dt_s * motion.angular_rad_s;
            let (sin, cos) = turned_rad.sin_cos();
            let expected = Pose {
                x_m: before.pose.x_m + dt_s * motion.linear_m_s * cos,
                y_m: before.pose.y_m + dt_s * motion.linear_m_s * sin,
                heading_rad: turned_rad,
            };
            let jump_m = expected
                .body_from_site(measured.pose.point())
                .y_m
                .clamp(-NOISE_JUMP_MAX_M, NOISE_JUMP_MAX_M);
            let share = (dt_s / NOISE_MEMORY_S).min(1.0);
            // A difference of two samples has twice the variance of one.
            self.density += share * (0.5 * jump_m * jump_m * dt_s - self.density);
        }
        self.density
    }
}
