//! The last word before the wheels: it can only reduce a command.
//!
//! A stop, a stale base, a lost position, sensors that
//! contradict each other, a lean, a hold from outside, silence of whoever must be
//! heard, or a command that is not finite asks for rest; limits and caps of the speed cut what is
//! left, both sides by the same share, so that a cut command bends the same way. The limits are
//! those of the commanded twist and of the wheels ([`crate::twist_limits`]): in every tick and
//! for every cause, speeding up stays within the acceleration limits, and while the base's word is
//! late nothing speeds up. Slowing down for a reason is
//! bounded by the braking limit: rest is met on a ramp, along the arc that was being driven. The
//! strictest cause is reported: the order of [`GateCause`], and of several caps the lowest one.

pub mod teleoperation;

use crate::measured::WheelSpeeds;
use crate::robot::RobotModel;
use crate::twist_limits::{Slowing, TwistLimits};

/// Why a command was reduced; later ones are stricter.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum GateCause {
    /// The command changed faster than the robot or its wheels may.
    Acceleration,
    /// The command was above a speed limit: along the path, in yaw, or of a wheel.
    Speed,
    /// Teleoperation commands arrive late: the slower the link, the slower the robot.
    CommandAge,
    /// A limit from outside.
    ExternalLimit,
    /// A fence is near, or has been crossed.
    Fence,
    /// The command was not a number.
    NotFinite,
    /// There was no command.
    NoCommand,
    /// Whoever teleoperates is silent.
    Lease,
    /// The server has been silent for longer than the mission allows.
    LinkPolicy,
    /// A hold from outside.
    ExternalHold,
    /// The control loop does not keep its rate.
    LoopOverrun,
    /// Sensors contradict each other.
    SensorFault,
    /// The robot does not know where it is.
    StalePosition,
    /// The robot leans too far.
    Tilt,
    /// The base has not been heard for too long.
    StaleFeedback,
    /// A stop is in force.
    Stop,
}

impl GateCause {
    /// Every cause, in order.
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

/// Everything outside the command that may reduce it; by default nothing does.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each says whether one independent reason holds"
)]
pub struct Reasons {
    /// A stop is latched.
    pub is_stopped: bool,
    /// How far the robot leans from level, radians, if the base measures it. What is not a number
    /// holds like a lean that is too far.
    pub tilt_rad: Option<f64>,
    /// The robot must know where it is, and does not.
    pub is_position_lost: bool,
    /// The control loop does not keep its rate.
    pub is_loop_late: bool,
    /// A sensor that the robot drives by is wrong.
    pub is_sensor_wrong: bool,
    /// Somebody outside holds the robot.
    pub is_held_outside: bool,
    /// The server has been silent for longer than it may.
    pub is_link_silent: bool,
    /// Whoever teleoperates is silent.
    pub is_driver_silent: bool,
    /// Fastest speed that keeps the robot inside its fence, metres per second.
    pub fence_max_m_s: Option<f64>,
    /// Fastest speed that somebody outside allows, metres per second.
    pub outside_max_m_s: Option<f64>,
    /// Fastest speed that the age of teleoperation commands allows, metres per second.
    pub command_age_max_m_s: Option<f64>,
    /// Fastest speed of a robot that does not know where it is, metres per second.
    pub blind_max_m_s: Option<f64>,
    /// Fastest speed of a robot whose sensors contradict each other, metres per second.
    pub sensors_max_m_s: Option<f64>,
    /// How fast the robot really goes along its path, metres per second, if that is known. While it
    /// comes to rest its wheels do not pull it on to a speed that it does not have yet.
    pub real_m_s: Option<f64>,
}

impl Reasons {
    /// The strictest reason for rest, if there is one.
    fn hold(&self, limits: &GateLimits) -> Option<GateCause> {
        let leans = self
            .tilt_rad
            .is_some_and(|tilt_rad| tilt_rad.is_nan() || tilt_rad.abs() > limits.tilt_max_rad);
        [
            (self.is_stopped, GateCause::Stop),
            (leans, GateCause::Tilt),
            (self.is_position_lost, GateCause::StalePosition),
            (self.is_sensor_wrong, GateCause::SensorFault),
            (self.is_loop_late, GateCause::LoopOverrun),
            (self.is_held_outside, GateCause::ExternalHold),
            (self.is_link_silent, GateCause::LinkPolicy),
            (self.is_driver_silent, GateCause::Lease),
        ]
        .into_iter()
        .find_map(|(is_so, cause)| is_so.then_some(cause))
    }

