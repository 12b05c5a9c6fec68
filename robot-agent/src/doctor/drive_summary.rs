//! Summarises the commands and messages of one motion of the examined robot. Pure.

use tread_control::geometry::wrap_angle_rad;
use tread_control::measured::{WheelSpeeds, WheelTorques};
use tread_ros2::cdr::decode;
use tread_ros2::messages::{Odometry, Time};

use super::message_buffer::Message;
use crate::drive::ros2::reading::{Content, Position, Wheels, wheels_of};
use crate::drive::ros2::refusal::Source;
use crate::drive::ros2::settings::{MotionOf, Ros2Settings};
use crate::drive::ros2::topic_receiver::decoded;

/// Smallest sum of squared deviations of the positions' times for a speed, s²: ten fixes in a
/// second.
const TIMES_SQUARES_MIN_S2: f64 = 0.8;
/// Number of the last wheel messages whose mean is the speed gained.
const LAST_SPEEDS: usize = 10;
/// Number of blocks into which the steady part of a motion is divided, to give means a standard
/// error.
const BLOCKS: usize = 8;
/// [`BLOCKS`] as a floating-point number.
const BLOCKS_COUNT: f64 = 8.0;
/// Number of messages after which a value that never changed counts as frozen.
const FROZEN_MIN: u32 = 10;

/// Summary of the steady second half of a motion.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct DriveSummary {
    /// Commanded wheel speeds.
    pub(super) commanded: WheelSpeeds,
    /// Measured wheel speeds, if any.
    pub(super) wheels: Option<WheelSpeeds>,
    /// Mean yaw rate, rad/s.
    pub(super) turn_rad_s: Option<f64>,
    /// Forward speed by position fixes, m/s.
    pub(super) places_m_s: Option<f64>,
    /// Forward speed by the odometry, m/s, if it measures the ground.
    pub(super) odometry_m_s: Option<f64>,
    /// Mean odometry twist, and the heading of its pose.
    pub(super) twist: Option<PlanarTwist>,
    /// Block means of the wheel-speed difference, right minus left, and of the yaw rate.
    pub(super) turn_blocks: Vec<TurnBlock>,
    /// Ranges of the measured values, from the begin of the motion to its end.
    pub(super) ranges: Ranges,
    /// Mean wheel torques, if measured.
    pub(super) torques: Option<WheelTorques>,
    /// Torque of both sides while the robot accelerated.
    pub(super) acceleration: Option<AccelerationPhase>,
    /// Whether the base was heard during the whole motion.
    pub(super) is_heard: bool,
}

/// Both motions of the examination.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Drives {
    /// Turn on the spot to the left.
    pub(super) turned: DriveSummary,
    pub(super) forward: DriveSummary,
}

/// Linear velocity as written in the odometry message, and the heading of its pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PlanarTwist {
    pub(super) x_m_s: f64,
    pub(super) y_m_s: f64,
    pub(super) heading_rad: f64,
}

/// Means over one block of a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TurnBlock {
    pub(super) difference_rad_s: f64,
    pub(super) turn_rad_s: f64,
}

/// Smallest and largest value, and the number of values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Range {
    least: f64,
    most: f64,
    count: u32,
}

impl Default for Range {
    fn default() -> Self {
        Self {
            least: f64::INFINITY,
            most: f64::NEG_INFINITY,
            count: 0,
        }
    }
}

impl Range {
    pub(super) fn add(&mut self, value: f64) {
        self.least = self.least.min(value);
        self.most = self.most.max(value);
        self.count += 1;
    }

    pub(super) fn with(self, other: Self) -> Self {
        Self {
            least: self.least.min(other.least),
            most: self.most.max(other.most),
            count: self.count + other.count,
        }
    }

    /// Returns the difference of the largest and the smallest value; 0 without values.
    pub(super) fn span(&self) -> f64 {
        if self.count == 0 {
            0.0
        } else {
            self.most - self.least
        }
    }

    /// Whether there were enough values and all are equal to the bit, unlike measured ones.
    pub(super) fn is_frozen(&self) -> bool {
        self.count >= FROZEN_MIN && self.span() <= 0.0
    }
}

