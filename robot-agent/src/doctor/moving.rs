//! Examines the messages of a moving robot: frozen sensors, wheel directions, sides, signs, the
//! frame of the twist, radius, track and torque.
//!
//! Pure: from the commands and messages of a turn on the spot to the left, and of a drive forward.
//! A question is not examined if another finding makes its answer meaningless.

use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::drive_summary::{DriveSummary, Drives};
use super::finding::{Finding, Key};
use super::frozen::Frozen;
use super::signs::{self, Answers};
use super::{effort, track, twist_frame};
use crate::drive::ros2::settings::Ros2Settings;

/// Ratio to its command below which a wheel's speed counts as standstill.
const STANDING_SHARE: f64 = 0.2;
/// Smallest yaw rate of a robot that turns, rad/s.
const TURNING_RAD_S: f64 = 0.05;
/// Ratio to the wheels' speed below which a robot counts as not moving over ground.
const DRIVING_RATIO_MIN: f64 = 0.3;
/// Largest accepted relative error of the wheel radius.
const RADIUS_SHARE: f64 = 0.06;

/// Returns the sign of a value that is not zero.
fn sign(value: f64) -> i8 {
    if value > 0.0 { 1 } else { -1 }
}

/// Returns the signs of the wheels' speeds, `[left, right]`, 0 for those that stand still.
fn directions(reported: WheelSpeeds, summary: &DriveSummary) -> [i8; 2] {
    let direction = |of_side: fn(WheelSpeeds) -> f64| {
        let speed_rad_s = of_side(reported);
        let stands = speed_rad_s.abs() < STANDING_SHARE * of_side(summary.commanded).abs();
        if stands { 0 } else { sign(speed_rad_s) }
    };
    [
        direction(|speeds| speeds.left_rad_s),
        direction(|speeds| speeds.right_rad_s),
    ]
}

/// Returns the findings; `gyro_bias_rad_s` is the mean of the gyro while the robot stood still.
pub(super) fn findings(
    settings: &Ros2Settings,
    model: &RobotModel,
    drives: &Drives,
    gyro_bias_rad_s: f64,
) -> Vec<Finding> {
    let Drives { turned, forward } = drives;
    if !(turned.is_heard && forward.is_heard) {
        return vec![Finding::on("wheels").wrong(Key("drive.ros2.silent_after_ms"),
            "the base fell silent whenever it was moved: its messages come with gaps, or its machine \
             is overloaded",
        )];
    }
    let (Some(turning), Some(driving)) = (turned.wheels, forward.wheels) else {
        return vec![Finding::on("wheels").wrong(
            Key("drive.ros2.joints.topic"),
            "the wheels said nothing while they were commanded to move",
        )];
    };
    let frozen = Frozen::of(drives, gyro_bias_rad_s);
    let mut findings = frozen.findings(settings, drives);
    if frozen.left || frozen.right {
        let text = "sides, signs, radius and track: they need the joints";
        findings.push(Finding::on("sides").skipped(text));
        return findings;
    }
    let of_forward = directions(driving, forward);
    // By the command, since joints that disagree have no meaningful mean.
    let commanded_rad_s = 0.5 * (forward.commanded.left_rad_s + forward.commanded.right_rad_s);
    let rim_m_s = model.wheel_radius_m() * commanded_rad_s;
    let twist = forward.twist.filter(|_| !frozen.odometry);
    let twist = twist.and_then(|twist| twist_frame::finding(&twist, rim_m_s, of_forward));
    let is_twist_well = twist.is_none();
    findings.extend(twist);
    let ground_m_s = forward.places_m_s.filter(|_| !frozen.position).or(forward
        .odometry_m_s
        .filter(|_| !frozen.odometry && is_twist_well));
    let turn_rad_s = turned.turn_rad_s.filter(|_| !frozen.gyro);
    let turn_rad_s = turn_rad_s.map(|rate| rate - gyro_bias_rad_s);
    let is_driving = |ground_m_s: &f64| ground_m_s.abs() > DRIVING_RATIO_MIN * rim_m_s.abs();
    let is_turning = |rate: &f64| rate.abs() > TURNING_RAD_S;
    let answers = Answers {
        turn: directions(turning, turned),
        forward: of_forward,
        turned: turn_rad_s.filter(is_turning).map_or(0, sign),
        drove: ground_m_s.filter(is_driving).map_or(0, sign),
    };
    if let Some(standing) = of_standing(answers) {
        findings.push(standing);
        return findings;
    }
    let sides = signs::finding(answers, settings);
    let is_well = sides.holds;
    findings.push(sides);
    if !is_well {
        let text = "radius, track and torque: they need sides and signs";
        findings.push(Finding::on("track").skipped(text));
        return findings;
    }
    let stays = ground_m_s.is_some() && answers.drove == 0;
    findings.extend(of_still_body(turn_rad_s, stays, settings));
    let radius_m = ground_m_s
        .filter(|_| answers.drove != 0)
        .map(|ground_m_s| 2.0 * ground_m_s / (driving.left_rad_s + driving.right_rad_s));
    findings.extend(radius_m.map(|radius_m| of_radius(model, radius_m)));
    let radius_m = radius_m.unwrap_or(model.wheel_radius_m());
    let mut of_track = drives.clone();
    if frozen.gyro {
        of_track.turned.turn_blocks.clear();
    }
    findings.extend(track::findings(
        settings,
        model,
        &of_track,
        track::Calibration {
            radius_m,
            gyro_bias_rad_s,
        },
    ));
    findings.extend(effort::findings(settings, model, drives));
    findings
}

