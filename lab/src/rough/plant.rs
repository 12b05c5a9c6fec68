//! Plant of the rough world: equations of motion of body, wheels, contacts and motors.
//!
//! The state is in the body frame at the centre of mass: forward and left speed, turn rate; per side
//! the wheel speed (front and rear are coupled by a chain, as on the robots of [`super::spec`]); per
//! contact the deflection of the tyre as a slip vector s, with
//! `ℓ ṡ = v_slip − |rω| s`. The contact force is `N μ(|s'|) s'/|s'|`, with the wheel load N of a rigid
//! body on four equal springs. `s'` is s with its lateral part multiplied by the ratio of the lateral to the
//! longitudinal stiffness (similarity of combined slip: Pacejka, Tire and Vehicle Dynamics, ch. 4). Gravity acts along the slope. A proportional-integral speed servo
//! commands the motor torques, which are limited. Rotor inertia, gear losses and rolling resistance
//! reduce the torque at the contact.

use nalgebra::{Matrix3, Vector3};
use tread_control::geometry::{Pose, wrap_angle_rad};
use tread_control::measured::WheelSpeeds;
use tread_control::robot::{GRAVITY_M_S2, RobotModel};

use super::arithmetic::{length, tanh};
use super::curve::{ContactSlip, Curve, Shape};
use super::gravity::gravity_m_s2;
use super::means::{Means, Moment, Sums};
use super::spec::Deviations;

/// Integration step in seconds: a hundredth of the period of the fastest oscillation of a contact.
pub const STEP_S: f64 = 5.0e-4;
/// Maximum deflection of a contact, as a slip, far beyond the peak of every curve; larger values
/// are clamped.
const DEFLECTION_MAX: f64 = 3.0;
/// Rim speed below which contacts have rubber damping, in metres per second.
const DAMPED_BELOW_M_S: f64 = 0.1;
/// Damping ratio of a contact at standstill.
const DAMPING_RATIO: f64 = 0.2;
/// Rim speed scale of the smooth sign change of rolling resistance, in metres per second.
const RESISTANCE_TURNS_M_S: f64 = 0.01;
/// Time constant with which wheel loads follow the forces, in seconds; models the vertical tyre
/// springs.
const LOAD_LAG_S: f64 = 0.02;

/// Contact of one wheel with the ground.
#[derive(Debug, Clone, Copy, Default)]
struct Contact {
    /// Position relative to the centre of mass, body frame, metres.
    x_m: f64,
    y_m: f64,
    side: usize,
    /// Deflection as a slip, `[forward, left]`.
    deflection: [f64; 2],
    load_n: f64,
    slip_m_s: f64,
}

/// True state at the reference point of the agent's model, the centre of the wheels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct State {
    /// Pose of the centre of the wheels, site frame.
    pub pose: Pose,
    /// Forward speed, metres per second.
    pub forward_m_s: f64,
    /// Speed to the left, metres per second.
    pub left_m_s: f64,
    /// Turn rate, radians per second.
    pub yaw_rate_rad_s: f64,
}

/// True values of one time from which sensor values are made, in addition to [`Means`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Truth {
    /// Pose and velocity of the robot.
    pub state: State,
    /// Accumulated wheel angles `[left, right]`, radians.
    pub turned_rad: [f64; 2],
    /// Ratio of measured to true torque, `[left, right]`.
    pub torque_scale: [f64; 2],
    /// Angle between the robot's vertical axis and the vertical, radians.
    pub tilt_rad: f64,
    /// Gravitational acceleration along the robot's axes `[forward, left]`.
    pub gravity_m_s2: [f64; 2],
}

/// Drive of the wheels in one integration step; values are `[left, right]`.
#[derive(Debug, Clone, Copy)]
enum WheelDrive {
    /// The servo controls the wheels to these speeds, radians per second.
    Servo([f64; 2]),
    /// The wheels have these speeds at the end of the step, radians per second; the torques follow.
    Given([f64; 2]),
}

