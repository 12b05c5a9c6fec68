//! Converts wheel speeds to the base's command message.

use tread_control::measured::WheelSpeeds;
use tread_ros2::cdr::{Sequence, encode};
use tread_ros2::messages::{
    Float64MultiArray, Header, Message, MessageType, MultiArrayLayout, Time, Twist, TwistStamped,
    Vector3,
};

use super::settings::{CommandKind, CommandSettings, JOINTS_MAX};

/// Returns the message type of the command.
pub(super) fn message_type(kind: CommandKind) -> MessageType {
    match kind {
        CommandKind::Twist => Twist::TYPE,
        CommandKind::TwistStamped => TwistStamped::TYPE,
        CommandKind::JointSpeeds => Float64MultiArray::TYPE,
    }
}

/// Returns the twist for which the base, with the wheel radius and track that it assumes, commands
/// these wheel speeds.
fn twist(command: WheelSpeeds, settings: &CommandSettings) -> Twist {
    let half_radius_m = 0.5 * settings.base_radius_m;
    let forward_m_s = half_radius_m * (command.left_rad_s + command.right_rad_s);
    let turn_rad_s =
        2.0 * half_radius_m * (command.right_rad_s - command.left_rad_s) / settings.base_track_m;
    Twist {
        linear: Vector3 {
            x: settings.forward_sign * forward_m_s,
            ..Vector3::default()
        },
        angular: Vector3 {
            z: settings.turn_sign * turn_rad_s,
            ..Vector3::default()
        },
    }
}

/// Encodes a command into `into`, replacing its content.
pub(super) fn write(
    command: WheelSpeeds,
    wall_ns: i64,
    settings: &CommandSettings,
    into: &mut Vec<u8>,
) {
    match settings.kind {
        CommandKind::Twist => encode(&twist(command, settings), into),
        CommandKind::TwistStamped => {
            let message = TwistStamped {
                header: Header {
                    stamp: Time::from_nanoseconds(wall_ns),
                    frame_id: &settings.frame,
                },
                twist: twist(command, settings),
            };
            encode(&message, into);
        }
        CommandKind::JointSpeeds => {
            let ([left, right], [left_ratio, right_ratio]) =
                (settings.joints, settings.joint_ratios);
            let mut speeds = [command.right_rad_s * right_ratio; 2 * JOINTS_MAX];
            speeds[..left].fill(command.left_rad_s * left_ratio);
            let message = Float64MultiArray {
                layout: MultiArrayLayout::default(),
                data: Sequence::from(&speeds[..left + right]),
            };
            encode(&message, into);
        }
    }
}

#[cfg(test)]
mod tests {
    use tread_ros2::cdr::decode;
    use tread_ros2::names::Name;

    use super::*;

    fn settings(kind: CommandKind) -> CommandSettings {
        CommandSettings {
            topic: Name::default(),
            kind,
            frame: "base_link".to_owned(),
            base_radius_m: 0.1,
            base_track_m: 0.5,
            turn_sign: 1.0,
            forward_sign: 1.0,
            joints: [2, 1],
            joint_ratios: [3.0, -3.0],
        }
    }

    const COMMAND: WheelSpeeds = WheelSpeeds {
        left_rad_s: 2.0,
        right_rad_s: 4.0,
    };

    #[test]
    fn a_motion_is_what_the_base_turns_back_into_the_wheels_speeds() {
        let mut bytes = Vec::new();
        write(
            COMMAND,
            1_500_000_000,
            &settings(CommandKind::TwistStamped),
            &mut bytes,
        );
        let message: TwistStamped<'_> = decode(&bytes).unwrap();
        assert_eq!(
            (message.header.stamp.sec, message.header.stamp.nanosec),
            (1, 500_000_000)
        );
        assert_eq!(message.header.frame_id, "base_link");
        let turn_m_s = 0.5 * 0.5 * message.twist.angular.z;
        let left_rad_s = (message.twist.linear.x - turn_m_s) / 0.1;
        let right_rad_s = (message.twist.linear.x + turn_m_s) / 0.1;
        assert!((left_rad_s - 2.0).abs() < 1.0e-12 && (right_rad_s - 4.0).abs() < 1.0e-12);
        let turn_rad_s = message.twist.angular.z;
        let mirrored = CommandSettings {
            turn_sign: -1.0,
            ..settings(CommandKind::Twist)
        };
        write(COMMAND, 0, &mirrored, &mut bytes);
        let mirrored: Twist = decode(&bytes).unwrap();
        assert!((mirrored.angular.z + turn_rad_s).abs() < 1.0e-12);
    }

    #[test]
    fn joints_turn_by_their_gear_and_sign_left_ones_first() {
        let mut bytes = Vec::new();
        write(COMMAND, 0, &settings(CommandKind::JointSpeeds), &mut bytes);
        let message: Float64MultiArray<'_> = decode(&bytes).unwrap();
        let speeds: Vec<f64> = message.data.iter().collect();
        assert_eq!(speeds, [6.0, 6.0, -12.0]);
    }
}
