//! Gate: last stage before the wheels, which can only reduce a command.
//!
//! These reasons require zero speed: a stop, stale feedback of the base, a lost position,
//! contradicting sensors, too much tilt, an external hold, a silent server or driver, a slow
//! control loop, or a command that is missing or not finite. Speed limits and caps scale both sides
//! by the same factor, which keeps the curvature. In every tick and for every cause, speeding up
//! stays within the limits of the commanded twist and of the wheels ([`crate::twist_limits`]), and
//! nothing speeds up while feedback of the base is late. Slowing down for a reason is bounded by
//! the braking limit and keeps the curvature until the robot has stopped. The strictest cause is
//! reported: the last in the order of [`GateCause`]; of several caps only the lowest counts.

pub mod teleoperation;

use crate::measured::WheelSpeeds;
use crate::robot::RobotModel;
use crate::twist_limits::{Change, Slowing, TwistLimits};

/// Cause of a reduced command; later ones are stricter.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum GateCause {
    /// The command changed faster than the acceleration limits of robot or wheels.
    Acceleration,
    /// The command was above a speed limit: along the path, in yaw, or of a wheel.
    Speed,
    /// Teleoperation commands arrive late, which lowers the speed limit.
    CommandAge,
    /// External speed limit.
    ExternalLimit,
    /// Speed limit of a fence that is near or has been crossed.
    Fence,
    /// The command, the previous command or the time step was not finite.
    NotFinite,
    /// There was no command.
    NoCommand,
    /// The teleoperating driver is silent.
    Lease,
    /// The server has been silent for longer than the mission allows.
    LinkPolicy,
    /// External hold.
    ExternalHold,
    /// The control loop is slower than its rate.
    LoopOverrun,
    /// Sensors contradict each other.
    SensorFault,
    /// The position of the robot is lost.
    StalePosition,
    /// The tilt of the robot is above its limit.
    Tilt,
    /// The feedback of the base is too old.
    StaleFeedback,
    /// A stop is in force.
    Stop,
}

impl GateCause {
    /// All causes, from the least to the most strict.
    pub const ALL: [Self; 16] = [
        Self::Acceleration,
        Self::Speed,
        Self::CommandAge,
        Self::ExternalLimit,
        Self::Fence,
        Self::NotFinite,
        Self::NoCommand,
        Self::Lease,
        Self::LinkPolicy,
        Self::ExternalHold,
        Self::LoopOverrun,
        Self::SensorFault,
        Self::StalePosition,
        Self::Tilt,
        Self::StaleFeedback,
        Self::Stop,
    ];
}

/// Reasons outside the command that may reduce it; none by default.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each says whether one independent reason holds"
)]
pub struct Reasons {
    /// Whether a stop is latched.
    pub is_stopped: bool,
    /// Tilt of the robot from level, radians; None if the base does not measure it. NaN counts as
    /// too much tilt.
    pub tilt_rad: Option<f64>,
    /// Whether the robot needs its position and has lost it.
    pub is_position_lost: bool,
    /// Whether the control loop is slower than its rate.
    pub is_loop_late: bool,
    /// Whether a sensor needed for driving is wrong.
    pub is_sensor_wrong: bool,
    /// Whether an external program holds the robot.
    pub is_held_outside: bool,
    /// Whether the server has been silent for longer than the mission allows.
    pub is_link_silent: bool,
    /// Whether the teleoperating driver is silent.
    pub is_driver_silent: bool,
    /// Maximum speed that keeps the robot inside its fence, metres per second.
    pub fence_max_m_s: Option<f64>,
    /// Maximum speed set by an external program, metres per second.
    pub outside_max_m_s: Option<f64>,
    /// Maximum speed because teleoperation commands arrive late, metres per second; `None` without
    /// a limit.
    pub command_age_max_m_s: Option<f64>,
    /// Maximum speed of a robot without a position, metres per second.
    pub blind_max_m_s: Option<f64>,
    /// Maximum speed of a robot whose sensors contradict each other, metres per second.
    pub sensors_max_m_s: Option<f64>,
    /// Measured speed along the path, metres per second; None if unknown. While the robot stops,
    /// its wheels do not turn faster than this speed, as far as their acceleration limit allows.
    pub real_m_s: Option<f64>,
}

