//! Equations of motion of a skid-steered robot on deflecting contacts, driven by its measured wheel
//! speeds.
//!
//! State at the centre of mass, body frame: forward and left speed, turn rate; per contact a
//! deflection s as a slip vector with `ℓ ṡ = (1 + q x) (v_slip − V s)` (relaxation length ℓ at zero
//! slip: Pacejka, Tire and Vehicle Dynamics, ch. 7). With q = 0 the relaxation length is constant,
//! with q = 1 it decreases like that of a lumped `LuGre` contact; a contact that deflects
//! like a spring is between them. `V = |u| + p (|v| − |u|)` lies between the rim speed u and the forward
//! speed v of the wheel's centre: with p = 0 the steady s is the theoretical slip of brush models
//! and of Yi et al. (2007), with p = 1 the practical slip over which the Magic Formula is fitted
//! (Pacejka, ch. 3 and 4). A contact with the load N has the force `N K s / D`,
//! with `D = (1 + n a x + xⁿ)^(1/n)` and `x = K|s|/μ_p`: its slope is K = 1/θ at zero slip, and its
//! friction coefficient approaches `μ_p` at large slip. a = 0 with a large n is the straight rise
//! of Yi et al. (2007), eq. (7), up to the peak; a = 1/3 with n = 3 is within 4 % of a brush model;
//! a = 0 with n = 2.7 of a Magic Formula; a = 2/3 with n = 2 of a `LuGre` tyre. The lateral
//! part of s is multiplied by the ratio of the tyre's lateral to its longitudinal stiffness, so that a
//! contact is softer to the side up to the same peak (similarity of combined slip: Pacejka, ch. 4). N
//! follows from the position of the centre of mass, the slope, and measured accelerations.
//!
//! Two resistances are proportional to N. Rolling resistance is a torque that is lost in the tyre:
//! it has to be driven, and does not act on the body. Motion resistance is a force of the ground against the
//! motion, as of soft ground that is compacted (Wong, Theory of Ground Vehicles, ch. 2): the
//! contacts have to slip for it even where the robot drives straight at a constant speed.

use super::dual::Real;
use super::physical::Robot;
use crate::geometry::Twist;
use crate::robot::GRAVITY_M_S2;

/// Number of channels: turn rate, acceleration (forward, left), torque (left, right), body speed.
pub(super) const CHANNELS: usize = 6;
/// Longest integration step, seconds: half of it changes no coverage by more than its noise.
const STEP_MAX_S: f64 = 5.1e-3;
/// Most integration steps of one sample.
const STEPS_MAX: u32 = 40;
/// Rim speed below which contacts are damped, and their deflection limited, metres per second.
const SLOW_M_S: f64 = 0.1;
/// Damping ratio of a contact at standstill.
const DAMPING_RATIO: f64 = 0.2;
/// Maximum deflection of a slow contact, relative to `μ_p/K`.
const STANDING_DEFLECTION_MAX: f64 = 5.0;
/// Rim speed over which resistances and gear loss smoothly change their sign (`tanh`),
/// metres per second.
const RESISTANCE_SIGN_WIDTH_M_S: f64 = 0.01;
/// Minimum of the speed that slip is relative to, over the rim speed: practical slip has no bound
/// where wheels turn and the robot stands.
const REFERENCE_MIN_RATIO: f64 = 0.05;
/// Added to the square of slip, so that the root has a finite slope at zero.
const SLIP_SQUARE_MIN: f64 = 1.0e-10;
// Arrays of numbers are written out below: `map` copies them, and a copy of numbers with their
// derivatives takes as long as arithmetic with them.

/// Positions of the contacts relative to the wheels' centre, forward and left, as fractions of
/// wheelbase and track width; the first two are on the left.
const CONTACTS: [(f64, f64); 4] = [(0.5, 0.5), (-0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)];

/// State of the model: motion of the centre of mass, and deflections of the contacts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct State<T> {
    /// Velocity of the centre of mass in the body frame, forward and left, metres per second.
    pub(super) speed_m_s: [T; 2],
    pub(super) turn_rad_s: T,
    /// Deflection of each contact, forward and left, as slip.
    pub(super) deflections: [[T; 2]; 4],
}

