//! Messages to values, by the readers that the agent has for a ROS 2 robot.

use tread_agent::drive::ros2::reading::Content;
use tread_agent::drive::ros2::refusal::{Refusal, Source};
use tread_agent::drive::ros2::settings::{JointSettings, Ros2Settings};
use tread_agent::drive::ros2::topic_receiver::decoded;
use tread_ros2::cdr::{Sequence, decode, encode};
use tread_ros2::messages::{
    Imu, JointState, Odometry, PoseStamped, PoseWithCovariance, PoseWithCovarianceStamped,
};

use super::mapping::{Mapping, POSE};
use super::recording::RawMessage;

/// Longest time over which two positions of a joint are differentiated, seconds.
const DIFFERENTIATED_MAX_S: f64 = 1.0;

/// A value with the times of its message.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Timed {
    /// The kind of topic.
    pub source: Source,
    /// When it was recorded, nanoseconds of the recorder's clock.
    pub logged_ns: i64,
    /// When it was measured, nanoseconds of the writer's clock.
    pub stamp_ns: i64,
    /// The value.
    pub content: Content,
}

/// Messages that were refused, by source and reason.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Refusals(Vec<(Source, Refusal, u64)>);

impl Refusals {
    /// Counts one.
    pub fn count(&mut self, source: Source, refusal: Refusal) {
        let known = self
            .0
            .iter_mut()
            .find(|(of, by, _)| (*of, *by) == (source, refusal));
        match known {
            Some((_, _, count)) => *count += 1,
            None => self.0.push((source, refusal, 1)),
        }
    }

    /// Returns all counts.
    pub fn iter(&self) -> impl Iterator<Item = (Source, Refusal, u64)> {
        self.0.iter().copied()
    }
}

/// Positions of joints, to be differentiated.
#[derive(Debug, Clone, PartialEq)]
struct Positions {
    stamp_ns: i64,
    names: Vec<String>,
    angles_rad: Vec<f64>,
}

/// Reads the messages of a robot.
#[derive(Debug, Clone)]
pub struct Decoder {
    settings: Ros2Settings,
    topics: Vec<(String, Source)>,
    is_plain_pose: bool,
    /// Whether speeds of joints are their differentiated positions even where they are given.
    is_by_positions: bool,
    has_frame: [bool; 3],
    last: Option<Positions>,
    buffer: Vec<u8>,
    /// Messages that were refused.
    pub refusals: Refusals,
}

impl Decoder {
    /// Creates a decoder of the chosen topics.
    pub fn new(mapping: &Mapping, is_by_positions: bool) -> Self {
        let pose = mapping.pose.as_ref();
        let topics = [
            (mapping.joints.as_ref(), Source::Joints),
            (mapping.imu.as_ref(), Source::Imu),
            (mapping.odometry.as_ref(), Source::Odometry),
            (pose.map(|(topic, _)| topic), Source::Pose),
        ];
        let topics = topics
            .into_iter()
            .filter_map(|(topic, source)| Some((topic?.clone(), source)));
        Self {
            settings: mapping.settings.clone(),
            topics: topics.collect(),
            is_plain_pose: pose.is_some_and(|(_, kind)| *kind == POSE),
            is_by_positions,
            has_frame: [false; 3],
            last: None,
            buffer: Vec::new(),
            refusals: Refusals::default(),
        }
    }

    /// Reads a message; `None` for one that is refused, which is counted, or that says nothing of
    /// the robot.
    pub fn take(&mut self, message: RawMessage<'_>) -> Option<Timed> {
        let topic = self.topics.iter().find(|(topic, _)| topic == message.topic);
        let source = topic.map(|(_, source)| *source)?;
        match self.read(source, message.bytes) {
            Ok(Some((stamp_ns, content))) => Some(Timed {
                source,
                logged_ns: message.logged_ns,
                stamp_ns,
                content,
            }),
            Ok(None) => None,
            Err(refusal) => {
                self.refusals.count(source, refusal);
                None
            }
        }
    }

    fn read(&mut self, source: Source, bytes: &[u8]) -> Result<Option<(i64, Content)>, Refusal> {
        let mut buffer = std::mem::take(&mut self.buffer);
        let read = match source {
            Source::Joints => self.with_speeds(bytes, &mut buffer),
            Source::Pose if self.is_plain_pose => with_covariance(bytes, &mut buffer),
            Source::Imu | Source::Odometry | Source::Pose | Source::Battery => Ok(Some(false)),
        };
        let reading = match read {
            Ok(Some(is_rewritten)) => {
                let bytes = if is_rewritten {
                    buffer.as_slice()
                } else {
                    bytes
                };
                self.learn_frames(source, bytes)
                    .and_then(|()| decoded(&self.settings, source, bytes))
            }
            Ok(None) => Ok(None),
            Err(refusal) => Err(refusal),
        };
        self.buffer = buffer;
        let Some((stamp, content)) = reading? else {
            return Ok(None);
        };
        let stamp_ns = stamp.nanoseconds().ok_or(Refusal::Stamp)?;
        Ok(Some((stamp_ns, content)))
    }

