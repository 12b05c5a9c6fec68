//! Converts ticks between the loop's types and the recorded message, to the bit.

use std::time::Duration;

use tread_api::robot::RobotMode;
use tread_control::gate::GateCause;
use tread_control::geometry::Pose;
use tread_control::localisation::FixNoise;
use tread_control::measured::{BodyAcceleration, WheelSpeeds, WheelTorques};
use tread_ros2::cdr::{CdrError, ENCAPSULATION_BYTES, Sequence, decode, decode_up_to, encode};
use tread_ros2::messages::Text;
use tread_ros2::messages::tread::{LoopSample, LoopTick, sample_bits, tick_bits};

use crate::control_loop::channels::Fault;
use crate::control_loop::frame::TickFrame;
use crate::drive::{Battery, Feedback, SAMPLES_MAX, SensorSample, StatedNoise};

/// Largest text that is decoded, bytes: a site of many polygons, a prior of many cells.
const TEXT_BYTES_MAX: usize = 64 * 1024 * 1024;
/// Recorded in fields of absent values, whose bit in `present` is zero.
const NONE: f64 = f64::NAN;

/// An output that differs from the recorded one.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Difference {
    pub(crate) name: &'static str,
    pub(crate) recorded: f64,
    pub(crate) replayed: f64,
}

/// Returns whole nanoseconds; saturates at 584 years.
pub(super) fn nanoseconds(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}

fn bit(bit: u32, is_set: bool) -> u32 {
    if is_set { bit } else { 0 }
}

/// Converts a sample to its recorded message.
pub(super) fn sample_message(sample: &SensorSample) -> LoopSample {
    let acceleration = sample.acceleration;
    let (wheels, torques) = (sample.wheel_speeds, sample.wheel_torques);
    let (position, noise) = (sample.position, sample.position_noise);
    LoopSample {
        at_ns: nanoseconds(sample.at),
        present: bit(sample_bits::YAW_RATE, sample.yaw_rate_rad_s.is_some())
            | bit(sample_bits::ACCELERATION, acceleration.is_some())
            | bit(sample_bits::SPECIFIC_FORCE, sample.is_specific_force)
            | bit(sample_bits::WHEELS, wheels.is_some())
            | bit(sample_bits::TORQUES, torques.is_some())
            | bit(sample_bits::BODY_SPEED, sample.body_speed_m_s.is_some())
            | bit(sample_bits::TILT, sample.tilt_rad.is_some())
            | bit(sample_bits::POSITION, position.is_some())
            | bit(sample_bits::POSITION_NOISE, noise.is_some()),
        yaw_rate_rad_s: sample.yaw_rate_rad_s.unwrap_or(NONE),
        forward_m_s2: acceleration.map_or(NONE, |it| it.forward_m_s2),
        left_m_s2: acceleration.map_or(NONE, |it| it.left_m_s2),
        wheel_left_rad_s: wheels.map_or(NONE, |it| it.left_rad_s),
        wheel_right_rad_s: wheels.map_or(NONE, |it| it.right_rad_s),
        torque_left_n_m: torques.map_or(NONE, |it| it.left_n_m),
        torque_right_n_m: torques.map_or(NONE, |it| it.right_n_m),
        body_speed_m_s: sample.body_speed_m_s.unwrap_or(NONE),
        tilt_rad: sample.tilt_rad.unwrap_or(NONE),
        x_m: position.map_or(NONE, |it| it.x_m),
        y_m: position.map_or(NONE, |it| it.y_m),
        heading_rad: position.map_or(NONE, |it| it.heading_rad),
        position_noise_m: noise.map_or(NONE, |it| it.position_m),
        heading_noise_rad: noise.map_or(NONE, |it| it.heading_rad),
    }
}

