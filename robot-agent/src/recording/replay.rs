//! Replays a record: runs controller and estimator on it again and reports where they differ.
//!
//! The loop's own core ([`LoopCore`]) is fed through its usual interfaces: commands through its
//! channel, samples through a drive that reads the record, stops, leases and limits through their
//! cell. Its notes are compared with the recorded ones to the bit.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::TryRecvError;
use std::time::Duration;

use jiff::Timestamp;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::{RobotModel, RobotModelError};
use tread_ros2::cdr::{decode, encode};
use tread_ros2::messages::tread::{LoopSample, LoopTick, tick_bits};

use super::codec::Difference;
use super::read::{Entry, ReadError, Run};
use super::{CommandMessage, CommandRecord, FORMAT, RunHead, VERSION, codec};
use crate::control_loop::channels::{AgentEnds, COMMANDS_MAX, LoopCommand, loop_channels};
use crate::control_loop::frame::{Note, Notes, TickFrame, notes};
use crate::control_loop::job::{Job, JobOrigin};
use crate::control_loop::segments::Moment;
use crate::control_loop::site_view::SiteView;
use crate::control_loop::tick::LoopCore;
use crate::drive::{Battery, Drive, Feedback, StatedNoise};
use crate::geometry::control_model;
use crate::safety::LoopView;

/// Largest number of differing ticks that are reported individually.
pub(crate) const REPORTED_MAX: usize = 10;

/// Why a record cannot be replayed to its end.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ReplayError {
    #[error(transparent)]
    Read(#[from] ReadError),
    #[error("the robot's model in the record is impossible")]
    Model(#[from] RobotModelError),
    #[error("tick {tick} of the record is none: {problem}")]
    Malformed { tick: u64, problem: String },
}

/// A tick with outputs that differ.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DifferingTick {
    pub(crate) tick: u64,
    /// Time since the first tick, seconds.
    pub(crate) after_s: f64,
    pub(crate) differences: Vec<Difference>,
}

/// Result of a replay.
#[derive(Debug)]
pub(crate) struct Replayed {
    pub(crate) head: RunHead,
    /// Ticks that were replayed.
    pub(crate) ticks: u64,
    /// Time between the first and the last replayed tick.
    pub(crate) lasting: Duration,
    /// Replayed ticks in which the wheels were commanded to turn.
    pub(crate) driving_ticks: u64,
    /// Replayed ticks that differ.
    pub(crate) differing: u64,
    /// The first differing ticks, at most [`REPORTED_MAX`].
    pub(crate) first_differing: Vec<DifferingTick>,
    /// Description of a gap in the record; the replay ends at the first gap.
    pub(crate) gap: Option<String>,
    /// Where the record is torn; the replay ends there.
    pub(crate) torn: Option<String>,
}

impl Replayed {
    /// Whether the record is of another version of the agent or an older format.
    pub(crate) fn is_of_another_version(&self) -> bool {
        self.head.version != VERSION || self.head.format < FORMAT
    }
}

/// A drive that returns the recorded samples.
#[derive(Default)]
struct RecordedBase {
    feedback: Feedback,
    is_silent: bool,
    noise: StatedNoise,
    battery: Option<Battery>,
}

impl Drive for RecordedBase {
    fn read(&mut self, _: Duration) -> Feedback {
        std::mem::take(&mut self.feedback)
    }

    fn write(&mut self, _: WheelSpeeds) {}

    fn battery(&self) -> Option<Battery> {
        self.battery
    }

    fn noise(&self) -> StatedNoise {
        self.noise
    }

    fn is_silent(&self) -> bool {
        self.is_silent
    }
}

/// Replays a record through a control loop.
struct Replayer {
    model: RobotModel,
    core: LoopCore,
    ends: AgentEnds,
    notes: Notes,
    view: LoopView,
    waiting: Vec<CommandMessage>,
    last_tick: u64,
    began: Option<Duration>,
    samples: Vec<LoopSample>,
    bytes: Vec<u8>,
    found: Replayed,
}

