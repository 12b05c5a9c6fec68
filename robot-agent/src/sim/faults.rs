//! Faults of a simulated base: channels that freeze, change sign, scale, have an offset or jump,
//! wheels that lock, and a base that ignores its commands.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use tread_control::geometry::Pose;
use tread_control::measured::{BodyAcceleration, WheelSpeeds};

use crate::drive::SensorSample;

/// Largest number of faults of one robot.
pub const FAULTS_MAX: usize = 16;
/// Latest begin and end of a fault, seconds.
pub const FAULT_AFTER_MAX_S: f64 = 1.0e6;
/// Largest factor, offset or jump of a fault.
pub const FAULT_BY_MAX: f64 = 1.0e3;

/// Kind of a fault.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum FaultKind {
    /// A channel repeats its last value, with new stamps.
    Frozen {
        /// The channel.
        channel: Channel,
    },
    /// A channel has the opposite sign.
    Inverted {
        /// The channel.
        channel: Channel,
    },
    /// A channel is scaled.
    Scaled {
        /// The channel.
        channel: Channel,
        /// The factor.
        factor: f64,
    },
    /// A channel has a constant offset.
    Biased {
        /// The channel.
        channel: Channel,
        /// The offset, in the channel's unit.
        by: f64,
    },
    /// The position jumps along the site's x axis.
    PositionJumped {
        /// The jump, metres.
        by_m: f64,
    },
    /// The position is rotated about the site's origin by a quarter turn.
    PositionRotated,
    /// The odometry's speed is the component along the site's x axis.
    OdometryInWorldFrame,
    /// The left wheels do not turn, whatever is commanded.
    LeftWheelsLocked,
    /// The base keeps the command that it had when the fault began.
    IgnoresCommands,
}

/// A channel of the base.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Channel {
    /// The gyro.
    Gyro,
    /// Both sides' wheel speeds.
    Wheels,
    /// The accelerometer.
    Accelerometer,
    /// The speed of the body over ground.
    Odometry,
    /// The position fixes.
    Position,
    /// All channels.
    All,
}

/// A fault and its time span.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Fault {
    /// Begin, seconds of the robot's clock since its agent's start.
    pub after_s: f64,
    /// End, seconds of the robot's clock; `None` for no end.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until_s: Option<f64>,
    /// Kind of the fault.
    #[serde(flatten)]
    pub kind: FaultKind,
}

impl Fault {
    /// Checks the values.
    ///
    /// # Errors
    /// A sentence that names the value.
    pub fn check(&self) -> Result<(), String> {
        let until_s = self.until_s.unwrap_or(FAULT_AFTER_MAX_S);
        let is_span = (0.0..=FAULT_AFTER_MAX_S).contains(&self.after_s)
            && (self.after_s..=FAULT_AFTER_MAX_S).contains(&until_s);
        if !is_span {
            return Err(format!(
                "faults: after_s and until_s must be 0 to {FAULT_AFTER_MAX_S} and in order, not {} and {until_s}",
                self.after_s
            ));
        }
        let by = match self.kind {
            FaultKind::Scaled { factor, .. } => factor,
            FaultKind::Biased { by, .. } => by,
            FaultKind::PositionJumped { by_m } => by_m,
            FaultKind::Frozen { .. }
            | FaultKind::Inverted { .. }
            | FaultKind::PositionRotated
            | FaultKind::OdometryInWorldFrame
            | FaultKind::LeftWheelsLocked
            | FaultKind::IgnoresCommands => 0.0,
        };
        if by.abs() > FAULT_BY_MAX || by.is_nan() {
            return Err(format!(
                "faults: a factor or offset must be at most {FAULT_BY_MAX}, not {by}"
            ));
        }
        Ok(())
    }

    fn is_on(&self, at: Duration) -> bool {
        let at_s = at.as_secs_f64();
        at_s >= self.after_s && self.until_s.is_none_or(|until_s| at_s < until_s)
    }
}

/// The faults of one base.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Faults {
    list: Vec<Fault>,
    /// Last value of each channel before it froze.
    held: SensorSample,
    /// Last command that was executed.
    obeyed: WheelSpeeds,
}

impl Faults {
    /// Creates the state of these faults.
    pub fn new(list: Vec<Fault>) -> Self {
        Self {
            list,
            ..Self::default()
        }
    }

    /// Returns the command that the wheels execute instead of `command`.
    pub fn command(&mut self, at: Duration, command: WheelSpeeds) -> WheelSpeeds {
        let is_on = |kind: FaultKind| {
            let mut faults = self.list.iter();
            faults.any(|fault| fault.kind == kind && fault.is_on(at))
        };
        if !is_on(FaultKind::IgnoresCommands) {
            self.obeyed = command;
        }
        let mut command = self.obeyed;
        if is_on(FaultKind::LeftWheelsLocked) {
            command.left_rad_s = 0.0;
        }
        command
    }

