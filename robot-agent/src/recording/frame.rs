//! What the loop notes of a tick, in room of its own: it waits for nobody and allocates nothing.

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

use crate::control_loop::active::Hold;
use crate::control_loop::channels::{Fault, LoopCommand};
use crate::control_loop::origin::JobOrigin;
use crate::control_loop::segments::Moment;
use crate::control_loop::site_view::SiteView;
use crate::drive::{Battery, Feedback, StatedNoise};
use crate::safety::LoopView;

/// Notes that may wait for whoever writes them: 2.5 s of a loop of 200 Hz, less than 3 MB.
pub(crate) const NOTES_MAX: usize = 512;

/// Everything that a tick took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TickInputs {
    pub(crate) now: Moment,
    /// When what a driver wants was judged, and what else carries its own end.
    pub(crate) judged: Duration,
    pub(crate) stop_requested: bool,
    /// Commands that it took, noted before it.
    pub(crate) commands: u32,
    pub(crate) feedback: Feedback,
    pub(crate) is_base_silent: bool,
    pub(crate) noise: StatedNoise,
    pub(crate) battery: Option<Battery>,
    pub(crate) stop: u64,
    pub(crate) server_silence: Duration,
    pub(crate) view: LoopView,
}

/// What it gave.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TickOutputs {
    pub(crate) wanted: WheelSpeeds,
    pub(crate) command: WheelSpeeds,
    pub(crate) pose: Option<Pose>,
    pub(crate) twist: Twist,
    pub(crate) theta_loop: Option<f64>,
    /// θ as measured, and its standard deviation.
    pub(crate) theta: Option<(f64, f64)>,
    /// Distance along the path and from it, metres.
    pub(crate) mission: Option<(f64, f64)>,
    pub(crate) slip: Option<SideSlip>,
    /// Information on θ of a closed segment, and the same weighted by θ.
    pub(crate) segment: Option<(f64, f64)>,
    pub(crate) mode: RobotMode,
    pub(crate) fault: Option<Fault>,
    pub(crate) gate: Option<GateCause>,
}

/// One tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TickFrame {
    /// Its number since the loop's start, from one on.
    pub(crate) number: u64,
    pub(crate) inputs: TickInputs,
    pub(crate) outputs: TickOutputs,
}

/// A command as the loop took it.
#[derive(Debug, Clone)]
pub(crate) enum NotedCommand {
    Start(Arc<JobOrigin>),
    Cancel(MissionId),
    Hold(MissionId, Hold),
    Release(MissionId, Hold),
    Replace(Arc<JobOrigin>),
    Site(Arc<SiteView>),
}

impl NotedCommand {
    /// Shares what the command carries; copies nothing.
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

/// From the loop to whoever writes.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "a box for ticks would be allocated in each of them"
)]
pub(crate) enum Note {
    /// A command, taken by the tick of that number.
    Command(u64, NotedCommand),
    Tick(TickFrame),
}

/// The loop's end.
#[derive(Debug)]
pub(crate) struct NoteTaker {
    notes: SyncSender<Note>,
    lost: Arc<AtomicU64>,
    commands: u32,
}

impl NoteTaker {
    /// Notes a command of the tick of that number.
    pub(crate) fn command(&mut self, tick: u64, command: &LoopCommand) {
        self.commands += 1;
        self.send(Note::Command(tick, NotedCommand::of(command)));
    }

    /// Commands since the last tick that was noted.
    pub(crate) fn commands(&self) -> u32 {
        self.commands
    }

    /// Notes a tick.
    pub(crate) fn tick(&mut self, frame: &TickFrame) {
        self.commands = 0;
        self.send(Note::Tick(*frame));
    }

    /// What finds no room is lost and counted; what it shares is held by the loop as well, so that
    /// nothing is freed here.
    fn send(&self, note: Note) {
        if self.notes.try_send(note).is_err() {
            self.lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The other end.
#[derive(Debug)]
pub(crate) struct Notes {
    pub(crate) notes: Receiver<Note>,
    /// Notes that found no room.
    pub(crate) lost: Arc<AtomicU64>,
}

/// Both ends of what the loop notes.
pub(crate) fn notes() -> (NoteTaker, Notes) {
    let (sender, receiver) = sync_channel(NOTES_MAX);
    let lost = Arc::new(AtomicU64::new(0));
    let taker = NoteTaker {
        notes: sender,
        lost: Arc::clone(&lost),
        commands: 0,
    };
    (
        taker,
        Notes {
            notes: receiver,
            lost,
        },
    )
}
