//! Longitudinal slip of the wheels of each side, equation (3) of the paper.

use crate::measured::WheelSpeeds;
use crate::robot::RobotModel;

/// Velocity of the centre of mass and turn rate, in the body frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct BodyVelocity {
    /// Forward speed ẋ, metres per second.
    pub forward_m_s: f64,
    /// Lateral speed ẏ, metres per second, positive to the left.
    pub left_m_s: f64,
    /// Turn rate φ̇, radians per second, counter-clockwise positive.
    pub yaw_rate_rad_s: f64,
}

/// Longitudinal slip λ of each side by (3), clamped to ±1; λ₁ = λ₂ and λ₃ = λ₄.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SideSlips {
    /// Slip of the left wheels, λ₁ = λ₂.
    pub left: f64,
    /// Slip of the right wheels, λ₃ = λ₄.
    pub right: f64,
}

impl SideSlips {
    /// Computes `λ = (rω − v_x)/(rω)` per side with `v_x = ẋ ∓ (W/2) φ̇`. Both wheel speeds must be
    /// above zero: slip is undefined at `rω` = 0.
    pub fn of(velocity: &BodyVelocity, wheels: WheelSpeeds, model: &RobotModel) -> Self {
        let half_m_s = 0.5 * model.track_width_m() * velocity.yaw_rate_rad_s;
        let slip = |wheel_rad_s: f64, contact_m_s: f64| {
            let rim_m_s = model.wheel_radius_m() * wheel_rad_s;
            ((rim_m_s - contact_m_s) / rim_m_s).clamp(-1.0, 1.0)
        };
        Self {
            left: slip(wheels.left_rad_s, velocity.forward_m_s - half_m_s),
            right: slip(wheels.right_rad_s, velocity.forward_m_s + half_m_s),
        }
    }
}
