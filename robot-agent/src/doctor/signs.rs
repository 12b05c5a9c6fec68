//! Finds the wrong signs and sides that explain the responses of wheels, gyro and ground to two
//! commands. Pure.
//!
//! The robot is commanded to turn left on the spot, and then to drive forward. Each flip of
//! [`Flip`] changes some of the responses. Every set of flips is tried, and the smallest set that
//! explains all responses is reported.

use super::finding::{Finding, Key, list};
use crate::drive::ros2::settings::Ros2Settings;

/// Responses of the robot, 1 or -1 for a direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Answers {
    /// Directions of the joints for the turn to the left, `[left, right]`.
    pub(super) turn: [i8; 2],
    /// Directions of the joints for the drive forward, `[left, right]`.
    pub(super) forward: [i8; 2],
    /// Direction of the turn by the gyro, 1 to the left; 0 if unknown.
    pub(super) turned: i8,
    /// Direction of the drive by position or speed over ground, 1 forward; 0 if unknown.
    pub(super) drove: i8,
}

/// A sign or side that is inverted or swapped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Flip {
    /// Left and right joints are swapped.
    Sides,
    /// The left joints report the opposite sign.
    LeftJoints,
    /// The right joints report the opposite sign.
    RightJoints,
    /// For the base a positive turn rate is a turn to the right.
    TurnCommand,
    /// For the base a positive speed is backwards.
    ForwardCommand,
    /// The gyro reports the opposite sign.
    Gyro,
    /// Position or odometry shows the opposite direction.
    Ground,
}

impl Flip {
    const ALL: [Self; 7] = [
        Self::Sides,
        Self::LeftJoints,
        Self::RightJoints,
        Self::TurnCommand,
        Self::ForwardCommand,
        Self::Gyro,
        Self::Ground,
    ];

    fn key(self) -> &'static str {
        match self {
            Self::Sides => "drive.ros2.joints.left",
            Self::LeftJoints => "drive.ros2.joints.left_sign",
            Self::RightJoints => "drive.ros2.joints.right_sign",
            Self::TurnCommand => "drive.ros2.command.turn_sign",
            Self::ForwardCommand => "drive.ros2.command.forward_sign",
            Self::Gyro => "drive.ros2.imu.upside_down",
            Self::Ground => "drive.ros2.pose.topic",
        }
    }

    fn text(self) -> &'static str {
        match self {
            Self::Sides => "left and right joints are swapped",
            Self::LeftJoints => "the left joints say the opposite of what they do",
            Self::RightJoints => "the right joints say the opposite of what they do",
            Self::TurnCommand => "the base takes a turn to the right for positive",
            Self::ForwardCommand => "the base takes backwards for positive",
            Self::Gyro => "the gyro turns the other way: it hangs upside down",
            Self::Ground => "position or odometry says backwards where the robot drove forward",
        }
    }

    fn with_remedy(self, finding: Finding, settings: &Ros2Settings) -> Finding {
        let opposite = |sign: f64| if sign > 0.0 { "-1" } else { "1" };
        let (command, joints) = (&settings.command, settings.joints.as_ref());
        match (self, joints) {
            (Self::Sides, Some(joints)) => finding
                .with_line(Key("drive.ros2.joints.left"), list(&joints.right.names))
                .with_line(Key("drive.ros2.joints.right"), list(&joints.left.names)),
            (Self::LeftJoints, Some(joints)) => {
                let sign = opposite(joints.left.sign);
                finding.with_line(Key("drive.ros2.joints.left_sign"), sign)
            }
            (Self::RightJoints, Some(joints)) => {
                let sign = opposite(joints.right.sign);
                finding.with_line(Key("drive.ros2.joints.right_sign"), sign)
            }
            (Self::TurnCommand, _) => {
                let sign = opposite(command.turn_sign);
                finding.with_line(Key("drive.ros2.command.turn_sign"), sign)
            }
            (Self::ForwardCommand, _) => {
                let sign = opposite(command.forward_sign);
                finding.with_line(Key("drive.ros2.command.forward_sign"), sign)
            }
            (Self::Gyro, _) => match &settings.imu {
                Some(imu) => {
                    let upside_down = (!imu.is_upside_down).to_string();
                    finding.with_line(Key("drive.ros2.imu.upside_down"), upside_down)
                }
                None => finding,
            },
            (Self::Sides | Self::LeftJoints | Self::RightJoints | Self::Ground, _) => finding,
        }
    }
}

/// Returns the responses of a robot with these flips.
fn predicted(flips: &[Flip]) -> Answers {
    let sign = |flip: Flip| if flips.contains(&flip) { -1 } else { 1 };
    let (turned, drove) = (sign(Flip::TurnCommand), sign(Flip::ForwardCommand));
    let joints = |left: i8, right: i8| {
        let [left, right] = if flips.contains(&Flip::Sides) {
            [right, left]
        } else {
            [left, right]
        };
        [
            left * sign(Flip::LeftJoints),
            right * sign(Flip::RightJoints),
        ]
    };
    Answers {
        turn: joints(-turned, turned),
        forward: joints(drove, drove),
        turned: turned * sign(Flip::Gyro),
        drove: drove * sign(Flip::Ground),
    }
}

