//! Receives the messages of one topic: checks them in zenoh's non-blocking callback and queues them
//! for the loop.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, PoisonError};

use tread_ros2::messages::{
    BatteryState, Imu, JointState, Message, MessageType, Odometry, PoseWithCovarianceStamped,
};
use tread_ros2::names::Name;
use tread_ros2::rmw::{Attachment, check_key};

use super::assemble::QueuedMessage;
use super::frames;
use super::reading::{self, Content, Reading};
use super::refusal::{Counts, Notice, Refusal, Source};
use super::settings::{Ros2Settings, Scheme};
use super::stamps::{Arrival, Stamps};
use super::writer_watch::{MessageOrder, WriterWatch};
use crate::clock::SharedClock;
use crate::drive::Arrivals;

/// Capacity of the queue to the loop: enough for a 20 Hz loop and 200 messages a second of each
/// topic.
pub const WAITING_MAX: usize = 128;

/// Observes every message as it arrived, in addition to the loop. Must not block.
pub trait MessageObserver: std::fmt::Debug + Send + Sync {
    /// Called for each message, before any check.
    fn receive(
        &self,
        source: Source,
        arrival: Arrival,
        key: &str,
        attachment: Option<&[u8]>,
        payload: &[u8],
    );
}

/// State of a topic between two messages.
#[derive(Debug, Clone, Copy)]
struct TopicState {
    writer: WriterWatch,
    stamps: Stamps,
}

/// Receiver of the messages of one topic.
#[derive(Debug)]
pub struct TopicReceiver {
    source: Source,
    settings: Arc<Ros2Settings>,
    topic_state: Mutex<TopicState>,
    counts: Arc<Counts>,
    to_loop: SyncSender<QueuedMessage>,
    arrivals: Arc<Arrivals>,
    /// Whether the topic's messages trigger the loop's ticks.
    is_pace: bool,
    clock: SharedClock,
    observer: Option<Arc<dyn MessageObserver>>,
}

impl TopicReceiver {
    /// Creates the receivers of all topics that the settings name.
    pub fn all(
        settings: &Arc<Ros2Settings>,
        counts: &Arc<Counts>,
        to_loop: &SyncSender<QueuedMessage>,
        arrivals: &Arc<Arrivals>,
        clock: &SharedClock,
    ) -> Vec<Self> {
        let timing = settings.timing;
        let pace = settings
            .joints
            .as_ref()
            .map_or(Source::Odometry, |_| Source::Joints);
        let receiver = |source| Self {
            source,
            settings: Arc::clone(settings),
            topic_state: Mutex::new(TopicState {
                writer: WriterWatch::default(),
                stamps: Stamps::new(
                    timing.stamps,
                    match source {
                        Source::Pose => timing.pose_late_after,
                        Source::Odometry | Source::Imu | Source::Joints | Source::Battery => {
                            timing.late_after
                        }
                    },
                ),
            }),
            counts: Arc::clone(counts),
            to_loop: to_loop.clone(),
            arrivals: Arc::clone(arrivals),
            is_pace: source == pace,
            clock: Arc::clone(clock),
            observer: None,
        };
        Source::ALL
            .into_iter()
            .filter(|source| topic_of(settings, *source).is_some())
            .map(receiver)
            .collect()
    }

    /// Sets an observer of every message.
    #[must_use]
    pub fn with_observer(mut self, observer: Option<Arc<dyn MessageObserver>>) -> Self {
        self.observer = observer;
        self
    }

    /// Returns the kind of topic.
    pub fn source(&self) -> Source {
        self.source
    }

    /// Returns the topic's name.
    pub fn topic(&self) -> Option<&Name> {
        topic_of(&self.settings, self.source)
    }

    /// Returns the type of the topic's messages.
    pub fn message_type(&self) -> MessageType {
        type_of(self.source)
    }

    /// Checks a message and queues it, or counts the reason for which it is dropped.
    pub fn take(&self, key: &str, attachment: Option<&[u8]>, payload: &[u8]) {
        self.counts.receive(self.source);
        match self.read(key, attachment, payload) {
            Ok(None) => {}
            Ok(Some(arrived)) => {
                // The message is counted first, so that whoever sees its effect also sees the
                // count.
                self.counts.take(self.source);
                if self.to_loop.try_send(arrived).is_err() {
                    self.counts.refuse(self.source, Refusal::Overflow);
                } else if self.is_pace {
                    self.arrivals.notify();
                }
            }
            Err(refusal) => {
                if refusal == Refusal::WrongFrame {
                    let frames = frames::named(&self.settings, self.source, payload);
                    let others = frames.and_then(|frames| frames::others(&frames));
                    self.counts.set_other_frames(self.source, others);
                }
                self.counts.refuse(self.source, refusal);
            }
        }
    }

