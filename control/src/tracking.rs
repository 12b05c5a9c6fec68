//! The shipped tracking law: wheel speeds from tracking errors.
//!
//! Lyapunov function `V = ½(e_x² + e_y²) + (1 − cos e_θ)/k_y + θ̃²/(2ρ)`, errors in the frame of the
//! robot's *course*. On a free base the course differs from the heading by the sideslip
//! `β = −v ω θ/g` (θ = 1/K, steady turn of the four-wheel sum), so the error's own motion holds
//! `ė_y = v sin e_θ + (v²ω/g) θ̃`, and `θ̂̇ = ρ e_y v²ω/g` makes V fall: the paper's adaptation (26)
//! on a law that never inverts a measured velocity, so it is regular at standstill.
//!
//! The command is the reference's motion, corrected by the errors (Kanayama's form with integral
//! action on `e_y`), plus feed-forward: lead for the wheel servo and half a sample, and, weighted by
//! the confidence in θ, the sideslip above and lead for slip relaxation, `vθ/g` along and
//! `(vθ/g)·4 I_G/(m(W² + L²))` in yaw. No confidence, no friction feed-forward. θ̂ is bounded in
//! range and rate, pulled to a measured θ where there is one, and held while the wheels saturate or
//! the pose is stale. It serves this loop only; what the map gets comes from [`crate::estimation`].

use thiserror::Error;

use crate::geometry::{Twist, wrap_angle_rad};
use crate::measured::{Measured, WheelSpeeds};
use crate::reference::ReferenceSample;
use crate::robot::{GRAVITY_M_S2, RobotModel};

/// How much faster than the plan's limits feedback may drive.
const FEEDBACK_HEADROOM: f64 = 1.2;
/// Fastest drive backwards, to come back to a point that was overrun, metres per second.
const REVERSE_MAX_M_S: f64 = 0.15;
/// Largest error along the path that acts, metres.
const ALONG_MAX_M: f64 = 0.3;
/// Reference speed below which the integral is held, metres per second.
const INTEGRAL_SPEED_MIN_M_S: f64 = 0.05;
/// Heading feedback acts as if driving at least this fast, so that it holds at rest too.
const HEADING_SPEED_MIN_M_S: f64 = 0.15;
/// Cross-track errors smaller than this do not move θ̂, metres.
const ADAPTATION_DEAD_ZONE_M: f64 = 5.0e-4;

/// What is known about θ: a map's prior or the robot's own measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThetaKnowledge {
    /// θ = 1/K.
    pub theta: f64,
    /// Its standard deviation.
    pub std_dev: f64,
}

impl ThetaKnowledge {
    /// Weight of friction feed-forward, 0 to 1: falls with the relative deviation.
    pub fn confidence(&self) -> f64 {
        let relative = self.std_dev / self.theta;
        if self.theta > 0.0 && relative.is_finite() && relative >= 0.0 {
            1.0 / (1.0 + (3.0 * relative).powi(2))
        } else {
            0.0
        }
    }
}

/// Gains and bounds of the law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackerConfig {
    /// Along-track gain `k_x`, per second.
    pub along_gain_1_s: f64,
    /// Cross-track gain `k_y`, per metre squared.
    pub cross_gain_1_m2: f64,
    /// Heading gain `k_θ`, per metre.
    pub heading_gain_1_m: f64,
    /// Integral gain `k_I` on the cross-track error, per metre squared and second.
    pub integral_gain_1_m2_s: f64,
    /// Largest turn of the path's curvature by the integral, per metre.
    pub integral_max_1_m: f64,
    /// First-order lag of the wheel servo that is led, seconds.
    pub servo_lag_s: f64,
    /// Adaptation gain ρ.
    pub adaptation_gain: f64,
    /// Fastest change of θ̂, per second.
    pub adaptation_rate_max_1_s: f64,
    /// Pull of θ̂ to a θ that is known, per second, at full confidence.
    pub adaptation_pull_1_s: f64,
    /// Smallest θ̂.
    pub theta_min: f64,
    /// Largest θ̂.
    pub theta_max: f64,
    /// Fastest change of the feed-forward's weight, per second.
    pub confidence_rate_max_1_s: f64,
    /// Age of the pose beyond which adaptation and integral are held, seconds.
    pub pose_age_max_s: f64,
}

