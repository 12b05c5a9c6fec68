//! Simulated base: a free four-wheel skid-steered body.
//!
//! Every contact i obeys one vector law, `F = −N μ(|σ|) σ/|σ|`: isotropic combined slip, with μ of
//! (7) and σ the slip velocity over the reference speed `u`. The body has Coriolis terms,
//! `m(ẍ − ẏφ̇) = ΣF`, `m(ÿ + ẋφ̇) = ΣP`, `I_G φ̈ = Σ(x_i P_i − y_i F_i)`; no constraint is imposed
//! (the paper's constraint (4) is enforced by no force).
//!
//! The reference speed is `u = (|rω|⁴ + u₀⁴)^¼` with `u₀` = 0.05 m/s, so that the law is regular at
//! standstill and equals the paper's |rω| within 1.2·10⁻⁵ at 0.6 m/s. Slip poles, `gK/u` and its
//! yaw counterpart, reach thousands per second at standstill: steps are split so that pole times
//! step stays within the fourth-order Runge-Kutta method's stable and accurate range.

mod means;
mod tyres;

use thiserror::Error;

use crate::friction::FrictionCurve;
use crate::geometry::{Pose, Twist};
use crate::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use crate::robot::{GRAVITY_M_S2, RobotModel};

use means::MeanSums;
pub use tyres::{TyreRise, Tyres};

/// Reference speed u₀ below which slip is regularised, metres per second.
pub const SLIP_SPEED_FLOOR_M_S: f64 = 0.05;
/// Maximum product of slip pole and step; the method is stable up to 2.78.
const POLE_STEP_MAX: f64 = 2.4;
/// Maximum internal step, seconds.
const STEP_MAX_S: f64 = 5.0e-3;
/// Maximum internal step below [`SLOW_M_S`], where slip's reference speed changes quickly, seconds.
const STEP_SLOW_MAX_S: f64 = 2.5e-3;
/// Rim speed below which [`STEP_SLOW_MAX_S`] applies, metres per second.
const SLOW_M_S: f64 = 0.2;
/// Maximum number of internal steps in one call (needs `gK/u₀` above 10⁵); the rest is left out.
const STEPS_MAX: usize = 10_000;
/// Minimum servo lag in the integration, seconds; a shorter one acts as this one.
const SERVO_LAG_FLOOR_S: f64 = 1.0e-3;

/// Parameters of the simulated base beyond the robot model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlantSpec {
    /// First-order lag of the wheel servo, seconds, 0 to 5.
    pub servo_lag_s: f64,
    /// Rolling resistance coefficient, 0 to 1. It acts on the wheels and shows in their torque
    /// only.
    pub rolling_resistance_ratio: f64,
    /// True rolling radius of the left wheels over the model's, 0.5 to 2.
    pub left_radius_ratio: f64,
    /// True rolling radius of the right wheels over the model's, 0.5 to 2.
    pub right_radius_ratio: f64,
    /// Deviation of the tyres from the isotropic friction curve (7).
    pub tyres: Tyres,
}

impl Default for PlantSpec {
    fn default() -> Self {
        Self {
            servo_lag_s: 0.05,
            rolling_resistance_ratio: 0.01,
            left_radius_ratio: 1.0,
            right_radius_ratio: 1.0,
            tyres: Tyres::default(),
        }
    }
}

/// Parameter of a plant that is out of its range.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum PlantError {
    /// A value is NaN, infinite or out of its range.
    #[error("`{field}` is out of its range: {value}")]
    OutOfRange {
        /// Name of the field.
        field: &'static str,
        /// Rejected value.
        value: f64,
    },
}

/// Friction curves of the ground under the two sides of a robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ground {
    /// Curve under the left wheels.
    pub left: FrictionCurve,
    /// Curve under the right wheels.
    pub right: FrictionCurve,
}

impl Ground {
    /// Returns ground with the same curve under both sides.
    pub fn uniform(curve: FrictionCurve) -> Self {
        Self {
            left: curve,
            right: curve,
        }
    }
}

/// True state of the simulated base.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlantState {
    /// Pose in the site frame.
    pub pose: Pose,
    /// Forward speed ẋ in the body frame, metres per second.
    pub forward_m_s: f64,
    /// Lateral speed ẏ in the body frame, metres per second, positive to the left.
    pub left_m_s: f64,
    /// Turn rate φ̇, radians per second, counter-clockwise positive.
    pub yaw_rate_rad_s: f64,
    /// Wheel speeds.
    pub wheel_speeds: WheelSpeeds,
}