impl<T: Real> State<T> {
    /// Creates the state of a robot that rolls without slip.
    pub(super) fn rolling(twist: Twist) -> Self {
        let zero = T::constant(0.0);
        Self {
            speed_m_s: [T::constant(twist.linear_m_s), zero],
            turn_rad_s: T::constant(twist.angular_rad_s),
            deflections: [[zero; 2]; 4],
        }
    }
}

impl State<f64> {
    /// Returns the same motion without deflections, as constants of another type.
    pub(super) fn constants<T: Real>(&self) -> State<T> {
        let [linear_m_s, left_m_s] = self.speed_m_s;
        let mut own = State::rolling(Twist {
            linear_m_s,
            angular_rad_s: self.turn_rad_s,
        });
        own.speed_m_s[1] = T::constant(left_m_s);
        own
    }
}

/// Measured quantities that the model takes as they are, over the time of one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Input {
    /// Mean wheel speeds, left and right, radians per second.
    pub(super) wheels_rad_s: [f64; 2],
    /// Wheel acceleration, left and right, radians per second squared.
    pub(super) wheels_rad_s2: [f64; 2],
    /// Heading relative to the start of identification, radians.
    pub(super) heading_rad: f64,
    /// Low-pass filtered measured acceleration, forward and left, metres per second squared; only
    /// for the contacts' loads.
    pub(super) acceleration_m_s2: [f64; 2],
    /// Whether measured accelerations are the specific force; otherwise they are without gravity.
    pub(super) is_specific_force: bool,
    /// Time of the sample, seconds, above 0.
    pub(super) time_s: f64,
}

/// Means over the time of one sample, as sensors would measure them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Output<T> {
    pub(super) turn_rad_s: T,
    /// Measured acceleration: the specific force along the ground or the acceleration without
    /// gravity, see [`Input`], forward and left, metres per second squared.
    pub(super) acceleration_m_s2: [T; 2],
    /// Torques of the motors at the wheels, left and right, newton metres.
    pub(super) torques_n_m: [T; 2],
    /// Forward speed of the wheels' centre at the sample's end, metres per second.
    pub(super) forward_m_s: T,
}

impl<T: Real> Output<T> {
    /// Returns an output of zeros, to which others are added.
    pub(super) fn zero() -> Self {
        let zero = T::constant(0.0);
        Self {
            turn_rad_s: zero,
            acceleration_m_s2: [zero; 2],
            torques_n_m: [zero; 2],
            forward_m_s: zero,
        }
    }
}

/// A contact, as it is over one sample.
#[derive(Debug, Clone, Copy)]
struct Contact<T> {
    side: usize,
    /// Position relative to the centre of mass, forward and left, metres.
    place_m: [T; 2],
    load_n: T,
}

/// Sums over the contacts.
struct Forces<T> {
    force_n: [T; 2],
    moment_n_m: T,
    /// Longitudinal forces of the left and the right side, newtons.
    sides_n: [T; 2],
}

/// Returns the magnitude of a deflection as slip, above 0.
fn magnitude<T: Real>([forward, left]: [T; 2]) -> T {
    (forward * forward + left * left + SLIP_SQUARE_MIN).sqrt()
}

/// Returns 1 for a wheel that rolls forward, -1 for one that rolls backward, and a value between near
/// standstill.
fn direction<T: Real>(rim_m_s: T) -> f64 {
    (rim_m_s.value() / RESISTANCE_SIGN_WIDTH_M_S).tanh()
}

/// Returns the acceleration by gravity along sloped ground in the body frame, forward and left,
/// metres per second squared. The slope is the rise per distance along the x and y axes of a frame
/// on the ground, in which the body has the heading `heading_rad`, counter-clockwise from x.
pub(super) fn gravity_m_s2<T: Real>([x, y]: [T; 2], heading_rad: f64) -> [T; 2] {
    let (sin, cos) = heading_rad.sin_cos();
    [
        (x * cos + y * sin) * -GRAVITY_M_S2,
        (y * cos - x * sin) * -GRAVITY_M_S2,
    ]
}

