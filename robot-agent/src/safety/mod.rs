//! Stops, teleoperation and external limits: everything outside the loop that can only slow the
//! robot.
//!
//! [`stop`], [`operator`] and [`limits`] are pure state machines. [`Safety`] owns them, stores the
//! stop latch on disk ([`latch_file`]) and publishes what the loop needs in a [`SafetyCell`], which
//! the loop reads without blocking. Every entry in the cell carries its expiry, so a tick that
//! cannot read the cell prolongs nothing. [`crate::control_loop::watchdog`] watches the loop itself.
//!
//! A stop takes effect when its message arrives: [`Safety::stop_now`] is called before the message
//! enters any queue. It is answered once the loop has set its target to zero under it
//! ([`Safety::confirm_stop`]) and the latch is on disk.

pub(crate) mod latch_file;
pub(crate) mod limits;
pub(crate) mod operator;
pub(crate) mod stop;

use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tokio::sync::Notify;
use tracing::{error, info, warn};
use tread_api::ids::{BootId, OwnerId, StopId};
use tread_api::safety::{DriveStatus, Driver, Lease, LimitStatus, SMALL_PAYLOAD_MAX, StopLatch};
use tread_api::wire;
use tread_api::wire::safety::{AcquireLease, DriveCommand, ExternalLimit, ReleaseLease, Stop};
use tread_control::robot::RobotModel;

use crate::clock::SharedClock;
use crate::fleet::Urgent;
use latch_file::LatchFile;
use limits::{ExternalLimits, LimitRefusal, LimitsView};
use operator::{LeaseRefusal, Operator, TeleoperationView, Verdict};
use stop::{ClearRefusal, StopState};

/// Longest wait for the loop to set its target to zero; the stop is then answered as unconfirmed.
pub(crate) const ZERO_WAIT_MAX: Duration = Duration::from_millis(500);
/// Interval of the checks whether the loop has set its target to zero.
const ZERO_POLL_EVERY: Duration = Duration::from_millis(1);

/// Returns the time in whole microseconds.
pub(crate) fn microseconds(at: Duration) -> u64 {
    u64::try_from(at.as_micros()).unwrap_or(u64::MAX)
}

/// Why a stop is not confirmed; it is in force regardless.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Unconfirmed {
    #[error("the control loop has not set its target to zero")]
    LoopStandsStill,
    #[error("the disk does not take the latch: {0}")]
    Disk(std::io::Error),
    #[error("the agent ends")]
    Ending,
}

/// Why a stop stays in force after a request to clear it.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum NotCleared {
    Refused(ClearRefusal),
    Disk(String),
}

/// Teleoperation and limits as the loop reads them in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct LoopView {
    // Older records name the field `hand`.
    #[serde(alias = "hand")]
    pub(crate) teleoperation: TeleoperationView,
    pub(crate) limits: LimitsView,
}

/// Cell shared by [`Safety`] and the loop.
#[derive(Debug, Default)]
pub(crate) struct SafetyCell {
    view: Mutex<LoopView>,
    /// The number of the newest stop in force; 0 for none.
    stop: AtomicU64,
    /// Number of the newest stop under which the loop has set its target to zero.
    zeroed: AtomicU64,
}

impl SafetyCell {
    /// Returns the newest view, unless it is being written.
    pub(crate) fn try_view(&self) -> Option<LoopView> {
        self.view.try_lock().ok().map(|view| *view)
    }

    /// Returns the number of the stop in force; 0 for none.
    pub(crate) fn stop(&self) -> u64 {
        self.stop.load(Ordering::Acquire)
    }

    /// Records that the loop has set its target to zero under this stop.
    pub(crate) fn record_zeroed(&self, stop: u64) {
        self.zeroed.fetch_max(stop, Ordering::Release);
    }

    /// Sets stop and view to those of a recorded tick, for a replay.
    pub(crate) fn show(&self, stop: u64, view: &LoopView) {
        self.stop.store(stop, Ordering::Release);
        self.publish(|shown| *shown = *view);
    }

