//! Detects frozen sensors: their messages arrive, but their values never change while the robot
//! moves. Pure.
//!
//! The robot turned and drove, so every value that depends on motion must have changed. A frozen
//! sensor differs from a robot that did not move in that another sensor measured the motion.

use super::drive_summary::{DriveSummary, Drives, Ranges};
use super::finding::{Finding, Key};
use crate::drive::ros2::settings::Ros2Settings;

/// Yaw rate that shows that the robot turned, rad/s.
const TURNED_RAD_S: f64 = 0.1;
/// Distance by position fixes that shows that the robot moved, metres.
const MOVED_M: f64 = 0.15;
/// Speed over ground that shows that the robot moved, m/s.
const MOVED_M_S: f64 = 0.05;
/// Change of a wheel's speed that shows that it turned, as a fraction of its command.
const TURNED_SHARE: f64 = 0.2;

/// Frozen sensors.
#[expect(
    clippy::struct_excessive_bools,
    reason = "one of each sensor, and any may be"
)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Frozen {
    pub(super) left: bool,
    pub(super) right: bool,
    pub(super) gyro: bool,
    pub(super) odometry: bool,
    pub(super) position: bool,
}

impl Frozen {
    /// Detects the sensors that were frozen during both motions; `gyro_bias_rad_s` is the gyro's
    /// offset.
    pub(super) fn of(Drives { turned, forward }: &Drives, gyro_bias_rad_s: f64) -> Self {
        let ranges = turned.ranges.with(&forward.ranges);
        let turn_rad_s = turned.turn_rad_s.unwrap_or(gyro_bias_rad_s) - gyro_bias_rad_s;
        let seen = Seen::of(&ranges, turn_rad_s, forward);
        let Ranges {
            left,
            right,
            gyro,
            odometry_forward,
            odometry_turn,
            x,
            y,
            heading,
        } = &ranges;
        let is_position = x.is_frozen() && y.is_frozen() && heading.is_frozen();
        let is_odometry = odometry_forward.is_frozen() && odometry_turn.is_frozen();
        Self {
            left: left.is_frozen() && (seen.right || seen.elsewhere()),
            right: right.is_frozen() && (seen.left || seen.elsewhere()),
            gyro: gyro.is_frozen() && seen.wheels(),
            odometry: is_odometry && (seen.wheels() || seen.gyro),
            position: is_position && (seen.wheels() || seen.gyro),
        }
    }

    fn joints(self) -> bool {
        self.left || self.right
    }

    /// Returns a finding for each frozen sensor.
    pub(super) fn findings(self, settings: &Ros2Settings, drives: &Drives) -> Vec<Finding> {
        let mut findings = Vec::new();
        if self.joints() {
            let which = match (self.left, self.right) {
                (true, true) => "the joints say",
                (true, false) => "the left joints say",
                (false, _) => "the right joints say",
            };
            let key = if settings.joints.is_some() {
                "drive.ros2.joints.topic"
            } else {
                "drive.ros2.odometry.topic"
            };
            let moved = moved(drives);
            let text = format!(
                "{which} the same speed all the time, though the robot moved ({moved}): they froze"
            );
            findings.push(Finding::on("joints").wrong(Key(key), text));
        }
        if self.gyro {
            let text =
                "the gyro says the same turn rate all the time, though the wheels turned: it froze";
            findings.push(Finding::on("imu").wrong(Key("drive.ros2.imu.topic"), text));
        }
        // If the odometry gives the wheel speeds, the finding on the wheels covers it.
        if self.odometry && (settings.joints.is_some() || !self.joints()) {
            let text =
                "the odometry says the same motion all the time, though the robot moved: it froze";
            findings.push(Finding::on("odometry").wrong(Key("drive.ros2.odometry.topic"), text));
        }
        if self.position {
            let key = if settings.pose.is_some() {
                "drive.ros2.pose.topic"
            } else {
                "drive.ros2.odometry.topic"
            };
            let text = "the position never changes, though the robot moved: it froze";
            findings.push(Finding::on("pose").wrong(Key(key), text));
        }
        findings
    }
}

/// Describes the motion measured by all sensors but the wheels, for people.
fn moved(Drives { turned, forward }: &Drives) -> String {
    let mut parts = Vec::new();
    if let Some(turn_rad_s) = turned.turn_rad_s {
        parts.push(format!("turned at {turn_rad_s:.2} rad/s"));
    }
    if let Some(ground_m_s) = forward.ground_m_s() {
        parts.push(format!("went {ground_m_s:.2} m/s"));
    }
    parts.join(", ")
}

/// Sensors of which others have shown that they should have measured motion.
#[expect(
    clippy::struct_excessive_bools,
    reason = "one of each sensor, and any may be"
)]
#[derive(Debug, Clone, Copy)]
struct Seen {
    left: bool,
    right: bool,
    gyro: bool,
    odometry: bool,
    position: bool,
}

impl Seen {
    fn of(ranges: &Ranges, turn_rad_s: f64, forward: &DriveSummary) -> Self {
        let has_turned = |span: f64, commanded: f64| span > TURNED_SHARE * commanded.abs();
        Self {
            left: has_turned(ranges.left.span(), forward.commanded.left_rad_s),
            right: has_turned(ranges.right.span(), forward.commanded.right_rad_s),
            gyro: turn_rad_s.abs() > TURNED_RAD_S && !ranges.gyro.is_frozen(),
            odometry: ranges.odometry_forward.span() > MOVED_M_S,
            position: ranges.x.span().hypot(ranges.y.span()) > MOVED_M,
        }
    }