/// Returns the smallest sets of flips that explain the responses; one empty set for a robot without
/// fault.
pub(super) fn explanations(answers: Answers) -> Vec<Vec<Flip>> {
    let agrees = |known: i8, predicted: i8| known == 0 || known == predicted;
    let mut found: Vec<Vec<Flip>> = (0..1_u32 << Flip::ALL.len())
        .map(|set| {
            let flips = Flip::ALL.into_iter().enumerate();
            flips
                .filter(|(index, _)| set & (1 << index) != 0)
                .map(|(_, flip)| flip)
                .collect::<Vec<_>>()
        })
        .filter(|flips| {
            let predicted = predicted(flips);
            answers.turn == predicted.turn
                && answers.forward == predicted.forward
                && agrees(answers.turned, predicted.turned)
                && agrees(answers.drove, predicted.drove)
        })
        .collect();
    let least = found.iter().map(Vec::len).min().unwrap_or(0);
    found.retain(|flips| flips.len() == least);
    found
}

/// Returns the finding on sides and signs.
pub(super) fn finding(answers: Answers, settings: &Ros2Settings) -> Finding {
    let explanations = explanations(answers);
    let Some(flips) = explanations.first() else {
        let text = "the wheels do not do what they are commanded, in no way that signs explain";
        return Finding::on("sides").wrong(Key("drive.ros2.joints.left"), text);
    };
    let Some(first) = flips.first() else {
        return Finding::on("sides")
            .ok("wheels, gyro, ground and command agree on left and forward");
    };
    let sentence = |flips: &[Flip]| {
        let texts: Vec<_> = flips.iter().map(|flip| flip.text()).collect();
        texts.join(", and ")
    };
    let mut text = sentence(flips);
    for other in &explanations[1..] {
        text = format!("{text}; or {}", sentence(other));
    }
    let is_odometrys = *first == Flip::Ground && settings.pose.is_none();
    let key = if is_odometrys {
        "drive.ros2.odometry.topic"
    } else {
        first.key()
    };
    let finding = Finding::on("sides").wrong(Key(key), text);
    if explanations.len() > 1 {
        // Several sets of flips explain the responses, so a person has to decide.
        return finding;
    }
    let remedied = |finding, flip: &Flip| flip.with_remedy(finding, settings);
    flips.iter().fold(finding, remedied)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::drive::ros2::tests::settings;

    /// Independent simulation of a robot: the motion of its wheels, and what its sensors report.
    fn robot(flips: &[Flip], sees_ground: bool) -> Answers {
        let is = |flip| flips.contains(&flip);
        let drive = |forward: f64, turn: f64| {
            let forward = if is(Flip::ForwardCommand) {
                -forward
            } else {
                forward
            };
            let turn = if is(Flip::TurnCommand) { -turn } else { turn };
            let (left, right) = (forward - turn, forward + turn);
            let (mut first, mut second) = if is(Flip::Sides) {
                (right, left)
            } else {
                (left, right)
            };
            if is(Flip::LeftJoints) {
                first = -first;
            }
            if is(Flip::RightJoints) {
                second = -second;
            }
            let gyro = if is(Flip::Gyro) { -turn } else { turn };
            let ground = if is(Flip::Ground) { -forward } else { forward };
            (first, second, gyro, ground)
        };
        let sign = |value: f64| if value > 0.0 { 1 } else { -1 };
        let (turn, forward) = (drive(0.0, 1.0), drive(1.0, 0.0));
        Answers {
            turn: [sign(turn.0), sign(turn.1)],
            forward: [sign(forward.0), sign(forward.1)],
            turned: sign(turn.2),
            drove: if sees_ground { sign(forward.3) } else { 0 },
        }
    }

    #[test]
    fn every_single_flip_is_named_alone_and_nothing_of_a_healthy_robot() {
        for sees_ground in [true, false] {
            assert!(finding(robot(&[], sees_ground), &settings()).holds);
            for flip in Flip::ALL {
                if flip == Flip::Ground && !sees_ground {
                    continue;
                }
                let found = explanations(robot(&[flip], sees_ground));
                assert_eq!(found, [vec![flip]], "{flip:?} {sees_ground}");
            }
        }
    }

    #[test]
    fn both_signs_of_the_command_are_named_and_not_the_joints() {
        let flips = [Flip::TurnCommand, Flip::ForwardCommand];
        for sees_ground in [true, false] {
            let found = finding(robot(&flips, sees_ground), &settings());
            assert_eq!(found.key, Some("drive.ros2.command.turn_sign"));
            let lines: Vec<_> = found
                .lines
                .iter()
                .map(|line| (line.key, line.value.as_str()))
                .collect();
            assert_eq!(lines, [("turn_sign", "-1"), ("forward_sign", "-1")]);
        }
    }

    #[test]
    fn swapped_sides_come_with_the_lines_that_swap_them() {
        let found = finding(robot(&[Flip::Sides], true), &settings());
        let lines: Vec<_> = found
            .lines
            .iter()
            .map(|line| (line.key, line.value.as_str()))
            .collect();
        assert_eq!(lines, [("left", "[\"right\"]"), ("right", "[\"left\"]")]);
    }

    #[test]
    fn a_sign_that_is_set_already_is_taken_back() {
        let mut settings = settings();
        settings.command.turn_sign = -1.0;
        let found = finding(robot(&[Flip::TurnCommand], true), &settings);
        assert_eq!(found.lines[0].value, "1");
    }

    proptest! {
        /// The reported flips explain all responses, with at most as many flips as there are.
        #[test]
        fn what_is_named_explains_the_answers(set in 0_u32..128, sees_ground: bool) {
            let flips: Vec<Flip> = Flip::ALL
                .into_iter()
                .enumerate()
                .filter(|(index, _)| set & (1 << index) != 0)
                .map(|(_, flip)| flip)
                .collect();
            let answers = robot(&flips, sees_ground);
            let found = explanations(answers);
            prop_assert!(!found.is_empty());
            for named in &found {
                prop_assert!(named.len() <= flips.len());
                prop_assert_eq!(robot(named, sees_ground), answers);
            }
        }
    }
}