/// Simulated robot of the rough world.
#[derive(Debug, Clone)]
pub struct Plant {
    spec: Deviations,
    mass_kg: f64,
    inertia_kg_m2: f64,
    side_inertia_kg_m2: f64,
    center_m: [f64; 3],
    radius_m: [f64; 2],
    contacts: [Contact; 4],
    load_of_moments: Matrix3<f64>,
    /// Low-pass filtered sum of the contact forces for the load transfer, `[forward, left]`,
    /// newtons.
    load_force_n: [f64; 2],
    speed_m_s: [f64; 2],
    yaw_rate_rad_s: f64,
    /// Pose of the centre of mass, site frame.
    pose: Pose,
    wheels_rad_s: [f64; 2],
    integral_n_m: [f64; 2],
    motor_n_m: [f64; 2],
    /// Accumulated wheel angles `[left, right]`, radians.
    turned_rad: [f64; 2],
    /// Gravitational acceleration at the heading 0: forward, left, into the ground.
    gravity_m_s2: [f64; 3],
    blend: Option<(Shape, f64)>,
}

fn inertia_over_mass_m2(model: &RobotModel, spec: &Deviations) -> f64 {
    model.yaw_inertia_kg_m2() / model.mass_kg() * spec.inertia_ratio
}

impl Plant {
    /// Creates a robot at rest with the centre of its wheels at `start`; `None` if the contacts do
    /// not form a rectangle.
    pub fn new(model: &RobotModel, spec: Deviations, start: Pose) -> Option<Self> {
        let (track_m, base_m) = (model.track_width_m(), model.wheelbase_m());
        let mass_kg = model.mass_kg() * (1.0 + spec.payload_ratio);
        let center_m = [
            spec.center_forward_ratio * base_m,
            spec.center_left_ratio * track_m,
            spec.center_height_ratio * track_m,
        ];
        let nominal_m = model.wheel_radius_m();
        let radius_m = spec.radius_ratio.map(|ratio| ratio * nominal_m);
        let contact = |front: f64, left: f64| Contact {
            x_m: 0.5 * front * base_m - center_m[0],
            y_m: 0.5 * left * track_m - center_m[1],
            side: usize::from(left < 0.0),
            ..Contact::default()
        };
        let contacts = [
            contact(1.0, 1.0),
            contact(-1.0, 1.0),
            contact(1.0, -1.0),
            contact(-1.0, -1.0),
        ];
        // Wheel loads c₀ + c₁x + c₂y with given sum and moments.
        let moments: Matrix3<f64> = contacts
            .iter()
            .map(|contact| {
                let row = Vector3::new(1.0, contact.x_m, contact.y_m);
                row * row.transpose()
            })
            .sum();
        let (sin, cos) = start.heading_rad.sin_cos();
        let mut plant = Self {
            mass_kg,
            inertia_kg_m2: mass_kg * inertia_over_mass_m2(model, &spec),
            side_inertia_kg_m2: spec.rotor_ratio * 0.5 * model.mass_kg() * nominal_m.powi(2),
            center_m,
            radius_m,
            contacts,
            load_of_moments: moments.try_inverse()?,
            load_force_n: [0.0; 2],
            speed_m_s: [0.0; 2],
            yaw_rate_rad_s: 0.0,
            pose: Pose {
                x_m: start.x_m + cos * center_m[0] - sin * center_m[1],
                y_m: start.y_m + sin * center_m[0] + cos * center_m[1],
                heading_rad: start.heading_rad,
            },
            wheels_rad_s: [0.0; 2],
            integral_n_m: [0.0; 2],
            motor_n_m: [0.0; 2],
            turned_rad: [0.0; 2],
            gravity_m_s2: gravity_m_s2(spec.slope_rad, 0.0),
            blend: None,
            spec,
        };
        plant.update_loads(1.0);
        Some(plant)
    }

    /// Changes the payload to this ratio of the model's mass, at the centre of mass.
    pub fn load(&mut self, model: &RobotModel, payload_ratio: f64) {
        self.spec.payload_ratio = payload_ratio;
        self.mass_kg = model.mass_kg() * (1.0 + payload_ratio);
        self.inertia_kg_m2 = self.mass_kg * inertia_over_mass_m2(model, &self.spec);
        self.update_loads(1.0);
    }

    /// Changes the stiffness of the ground under all wheels.
    pub fn change_ground(&mut self, stiffness: f64) {
        self.spec.curve.stiffness = stiffness;
    }

    /// Returns the true parameters of robot and ground.
    pub fn spec(&self) -> &Deviations {
        &self.spec
    }

