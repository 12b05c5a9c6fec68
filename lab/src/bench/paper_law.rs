//! The law `yi2007` on a free base: integrators in the loop, wheel speeds by (21) with the measured
//! velocity. No force enforces the constraint that (21) inverts, so the law diverges, as the
//! comparison shows.

use nalgebra::Vector2;

use crate::bench::course::Course;
use crate::paper::closed_form::SlipShape;
use crate::paper::law::{DesiredPoint, LawInput};
use crate::paper::reduced::Reduced;
use crate::paper::{Setting, Yi2007, Yi2007Config};
use tread_control::friction::FrictionCurve;
use tread_control::geometry::Twist;
use tread_control::measured::{BodyAcceleration, Measured, WheelSpeeds};
use tread_control::robot::RobotModel;
use tread_control::tracking::desaturated;

/// Time step of the central difference that gives the course's third derivative, seconds.
const DIFFERENCE_S: f64 = 0.01;
/// Bounds of θ̂: at zero the law would have no input.
const THETA_RANGE: [f64; 2] = [0.01, 10.0];
/// Bound of |τ₁|, so that a diverging run stays finite.
const ZETA_MAX: f64 = 1.0;

/// The law with its state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaperLaw {
    model: RobotModel,
    law: Yi2007,
    reduced: Reduced,
    zeta: f64,
    theta: f64,
    wheels: WheelSpeeds,
}

impl PaperLaw {
    /// Creates the law of section IV with θ̂ = 1; its wheel transformation uses the true curve.
    /// Returns None if the model or the gains are invalid.
    pub fn new(model: RobotModel, curve: FrictionCurve) -> Option<Self> {
        let config = Yi2007Config::section_iv();
        Some(Self {
            model,
            law: Yi2007::new(config).ok()?,
            reduced: Reduced::new(Setting { model, curve }, config.centre_forward_m).ok()?,
            zeta: 0.0,
            theta: 1.0,
            wheels: WheelSpeeds::default(),
        })
    }

    /// Returns the distance of the control point ahead of the centre, metres.
    pub fn point_forward_m(&self) -> f64 {
        self.law.config().centre_forward_m
    }

    /// Computes the wheel speeds of one tick of `dt_s` seconds.
    pub fn step(
        &mut self,
        desired: &DesiredPoint,
        measured: &Measured,
        felt: BodyAcceleration,
        dt_s: f64,
    ) -> WheelSpeeds {
        let forward_m = self.law.config().centre_forward_m;
        let input = LawInput {
            pose: measured.pose,
            forward_m_s: measured.twist.linear_m_s,
            left_m_s: -forward_m * measured.twist.angular_rad_s,
            forward_m_s2: felt.forward_m_s2,
            zeta: self.zeta,
            theta: self.theta,
        };
        let Ok(output) = self.law.evaluate(&input, desired) else {
            // Singular at standstill: drive forward until it is not.
            let twist = Twist {
                linear_m_s: 0.1,
                angular_rad_s: 0.0,
            };
            return desaturated(&self.model, twist).0;
        };
        let tau = Vector2::new(self.zeta, output.inputs[1]);
        self.zeta = (self.zeta + output.inputs[0] * dt_s).clamp(-ZETA_MAX, ZETA_MAX);
        self.theta =
            (self.theta + output.theta_rate_1_s * dt_s).clamp(THETA_RANGE[0], THETA_RANGE[1]);
        let eta = Vector2::new(input.forward_m_s, input.left_m_s);
        let velocity = self.reduced.velocity(eta);
        let shape = SlipShape::linear();
        let wheels = self
            .reduced
            .inputs(tau, &velocity, &shape)
            .and_then(|inputs| self.reduced.wheel_speeds(inputs, &shape));
        // Where no forward wheel speed gives τ, the last wheel speeds apply.
        if let Ok(wheels) = wheels {
            let most_rad_s = self.model.limits().wheel_speed_max_rad_s;
            self.wheels = WheelSpeeds {
                left_rad_s: wheels.left_rad_s.min(most_rad_s),
                right_rad_s: wheels.right_rad_s.min(most_rad_s),
            };
        }
        self.wheels
    }
}

/// Returns the course as motion of point D, with its jerk by a central difference.
pub(super) fn desired(course: &Course, time_s: f64) -> DesiredPoint {
    let derivatives = |time_s: f64| {
        let sample = course.sample(time_s);
        let (sin, cos) = sample.pose.heading_rad.sin_cos();
        let (longitudinal, lateral) = (Vector2::new(cos, sin), Vector2::new(-sin, cos));
        let acceleration = longitudinal.scale(sample.acceleration_m_s2)
            + lateral.scale(sample.speed_m_s * sample.turn_rad_s);
        (sample, longitudinal.scale(sample.speed_m_s), acceleration)
    };
    let (sample, velocity, acceleration) = derivatives(time_s);
    let (_, _, later) = derivatives(time_s + DIFFERENCE_S);
    let (_, _, earlier) = derivatives((time_s - DIFFERENCE_S).max(0.0));
    DesiredPoint {
        position: Vector2::new(sample.pose.x_m, sample.pose.y_m),
        velocity,
        acceleration,
        jerk: (later - earlier).scale(0.5 / DIFFERENCE_S),
    }
}