impl Reasons {
    /// Returns the strictest cause that requires zero speed, or None.
    fn hold(&self, limits: &GateLimits) -> Option<GateCause> {
        let is_tilted = self
            .tilt_rad
            .is_some_and(|tilt_rad| tilt_rad.is_nan() || tilt_rad.abs() > limits.tilt_max_rad);
        [
            (self.is_stopped, GateCause::Stop),
            (is_tilted, GateCause::Tilt),
            (self.is_position_lost, GateCause::StalePosition),
            (self.is_sensor_wrong, GateCause::SensorFault),
            (self.is_loop_late, GateCause::LoopOverrun),
            (self.is_held_outside, GateCause::ExternalHold),
            (self.is_link_silent, GateCause::LinkPolicy),
            (self.is_driver_silent, GateCause::Lease),
        ]
        .into_iter()
        .find_map(|(holds, cause)| holds.then_some(cause))
    }

    /// Returns the lowest speed cap and its cause, or None; of equal caps the stricter cause.
    fn cap(&self) -> Option<(f64, GateCause)> {
        [
            (self.blind_max_m_s, GateCause::StalePosition),
            (self.sensors_max_m_s, GateCause::SensorFault),
            (self.fence_max_m_s, GateCause::Fence),
            (self.outside_max_m_s, GateCause::ExternalLimit),
            (self.command_age_max_m_s, GateCause::CommandAge),
        ]
        .into_iter()
        // NaN and negative caps count as 0.
        .filter_map(|(most_m_s, cause)| {
            let most_m_s = most_m_s?;
            let is_number = !most_m_s.is_nan();
            Some((if is_number { most_m_s.max(0.0) } else { 0.0 }, cause))
        })
        .reduce(|lowest, cap| if cap.0 < lowest.0 { cap } else { lowest })
    }
}

/// Limits that the gate enforces.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateLimits {
    model: RobotModel,
    /// Maximum angular speed of a wheel, radians per second.
    pub wheel_speed_max_rad_s: f64,
    /// Maximum angular acceleration of a wheel, radians per second squared.
    pub wheel_acceleration_max_rad_s2: f64,
    /// Maximum deceleration of the robot's centre while it stops, as angular acceleration of a
    /// wheel, radians per second squared.
    pub wheel_braking_max_rad_s2: f64,
    /// Maximum age of the base's feedback, seconds; older feedback stops the robot.
    pub feedback_age_max_s: f64,
    /// Maximum tilt from level, radians; more stops the robot.
    pub tilt_max_rad: f64,
    /// Rolling radius of a wheel, metres.
    pub wheel_radius_m: f64,
}

/// Default of the maximum tilt from level, radians: 25 degrees.
pub const TILT_MAX_RAD: f64 = 0.436;

/// Duration assumed for a tick whose time step is invalid, seconds.
const TICK_USUAL_S: f64 = 0.01;
/// Fraction of the maximum feedback age above which nothing speeds up, because the command for a
/// silent base is based on its predicted motion.
const LATE_SHARE: f64 = 0.5;
/// Relative excess over a speed limit that counts as rounding.
const ROUNDING_SHARE: f64 = 1.0e-9;
/// Wheel speed at the rim below which slip is not evaluated, metres per second.
const SLIP_LEAST_M_S: f64 = 0.01;

impl GateLimits {
    /// Returns the limits of a robot, with defaults for tilt and feedback age. Its braking along
    /// the path is at most twice its planned deceleration, so that a turn can be ended at the same
    /// time.
    pub fn of(model: &RobotModel) -> Self {
        let limits = model.limits();
        let braking = 2.0 * limits.linear_acceleration_max_m_s2 / model.wheel_radius_m();
        Self {
            model: *model,
            wheel_speed_max_rad_s: limits.wheel_speed_max_rad_s,
            wheel_acceleration_max_rad_s2: limits.wheel_acceleration_max_rad_s2,
            wheel_braking_max_rad_s2: braking.min(limits.wheel_acceleration_max_rad_s2),
            feedback_age_max_s: 0.2,
            tilt_max_rad: TILT_MAX_RAD,
            wheel_radius_m: model.wheel_radius_m(),
        }
    }
}

