//! Longitudinal slip of each side's wheels, equation (3) of the paper.

use crate::measured::WheelSpeeds;
use crate::robot::RobotModel;

/// Speeds of the body in its own frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct BodyVelocity {
    /// ẋ, metres per second.
    pub forward_m_s: f64,
    /// ẏ, metres per second.
    pub left_m_s: f64,
    /// φ̇, radians per second.
    pub yaw_rate_rad_s: f64,
}

/// Longitudinal slips of the two sides (3), held within ±1; λ₁ = λ₂ and λ₃ = λ₄.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SideSlips {
    /// λ₁ = λ₂.
    pub left: f64,
    /// λ₃ = λ₄.
    pub right: f64,
}

impl SideSlips {
    /// Slips of a moving base. Wheels must turn forward: at `rω` = 0 the slip is not defined.
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
