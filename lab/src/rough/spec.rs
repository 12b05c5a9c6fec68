//! Makes of robots, and the differences of a simulated robot and its ground from the agent's model.

use std::ops::Range;

use serde::Serialize;
use tread_control::robot::{Limits, RobotModel, RobotModelError, RobotModelSpec};

use super::curve::{Curve, Shape};
use super::width::{Middle, Width};
use crate::random::Random;

/// Make of a robot, from its description package and data sheet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Make {
    /// Name of the make.
    pub name: &'static str,
    mass_kg: f64,
    track_m: f64,
    wheelbase_m: f64,
    wheel_radius_m: f64,
    /// Length and width of the body, metres.
    body_m: (f64, f64),
}

/// Makes of robots. Masses, wheels and body sizes are from `husky_description`,
/// `jackal_description` and `warthog_description` of Clearpath Robotics and their data sheets. The
/// first is the robot of Yi et al. (2007), whose body is assumed to extend over its wheels.
pub const MAKES: [Make; 4] = [
    Make {
        name: "paper",
        mass_kg: 5.0,
        track_m: 0.43,
        wheelbase_m: 0.28,
        wheel_radius_m: 0.08,
        body_m: (0.44, 0.48),
    },
    Make {
        name: "Jackal",
        mass_kg: 17.0,
        track_m: 0.376,
        wheelbase_m: 0.262,
        wheel_radius_m: 0.098,
        body_m: (0.508, 0.43),
    },
    Make {
        name: "Husky",
        mass_kg: 50.0,
        track_m: 0.571,
        wheelbase_m: 0.512,
        wheel_radius_m: 0.165,
        body_m: (0.99, 0.67),
    },
    Make {
        name: "Warthog",
        mass_kg: 280.0,
        track_m: 1.125,
        wheelbase_m: 0.916,
        wheel_radius_m: 0.27,
        body_m: (1.52, 1.38),
    },
];

impl Make {
    /// Returns the model that an integrator configures: the values of the data sheet, and the yaw
    /// inertia of a homogeneous plate of the body's size.
    ///
    /// # Errors
    /// [`RobotModelError`] if a value of the table is out of range.
    pub fn model(&self) -> Result<RobotModel, RobotModelError> {
        let (length_m, width_m) = self.body_m;
        RobotModel::try_from(RobotModelSpec {
            mass_kg: self.mass_kg,
            track_width_m: self.track_m,
            wheelbase_m: self.wheelbase_m,
            wheel_radius_m: self.wheel_radius_m,
            yaw_inertia_kg_m2: self.mass_kg * (length_m.powi(2) + width_m.powi(2)) / 12.0,
            limits: Limits {
                wheel_speed_max_rad_s: 1.6 / self.wheel_radius_m,
                wheel_acceleration_max_rad_s2: 4.8 / self.wheel_radius_m,
                linear_max_m_s: 1.0,
                angular_max_rad_s: 1.5,
                linear_acceleration_max_m_s2: 0.8,
                linear_jerk_max_m_s3: 4.0,
                lateral_acceleration_max_m_s2: 1.0,
            },
        })
    }
}

/// Differences of a simulated robot and its ground from the agent's model and from the agent's
/// simulator.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Deviations {
    /// Ratio of the payload to the mass of the agent's model; the payload is at the centre of mass.
    pub payload_ratio: f64,
    /// Ratio of the yaw inertia to that of the agent's model, apart from the payload's
    /// contribution.
    pub inertia_ratio: f64,
    /// Distance of the centre of mass forward of the centre of the wheels, relative to the
    /// wheelbase.
    pub center_forward_ratio: f64,
    /// Distance of the centre of mass to the left of the centre of the wheels, relative to the
    /// track width.
    pub center_left_ratio: f64,
    /// Height of the centre of mass, relative to the track width.
    pub center_height_ratio: f64,
    /// Relaxation length of the contacts, metres.
    pub relaxation_m: f64,
    /// Ratio of the contacts' lateral to their longitudinal stiffness.
    pub lateral_stiffness_ratio: f64,
    /// Slope of the ground along the site's axes `[x, y]`, radians.
    pub slope_rad: [f64; 2],
    /// Ratio of measured to true torque, `[left, right]`.
    pub torque_scale: [f64; 2],
    /// Inertia of a side's rotors and wheels at the rim, relative to half the mass.
    pub rotor_ratio: f64,
    /// Ratio of the torque lost in the gears to the transmitted torque.
    pub gear_loss_ratio: f64,
    /// Rolling resistance coefficient.
    pub rolling_resistance_ratio: f64,
    /// Ratio of true to nominal rolling radius, `[left, right]`.
    pub radius_ratio: [f64; 2],
    /// Time constant of the speed servo, seconds.
    pub servo_lag_s: f64,
    /// Maximum motor force at the rim of a side, relative to its load.
    pub motor_limit_mu: f64,
    /// Friction curve of ground and tyre.
    pub curve: Curve,
}