    /// Returns the true values from which sensor values are made.
    pub fn truth(&self) -> Truth {
        Truth {
            state: self.state(),
            turned_rad: self.turned_rad,
            torque_scale: self.spec.torque_scale,
            tilt_rad: self.tilt_rad(),
            gravity_m_s2: self.level_gravity_m_s2(self.pose.heading_rad.sin_cos().into()),
        }
    }

    /// Returns the true state of the centre of the wheels.
    pub fn state(&self) -> State {
        let (sin, cos) = self.pose.heading_rad.sin_cos();
        let [x_m, y_m, _] = self.center_m;
        State {
            pose: Pose {
                x_m: self.pose.x_m - cos * x_m + sin * y_m,
                y_m: self.pose.y_m - sin * x_m - cos * y_m,
                heading_rad: self.pose.heading_rad,
            },
            forward_m_s: self.speed_m_s[0] + self.yaw_rate_rad_s * y_m,
            left_m_s: self.speed_m_s[1] - self.yaw_rate_rad_s * x_m,
            yaw_rate_rad_s: self.yaw_rate_rad_s,
        }
    }

    /// Returns the angle between the robot's vertical axis and the vertical, radians.
    pub fn tilt_rad(&self) -> f64 {
        let [x_rad, y_rad] = self.spec.slope_rad;
        x_rad.tan().hypot(y_rad.tan()).atan()
    }

    /// Returns the ratio of the largest contact slip to the slip at the peak of the friction curve.
    pub fn slip_over_peak(&self) -> f64 {
        let slips = self
            .contacts
            .iter()
            .map(|contact| length(self.felt(contact.deflection)));
        slips.fold(0.0, f64::max) / self.spec.curve.peak_slip()
    }

    /// Returns the gravitational acceleration along the ground in the body frame, forward and left, given
    /// sine and cosine of the heading.
    fn level_gravity_m_s2(&self, [sin, cos]: [f64; 2]) -> [f64; 2] {
        let [x, y, _] = self.gravity_m_s2;
        [cos * x + sin * y, -sin * x + cos * y]
    }

    /// Moves the wheel loads towards equilibrium with the moments of the contact forces, by the
    /// fraction `share` of the difference.
    fn update_loads(&mut self, share: f64) {
        let height_m = self.center_m[2];
        let weight_n = self.mass_kg * self.gravity_m_s2[2];
        let moments = Vector3::new(
            weight_n,
            -height_m * self.load_force_n[0],
            -height_m * self.load_force_n[1],
        );
        let plane = self.load_of_moments * moments;
        for contact in &mut self.contacts {
            let load_n = plane[0] + plane[1] * contact.x_m + plane[2] * contact.y_m;
            contact.load_n += share * (load_n.max(0.0) - contact.load_n);
        }
    }

    /// Replaces the fraction `ratio` of the friction by that of another shape, for derivatives with
    /// respect to the shape.
    #[must_use]
    pub fn with_blend(mut self, shape: Shape, ratio: f64) -> Self {
        self.blend = Some((shape, ratio));
        self
    }

    /// Returns the deflection in whose direction the contact force acts.
    fn felt(&self, [forward, left]: [f64; 2]) -> [f64; 2] {
        [forward, self.spec.lateral_stiffness_ratio * left]
    }

    /// Returns the ratio μ/λ of the blended friction curve.
    fn mu_over_slip(&self, contact: ContactSlip) -> f64 {
        let own = self.spec.curve.mu_over_slip(contact);
        self.blend.map_or(own, |(shape, share)| {
            let other = Curve {
                shape,
                ..self.spec.curve
            };
            (1.0 - share) * own + share * other.mu_over_slip(contact)
        })
    }

    /// Computes the motor torques for commanded wheel speeds `[left, right]`, radians per second.
    fn command(&mut self, command: [f64; 2]) {
        for (side, target_rad_s) in command.into_iter().enumerate() {
            let radius_m = self.radius_m[side];
            let inertia = 0.5 * self.mass_kg * radius_m.powi(2) + self.side_inertia_kg_m2;
            let gain = inertia / self.spec.servo_lag_s;
            let error = target_rad_s - self.wheels_rad_s[side];
            let most = self.spec.motor_limit_mu * 0.5 * self.mass_kg * GRAVITY_M_S2 * radius_m;
            // Implicit proportional part, because light rotors with a stiff servo are faster than
            // one integration step.
            let stiffness = gain / (1.0 + gain * STEP_S / self.side_inertia_kg_m2);
            let wanted = stiffness * error + self.integral_n_m[side];
            let torque = wanted.clamp(-most, most);
            // Anti-windup: the integral does not change while the torque is limited.
            if (wanted - torque).abs() < f64::EPSILON {
                let rate = gain / (4.0 * self.spec.servo_lag_s);
                self.integral_n_m[side] += rate * error * STEP_S;
            }
            self.motor_n_m[side] = torque;
        }
    }