    /// The lowest of the speeds that may be driven, and its cause; the stricter one of equals.
    fn cap(&self) -> Option<(f64, GateCause)> {
        [
            (self.blind_max_m_s, GateCause::StalePosition),
            (self.sensors_max_m_s, GateCause::SensorFault),
            (self.fence_max_m_s, GateCause::Fence),
            (self.outside_max_m_s, GateCause::ExternalLimit),
            (self.command_age_max_m_s, GateCause::CommandAge),
        ]
        .into_iter()
        // A cap that is no number is no permission.
        .filter_map(|(most_m_s, cause)| {
            let most_m_s = most_m_s?;
            let is_number = !most_m_s.is_nan();
            Some((if is_number { most_m_s.max(0.0) } else { 0.0 }, cause))
        })
        .reduce(|lowest, cap| if cap.0 < lowest.0 { cap } else { lowest })
    }
}

/// Bounds of the gate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateLimits {
    model: RobotModel,
    /// Fastest wheel, radians per second.
    pub wheel_speed_max_rad_s: f64,
    /// Fastest change of a wheel's speed, radians per second squared.
    pub wheel_acceleration_max_rad_s2: f64,
    /// Fastest slowing down of the robot's centre while it comes to rest, as a wheel's, radians per
    /// second squared.
    pub wheel_braking_max_rad_s2: f64,
    /// Oldest feedback of the base that is trusted, seconds.
    pub feedback_age_max_s: f64,
    /// Farthest that the robot may lean from level, radians.
    pub tilt_max_rad: f64,
    /// Rolling radius of a wheel, metres.
    pub wheel_radius_m: f64,
}

/// Farthest that a robot may lean from level unless said otherwise, radians: 25 degrees.
pub const TILT_MAX_RAD: f64 = 0.436;

/// Time that a tick without one is taken to have lasted, seconds.
const TICK_USUAL_S: f64 = 0.01;
/// Share of the oldest feedback that is trusted beyond which nothing speeds up: what is wanted for
/// a base that falls silent is predicted from where it was.
const LATE_SHARE: f64 = 0.5;
/// Share above a speed limit that is rounding.
const ROUNDING_SHARE: f64 = 1.0e-9;
/// Speed below which a robot's slip says nothing, metres per second.
const SLIP_LEAST_M_S: f64 = 0.01;

impl GateLimits {
    /// Limits of a robot; it brakes no harder along the path than twice its planned braking, so
    /// that a turn can be undone at the same time.
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

/// What the gate looks at in one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateInput {
    /// What is wanted; none asks for rest.
    pub command: Option<WheelSpeeds>,
    /// What the gate let through last.
    pub previous: WheelSpeeds,
    /// Whether a stop is in force.
    pub stop: bool,
    /// Age of the last word from the base, seconds.
    pub feedback_age_s: f64,
    /// Time since the gate's last word, seconds.
    pub dt_s: f64,
}

/// What the gate lets through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GateOutput {
    /// Wheel speeds for the base.
    pub wheel_speeds: WheelSpeeds,
    /// What they are on the ramp to.
    pub target: WheelSpeeds,
    /// The strictest cause of a reduction; none when the command passed whole.
    pub cause: Option<GateCause>,
}

/// Lets a command through, reduced where it must be, for no reason but those of the input.
pub fn gate(input: &GateInput, limits: &GateLimits) -> GateOutput {
    gate_with(input, &Reasons::default(), limits)
}