    /// Returns the sample with the active faults applied.
    pub fn sample(&mut self, mut sample: SensorSample, heading_rad: f64) -> SensorSample {
        let at = sample.at;
        let mut frozen = [false; 5];
        for fault in self.list.iter().filter(|fault| fault.is_on(at)) {
            match fault.kind {
                FaultKind::Frozen { channel } => {
                    for (one, is_frozen) in CHANNELS.into_iter().zip(&mut frozen) {
                        if channel == one || channel == Channel::All {
                            freeze(&mut sample, one, &self.held);
                            *is_frozen = true;
                        }
                    }
                }
                FaultKind::Inverted { channel } => change(&mut sample, channel, |value| -value),
                FaultKind::Scaled { channel, factor } => {
                    change(&mut sample, channel, |value| factor * value);
                }
                FaultKind::Biased { channel, by } => {
                    change(&mut sample, channel, |value| value + by);
                }
                FaultKind::PositionJumped { by_m } => {
                    if let Some(pose) = &mut sample.position {
                        pose.x_m += by_m;
                    }
                }
                FaultKind::PositionRotated => {
                    sample.position = sample.position.map(|pose| Pose {
                        x_m: -pose.y_m,
                        y_m: pose.x_m,
                        heading_rad: pose.heading_rad + std::f64::consts::FRAC_PI_2,
                    });
                }
                FaultKind::OdometryInWorldFrame => {
                    let cos = heading_rad.cos();
                    sample.body_speed_m_s = sample.body_speed_m_s.map(|speed_m_s| cos * speed_m_s);
                }
                FaultKind::LeftWheelsLocked | FaultKind::IgnoresCommands => {}
            }
        }
        self.remember(&sample, frozen);
        sample
    }

    fn remember(&mut self, sample: &SensorSample, frozen: [bool; 5]) {
        let held = &mut self.held;
        for (channel, is_frozen) in CHANNELS.into_iter().zip(frozen) {
            if is_frozen {
                continue;
            }
            match channel {
                Channel::Gyro => {
                    held.yaw_rate_rad_s = sample.yaw_rate_rad_s.or(held.yaw_rate_rad_s);
                }
                Channel::Wheels => held.wheel_speeds = sample.wheel_speeds.or(held.wheel_speeds),
                Channel::Accelerometer => {
                    held.acceleration = sample.acceleration.or(held.acceleration);
                }
                Channel::Odometry => {
                    held.body_speed_m_s = sample.body_speed_m_s.or(held.body_speed_m_s);
                }
                Channel::Position => held.position = sample.position.or(held.position),
                Channel::All => {}
            }
        }
    }
}

/// The channels except [`Channel::All`].
const CHANNELS: [Channel; 5] = [
    Channel::Gyro,
    Channel::Wheels,
    Channel::Accelerometer,
    Channel::Odometry,
    Channel::Position,
];

/// Replaces the channel's value, if present, by the held one.
fn freeze(sample: &mut SensorSample, channel: Channel, held: &SensorSample) {
    match channel {
        Channel::Gyro => sample.yaw_rate_rad_s = sample.yaw_rate_rad_s.and(held.yaw_rate_rad_s),
        Channel::Wheels => sample.wheel_speeds = sample.wheel_speeds.and(held.wheel_speeds),
        Channel::Accelerometer => sample.acceleration = sample.acceleration.and(held.acceleration),
        Channel::Odometry => sample.body_speed_m_s = sample.body_speed_m_s.and(held.body_speed_m_s),
        Channel::Position => sample.position = sample.position.and(held.position),
        Channel::All => {}
    }
}

/// Applies a function to every value of the channel.
fn change(sample: &mut SensorSample, channel: Channel, to: impl Fn(f64) -> f64) {
    let is = |one: Channel| channel == one || channel == Channel::All;
    if is(Channel::Gyro) {
        sample.yaw_rate_rad_s = sample.yaw_rate_rad_s.map(&to);
    }
    if is(Channel::Wheels) {
        sample.wheel_speeds = sample.wheel_speeds.map(|wheels| WheelSpeeds {
            left_rad_s: to(wheels.left_rad_s),
            right_rad_s: to(wheels.right_rad_s),
        });
    }
    if is(Channel::Accelerometer) {
        sample.acceleration = sample.acceleration.map(|felt| BodyAcceleration {
            forward_m_s2: to(felt.forward_m_s2),
            left_m_s2: to(felt.left_m_s2),
        });
    }
    if is(Channel::Odometry) {
        sample.body_speed_m_s = sample.body_speed_m_s.map(&to);
    }
    if is(Channel::Position) {
        sample.position = sample.position.map(|pose| Pose {
            x_m: to(pose.x_m),
            y_m: to(pose.y_m),
            heading_rad: pose.heading_rad,
        });
    }
}