impl Deviations {
    /// Returns the parameters nearest to the agent's simulator, so that only plant and sensors
    /// differ.
    pub fn none(stiffness: f64) -> Self {
        Self {
            payload_ratio: 0.0,
            inertia_ratio: 1.0,
            center_forward_ratio: 0.0,
            center_left_ratio: 0.0,
            center_height_ratio: 0.3,
            relaxation_m: 2.0e-3,
            lateral_stiffness_ratio: 1.0,
            slope_rad: [0.0; 2],
            torque_scale: [1.0; 2],
            rotor_ratio: 0.01,
            gear_loss_ratio: 0.0,
            rolling_resistance_ratio: 0.01,
            radius_ratio: [1.0; 2],
            servo_lag_s: 0.05,
            motor_limit_mu: 1.5,
            curve: Curve {
                shape: Shape::Linear,
                stiffness,
                mu_peak: 0.6_f64.min(0.9 * stiffness),
            },
        }
    }

    /// Draws one robot of the population.
    ///
    /// Payloads are those that data sheets allow for daily use (0 to 30 %); relaxation lengths are
    /// those of small pneumatic and solid tyres (1 to 10 cm: Pacejka, ch. 5). Carcasses are softer to the
    /// side than along the wheel, so lateral stiffness is 0.7 to 1.1 of the longitudinal one (Pacejka, ch. 3
    /// and 4; 1 for a brush model on a rigid carcass). Torque constants have
    /// standard deviations of 3 % for both sides together and 2 % per side (motor data sheets state
    /// ± 5 to 10 % at most). Slopes are those of yards and fields (standard deviation 2° per axis,
    /// at most 6°).
    pub fn drawn(random: &mut Random) -> Self {
        Self::drawn_wider(random, Width::default())
    }

    /// Draws one robot from distributions that are wider than those of the population.
    pub fn drawn_wider(random: &mut Random, width: Width) -> Self {
        let stiffness = random.one_of(&[0.7, 3.0, 12.0]).unwrap_or(3.0);
        let stiffness = width.log_value(stiffness, STIFFNESS_MIDDLE);
        let shape = random.one_of(&Shape::ALL).unwrap_or(Shape::Linear);
        let scale = 1.0 + random.normal(width.std_dev(0.03));
        let slope_max = width.std_dev(6.0_f64.to_radians());
        let mut slope = || {
            let rad = random.normal(width.std_dev(2.0_f64.to_radians()));
            rad.clamp(-slope_max, slope_max)
        };
        let slope_rad = [slope(), slope()];
        let side_scale = width.std_dev(0.02);
        let radius = width.std_dev(0.005);
        Self {
            payload_ratio: random.uniform(width.range(0.0..0.3)),
            inertia_ratio: random.uniform(width.range(0.8..1.25)),
            center_forward_ratio: random.uniform(width.range(-0.05..0.05)),
            center_left_ratio: random.uniform(width.range(-0.03..0.03)),
            center_height_ratio: random.uniform(width.range(0.2..0.5)),
            relaxation_m: random.log_uniform(width.log_range(0.01..0.1)),
            lateral_stiffness_ratio: random
                .stream(LATERAL_STREAM)
                .log_uniform(width.log_range(0.7..1.1)),
            slope_rad,
            torque_scale: [
                scale * (1.0 + random.normal(side_scale)),
                scale * (1.0 + random.normal(side_scale)),
            ],
            rotor_ratio: random.uniform(above(ROTOR_RATIO_MIN, width.range(0.01..0.1))),
            gear_loss_ratio: random.uniform(above(0.0, width.range(0.0..0.03))),
            rolling_resistance_ratio: random.uniform(above(0.0, width.range(0.01..0.04))),
            radius_ratio: [1.0 + random.normal(radius), 1.0 + random.normal(radius)],
            servo_lag_s: random.log_uniform(width.log_range(0.02..0.1)),
            motor_limit_mu: random.uniform(width.range(0.8..1.5)),
            curve: Curve {
                shape,
                stiffness,
                mu_peak: random.uniform(width.range(0.3..0.9)).min(0.9 * stiffness),
            },
        }
    }
}

/// Random sequence of the lateral stiffness, so that all else is as it was without this draw.
const LATERAL_STREAM: u64 = 1;
/// Geometric middle of the grounds' stiffnesses 0.7 and 12.
const STIFFNESS_MIDDLE: Middle = Middle(2.898);
/// Least inertia of a side's rotors and wheels at the rim, relative to half the mass: that of the
/// wheels alone.
const ROTOR_RATIO_MIN: f64 = 0.002;

/// Returns the part of a range above `least`.
fn above(least: f64, range: Range<f64>) -> Range<f64> {
    range.start.max(least)..range.end
}