impl<T: Real> Robot<T> {
    /// Returns the contacts with their loads, those of a rigid body on four equal springs.
    fn contacts(&self, gravity: [T; 2], input: &Input) -> [Contact<T>; 4] {
        let [forward_m, left_m, height_m] = self.centre_m;
        let (base_m, track_m) = (self.wheelbase_m, self.track_m);
        let specific_force = |axis: usize| {
            let removed = if input.is_specific_force {
                T::constant(0.0)
            } else {
                -gravity[axis]
            };
            removed + input.acceleration_m_s2[axis]
        };
        let tilt = |offset_m: T, axis: usize, size_m: f64| {
            (offset_m * GRAVITY_M_S2 - height_m * specific_force(axis)) * (size_m * size_m).recip()
        };
        let (pitch, roll) = (tilt(forward_m, 0, base_m), tilt(left_m, 1, track_m));
        let contact = |(front, left): (f64, f64)| Contact {
            side: usize::from(left < 0.0),
            place_m: [-forward_m + front * base_m, -left_m + left * track_m],
            load_n: (pitch * (front * base_m) + roll * (left * track_m) + 0.25 * GRAVITY_M_S2)
                * self.mass_kg,
        };
        let [first, second, third, fourth] = CONTACTS;
        [
            contact(first),
            contact(second),
            contact(third),
            contact(fourth),
        ]
    }

    /// Returns the friction coefficient over slip, `K / D`, at a slip above 0.
    fn mu_over_slip(&self, slip: T) -> T {
        let x = self.per_peak_slip * slip;
        let inside = (x.ln() * self.sharpness).exp() + self.sharpness * self.bend * x + 1.0;
        self.stiffness / (inside.ln() / self.sharpness).exp()
    }

    /// Advances the contacts' deflections by one step, and returns the sums of their forces.
    fn deflect(
        &self,
        state: &mut State<T>,
        contacts: &[Contact<T>; 4],
        (speeds_m_s, directions): ([T; 2], [f64; 2]),
        step_s: f64,
    ) -> Forces<T> {
        let zero = T::constant(0.0);
        let mut sums = Forces {
            force_n: [zero; 2],
            moment_n_m: zero,
            sides_n: [zero; 2],
        };
        let rate = self.relaxation_m.recip() * step_s;
        let [forward_m_s, left_m_s] = state.speed_m_s;
        let turn = state.turn_rad_s;
        for (contact, deflection) in contacts.iter().zip(&mut state.deflections) {
            let [x_m, y_m] = contact.place_m;
            let rim_m_s = speeds_m_s[contact.side];
            let centre_m_s = forward_m_s - turn * y_m;
            let slips_m_s = [
                rim_m_s - centre_m_s,
                -(left_m_s + turn * x_m) * self.lateral_stiffness_ratio,
            ];
            let theoretical_m_s = rim_m_s.abs();
            let mut reference_m_s =
                theoretical_m_s + self.practical_slip * (centre_m_s.abs() - theoretical_m_s);
            if reference_m_s.value() < REFERENCE_MIN_RATIO * theoretical_m_s.value() {
                reference_m_s = theoretical_m_s * REFERENCE_MIN_RATIO;
            }
            let x = self.per_peak_slip * magnitude(*deflection);
            let rate = rate * (self.relaxation_decrease * x + 1.0);
            // Trapezoidal in the deflection, which is stiff at short relaxation lengths.
            let rolled = rate * reference_m_s * 0.5;
            let (keeps, over) = (-rolled + 1.0, (rolled + 1.0).recip());
            for (part, slip_m_s) in deflection.iter_mut().zip(slips_m_s) {
                *part = (*part * keeps + rate * slip_m_s) * over;
            }
            let [forward, left] = *deflection;
            let slip = magnitude(*deflection);
            let mu_over_slip = self.mu_over_slip(slip);
            let per_slip_n = mu_over_slip * contact.load_n;
            let mut force_n = [per_slip_n * forward, per_slip_n * left];
            let slow = 1.0 - rim_m_s.value().abs() / SLOW_M_S;
            if slow > 0.0 {
                let (stiffness, length_m) = (self.stiffness.value(), self.relaxation_m.value());
                let damping =
                    2.0 * DAMPING_RATIO * slow * (stiffness / GRAVITY_M_S2 / length_m).sqrt();
                for ((force_n, slip_m_s), part) in
                    force_n.iter_mut().zip(slips_m_s).zip(*deflection)
                {
                    *force_n =
                        *force_n + contact.load_n * damping * (slip_m_s - reference_m_s * part);
                }
                let most = STANDING_DEFLECTION_MAX * self.peak.value() / stiffness;
                if slip.value() > most {
                    let [forward, left] = deflection;
                    *forward = *forward * (most / slip.value());
                    *left = *left * (most / slip.value());
                }
            }
            let [tractive_n, lateral_n] = force_n;
            let longitudinal_n =
                tractive_n - self.motion_resistance * contact.load_n * directions[contact.side];
            sums.force_n = [
                sums.force_n[0] + longitudinal_n,
                sums.force_n[1] + lateral_n,
            ];
            sums.moment_n_m = sums.moment_n_m + x_m * lateral_n - y_m * longitudinal_n;
            sums.sides_n[contact.side] = sums.sides_n[contact.side] + tractive_n;
        }
        sums
    }