    /// Returns the contact forces on the body, `[forward, left]` each, newtons.
    fn forces(&self) -> [[f64; 2]; 4] {
        let curve = self.spec.curve;
        let damping =
            2.0 * DAMPING_RATIO * (curve.stiffness * self.spec.relaxation_m / GRAVITY_M_S2).sqrt();
        self.contacts.map(|contact| {
            let felt = self.felt(contact.deflection);
            let slip = length(felt);
            let mu_over_slip = self.mu_over_slip(ContactSlip {
                slip,
                sliding_m_s: contact.slip_m_s,
            });
            let rim_m_s = (self.wheels_rad_s[contact.side] * self.radius_m[contact.side]).abs();
            let damped =
                damping * (1.0 - rim_m_s / DAMPED_BELOW_M_S).max(0.0) / self.spec.relaxation_m;
            let velocity = self.slip_velocity(&contact);
            let most_n = curve.mu_peak * contact.load_n;
            let mut force = [0, 1].map(|axis| {
                let gives = velocity[axis] - rim_m_s * contact.deflection[axis];
                contact.load_n * (mu_over_slip * felt[axis] + damped * gives)
            });
            let size_n = length(force);
            if size_n > most_n {
                force = force.map(|part| part * most_n / size_n);
            }
            force
        })
    }

    fn step(&mut self, drive: WheelDrive, sums: &mut Sums) {
        if let WheelDrive::Servo(command) = drive {
            self.command(command);
        }
        let forces = self.forces();
        let (mut force, mut moment, mut side_n) = ([0.0; 2], 0.0, [0.0; 2]);
        let mut side_load_n = [0.0; 2];
        for (contact, [longitudinal_n, left_n]) in self.contacts.iter().zip(forces) {
            force[0] += longitudinal_n;
            force[1] += left_n;
            moment += contact.x_m * left_n - contact.y_m * longitudinal_n;
            side_n[contact.side] += longitudinal_n;
            side_load_n[contact.side] += contact.load_n;
        }
        let share = STEP_S / LOAD_LAG_S;
        for (slow_n, now_n) in self.load_force_n.iter_mut().zip(force) {
            *slow_n += share * (now_n - *slow_n);
        }
        self.update_loads(share);
        let (sin, cos) = self.pose.heading_rad.sin_cos();
        let gravity = self.level_gravity_m_s2([sin, cos]);
        let acceleration = [
            force[0] / self.mass_kg + gravity[0],
            force[1] / self.mass_kg + gravity[1],
        ];
        let yaw_rate = self.yaw_rate_rad_s;
        let [forward, left] = self.speed_m_s;
        self.speed_m_s = [
            forward + STEP_S * (acceleration[0] + left * yaw_rate),
            left + STEP_S * (acceleration[1] - forward * yaw_rate),
        ];
        self.yaw_rate_rad_s += STEP_S * moment / self.inertia_kg_m2;
        for side in 0..2 {
            let (radius_m, speed) = (self.radius_m[side], self.wheels_rad_s[side]);
            let contact_n_m = side_n[side] * radius_m;
            let turns = tanh(speed * radius_m / RESISTANCE_TURNS_M_S);
            let resistance =
                self.spec.rolling_resistance_ratio * side_load_n[side] * radius_m * turns;
            let lost = self.spec.gear_loss_ratio * contact_n_m.abs() * turns;
            let taken = contact_n_m + resistance + lost;
            match drive {
                WheelDrive::Servo(_) => {
                    let driving = self.motor_n_m[side] - taken;
                    self.wheels_rad_s[side] += STEP_S * driving / self.side_inertia_kg_m2;
                }
                WheelDrive::Given(next) => {
                    let rate = (next[side] - speed) / STEP_S;
                    self.motor_n_m[side] = taken + self.side_inertia_kg_m2 * rate;
                    self.wheels_rad_s[side] = next[side];
                }
            }
            self.turned_rad[side] += STEP_S * self.wheels_rad_s[side];
        }
        self.deflect();
        let [forward, left] = self.speed_m_s;
        self.pose = Pose {
            x_m: self.pose.x_m + STEP_S * (cos * forward - sin * left),
            y_m: self.pose.y_m + STEP_S * (sin * forward + cos * left),
            heading_rad: wrap_angle_rad(self.pose.heading_rad + STEP_S * self.yaw_rate_rad_s),
        };
        sums.add(&Moment {
            yaw_rate_rad_s: self.yaw_rate_rad_s,
            acceleration_m_s2: acceleration,
            wheels_rad_s: self.wheels_rad_s,
            motor_n_m: self.motor_n_m,
        });
    }

