//! The channels and shared cells between the loop thread and the rest of the agent.
//!
//! Commands ([`LoopCommand`]) and events ([`LoopEvent`]) pass through bounded channels, on which
//! the loop never blocks. The latest [`Snapshot`] is in a mutex that the loop skips while it is
//! locked.

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use tread_api::friction::{NoEstimate, RobotParameters, SideSlip, ThetaEstimate};
use tread_api::ids::MissionId;
use tread_api::robot::{MissionProgress, RobotMode};
use tread_api::site::Cell;
use tread_api::wire::ingest::MissionPhase;
use tread_control::consistency::Findings;
use tread_control::estimation::{PayloadChange, SegmentStatistics};
use tread_control::follower::FailureReason;
use tread_control::gate::GateCause;
use tread_control::geometry::{Point, Pose, Twist};
use tread_control::measured::WheelTorques;
use tread_control::plan::Plan;
use tread_control::reference::Governor;

use super::job::Job;
use super::overrun::Overrun;
use super::site_view::SiteView;
use super::standstill::StandstillReport;
use super::surface::Comparison;
use crate::drive::Battery;
use crate::safety::SafetyCell;

/// Capacity of the command channel, emptied by each tick.
pub(crate) const COMMANDS_MAX: usize = 16;
/// Capacity of the event channel; segments that find it full are dropped and counted.
pub(crate) const EVENTS_MAX: usize = 1_024;

/// Why a mission is held.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Hold {
    /// An operator paused the mission.
    Pause,
    /// The next revision is being planned from where the robot stops.
    Replacement,
    /// An external limit holds the robot; the mission goes on when the limit ends.
    Outside,
    /// The base is silent, or sends again for too short a time; the mission goes on when it has sent for
    /// long enough.
    Base,
    /// The control loop does not keep its rate; the mission goes on when it does.
    Overrun,
    /// A sensor that the mission needs is contradicted; the mission goes on when the finding ends.
    Sensors,
}

/// A command to the loop.
#[derive(Debug)]
pub(crate) enum LoopCommand {
    /// Starts this mission.
    Start(Box<Job>),
    /// Brakes along the path and ends the mission, if it is the active one.
    Cancel(MissionId),
    /// Stops this mission on its path until the same hold is released.
    Hold(MissionId, Hold),
    /// Ends this hold; the mission goes on if no other hold is active.
    Release(MissionId, Hold),
    /// Replaces the active revision by this one once the robot has stopped.
    Replace(Box<Job>),
    /// Replaces the definition of the site.
    Site(Arc<SiteView>),
}

/// Why a mission ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EndReason {
    Reached,
    Cancelled,
    Failed(FailureReason),
    TooLate,
    AnotherActive,
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
            | Self::AnotherActive
            | Self::AgentStopped
            | Self::ServerSilent
            | Self::SensorFault => MissionPhase::Failed,
        }
    }

    /// Description for people; `None` for a success.
    pub(crate) fn text(self) -> Option<&'static str> {
        match self {
            Self::Reached => None,
            Self::Cancelled => Some("cancelled on request"),
            Self::Failed(reason) => Some(reason.text()),
            Self::TooLate => Some("its latest start passed before it began"),
            Self::AnotherActive => Some("another mission was being driven"),
            Self::AgentStopped => Some("the agent was stopped"),
            Self::SensorFault => Some("sensors contradicted each other for too long"),
            Self::ServerSilent => Some("the server was silent for longer than the mission allows"),
        }
    }
}

/// A segment that the loop has closed.
#[derive(Debug, Clone)]
pub(crate) struct ClosedSegment {
    pub(crate) site: Arc<SiteView>,
    pub(crate) mission: Option<MissionId>,
    pub(crate) started_at: Timestamp,
    pub(crate) ended_at: Timestamp,
    pub(crate) cell: Cell,
    pub(crate) terrain: Option<usize>,
    pub(crate) distance_m: f64,
    /// Fraction of the segment's blocks with a wheel beyond the linear slip range.
    pub(crate) saturation_ratio: f64,
    pub(crate) statistics: SegmentStatistics,
}