/// Ranges of the measured values.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Ranges {
    pub(super) left: Range,
    pub(super) right: Range,
    pub(super) gyro: Range,
    pub(super) odometry_forward: Range,
    pub(super) odometry_turn: Range,
    pub(super) x: Range,
    pub(super) y: Range,
    pub(super) heading: Range,
}

impl Ranges {
    /// Joins the ranges of two motions.
    pub(super) fn with(&self, other: &Self) -> Self {
        Self {
            left: self.left.with(other.left),
            right: self.right.with(other.right),
            gyro: self.gyro.with(other.gyro),
            odometry_forward: self.odometry_forward.with(other.odometry_forward),
            odometry_turn: self.odometry_turn.with(other.odometry_turn),
            x: self.x.with(other.x),
            y: self.y.with(other.y),
            heading: self.heading.with(other.heading),
        }
    }

    fn add(&mut self, settings: &Ros2Settings, content: &Content) {
        match content {
            Content::Wheels(wheels) => self.add_wheels(wheels.speeds),
            Content::Inertial(inertial) => self.gyro.add(inertial.yaw_rate_rad_s),
            Content::Motion(motion) => {
                self.odometry_forward.add(motion.forward_m_s);
                self.odometry_turn.add(motion.yaw_rate_rad_s);
                if settings.joints.is_none() {
                    self.add_wheels(wheels_of(motion, &settings.command));
                }
                if let Some(position) = &motion.position {
                    self.add_place(position);
                }
            }
            Content::Position(position) => self.add_place(position),
            Content::Battery(_) => {}
        }
    }

    fn add_wheels(&mut self, speeds: WheelSpeeds) {
        self.left.add(speeds.left_rad_s);
        self.right.add(speeds.right_rad_s);
    }

    fn add_place(&mut self, position: &Position) {
        self.x.add(position.pose.x_m);
        self.y.add(position.pose.y_m);
        self.heading.add(position.pose.heading_rad);
    }
}

/// Torque of the wheels during the acceleration from zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct AccelerationPhase {
    /// Mean torque of both sides together, N m.
    pub(super) torque_n_m: f64,
    /// Duration of the acceleration by the messages' stamps, seconds.
    pub(super) span_s: f64,
    /// Wheel speed at its end, rad/s.
    pub(super) gained_rad_s: f64,
}

impl DriveSummary {
    /// Returns the speed over ground, m/s: by position fixes if available, else by odometry.
    pub(super) fn ground_m_s(&self) -> Option<f64> {
        self.places_m_s.or(self.odometry_m_s)
    }
}

/// Messages of one motion.
#[derive(Debug)]
pub(super) struct MotionMessages {
    /// Those of the acceleration.
    pub(super) starting: Vec<Message>,
    /// Those of the steady part.
    pub(super) steady: Vec<Message>,
}

/// Running mean.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.count += 1.0;
    }

    fn value(self) -> Option<f64> {
        (self.count > 0.0).then(|| self.sum / self.count)
    }
}

/// Summarises a motion.
pub(super) fn summarise(
    commanded: WheelSpeeds,
    settings: &Ros2Settings,
    messages: &MotionMessages,
) -> DriveSummary {
    let MotionMessages { starting, steady } = messages;
    let (mut left, mut right) = (Mean::default(), Mean::default());
    let (mut left_torque, mut right_torque) = (Mean::default(), Mean::default());
    let (mut gyro, mut odometry_turn, mut speed) =
        (Mean::default(), Mean::default(), Mean::default());
    let mut places: Vec<(f64, Position)> = Vec::new();
    let motion_of = settings
        .odometry
        .as_ref()
        .map(|odometry| odometry.motion_of);
    for message in steady {
        let Ok(Some((stamp, content))) = decoded(settings, message.source, &message.payload) else {
            continue;
        };
        let mut add_wheels = |speeds: WheelSpeeds| {
            left.add(speeds.left_rad_s);
            right.add(speeds.right_rad_s);
        };
        let at_s = seconds(stamp);
        match content {
            Content::Wheels(wheels) => {
                add_wheels(wheels.speeds);
                if let Some(torques) = wheels.torques {
                    left_torque.add(torques.left_n_m);
                    right_torque.add(torques.right_n_m);
                }
            }
            Content::Inertial(inertial) => gyro.add(inertial.yaw_rate_rad_s),
            Content::Motion(motion) => {
                odometry_turn.add(motion.yaw_rate_rad_s);
                if settings.joints.is_none() {
                    add_wheels(wheels_of(&motion, &settings.command));
                }
                if motion_of == Some(MotionOf::Ground) {
                    speed.add(motion.forward_m_s);
                }
                places.extend(motion.position.map(|position| (at_s, position)));
            }
            Content::Position(position) => places.push((at_s, position)),
            Content::Battery(_) => {}
        }
    }
    let mut ranges = Ranges::default();
    for message in starting.iter().chain(steady) {
        if let Ok(Some((_, content))) = decoded(settings, message.source, &message.payload) {
            ranges.add(settings, &content);
        }
    }
    DriveSummary {
        commanded,
        twist: planar_twist(steady),
        turn_blocks: turn_blocks(settings, steady),
        ranges,
        wheels: left
            .value()
            .zip(right.value())
            .map(|(left_rad_s, right_rad_s)| WheelSpeeds {
                left_rad_s,
                right_rad_s,
            }),
        turn_rad_s: gyro.value().or(odometry_turn.value()),
        places_m_s: speed_of(&places),
        odometry_m_s: speed.value(),
        torques: left_torque
            .value()
            .zip(right_torque.value())
            .map(|(left_n_m, right_n_m)| WheelTorques {
                left_n_m,
                right_n_m,
            }),
        acceleration: acceleration(settings, starting),
        is_heard: true,
    }
}