/// Converts a recorded message to a sample.
fn sample_of(message: &LoopSample) -> SensorSample {
    let has = |bit: u32| message.present & bit != 0;
    SensorSample {
        at: Duration::from_nanos(message.at_ns),
        yaw_rate_rad_s: has(sample_bits::YAW_RATE).then_some(message.yaw_rate_rad_s),
        acceleration: has(sample_bits::ACCELERATION).then_some(BodyAcceleration {
            forward_m_s2: message.forward_m_s2,
            left_m_s2: message.left_m_s2,
        }),
        is_specific_force: has(sample_bits::SPECIFIC_FORCE),
        wheel_speeds: has(sample_bits::WHEELS).then_some(WheelSpeeds {
            left_rad_s: message.wheel_left_rad_s,
            right_rad_s: message.wheel_right_rad_s,
        }),
        wheel_torques: has(sample_bits::TORQUES).then_some(WheelTorques {
            left_n_m: message.torque_left_n_m,
            right_n_m: message.torque_right_n_m,
        }),
        body_speed_m_s: has(sample_bits::BODY_SPEED).then_some(message.body_speed_m_s),
        tilt_rad: has(sample_bits::TILT).then_some(message.tilt_rad),
        position: has(sample_bits::POSITION).then_some(Pose {
            x_m: message.x_m,
            y_m: message.y_m,
            heading_rad: message.heading_rad,
        }),
        position_noise: has(sample_bits::POSITION_NOISE).then_some(FixNoise {
            position_m: message.position_noise_m,
            heading_rad: message.heading_noise_rad,
        }),
    }
}

/// Returns the samples of a recorded tick; `None` if there are more than [`SAMPLES_MAX`].
pub(super) fn feedback_of(message: &LoopTick<'_>) -> Option<Feedback> {
    if message.samples.len() > SAMPLES_MAX {
        return None;
    }
    let mut feedback = Feedback::default();
    for sample in &message.samples {
        feedback.push(sample_of(&sample));
    }
    Some(feedback.with_lost(message.lost_samples))
}

/// Returns the sensor noise that the base stated, of a recorded tick.
pub(super) fn noise_of(message: &LoopTick<'_>) -> StatedNoise {
    let has = |bit: u32| message.present & bit != 0;
    StatedNoise {
        gyro_rad_s: has(tick_bits::NOISE_GYRO).then_some(message.noise_gyro_rad_s),
        accelerometer_m_s2: has(tick_bits::NOISE_ACCELEROMETER)
            .then_some(message.noise_accelerometer_m_s2),
        body_speed_m_s: has(tick_bits::NOISE_BODY_SPEED).then_some(message.noise_body_speed_m_s),
    }
}

/// Returns the battery of a recorded tick.
pub(super) fn battery_of(message: &LoopTick<'_>) -> Option<Battery> {
    (message.present & tick_bits::BATTERY != 0).then_some(Battery {
        charge_ratio: message.battery_charge_ratio,
        voltage_v: message.battery_voltage_v,
    })
}

fn mode_number(mode: RobotMode) -> u8 {
    match mode {
        RobotMode::Idle => 0,
        RobotMode::Tracking => 1,
        RobotMode::Teleoperated => 2,
        RobotMode::Stopped => 3,
        RobotMode::Fault => 4,
    }
}

/// Returns the number of a cause in records, which never changes, unlike its position in
/// [`GateCause::ALL`].
fn gate_number(cause: GateCause) -> u8 {
    match cause {
        GateCause::Acceleration => 0,
        GateCause::Speed => 1,
        GateCause::CommandAge => 2,
        GateCause::ExternalLimit => 3,
        GateCause::Fence => 4,
        GateCause::NotFinite => 5,
        GateCause::NoCommand => 6,
        GateCause::Lease => 7,
        GateCause::LinkPolicy => 8,
        GateCause::ExternalHold => 9,
        GateCause::StalePosition => 10,
        GateCause::Tilt => 11,
        GateCause::StaleFeedback => 12,
        GateCause::Stop => 13,
        GateCause::LoopOverrun => 14,
        GateCause::SensorFault => 15,
    }
}

/// Alignment of `judged_ns`, the last field of a tick, which format 1 lacks, bytes.
const JUDGED_ALIGNED: usize = 8;

