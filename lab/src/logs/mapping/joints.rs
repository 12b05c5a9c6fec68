//! Names of a robot's joints, and which side they are on.

use std::collections::BTreeSet;
use std::ops::ControlFlow;

use tread_agent::drive::ros2::settings::{Effort, JOINTS_MAX, JointSettings, SideJoints};
use tread_ros2::cdr::decode;
use tread_ros2::messages::JointState;
use tread_ros2::names::Name;

use super::{MappingError, RequestedTopics};
use crate::logs::recording::{Recording, RecordingError};

/// Messages of a topic in which the names of joints are looked for.
const LOOKED_AT_MAX: u32 = 100;

/// Names of the joints of both sides.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JointNames {
    /// Left ones.
    pub left: Vec<String>,
    /// Right ones.
    pub right: Vec<String>,
}

impl std::str::FromStr for JointNames {
    type Err = String;

    /// Parses `left,left/right,right`.
    fn from_str(text: &str) -> Result<Self, String> {
        let names = |side: &str| -> Vec<String> {
            let names = side
                .split(',')
                .map(str::trim)
                .filter(|name| !name.is_empty());
            names.map(str::to_owned).collect()
        };
        let (left, right) = text.split_once('/').ok_or(
            "a slash must stand between the left and the right joints: `left_wheel/right_wheel`",
        )?;
        let (left, right) = (names(left), names(right));
        let is_right = |count: usize| (1..=JOINTS_MAX).contains(&count);
        if is_right(left.len()) && is_right(right.len()) {
            Ok(Self { left, right })
        } else {
            Err(format!("each side has 1 to {JOINTS_MAX} joints"))
        }
    }
}

/// Returns the names of the joints in the first messages of a topic.
fn names_of(recording: &Recording, topic: &str) -> Result<Vec<String>, RecordingError> {
    let (mut names, mut looked_at) = (BTreeSet::new(), 0);
    recording.read(&[topic], &mut |message| {
        if let Ok(joints) = decode::<JointState<'_>>(message.bytes) {
            names.extend(joints.name.iter().map(str::to_owned));
        }
        looked_at += 1;
        if looked_at < LOOKED_AT_MAX {
            ControlFlow::Continue(())
        } else {
            ControlFlow::Break(())
        }
    })?;
    Ok(names.into_iter().collect())
}

/// Whether a name has a word, however words are joined: `front_left_wheel`, `frontLeftWheel`.
fn has_word(name: &str, words: [&str; 2]) -> bool {
    let [long, short] = words;
    let lower = name.to_lowercase();
    let mut parts = lower.split(|letter: char| !letter.is_ascii_alphanumeric());
    lower.contains(long) || parts.any(|part| part == short)
}

/// Chooses the joints of the sides by the words in their names; `None` where that is ambiguous.
pub fn sides_of(names: &[String]) -> Option<JointNames> {
    let of = |words: [&'static str; 2], others: [&'static str; 2]| -> Vec<String> {
        let mine = names
            .iter()
            .filter(|name| has_word(name, words) && !has_word(name, others));
        mine.cloned().collect()
    };
    let (left_words, right_words) = (["left", "l"], ["right", "r"]);
    let (left, right) = (of(left_words, right_words), of(right_words, left_words));
    let is_even = left.len() == right.len() && (1..=JOINTS_MAX).contains(&left.len());
    is_even.then_some(JointNames { left, right })
}

/// Chooses the joints of a topic: the ones that are asked for, those of the configuration, or those
/// that their names tell.
pub(super) fn joint_settings(
    recording: &Recording,
    topic: &str,
    configured: Option<&JointSettings>,
    requested: &RequestedTopics,
) -> Result<JointSettings, MappingError> {
    let names = names_of(recording, topic)?;
    let listed = || {
        let quoted: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
        quoted.join(", ")
    };
    let of_configuration = configured.map(|joints| JointNames {
        left: joints.left.names.clone(),
        right: joints.right.names.clone(),
    });
    let chosen = requested.joints.clone().or(of_configuration);
    let chosen = chosen.or_else(|| sides_of(&names));
    let chosen = chosen.ok_or_else(|| MappingError::Joints {
        topic: topic.to_owned(),
        names: listed(),
    })?;
    let mut all = chosen.left.iter().chain(&chosen.right);
    if let Some(joint) = all.find(|joint| !names.contains(joint)) {
        return Err(MappingError::NoJoint {
            topic: topic.to_owned(),
            joint: joint.clone(),
            names: listed(),
        });
    }
    let side =
        |names: Vec<String>, is_reversed: bool, configured: Option<&SideJoints>| SideJoints {
            names,
            sign: if is_reversed {
                -1.0
            } else {
                configured.map_or(1.0, |side| side.sign)
            },
            effort_sign: configured.map_or(1.0, |side| side.effort_sign),
        };
    let [is_left_reversed, is_right_reversed] = requested.reversed;
    let ratio = requested
        .gear_ratio
        .or(configured.map(|joints| joints.gear_ratio));
    let effort = requested.effort.or(configured.map(|joints| joints.effort));
    Ok(JointSettings {
        topic: Name::default(),
        left: side(
            chosen.left,
            is_left_reversed,
            configured.map(|joints| &joints.left),
        ),
        right: side(
            chosen.right,
            is_right_reversed,
            configured.map(|joints| &joints.right),
        ),
        gear_ratio: ratio.unwrap_or(1.0),
        effort: effort.unwrap_or(Effort::None),
    })
}
