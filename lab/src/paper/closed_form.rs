//! Dynamics in closed form, (15) to (17), with corrections: equal to the sum over four wheels.
//!
//! `v₁ = σ₂(λ₁)u₁ − σ₂(λ₃)u₂`, `v₂ = σ₂(λ₁)u₁ + σ₂(λ₃)u₂`, `u₁ = 1/(rω₁)`, `u₂ = 1/(rω₃)`. With
//! `a_i = σ₁(λ_i)/(|λ_i| σ₂(λ_i))`, `σ_r1 = a₁ − a₃`, `σ_r2 = a₁ + a₃`:
//!
//! ```text
//! ΣF/m  = gK [½σ_Σ + ¼Wφ̇ v₁ − ½ẋ v₂]                                              (16a)
//! ΣP/m  = −½gKẏ [v₂(1 + ½σ_r2) + ½σ_r1 v₁]                                        (16b)
//! ΣM/I  = mgK/(4I) {−Wσ_Δ + (Wẋ − ¼L²φ̇σ_r1) v₁ − ½[W² + L²(1 + ½σ_r2)]φ̇ v₂}        (16c)
//! ```
//! The paper prints: `σ_r1` and `σ_r2` swapped in (16b) and (17), +½ for −¼ in (16c), no ½ in `e₂`
//! of (17), sgn(φ̇) in `σ_r1` and `σ_r2`. The form is singular for α = 1 beyond `λ_m` (σ₂ = 0), and
//! holds for |λ| < 1 only: elsewhere use [`super::wheels::four_wheel_sum`].

use nalgebra::{Matrix2, RowVector2, Vector2};

use tread_control::friction::FrictionCurve;
use tread_control::measured::WheelSpeeds;
use tread_control::slip::{BodyVelocity, SideSlips};

use crate::paper::Setting;
use crate::paper::wheels::BodyForce;
use tread_control::robot::GRAVITY_M_S2;

/// σ₁ and σ₂ of (9) for a slip magnitude.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sigma {
    /// σ₁; zero in the linear range.
    pub one: f64,
    /// σ₂; one in the linear range, ≤ 0 beyond.
    pub two: f64,
}

impl Sigma {
    /// Computes (9) at `|λ|`.
    pub fn at(slip: f64, curve: &FrictionCurve) -> Self {
        let (peak, alpha) = (curve.peak_slip(), curve.sliding_ratio());
        if slip.abs() < peak {
            return Self { one: 0.0, two: 1.0 };
        }
        let fall = peak / (1.0 - peak);
        Self {
            one: (1.0 - alpha * peak) * fall,
            two: -(1.0 - alpha) * fall,
        }
    }
}

/// Terms of (16) and (17) that depend on the slips alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SlipShape {
    /// σ of the left side.
    pub left: Sigma,
    /// σ of the right side.
    pub right: Sigma,
    /// `σ_Σ`.
    pub sum: f64,
    /// `σ_Δ`.
    pub difference: f64,
    /// `σ_r1 = a₁ − a₃`.
    pub ratio_difference: f64,
    /// `σ_r2 = a₁ + a₃`.
    pub ratio_sum: f64,
}

impl SlipShape {
    /// Computes the terms; None where the closed form is singular: σ₂ = 0, or a slip clamped at ±1.
    pub fn at(slips: SideSlips, curve: &FrictionCurve) -> Option<Self> {
        let (left, right) = (Sigma::at(slips.left, curve), Sigma::at(slips.right, curve));
        if left.two.abs().min(right.two.abs()) <= f64::EPSILON
            || slips.left.abs().max(slips.right.abs()) >= 1.0
        {
            return None;
        }
        let ratio = |sigma: Sigma, slip: f64| {
            if sigma.one > 0.0 {
                sigma.one / (slip.abs() * sigma.two)
            } else {
                0.0
            }
        };
        let (a_left, a_right) = (ratio(left, slips.left), ratio(right, slips.right));
        let signed = [
            left.one * slips.left.signum(),
            right.one * slips.right.signum(),
        ];
        Some(Self {
            left,
            right,
            sum: signed[0] + signed[1] + left.two + right.two,
            difference: signed[0] - signed[1] + left.two - right.two,
            ratio_difference: a_left - a_right,
            ratio_sum: a_left + a_right,
        })
    }

    /// Returns the terms of the linear range, where σ₁ = 0 and σ₂ = 1.
    pub fn linear() -> Self {
        let sigma = Sigma { one: 0.0, two: 1.0 };
        Self {
            left: sigma,
            right: sigma,
            sum: 2.0,
            difference: 0.0,
            ratio_difference: 0.0,
            ratio_sum: 0.0,
        }
    }

    /// Returns the inputs `(v₁, v₂)` of wheel speeds above zero, seconds per metre.
    pub fn inputs(&self, wheels: WheelSpeeds, radius_m: f64) -> Vector2<f64> {
        let left = self.left.two / (radius_m * wheels.left_rad_s);
        let right = self.right.two / (radius_m * wheels.right_rad_s);
        Vector2::new(left - right, left + right)
    }
}

/// Returns E₁ of (17), corrected: rows forward and left, columns v₁ and v₂.
pub fn e_1(velocity: &BodyVelocity, shape: &SlipShape, setting: &Setting) -> Matrix2<f64> {
    let (forward, left) = (velocity.forward_m_s, velocity.left_m_s);
    Matrix2::new(
        setting.model.track_width_m() * velocity.yaw_rate_rad_s,
        -2.0 * forward,
        -shape.ratio_difference * left,
        -2.0 * left * (1.0 + 0.5 * shape.ratio_sum),
    )
}

/// Returns e₂ of (17), corrected: the yaw row.
pub fn e_2(velocity: &BodyVelocity, shape: &SlipShape, setting: &Setting) -> RowVector2<f64> {
    let (track_m, base_m) = (setting.model.track_width_m(), setting.model.wheelbase_m());
    let turn = velocity.yaw_rate_rad_s;
    RowVector2::new(
        track_m * velocity.forward_m_s - 0.25 * base_m * base_m * turn * shape.ratio_difference,
        -0.5 * turn * (track_m * track_m + base_m * base_m * (1.0 + 0.5 * shape.ratio_sum)),
    )
}

/// Returns the forces by (17), `¼mgK (E v + [2σ_Σ, 0, −Wσ_Δ])`, in the body frame.
///
/// None where the closed form is singular, see [`SlipShape::at`].
pub fn forces(
    velocity: &BodyVelocity,
    wheels: WheelSpeeds,
    setting: &Setting,
) -> Option<BodyForce> {
    let model = &setting.model;
    let slips = SideSlips::of(velocity, wheels, model);
    let shape = SlipShape::at(slips, &setting.curve)?;
    let inputs = shape.inputs(wheels, model.wheel_radius_m());
    let scale_n = 0.25 * model.mass_kg() * GRAVITY_M_S2 * setting.curve.stiffness();
    let body = e_1(velocity, &shape, setting) * inputs + Vector2::new(2.0 * shape.sum, 0.0);
    let moment =
        (e_2(velocity, &shape, setting) * inputs)[0] - model.track_width_m() * shape.difference;
    Some(BodyForce {
        longitudinal_n: scale_n * body[0],
        left_n: scale_n * body[1],
        moment_n_m: scale_n * moment,
    })
}
