//! Answers the server's safety commands: stop, clear, lease, limit.

use std::sync::Arc;
use std::time::Duration;

use tread_api::safety::Driver;
use tread_api::wire::reply::{CommandRefusal, CommandRefusalCode};
use tread_api::wire::safety::{AcquireLease, ClearStop, ExternalLimit, ReleaseLease, Stop};

use super::limits::LimitRefusal;
use super::operator::LeaseRefusal;
use super::stop::ClearRefusal;
use super::{NotCleared, Safety};
use crate::clock::SharedClock;
use crate::control_loop::channels::Shared;

/// Oldest word of the loop by which a robot counts as standing.
const STANDS_AGE_MAX: Duration = Duration::from_millis(500);

/// Stops; done once the target is zero and the disk has the latch.
pub(crate) async fn stop(safety: &Arc<Safety>, stop: &Stop) -> Result<(), CommandRefusal> {
    let confirmed = safety.confirm_stop(stop).await;
    confirmed.map_err(|cause| not_ready(cause.to_string()))?;
    // Stops may come in another order than they were asked for in, and the clear of the one
    // that came last ends all that came before.
    if safety.latch().is_none() {
        let detail = "this stop was in force, and was cleared";
        return Err(CommandRefusal::new(CommandRefusalCode::Ended, detail));
    }
    Ok(())
}

/// Ends a stop, if the robot stands.
pub(crate) async fn clear(
    safety: &Arc<Safety>,
    shared: &Shared,
    clock: &SharedClock,
    clear: &ClearStop,
) -> Result<(), CommandRefusal> {
    if safety.latch().is_some_and(|latch| latch.id == clear.stop) {
        let snapshot = shared.snapshot();
        if clock.monotonic().saturating_sub(snapshot.at) > STANDS_AGE_MAX {
            return Err(not_ready("the control loop stands still"));
        }
        if !snapshot.stands {
            let detail = "the robot does not stand";
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

/// Gives the lease.
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

/// Takes the lease back.
pub(crate) fn release_lease(safety: &Safety, command: &ReleaseLease) -> Result<(), CommandRefusal> {
    let released = safety.release_lease(command);
    released.map_err(|driver| leased_by(&driver))
}

/// Takes a limit.
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

/// A refusal because of who teleoperates.
pub(crate) fn leased_by(driver: &Driver) -> CommandRefusal {
    let detail = format!("{} teleoperates the robot", driver.name);
    CommandRefusal::new(CommandRefusalCode::Leased, detail)
}

fn not_ready(detail: impl Into<String>) -> CommandRefusal {
    CommandRefusal::new(CommandRefusalCode::NotReady, detail)
}