/// Returns the block means of a motion in which wheel speeds and yaw rate were measured.
fn turn_blocks(settings: &Ros2Settings, messages: &[Message]) -> Vec<TurnBlock> {
    let (Some(first), Some(last)) = (messages.first(), messages.last()) else {
        return Vec::new();
    };
    let began = first.arrival.monotonic;
    let span_s = last.arrival.monotonic.saturating_sub(began).as_secs_f64();
    let mut sums = [(Mean::default(), Mean::default()); BLOCKS];
    let has_gyro = settings.imu.is_some();
    for message in messages {
        let Ok(Some((_, content))) = decoded(settings, message.source, &message.payload) else {
            continue;
        };
        let at_s = message
            .arrival
            .monotonic
            .saturating_sub(began)
            .as_secs_f64();
        // Index of the last block that has begun.
        let index = (1..BLOCKS).rev().find(|index| {
            let share = f64::from(u32::try_from(*index).unwrap_or(0)) / BLOCKS_COUNT;
            at_s >= share * span_s
        });
        let (difference, turn) = &mut sums[index.unwrap_or(0)];
        match content {
            Content::Wheels(Wheels { speeds, .. }) => {
                difference.add(speeds.right_rad_s - speeds.left_rad_s);
            }
            Content::Inertial(inertial) => turn.add(inertial.yaw_rate_rad_s),
            Content::Motion(motion) => {
                if settings.joints.is_none() {
                    let speeds = wheels_of(&motion, &settings.command);
                    difference.add(speeds.right_rad_s - speeds.left_rad_s);
                }
                if !has_gyro {
                    turn.add(motion.yaw_rate_rad_s);
                }
            }
            Content::Position(_) | Content::Battery(_) => {}
        }
    }
    let block = |(difference, turn): (Mean, Mean)| {
        Some(TurnBlock {
            difference_rad_s: difference.value()?,
            turn_rad_s: turn.value()?,
        })
    };
    sums.into_iter().filter_map(block).collect()
}

/// Returns the mean odometry twist, in the frame of the messages.
fn planar_twist(messages: &[Message]) -> Option<PlanarTwist> {
    let (mut x, mut y, mut sin, mut cos) = <(Mean, Mean, Mean, Mean)>::default();
    for message in messages.iter().filter(|it| it.source == Source::Odometry) {
        let Ok(read) = decode::<Odometry<'_>>(&message.payload) else {
            continue;
        };
        let linear = read.twist.twist.linear;
        x.add(linear.x);
        y.add(linear.y);
        if let Some(heading_rad) = read.pose.pose.orientation.yaw_rad() {
            sin.add(heading_rad.sin());
            cos.add(heading_rad.cos());
        }
    }
    Some(PlanarTwist {
        x_m_s: x.value()?,
        y_m_s: y.value()?,
        heading_rad: wrap_angle_rad(sin.value()?.atan2(cos.value()?)),
    })
}