/// Returns the finding on wheels that stand still though commanded to turn.
fn of_standing(answers: Answers) -> Option<Finding> {
    let Answers { turn, forward, .. } = answers;
    let stands = |side: usize| turn[side] == 0 && forward[side] == 0;
    let text = match (stands(0), stands(1)) {
        (true, true) => {
            "the wheels stand though they are commanded to turn, and nothing else moved: nobody takes the \
             command, or an emergency stop is pressed"
        }
        (true, false) => "the left wheels stand though they are commanded to turn",
        (false, true) => "the right wheels stand though they are commanded to turn",
        (false, false) if turn.contains(&0) => "the wheels stand when a turn is commanded",
        (false, false) if forward.contains(&0) => {
            "the wheels stand when a forward speed is commanded"
        }
        (false, false) => return None,
    };
    Some(Finding::on("wheels").wrong(Key("drive.ros2.command.topic"), text))
}

/// Returns the finding on a robot that does not move though its wheels turn, by a sensor that is
/// not frozen. `stays` is whether it was measured to stay where it is.
fn of_still_body(turn_rad_s: Option<f64>, stays: bool, settings: &Ros2Settings) -> Option<Finding> {
    let turn_key = if settings.imu.is_some() {
        "drive.ros2.imu.topic"
    } else {
        "drive.ros2.odometry.topic"
    };
    if turn_rad_s.is_some_and(|rate| rate.abs() <= TURNING_RAD_S) {
        let text = "the gyro says that the robot does not turn though its wheels do: another axis, or the \
                    wheels spin";
        return Some(Finding::on("imu").wrong(Key(turn_key), text));
    }
    stays.then(|| {
        let key = if settings.pose.is_some() {
            "drive.ros2.pose.topic"
        } else {
            "drive.ros2.odometry.topic"
        };
        let text =
            "the robot stays where it is though its wheels turn forward, by its position or odometry";
        Finding::on("ground").wrong(Key(key), text)
    })
}

/// Compares the wheel radius with the distance over ground.
fn of_radius(model: &RobotModel, radius_m: f64) -> Finding {
    let model_m = model.wheel_radius_m();
    if (radius_m / model_m - 1.0).abs() <= RADIUS_SHARE {
        let text = format!("the wheels roll as with a radius of {radius_m:.3} m");
        return Finding::on("radius").ok(text);
    }
    let text = format!(
        "the wheels roll as with a radius of {radius_m:.3} m, the model says {model_m:.3} m"
    );
    let value = format!("{radius_m:.3}");
    Finding::on("radius")
        .wrong(Key("model.wheel_radius_m"), text)
        .with_line(Key("model.wheel_radius_m"), value)
}

#[cfg(test)]
mod tests {
    use super::super::drive_summary::{PlanarTwist, Range, Ranges, TurnBlock};
    use super::*;
    use crate::drive::ros2::tests::settings;

    fn speeds(left_rad_s: f64, right_rad_s: f64) -> WheelSpeeds {
        WheelSpeeds {
            left_rad_s,
            right_rad_s,
        }
    }

    fn moving(values: [f64; 2]) -> Range {
        let mut range = Range::default();
        for step in 0..20 {
            range.add(values[0] + f64::from(step) / 19.0 * (values[1] - values[0]));
        }
        range
    }

    /// Returns both motions of the paper's robot without any fault.
    fn healthy() -> Drives {
        let turn_rad_s = 2.0 * 0.2 / RobotModel::yi2007().effective_track_m();
        let turned = DriveSummary {
            commanded: speeds(-2.5, 2.5),
            wheels: Some(speeds(-2.5, 2.5)),
            turn_rad_s: Some(turn_rad_s),
            turn_blocks: vec![
                TurnBlock {
                    difference_rad_s: 5.0,
                    turn_rad_s
                };
                8
            ],
            ranges: Ranges {
                left: moving([0.0, -2.5]),
                right: moving([0.0, 2.5]),
                gyro: moving([0.0, turn_rad_s]),
                ..Ranges::default()
            },
            is_heard: true,
            ..DriveSummary::default()
        };
        let forward = DriveSummary {
            commanded: speeds(2.5, 2.5),
            wheels: Some(speeds(2.5, 2.5)),
            turn_rad_s: Some(0.0),
            odometry_m_s: Some(0.2),
            twist: Some(PlanarTwist {
                x_m_s: 0.2,
                y_m_s: 0.0,
                heading_rad: 2.8,
            }),
            ranges: Ranges {
                left: moving([0.0, 2.5]),
                right: moving([0.0, 2.5]),
                gyro: moving([0.0, 0.001]),
                odometry_forward: moving([0.0, 0.2]),
                ..Ranges::default()
            },
            is_heard: true,
            ..DriveSummary::default()
        };
        Drives { turned, forward }
    }

