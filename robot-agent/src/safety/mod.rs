//! What may only slow the robot down: stops, teleoperation, limits from outside.
//!
//! [`stop`], [`operator`] and [`limits`] are pure and decide; [`Safety`] owns them, keeps the stop
//! on the disk ([`latch_file`]), and leaves what the loop needs in a cell that the loop never waits
//! for. What the loop has once seen carries its own end, so that a cell that it cannot read for a
//! moment makes nothing last longer. [`watchdog`] looks after the loop itself.
//!
//! A stop counts from the moment its message arrives: [`Safety::stop_now`] is called before it
//! waits in any queue. It is answered when the loop has set its target to zero under it
//! ([`Safety::confirm_stop`]) and the disk has it.

pub(crate) mod answers;
pub(crate) mod latch_file;
pub(crate) mod limits;
pub(crate) mod operator;
pub(crate) mod stop;
pub(crate) mod watchdog;

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

/// Longest wait until the loop has set its target to zero.
pub(crate) const ZERO_WAIT_MAX: Duration = Duration::from_millis(500);
/// Time between two looks at whether it has.
const ZERO_LOOK_EVERY: Duration = Duration::from_millis(1);

/// Microseconds of the agent's monotonic clock.
pub(crate) fn microseconds(at: Duration) -> u64 {
    u64::try_from(at.as_micros()).unwrap_or(u64::MAX)
}

/// Why a stop is not confirmed; it is in force all the same.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Unconfirmed {
    #[error("the control loop has not set its target to zero")]
    LoopStandsStill,
    #[error("the disk does not take the latch: {0}")]
    Disk(std::io::Error),
    #[error("the agent ends")]
    Ending,
}

/// Why a stop stays in force.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum NotCleared {
    Refused(ClearRefusal),
    Disk(String),
}

/// What the loop looks at in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub(crate) struct LoopView {
    // Earlier records say `hand`.
    #[serde(alias = "hand")]
    pub(crate) teleoperation: TeleoperationView,
    pub(crate) limits: LimitsView,
}

/// What passes between [`Safety`] and the loop.
#[derive(Debug, Default)]
pub(crate) struct SafetyCell {
    view: Mutex<LoopView>,
    /// The number of the newest stop in force; 0 for none.
    stop: AtomicU64,
    /// The newest stop under which the loop has set its target to zero.
    zeroed: AtomicU64,
}

impl SafetyCell {
    /// The newest view, unless somebody is writing right now.
    pub(crate) fn try_view(&self) -> Option<LoopView> {
        self.view.try_lock().ok().map(|view| *view)
    }

    /// The number of the stop in force; 0 for none.
    pub(crate) fn stop(&self) -> u64 {
        self.stop.load(Ordering::Acquire)
    }

    /// The loop has set its target to zero under this stop.
    pub(crate) fn note_zeroed(&self, stop: u64) {
        self.zeroed.fetch_max(stop, Ordering::Release);
    }

    /// Shows the loop what a record says that it saw.
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
    /// Counts the stops of this run.
    number: u64,
}