    fn wheels(self) -> bool {
        self.left || self.right
    }

    fn elsewhere(self) -> bool {
        self.gyro || self.odometry || self.position
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use tread_control::measured::WheelSpeeds;

    use super::*;
    use crate::drive::ros2::tests::settings;

    /// Returns both motions of a robot with some frozen sensors, which moved or not.
    fn robot(frozen: Frozen, moves: bool, noise: f64) -> Drives {
        let mut random = 1_u32;
        let mut measured = |value: f64, is_frozen: bool| {
            if is_frozen {
                return 0.125;
            }
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            value + noise * (f64::from(random >> 8) / f64::from(1_u32 << 24) - 0.5)
        };
        let [turned, forward] = [(-1.0, 1.0), (1.0, 1.0)].map(|(left, right): (f64, f64)| {
            let scale = if moves { 1.0 } else { 0.0 };
            let (turn, forward) = (scale * (right - left), scale * (left + right));
            let mut drove = DriveSummary {
                commanded: WheelSpeeds {
                    left_rad_s: 2.5 * left,
                    right_rad_s: 2.5 * right,
                },
                turn_rad_s: Some(if frozen.gyro { 0.125 } else { 0.3 * turn }),
                ..DriveSummary::default()
            };
            let ranges = &mut drove.ranges;
            for step in 0..100 {
                let share = f64::from(step) / 100.0;
                ranges
                    .left
                    .add(measured(2.5 * left * scale * share, frozen.left));
                ranges
                    .right
                    .add(measured(2.5 * right * scale * share, frozen.right));
                ranges.gyro.add(measured(0.3 * turn * share, frozen.gyro));
                ranges
                    .odometry_forward
                    .add(measured(0.1 * forward * share, frozen.odometry));
                ranges
                    .odometry_turn
                    .add(measured(0.3 * turn * share, frozen.odometry));
                ranges
                    .x
                    .add(measured(0.1 * forward * share * 4.0, frozen.position));
                ranges.y.add(measured(0.0, frozen.position));
                ranges
                    .heading
                    .add(measured(0.3 * turn * share, frozen.position));
            }
            drove
        });
        Drives { turned, forward }
    }

    fn found(frozen: Frozen, moves: bool, noise: f64) -> Frozen {
        Frozen::of(&robot(frozen, moves, noise), 0.0)
    }

    #[test]
    fn each_sensor_that_froze_has_its_key() {
        let healthy = Frozen::default();
        for (frozen, key) in [
            (
                Frozen {
                    left: true,
                    right: true,
                    ..healthy
                },
                "drive.ros2.joints.topic",
            ),
            (
                Frozen {
                    left: true,
                    ..healthy
                },
                "drive.ros2.joints.topic",
            ),
            (
                Frozen {
                    gyro: true,
                    ..healthy
                },
                "drive.ros2.imu.topic",
            ),
            (
                Frozen {
                    odometry: true,
                    ..healthy
                },
                "drive.ros2.odometry.topic",
            ),
            (
                Frozen {
                    position: true,
                    ..healthy
                },
                "drive.ros2.odometry.topic",
            ),
        ] {
            let drives = robot(frozen, true, 0.01);
            let findings = Frozen::of(&drives, 0.0).findings(&settings(), &drives);
            let keys: Vec<_> = findings.iter().filter_map(|finding| finding.key).collect();
            assert_eq!(keys, [key], "{frozen:?}");
        }
    }

    #[test]
    fn a_robot_that_stood_has_no_frozen_sensor_though_its_perfect_sensors_never_changed() {
        assert_eq!(found(Frozen::default(), false, 0.0), Frozen::default());
    }

    #[test]
    fn a_gyro_with_a_bias_did_not_see_a_robot_turn_that_stood() {
        let mut drives = robot(Frozen::default(), false, 0.0);
        drives.turned.turn_rad_s = Some(0.3);
        drives.turned.ranges.gyro.add(0.3);
        assert_eq!(Frozen::of(&drives, 0.3), Frozen::default());
        let found = Frozen::of(&drives, 0.0);
        assert!(found.left && found.right, "{found:?}");
    }

    proptest! {
        /// Exactly the frozen sensors are reported, if another sensor measured motion.
        #[test]
        fn exactly_what_froze_is_named(set in 0_u32..31, noise in 1.0e-6_f64..0.02) {
            let is = |bit: u32| set & (1 << bit) != 0;
            let frozen = Frozen {
                left: is(0),
                right: is(1),
                gyro: is(2),
                odometry: is(3),
                position: is(4),
            };
            let wheels = !(frozen.left && frozen.right);
            let expected = Frozen {
                gyro: frozen.gyro && wheels,
                odometry: frozen.odometry && (wheels || !frozen.gyro),
                position: frozen.position && (wheels || !frozen.gyro),
                ..frozen
            };
            prop_assert_eq!(found(frozen, true, noise), expected);
        }
    }
}