    fn publish(&self, change: impl FnOnce(&mut LoopView)) {
        change(&mut self.view.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

#[derive(Debug)]
struct Stops {
    state: StopState,
    /// Number of stops of this run of the agent.
    number: u64,
}

/// State of stops, teleoperation and limits.
#[derive(Debug)]
pub(crate) struct Safety {
    clock: SharedClock,
    cell: Arc<SafetyCell>,
    stops: Mutex<Stops>,
    file: LatchFile,
    /// Serialises the writes of the latch file; each writes the newest state.
    writing: tokio::sync::Mutex<()>,
    operator: Mutex<Operator>,
    limits: Mutex<ExternalLimits>,
    /// Notified when a stop or a lease begins or ends.
    changed: Notify,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Safety {
    /// Creates the state at the agent's start: the stop from the disk, no lease, and every required
    /// owner silent.
    ///
    /// `state` is the content of the latch file of `folder`.
    pub(crate) fn open(
        folder: &Path,
        state: StopState,
        boot: BootId,
        model: RobotModel,
        required: &[OwnerId],
        cell: Arc<SafetyCell>,
        clock: SharedClock,
    ) -> Arc<Self> {
        let file = LatchFile::new(folder);
        let number = u64::from(state.latch().is_some());
        if let Some(latch) = state.latch() {
            warn!(stop.id = %latch.id, "starting stopped: {} ({})", latch.reason, latch.by);
        }
        let limits = ExternalLimits::new(boot, required);
        let operator = Operator::new(boot, model);
        cell.stop.store(number, Ordering::Release);
        cell.publish(|view| {
            view.limits = limits.view();
            view.teleoperation = operator.view();
        });
        Arc::new(Self {
            clock,
            cell,
            stops: Mutex::new(Stops { state, number }),
            file,
            writing: tokio::sync::Mutex::new(()),
            operator: Mutex::new(operator),
            limits: Mutex::new(limits),
            changed: Notify::new(),
        })
    }

    fn now_us(&self) -> u64 {
        microseconds(self.clock.monotonic())
    }

    /// Returns the stop in force.
    pub(crate) fn latch(&self) -> Option<StopLatch> {
        lock(&self.stops).state.latch().cloned()
    }

    /// Puts a stop in force at once, in memory. Returns the number under which the loop confirms
    /// it.
    pub(crate) fn stop_now(&self, stop: &Stop) -> u64 {
        let mut stops = lock(&self.stops);
        if stops.state.stop(stop, self.clock.wall()) {
            stops.number += 1;
            self.cell.stop.store(stops.number, Ordering::Release);
            let id = stop.stop;
            warn!(stop.id = %id, "stopped by {}: {}", stop.by, stop.reason);
            self.changed.notify_one();
        }
        stops.number
    }

    /// Puts a stop in force, and waits until the loop's target is zero and the latch is on disk.
    ///
    /// # Errors
    /// [`Unconfirmed`]: the stop is in force, but the loop or the disk has not confirmed it; the
    /// sender repeats it.
    pub(crate) async fn confirm_stop(self: &Arc<Self>, stop: &Stop) -> Result<(), Unconfirmed> {
        let number = self.stop_now(stop);
        let zeroing = async {
            // A stop that was cleared meanwhile counts as confirmed.
            while self.cell.stop() != 0 && self.cell.zeroed.load(Ordering::Acquire) < number {
                tokio::time::sleep(ZERO_POLL_EVERY).await;
            }
        };
        let zeroing = tokio::time::timeout(ZERO_WAIT_MAX, zeroing);
        let (zeroed, written) = tokio::join!(zeroing, self.write_newest());
        zeroed.map_err(|_| Unconfirmed::LoopStandsStill)?;
        written
    }

    async fn write_newest(self: &Arc<Self>) -> Result<(), Unconfirmed> {
        let _writing = self.writing.lock().await;
        let state = lock(&self.stops).state.clone();
        self.write(state).await
    }

    async fn write(self: &Arc<Self>, state: StopState) -> Result<(), Unconfirmed> {
        let safety = Arc::clone(self);
        let writing = tokio::task::spawn_blocking(move || safety.file.save(&state));
        let written = writing.await.map_err(|_| Unconfirmed::Ending)?;
        written.map_err(|cause| {
            error!("the stop latch cannot be written: {cause}");
            Unconfirmed::Disk(cause)
        })
    }

    /// Clears a stop, on disk first. The caller must check that the robot has stopped.
    ///
    /// # Errors
    /// [`NotCleared`]: the stop stays.
    pub(crate) async fn clear(self: &Arc<Self>, stop: StopId, by: &str) -> Result<(), NotCleared> {
        let _writing = self.writing.lock().await;
        let next = lock(&self.stops).state.cleared(stop);
        let Some(next) = next.map_err(NotCleared::Refused)? else {
            return Ok(());
        };
        let written = self.write(next).await;
        written.map_err(|cause| NotCleared::Disk(cause.to_string()))?;
        let mut stops = lock(&self.stops);
        // A newer stop stays in force; whoever sent it has it written.
        if let Some(next) = stops.state.cleared(stop).map_err(NotCleared::Refused)? {
            stops.state = next;
            self.cell.stop.store(0, Ordering::Release);
            info!(stop.id = %stop, "the stop was cleared by {by}");
            self.changed.notify_one();
        }
        Ok(())
    }

    /// Grants the lease of teleoperation and returns its epoch.
    ///
    /// # Errors
    /// [`LeaseRefusal`]: another driver has the lease, or the lease granted to this request is
    /// over.
    pub(crate) fn acquire_lease(&self, command: &AcquireLease) -> Result<u64, LeaseRefusal> {
        self.operate(|operator, now_us| operator.acquire(command, now_us))
    }

    /// Ends the lease of teleoperation.
    ///
    /// # Errors
    /// The driver who has the lease, if it is another one.
    pub(crate) fn release_lease(&self, command: &ReleaseLease) -> Result<(), Driver> {
        self.operate(|operator, now_us| operator.release(command, now_us))
    }

    fn operate<T, E>(&self, act: impl FnOnce(&mut Operator, u64) -> Result<T, E>) -> Result<T, E> {
        let mut operator = lock(&self.operator);
        let answer = act(&mut operator, self.now_us());
        self.cell
            .publish(|view| view.teleoperation = operator.view());
        if answer.is_ok() {
            self.changed.notify_one();
        }
        answer
    }

    /// Waits until a stop or a lease has begun or ended since the last call. For a single waiting
    /// task.
    pub(crate) async fn changed(&self) {
        self.changed.notified().await;
    }

    /// Returns the lease in force.
    pub(crate) fn lease_now(&self) -> Option<Lease> {
        lock(&self.operator).lease_at(self.now_us()).cloned()
    }

    /// Processes an urgent message at once.
    pub(crate) fn handle_urgent(&self, urgent: Urgent<'_>) {
        match urgent {
            // A stop that does not parse is answered and counted where commands are.
            Urgent::Stop(payload) => {
                if let Ok(stop) = wire::decode::<Stop>(payload) {
                    self.stop_now(&stop);
                }
            }
            Urgent::Drive(payload) => self.handle_drive(payload),
            Urgent::Limit(owner, payload) => self.handle_published_limit(owner, payload),
        }
    }

    /// Processes a drive command; blocks at most for another command.
    pub(crate) fn handle_drive(&self, payload: &[u8]) {
        let command = (payload.len() <= SMALL_PAYLOAD_MAX)
            .then(|| wire::decode::<DriveCommand>(payload).ok())
            .flatten();
        let mut operator = lock(&self.operator);
        match command {
            Some(command) => {
                if operator.drive(&command, self.now_us()) == Verdict::Accepted {
                    self.cell
                        .publish(|view| view.teleoperation = operator.view());
                }
            }
            None => operator.count_malformed(),
        }
    }

    /// Processes a published limit; `owner` is the owner in its key, which must be that of the
    /// payload.
    pub(crate) fn handle_published_limit(&self, owner: &OwnerId, payload: &[u8]) {
        let limit = (payload.len() <= SMALL_PAYLOAD_MAX)
            .then(|| wire::decode::<ExternalLimit>(payload).ok())
            .flatten()
            .filter(|limit| limit.owner == *owner);
        match limit {
            // A refused limit is counted.
            Some(limit) => drop(self.limit(&limit)),
            None => lock(&self.limits).count_malformed(),
        }
    }

    /// Applies a limit.
    ///
    /// # Errors
    /// [`LimitRefusal`]: the limit is not applied.
    pub(crate) fn limit(&self, limit: &ExternalLimit) -> Result<(), LimitRefusal> {
        let mut limits = lock(&self.limits);
        limits.take(limit, self.now_us())?;
        self.cell.publish(|view| view.limits = limits.view());
        Ok(())
    }

    /// Returns the state of teleoperation for the robot's state message.
    pub(crate) fn drive_status(&self) -> Option<DriveStatus> {
        lock(&self.operator).status()
    }

    /// Returns the limits for the robot's state message, and the number refused.
    pub(crate) fn limits_status(&self) -> (Vec<LimitStatus>, u64) {
        let limits = lock(&self.limits);
        (limits.status(self.now_us()), limits.refused())
    }
}

#[cfg(test)]
mod limit_tests;
#[cfg(test)]
mod tests;
