//! Reasons for which messages of the base are dropped, and events on their topics, with their counts
//! and recent changes.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use tread_ros2::cdr::CdrError;
use tread_ros2::rmw::KeyMismatch;

/// An event on a topic that is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Notice {
    /// The topic's writer restarted, or another writer replaced a silent one.
    Restarted,
    /// The message stamps jumped, and the new ones are accepted.
    ClockLeapt,
}

impl Notice {
    /// All events.
    pub const ALL: [Self; 2] = [Self::Restarted, Self::ClockLeapt];

    pub(super) fn text(self) -> &'static str {
        match self {
            Self::Restarted => "started again and is heard again",
            Self::ClockLeapt => "set its clock anew and is heard again",
        }
    }

    /// Returns the alert code, for programs.
    pub fn code(self) -> &'static str {
        match self {
            Self::Restarted => "base-restarted",
            Self::ClockLeapt => "base-clock",
        }
    }
}

/// Why a message was dropped. A dropped message does not count as a sign of life: a base that sends
/// no other counts as silent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// A message of another type on the topic.
    WrongType,
    /// The type has the expected name but another definition.
    WrongHash,
    /// No attachment, or one of invalid form.
    NoAttachment,
    /// Too short, too long, or inconsistent with its type.
    Malformed,
    /// Another frame than the configured one.
    WrongFrame,
    /// Some of the robot's joints are missing, or the lists have unequal lengths.
    Joints,
    /// A value that is not finite, not a rotation, or physically impossible.
    Value,
    /// An invalid covariance.
    Covariance,
    /// An invalid stamp, or one that jumped.
    Stamp,
    /// Older than the configured limit.
    Late,
    /// Not newer than the previous message.
    OutOfOrder,
    /// Another writer on a topic whose writer is active.
    SecondWriter,
    /// The wheels stand still although commanded to turn.
    Disobedient,
    /// The wheels turn differently from their command: another node may command them.
    OtherMotion,
    /// Another node commands the base while the agent drives it.
    Contested,
    /// The queue to the loop was full.
    Overflow,
}

impl Refusal {
    /// All reasons.
    pub const ALL: [Self; 16] = [
        Self::WrongType,
        Self::WrongHash,
        Self::NoAttachment,
        Self::Malformed,
        Self::WrongFrame,
        Self::Joints,
        Self::Value,
        Self::Covariance,
        Self::Stamp,
        Self::Late,
        Self::OutOfOrder,
        Self::SecondWriter,
        Self::Disobedient,
        Self::OtherMotion,
        Self::Contested,
        Self::Overflow,
    ];

    /// Description for people.
    pub fn text(self) -> &'static str {
        match self {
            Self::WrongType => "messages of another type",
            Self::WrongHash => "messages of another definition of the type",
            Self::NoAttachment => "messages without attachment",
            Self::Malformed => "messages that are not what their type says",
            Self::WrongFrame => "messages of another frame",
            Self::Joints => "messages without the robot's joints",
            Self::Value => "messages with impossible values",
            Self::Covariance => "messages with an impossible covariance",
            Self::Stamp => "messages whose time stamp leapt",
            Self::Late => "messages that came late",
            Self::OutOfOrder => "messages that came twice or out of order",
            Self::SecondWriter => "messages of a second writer",
            Self::Disobedient => "messages of wheels that do not follow their command",
            Self::OtherMotion => {
                "messages of wheels that turn otherwise than commanded, as if another node commands \
                 the base,"
            }
            Self::Contested => "messages of wheels that another node commands too",
            Self::Overflow => "more messages than could be taken",
        }
    }
}

impl Refusal {
    /// Part of an alert's code, for programs.
    pub fn code(self) -> &'static str {
        match self {
            Self::WrongType => "type",
            Self::WrongHash => "definition",
            Self::NoAttachment => "attachment",
            Self::Malformed => "malformed",
            Self::WrongFrame => "frame",
            Self::Joints => "joints",
            Self::Value => "value",
            Self::Covariance => "covariance",
            Self::Stamp => "stamp",
            Self::Late => "late",
            Self::OutOfOrder => "order",
            Self::SecondWriter => "second-writer",
            Self::Disobedient => "disobedient",
            Self::OtherMotion => "other-motion",
            Self::Contested => "contested",
            Self::Overflow => "overflow",
        }
    }
}

