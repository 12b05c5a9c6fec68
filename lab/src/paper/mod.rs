//! Implementation of the paper's equations: Yi, Song, Zhang and Goodwin, *Adaptive Trajectory
//! Tracking Control of Skid-Steered Mobile Robots*, with its errors corrected.
//!
//! * [`wheels`]: turning centres (4) to (6), wheel forces (10) to (15), summed over the four
//!   wheels. The reference against which every closed form is tested.
//! * [`closed_form`]: dynamics (16) and (17).
//! * [`reduced`]: the constraint (18), the reduced model (19), (20) and the transformation (21).
//! * [`law`]: the law `yi2007` (22) to (26), and its closed loop on the reduced model.
//!
//! Corrections, each with a test: (17) lacks a ½ in `e₂`; (13) has the sign of the right side's
//! lateral forces wrong; (16b), (16c) and (17) mix up `σ_r1` and `σ_r2`; (14a), (14b) lack the
//! Coriolis terms, without which c of (17) cancels; (23) and (24) lost a dot, they are third
//! derivatives. Slip (3) is [`tread_control::slip::SideSlips`], friction (7) to (9)
//! [`tread_control::friction::FrictionCurve`].
//!
//! This is a test bench and does not drive robots: no force enforces (4) with an imposed S, so on a
//! free base the law diverges. The shipped law is [`tread_control::tracking`].

pub mod closed_form;
pub mod law;
pub mod reduced;
pub mod wheels;

pub use law::{ClosedLoop, ClosedLoopState, Yi2007, Yi2007Config, Yi2007Error};

use tread_control::friction::FrictionCurve;
use tread_control::robot::RobotModel;

/// Robot and ground parameters in the paper's equations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setting {
    /// m, W, L, r and `I_G`.
    pub model: RobotModel,
    /// K, `λ_m` and α.
    pub curve: FrictionCurve,
}