    /// Advances the state by the time of one sample and returns what the sensors would measure.
    /// Deflections lead speeds by half a step (leapfrog integration).
    pub(super) fn advance(&self, state: &mut State<T>, input: &Input) -> Output<T> {
        let gravity = gravity_m_s2(self.slope, input.heading_rad);
        let contacts = self.contacts(gravity, input);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a small number above 0"
        )]
        let count = ((input.time_s / STEP_MAX_S).ceil() as u32).clamp(1, STEPS_MAX);
        let share = f64::from(count).recip();
        let step_s = input.time_s * share;
        let (per_mass, per_inertia) = (self.mass_kg.recip(), self.inertia_kg_m2.recip());
        let mut output = Output::zero();
        for step in 0..count {
            let from_middle_s = (f64::from(step) * share - 0.5) * input.time_s;
            let rim_of = |side: usize| {
                self.radius_m[side]
                    * (input.wheels_rad_s[side] + input.wheels_rad_s2[side] * from_middle_s)
            };
            let rims_m_s = [rim_of(0), rim_of(1)];
            let directions = rims_m_s.map(direction);
            let forces = self.deflect(state, &contacts, (rims_m_s, directions), step_s);
            let [forward_m_s, left_m_s] = state.speed_m_s;
            let turn = state.turn_rad_s;
            let along = |axis: usize| forces.force_n[axis] * per_mass + gravity[axis];
            let acceleration = [along(0), along(1)];
            state.speed_m_s = [
                forward_m_s + (acceleration[0] + left_m_s * turn) * step_s,
                left_m_s + (acceleration[1] - forward_m_s * turn) * step_s,
            ];
            state.turn_rad_s = turn + forces.moment_n_m * per_inertia * step_s;
            output.turn_rad_s = output.turn_rad_s + (turn + state.turn_rad_s) * (0.5 * share);
            for side in 0..2 {
                let measured = if input.is_specific_force {
                    forces.force_n[side] * per_mass
                } else {
                    acceleration[side]
                };
                output.acceleration_m_s2[side] = output.acceleration_m_s2[side] + measured * share;
                let load_n = contacts[2 * side].load_n + contacts[2 * side + 1].load_n;
                let side_n = forces.sides_n[side];
                let lost_n = self.resistance * load_n + self.gear_loss * side_n.abs();
                let driving_n = side_n + lost_n * directions[side];
                let nominal_m = self.nominal_radius_m;
                let rotors_n_m =
                    self.rotors_kg * (nominal_m * nominal_m * input.wheels_rad_s2[side]);
                output.torques_n_m[side] = output.torques_n_m[side]
                    + (driving_n * self.radius_m[side] + rotors_n_m)
                        * self.torque_scale[side]
                        * share;
            }
        }
        output.turn_rad_s = output.turn_rad_s + self.gyro_offset_rad_s;
        for axis in 0..2 {
            output.acceleration_m_s2[axis] =
                output.acceleration_m_s2[axis] + self.acceleration_offset_m_s2[axis];
        }
        output.forward_m_s =
            state.speed_m_s[0] + state.turn_rad_s * self.centre_m[1] + self.speed_offset_m_s;
        output
    }
}