/// Returns the heading of the newest odometry pose in its own frame.
pub(super) fn newest_heading_rad(settings: &Ros2Settings, messages: &[Message]) -> Option<f64> {
    settings.odometry.as_ref()?;
    let mut newest = messages.iter().rev();
    let message = newest.find(|message| message.source == Source::Odometry)?;
    let read: Odometry<'_> = decode(&message.payload).ok()?;
    read.pose.pose.orientation.yaw_rad()
}

/// Returns the torque during the acceleration.
fn acceleration(settings: &Ros2Settings, messages: &[Message]) -> Option<AccelerationPhase> {
    let mut torque = Mean::default();
    let mut speeds_over_time = Vec::with_capacity(messages.len());
    for message in messages {
        let Ok(Some((stamp, content))) = decoded(settings, message.source, &message.payload) else {
            continue;
        };
        if let Content::Wheels(Wheels {
            speeds,
            torques: Some(torques),
        }) = content
        {
            torque.add(torques.left_n_m + torques.right_n_m);
            let speed_rad_s = 0.5 * (speeds.left_rad_s + speeds.right_rad_s);
            speeds_over_time.push((seconds(stamp), speed_rad_s));
        }
    }
    let ((first_s, _), (last_s, _)) = (speeds_over_time.first()?, speeds_over_time.last()?);
    let intervals = torque.count - 1.0;
    let mut gained = Mean::default();
    for (_, speed_rad_s) in speeds_over_time.iter().rev().take(LAST_SPEEDS) {
        gained.add(*speed_rad_s);
    }
    let gained_rad_s = gained.value()?;
    (intervals > 0.0).then(|| AccelerationPhase {
        torque_n_m: torque.sum / torque.count,
        // Each message accounts for the time since the previous one.
        span_s: (last_s - first_s) * torque.count / intervals,
        gained_rad_s,
    })
}

fn seconds(stamp: Time) -> f64 {
    f64::from(stamp.sec) + 1.0e-9 * f64::from(stamp.nanosec)
}

/// Returns the forward speed of the positions: the slope of their regression line, m/s.
fn speed_of(places: &[(f64, Position)]) -> Option<f64> {
    let (first_s, first) = places.first()?;
    let (sin, cos) = first.pose.heading_rad.sin_cos();
    let (mut span, mut distance) = (Mean::default(), Mean::default());
    let points: Vec<(f64, f64)> = places
        .iter()
        .map(|(at_s, place)| {
            let forward_m = cos * place.pose.x_m + sin * place.pose.y_m;
            (at_s - first_s, forward_m)
        })
        .inspect(|(at_s, forward_m)| {
            span.add(*at_s);
            distance.add(*forward_m);
        })
        .collect();
    let (middle_s, middle_m) = (span.value()?, distance.value()?);
    let (mut squares, mut products) = (0.0, 0.0);
    for (at_s, forward_m) in points {
        squares += (at_s - middle_s).powi(2);
        products += (at_s - middle_s) * (forward_m - middle_m);
    }
    (squares > TIMES_SQUARES_MIN_S2).then(|| products / squares)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_is_frozen_if_it_was_said_often_and_never_changed() {
        let mut range = Range::default();
        assert!(!range.is_frozen(), "nothing was said");
        for _ in 0..FROZEN_MIN {
            range.add(0.25);
        }
        assert!(range.is_frozen());
        assert!(
            !Range::default()
                .with(Range { count: 3, ..range })
                .is_frozen()
        );
        range.add(0.25 + f64::EPSILON);
        assert!(!range.is_frozen());
    }

    #[test]
    fn a_speed_is_the_slope_of_all_places() {
        let at = |index: u32| {
            let at_s = 100.0 + 0.05 * f64::from(index);
            // Every other position is off by a centimetre.
            let off_m = if index.is_multiple_of(2) { 0.01 } else { -0.01 };
            let pose = tread_control::geometry::Pose {
                x_m: 0.2 * at_s + off_m,
                ..Default::default()
            };
            (at_s, Position { pose, noise: None })
        };
        let places: Vec<_> = (0..40).map(at).collect();
        assert!((speed_of(&places).unwrap() - 0.2).abs() < 0.002);
        assert_eq!(speed_of(&places[..3]), None);
    }
}
