//! The law `yi2007`: point D (22), its third derivative (23), the law (25), the adaptation (26).
//!
//! With `ε = z − z_d`, `s = ε̈ + k₁ε̇ + k₂ε`, `f = −z⃛_d + k₁ε̈ + k₂ε̇` and `r = −γ − f − ξs`:
//! `w = α⁻¹(θ̂r − β)`, `θ̂̇ = −ρ sᵀr`. On the reduced model `V = ½sᵀs + θ̃²/(2θρ)` decreases as
//! `V̇ = −ξ sᵀs`. θ̂ converges to θ only under excitation: on the paper's own circle it settles at
//! 0.9747 while θ = 0.2.
//!
//! `s` needs ε̈, so an acceleration, which is measured. With K̂ζ in its place the proof does not
//! hold. `det α = −η₁/S`: the law is singular at standstill and returns an error there.

use nalgebra::{Matrix2, SVector, Vector2};
use thiserror::Error;

use tread_control::geometry::{Point, Pose};

/// Forward speed below which α counts as singular, metres per second.
pub const SPEED_MIN_M_S: f64 = 1.0e-3;

/// Gains of the law and the position of its control point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Yi2007Config {
    /// S, distance of the control point D ahead of the centre, metres, above zero.
    pub centre_forward_m: f64,
    /// `k₁`, per second, above zero.
    pub k_1_1_s: f64,
    /// `k₂`, per second squared, above zero.
    pub k_2_1_s2: f64,
    /// ξ, per second, above zero.
    pub xi_1_s: f64,
    /// ρ, the adaptation gain, above zero.
    pub rho: f64,
}

impl Yi2007Config {
    /// Returns the gains of section IV.
    pub fn section_iv() -> Self {
        Self {
            centre_forward_m: 0.167,
            k_1_1_s: 2.0,
            k_2_1_s2: 1.0,
            xi_1_s: 0.1,
            rho: 1.0,
        }
    }
}

/// Error of constructing or evaluating the law.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum Yi2007Error {
    /// A gain is NaN, infinite, zero or negative.
    #[error("`{field}` must be finite and above zero, not {value}")]
    OutOfRange {
        /// Name of the field.
        field: &'static str,
        /// Rejected value.
        value: f64,
    },
    /// The forward speed, in metres per second, is too low to invert α of (23).
    #[error("the law is singular at {0} m/s")]
    Standstill(f64),
}

/// Desired motion of point D in the site frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DesiredPoint {
    /// `z_d`, metres.
    pub position: Vector2<f64>,
    /// First derivative of `z_d`, metres per second.
    pub velocity: Vector2<f64>,
    /// Second derivative of `z_d`, metres per second squared.
    pub acceleration: Vector2<f64>,
    /// Third derivative of `z_d`, metres per second cubed.
    pub jerk: Vector2<f64>,
}

impl DesiredPoint {
    /// Returns the circle of section IV, `(R sin(t/T), R cos(t/T))` with R 6 m and T 10 s, driven
    /// clockwise.
    pub fn section_iv(time_s: f64) -> Self {
        const RADIUS_M: f64 = 6.0;
        const RATE_RAD_S: f64 = 0.1;
        let (sin, cos) = (RATE_RAD_S * time_s).sin_cos();
        let scale = |order: i32| RADIUS_M * RATE_RAD_S.powi(order);
        Self {
            position: Vector2::new(sin, cos).scale(scale(0)),
            velocity: Vector2::new(cos, -sin).scale(scale(1)),
            acceleration: Vector2::new(-sin, -cos).scale(scale(2)),
            jerk: Vector2::new(-cos, sin).scale(scale(3)),
        }
    }
}

/// Input of the law at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LawInput {
    /// Pose of the centre in the site frame.
    pub pose: Pose,
    /// η₁ = ẋ, metres per second.
    pub forward_m_s: f64,
    /// η₂ = ẏ, metres per second; by the constraint `−Sφ̇`.
    pub left_m_s: f64,
    /// η̇₁, measured, metres per second squared.
    pub forward_m_s2: f64,
    /// ζ = τ₁, the state of the law's integrator.
    pub zeta: f64,
    /// θ̂, the adapted slip compliance.
    pub theta: f64,
}

/// Output of the law at one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LawOutput {
    /// `w₁ = ζ̇`, `w₂ = τ₂`.
    pub inputs: Vector2<f64>,
    /// θ̂̇ of (26), per second.
    pub theta_rate_1_s: f64,
    /// `ε = z − z_d`, metres.
    pub error: Vector2<f64>,
    /// `s = ε̈ + k₁ε̇ + k₂ε`, metres per second squared.
    pub surface: Vector2<f64>,
}