/// Replays the files of one run, given in any order.
///
/// # Errors
/// [`ReplayError`] if the record cannot be read, its model is impossible, or a tick is malformed.
pub(crate) fn replay(files: &[PathBuf]) -> Result<Replayed, ReplayError> {
    let mut run = Run::open(files)?;
    let mut replayer = Replayer::new(run.head.clone())?;
    while replayer.found.gap.is_none() {
        match run.next()? {
            None => break,
            Some(Entry::Command(command)) => replayer.waiting.push(*command),
            Some(Entry::Safety(message)) => replayer.view = message.view,
            Some(Entry::Tick(bytes)) => replayer.take(&bytes)?,
        }
    }
    replayer.found.torn = run.torn;
    Ok(replayer.found)
}

impl Replayer {
    fn new(head: RunHead) -> Result<Self, ReplayError> {
        let model = control_model(&head.model)?;
        let (loop_ends, ends) = loop_channels();
        let (record_sender, notes) = notes();
        let mut core = LoopCore::new(model, loop_ends)
            .with_blind_within_fence(head.blind_within_fence)
            .with_silent_after(head.silent_after)
            .with_prior(head.prior);
        let period = Duration::try_from_secs_f64(head.rate_hz.recip());
        if let Ok(period) = period
            && head.format >= FORMAT
        {
            core = core.with_period(period);
        }
        core.record_to(Some(record_sender));
        Ok(Self {
            model,
            core,
            ends,
            notes,
            view: LoopView::default(),
            waiting: Vec::with_capacity(COMMANDS_MAX),
            last_tick: 0,
            began: None,
            samples: Vec::new(),
            bytes: Vec::new(),
            found: Replayed {
                head,
                ticks: 0,
                lasting: Duration::ZERO,
                driving_ticks: 0,
                differing: 0,
                first_differing: Vec::new(),
                gap: None,
                torn: None,
            },
        })
    }

    /// Processes a tick as it is in the record.
    fn take(&mut self, bytes: &[u8]) -> Result<(), ReplayError> {
        if self.found.head.format >= FORMAT {
            return self.tick(bytes);
        }
        let tick = self.last_tick + 1;
        let bytes = codec::from_format_1(bytes).map_err(|refused| ReplayError::Malformed {
            tick,
            problem: refused.to_string(),
        })?;
        self.tick(&bytes)
    }

    fn tick(&mut self, recorded_bytes: &[u8]) -> Result<(), ReplayError> {
        let tick = self.last_tick + 1;
        let malformed = |problem: String| ReplayError::Malformed { tick, problem };
        let recorded: LoopTick<'_> =
            decode(recorded_bytes).map_err(|refused| malformed(refused.to_string()))?;
        if recorded.number != tick {
            let (from, to) = (tick, recorded.number);
            self.found.gap = Some(format!(
                "ticks {from} to {to} are not in the record one after the other; nothing behind them can be run again"
            ));
            return Ok(());
        }
        self.last_tick = tick;
        if let Err(problem) = self.command(&recorded) {
            self.found.gap = Some(problem);
            return Ok(());
        }
        let wall = Timestamp::from_nanosecond(i128::from(recorded.wall_ns))
            .map_err(|refused| malformed(refused.to_string()))?;
        let now = Moment {
            monotonic: Duration::from_nanos(recorded.monotonic_ns),
            wall,
        };
        let has = |bit: u32| recorded.present & bit != 0;
        let mut base = RecordedBase {
            feedback: codec::feedback_of(&recorded)
                .ok_or_else(|| malformed("it has too many samples".to_owned()))?,
            is_silent: has(tick_bits::BASE_SILENT),
            noise: codec::noise_of(&recorded),
            battery: codec::battery_of(&recorded),
        };
        let shared = &self.ends.shared;
        shared.safety.show(recorded.stop, &self.view);
        let silence = Duration::from_nanos(recorded.server_silence_ns);
        shared.replay_server_message(now.monotonic.saturating_sub(silence));
        let judged = Duration::from_nanos(recorded.judged_ns);
        let stop = has(tick_bits::STOP_REQUESTED);
        self.core.tick_by(now, &|| judged, stop, &mut base);
        // Events are dropped.
        self.ends.events.try_iter().for_each(drop);
        if let Some(frame) = self.noted() {
            self.compare(&recorded, recorded_bytes, &frame);
        }
        self.count(&recorded, now.monotonic);
        Ok(())
    }