/// Lets a command through, reduced where it must be.
pub fn gate_with(input: &GateInput, reasons: &Reasons, limits: &GateLimits) -> GateOutput {
    let mut cause: Option<GateCause> = None;
    let mut note = |new: GateCause| cause = cause.max(Some(new));
    let rest = WheelSpeeds::default();
    let mut target = match input.command {
        None => {
            note(GateCause::NoCommand);
            rest
        }
        Some(command) if !command.is_finite() => {
            note(GateCause::NotFinite);
            rest
        }
        Some(command) => command,
    };
    // Without a time there is no ramp up; rest is met as if a usual tick had passed.
    let dt_s = if input.dt_s.is_finite() && input.dt_s >= 0.0 {
        input.dt_s
    } else {
        note(GateCause::NotFinite);
        target = rest;
        TICK_USUAL_S
    };
    let previous = if input.previous.is_finite() {
        input.previous
    } else {
        note(GateCause::NotFinite);
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
        note(hold);
        target = rest;
    }
    let share =
        TwistLimits::of(&limits.model).share_within(limits.model.twist_from_wheel_speeds(target));
    if share < 1.0 {
        // Rounding between wheel speeds and twists is no reason to report.
        if share < 1.0 - ROUNDING_SHARE {
            note(GateCause::Speed);
        }
        target = scaled(target, share);
    }
    let mut is_capped = false;
    if let Some((most_m_s, capped_by)) = reasons.cap() {
        let forward_m_s =
            0.5 * limits.wheel_radius_m * (target.left_rad_s + target.right_rad_s).abs();
        if forward_m_s > most_m_s {
            note(capped_by);
            is_capped = true;
            target = scaled(target, most_m_s / forward_m_s);
        }
    }
    if input.feedback_age_s > LATE_SHARE * limits.feedback_age_max_s {
        let model = &limits.model;
        let twist = |wheels: WheelSpeeds| model.twist_from_wheel_speeds(wheels);
        let steady = teleoperation::no_faster(twist(previous), twist(target));
        if steady != twist(target) {
            target = model.wheel_speeds_from_twist(steady);
            note(GateCause::Acceleration);
        }
    }
    let step = Step {
        dt_s,
        is_capped,
        real_m_s: reasons.real_m_s,
    };
    let wheel_speeds = ramped(previous, target, step, limits);
    let is_short = |got: f64, wanted: f64| (got - wanted).abs() > 1.0e-9;
    if is_short(wheel_speeds.left_rad_s, target.left_rad_s)
        || is_short(wheel_speeds.right_rad_s, target.right_rad_s)
    {
        note(GateCause::Acceleration);
    }
    GateOutput {
        wheel_speeds,
        target,
        cause,
    }
}

/// The share of both sides' speeds that a tick takes away while the robot comes to rest.
///
/// The centre slows down at the braking limit, also in a turn, where one side must slow down faster
/// for it: by twice the limit at the most.
fn rest_share(previous: WheelSpeeds, braking: f64, up: f64) -> f64 {
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

/// The share of both sides' speeds by which the wheels are ahead of the robot, as far as they may
/// change in a tick: a robot that still gains speed by slip would be pulled on while they brake.
fn slip_share(previous: WheelSpeeds, real_m_s: Option<f64>, radius_m: f64, up: f64) -> f64 {
    let centre_m_s = 0.5 * radius_m * (previous.left_rad_s + previous.right_rad_s);
    let Some(real_m_s) = real_m_s.filter(|real_m_s| real_m_s.is_finite()) else {
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

/// What a tick of the ramp depends on beside the speeds.
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

/// From `previous` towards `target` as far as `dt_s` allows.
///
/// While the command stands, it speeds up within the limits of the twist and slows down as the
/// wheels may; where a cap cuts, the braking ramp holds along the path. Rest is met by both sides
/// at once, so that the robot stays on its arc.
fn ramped(
    previous: WheelSpeeds,
    target: WheelSpeeds,
    step: Step,
    limits: &GateLimits,
) -> WheelSpeeds {
    let up = limits.wheel_acceleration_max_rad_s2 * step.dt_s;
    let braking = limits.wheel_braking_max_rad_s2 * step.dt_s;
    if target == WheelSpeeds::default() {
        let share = rest_share(previous, braking, up);
        let slip = slip_share(previous, step.real_m_s, limits.wheel_radius_m, up);
        return scaled(previous, 1.0 - share.max(slip));
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
    let from = model.twist_from_wheel_speeds(previous);
    let to = model.twist_from_wheel_speeds(target);
    let next = twist_limits.step(from, to, slowing, step.dt_s);
    if next == to {
        // Not through the twist and back: a command that passes whole passes to the bit.
        return target;
    }
    model.wheel_speeds_from_twist(next)
}

#[cfg(test)]
mod tests;
