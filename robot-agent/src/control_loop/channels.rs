//! What passes between the loop thread and the rest of the agent.
//!
//! Commands come in and events go out through bounded channels, never waited for by the loop; the
//! latest snapshot lies in a cell that the loop leaves alone while somebody reads it.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use tread_api::friction::{SideSlip, ThetaEstimate};
use tread_api::ids::{MissionId, PlanHash};
use tread_api::robot::{MissionProgress, RobotMode};
use tread_api::site::Cell;
use tread_api::wire::ingest::MissionPhase;
use tread_control::consistency::Findings;
use tread_control::estimation::SegmentStatistics;
use tread_control::follower::{FailureReason, Follower};
use tread_control::gate::GateCause;
use tread_control::geometry::{Point, Pose, Twist};
use tread_control::plan::Plan;
use tread_control::reference::Governor;

use super::active::Hold;
use super::driven::Driven;
use super::origin::JobOrigin;
use super::overrun::Overrun;
use super::prior::Prior;
use super::site_view::SiteView;
use super::standing::StandingReport;
use super::surface::Comparison;
use crate::drive::Battery;
use crate::safety::SafetyCell;

/// Commands that may wait for the next tick.
pub(crate) const COMMANDS_MAX: usize = 16;
/// Events that may wait for whoever records them; more segments than that are lost and counted.
pub(crate) const EVENTS_MAX: usize = 1_024;

/// A planned mission, ready to drive.
#[derive(Debug)]
pub(crate) struct Job {
    pub(crate) mission: MissionId,
    pub(crate) revision: u32,
    pub(crate) plan_hash: PlanHash,
    pub(crate) follower: Follower,
    /// What the map knows along the path.
    pub(crate) prior: Prior,
    /// Past this monotonic time it must not start.
    pub(crate) start_by: Option<Duration>,
    /// Longest silence of the server with which it goes on; for ever when absent.
    pub(crate) silence_max: Option<Duration>,
    /// What it turns out to be.
    pub(crate) driven: Driven,
    /// What it was made from.
    pub(crate) origin: Arc<JobOrigin>,
}

/// To the loop.
#[derive(Debug)]
pub(crate) enum LoopCommand {
    /// Drive this.
    Start(Box<Job>),
    /// Brake along the path and end the mission, if it is this one.
    Cancel(MissionId),
    /// Hold this mission, standing.
    Hold(MissionId, Hold),
    /// Let it go on, if nothing else holds it.
    Release(MissionId, Hold),
    /// Drive this revision instead of the active one, once the robot stands.
    Replace(Box<Job>),
    /// The site is like this now.
    Site(Arc<SiteView>),
}

/// Why a mission ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EndReason {
    Reached,
    Cancelled,
    Failed(FailureReason),
    TooLate,
    AnotherInHand,
    AgentStopped,
    ServerSilent,
    SensorFault,
}

impl EndReason {
    pub(crate) fn phase(self) -> MissionPhase {
        match self {
            Self::Reached => MissionPhase::Succeeded,
            Self::Cancelled => MissionPhase::Cancelled,
            Self::TooLate => MissionPhase::Expired,
            Self::Failed(_)
            | Self::AnotherInHand
            | Self::AgentStopped
            | Self::ServerSilent
            | Self::SensorFault => MissionPhase::Failed,
        }
    }

    /// For people; a success needs no words.
    pub(crate) fn text(self) -> Option<&'static str> {
        match self {
            Self::Reached => None,
            Self::Cancelled => Some("cancelled on request"),
            Self::Failed(reason) => Some(reason.text()),
            Self::TooLate => Some("its latest start passed before it began"),
            Self::AnotherInHand => Some("another mission was being driven"),
            Self::AgentStopped => Some("the agent was stopped"),
            Self::SensorFault => Some("sensors contradicted each other for too long"),
            Self::ServerSilent => Some("the server was silent for longer than the mission allows"),
        }
    }
}

/// A segment as the loop closed it.
#[derive(Debug, Clone)]
pub(crate) struct ClosedSegment {
    pub(crate) site: Arc<SiteView>,
    pub(crate) mission: Option<MissionId>,
    pub(crate) started_at: Timestamp,
    pub(crate) ended_at: Timestamp,
    pub(crate) cell: Cell,
    pub(crate) terrain: Option<usize>,
    pub(crate) distance_m: f64,
    /// Share of the segment's blocks with a wheel beyond the linear range.
    pub(crate) saturation_ratio: f64,
    pub(crate) statistics: SegmentStatistics,
}

