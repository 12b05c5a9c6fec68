//! Checks the frame of the odometry's twist. Pure.
//!
//! The twist in `nav_msgs/Odometry` is defined in the frame `child_frame_id`: forward and to the
//! left of the robot. If the publisher writes it in the frame of the pose instead, its direction is
//! the robot's heading, which is correct only while the robot heads along the x axis.

use std::f64::consts::PI;

use tread_control::geometry::wrap_angle_rad;

use super::drive_summary::PlanarTwist;
use super::finding::{Finding, Key};

/// Angle up to which a motion counts as straight forward, radians.
pub(super) const FORWARD_MAX_RAD: f64 = 0.35;
/// Ratio to the rim speed below which the direction of the odometry is not used.
const SPEED_MIN_SHARE: f64 = 0.3;

/// Returns whether the robot heads along the x axis of the odometry's frame, where the twist is
/// equal in both frames.
pub(super) fn is_along_x(heading_rad: f64) -> bool {
    wrap_angle_rad(heading_rad).abs() < 1.5 * FORWARD_MAX_RAD
}

/// Returns a finding if the twist is in the wrong frame; `None` if not, or if the odometry shows no
/// motion.
///
/// `rim_m_s` is the commanded rim speed, and `joints` are the measured directions `[left, right]`,
/// 1 for forward and -1 for backward. If they differ, one of them is inverted and the direction of
/// the robot is unknown.
pub(super) fn finding(twist: &PlanarTwist, rim_m_s: f64, joints: [i8; 2]) -> Option<Finding> {
    let speed_m_s = twist.x_m_s.hypot(twist.y_m_s);
    (speed_m_s > SPEED_MIN_SHARE * rim_m_s.abs()).then_some(())?;
    // For a robot that drives backward, the direction is relative to its back.
    let back_rad = if joints == [-1, -1] { PI } else { 0.0 };
    let direction_rad = wrap_angle_rad(twist.y_m_s.atan2(twist.x_m_s) - back_rad);
    let is_along = direction_rad.abs() >= PI - FORWARD_MAX_RAD;
    if direction_rad.abs() <= FORWARD_MAX_RAD || (is_along && joints[0] != joints[1]) {
        return None;
    }
    let key = "drive.ros2.odometry.child_frame";
    if wrap_angle_rad(direction_rad - twist.heading_rad).abs() <= FORWARD_MAX_RAD {
        let text = format!(
            "driving forward, the odometry's twist points {:.0}° to the left, which is where its pose heads: it \
             is in the frame of the pose, and nav_msgs/Odometry wants it in `child_frame_id`. Mend what \
             writes it; no key of robot.toml can",
            direction_rad.to_degrees()
        );
        return Some(Finding::on("twist").wrong(Key(key), text));
    }
    // A twist straight backward is a matter of signs.
    if is_along {
        return None;
    }
    let text = format!(
        "driving forward, the odometry's twist points {:.0}° to the left: its child frame is turned against the \
         robot",
        direction_rad.to_degrees()
    );
    Some(Finding::on("twist").wrong(Key(key), text))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const RIM_M_S: f64 = 0.2;
    const FORWARD: [i8; 2] = [1, 1];
    const BACK: [i8; 2] = [-1, -1];

    fn twist(direction_rad: f64, heading_rad: f64) -> PlanarTwist {
        PlanarTwist {
            x_m_s: RIM_M_S * direction_rad.cos(),
            y_m_s: RIM_M_S * direction_rad.sin(),
            heading_rad,
        }
    }

    #[test]
    fn a_twist_that_is_turned_otherwise_is_named_as_that() {
        let turned = finding(&twist(PI / 2.0, 2.8), RIM_M_S, FORWARD).unwrap();
        assert!(
            turned.text.contains("child frame is turned"),
            "{}",
            turned.text
        );
        assert_eq!(
            finding(&twist(PI, 1.0), RIM_M_S, FORWARD),
            None,
            "backwards"
        );
    }

    #[test]
    fn odometry_that_does_not_move_has_no_direction() {
        let still = PlanarTwist {
            x_m_s: 0.001,
            y_m_s: -0.001,
            heading_rad: 1.0,
        };
        assert_eq!(finding(&still, RIM_M_S, FORWARD), None);
    }

    #[test]
    fn a_robot_that_goes_backwards_where_it_heads_back_is_well() {
        assert_eq!(finding(&twist(PI - 0.01, PI - 0.02), RIM_M_S, BACK), None);
        let world = finding(&twist(1.5 + PI, 1.5), RIM_M_S, BACK).unwrap();
        assert!(world.text.contains("frame of the pose"), "{}", world.text);
    }

    #[test]
    fn joints_of_which_one_is_inverted_do_not_make_a_twist_wrong() {
        for joints in [[-1, 1], [1, -1]] {
            // The robot had turned by half a turn, and drove backward or forward.
            for direction_rad in [0.02, PI - 0.02] {
                let twist = twist(direction_rad, PI - 0.01);
                assert_eq!(finding(&twist, RIM_M_S, joints), None);
            }
            let world = finding(&twist(1.5, 1.4), RIM_M_S, joints).unwrap();
            assert!(world.text.contains("frame of the pose"), "{}", world.text);
        }
    }

    proptest! {
        #[test]
        fn a_twist_of_the_body_is_well_wherever_the_robot_heads(heading_rad in -3.2_f64..3.2, off_rad in -0.3_f64..0.3) {
            prop_assert_eq!(finding(&twist(off_rad, heading_rad), RIM_M_S, FORWARD), None);
        }

        #[test]
        fn a_twist_of_the_world_is_named_unless_the_robot_heads_along_x(
            heading_rad in -3.1_f64..3.1,
            off_rad in -0.15_f64..0.15,
        ) {
            let found = finding(&twist(heading_rad + off_rad, heading_rad), RIM_M_S, FORWARD);
            if is_along_x(heading_rad) {
                prop_assert!(found.is_none_or(|finding| finding.text.contains("frame of the pose")));
            } else {
                prop_assert!(found.unwrap().text.contains("frame of the pose"));
            }
        }
    }
}