impl From<CdrError> for Refusal {
    fn from(_: CdrError) -> Self {
        Self::Malformed
    }
}

impl From<KeyMismatch> for Refusal {
    fn from(mismatch: KeyMismatch) -> Self {
        match mismatch {
            KeyMismatch::Type => Self::WrongType,
            KeyMismatch::Hash => Self::WrongHash,
        }
    }
}

/// A topic that is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// Odometry.
    Odometry,
    /// The inertial measurement unit.
    Imu,
    /// The joints.
    Joints,
    /// The pose.
    Pose,
    /// The battery.
    Battery,
}

impl Source {
    /// All topics.
    pub const ALL: [Self; 5] = [
        Self::Odometry,
        Self::Imu,
        Self::Joints,
        Self::Pose,
        Self::Battery,
    ];

    /// Topics without which the base counts as silent.
    pub const OF_BASE: [Self; 3] = [Self::Odometry, Self::Imu, Self::Joints];
    /// Topics that are published continuously; a battery may be published rarely.
    pub const CONTINUOUS: [Self; 4] = [Self::Odometry, Self::Imu, Self::Joints, Self::Pose];

    /// Returns the name of the topic's section in `robot.toml`.
    pub fn section(self) -> &'static str {
        match self {
            Self::Odometry => "odometry",
            Self::Imu => "imu",
            Self::Joints => "joints",
            Self::Pose => "pose",
            Self::Battery => "battery",
        }
    }
}

/// Numbers of messages used and dropped, by topic and reason, and of other events on the bus.
#[derive(Debug, Default)]
pub struct Counts {
    received: [AtomicU64; Source::ALL.len()],
    taken: [AtomicU64; Source::ALL.len()],
    dropped: [[AtomicU64; Refusal::ALL.len()]; Source::ALL.len()],
    noted: [[AtomicU64; Notice::ALL.len()]; Source::ALL.len()],
    foreign_commands: AtomicU64,
    /// Frames of the last message that was dropped for them, with the configured ones, for people.
    other_frames: [Mutex<Option<String>>; Source::ALL.len()],
    /// Names of the configured topics.
    topics: [Option<String>; Source::ALL.len()],
}

impl Counts {
    /// Creates the counts of the configured topics, whose names `topic_of` returns.
    pub fn of(topic_of: impl Fn(Source) -> Option<String>) -> Self {
        Self {
            topics: Source::ALL.map(topic_of),
            ..Self::default()
        }
    }