impl Default for TrackerConfig {
    fn default() -> Self {
        Self {
            along_gain_1_s: 3.0,
            cross_gain_1_m2: 16.0,
            heading_gain_1_m: 7.0,
            integral_gain_1_m2_s: 4.0,
            integral_max_1_m: 0.5,
            servo_lag_s: 0.05,
            adaptation_gain: 20.0,
            adaptation_rate_max_1_s: 0.1,
            adaptation_pull_1_s: 1.0,
            theta_min: 0.02,
            theta_max: 4.0,
            confidence_rate_max_1_s: 0.5,
            pose_age_max_s: 0.3,
        }
    }
}

/// Why gains were refused.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum TrackerError {
    /// A figure is NaN, infinite or out of its range.
    #[error("`{field}` is out of its range: {value}")]
    OutOfRange {
        /// The field's name.
        field: &'static str,
        /// What it held.
        value: f64,
    },
}

/// How far the robot is from its reference.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TrackingErrors {
    /// How far the reference is ahead along its path, metres.
    pub along_m: f64,
    /// How far the reference is to the left of the robot, across its path, metres.
    pub cross_m: f64,
    /// Reference heading minus the robot's, radians.
    pub heading_rad: f64,
}

impl TrackingErrors {
    /// Errors in the frame of the reference.
    pub fn between(reference: &ReferenceSample, measured: &Measured) -> Self {
        let robot = reference.pose.body_from_site(measured.pose.point());
        Self {
            along_m: -robot.x_m,
            cross_m: -robot.y_m,
            heading_rad: wrap_angle_rad(reference.pose.heading_rad - measured.pose.heading_rad),
        }
    }

    /// Distance to the reference, metres.
    pub fn distance_m(&self) -> f64 {
        self.along_m.hypot(self.cross_m)
    }
}

/// What the law gives in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TrackerOutput {
    /// Wheel speeds to command.
    pub wheel_speeds: WheelSpeeds,
    /// The twist behind them.
    pub twist: Twist,
    /// Errors in the frame of the reference.
    pub errors: TrackingErrors,
    /// θ̂ in the loop; never a measurement.
    pub theta_loop: f64,
    /// Weight of friction feed-forward, 0 to 1.
    pub confidence: f64,
    /// Whether the wheel limits cut the command.
    pub saturated: bool,
}

/// The law and its memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tracker {
    model: RobotModel,
    config: TrackerConfig,
    integral_m_s: f64,
    theta: f64,
    confidence: f64,
    was_saturated: bool,
}