/// An event from the loop.
#[derive(Debug)]
pub(crate) enum LoopEvent {
    /// The first wheel command of a mission was given.
    Started {
        at: Timestamp,
        progress: MissionProgress,
    },
    /// The robot has stopped for a pause; `since` is when the pause began if the robot paused the
    /// mission itself, `None` for a requested pause.
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
    /// A new revision is active; `old` is returned for deallocation outside the loop.
    Replaced {
        at: Timestamp,
        progress: MissionProgress,
        old: Box<Job>,
    },
    /// A revision that arrived after its mission had ended, or was replaced before it was driven;
    /// returned for deallocation outside the loop.
    CameTooLate(Box<Job>),
    /// A mission ended; `job` is returned with its record, for deallocation outside the loop.
    Ended {
        at: Timestamp,
        reason: EndReason,
        progress: MissionProgress,
        job: Box<Job>,
    },
    /// A segment closed with information.
    Segment(ClosedSegment),
    /// A site definition that is no longer used, returned for deallocation outside the loop.
    Retired(Arc<SiteView>),
}

/// A fault of the base or of the localisation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// No valid message from the base for too long.
    BaseSilent,
    /// No position fix for too long.
    PositionLost,
}

impl Fault {
    /// Description for people.
    pub fn text(self) -> &'static str {
        match self {
            Self::BaseSilent => "the base has not been heard for too long",
            Self::PositionLost => "there has been no position fix for too long",
        }
    }
}

/// Action of the gate in the last tick, and its counters since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct GateSnapshot {
    /// The strictest cause in the last tick.
    pub(crate) cause: Option<GateCause>,
    /// Whether the gate's target in the last tick was zero velocity.
    pub(crate) target_rests: bool,
    /// Ticks in which it reduced a command.
    pub(crate) reduced_ticks: u64,
    /// Number of times each cause began, in the order of [`GateCause::ALL`].
    pub(crate) counts: [u64; GateCause::ALL.len()],
}

/// State of the loop after a tick, as published to the rest of the agent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Snapshot {
    /// Time of the tick, by the agent's monotonic clock.
    pub at: Duration,
    /// Operating mode.
    pub mode: RobotMode,
    /// Active fault.
    pub fault: Option<Fault>,
    /// Pose in the site frame, and the measuring time of the last fix fused into it.
    pub pose: Option<(Pose, Duration)>,
    /// Twist in the robot frame, and the time of the last sample of gyro and wheels.
    pub twist: Option<(Twist, Duration)>,
    /// Progress of the active mission.
    pub mission: Option<MissionProgress>,
    /// Position of the reference on the plan of the active mission.
    pub governor: Option<Governor>,
    /// Whether a hold stops the active mission.
    pub is_on_hold: bool,
    /// Distance from the robot to the reference of a held mission, metres.
    pub off_path_m: Option<f64>,
    /// Whether the wheels are commanded to zero and are measured near zero.
    pub stands: bool,
    /// Action of the gate.
    pub(crate) gate: GateSnapshot,
    /// Revision of the active geofence.
    pub fence_revision: Option<u64>,
    /// The battery, if the base measures it.
    pub battery: Option<Battery>,
    /// Adapted θ̂ of the tracking law; that of the last mission between missions, `None` before the
    /// first.
    pub theta_loop: Option<f64>,
    /// Measured θ of the ground under the robot.
    pub theta_measured: Option<ThetaEstimate>,
    /// Why there is no θ, or none with a narrow interval.
    pub no_estimate: Option<NoEstimate>,
    /// Parameters of the robot, estimated together with θ.
    pub robot_parameters: Option<RobotParameters>,
    /// The last change of the payload, while it is reported.
    pub(crate) payload_change: Option<PayloadChange>,
    /// Wheel torques that are frozen.
    pub(crate) frozen_torque: Option<WheelTorques>,
    /// Whether recent motion carried information on θ.
    pub excited: bool,
    /// Changes of the ground that the estimator detected since the start.
    pub ground_changes: u64,
    /// The comparison that raised the alert that the ground differs from the map.
    pub(crate) surface_change: Option<Comparison>,
    /// Position at which the wheels turn without moving the robot.
    pub dug_in_at: Option<Point>,
    /// Lateness of the loop while the robot is held for it.
    pub(crate) overrun: Option<Overrun>,
    /// Contradictions between sensors.
    pub(crate) findings: Findings,
    /// Result of the standstill watch.
    pub(crate) standstill: StandstillReport,
    /// Longitudinal slip of each side, while it is defined.
    pub slip: Option<SideSlip>,
    /// Cell of the open segment.
    pub cell: Option<Cell>,
    /// Terrain under all wheels, as an index into the site's terrains.
    pub(crate) terrain: Option<usize>,
    /// Terrain revision of the active site definition.
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
            no_estimate: None,
            robot_parameters: None,
            payload_change: None,
            frozen_torque: None,
            excited: false,
            ground_changes: 0,
            surface_change: None,
            dug_in_at: None,
            overrun: None,
            findings: Findings::default(),
            standstill: StandstillReport::default(),
            slip: None,
            cell: None,
            terrain: None,
            terrain_revision: None,
            ticks: 0,
        }
    }
}