impl PlantState {
    /// Returns forward speed and turn rate.
    pub fn twist(&self) -> Twist {
        Twist {
            linear_m_s: self.forward_m_s,
            angular_rad_s: self.yaw_rate_rad_s,
        }
    }
}

/// Simulated base with its state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plant {
    model: RobotModel,
    spec: PlantSpec,
    state: PlantState,
    contact: Contact,
    means: PlantMeans,
    /// Means of the forward forces over the last step, `[left, right]`, newtons.
    side_longitudinal_n: [f64; 2],
}

/// Means over the time of one call of [`Plant::step`], as counting encoders and inertial sensors
/// with anti-aliasing measure them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PlantMeans {
    /// Wheel speeds.
    pub wheel_speeds: WheelSpeeds,
    /// Turn rate φ̇, radians per second.
    pub yaw_rate_rad_s: f64,
    /// Specific force at the centre of mass in the body frame, as an accelerometer measures it.
    pub acceleration: BodyAcceleration,
}

/// Sums of all contact forces on the body, and the largest combined slip.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Contact {
    longitudinal_n: f64,
    left_n: f64,
    moment_n_m: f64,
    left_side_longitudinal_n: f64,
    right_side_longitudinal_n: f64,
    slip_max: f64,
}

/// State in the order of `pack`, or its time derivative.
type Rates = [f64; 8];

impl Plant {
    /// Creates a stopped base at a pose in the site frame.
    ///
    /// # Errors
    /// [`PlantError`] if a value of `spec` is out of its range or the pose is not finite.
    pub fn new(model: RobotModel, spec: PlantSpec, pose: Pose) -> Result<Self, PlantError> {
        let check = |field, value: f64, range: std::ops::RangeInclusive<f64>| {
            if range.contains(&value) {
                Ok(())
            } else {
                Err(PlantError::OutOfRange { field, value })
            }
        };
        check("servo_lag_s", spec.servo_lag_s, 0.0..=5.0)?;
        check(
            "rolling_resistance_ratio",
            spec.rolling_resistance_ratio,
            0.0..=1.0,
        )?;
        check("left_radius_ratio", spec.left_radius_ratio, 0.5..=2.0)?;
        check("right_radius_ratio", spec.right_radius_ratio, 0.5..=2.0)?;
        check(
            "lateral_stiffness_ratio",
            spec.tyres.lateral_stiffness_ratio,
            0.1..=10.0,
        )?;
        let figures = [pose.x_m, pose.y_m, pose.heading_rad];
        if let Some(value) = figures.into_iter().find(|figure| !figure.is_finite()) {
            let field = "pose";
            return Err(PlantError::OutOfRange { field, value });
        }
        let state = PlantState {
            pose,
            ..PlantState::default()
        };
        Ok(Self {
            model,
            spec,
            state,
            contact: Contact::default(),
            means: PlantMeans::default(),
            side_longitudinal_n: [0.0; 2],
        })
    }

    /// Returns the true state.
    pub fn state(&self) -> &PlantState {
        &self.state
    }

    /// Sets the state, for instance a pose after a push.
    #[cfg(any(test, feature = "testing"))]
    pub fn set_state(&mut self, state: PlantState) {
        self.state = state;
    }

    /// Returns means over the last step; zero before the first.
    pub fn means(&self) -> &PlantMeans {
        &self.means
    }

    /// Returns the specific force at the centre of mass after the last step, without noise.
    #[cfg(any(test, feature = "testing"))]
    pub fn body_acceleration(&self) -> BodyAcceleration {
        BodyAcceleration {
            forward_m_s2: self.contact.longitudinal_n / self.model.mass_kg(),
            left_m_s2: self.contact.left_n / self.model.mass_kg(),
        }
    }

    /// Returns the drive torques per side, mean over the last step: (ground force plus rolling
    /// resistance) times rolling radius. An instantaneous torque beside [`Plant::means`] would make
    /// slip lag force and θ too low wherever the command changes.
    pub fn wheel_torques(&self) -> WheelTorques {
        let radius_m = self.model.wheel_radius_m();
        let side = |force_n: f64, wheel_rad_s: f64, radius_ratio: f64| {
            let rolling = (wheel_rad_s * radius_m / SLIP_SPEED_FLOOR_M_S).tanh();
            let resistance_n =
                self.spec.rolling_resistance_ratio * self.model.side_load_n() * rolling;
            (force_n + resistance_n) * radius_m * radius_ratio
        };
        let wheels = self.means.wheel_speeds;
        let [left_n, right_n] = self.side_longitudinal_n;
        WheelTorques {
            left_n_m: side(left_n, wheels.left_rad_s, self.spec.left_radius_ratio),
            right_n_m: side(right_n, wheels.right_rad_s, self.spec.right_radius_ratio),
        }
    }

