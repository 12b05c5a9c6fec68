//! Forces of the four wheels, one by one: turning centres (4) to (6), forces (7) to (15).
//!
//! Wheels are numbered as in the paper: left front, left rear, right front, right rear. Forces are
//! signed (the paper writes magnitudes and `sgn(λ)`). The friction coefficient depends on the
//! longitudinal slip alone, and `P_i = F_i tan θ_i` (10), so that the force opposes the slip
//! *vector*. With (13) as printed the right side's lateral force would push with the slip.

use tread_control::friction::FrictionCurve;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::{GRAVITY_M_S2, RobotModel};
use tread_control::slip::{BodyVelocity, SideSlips};

use crate::paper::Setting;

/// Turn rate below which the turning centres are at infinity, radians per second.
const TURN_MIN_RAD_S: f64 = 1.0e-9;

/// Forces and moment on the body, in the body frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct BodyForce {
    /// ΣF, newtons, forward.
    pub longitudinal_n: f64,
    /// ΣP, newtons, to the left.
    pub left_n: f64,
    /// `Σ(x_i P_i − y_i F_i)`, newton metres, counter-clockwise positive.
    pub moment_n_m: f64,
}

/// Second derivatives in the body frame: ẍ, ÿ, φ̈.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct BodyRates {
    /// ẍ, metres per second squared.
    pub forward_m_s2: f64,
    /// ÿ, metres per second squared.
    pub left_m_s2: f64,
    /// φ̈, radians per second squared.
    pub yaw_rad_s2: f64,
}

impl BodyForce {
    /// Returns the accelerations by (14) with its Coriolis terms: `m(ẍ − ẏφ̇) = ΣF`,
    /// `m(ÿ + ẋφ̇) = ΣP`.
    pub fn rates(&self, velocity: &BodyVelocity, model: &RobotModel) -> BodyRates {
        BodyRates {
            forward_m_s2: self.longitudinal_n / model.mass_kg()
                + velocity.left_m_s * velocity.yaw_rate_rad_s,
            left_m_s2: self.left_n / model.mass_kg()
                - velocity.forward_m_s * velocity.yaw_rate_rad_s,
            yaw_rad_s2: self.moment_n_m / model.yaw_inertia_kg_m2(),
        }
    }
}

/// Turning centres of the contacts and of the body (4) to (6), in the body frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TurningCentres {
    /// S = −ẏ/φ̇, the x coordinate of all three, metres.
    pub forward_m: f64,
    /// `y_l = (ẋ − rω₁)/φ̇`, metres.
    pub left_m: f64,
    /// `y_r = (ẋ − rω₃)/φ̇`, metres.
    pub right_m: f64,
    /// `y_G = ẋ/φ̇`, metres.
    pub body_m: f64,
}

impl TurningCentres {
    /// Computes the centres; None when the body does not turn, so that they are at infinity.
    pub fn of(velocity: &BodyVelocity, wheels: WheelSpeeds, model: &RobotModel) -> Option<Self> {
        let turn = velocity.yaw_rate_rad_s;
        (turn.abs() > TURN_MIN_RAD_S).then(|| Self {
            forward_m: -velocity.left_m_s / turn,
            left_m: (velocity.forward_m_s - model.wheel_radius_m() * wheels.left_rad_s) / turn,
            right_m: (velocity.forward_m_s - model.wheel_radius_m() * wheels.right_rad_s) / turn,
            body_m: velocity.forward_m_s / turn,
        })
    }
}

/// Returns force over load and slip, `K(σ₁ + σ₂|λ|)/|λ|`, the factor of the slip vector.
fn stiffness(curve: &FrictionCurve, slip: f64) -> f64 {
    curve.mu_over_slip(slip.abs())
}

/// Returns the sum of the four wheels' forces, in both ranges of slip, regular at λ = 0.
///
/// Wheels must turn forward. Longitudinal slips beyond 1 act as 1; the lateral force keeps the
/// direction of the slip vector.
pub fn four_wheel_sum(
    velocity: &BodyVelocity,
    wheels: WheelSpeeds,
    setting: &Setting,
) -> BodyForce {
    let model = &setting.model;
    let load_n = model.mass_kg() * GRAVITY_M_S2 / 4.0;
    let slips = SideSlips::of(velocity, wheels, model);
    let mut sum = BodyForce::default();
    for (y_sign, slip, wheel_rad_s) in [
        (1.0, slips.left, wheels.left_rad_s),
        (-1.0, slips.right, wheels.right_rad_s),
    ] {
        let y_m = y_sign * 0.5 * model.track_width_m();
        let rim_m_s = model.wheel_radius_m() * wheel_rad_s;
        let stiff = stiffness(&setting.curve, slip);
        let force_n = load_n * stiff * slip;
        let skid_m_s = velocity.forward_m_s - velocity.yaw_rate_rad_s * y_m - rim_m_s;
        for x_sign in [1.0, -1.0] {
            let x_m = x_sign * 0.5 * model.wheelbase_m();
            let left_m_s = velocity.left_m_s + velocity.yaw_rate_rad_s * x_m;
            // F tan θ = F v_y/Δv_x, and Δv_x = −rω λ while the slip is not clamped at ±1.
            let lateral_n = if slip.abs() < 1.0 {
                -load_n * stiff * left_m_s / rim_m_s
            } else {
                force_n * left_m_s / skid_m_s
            };
            sum.longitudinal_n += force_n;
            sum.left_n += lateral_n;
            sum.moment_n_m += x_m * lateral_n - y_m * force_n;
        }
    }
    sum
}

/// Returns the lateral forces of the four wheels in newtons by (12) and (13), the latter with its
/// sign corrected.
///
/// None when the body does not turn, or a turning centre is at its contact.
pub fn lateral_forces_n(
    velocity: &BodyVelocity,
    wheels: WheelSpeeds,
    setting: &Setting,
) -> Option<[f64; 4]> {
    let model = &setting.model;
    let centres = TurningCentres::of(velocity, wheels, model)?;
    let slips = SideSlips::of(velocity, wheels, model);
    let load_n = model.mass_kg() * GRAVITY_M_S2 / 4.0;
    let half_base_m = 0.5 * model.wheelbase_m();
    let half_track_m = 0.5 * model.track_width_m();
    let mut forces_n = [0.0; 4];
    for (side, (slip, lever_m)) in [
        (slips.left, centres.left_m - half_track_m),
        // As printed: −(y_r + W/2).
        (slips.right, centres.right_m + half_track_m),
    ]
    .into_iter()
    .enumerate()
    {
        if lever_m.abs() <= 0.0 {
            return None;
        }
        let longitudinal_n = load_n * setting.curve.mu(slip);
        forces_n[2 * side] = longitudinal_n * (half_base_m - centres.forward_m) / lever_m;
        forces_n[2 * side + 1] = -longitudinal_n * (half_base_m + centres.forward_m) / lever_m;
    }
    Some(forces_n)
}