    /// Takes the frame of a topic's first message for its frame: another one on the same topic is
    /// another sensor.
    fn learn_frames(&mut self, source: Source, bytes: &[u8]) -> Result<(), Refusal> {
        let has_frame = match source {
            Source::Imu => &mut self.has_frame[0],
            Source::Odometry => &mut self.has_frame[1],
            Source::Pose => &mut self.has_frame[2],
            Source::Joints | Source::Battery => return Ok(()),
        };
        if *has_frame {
            return Ok(());
        }
        let bare = |frame: &str| frame.strip_prefix('/').unwrap_or(frame).to_owned();
        match source {
            Source::Imu => {
                let message: Imu<'_> = decode(bytes)?;
                if let Some(imu) = &mut self.settings.imu {
                    imu.frame = bare(message.header.frame_id);
                }
            }
            Source::Odometry => {
                let message: Odometry<'_> = decode(bytes)?;
                if let Some(odometry) = &mut self.settings.odometry {
                    odometry.frame = bare(message.header.frame_id);
                    odometry.child_frame = bare(message.child_frame_id);
                }
            }
            Source::Pose => {
                let message: PoseWithCovarianceStamped<'_> = decode(bytes)?;
                if let Some(pose) = &mut self.settings.pose {
                    pose.frame = bare(message.header.frame_id);
                }
            }
            Source::Joints | Source::Battery => {}
        }
        *has_frame = true;
        Ok(())
    }

    /// Writes joint states with differentiated positions for speeds, where speeds are missing.
    /// Returns whether it wrote them; `None` for a first message, whose speeds nobody knows.
    fn with_speeds(&mut self, bytes: &[u8], buffer: &mut Vec<u8>) -> Result<Option<bool>, Refusal> {
        let message: JointState<'_> = decode(bytes)?;
        let count = message.name.len();
        let has_speeds = message.velocity.len() == count && !self.is_by_positions;
        let is_ours = self
            .settings
            .joints
            .as_ref()
            .is_some_and(|joints| has_joints(&message, joints));
        if has_speeds || !is_ours {
            return Ok(Some(false));
        }
        if message.position.len() != count {
            return Err(Refusal::Joints);
        }
        let stamp_ns = message.header.stamp.nanoseconds().ok_or(Refusal::Stamp)?;
        let now = Positions {
            stamp_ns,
            names: message.name.iter().map(str::to_owned).collect(),
            angles_rad: message.position.iter().collect(),
        };
        let before = self.last.replace(now.clone());
        let Some(before) = before.filter(|before| before.names == now.names) else {
            return Ok(None);
        };
        #[expect(
            clippy::cast_precision_loss,
            reason = "nanoseconds between two messages"
        )]
        let span_s = stamp_ns.saturating_sub(before.stamp_ns) as f64 * 1.0e-9;
        if span_s <= 0.0 {
            return Err(Refusal::OutOfOrder);
        }
        if span_s > DIFFERENTIATED_MAX_S {
            return Ok(None);
        }
        let pairs = now.angles_rad.iter().zip(&before.angles_rad);
        let speeds: Vec<f64> = pairs.map(|(now, before)| (now - before) / span_s).collect();
        let rewritten = JointState {
            velocity: Sequence::from(speeds.as_slice()),
            ..message
        };
        encode(&rewritten, buffer);
        Ok(Some(true))
    }
}

fn has_joints(message: &JointState<'_>, joints: &JointSettings) -> bool {
    let known = [&joints.left, &joints.right];
    let is_known = |name: &str| {
        known
            .iter()
            .any(|side| side.names.iter().any(|one| one == name))
    };
    message.name.iter().any(is_known)
}

/// Writes a plain pose as one of unknown covariance.
fn with_covariance(bytes: &[u8], buffer: &mut Vec<u8>) -> Result<Option<bool>, Refusal> {
    let message: PoseStamped<'_> = decode(bytes)?;
    let covariant = PoseWithCovarianceStamped {
        header: message.header,
        pose: PoseWithCovariance {
            pose: message.pose,
            ..PoseWithCovariance::default()
        },
    };
    encode(&covariant, buffer);
    Ok(Some(true))
}

#[cfg(test)]
mod tests;