/// The law with checked gains.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Yi2007 {
    config: Yi2007Config,
}

impl Yi2007 {
    /// Creates a law with checked gains.
    ///
    /// # Errors
    /// [`Yi2007Error::OutOfRange`] names the gain.
    pub fn new(config: Yi2007Config) -> Result<Self, Yi2007Error> {
        for (field, value) in [
            ("centre_forward_m", config.centre_forward_m),
            ("k_1_1_s", config.k_1_1_s),
            ("k_2_1_s2", config.k_2_1_s2),
            ("xi_1_s", config.xi_1_s),
            ("rho", config.rho),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Yi2007Error::OutOfRange { field, value });
            }
        }
        Ok(Self { config })
    }

    /// Returns the gains.
    pub fn config(&self) -> &Yi2007Config {
        &self.config
    }

    /// Returns the control point D (22), site frame.
    pub fn point(&self, pose: Pose) -> Point {
        let (sin, cos) = pose.heading_rad.sin_cos();
        Point {
            x_m: pose.x_m + self.config.centre_forward_m * cos,
            y_m: pose.y_m + self.config.centre_forward_m * sin,
        }
    }

    /// Evaluates (25) and (26) at one time.
    ///
    /// # Errors
    /// [`Yi2007Error::Standstill`] below [`SPEED_MIN_M_S`].
    pub fn evaluate(
        &self,
        input: &LawInput,
        desired: &DesiredPoint,
    ) -> Result<LawOutput, Yi2007Error> {
        let config = &self.config;
        let eta_1 = input.forward_m_s;
        if eta_1.is_nan() || eta_1.abs() < SPEED_MIN_M_S {
            return Err(Yi2007Error::Standstill(eta_1));
        }
        let turn_rad_s = -input.left_m_s / config.centre_forward_m;
        let (sin, cos) = input.pose.heading_rad.sin_cos();
        let (longitudinal, lateral) = (Vector2::new(cos, sin), Vector2::new(-sin, cos));
        let point = self.point(input.pose);
        let error = Vector2::new(point.x_m, point.y_m) - desired.position;
        let error_rate = longitudinal.scale(eta_1) - desired.velocity;
        let error_rate_2 = longitudinal.scale(input.forward_m_s2)
            + lateral.scale(eta_1 * turn_rad_s)
            - desired.acceleration;
        let surface =
            error_rate_2 + error_rate.scale(config.k_1_1_s) + error.scale(config.k_2_1_s2);
        let gamma = longitudinal.scale(-eta_1 * turn_rad_s * turn_rad_s);
        let beta = lateral.scale(2.0 * input.zeta * turn_rad_s);
        let drift =
            -desired.jerk + error_rate_2.scale(config.k_1_1_s) + error_rate.scale(config.k_2_1_s2);
        let wanted = -gamma - drift - surface.scale(config.xi_1_s);
        let lever = eta_1 / config.centre_forward_m;
        let alpha = Matrix2::new(cos, lever * sin, sin, -lever * cos);
        let inverse = alpha.try_inverse().ok_or(Yi2007Error::Standstill(eta_1))?;
        Ok(LawOutput {
            inputs: inverse * (wanted.scale(input.theta) - beta),
            theta_rate_1_s: -config.rho * surface.dot(&wanted),
            error,
            surface,
        })
    }
}

/// State of the closed loop on the reduced model with `η̇ = Kτ`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClosedLoopState {
    /// Time, seconds.
    pub time_s: f64,
    /// Pose of the centre in the site frame.
    pub pose: Pose,
    /// η₁, metres per second.
    pub forward_m_s: f64,
    /// η₂, metres per second.
    pub left_m_s: f64,
    /// ζ, the state of the law's integrator.
    pub zeta: f64,
    /// θ̂, the adapted slip compliance.
    pub theta: f64,
}

impl ClosedLoopState {
    /// Returns the initial state of section IV; η₂ and ζ are not in the paper and start at zero.
    pub fn section_iv() -> Self {
        Self {
            time_s: 0.0,
            pose: Pose {
                x_m: 0.0,
                y_m: 3.0,
                heading_rad: 0.0,
            },
            forward_m_s: 0.3,
            left_m_s: 0.0,
            zeta: 0.0,
            theta: 1.0,
        }
    }
}

/// The paper's simulation: law, adaptation and reduced model, by fourth-order Runge-Kutta.
#[derive(Debug, Clone, Copy)]
pub struct ClosedLoop {
    law: Yi2007,
    /// K, the true friction stiffness of the ground.
    stiffness: f64,
    desired: fn(f64) -> DesiredPoint,
    state: ClosedLoopState,
}