    /// Returns the negative sliding velocity of a contact patch over the ground, `[forward, left]`,
    /// metres per second.
    fn slip_velocity(&self, contact: &Contact) -> [f64; 2] {
        let rim_m_s = self.wheels_rad_s[contact.side] * self.radius_m[contact.side];
        let [forward_m_s, left_m_s] = self.speed_m_s;
        [
            rim_m_s - (forward_m_s - self.yaw_rate_rad_s * contact.y_m),
            -(left_m_s + self.yaw_rate_rad_s * contact.x_m),
        ]
    }

    fn deflect(&mut self) {
        let length_m = self.spec.relaxation_m;
        let velocities = self.contacts.map(|contact| self.slip_velocity(&contact));
        for (contact, velocity) in self.contacts.iter_mut().zip(velocities) {
            let rim_m_s = self.wheels_rad_s[contact.side] * self.radius_m[contact.side];
            contact.slip_m_s = length(velocity);
            let share = STEP_S / length_m;
            for (axis, deflection) in contact.deflection.iter_mut().enumerate() {
                *deflection =
                    (*deflection + share * velocity[axis]) / (1.0 + share * rim_m_s.abs());
            }
            let size = length(contact.deflection);
            // At low rim speed the contact slides beyond the peak of the curve.
            let most = if rim_m_s.abs() < DAMPED_BELOW_M_S {
                self.spec.curve.peak_slip().min(DEFLECTION_MAX)
            } else {
                DEFLECTION_MAX
            };
            if size > most {
                contact.deflection = contact.deflection.map(|part| part * most / size);
            }
        }
    }

    /// Integrates `steps` steps with commanded wheel speeds. Returns the means over that time.
    pub fn advance(&mut self, command: WheelSpeeds, steps: u32) -> Means {
        let mut sums = Sums::default();
        let command = [command.left_rad_s, command.right_rad_s];
        for _ in 0..steps {
            self.step(WheelDrive::Servo(command), &mut sums);
        }
        sums.means()
    }

    /// Integrates one step for each entry of `wheels_rad_s`, which has the wheel speeds at the end of
    /// the step, `[left, right]` in radians per second; motor torques are unlimited. Returns the
    /// means over that time.
    pub fn advance_along(&mut self, wheels_rad_s: &[[f64; 2]]) -> Means {
        let mut sums = Sums::default();
        for next in wheels_rad_s {
            self.step(WheelDrive::Given(*next), &mut sums);
        }
        sums.means()
    }

    /// Returns the wheel speeds `[left, right]`, radians per second.
    pub fn wheels_rad_s(&self) -> [f64; 2] {
        self.wheels_rad_s
    }
}

#[cfg(test)]
mod tests {
    use super::super::spec::MAKES;
    use super::*;

    #[test]
    fn a_stiff_servo_on_light_rotors_holds_a_robot_on_a_slope() {
        for make in MAKES {
            let spec = Deviations {
                rotor_ratio: 0.01,
                servo_lag_s: 0.02,
                slope_rad: [0.05, -0.05],
                ..Deviations::none(3.0)
            };
            let model = make.model().expect("the makes are robots");
            let mut plant = Plant::new(&model, spec, Pose::default()).expect("a rectangle");
            plant.advance(WheelSpeeds::default(), 4_000);
            let means = plant.advance(WheelSpeeds::default(), 4_000);
            let wheels = means.wheel_speeds;
            let rim_m_s =
                wheels.left_rad_s.abs().max(wheels.right_rad_s.abs()) * model.wheel_radius_m();
            assert!(rim_m_s < 5.0e-3, "{}: {rim_m_s} m/s", make.name);
        }
    }
}
