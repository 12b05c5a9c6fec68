//! The notes that the loop makes of a tick, sent to the recorder without blocking or allocating.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;

use tread_api::friction::SideSlip;
use tread_api::ids::MissionId;
use tread_api::robot::RobotMode;
use tread_control::gate::GateCause;
use tread_control::geometry::{Pose, Twist};
use tread_control::measured::WheelSpeeds;

use crate::control_loop::channels::Hold;
use crate::control_loop::channels::{Fault, LoopCommand};
use crate::control_loop::job::JobOrigin;
use crate::control_loop::segments::Moment;
use crate::control_loop::site_view::SiteView;
use crate::drive::{Battery, Feedback, StatedNoise};
use crate::safety::LoopView;

/// Capacity of the queue of notes: 2.5 s of a loop at 200 Hz, less than 3 MB.
pub(crate) const NOTES_MAX: usize = 512;

/// Inputs of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TickInputs {
    pub(crate) now: Moment,
    /// Time by which inputs with an expiry, such as drive commands, were judged; monotonic clock.
    pub(crate) judged: Duration,
    pub(crate) stop_requested: bool,
    /// Number of commands that the tick took from the queue; each is recorded before the tick.
    pub(crate) commands: u32,
    pub(crate) feedback: Feedback,
    pub(crate) is_base_silent: bool,
    pub(crate) noise: StatedNoise,
    pub(crate) battery: Option<Battery>,
    pub(crate) stop: u64,
    pub(crate) server_silence: Duration,
    pub(crate) view: LoopView,
}

/// Outputs of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TickOutputs {
    pub(crate) requested: WheelSpeeds,
    pub(crate) command: WheelSpeeds,
    pub(crate) pose: Option<Pose>,
    pub(crate) twist: Twist,
    pub(crate) theta_loop: Option<f64>,
    /// Measured θ and its standard deviation.
    pub(crate) theta: Option<(f64, f64)>,
    /// Distance driven along the path and cross-track error, metres.
    pub(crate) mission: Option<(f64, f64)>,
    pub(crate) slip: Option<SideSlip>,
    /// θ information of the segment that was closed, and θ weighted by it.
    pub(crate) segment: Option<(f64, f64)>,
    pub(crate) mode: RobotMode,
    pub(crate) fault: Option<Fault>,
    pub(crate) gate: Option<GateCause>,
}

/// Inputs and outputs of one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TickFrame {
    /// Number of the tick since the loop's start, from 1.
    pub(crate) number: u64,
    pub(crate) inputs: TickInputs,
    pub(crate) outputs: TickOutputs,
}

/// A command that the loop took.
#[derive(Debug, Clone)]
pub(crate) enum RecordedCommand {
    Start(Arc<JobOrigin>),
    Cancel(MissionId),
    Hold(MissionId, Hold),
    Release(MissionId, Hold),
    Replace(Arc<JobOrigin>),
    Site(Arc<SiteView>),
}

impl RecordedCommand {
    /// Creates the note by sharing the command's data; copies nothing.
    pub(crate) fn of(command: &LoopCommand) -> Self {
        match command {
            LoopCommand::Start(job) => Self::Start(Arc::clone(&job.origin)),
            LoopCommand::Cancel(mission) => Self::Cancel(*mission),
            LoopCommand::Hold(mission, hold) => Self::Hold(*mission, *hold),
            LoopCommand::Release(mission, hold) => Self::Release(*mission, *hold),
            LoopCommand::Replace(job) => Self::Replace(Arc::clone(&job.origin)),
            LoopCommand::Site(site) => Self::Site(Arc::clone(site)),
        }
    }
}

/// A note from the loop to the recorder.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "a box for ticks would be allocated in each of them"
)]
pub(crate) enum Note {
    /// A command, with the number of the tick that took it.
    Command(u64, RecordedCommand),
    Tick(TickFrame),
}

/// The loop's end of the queue of notes.
#[derive(Debug)]
pub(crate) struct RecordSender {
    notes: SyncSender<Note>,
    lost: Arc<AtomicU64>,
    commands: u32,
}

impl RecordSender {
    /// Notes a command taken by tick number `tick`.
    pub(crate) fn command(&mut self, tick: u64, command: &LoopCommand) {
        self.commands += 1;
        self.send(Note::Command(tick, RecordedCommand::of(command)));
    }

    /// Returns the number of commands since the last noted tick.
    pub(crate) fn commands(&self) -> u32 {
        self.commands
    }

    /// Notes a tick.
    pub(crate) fn tick(&mut self, frame: &TickFrame) {
        self.commands = 0;
        self.send(Note::Tick(*frame));
    }

    /// Sends a note, or counts it as lost if the queue is full. Its shared data are also owned by
    /// the loop, so that dropping it deallocates nothing.
    fn send(&self, note: Note) {
        if self.notes.try_send(note).is_err() {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The recorder's end of the queue of notes.
#[derive(Debug)]
pub(crate) struct Notes {
    pub(crate) notes: Receiver<Note>,
    /// Number of notes that found the queue full.
    pub(crate) lost: Arc<AtomicU64>,
}

/// Creates both ends of the queue of notes.
pub(crate) fn notes() -> (RecordSender, Notes) {
    let (sender, receiver) = sync_channel(NOTES_MAX);
    let lost = Arc::new(AtomicU64::new(0));
    let record_sender = RecordSender {
        notes: sender,
        lost: Arc::clone(&lost),
        commands: 0,
    };
    (
        record_sender,
        Notes {
            notes: receiver,
            lost,
        },
    )
}
