//! Reduced model: constraint (18), dynamics (19) and (20), input transformation (21).
//!
//! `ẏ + Sφ̇ = 0` leaves the pseudo-velocities η = (ẋ, ẏ), and `φ̇ = −η₂/S`. As printed, without the
//! Coriolis terms of (14): `η̇ = M_η Gᵀ(forces)`, which (21) transforms to `η̇ = Kτ`.

use nalgebra::{Matrix2, Vector2};
use thiserror::Error;

use crate::paper::closed_form::{SlipShape, e_1, e_2};
use crate::paper::wheels::{BodyForce, four_wheel_sum};
use tread_control::measured::WheelSpeeds;
use tread_control::slip::BodyVelocity;

use crate::paper::Setting;
use tread_control::robot::GRAVITY_M_S2;

/// Magnitude of the determinant below which (21) counts as singular: standstill without turning.
const DETERMINANT_MIN: f64 = 1.0e-9;

/// Error of constructing or evaluating the reduced model.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum ReducedError {
    /// S is zero or not finite.
    #[error("`centre_forward_m` must be finite and not zero, not {0}")]
    Centre(f64),
    /// `E₁ + g₁ᵀe₂` cannot be inverted at this velocity.
    #[error("the transformation (21) is singular at this velocity")]
    Singular,
    /// The inputs need a wheel that stands still, turns backwards, or turns infinitely fast.
    #[error("no forward wheel speed gives these inputs")]
    NoWheelSpeed,
}

/// Robot with the constraint (18).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reduced {
    setting: Setting,
    centre_forward_m: f64,
}

impl Reduced {
    /// Creates a robot whose turning centre is held S ahead of its centre of mass, metres.
    ///
    /// # Errors
    /// [`ReducedError::Centre`] if S is zero or not finite.
    pub fn new(setting: Setting, centre_forward_m: f64) -> Result<Self, ReducedError> {
        if !centre_forward_m.is_finite() || centre_forward_m.abs() <= 0.0 {
            return Err(ReducedError::Centre(centre_forward_m));
        }
        Ok(Self {
            setting,
            centre_forward_m,
        })
    }

    /// Returns S, metres.
    pub fn centre_forward_m(&self) -> f64 {
        self.centre_forward_m
    }

    /// Returns all three speeds from η, (19a) in the body frame.
    pub fn velocity(&self, eta: Vector2<f64>) -> BodyVelocity {
        BodyVelocity {
            forward_m_s: eta[0],
            left_m_s: eta[1],
            yaw_rate_rad_s: -eta[1] / self.centre_forward_m,
        }
    }

    /// Returns the diagonal of `M_η⁻¹`: m and `m + I_G/S²`, kilograms.
    fn masses_kg(&self) -> Vector2<f64> {
        let model = &self.setting.model;
        let turned_kg = model.yaw_inertia_kg_m2() / self.centre_forward_m.powi(2);
        Vector2::new(model.mass_kg(), model.mass_kg() + turned_kg)
    }

    /// Returns η̇ under forces on the body, (19b) as printed, metres per second squared.
    pub fn rates(&self, force: &BodyForce) -> Vector2<f64> {
        let masses_kg = self.masses_kg();
        Vector2::new(
            force.longitudinal_n / masses_kg[0],
            (force.left_n - force.moment_n_m / self.centre_forward_m) / masses_kg[1],
        )
    }

    /// Returns η̇ under forward wheel speeds, in both ranges of slip, by the four-wheel sum.
    pub fn rates_from_wheels(&self, eta: Vector2<f64>, wheels: WheelSpeeds) -> Vector2<f64> {
        self.rates(&four_wheel_sum(&self.velocity(eta), wheels, &self.setting))
    }

    /// Returns `E₁ + g₁ᵀe₂` of (20).
    fn input_matrix(&self, velocity: &BodyVelocity, shape: &SlipShape) -> Matrix2<f64> {
        let mut matrix = e_1(velocity, shape, &self.setting);
        let yaw = e_2(velocity, shape, &self.setting) / self.centre_forward_m;
        matrix[(1, 0)] -= yaw[0];
        matrix[(1, 1)] -= yaw[1];
        matrix
    }

    /// Returns the vector `[2σ_Σ, Wσ_Δ/S]` of (20) and (21); (21) prints it as a fraction.
    fn offset(&self, shape: &SlipShape) -> Vector2<f64> {
        let track_m = self.setting.model.track_width_m();
        Vector2::new(
            2.0 * shape.sum,
            track_m * shape.difference / self.centre_forward_m,
        )
    }

    /// Returns η̇ from the inputs v by (20), metres per second squared. The velocity is that of η
    /// ([`Self::velocity`]).
    pub fn rates_from_inputs(
        &self,
        velocity: &BodyVelocity,
        inputs: Vector2<f64>,
        shape: &SlipShape,
    ) -> Vector2<f64> {
        let model = &self.setting.model;
        let scale_n = 0.25 * model.mass_kg() * GRAVITY_M_S2 * self.setting.curve.stiffness();
        let masses_kg = self.masses_kg();
        (self.input_matrix(velocity, shape) * inputs + self.offset(shape))
            .component_div(&masses_kg)
            .scale(scale_n)
    }

    /// Returns the inputs v that make `η̇ = Kτ`, (21). The velocity is that of η
    /// ([`Self::velocity`]).
    ///
    /// # Errors
    /// [`ReducedError::Singular`] near standstill.
    pub fn inputs(
        &self,
        tau: Vector2<f64>,
        velocity: &BodyVelocity,
        shape: &SlipShape,
    ) -> Result<Vector2<f64>, ReducedError> {
        let matrix = self.input_matrix(velocity, shape);
        if matrix.determinant().abs() < DETERMINANT_MIN {
            return Err(ReducedError::Singular);
        }
        let inverse = matrix.try_inverse().ok_or(ReducedError::Singular)?;
        let weight_n = self.setting.model.mass_kg() * GRAVITY_M_S2;
        let wanted = self.masses_kg().component_mul(&tau).scale(4.0 / weight_n);
        Ok(inverse * (wanted - self.offset(shape)))
    }

    /// Returns the wheel speeds of inputs v.
    ///
    /// # Errors
    /// [`ReducedError::NoWheelSpeed`] where a wheel would have to stand still or turn backwards.
    pub fn wheel_speeds(
        &self,
        inputs: Vector2<f64>,
        shape: &SlipShape,
    ) -> Result<WheelSpeeds, ReducedError> {
        let radius_m = self.setting.model.wheel_radius_m();
        let left_s_m = 0.5 * (inputs[1] + inputs[0]) / shape.left.two;
        let right_s_m = 0.5 * (inputs[1] - inputs[0]) / shape.right.two;
        let wheels = WheelSpeeds {
            left_rad_s: (radius_m * left_s_m).recip(),
            right_rad_s: (radius_m * right_s_m).recip(),
        };
        if wheels.is_finite() && wheels.left_rad_s.min(wheels.right_rad_s) > 0.0 {
            Ok(wheels)
        } else {
            Err(ReducedError::NoWheelSpeed)
        }
    }
}
