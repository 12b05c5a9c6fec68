//! Builds what the robot publishes about itself from the loop's latest snapshot.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};
use tread_api::friction::LiveFriction;
use tread_api::robot::{Aged, Battery, LoopStatus};
use tread_api::safety::{
    self, GateCount, GateStatus, SafetyStatus, StandstillState, StandstillStatus,
};
use tread_api::wire::state::{FrictionReport, RobotState};
use tread_control::gate::GateCause;

use crate::alerts::{AlertInputs, Alerts};
use crate::clock::SharedClock;
use crate::control_loop::channels::{Shared, Snapshot};
use crate::control_loop::standstill::StandstillReport;
use crate::drive::ros2::notices::{ForeignCommands, RecentNotices};
use crate::drive::ros2::refusal::Notice;
use crate::drive::ros2::refusal::{Counts, DropMonitor, Source};
use crate::fleet::{FleetLink, Identity};
use crate::geometry::{wire_pose, wire_twist};
use crate::knowledge::SiteCell;
use crate::outbox::Outbox;
use crate::safety::{Safety, microseconds};
use crate::state_rate::{PublishRate, PublishTimes};

/// Longest wait for the loop before a change is published: two ticks of the slowest loop.
const TICK_WAIT_MAX: Duration = Duration::from_millis(100);
/// Interval of the checks of the loop's ticks, and the shortest time between two published changes.
const TICK_POLL_EVERY: Duration = Duration::from_millis(2);

/// Builds and publishes the robot's state.
#[derive(Debug)]
pub(crate) struct Reporter {
    pub(crate) identity: Identity,
    pub(crate) clock: SharedClock,
    pub(crate) shared: Arc<Shared>,
    pub(crate) site: Arc<SiteCell>,
    pub(crate) safety: Arc<Safety>,
    pub(crate) outbox: Outbox,
    pub(crate) rate_hz: f64,
    pub(crate) publish_rate: Arc<PublishRate>,
    pub(crate) states: AtomicU64,
    pub(crate) frictions: AtomicU64,
    pub(crate) alerts: Mutex<Alerts>,
    /// Counts of the base's dropped messages, where they are counted.
    pub(crate) base: Option<Arc<Counts>>,
}

/// Converts a cause to the wire's.
fn wire_cause(cause: GateCause) -> safety::GateCause {
    match cause {
        GateCause::Acceleration => safety::GateCause::Acceleration,
        GateCause::Speed => safety::GateCause::Speed,
        GateCause::CommandAge => safety::GateCause::CommandAge,
        GateCause::ExternalLimit => safety::GateCause::ExternalLimit,
        GateCause::Fence => safety::GateCause::Fence,
        GateCause::NotFinite => safety::GateCause::NotFinite,
        GateCause::NoCommand => safety::GateCause::NoCommand,
        GateCause::Lease => safety::GateCause::Lease,
        GateCause::LinkPolicy => safety::GateCause::LinkPolicy,
        GateCause::ExternalHold => safety::GateCause::ExternalHold,
        GateCause::LoopOverrun => safety::GateCause::LoopOverrun,
        GateCause::SensorFault => safety::GateCause::SensorFault,
        GateCause::StalePosition => safety::GateCause::StalePosition,
        GateCause::Tilt => safety::GateCause::Tilt,
        GateCause::StaleFeedback => safety::GateCause::StaleFeedback,
        GateCause::Stop => safety::GateCause::Stop,
    }
}

/// Converts the result of the standstill watch to the wire's; `None` unless zero is commanded.
fn wire_standstill(report: &StandstillReport) -> Option<StandstillStatus> {
    let state = if report.standstill_not_reached.is_some() {
        StandstillState::StandstillNotReached
    } else if report.unexpected_motion.is_some() {
        StandstillState::UnexpectedMotion
    } else if report.standstill.is_some() {
        StandstillState::Standstill
    } else {
        StandstillState::Stopping
    };
    let took = report.standstill.map(|(_, took)| took.as_millis());
    report.is_rest_commanded.then(|| StandstillStatus {
        state,
        stopping_time_ms: took.map(|took| u64::try_from(took).unwrap_or(u64::MAX)),
    })
}