/// The plan that was given to the loop last.
#[derive(Debug, Clone)]
pub(crate) struct GivenPlan {
    pub(crate) mission: MissionId,
    pub(crate) revision: u32,
    pub(crate) plan: Arc<Plan>,
}

/// State shared by the loop and the rest of the agent.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    snapshot: Mutex<Snapshot>,
    /// Stops, teleoperation and limits, which can only slow the robot down.
    pub(crate) safety: Arc<SafetyCell>,
    /// Ticks since the start, for the watchdog.
    pub(crate) ticks: AtomicU64,
    /// Requests the loop to brake and end.
    pub(crate) stop: AtomicBool,
    /// Ticks that began more than one period late.
    pub(crate) overruns: AtomicU64,
    /// Refused commands: not parsable, or of another payload version.
    pub(crate) commands_refused: AtomicU64,
    /// Longest computing time of a tick since the last reading, microseconds.
    pub(crate) tick_max_us: AtomicU32,
    /// Segments that were dropped because the event channel was full.
    pub(crate) lost_segments: AtomicU64,
    /// Estimator blocks that belong to no cell, because the site or the position was unknown.
    pub(crate) unmapped_blocks: AtomicU64,
    /// Samples of the base that newer ones replaced before a tick read them.
    pub(crate) lost_samples: AtomicU64,
    /// Server commands that were dropped because the command channel was full.
    pub(crate) lost_commands: AtomicU64,
    /// Plan that was given to the loop last, for display; the loop does not read it.
    plan: Mutex<Option<GivenPlan>>,
    /// Time of the last message from the server, microseconds of the agent's monotonic clock.
    server_message_us: AtomicU64,
}

impl Shared {
    /// Returns the newest snapshot.
    pub(crate) fn snapshot(&self) -> Snapshot {
        *self.snapshot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Publishes a snapshot, unless the cell is locked by a reader; the next tick publishes again.
    pub(crate) fn publish(&self, snapshot: &Snapshot) {
        if let Ok(mut cell) = self.snapshot.try_lock() {
            *cell = *snapshot;
        }
    }

    /// Publishes the plan that the loop was given.
    pub(crate) fn show_plan(&self, given: GivenPlan) {
        *self.plan.lock().unwrap_or_else(PoisonError::into_inner) = Some(given);
    }

    /// Returns the plan that the loop was given last.
    pub(crate) fn given_plan(&self) -> Option<GivenPlan> {
        let plan = self.plan.lock();
        plan.unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn count(counter: &AtomicU64) {
        counter.fetch_add(1, Ordering::Relaxed);
    }

    /// Records a message from the server at `now`.
    pub(crate) fn record_server_message(&self, now: Duration) {
        let now_us = u64::try_from(now.as_micros()).unwrap_or(u64::MAX);
        self.server_message_us.fetch_max(now_us, Ordering::Relaxed);
    }

    /// Sets the time of the server's last message to the one in a record.
    pub(crate) fn replay_server_message(&self, received_at: Duration) {
        // Rounded up, so that a silence in whole microseconds is reproduced exactly and a message
        // after the begin of the tick gives a silence of zero.
        let received_us = received_at.as_nanos().div_ceil(1_000);
        let received_us = u64::try_from(received_us).unwrap_or(u64::MAX);
        self.server_message_us.store(received_us, Ordering::Relaxed);
    }

    /// Returns the time since the last message from the server.
    pub(crate) fn server_silence(&self, now: Duration) -> Duration {
        let received_at = Duration::from_micros(self.server_message_us.load(Ordering::Relaxed));
        now.saturating_sub(received_at)
    }
}

/// The loop's ends of the channels.
#[derive(Debug)]
pub(crate) struct LoopEnds {
    pub(crate) commands: Receiver<LoopCommand>,
    pub(crate) events: SyncSender<LoopEvent>,
    pub(crate) shared: Arc<Shared>,
}

/// The ends of the rest of the agent.
#[derive(Debug)]
pub(crate) struct AgentEnds {
    pub(crate) commands: SyncSender<LoopCommand>,
    pub(crate) events: Receiver<LoopEvent>,
    pub(crate) shared: Arc<Shared>,
}

/// Creates the channels between the loop and the rest of the agent.
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