    /// Counts a message that came, whether it is used or not.
    pub fn receive(&self, source: Source) {
        self.received[source as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Returns a text that names the configured topics of `sources` without any message since the
    /// start; `None` if every one has had a message.
    pub fn topics_without_messages(&self, sources: &[Source]) -> Option<String> {
        let is_missing = |source: &Source| {
            let received = &self.received[*source as usize];
            received.load(Ordering::Relaxed) == 0
        };
        let topics: Vec<String> = sources
            .iter()
            .copied()
            .filter(is_missing)
            .filter_map(|source| {
                let topic = self.topics[source as usize].as_ref()?;
                Some(format!("`{topic}` ({})", source.section()))
            })
            .collect();
        let topics = topics.join(", ");
        (!topics.is_empty()).then(|| format!("no message has come on {topics} since the start"))
    }

    /// Counts a message that was used.
    pub fn take(&self, source: Source) {
        self.taken[source as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a message that was dropped.
    pub fn refuse(&self, source: Source, refusal: Refusal) {
        self.dropped[source as usize][refusal as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Sets the description of the frames for which a message of a topic is dropped.
    pub fn set_other_frames(&self, source: Source, others: Option<String>) {
        let frames = &self.other_frames[source as usize];
        *frames.lock().unwrap_or_else(PoisonError::into_inner) = others;
    }

    /// Returns the description of the frames for which a message of a topic was dropped last.
    fn other_frames(&self, source: Source) -> Option<String> {
        let frames = &self.other_frames[source as usize];
        frames
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    /// Returns the number of messages of a topic that were used.
    pub fn taken(&self, source: Source) -> u64 {
        self.taken[source as usize].load(Ordering::Relaxed)
    }

    /// Returns the number of messages of a topic that were dropped for a reason.
    pub fn dropped(&self, source: Source, refusal: Refusal) -> u64 {
        self.dropped[source as usize][refusal as usize].load(Ordering::Relaxed)
    }

    /// Counts an event on a topic.
    pub fn record(&self, source: Source, notice: Notice) {
        self.noted[source as usize][notice as usize].fetch_add(1, Ordering::Relaxed);
    }

    /// Returns the number of these events on a topic.
    pub fn noted(&self, source: Source, notice: Notice) -> u64 {
        self.noted[source as usize][notice as usize].load(Ordering::Relaxed)
    }

    /// Counts a command of another node.
    pub fn count_foreign_command(&self) {
        self.foreign_commands.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns the number of commands that other nodes wrote on the command topic.
    pub fn foreign_commands(&self) -> u64 {
        self.foreign_commands.load(Ordering::Relaxed)
    }

    /// Returns each topic and reason with dropped messages, and their number.
    pub fn drops(&self) -> impl Iterator<Item = (Source, Refusal, u64)> + '_ {
        Source::ALL
            .into_iter()
            .flat_map(|source| Refusal::ALL.map(|refusal| (source, refusal)))
            .map(|(source, refusal)| (source, refusal, self.dropped(source, refusal)))
            .filter(|(_, _, times)| *times > 0)
    }
}

/// Number of checks without a new event after which it is no longer reported.
pub(super) const QUIET_CHECKS: u32 = 10;

/// Detects recently dropped messages by comparing the counts at intervals.
#[derive(Debug, Clone, Copy, Default)]
pub struct DropMonitor {
    before: [[u64; Refusal::ALL.len()]; Source::ALL.len()],
    worst: Option<(Source, Refusal)>,
    quiet_checks: u32,
}

impl DropMonitor {
    /// Runs one check; returns the most frequent recent reason and its description for people,
    /// `None` if nothing was dropped recently.
    pub fn check(&mut self, counts: &Counts) -> Option<(Refusal, String)> {
        let mut most = 0;
        for (source, refusal, times) in counts.drops() {
            let before = &mut self.before[source as usize][refusal as usize];
            let new = times - std::mem::replace(before, times).min(times);
            if new > most {
                (most, self.worst) = (new, Some((source, refusal)));
            }
        }
        self.quiet_checks = if most > 0 { 0 } else { self.quiet_checks + 1 };
        if self.quiet_checks > QUIET_CHECKS {
            self.worst = None;
        }
        let (source, refusal) = self.worst?;
        let times = counts.dropped(source, refusal);
        let (text, section) = (refusal.text(), source.section());
        let mut text = format!("{text} are dropped ({section}, {times} so far)");
        if refusal == Refusal::WrongFrame
            && let Some(frames) = counts.other_frames(source)
        {
            text = format!("{text}: {frames}");
        }
        Some((refusal, text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_dropped_most_of_late_is_said_until_it_is_over() {
        let (counts, mut drop_monitor) = (Counts::default(), DropMonitor::default());
        assert_eq!(drop_monitor.check(&counts), None);
        for _ in 0..3 {
            counts.refuse(Source::Imu, Refusal::Late);
        }
        counts.refuse(Source::Odometry, Refusal::Value);
        let (_, text) = drop_monitor.check(&counts).unwrap();
        assert_eq!(text, "messages that came late are dropped (imu, 3 so far)");
        counts.refuse(Source::Odometry, Refusal::Value);
        let (_, text) = drop_monitor.check(&counts).unwrap();
        assert_eq!(
            text,
            "messages with impossible values are dropped (odometry, 2 so far)"
        );
        for _ in 0..QUIET_CHECKS {
            assert!(drop_monitor.check(&counts).is_some());
        }
        assert_eq!(drop_monitor.check(&counts), None);
        assert_eq!(counts.drops().count(), 2);
    }
}