/// Input of the gate in one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateInput {
    /// Commanded wheel speeds; None requires zero speed.
    pub command: Option<WheelSpeeds>,
    /// Last output of the gate.
    pub previous: WheelSpeeds,
    /// Whether a stop is in force.
    pub stop: bool,
    /// Age of the last feedback of the base, seconds.
    pub feedback_age_s: f64,
    /// Time since the last output of the gate, seconds.
    pub dt_s: f64,
}

/// Output of the gate in one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateOutput {
    /// Wheel speeds to command to the base: `target`, as far as the acceleration limits allow.
    pub wheel_speeds: WheelSpeeds,
    /// Wheel speeds after all reductions but those of the acceleration limits.
    pub target: WheelSpeeds,
    /// Strictest cause of a reduction; None if the command passed unchanged.
    pub cause: Option<GateCause>,
}

/// Reduces a command for the reasons in the input alone, see [`gate_with`].
pub fn gate(input: &GateInput, limits: &GateLimits) -> GateOutput {
    gate_with(input, &Reasons::default(), limits)
}

/// Reduces a command for the reasons in the input and in `reasons`, within the limits.
pub fn gate_with(input: &GateInput, reasons: &Reasons, limits: &GateLimits) -> GateOutput {
    let mut cause: Option<GateCause> = None;
    let mut record = |new: GateCause| cause = cause.max(Some(new));
    let rest = WheelSpeeds::default();
    let mut target = match input.command {
        None => {
            record(GateCause::NoCommand);
            rest
        }
        Some(command) if !command.is_finite() => {
            record(GateCause::NotFinite);
            rest
        }
        Some(command) => command,
    };
    // Without a valid time step nothing speeds up; stopping assumes a tick of usual duration.
    let dt_s = if input.dt_s.is_finite() && input.dt_s >= 0.0 {
        input.dt_s
    } else {
        record(GateCause::NotFinite);
        target = rest;
        TICK_USUAL_S
    };
    let previous = if input.previous.is_finite() {
        input.previous
    } else {
        record(GateCause::NotFinite);
        target = rest;
        rest
    };
    let is_fresh =
        input.feedback_age_s.is_finite() && input.feedback_age_s <= limits.feedback_age_max_s;
    let hold = if input.stop {
        Some(GateCause::Stop)
    } else {
        let stale = (!is_fresh).then_some(GateCause::StaleFeedback);
        stale.max(reasons.hold(limits))
    };
    if let Some(hold) = hold {
        record(hold);
        target = rest;
    }
    let share =
        TwistLimits::of(&limits.model).share_within(limits.model.twist_from_wheel_speeds(target));
    if share < 1.0 {
        // Rounding between wheel speeds and twists is not reported.
        if share < 1.0 - ROUNDING_SHARE {
            record(GateCause::Speed);
        }
        target = scaled(target, share);
    }
    let mut is_capped = false;
    if let Some((most_m_s, capped_by)) = reasons.cap() {
        let forward_m_s =
            0.5 * limits.wheel_radius_m * (target.left_rad_s + target.right_rad_s).abs();
        if forward_m_s > most_m_s {
            record(capped_by);
            is_capped = true;
            target = scaled(target, most_m_s / forward_m_s);
        }
    }
    if input.feedback_age_s > LATE_SHARE * limits.feedback_age_max_s {
        let model = &limits.model;
        let change = Change {
            from: previous,
            to: target,
        }
        .map(|wheels| model.twist_from_wheel_speeds(wheels));
        let steady = teleoperation::no_faster(change);
        if steady != change.to {
            target = model.wheel_speeds_from_twist(steady);
            record(GateCause::Acceleration);
        }
    }
    let step = Step {
        dt_s,
        is_capped,
        real_m_s: reasons.real_m_s,
    };
    let change = Change {
        from: previous,
        to: target,
    };
    let wheel_speeds = ramped(change, step, limits);
    let is_short = |limited: f64, requested: f64| (limited - requested).abs() > 1.0e-9;
    if is_short(wheel_speeds.left_rad_s, target.left_rad_s)
        || is_short(wheel_speeds.right_rad_s, target.right_rad_s)
    {
        record(GateCause::Acceleration);
    }
    GateOutput {
        wheel_speeds,
        target,
        cause,
    }
}