/// From the loop.
#[derive(Debug)]
pub(crate) enum LoopEvent {
    /// The first wheel command of a mission was given.
    Started {
        at: Timestamp,
        progress: MissionProgress,
    },
    /// The mission stands paused, by the robot itself since then.
    Paused {
        at: Timestamp,
        since: Option<Timestamp>,
        progress: MissionProgress,
    },
    /// The mission goes on after a pause.
    Resumed {
        at: Timestamp,
        progress: MissionProgress,
    },
    /// Another revision is driven from now on; the one before is handed back to be freed.
    Replaced {
        at: Timestamp,
        progress: MissionProgress,
        old: Box<Job>,
    },
    /// A revision came when its mission was over, and is handed back to be freed.
    CameTooLate(Box<Job>),
    /// A mission ended; what was driven is handed back to be freed elsewhere.
    Ended {
        at: Timestamp,
        reason: EndReason,
        progress: MissionProgress,
        job: Box<Job>,
    },
    /// A segment closed with information.
    Segment(ClosedSegment),
    /// A site that is no longer used, handed back to be freed elsewhere.
    Retired(Arc<SiteView>),
}

/// What is broken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The base has not been heard for too long.
    BaseSilent,
    /// No position fix for too long.
    PositionLost,
}

impl Fault {
    /// For people.
    pub fn text(self) -> &'static str {
        match self {
            Self::BaseSilent => "the base has not been heard for too long",
            Self::PositionLost => "there has been no position fix for too long",
        }
    }
}

/// What the gate did since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct GateSnapshot {
    /// The strictest cause in the last tick.
    pub(crate) cause: Option<GateCause>,
    /// Whether it was coming to rest, or stood.
    pub(crate) target_rests: bool,
    /// Ticks in which it reduced a command.
    pub(crate) reduced_ticks: u64,
    /// How often each cause began, in the order of [`GateCause::ALL`].
    pub(crate) counts: [u64; GateCause::ALL.len()],
}

/// What the loop last said of itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Snapshot {
    /// When, by the agent's monotonic clock.
    pub at: Duration,
    /// What the agent is doing.
    pub mode: RobotMode,
    /// What is broken, if anything.
    pub fault: Option<Fault>,
    /// Where the robot is, and when the last fix behind it was measured.
    pub pose: Option<(Pose, Duration)>,
    /// How it moves, and when the base was last heard.
    pub twist: Option<(Twist, Duration)>,
    /// The mission that is driven.
    pub mission: Option<MissionProgress>,
    /// What walks along its plan.
    pub governor: Option<Governor>,
    /// What holds the mission.
    pub is_on_hold: bool,
    /// How far the robot is from where its held mission goes on, metres.
    pub off_path_m: Option<f64>,
    /// Whether the wheels are commanded to rest and do.
    pub stands: bool,
    /// What the gate does.
    pub(crate) gate: GateSnapshot,
    /// The revision of the geofence that the loop keeps to.
    pub fence_revision: Option<u64>,
    /// The battery, if the base measures it.
    pub battery: Option<Battery>,
    /// θ̂ of the loop; kept from the last mission, none before the first.
    pub theta_loop: Option<f64>,
    /// θ measured on the present ground.
    pub theta_measured: Option<ThetaEstimate>,
    /// Whether the motion of late carried information on θ.
    pub excited: bool,
    /// Where the ground is not as the map says.
    pub(crate) surface_change: Option<Comparison>,
    /// Where the wheels turn without progress.
    pub dug_in_at: Option<Point>,
    /// How far the loop is from its rate, while the robot is held for it.
    pub(crate) overrun: Option<Overrun>,
    /// Sensors that contradict each other.
    pub(crate) findings: Findings,
    /// Whether the robot stands, where it is to.
    pub(crate) standing: StandingReport,
    /// How much the wheels slip along their direction, while they turn.
    pub slip: Option<SideSlip>,
    /// The cell that the robot is in.
    pub cell: Option<Cell>,
    /// The terrain that it is on, by its place in the site's definition.
    pub(crate) terrain: Option<usize>,
    /// The revision of the definition that the loop uses.
    pub terrain_revision: Option<u64>,
    /// Ticks since the start.
    pub ticks: u64,
}

impl Default for Snapshot {
    fn default() -> Self {
        Self {
            at: Duration::ZERO,
            mode: RobotMode::Idle,
            fault: None,
            pose: None,
            twist: None,
            mission: None,
            governor: None,
            is_on_hold: false,
            off_path_m: None,
            stands: false,
            gate: GateSnapshot::default(),
            fence_revision: None,
            battery: None,
            theta_loop: None,
            theta_measured: None,
            excited: false,
            surface_change: None,
            dug_in_at: None,
            overrun: None,
            findings: Findings::default(),
            standing: StandingReport::default(),
            slip: None,
            cell: None,
            terrain: None,
            terrain_revision: None,
            ticks: 0,
        }
    }
}

