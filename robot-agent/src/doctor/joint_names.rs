//! Collects joint names, and guesses which are those of the left and the right wheels. Pure.

use super::finding::{Finding, Key, list};
use crate::drive::ros2::settings::JointSettings;

/// Largest number of names that are printed.
const SHOWN_MAX: usize = 24;

/// Names in the received messages, each once, in order of arrival.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(super) struct JointNames(Vec<String>);

impl JointNames {
    /// Adds the names of a message.
    pub(super) fn add<'a>(&mut self, names: impl Iterator<Item = &'a str>) {
        for name in names {
            if !self.0.iter().any(|known| known == name) {
                self.0.push(name.to_owned());
            }
        }
    }

    /// Lists the names, for people.
    pub(super) fn text(&self) -> String {
        let shown: Vec<_> = self
            .0
            .iter()
            .take(SHOWN_MAX)
            .map(|name| format!("`{name}`"))
            .collect();
        let more = self.0.len().saturating_sub(SHOWN_MAX);
        match (shown.is_empty(), more) {
            (true, _) => "no joints".to_owned(),
            (false, 0) => shown.join(", "),
            (false, more) => format!("{} and {more} more", shown.join(", ")),
        }
    }

    /// Returns the finding on the configured names; `None` if all were received.
    pub(super) fn finding(&self, joints: &JointSettings) -> Option<Finding> {
        let missing = |names: &[String]| -> Vec<String> {
            let is_missing = |name: &&String| !self.0.contains(name);
            names.iter().filter(is_missing).cloned().collect()
        };
        let (left, right) = (missing(&joints.left.names), missing(&joints.right.names));
        let key = match (left.is_empty(), right.is_empty()) {
            (true, true) => return None,
            (false, _) => "drive.ros2.joints.left",
            (true, false) => "drive.ros2.joints.right",
        };
        let missing: Vec<_> = left
            .iter()
            .chain(&right)
            .map(|name| format!("`{name}`"))
            .collect();
        let text = format!(
            "`{}` names {}, and of the configured joints it lacks {}",
            joints.topic,
            self.text(),
            missing.join(", ")
        );
        let finding = Finding::on("joints").wrong(Key(key), text);
        Some(match self.sides() {
            Some((left, right)) => finding
                .with_line(Key("drive.ros2.joints.left"), list(&left))
                .with_line(Key("drive.ros2.joints.right"), list(&right)),
            None => finding,
        })
    }

    /// Returns the wheel joints of each side, `(left, right)`, if their names show the side.
    fn sides(&self) -> Option<(Vec<String>, Vec<String>)> {
        let is_wheel = |name: &&String| name.to_lowercase().contains("wheel");
        let wheels: Vec<&String> = self.0.iter().filter(is_wheel).collect();
        let candidates: Vec<&String> = if wheels.is_empty() {
            self.0.iter().collect()
        } else {
            wheels
        };
        let of = |side: Side| -> Vec<String> {
            let names = candidates.iter().filter(|name| side_of(name) == Some(side));
            names.map(|name| (*name).clone()).collect()
        };
        let (left, right) = (of(Side::Left), of(Side::Right));
        (!left.is_empty() && left.len() == right.len()).then_some((left, right))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Side {
    Left,
    Right,
}

/// Returns the side in a joint's name, by a word such as `left`, `l`, `fl` or `rear_r`.
fn side_of(name: &str) -> Option<Side> {
    let name = name.to_lowercase();
    match (name.contains("left"), name.contains("right")) {
        (true, false) => return Some(Side::Left),
        (false, true) => return Some(Side::Right),
        (true, true) => return None,
        (false, false) => {}
    }
    let words = name.split(|character: char| !character.is_ascii_alphabetic());
    let mut sides = words.filter_map(|word| match word {
        "l" | "fl" | "ml" | "rl" | "bl" | "lf" | "lm" | "lb" | "lr" => Some(Side::Left),
        "r" | "fr" | "mr" | "rr" | "br" | "rf" | "rm" | "rb" => Some(Side::Right),
        _ => None,
    });
    sides.next()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drive::ros2::tests::settings;

    fn names(names: &[&str]) -> JointNames {
        let mut heard = JointNames::default();
        heard.add(names.iter().copied());
        heard
    }

    #[test]
    fn renamed_joints_are_listed_with_the_lines_that_name_them() {
        let joints = settings().joints.unwrap();
        for (heard, left, right) in [
            (
                ["fl_wheel", "fr_wheel", "rl_wheel", "rr_wheel"],
                "[\"fl_wheel\", \"rl_wheel\"]",
                "[\"fr_wheel\", \"rr_wheel\"]",
            ),
            (
                [
                    "wheel_front_left",
                    "wheel_front_right",
                    "wheel_left_2",
                    "wheel_right_2",
                ],
                "[\"wheel_front_left\", \"wheel_left_2\"]",
                "[\"wheel_front_right\", \"wheel_right_2\"]",
            ),
            (
                ["drive-l1", "drive.r1", "arm_l", "gripper"],
                "[\"arm_l\"]",
                "",
            ),
        ] {
            let finding = names(&heard).finding(&joints).unwrap();
            assert_eq!(finding.key, Some("drive.ros2.joints.left"));
            assert!(
                heard.iter().all(|name| finding.text.contains(name)),
                "{}",
                finding.text
            );
            assert!(
                finding.text.contains("lacks `left`, `right`"),
                "{}",
                finding.text
            );
            if !right.is_empty() {
                let lines: Vec<_> = finding
                    .lines
                    .iter()
                    .map(|line| line.value.as_str())
                    .collect();
                assert_eq!(lines, [left, right]);
            }
        }
    }

    #[test]
    fn joints_of_one_side_that_are_missing_are_named_by_that_side() {
        let joints = settings().joints.unwrap();
        assert_eq!(names(&["left", "right", "arm"]).finding(&joints), None);
        let finding = names(&["left", "arm"]).finding(&joints).unwrap();
        assert_eq!(finding.key, Some("drive.ros2.joints.right"));
        assert!(finding.lines.is_empty(), "nothing says which joint it is");
    }

    #[test]
    fn a_name_that_says_no_side_or_both_is_no_ones() {
        for name in ["wheel_1", "left_right_wheel", "roller", "laser"] {
            assert_eq!(side_of(name), None, "{name}");
        }
        assert_eq!(side_of("Wheel-FL"), Some(Side::Left));
        assert_eq!(side_of("joint_wheel_rr_2"), Some(Side::Right));
    }
}