    /// Returns the largest combined slip of the four wheels after the last step.
    pub fn slip_max(&self) -> f64 {
        self.contact.slip_max
    }

    /// Advances the base by `dt_s` seconds, if valid, under a constant wheel command.
    ///
    /// A non-finite command acts as zero; one above the wheel speed limit acts as the limit.
    pub fn step(&mut self, command: WheelSpeeds, ground: &Ground, dt_s: f64) {
        if !(dt_s.is_finite() && dt_s > 0.0) {
            return;
        }
        let limit_rad_s = self.model.limits().wheel_speed_max_rad_s;
        let bounded = |speed_rad_s: f64| {
            if speed_rad_s.is_finite() {
                speed_rad_s.clamp(-limit_rad_s, limit_rad_s)
            } else {
                0.0
            }
        };
        let command = WheelSpeeds {
            left_rad_s: bounded(command.left_rad_s),
            right_rad_s: bounded(command.right_rad_s),
        };
        let mut sums = MeanSums::new(self.state);
        let mut left_s = dt_s;
        let mut contact = self.contact_forces(&self.state, ground);
        let (mut left_n_s, mut right_n_s) = (0.0, 0.0);
        for _ in 0..STEPS_MAX {
            // Equal parts, so that no short step is left over.
            let parts = (left_s / self.stable_step_s(ground)).ceil().max(1.0);
            let step_s = left_s / parts;
            self.runge_kutta(command, ground, step_s);
            sums.add(&self.state, step_s);
            let after = self.contact_forces(&self.state, ground);
            left_n_s +=
                0.5 * step_s * (contact.left_side_longitudinal_n + after.left_side_longitudinal_n);
            right_n_s += 0.5
                * step_s
                * (contact.right_side_longitudinal_n + after.right_side_longitudinal_n);
            contact = after;
            left_s -= step_s;
            if left_s <= 1.0e-12 {
                break;
            }
        }
        let span_s = dt_s - left_s;
        self.means = sums.means(span_s);
        self.side_longitudinal_n = [left_n_s / span_s, right_n_s / span_s];
        self.contact = contact;
    }

    /// Returns the longest step that is stable for slip poles and servo, at most [`STEP_MAX_S`].
    fn stable_step_s(&self, ground: &Ground) -> f64 {
        let model = &self.model;
        let wheels = self.state.wheel_speeds;
        let slowest_m_s =
            wheels.left_rad_s.abs().min(wheels.right_rad_s.abs()) * model.wheel_radius_m();
        let stiffness = ground.left.stiffness().max(ground.right.stiffness());
        let reference_m_s = slip_reference_m_s(slowest_m_s);
        let shape = model.mass_kg() * (model.track_width_m().powi(2) + model.wheelbase_m().powi(2))
            / (4.0 * model.yaw_inertia_kg_m2());
        let lateral_ratio = self.spec.tyres.lateral_stiffness_ratio.max(1.0);
        let pole_s1 = GRAVITY_M_S2 * stiffness * lateral_ratio / reference_m_s * shape.max(1.0);
        let servo_s = 0.5 * self.spec.servo_lag_s.max(SERVO_LAG_FLOOR_S);
        let step_max_s = if slowest_m_s < SLOW_M_S {
            STEP_SLOW_MAX_S
        } else {
            STEP_MAX_S
        };
        (POLE_STEP_MAX / pole_s1).min(servo_s).min(step_max_s)
    }

    fn runge_kutta(&mut self, command: WheelSpeeds, ground: &Ground, step_s: f64) {
        let start = self.state;
        let rates_1 = self.rates(&start, command, ground);
        let rates_2 = self.rates(&advance(&start, &rates_1, 0.5 * step_s), command, ground);
        let rates_3 = self.rates(&advance(&start, &rates_2, 0.5 * step_s), command, ground);
        let rates_4 = self.rates(&advance(&start, &rates_3, step_s), command, ground);
        let mut end = pack(&start);
        for index in 0..end.len() {
            end[index] += step_s / 6.0
                * (rates_1[index] + 2.0 * (rates_2[index] + rates_3[index]) + rates_4[index]);
        }
        self.state = unpack(&end);
    }

