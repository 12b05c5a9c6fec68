//! The thread that writes records: files of bounded size and bounded number.
//!
//! Each second the open chunk is closed and handed to the operating system, so that a file torn by
//! a crash is readable up to there. The files follow ROS 2's conventions for MCAP: profile, CDR
//! messages with their definitions, and the quality of service of each channel. A disk error ends
//! the file; it is logged, and a new file is tried after [`RETRY_EVERY`].

use std::collections::BTreeMap;
use std::fmt;
use std::fs::{self, File};
use std::io::{self, BufWriter, Seek, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::time::Duration;

use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{Compression, McapError, WriteOptions, Writer};
use serde::Serialize;
use tracing::{error, info, warn};
use tread_control::robot::RobotModel;
use tread_ros2::cdr::encode;
use tread_ros2::definitions::schema;
use tread_ros2::messages::tread::{self, LoopSample};
use tread_ros2::messages::{
    DiagnosticArray, Imu, JointState, Message, Odometry, Path as PathMessage,
    PoseWithCovarianceStamped, Text, TwistStamped,
};

use super::{CommandMessage, CommandRecord, RunHead, SafetyMessage, codec, topics, views};
use crate::clock::SharedClock;
use crate::config::recording::RecordingConfig;
use crate::control_loop::frame::{Note, Notes, RecordedCommand, TickFrame};
use crate::control_loop::job::JobOrigin;
use crate::safety::LoopView;

/// Interval at which written data are handed to the operating system.
const FLUSH_EVERY: Duration = Duration::from_secs(1);
/// Pause after a disk error.
const RETRY_EVERY: Duration = Duration::from_secs(10);
/// Interval of the diagnostics messages.
const DIAGNOSTICS_EVERY: Duration = Duration::from_secs(1);
/// Prefix and suffix of the records' file names.
const NAME: (&str, &str) = ("tread-", ".mcap");

/// A file that counts the bytes written to it.
#[derive(Debug)]
struct CountingFile {
    file: BufWriter<File>,
    bytes: Arc<AtomicU64>,
}

impl Write for CountingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.file.write(bytes)?;
        self.bytes.fetch_add(written as u64, Ordering::Relaxed);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// A record that is being written.
struct OpenRecord {
    writer: Writer<NoSeek<CountingFile>>,
    channels: BTreeMap<&'static str, (u16, u32)>,
    bytes: Arc<AtomicU64>,
    flushed: Duration,
}

/// MCAP profile of ROS 2 tools.
const PROFILE: &str = "ros2";
/// Key of the channel metadata with the quality of service of the publisher, which ROS 2 tools
/// require.
const QOS_KEY: &str = "offered_qos_profiles";
/// Default quality of service of a ROS 2 publisher: reliable, volatile, keep last ten. In the
/// numeric notation of recordings; infinite durations are the largest representable ones.
const QOS: &str = "- history: 1
  depth: 10
  reliability: 1
  durability: 2
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false";

/// Package and name of a message type.
type Kind = (&'static str, &'static str);

const fn kind<'a, T: Message<'a>>() -> Kind {
    (T::TYPE.package, T::TYPE.name)
}

/// Channels of a record, in the order of their numbers, from 1.
const CHANNELS: [(&str, Kind); 11] = [
    (topics::RUN, kind::<Text<'_>>()),
    (topics::COMMAND, kind::<Text<'_>>()),
    (topics::SAFETY, kind::<Text<'_>>()),
    (topics::TICK, (tread::PACKAGE, tread::LOOP_TICK)),
    (topics::ODOMETRY, kind::<Odometry<'_>>()),
    (topics::COMMANDED, kind::<TwistStamped<'_>>()),
    (topics::IMU, kind::<Imu<'_>>()),
    (topics::JOINTS, kind::<JointState<'_>>()),
    (topics::POSE, kind::<PoseWithCovarianceStamped<'_>>()),
    (topics::PLAN, kind::<PathMessage<'_>>()),
    (topics::DIAGNOSTICS, kind::<DiagnosticArray<'_>>()),
];

/// Returns topic and message type of a channel number in records of this agent.
pub(super) fn channel_numbered(number: u16) -> Option<(&'static str, Kind)> {
    // Numbers begin with 1.
    CHANNELS.get(usize::from(number).checked_sub(1)?).copied()
}

/// Returns the options of the MCAP writer.
pub(super) fn options() -> WriteOptions {
    WriteOptions::new()
        .profile(PROFILE)
        .library(concat!("tread-agent ", env!("CARGO_PKG_VERSION")))
        .compression(Some(Compression::Zstd))
        .compression_threads(0)
        .disable_seeking(true)
}

/// Adds a channel with ROS messages to a record.
pub(super) fn ros_channel<W: Write + Seek>(
    writer: &mut Writer<W>,
    topic: &str,
    (package, name): Kind,
) -> Result<u16, McapError> {
    let text = schema(&format!("{package}/{name}")).unwrap_or_default();
    let full = format!("{package}/msg/{name}");
    let schema = writer.add_schema(&full, "ros2msg", text.as_bytes())?;
    let metadata = BTreeMap::from([(QOS_KEY.to_owned(), QOS.to_owned())]);
    writer.add_channel(schema, topic, "cdr", &metadata)
}

impl OpenRecord {
    fn create(path: &Path, now: Duration) -> Result<Self, McapError> {
        let bytes = Arc::new(AtomicU64::new(0));
        let counted = CountingFile {
            file: BufWriter::new(File::create_new(path)?),
            bytes: Arc::clone(&bytes),
        };
        let mut writer = options().create(NoSeek::new(counted))?;
        let mut channels = BTreeMap::new();
        for (topic, kind) in CHANNELS {
            let channel = ros_channel(&mut writer, topic, kind)?;
            channels.insert(topic, (channel, 0));
        }
        Ok(Self {
            writer,
            channels,
            bytes,
            flushed: now,
        })
    }

    fn write(&mut self, topic: &str, wall_ns: i64, message: &[u8]) -> Result<(), McapError> {
        let Some((channel, sequence)) = self.channels.get_mut(topic) else {
            return Ok(());
        };
        let time = u64::try_from(wall_ns).unwrap_or_default();
        let header = MessageHeader {
            channel_id: *channel,
            sequence: *sequence,
            log_time: time,
            publish_time: time,
        };
        *sequence = sequence.wrapping_add(1);
        self.writer.write_to_known_channel(&header, message)
    }

    fn write_text(
        &mut self,
        topic: &str,
        wall_ns: i64,
        message: &impl Serialize,
    ) -> Result<(), McapError> {
        let text = serde_json::to_string(message).map_err(io::Error::from)?;
        let mut bytes = Vec::with_capacity(text.len());
        codec::text_message(&text, &mut bytes);
        self.write(topic, wall_ns, &bytes)
    }
}

/// Writes the records of one run.
pub(crate) struct RecordWriter {
    config: RecordingConfig,
    head: RunHead,
    model: RobotModel,
    clock: SharedClock,
    open: Option<OpenRecord>,
    /// Time before which no new file is tried.
    retry_at: Duration,
    view: Option<LoopView>,
    /// Wall-clock time of the newest tick, nanoseconds since the Unix epoch, for messages without a
    /// time.
    wall_ns: i64,
    diagnosed: Option<Duration>,
    /// Number of lost notes when it was last logged.
    lost: u64,
    said_lost_at: Option<Duration>,
    bytes: Vec<u8>,
    samples: Vec<LoopSample>,
}

impl fmt::Debug for RecordWriter {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("RecordWriter")
            .field("config", &self.config)
            .field("head", &self.head)
            .finish_non_exhaustive()
    }
}

impl RecordWriter {
    /// Creates the writer without opening a file; `model` is the checked model of `head`.
    pub(crate) fn new(
        config: RecordingConfig,
        head: RunHead,
        model: RobotModel,
        clock: SharedClock,
    ) -> Self {
        Self {
            config,
            head,
            model,
            clock,
            open: None,
            retry_at: Duration::ZERO,
            view: None,
            wall_ns: 0,
            diagnosed: None,
            lost: 0,
            said_lost_at: None,
            bytes: Vec::new(),
            samples: Vec::new(),
        }
    }

    /// Writes until the loop has ended.
    pub(crate) fn run(mut self, notes: &Notes) {
        loop {
            match notes.notes.recv_timeout(FLUSH_EVERY) {
                Ok(note) => self.record(notes, &note),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            self.flush_when_due();
        }
        self.close();
    }

    /// Writes all waiting notes.
    #[cfg(any(test, feature = "testing"))]
    pub(crate) fn drain(&mut self, notes: &Notes) {
        for note in notes.notes.try_iter() {
            self.record(notes, &note);
        }
        self.flush_when_due();
    }

    fn record(&mut self, notes: &Notes, note: &Note) {
        let lost = notes.lost.load(Ordering::Relaxed);
        let is_over = |at| self.clock.monotonic().saturating_sub(at) >= RETRY_EVERY;
        if lost > self.lost && self.said_lost_at.is_none_or(is_over) {
            warn!(
                lost,
                "{lost} notes of the loop are not in the record: the disk is slow"
            );
            self.said_lost_at = Some(self.clock.monotonic());
            self.lost = lost;
        }
        self.with_open_record(|writer, open| writer.take(open, note, lost));
        self.rotate_if_full();
    }

    /// Runs `work` on the open record, opening one if necessary; closes it after an error.
    fn with_open_record(
        &mut self,
        work: impl FnOnce(&mut Self, &mut OpenRecord) -> Result<(), McapError>,
    ) {
        let now = self.clock.monotonic();
        let mut open = match self.open.take() {
            Some(open) => open,
            None if now < self.retry_at => return,
            None => match self.begin(now) {
                Ok(open) => open,
                Err(cause) => return self.suspend(now, &cause),
            },
        };
        match work(self, &mut open) {
            Ok(()) => self.open = Some(open),
            Err(cause) => self.suspend(now, &cause),
        }
    }

    fn suspend(&mut self, now: Duration, cause: &McapError) {
        let folder = self.config.folder.display();
        error!("nothing is recorded for a while, `{folder}` refuses: {cause}");
        self.retry_at = now.saturating_add(RETRY_EVERY);
        self.head.part += 1;
    }

    /// Removes the oldest files in excess and begins the next file.
    fn begin(&mut self, now: Duration) -> Result<OpenRecord, McapError> {
        let folder = &self.config.folder;
        fs::create_dir_all(folder)?;
        make_room(folder, self.config.files.saturating_sub(1))?;
        let (wall, head) = (self.clock.wall(), &self.head);
        let (begin, end) = NAME;
        let boot = head.boot.to_string();
        let name = format!(
            "{begin}{}-{}-{}-{:04}{end}",
            head.robot,
            wall.strftime("%Y%m%dT%H%M%SZ"),
            boot.get(..8).unwrap_or(&boot),
            head.part,
        );
        let path = folder.join(name);
        let mut open = OpenRecord::create(&path, now)?;
        if self.wall_ns == 0 {
            self.wall_ns = i64::try_from(wall.as_nanosecond()).unwrap_or_default();
        }
        open.write_text(topics::RUN, self.wall_ns, head)?;
        // Each file begins with the view of its first tick.
        self.view = None;
        info!("recording to `{}`", path.display());
        Ok(open)
    }

    fn take(&mut self, open: &mut OpenRecord, note: &Note, lost: u64) -> Result<(), McapError> {
        match note {
            Note::Command(tick, command) => self.take_command(open, *tick, command),
            Note::Tick(frame) => self.take_tick(open, frame, lost),
        }
    }

    fn take_command(
        &mut self,
        open: &mut OpenRecord,
        tick: u64,
        noted: &RecordedCommand,
    ) -> Result<(), McapError> {
        // Not later than the tick that took the command.
        let wall_ns = self.wall_ns;
        let message = CommandMessage {
            tick,
            command: CommandRecord::from(noted),
        };
        open.write_text(topics::COMMAND, wall_ns, &message)?;
        match noted {
            RecordedCommand::Start(origin) | RecordedCommand::Replace(origin) => {
                self.write_plan(open, wall_ns, origin)
            }
            RecordedCommand::Cancel(_)
            | RecordedCommand::Hold(..)
            | RecordedCommand::Release(..)
            | RecordedCommand::Site(_) => Ok(()),
        }
    }

    fn write_plan(
        &mut self,
        open: &mut OpenRecord,
        wall_ns: i64,
        origin: &JobOrigin,
    ) -> Result<(), McapError> {
        // The plan was computed from the same origin before, so this does not fail in practice.
        let Ok(plan) = origin.plan(&self.model) else {
            return Ok(());
        };
        views::path(
            &views::poses_of(&plan),
            views::SITE_FRAME,
            wall_ns,
            &mut self.bytes,
        );
        open.write(topics::PLAN, wall_ns, &self.bytes)
    }

    fn take_tick(
        &mut self,
        open: &mut OpenRecord,
        frame: &TickFrame,
        lost: u64,
    ) -> Result<(), McapError> {
        let inputs = &frame.inputs;
        let wall_ns = i64::try_from(inputs.now.wall.as_nanosecond()).unwrap_or_default();
        self.wall_ns = wall_ns;
        if self.view != Some(inputs.view) {
            let message = SafetyMessage {
                tick: frame.number,
                view: inputs.view,
            };
            open.write_text(topics::SAFETY, wall_ns, &message)?;
            self.view = Some(inputs.view);
        }
        let tick = codec::tick_message(frame, &mut self.samples);
        encode(&tick, &mut self.bytes);
        open.write(topics::TICK, wall_ns, &self.bytes)?;
        self.write_views(open, frame, wall_ns)?;
        let now = inputs.now.monotonic;
        let is_due = |last: Duration| now.saturating_sub(last) >= DIAGNOSTICS_EVERY;
        if self.diagnosed.is_none_or(is_due) {
            self.diagnosed = Some(now);
            views::diagnostics(frame, self.head.robot.as_str(), lost, &mut self.bytes);
            open.write(topics::DIAGNOSTICS, wall_ns, &self.bytes)?;
        }
        Ok(())
    }

    fn write_views(
        &mut self,
        open: &mut OpenRecord,
        frame: &TickFrame,
        wall_ns: i64,
    ) -> Result<(), McapError> {
        let bytes = &mut self.bytes;
        for sample in frame.inputs.feedback.samples() {
            let wall_ns = views::sample_wall_ns(frame, wall_ns, sample);
            if views::imu(sample, wall_ns, bytes) {
                open.write(topics::IMU, wall_ns, bytes)?;
            }
            if views::joints(sample, wall_ns, bytes) {
                open.write(topics::JOINTS, wall_ns, bytes)?;
            }
            if views::fix(sample, wall_ns, bytes) {
                open.write(topics::POSE, wall_ns, bytes)?;
            }
        }
        if views::odometry(frame, wall_ns, bytes) {
            open.write(topics::ODOMETRY, wall_ns, bytes)?;
        }
        let commanded = self.model.twist_from_wheel_speeds(frame.outputs.command);
        views::commanded(commanded, wall_ns, bytes);
        open.write(topics::COMMANDED, wall_ns, bytes)
    }

    fn flush_when_due(&mut self) {
        let now = self.clock.monotonic();
        let is_due = |open: &OpenRecord| now.saturating_sub(open.flushed) >= FLUSH_EVERY;
        if self.open.as_ref().is_some_and(is_due) {
            self.with_open_record(|_, open| {
                open.flushed = now;
                open.writer.flush()
            });
        }
    }

    /// Closes a file that has reached its size; the next note begins another.
    fn rotate_if_full(&mut self) {
        let is_full =
            |open: &OpenRecord| open.bytes.load(Ordering::Relaxed) >= self.config.file_bytes;
        if self.open.as_ref().is_some_and(is_full) {
            self.close();
            self.head.part += 1;
        }
    }

    /// Closes the record.
    pub(crate) fn close(&mut self) {
        if let Some(mut open) = self.open.take()
            && let Err(cause) = open.writer.finish()
        {
            error!("the end of a record is not written: {cause}");
        }
    }
}

/// Removes the oldest records until at most `most` are left.
fn make_room(folder: &Path, most: usize) -> io::Result<()> {
    let (begin, end) = NAME;
    let mut records = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let is_record = name
            .to_str()
            .is_some_and(|name| name.starts_with(begin) && name.ends_with(end));
        if is_record {
            records.push((entry.metadata()?.modified()?, name));
        }
    }
    records.sort();
    let excess = records.len().saturating_sub(most);
    for (_, name) in &records[..excess] {
        fs::remove_file(folder.join(name))?;
    }
    Ok(())
}
