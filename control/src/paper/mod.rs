//! The paper, exactly: Yi, Song, Zhang and Goodwin, *Adaptive Trajectory Tracking Control of
//! Skid-Steered Mobile Robots*, with its slips of the pen corrected.
//!
//! * [`wheels`]: slip (3), turning centres (4) to (6), wheel forces (10) to (15), summed over the
//!   four wheels. The reference that every closed form is tested against.
//! * [`closed_form`]: dynamics (16) and (17).
//! * [`reduced`]: the constraint (18), the reduced model (19), (20) and the transformation (21).
//! * [`law`]: the law `yi2007` (22) to (26), and its closed loop on the reduced model.
//!
//! Corrected here, each with a test: (17) lacks a ½ in `e₂`; (13) has the sign of the right side's
//! lateral forces wrong; (16b), (16c) and (17) mix up `σ_r1` and `σ_r2`; (14a), (14b) lack the
//! Coriolis terms, without which c of (17) cancels; (23) and (24) lost a dot, they are third
//! derivatives. Friction (7) to (9) is [`crate::friction::FrictionCurve`].
//!
//! This is a bench, not what drives a robot: no force enforces (4) with an imposed S, so on a free
//! base the law diverges. What ships is [`crate::tracking`].

pub mod closed_form;
pub mod law;
pub mod reduced;
pub mod wheels;

pub use law::{ClosedLoop, ClosedLoopState, Yi2007, Yi2007Config, Yi2007Error};

use crate::friction::FrictionCurve;
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

/// Robot and ground of the paper's section IV, all that the equations look at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setting {
    /// m, W, L, r and `I_G`.
    pub model: RobotModel,
    /// K, `λ_m` and α.
    pub curve: FrictionCurve,
}
