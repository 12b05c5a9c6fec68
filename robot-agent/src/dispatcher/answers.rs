//! Answers the server's safety commands: stop, clear, lease, limit.

use std::sync::Arc;
use std::time::Duration;

use tread_api::safety::Driver;
use tread_api::wire::reply::{CommandRefusal, CommandRefusalCode};
use tread_api::wire::safety::{AcquireLease, ClearStop, ExternalLimit, ReleaseLease, Stop};

use crate::clock::SharedClock;
use crate::control_loop::channels::Shared;
use crate::safety::limits::LimitRefusal;
use crate::safety::operator::LeaseRefusal;
use crate::safety::stop::ClearRefusal;
use crate::safety::{NotCleared, Safety};

/// Largest age of the loop's snapshot by which the robot may count as stopped.
const SNAPSHOT_AGE_MAX: Duration = Duration::from_millis(500);

/// Puts a stop in force; returns once the loop's target is zero and the latch is on disk.
pub(crate) async fn stop(safety: &Arc<Safety>, stop: &Stop) -> Result<(), CommandRefusal> {
    let confirmed = safety.confirm_stop(stop).await;
    confirmed.map_err(|cause| not_ready(cause.to_string()))?;
    // Stops may arrive in another order than they were sent, and clearing the one that arrived last
    // ends all before it.
    if safety.latch().is_none() {
        let detail = "this stop was in force, and was cleared";
        return Err(CommandRefusal::new(CommandRefusalCode::Ended, detail));
    }
    Ok(())
}

/// Clears a stop, if the robot has stopped.
pub(crate) async fn clear(
    safety: &Arc<Safety>,
    shared: &Shared,
    clock: &SharedClock,
    clear: &ClearStop,
) -> Result<(), CommandRefusal> {
    if safety.latch().is_some_and(|latch| latch.id == clear.stop) {
        let snapshot = shared.snapshot();
        if clock.monotonic().saturating_sub(snapshot.at) > SNAPSHOT_AGE_MAX {
            return Err(not_ready("the control loop stands still"));
        }
        if !snapshot.stands {
            let detail = "the robot is not at standstill";
            return Err(CommandRefusal::new(CommandRefusalCode::Moving, detail));
        }
    }
    let cleared = safety.clear(clear.stop, &clear.by).await;
    cleared.map_err(|refused| match refused {
        NotCleared::Refused(ClearRefusal::Newer(latch)) => CommandRefusal::new(
            CommandRefusalCode::Conflict,
            format!("stop {} by {} is newer and in force", latch.id, latch.by),
        ),
        NotCleared::Refused(ClearRefusal::Unknown) => {
            CommandRefusal::new(CommandRefusalCode::Unknown, "this stop never came here")
        }
        NotCleared::Disk(cause) => not_ready(cause),
    })
}

/// Grants the lease.
pub(crate) fn acquire_lease(
    safety: &Safety,
    command: &AcquireLease,
) -> Result<u64, CommandRefusal> {
    safety
        .acquire_lease(command)
        .map_err(|refused| match refused {
            LeaseRefusal::Taken(driver) => leased_by(&driver),
            LeaseRefusal::Over => {
                CommandRefusal::new(CommandRefusalCode::Ended, "this lease is over")
            }
        })
}

/// Ends the lease.
pub(crate) fn release_lease(safety: &Safety, command: &ReleaseLease) -> Result<(), CommandRefusal> {
    let released = safety.release_lease(command);
    released.map_err(|driver| leased_by(&driver))
}

/// Applies a limit.
pub(crate) fn limit(safety: &Safety, limit: &ExternalLimit) -> Result<(), CommandRefusal> {
    safety.limit(limit).map_err(|refused| match refused {
        LimitRefusal::Foreign => CommandRefusal::new(
            CommandRefusalCode::Conflict,
            "the limit is for another run of the agent",
        ),
        LimitRefusal::OutOfOrder => CommandRefusal::new(
            CommandRefusalCode::Conflict,
            "a newer limit of this owner is in force",
        ),
        LimitRefusal::TooLong => CommandRefusal::new(
            CommandRefusalCode::Impossible,
            "its end is more than an hour ahead",
        ),
        LimitRefusal::Invalid(detail) => {
            CommandRefusal::new(CommandRefusalCode::Impossible, detail)
        }
        LimitRefusal::TooMany => CommandRefusal::new(
            CommandRefusalCode::TooMany,
            "too many owners limit the robot",
        ),
    })
}

/// Creates the refusal for a robot that this driver teleoperates.
pub(crate) fn leased_by(driver: &Driver) -> CommandRefusal {
    let detail = format!("{} teleoperates the robot", driver.name);
    CommandRefusal::new(CommandRefusalCode::Leased, detail)
}

fn not_ready(detail: impl Into<String>) -> CommandRefusal {
    CommandRefusal::new(CommandRefusalCode::NotReady, detail)
}