/// A plan that was given to the loop.
#[derive(Debug, Clone)]
pub(crate) struct GivenPlan {
    pub(crate) mission: MissionId,
    pub(crate) revision: u32,
    pub(crate) plan: Arc<Plan>,
}

/// What both sides may look at.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    snapshot: Mutex<Snapshot>,
    /// What may only slow the robot down.
    pub(crate) safety: Arc<SafetyCell>,
    /// Ticks since the start, for whoever watches the loop.
    pub(crate) ticks: AtomicU64,
    /// Tells the loop to brake and end.
    pub(crate) stop: AtomicBool,
    /// Ticks that began more than one period late.
    pub(crate) overruns: AtomicU64,
    /// Commands refused because they did not parse, or were of another version.
    pub(crate) commands_refused: AtomicU64,
    /// Longest computation of a tick since it was last taken, microseconds.
    pub(crate) tick_max_us: AtomicU32,
    /// Segments that nobody took in time.
    pub(crate) lost_segments: AtomicU64,
    /// Blocks of measurement that belong to no cell, for want of a site or a position.
    pub(crate) unplaced_blocks: AtomicU64,
    /// Samples of the base that gave way to newer ones before a tick took them.
    pub(crate) lost_samples: AtomicU64,
    /// Commands of the server that found no room.
    pub(crate) lost_commands: AtomicU64,
    /// The plan that the loop was given last, for whoever shows it; the loop itself never looks.
    plan: Mutex<Option<GivenPlan>>,
    /// When the server was last heard, microseconds of the agent's monotonic clock.
    server_heard_us: AtomicU64,
}

impl Shared {
    /// The newest snapshot.
    pub(crate) fn snapshot(&self) -> Snapshot {
        *self.snapshot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Leaves a newer one, unless somebody is reading right now: the next tick brings another.
    pub(crate) fn publish(&self, snapshot: &Snapshot) {
        if let Ok(mut cell) = self.snapshot.try_lock() {
            *cell = *snapshot;
        }
    }

    /// Leaves the plan that the loop was given.
    pub(crate) fn show_plan(&self, given: GivenPlan) {
        *self.plan.lock().unwrap_or_else(PoisonError::into_inner) = Some(given);
    }

    /// The plan that the loop was given last.
    pub(crate) fn given_plan(&self) -> Option<GivenPlan> {
        let plan = self.plan.lock();
        plan.unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn count(counter: &AtomicU64) {
        counter.fetch_add(1, Ordering::Relaxed);
    }

    /// The server has been heard just now.
    pub(crate) fn note_server_heard(&self, now: Duration) {
        let now_us = u64::try_from(now.as_micros()).unwrap_or(u64::MAX);
        self.server_heard_us.fetch_max(now_us, Ordering::Relaxed);
    }

    /// Replaces when the server was heard by what a record says.
    pub(crate) fn replay_server_heard(&self, heard: Duration) {
        // Rounded up: what is kept in whole microseconds is met, and a server heard later than the
        // tick began stays silent for no time.
        let heard_us = heard.as_nanos().div_ceil(1_000);
        let heard_us = u64::try_from(heard_us).unwrap_or(u64::MAX);
        self.server_heard_us.store(heard_us, Ordering::Relaxed);
    }

    /// How long the server has been silent.
    pub(crate) fn server_silence(&self, now: Duration) -> Duration {
        let heard = Duration::from_micros(self.server_heard_us.load(Ordering::Relaxed));
        now.saturating_sub(heard)
    }
}

/// The loop's ends of everything.
#[derive(Debug)]
pub(crate) struct LoopEnds {
    pub(crate) commands: Receiver<LoopCommand>,
    pub(crate) events: SyncSender<LoopEvent>,
    pub(crate) shared: Arc<Shared>,
}

/// The other ends.
#[derive(Debug)]
pub(crate) struct AgentEnds {
    pub(crate) commands: SyncSender<LoopCommand>,
    pub(crate) events: Receiver<LoopEvent>,
    pub(crate) shared: Arc<Shared>,
}

/// Everything that passes between the loop and the rest.
pub(crate) fn loop_channels() -> (LoopEnds, AgentEnds) {
    let (command_sender, command_receiver) = sync_channel(COMMANDS_MAX);
    let (event_sender, event_receiver) = sync_channel(EVENTS_MAX);
    let shared = Arc::new(Shared::default());
    let loop_ends = LoopEnds {
        commands: command_receiver,
        events: event_sender,
        shared: Arc::clone(&shared),
    };
    (
        loop_ends,
        AgentEnds {
            commands: command_sender,
            events: event_receiver,
            shared,
        },
    )
}