fn aged<T>(value: T, age: Duration) -> Aged<T> {
    Aged {
        value,
        age_ms: u64::try_from(age.as_millis()).unwrap_or(u64::MAX),
    }
}

impl Reporter {
    /// Returns the present state.
    pub(crate) fn state(&self) -> RobotState {
        let snapshot = self.shared.snapshot();
        let now = self.clock.monotonic();
        let (outbox, outbox_damage) = (self.outbox.status(), self.outbox.damage());
        let causes = AlertInputs {
            battery: snapshot.battery,
            fault: snapshot.fault,
            is_stopped: self.shared.safety.stop() != 0,
            outbox,
            outbox_damage: Some(&outbox_damage),
            base: self.base.as_deref(),
            surface_change: snapshot.surface_change,
            payload_change: snapshot.payload_change,
            frozen_torque: snapshot.frozen_torque,
            dug_in_at: snapshot.dug_in_at,
            overrun: snapshot.overrun,
            findings: snapshot.findings,
            standstill: snapshot.standstill,
        };
        let counted = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        RobotState {
            robot: self.identity.robot.clone(),
            boot: self.identity.boot,
            seq: self.states.fetch_add(1, Ordering::Relaxed),
            robot_time: self.clock.wall(),
            leaving: false,
            monotonic_us: Some(microseconds(now)),
            mode: snapshot.mode,
            fault: snapshot.fault.map(|fault| fault.text().to_owned()),
            pose: snapshot
                .pose
                .map(|(pose, at)| aged(wire_pose(pose), now.saturating_sub(at))),
            twist: snapshot
                .twist
                .map(|(twist, at)| aged(wire_twist(twist), now.saturating_sub(at))),
            mission: snapshot.mission,
            terrain_revision: snapshot.terrain_revision,
            outbox,
            control_loop: LoopStatus {
                rate_hz: self.rate_hz,
                ticks: snapshot.ticks,
                overruns: counted(&self.shared.overruns),
                lost_segments: counted(&self.shared.lost_segments),
                unmapped_blocks: counted(&self.shared.unmapped_blocks),
                lost_samples: counted(&self.shared.lost_samples),
                lost_commands: counted(&self.shared.lost_commands),
                tick_max_us: self.shared.tick_max_us.swap(0, Ordering::Relaxed),
                commands_refused: self.shared.commands_refused.load(Ordering::Relaxed),
            },
            battery: snapshot.battery.map(|battery| Battery {
                charge_ratio: battery.charge_ratio,
                voltage_v: Some(battery.voltage_v),
                charging: false,
            }),
            alerts: self
                .alerts
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .judge(&causes),
            safety: self.safety_status(&snapshot),
        }
    }

    fn safety_status(&self, snapshot: &Snapshot) -> SafetyStatus {
        let gate = &snapshot.gate;
        let counts = GateCause::ALL.into_iter().zip(gate.counts);
        let (limits, limits_refused) = self.safety.limits_status();
        SafetyStatus {
            stop: self.safety.latch(),
            lease: self.safety.lease_now(),
            drive: self.safety.drive_status(),
            gate: GateStatus {
                cause: gate.cause.map(wire_cause),
                reduced_ticks: gate.reduced_ticks,
                counts: counts
                    .filter(|(_, count)| *count > 0)
                    .map(|(cause, count)| GateCount {
                        cause: wire_cause(cause),
                        count,
                    })
                    .collect(),
            },
            limits,
            limits_refused,
            standstill: wire_standstill(&snapshot.standstill),
            fence_revision: snapshot.fence_revision,
        }
    }

    /// Waits until the loop has processed a recent change, so that the published mode includes it.
    async fn await_loop_update(&self) {
        let ticks = || self.shared.ticks.load(Ordering::Relaxed);
        // A tick that has begun may not have read the change.
        let seen = ticks() + 2;
        let ticking = async {
            while ticks() < seen {
                tokio::time::sleep(TICK_POLL_EVERY).await;
            }
        };
        // If the loop does not tick, its last snapshot is published.
        let _ = tokio::time::timeout(TICK_WAIT_MAX, ticking).await;
    }