    fn rates(&self, state: &PlantState, command: WheelSpeeds, ground: &Ground) -> Rates {
        let contact = self.contact_forces(state, ground);
        let (sin, cos) = state.pose.heading_rad.sin_cos();
        let (forward_m_s, left_m_s, yaw) =
            (state.forward_m_s, state.left_m_s, state.yaw_rate_rad_s);
        let acceleration_max = self.model.limits().wheel_acceleration_max_rad_s2;
        let lag_s = self.spec.servo_lag_s.max(SERVO_LAG_FLOOR_S);
        let servo = |target: f64, speed: f64| {
            ((target - speed) / lag_s).clamp(-acceleration_max, acceleration_max)
        };
        [
            forward_m_s * cos - left_m_s * sin,
            forward_m_s * sin + left_m_s * cos,
            yaw,
            contact.longitudinal_n / self.model.mass_kg() + left_m_s * yaw,
            contact.left_n / self.model.mass_kg() - forward_m_s * yaw,
            contact.moment_n_m / self.model.yaw_inertia_kg_m2(),
            servo(command.left_rad_s, state.wheel_speeds.left_rad_s),
            servo(command.right_rad_s, state.wheel_speeds.right_rad_s),
        ]
    }

    fn contact_forces(&self, state: &PlantState, ground: &Ground) -> Contact {
        let half_track_m = 0.5 * self.model.track_width_m();
        let half_base_m = 0.5 * self.model.wheelbase_m();
        let load_n = 0.5 * self.model.side_load_n();
        let radius_m = self.model.wheel_radius_m();
        let tyres = &self.spec.tyres;
        let sides = [
            (
                half_track_m,
                state.wheel_speeds.left_rad_s * radius_m * self.spec.left_radius_ratio,
                &ground.left,
            ),
            (
                -half_track_m,
                state.wheel_speeds.right_rad_s * radius_m * self.spec.right_radius_ratio,
                &ground.right,
            ),
        ];
        let mut sum = Contact::default();
        let mut side_n = [0.0; 2];
        for (side, (y_m, rim_m_s, curve)) in sides.into_iter().enumerate() {
            let per_speed_s_m = slip_reference_m_s(rim_m_s).recip();
            let longitudinal_slip =
                (state.forward_m_s - state.yaw_rate_rad_s * y_m - rim_m_s) * per_speed_s_m;
            for x_m in [half_base_m, -half_base_m] {
                // Lateral slip that would give the same lateral force on an isotropic tyre.
                let slip_left = tyres.lateral_stiffness_ratio
                    * (state.left_m_s + state.yaw_rate_rad_s * x_m)
                    * per_speed_s_m;
                let slip = (longitudinal_slip * longitudinal_slip + slip_left * slip_left).sqrt();
                let gain_n = -load_n * tyres.rise.mu_over_slip(curve, slip);
                let (longitudinal_force_n, force_left_n) =
                    (gain_n * longitudinal_slip, gain_n * slip_left);
                side_n[side] += longitudinal_force_n;
                sum.left_n += force_left_n;
                sum.moment_n_m += x_m * force_left_n - y_m * longitudinal_force_n;
                sum.slip_max = sum.slip_max.max(slip);
            }
        }
        sum.left_side_longitudinal_n = side_n[0];
        sum.right_side_longitudinal_n = side_n[1];
        sum.longitudinal_n = side_n[0] + side_n[1];
        sum
    }
}

/// Returns the reference speed of slip for a rim speed, `(|rω|⁴ + u₀⁴)^¼`, metres per second.
pub fn slip_reference_m_s(rim_m_s: f64) -> f64 {
    (rim_m_s.powi(4) + SLIP_SPEED_FLOOR_M_S.powi(4))
        .sqrt()
        .sqrt()
}

fn pack(state: &PlantState) -> Rates {
    [
        state.pose.x_m,
        state.pose.y_m,
        state.pose.heading_rad,
        state.forward_m_s,
        state.left_m_s,
        state.yaw_rate_rad_s,
        state.wheel_speeds.left_rad_s,
        state.wheel_speeds.right_rad_s,
    ]
}

fn unpack(packed: &Rates) -> PlantState {
    let &[
        x_m,
        y_m,
        heading_rad,
        forward_m_s,
        left_m_s,
        yaw_rate_rad_s,
        left_rad_s,
        right_rad_s,
    ] = packed;
    PlantState {
        pose: Pose {
            x_m,
            y_m,
            heading_rad,
        },
        forward_m_s,
        left_m_s,
        yaw_rate_rad_s,
        wheel_speeds: WheelSpeeds {
            left_rad_s,
            right_rad_s,
        },
    }
}

fn advance(start: &PlantState, rates: &Rates, step_s: f64) -> PlantState {
    let mut end = pack(start);
    for (value, rate) in end.iter_mut().zip(rates) {
        *value += step_s * rate;
    }
    unpack(&end)
}