    fn read(
        &self,
        key: &str,
        attachment: Option<&[u8]>,
        payload: &[u8],
    ) -> Result<Option<QueuedMessage>, Refusal> {
        let arrival = Arrival {
            monotonic: self.clock.monotonic(),
            wall_ns: self.clock.host_wall_ns(),
        };
        if let Some(observer) = &self.observer {
            observer.receive(self.source, arrival, key, attachment, payload);
        }
        let writer = match self.settings.bus.scheme {
            Scheme::Ros2Dds => None,
            Scheme::RmwZenoh(generation) => {
                check_key(key, &self.message_type(), generation)?;
                let attachment = attachment.and_then(Attachment::from_bytes);
                Some(attachment.ok_or(Refusal::NoAttachment)?)
            }
        };
        let Some((stamp, content)) = decoded(&self.settings, self.source, payload)? else {
            return Ok(None);
        };
        let mut topic_state = self
            .topic_state
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let order = writer
            .map(|message| topic_state.writer.check(&message, arrival.monotonic))
            .transpose()?;
        let at = if matches!(content, Content::Battery(_)) {
            arrival.monotonic
        } else {
            let stamp_ns = stamp.nanoseconds().ok_or(Refusal::Stamp)?;
            let leaps = topic_state.stamps.leaps();
            let placed = topic_state.stamps.place(stamp_ns, arrival)?;
            if topic_state.stamps.leaps() > leaps {
                self.counts.record(self.source, Notice::ClockLeapt);
            }
            placed
        };
        // The watch follows only valid messages, so that repeated data never count as a restarted
        // writer.
        if let Some((message, order)) = writer.zip(order) {
            topic_state
                .writer
                .follow(&message, order, arrival.monotonic);
            match order {
                MessageOrder::Continues => {}
                MessageOrder::Restarted => self.counts.record(self.source, Notice::Restarted),
                MessageOrder::MayHaveRestarted => return Err(Refusal::OutOfOrder),
            }
        }
        Ok(Some(QueuedMessage { at, content }))
    }
}

/// Decodes a message of a topic; `None` for one that does not concern the robot.
///
/// # Errors
/// [`Refusal`]: the reason why the message is not valid.
pub fn decoded(
    settings: &Ros2Settings,
    source: Source,
    payload: &[u8],
) -> Result<Option<Reading>, Refusal> {
    match source {
        Source::Odometry => {
            let odometry = settings.odometry.as_ref();
            odometry
                .map(|odometry| reading::odometry(payload, odometry))
                .transpose()
        }
        Source::Imu => {
            let imu = settings.imu.as_ref();
            imu.map(|imu| reading::imu(payload, imu)).transpose()
        }
        Source::Joints => match &settings.joints {
            Some(joints) => reading::joints(payload, joints),
            None => Ok(None),
        },
        Source::Pose => {
            let pose = settings.pose.as_ref();
            pose.map(|pose| reading::pose(payload, pose)).transpose()
        }
        Source::Battery => reading::battery(payload),
    }
}

/// Returns the name of a topic, if it is read.
pub fn topic_of(settings: &Ros2Settings, source: Source) -> Option<&Name> {
    match source {
        Source::Odometry => settings.odometry.as_ref().map(|odometry| &odometry.topic),
        Source::Imu => settings.imu.as_ref().map(|imu| &imu.topic),
        Source::Joints => settings.joints.as_ref().map(|joints| &joints.topic),
        Source::Pose => settings.pose.as_ref().map(|pose| &pose.topic),
        Source::Battery => settings.battery.as_ref(),
    }
}

/// Returns the type of a topic's messages.
pub fn type_of(source: Source) -> MessageType {
    match source {
        Source::Odometry => Odometry::TYPE,
        Source::Imu => Imu::TYPE,
        Source::Joints => JointState::TYPE,
        Source::Pose => PoseWithCovarianceStamped::TYPE,
        Source::Battery => BatteryState::TYPE,
    }
}

/// Sequence numbers of one writer's messages.
#[derive(Debug, Default)]
pub struct Numbering(AtomicU64);

impl Numbering {
    /// Returns the next number, from 1.
    pub fn next(&self) -> i64 {
        let number = self.0.fetch_add(1, Ordering::Relaxed).saturating_add(1);
        i64::try_from(number).unwrap_or(i64::MAX)
    }
}