/// Everything that may only slow the robot down.
#[derive(Debug)]
pub(crate) struct Safety {
    clock: SharedClock,
    cell: Arc<SafetyCell>,
    stops: Mutex<Stops>,
    file: LatchFile,
    /// One writes the latch at a time, and always what is newest then.
    writing: tokio::sync::Mutex<()>,
    operator: Mutex<Operator>,
    limits: Mutex<ExternalLimits>,
    /// Woken when a stop or a lease begins or ends.
    changed: Notify,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Safety {
    /// What the disk says of stops, nobody driving, and the required owners silent.
    ///
    /// `state` is what the latch file of this folder said when the agent started.
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

    /// The stop in force.
    pub(crate) fn latch(&self) -> Option<StopLatch> {
        lock(&self.stops).state.latch().cloned()
    }

    /// Stops, at once and in memory; gives the number under which the loop confirms it.
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

    /// Stops, waits until the loop's target is zero and the disk has the latch.
    ///
    /// # Errors
    /// [`Unconfirmed`]: the robot is stopped as well as it can be, and the sender asks again.
    pub(crate) async fn confirm_stop(self: &Arc<Self>, stop: &Stop) -> Result<(), Unconfirmed> {
        let number = self.stop_now(stop);
        let zeroing = async {
            // A stop that was cleared since is confirmed by that.
            while self.cell.stop() != 0 && self.cell.zeroed.load(Ordering::Acquire) < number {
                tokio::time::sleep(ZERO_LOOK_EVERY).await;
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

    /// Ends a stop, on the disk first; that the robot stands is for the caller to check.
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
        // A stop that came meanwhile stays; it is written by whoever brought it.
        if let Some(next) = stops.state.cleared(stop).map_err(NotCleared::Refused)? {
            stops.state = next;
            self.cell.stop.store(0, Ordering::Release);
            info!(stop.id = %stop, "the stop was cleared by {by}");
            self.changed.notify_one();
        }
        Ok(())
    }

    /// Gives the lease of teleoperation, and says its epoch.
    ///
    /// # Errors
    /// [`LeaseRefusal`].
    pub(crate) fn acquire_lease(&self, command: &AcquireLease) -> Result<u64, LeaseRefusal> {
        self.operate(|operator, now_us| operator.acquire(command, now_us))
    }

    /// Takes the lease of teleoperation back.
    ///
    /// # Errors
    /// Who has it, if it is somebody else.
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

    /// Waits until a stop or a lease has begun or ended since the last call; for one who waits.
    pub(crate) async fn changed(&self) {
        self.changed.notified().await;
    }

    /// Who teleoperates.
    pub(crate) fn lease_now(&self) -> Option<Lease> {
        lock(&self.operator).lease_at(self.now_us()).cloned()
    }

    /// Takes what must not wait in any queue, as it came.
    pub(crate) fn take_urgent(&self, urgent: Urgent<'_>) {
        match urgent {
            // What does not parse is answered, and counted, where commands are.
            Urgent::Stop(payload) => {
                if let Ok(stop) = wire::decode::<Stop>(payload) {
                    self.stop_now(&stop);
                }
            }
            Urgent::Drive(payload) => self.take_drive(payload),
            Urgent::Limit(owner, payload) => self.take_published_limit(owner, payload),
        }
    }

    /// Takes a drive command as it came; never waits for more than another one.
    pub(crate) fn take_drive(&self, payload: &[u8]) {
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
            None => operator.note_malformed(),
        }
    }

    /// Takes a published limit as it came; `owner` is the one in its key.
    pub(crate) fn take_published_limit(&self, owner: &OwnerId, payload: &[u8]) {
        let limit = (payload.len() <= SMALL_PAYLOAD_MAX)
            .then(|| wire::decode::<ExternalLimit>(payload).ok())
            .flatten()
            .filter(|limit| limit.owner == *owner);
        match limit {
            // What is refused is counted.
            Some(limit) => drop(self.limit(&limit)),
            None => lock(&self.limits).note_malformed(),
        }
    }

    /// Takes a limit.
    ///
    /// # Errors
    /// [`LimitRefusal`].
    pub(crate) fn limit(&self, limit: &ExternalLimit) -> Result<(), LimitRefusal> {
        let mut limits = lock(&self.limits);
        limits.take(limit, self.now_us())?;
        self.cell.publish(|view| view.limits = limits.view());
        Ok(())
    }

    /// Teleoperation, for the state.
    pub(crate) fn drive_status(&self) -> Option<DriveStatus> {
        lock(&self.operator).status()
    }

    /// Limits for the state, and how many were refused.
    pub(crate) fn limits_status(&self) -> (Vec<LimitStatus>, u64) {
        let limits = lock(&self.limits);
        (limits.status(self.now_us()), limits.refused())
    }
}

#[cfg(test)]
mod limit_tests;
#[cfg(test)]
mod tests;