/// Converts a tick of format 1 to the present format, judged at its begin.
pub(super) fn from_format_1(tick: &[u8]) -> Result<Vec<u8>, CdrError> {
    let mut padded = tick.to_vec();
    let body = tick.len().saturating_sub(ENCAPSULATION_BYTES);
    let room = body.next_multiple_of(JUDGED_ALIGNED) + size_of::<u64>();
    padded.resize(ENCAPSULATION_BYTES + room, 0);
    let mut present: LoopTick<'_> = decode(&padded)?;
    present.judged_ns = present.monotonic_ns;
    let mut bytes = Vec::with_capacity(padded.len());
    encode(&present, &mut bytes);
    Ok(bytes)
}

/// Encodes a text as a recorded message.
pub(super) fn text_message(text: &str, into: &mut Vec<u8>) {
    encode(&Text { data: text }, into);
}

/// Decodes the text of a recorded message.
pub(super) fn text_of(message: &[u8]) -> Result<&str, CdrError> {
    let text: Text<'_> = decode_up_to(message, TEXT_BYTES_MAX)?;
    Ok(text.data)
}

/// Converts a tick to its recorded message; `samples` is the buffer of the samples.
pub(super) fn tick_message<'room>(
    frame: &TickFrame,
    samples: &'room mut Vec<LoopSample>,
) -> LoopTick<'room> {
    let (inputs, outputs) = (&frame.inputs, &frame.outputs);
    samples.clear();
    samples.extend(inputs.feedback.samples().iter().map(sample_message));
    let (noise, battery, pose) = (inputs.noise, inputs.battery, outputs.pose);
    let (theta, theta_std_dev) = outputs.theta.unwrap_or((NONE, NONE));
    let (driven_m, cross_track_m) = outputs.mission.unwrap_or((NONE, NONE));
    let (segment_information, segment_weighted) = outputs.segment.unwrap_or((NONE, NONE));
    LoopTick {
        number: frame.number,
        monotonic_ns: nanoseconds(inputs.now.monotonic),
        wall_ns: i64::try_from(inputs.now.wall.as_nanosecond()).unwrap_or(i64::MAX),
        present: bit(tick_bits::STOP_REQUESTED, inputs.stop_requested)
            | bit(tick_bits::BASE_SILENT, inputs.is_base_silent)
            | bit(tick_bits::NOISE_GYRO, noise.gyro_rad_s.is_some())
            | bit(
                tick_bits::NOISE_ACCELEROMETER,
                noise.accelerometer_m_s2.is_some(),
            )
            | bit(tick_bits::NOISE_BODY_SPEED, noise.body_speed_m_s.is_some())
            | bit(tick_bits::BATTERY, battery.is_some())
            | bit(tick_bits::POSE, pose.is_some())
            | bit(tick_bits::THETA_LOOP, outputs.theta_loop.is_some())
            | bit(tick_bits::THETA, outputs.theta.is_some())
            | bit(tick_bits::MISSION, outputs.mission.is_some())
            | bit(tick_bits::SLIP, outputs.slip.is_some())
            | bit(tick_bits::SEGMENT, outputs.segment.is_some())
            | bit(tick_bits::FAULT, outputs.fault.is_some())
            | bit(tick_bits::GATE, outputs.gate.is_some()),
        commands: inputs.commands,
        lost_samples: inputs.feedback.lost(),
        stop: inputs.stop,
        server_silence_ns: nanoseconds(inputs.server_silence),
        noise_gyro_rad_s: noise.gyro_rad_s.unwrap_or(NONE),
        noise_accelerometer_m_s2: noise.accelerometer_m_s2.unwrap_or(NONE),
        noise_body_speed_m_s: noise.body_speed_m_s.unwrap_or(NONE),
        battery_charge_ratio: battery.map_or(NONE, |it| it.charge_ratio),
        battery_voltage_v: battery.map_or(NONE, |it| it.voltage_v),
        samples: Sequence::from(samples.as_slice()),
        wanted_left_rad_s: outputs.requested.left_rad_s,
        wanted_right_rad_s: outputs.requested.right_rad_s,
        command_left_rad_s: outputs.command.left_rad_s,
        command_right_rad_s: outputs.command.right_rad_s,
        x_m: pose.map_or(NONE, |it| it.x_m),
        y_m: pose.map_or(NONE, |it| it.y_m),
        heading_rad: pose.map_or(NONE, |it| it.heading_rad),
        linear_m_s: outputs.twist.linear_m_s,
        angular_rad_s: outputs.twist.angular_rad_s,
        theta_loop: outputs.theta_loop.unwrap_or(NONE),
        theta,
        theta_std_dev,
        driven_m,
        cross_track_m,
        slip_left_ratio: outputs.slip.map_or(NONE, |it| it.left_ratio),
        slip_right_ratio: outputs.slip.map_or(NONE, |it| it.right_ratio),
        segment_information,
        segment_weighted,
        mode: mode_number(outputs.mode),
        fault: match outputs.fault {
            Some(Fault::BaseSilent) | None => 0,
            Some(Fault::PositionLost) => 1,
        },
        gate: outputs.gate.map_or(0, gate_number),
        judged_ns: nanoseconds(inputs.judged),
    }
}