/// X, Y, φ, η₁, η₂, ζ, θ̂.
type Packed = SVector<f64, 7>;

impl ClosedLoop {
    /// Creates a closed loop at a state.
    ///
    /// # Errors
    /// [`Yi2007Error::OutOfRange`] if K is not finite or not above zero.
    pub fn new(
        law: Yi2007,
        stiffness: f64,
        desired: fn(f64) -> DesiredPoint,
        state: ClosedLoopState,
    ) -> Result<Self, Yi2007Error> {
        if !(stiffness.is_finite() && stiffness > 0.0) {
            return Err(Yi2007Error::OutOfRange {
                field: "stiffness",
                value: stiffness,
            });
        }
        Ok(Self {
            law,
            stiffness,
            desired,
            state,
        })
    }

    /// Returns the present state.
    pub fn state(&self) -> &ClosedLoopState {
        &self.state
    }

    /// Returns errors and inputs at the present state.
    ///
    /// # Errors
    /// [`Yi2007Error::Standstill`] where the law is singular.
    pub fn output(&self) -> Result<LawOutput, Yi2007Error> {
        self.evaluate(&pack(&self.state), self.state.time_s)
    }

    /// Returns `V = ½sᵀs + θ̃²/(2θρ)` at the present state.
    ///
    /// # Errors
    /// [`Yi2007Error::Standstill`] where the law is singular.
    pub fn lyapunov(&self) -> Result<f64, Yi2007Error> {
        let output = self.output()?;
        let theta = self.stiffness.recip();
        let gap = theta - self.state.theta;
        let weight = 2.0 * theta * self.law.config.rho;
        Ok(0.5 * output.surface.norm_squared() + gap * gap / weight)
    }

    /// Advances the state by `dt_s` seconds.
    ///
    /// # Errors
    /// [`Yi2007Error::Standstill`] where the law is singular.
    pub fn step(&mut self, dt_s: f64) -> Result<(), Yi2007Error> {
        let time_s = self.state.time_s;
        let start = pack(&self.state);
        let middle_s = time_s + 0.5 * dt_s;
        let rates_1 = self.rates(&start, time_s)?;
        let rates_2 = self.rates(&(start + rates_1.scale(0.5 * dt_s)), middle_s)?;
        let rates_3 = self.rates(&(start + rates_2.scale(0.5 * dt_s)), middle_s)?;
        let rates_4 = self.rates(&(start + rates_3.scale(dt_s)), time_s + dt_s)?;
        let sum = rates_1 + (rates_2 + rates_3).scale(2.0) + rates_4;
        self.state = unpack(&(start + sum.scale(dt_s / 6.0)), time_s + dt_s);
        Ok(())
    }

    fn evaluate(&self, packed: &Packed, time_s: f64) -> Result<LawOutput, Yi2007Error> {
        let state = unpack(packed, time_s);
        let input = LawInput {
            pose: state.pose,
            forward_m_s: state.forward_m_s,
            left_m_s: state.left_m_s,
            forward_m_s2: self.stiffness * state.zeta,
            zeta: state.zeta,
            theta: state.theta,
        };
        self.law.evaluate(&input, &(self.desired)(time_s))
    }

    fn rates(&self, packed: &Packed, time_s: f64) -> Result<Packed, Yi2007Error> {
        let output = self.evaluate(packed, time_s)?;
        let state = unpack(packed, time_s);
        let (sin, cos) = state.pose.heading_rad.sin_cos();
        Ok(Packed::from([
            state.forward_m_s * cos - state.left_m_s * sin,
            state.forward_m_s * sin + state.left_m_s * cos,
            -state.left_m_s / self.law.config.centre_forward_m,
            self.stiffness * state.zeta,
            self.stiffness * output.inputs[1],
            output.inputs[0],
            output.theta_rate_1_s,
        ]))
    }
}

fn pack(state: &ClosedLoopState) -> Packed {
    Packed::from([
        state.pose.x_m,
        state.pose.y_m,
        state.pose.heading_rad,
        state.forward_m_s,
        state.left_m_s,
        state.zeta,
        state.theta,
    ])
}

fn unpack(packed: &Packed, time_s: f64) -> ClosedLoopState {
    ClosedLoopState {
        time_s,
        pose: Pose {
            x_m: packed[0],
            y_m: packed[1],
            heading_rad: packed[2],
        },
        forward_m_s: packed[3],
        left_m_s: packed[4],
        zeta: packed[5],
        theta: packed[6],
    }
}