    /// Sends the loop the commands that this tick took.
    fn command(&mut self, recorded: &LoopTick<'_>) -> Result<(), String> {
        let tick = recorded.number;
        let noted = self.waiting.len();
        if usize::try_from(recorded.commands) != Ok(noted)
            || self.waiting.iter().any(|command| command.tick != tick)
        {
            return Err(format!(
                "tick {tick} took {} commands, of which {noted} are in the record",
                recorded.commands
            ));
        }
        for message in self.waiting.drain(..) {
            let command = loop_command(message.command, self.model).map_err(|problem| {
                format!("tick {tick} took a mission that is refused now: {problem}")
            })?;
            let sent = self.ends.commands.try_send(command);
            sent.map_err(|_| format!("tick {tick} took more commands than a loop takes"))?;
        }
        Ok(())
    }

    /// Returns the loop's note of its tick.
    fn noted(&mut self) -> Option<TickFrame> {
        loop {
            match self.notes.notes.try_recv() {
                Ok(Note::Tick(frame)) => return Some(frame),
                Ok(Note::Command(..)) => {}
                Err(TryRecvError::Empty | TryRecvError::Disconnected) => return None,
            }
        }
    }

    fn compare(&mut self, recorded: &LoopTick<'_>, recorded_bytes: &[u8], frame: &TickFrame) {
        let replayed = codec::tick_message(frame, &mut self.samples);
        encode(&replayed, &mut self.bytes);
        if self.bytes == recorded_bytes {
            return;
        }
        self.found.differing += 1;
        // An output differs if any of its bits does.
        let pairs = codec::outputs(recorded)
            .into_iter()
            .zip(codec::outputs(&replayed));
        let differences = pairs
            .filter(|((_, was), (_, is))| was.to_bits() != is.to_bits())
            .map(|((name, recorded), (_, replayed))| Difference {
                name,
                recorded,
                replayed,
            });
        if self.found.first_differing.len() < REPORTED_MAX {
            let since = Duration::from_nanos(recorded.monotonic_ns);
            let after = since.saturating_sub(self.began.unwrap_or(since));
            self.found.first_differing.push(DifferingTick {
                tick: recorded.number,
                after_s: after.as_secs_f64(),
                differences: differences.collect(),
            });
        }
    }

    fn count(&mut self, recorded: &LoopTick<'_>, now: Duration) {
        let began = *self.began.get_or_insert(now);
        self.found.ticks += 1;
        self.found.lasting = now.saturating_sub(began);
        let speed = recorded.command_left_rad_s.abs() + recorded.command_right_rad_s.abs();
        self.found.driving_ticks += u64::from(speed > 0.0);
    }
}

fn job(origin: JobOrigin, model: RobotModel) -> Result<Box<Job>, String> {
    let plan = origin.plan(&model)?;
    origin.job(plan, model)
}

fn loop_command(record: CommandRecord, model: RobotModel) -> Result<LoopCommand, String> {
    Ok(match record {
        CommandRecord::Start(origin) => LoopCommand::Start(job(origin, model)?),
        CommandRecord::Replace(origin) => LoopCommand::Replace(job(origin, model)?),
        CommandRecord::Cancel { mission } => LoopCommand::Cancel(mission),
        CommandRecord::Hold { mission, hold } => LoopCommand::Hold(mission, hold),
        CommandRecord::Release { mission, hold } => LoopCommand::Release(mission, hold),
        CommandRecord::Site {
            definition,
            is_without_room,
        } => LoopCommand::Site(Arc::new(if is_without_room {
            SiteView::without_room(definition)
        } else {
            SiteView::new(definition)
        })),
    })
}