impl Tracker {
    /// A law at rest, with θ̂ where it is told or at 0.2, and no confidence in it.
    ///
    /// # Errors
    /// [`TrackerError`] names a gain or bound that is out of its range.
    pub fn new(model: RobotModel, config: TrackerConfig) -> Result<Self, TrackerError> {
        let positive = [
            ("along_gain_1_s", config.along_gain_1_s),
            ("cross_gain_1_m2", config.cross_gain_1_m2),
            ("heading_gain_1_m", config.heading_gain_1_m),
            ("theta_min", config.theta_min),
            ("theta_max", config.theta_max),
            ("confidence_rate_max_1_s", config.confidence_rate_max_1_s),
            ("pose_age_max_s", config.pose_age_max_s),
        ];
        let at_least_zero = [
            ("integral_gain_1_m2_s", config.integral_gain_1_m2_s),
            ("integral_max_1_m", config.integral_max_1_m),
            ("servo_lag_s", config.servo_lag_s),
            ("adaptation_gain", config.adaptation_gain),
            ("adaptation_rate_max_1_s", config.adaptation_rate_max_1_s),
            ("adaptation_pull_1_s", config.adaptation_pull_1_s),
        ];
        for (field, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(TrackerError::OutOfRange { field, value });
            }
        }
        for (field, value) in at_least_zero {
            if !(value.is_finite() && value >= 0.0) {
                return Err(TrackerError::OutOfRange { field, value });
            }
        }
        if config.theta_max < config.theta_min {
            return Err(TrackerError::OutOfRange {
                field: "theta_max",
                value: config.theta_max,
            });
        }
        Ok(Self {
            model,
            config,
            integral_m_s: 0.0,
            theta: 0.2_f64.clamp(config.theta_min, config.theta_max),
            confidence: 0.0,
            was_saturated: false,
        })
    }

    /// Starts with what a map or an earlier run knows, at its full weight from the first metre.
    pub fn warm_start(&mut self, knowledge: ThetaKnowledge) {
        if knowledge.confidence() > 0.0 {
            self.theta = knowledge
                .theta
                .clamp(self.config.theta_min, self.config.theta_max);
            self.confidence = knowledge.confidence();
        }
    }

    /// θ̂ in the loop.
    pub fn theta_loop(&self) -> f64 {
        self.theta
    }

    /// One tick: the command for this reference from what is measured and known.
    pub fn step(
        &mut self,
        reference: &ReferenceSample,
        measured: &Measured,
        knowledge: Option<ThetaKnowledge>,
        dt_s: f64,
    ) -> TrackerOutput {
        let config = self.config;
        let wanted = knowledge.map_or(0.0, |known| known.confidence());
        let step = config.confidence_rate_max_1_s * dt_s;
        self.confidence += (wanted - self.confidence).clamp(-step, step);
        let theta = self.confidence * self.theta;

        let speed_m_s = reference.speed_m_s;
        let sideslip = Sideslip::of(reference, theta, &self.model);
        let mut course = measured.pose;
        course.heading_rad += sideslip.angle_rad;
        let ahead = course.body_from_site(reference.pose.point());
        let heading_rad = wrap_angle_rad(reference.pose.heading_rad - course.heading_rad);
        let along_m = ahead.x_m.clamp(-ALONG_MAX_M, ALONG_MAX_M);
        // Bounded so that a far-off robot comes in at a bounded angle instead of spinning.
        let cross_max_m = 0.8 * config.heading_gain_1_m / config.cross_gain_1_m2;
        let cross_m = ahead.y_m.clamp(-cross_max_m, cross_max_m);

        let held = self.was_saturated
            || measured.pose_age_s > config.pose_age_max_s
            || speed_m_s < INTEGRAL_SPEED_MIN_M_S;
        if !held {
            self.integrate(cross_m, dt_s);
            self.adapt(reference, cross_m, knowledge, dt_s);
        }

        let slip_lead_s = speed_m_s * theta / GRAVITY_M_S2;
        let yaw_shape = 4.0 * self.model.yaw_inertia_kg_m2()
            / (self.model.mass_kg()
                * (self.model.track_width_m().powi(2) + self.model.wheelbase_m().powi(2)));
        let lead_s = config.servo_lag_s + 0.5 * dt_s;
        let linear_m_s = speed_m_s * heading_rad.cos()
            + config.along_gain_1_s * along_m
            + (lead_s + slip_lead_s) * reference.acceleration_m_s2;
        let angular_rad_s = reference.turn_rad_s - sideslip.rate_rad_s
            + speed_m_s
                * (config.cross_gain_1_m2 * cross_m
                    + config.integral_gain_1_m2_s * self.integral_m_s)
            + speed_m_s.max(HEADING_SPEED_MIN_M_S) * config.heading_gain_1_m * heading_rad.sin()
            + (lead_s + slip_lead_s * yaw_shape) * reference.turn_acceleration_rad_s2;
        let twist = self.bounded(Twist {
            linear_m_s,
            angular_rad_s,
        });
        let (wheel_speeds, saturated) = desaturated(&self.model, twist);
        self.was_saturated = saturated;
        TrackerOutput {
            wheel_speeds,
            twist: self.model.twist_from_wheel_speeds(wheel_speeds),
            errors: TrackingErrors::between(reference, measured),
            theta_loop: self.theta,
            confidence: self.confidence,
            saturated,
        }
    }

    fn integrate(&mut self, cross_m: f64, dt_s: f64) {
        let gain = self.config.integral_gain_1_m2_s;
        if gain > 0.0 {
            let bound = self.config.integral_max_1_m / gain;
            self.integral_m_s = (self.integral_m_s + cross_m * dt_s).clamp(-bound, bound);
        }
    }

    /// `θ̂̇ = ρ e_y φ/(1 + φ²) + pull (θ − θ̂)`, φ = v²ω/g, bounded in rate and range.
    fn adapt(
        &mut self,
        reference: &ReferenceSample,
        cross_m: f64,
        knowledge: Option<ThetaKnowledge>,
        dt_s: f64,
    ) {
        let config = &self.config;
        let regressor = reference.speed_m_s.powi(2) * reference.turn_rad_s / GRAVITY_M_S2;
        let error_m = if cross_m.abs() < ADAPTATION_DEAD_ZONE_M {
            0.0
        } else {
            cross_m
        };
        let gradient = config.adaptation_gain * error_m * regressor / (1.0 + regressor * regressor);
        let pull = knowledge.map_or(0.0, |known| {
            config.adaptation_pull_1_s * known.confidence() * (known.theta - self.theta)
        });
        let bound = config.adaptation_rate_max_1_s;
        // The pull is a way back, not a drift: it may act faster than the gradient.
        let rate = gradient.clamp(-bound, bound) + pull;
        self.theta = (self.theta + rate * dt_s).clamp(config.theta_min, config.theta_max);
    }

    fn bounded(&self, twist: Twist) -> Twist {
        let limits = self.model.limits();
        let angular_max = FEEDBACK_HEADROOM * limits.angular_max_rad_s;
        Twist {
            linear_m_s: twist
                .linear_m_s
                .clamp(-REVERSE_MAX_M_S, FEEDBACK_HEADROOM * limits.linear_max_m_s),
            angular_rad_s: twist.angular_rad_s.clamp(-angular_max, angular_max),
        }
    }
}