    /// Returns both present friction estimates.
    pub(crate) fn friction(&self) -> FrictionReport {
        let snapshot = self.shared.snapshot();
        let view = self.site.view();
        // Without the newest definition in the loop, the index of the terrain is not valid.
        let view = view.filter(|view| Some(view.terrain_revision()) == snapshot.terrain_revision);
        let terrain = view.as_ref().zip(snapshot.terrain);
        FrictionReport {
            robot: self.identity.robot.clone(),
            boot: self.identity.boot,
            seq: self.frictions.fetch_add(1, Ordering::Relaxed),
            robot_time: self.clock.wall(),
            cell: snapshot.cell,
            terrain: terrain
                .and_then(|(view, place)| view.terrain(place))
                .cloned(),
            friction: LiveFriction {
                theta_loop: snapshot.theta_loop,
                theta_measured: snapshot.theta_measured,
                no_estimate: snapshot.no_estimate,
                excited: snapshot.excited,
                slip: snapshot.slip,
                robot_parameters: snapshot.robot_parameters,
            },
        }
    }
}

/// Interval of the checks of the loss counters.
const LOSSES_EVERY: Duration = Duration::from_secs(10);

/// Logs new losses of the loop and the base until requested to stop.
pub(crate) async fn log_losses(
    shared: Arc<Shared>,
    base: Option<Arc<Counts>>,
    stop: CancellationToken,
) {
    let (mut drop_monitor, mut logged_drops) = (DropMonitor::default(), None);
    let (mut segments, mut blocks) = (0, 0);
    let mut recent_notices = [RecentNotices::default(); Notice::ALL.len()];
    let mut noticed = [const { None }; Notice::ALL.len()];
    let (mut foreign, mut logged_foreign) = (ForeignCommands::default(), None);
    let mut logged_missing = None;
    loop {
        tokio::select! {
            () = tokio::time::sleep(LOSSES_EVERY) => {}
            () = stop.cancelled() => return,
        }
        let dropped = base.as_deref().and_then(|base| drop_monitor.check(base));
        // The count in it grows as long as there is something new.
        if let Some((_, text)) = dropped.as_ref().filter(|_| dropped != logged_drops) {
            warn!("{text}");
        }
        logged_drops = dropped;
        if let Some(base) = base.as_deref() {
            for notice in Notice::ALL {
                let text = recent_notices[notice as usize].check(base, notice);
                let former = std::mem::replace(&mut noticed[notice as usize], text.clone());
                if let Some(text) = text.filter(|text| former.as_ref() != Some(text)) {
                    warn!("{text}");
                }
            }
            let text = foreign.check(base);
            if let Some(text) = text.as_ref().filter(|_| text != logged_foreign) {
                warn!("{text}");
            }
            logged_foreign = text;
            let text = base.topics_without_messages(&Source::CONTINUOUS);
            if let Some(text) = text.as_ref().filter(|_| text != logged_missing) {
                warn!("{text}: does a node publish it under this name? (`tread-agent doctor`)");
            }
            logged_missing = text;
        }
        let lost = shared.lost_segments.load(Ordering::Relaxed);
        if lost > segments {
            warn!(
                lost,
                "{lost} segments were lost since the start: nobody took them in time"
            );
            segments = lost;
        }
        let unmapped = shared.unmapped_blocks.load(Ordering::Relaxed);
        if unmapped > blocks {
            info!(
                unmapped,
                "{unmapped} measurements belong to no cell: site or pose was not known, the robot \
                 was outside of the grid, or its wheels were on two kinds of ground"
            );
            blocks = unmapped;
        }
    }
}

/// Publishes the state at the present rate, and at once when a stop or a lease has begun or ended,
/// until the future is dropped.
pub(crate) async fn publish_states(link: Arc<FleetLink>, reporter: &Reporter) {
    let mut times = PublishTimes::new(&reporter.publish_rate);
    loop {
        tokio::select! {
            () = times.next() => {}
            () = reporter.safety.changed() => reporter.await_loop_update().await,
        }
        link.publish_state(&reporter.state());
    }
}

/// Publishes at a fixed rate until the task is dropped.
pub(crate) async fn every(rate_hz: f64, link: Arc<FleetLink>, publish: impl Fn(&FleetLink)) {
    let mut ticks = tokio::time::interval(Duration::from_secs_f64(rate_hz.recip()));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        publish(&link);
    }
}