/// Returns the outputs of a tick with their names.
pub(super) fn outputs(tick: &LoopTick<'_>) -> [(&'static str, f64); 22] {
    [
        ("wanted left, rad/s", tick.wanted_left_rad_s),
        ("wanted right, rad/s", tick.wanted_right_rad_s),
        ("command left, rad/s", tick.command_left_rad_s),
        ("command right, rad/s", tick.command_right_rad_s),
        ("x, m", tick.x_m),
        ("y, m", tick.y_m),
        ("heading, rad", tick.heading_rad),
        ("speed, m/s", tick.linear_m_s),
        ("turn rate, rad/s", tick.angular_rad_s),
        ("theta of the law", tick.theta_loop),
        ("theta measured", tick.theta),
        ("standard deviation of theta", tick.theta_std_dev),
        ("driven distance, m", tick.driven_m),
        ("cross-track error, m", tick.cross_track_m),
        ("slip left", tick.slip_left_ratio),
        ("slip right", tick.slip_right_ratio),
        ("information of a segment", tick.segment_information),
        ("weighted sum of a segment", tick.segment_weighted),
        ("what is present, bits", f64::from(tick.present)),
        ("mode", f64::from(tick.mode)),
        ("fault", f64::from(tick.fault)),
        ("gate", f64::from(tick.gate)),
    ]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn pair() -> impl Strategy<Value = Option<(f64, f64)>> {
        prop::option::of((any::<f64>(), any::<f64>()))
    }

    prop_compose! {
        fn sample()(
            at_ns in any::<u64>(),
            is_specific_force in any::<bool>(),
            singles in prop::collection::vec(prop::option::of(any::<f64>()), 3),
            pairs in prop::collection::vec(pair(), 4),
            position in prop::option::of((any::<f64>(), any::<f64>(), any::<f64>())),
        ) -> SensorSample {
            SensorSample {
                at: Duration::from_nanos(at_ns),
                yaw_rate_rad_s: singles[0],
                body_speed_m_s: singles[1],
                tilt_rad: singles[2],
                is_specific_force,
                acceleration: pairs[0].map(|(forward_m_s2, left_m_s2)| BodyAcceleration { forward_m_s2, left_m_s2 }),
                wheel_speeds: pairs[1].map(|(left_rad_s, right_rad_s)| WheelSpeeds { left_rad_s, right_rad_s }),
                wheel_torques: pairs[2].map(|(left_n_m, right_n_m)| WheelTorques { left_n_m, right_n_m }),
                position: position.map(|(x_m, y_m, heading_rad)| Pose { x_m, y_m, heading_rad }),
                position_noise: pairs[3].map(|(position_m, heading_rad)| FixNoise { position_m, heading_rad }),
            }
        }
    }

    proptest! {
        #[test]
        fn a_sample_comes_back_from_a_record_to_the_bit(sample in sample()) {
            let there = sample_message(&sample);
            let back = sample_message(&sample_of(&there));
            let (mut bytes, mut again) = (Vec::new(), Vec::new());
            tread_ros2::cdr::encode(&there, &mut bytes);
            tread_ros2::cdr::encode(&back, &mut again);
            prop_assert_eq!(bytes, again);
        }
    }
}