/// The angle between course and heading, and its rate.
struct Sideslip {
    angle_rad: f64,
    rate_rad_s: f64,
}

impl Sideslip {
    fn of(reference: &ReferenceSample, theta: f64, model: &RobotModel) -> Self {
        // Tight turns: the inner wheels' reference speed falls, and with it the sideslip.
        let tight = 0.5 * model.effective_track_m() * reference.curvature_1_m;
        let gain = -theta / GRAVITY_M_S2 * (1.0 - tight * tight).max(0.0);
        Self {
            angle_rad: gain * reference.speed_m_s * reference.turn_rad_s,
            rate_rad_s: gain
                * (reference.acceleration_m_s2 * reference.turn_rad_s
                    + reference.speed_m_s * reference.turn_acceleration_rad_s2),
        }
    }
}

/// Wheel speeds for a twist within the wheel limit: the turn is kept, the speed gives way.
pub(crate) fn desaturated(model: &RobotModel, twist: Twist) -> (WheelSpeeds, bool) {
    let limit_rad_s = model.limits().wheel_speed_max_rad_s;
    let free = model.wheel_speeds_from_twist(twist);
    if free.magnitude_max_rad_s() <= limit_rad_s {
        return (free, false);
    }
    let middle = 0.5 * (free.left_rad_s + free.right_rad_s);
    let half = 0.5 * (free.right_rad_s - free.left_rad_s);
    let half = half.clamp(-limit_rad_s, limit_rad_s);
    let room = limit_rad_s - half.abs();
    let middle = middle.clamp(-room, room);
    (
        WheelSpeeds {
            left_rad_s: middle - half,
            right_rad_s: middle + half,
        },
        true,
    )
}