/// Returns the fraction of both sides' speeds that a tick removes while the robot stops.
///
/// The centre decelerates at the braking limit, also in a turn, where one side must decelerate
/// faster than the centre: by at most twice the limit.
fn stopping_share(previous: WheelSpeeds, step: Step, limits: &GateLimits) -> f64 {
    let up = limits.wheel_acceleration_max_rad_s2 * step.dt_s;
    let braking = limits.wheel_braking_max_rad_s2 * step.dt_s;
    let fastest_rad_s = previous.magnitude_max_rad_s();
    let centre_rad_s = 0.5 * (previous.left_rad_s + previous.right_rad_s).abs();
    if fastest_rad_s <= braking {
        return 1.0;
    }
    let by_fastest = braking / fastest_rad_s;
    (braking / centre_rad_s)
        .clamp(by_fastest, 2.0 * by_fastest)
        .min((up / fastest_rad_s).max(by_fastest))
        .min(1.0)
}

/// Returns the fraction of the wheels' speed by which it exceeds the robot's measured speed, at
/// most what they may change in a tick. Without this reduction a robot that gains speed by slip
/// would be accelerated while it brakes.
fn slip_share(previous: WheelSpeeds, step: Step, limits: &GateLimits) -> f64 {
    let up = limits.wheel_acceleration_max_rad_s2 * step.dt_s;
    let centre_m_s = 0.5 * limits.wheel_radius_m * (previous.left_rad_s + previous.right_rad_s);
    let Some(real_m_s) = step.real_m_s.filter(|real_m_s| real_m_s.is_finite()) else {
        return 0.0;
    };
    if centre_m_s.abs() < SLIP_LEAST_M_S {
        return 0.0;
    }
    let forward = 1.0 - (real_m_s / centre_m_s).max(0.0);
    forward
        .min(up / previous.magnitude_max_rad_s())
        .clamp(0.0, 1.0)
}

/// Parameters of one tick of the ramp.
#[derive(Debug, Clone, Copy)]
struct Step {
    dt_s: f64,
    is_capped: bool,
    real_m_s: Option<f64>,
}

fn scaled(speeds: WheelSpeeds, share: f64) -> WheelSpeeds {
    WheelSpeeds {
        left_rad_s: speeds.left_rad_s * share,
        right_rad_s: speeds.right_rad_s * share,
    }
}

/// Returns the wheel speeds after one tick of a change.
///
/// A nonzero target is approached within the limits of the twist, and slowing down within the
/// wheels' limit, or within the braking limit along the path if a cap applies. For a zero target
/// both sides are reduced by the same fraction, so that the robot stays on its arc.
fn ramped(change: Change<WheelSpeeds>, step: Step, limits: &GateLimits) -> WheelSpeeds {
    if change.to == WheelSpeeds::default() {
        let share = stopping_share(change.from, step, limits);
        let slip = slip_share(change.from, step, limits);
        return scaled(change.from, 1.0 - share.max(slip));
    }
    let twist_limits = TwistLimits::of(&limits.model);
    let by_wheels = twist_limits.slowing_by_wheels();
    let slowing = if step.is_capped {
        Slowing {
            linear_m_s2: limits.wheel_braking_max_rad_s2 * limits.wheel_radius_m,
            ..by_wheels
        }
    } else {
        by_wheels
    };
    let model = &limits.model;
    let twists = change.map(|wheels| model.twist_from_wheel_speeds(wheels));
    let next = twist_limits.step(twists, slowing, step.dt_s);
    if next == twists.to {
        // Returned as it is: conversion to a twist and back would round it.
        return change.to;
    }
    model.wheel_speeds_from_twist(next)
}

#[cfg(test)]
mod tests;