    /// The paper's base, with its own track width and radius.
    fn keys_of(change: impl Fn(&mut Drives)) -> Vec<&'static str> {
        let mut drives = healthy();
        change(&mut drives);
        let found = findings(&settings(), &RobotModel::yi2007(), &drives, 0.0);
        found.iter().filter_map(|finding| finding.key).collect()
    }

    #[test]
    fn nothing_is_wrong_with_a_healthy_robot() {
        assert_eq!(keys_of(|_| {}), Vec::<&str>::new());
    }

    #[test]
    fn frozen_joints_of_a_robot_that_moved_are_not_a_command_that_nobody_takes() {
        let still = |drives: &mut Drives| {
            for drove in [&mut drives.turned, &mut drives.forward] {
                drove.wheels = Some(speeds(0.0, 0.0));
                drove.ranges.left = moving([0.0, 0.0]);
                drove.ranges.right = moving([0.0, 0.0]);
            }
        };
        assert_eq!(keys_of(still), ["drive.ros2.joints.topic"]);
        let of_a_robot_that_stood = keys_of(|drives| {
            still(drives);
            drives.turned.turn_rad_s = Some(0.001);
            for drove in [&mut drives.turned, &mut drives.forward] {
                drove.ranges.gyro = moving([0.0, 0.001]);
                drove.ranges.odometry_forward = moving([0.0, 0.0]);
            }
        });
        assert_eq!(of_a_robot_that_stood, ["drive.ros2.command.topic"]);
    }

    #[test]
    fn frozen_odometry_is_not_a_radius_of_zero() {
        let frozen = keys_of(|drives| {
            drives.forward.odometry_m_s = Some(0.0);
            drives.forward.twist = None;
            for drove in [&mut drives.turned, &mut drives.forward] {
                drove.ranges.odometry_forward = moving([0.0, 0.0]);
                drove.ranges.odometry_turn = moving([0.0, 0.0]);
            }
        });
        assert_eq!(frozen, ["drive.ros2.odometry.topic"]);
    }

    #[test]
    fn a_twist_of_the_world_is_neither_a_radius_nor_a_sign() {
        let world = keys_of(|Drives { forward, .. }| {
            let heading_rad: f64 = 2.8;
            forward.odometry_m_s = Some(0.2 * heading_rad.cos());
            forward.twist = Some(PlanarTwist {
                x_m_s: 0.2 * heading_rad.cos(),
                y_m_s: 0.2 * heading_rad.sin(),
                heading_rad,
            });
        });
        assert_eq!(world, ["drive.ros2.odometry.child_frame"]);
    }

    #[test]
    fn one_side_inverted_is_a_sign_and_no_twist_after_a_turn_half_around() {
        let inverted = keys_of(|Drives { turned, forward }| {
            turned.wheels = Some(speeds(2.5, 2.5));
            forward.wheels = Some(speeds(-2.5001, 2.5));
            forward.twist = Some(PlanarTwist {
                x_m_s: -0.2,
                y_m_s: 0.001,
                heading_rad: std::f64::consts::PI,
            });
            forward.odometry_m_s = None;
        });
        assert_eq!(inverted, ["drive.ros2.joints.left_sign"]);
    }

    #[test]
    fn a_radius_is_reported_from_the_distance_over_ground_with_the_line_that_mends_it() {
        let mut drives = healthy();
        drives.turned.turn_rad_s = drives.turned.turn_rad_s.map(|rate| 1.25 * rate);
        for block in &mut drives.turned.turn_blocks {
            block.turn_rad_s *= 1.25;
        }
        drives.forward.odometry_m_s = Some(0.25);
        let found = findings(&settings(), &RobotModel::yi2007(), &drives, 0.0);
        let wrong: Vec<_> = found.iter().filter(|finding| !finding.holds).collect();
        let [wrong] = wrong.as_slice() else {
            panic!("{found:#?}");
        };
        assert_eq!(wrong.key, Some("model.wheel_radius_m"));
        assert_eq!(wrong.lines[0].value, "0.100");
    }

    #[test]
    fn one_side_that_stands_is_named() {
        let keys = keys_of(|Drives { turned, forward }| {
            turned.wheels = Some(speeds(0.0, 2.5));
            forward.wheels = Some(speeds(0.001, 2.5));
        });
        assert_eq!(keys, ["drive.ros2.command.topic"]);
    }
}
