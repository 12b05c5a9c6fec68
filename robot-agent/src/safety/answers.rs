//! Answers the server's safety commands: stop, clear, lease, limit.

use std::sync::Arc;
use std::time::Duration;

use tread_api::wire::command::{OfferRefusal, Outcome};
use tread_api::wire::safety::{ClearStop, ExternalLimit, LeaseCommand, Stop};

use super::limits::LimitRefusal;
use super::operator::{LeaseAnswer, LeaseRefusal};
use super::stop::ClearRefusal;
use super::{NotCleared, Safety};
use crate::clock::SharedClock;
use crate::control_loop::channels::Shared;

/// Oldest word of the loop by which a robot counts as standing.
const STANDS_AGE_MAX: Duration = Duration::from_millis(500);

fn refused(code: OfferRefusal, detail: impl Into<String>) -> Outcome {
    Outcome::Refused {
        code,
        detail: detail.into(),
    }
}

/// Stops, and says so once the target is zero and the disk has the latch.
pub(crate) async fn stop(safety: &Arc<Safety>, stop: &Stop) -> Outcome {
    match safety.confirm_stop(stop).await {
        // Stops may come in another order than they were asked for in, and the clear of the one
        // that came last ends all that came before.
        Ok(()) if safety.latch().is_none() => refused(
            OfferRefusal::Ended,
            "this stop was in force, and was cleared",
        ),
        Ok(()) => Outcome::Done,
        Err(cause) => refused(OfferRefusal::NotReady, cause.to_string()),
    }
}

/// Ends a stop, if the robot stands.
pub(crate) async fn clear(
    safety: &Arc<Safety>,
    shared: &Shared,
    clock: &SharedClock,
    clear: &ClearStop,
) -> Outcome {
    if safety.latch().is_some_and(|latch| latch.id == clear.stop) {
        let snapshot = shared.snapshot();
        if clock.monotonic().saturating_sub(snapshot.at) > STANDS_AGE_MAX {
            return refused(OfferRefusal::NotReady, "the control loop stands still");
        }
        if !snapshot.stands {
            return refused(OfferRefusal::Moving, "the robot does not stand");
        }
    }
    match safety.clear(clear.stop, &clear.by).await {
        Ok(()) => Outcome::Done,
        Err(NotCleared::Refused(ClearRefusal::Newer(latch))) => refused(
            OfferRefusal::Conflict,
            format!("stop {} by {} is newer and in force", latch.id, latch.by),
        ),
        Err(NotCleared::Refused(ClearRefusal::Unknown)) => {
            refused(OfferRefusal::Unknown, "this stop never came here")
        }
        Err(NotCleared::Disk(cause)) => refused(OfferRefusal::NotReady, cause),
    }
}

/// Acquires, takes or releases the lease.
pub(crate) fn lease(safety: &Safety, command: &LeaseCommand) -> Outcome {
    match safety.lease(command) {
        Ok(LeaseAnswer::Leased(epoch)) => Outcome::Leased { epoch },
        Ok(LeaseAnswer::Released) => Outcome::Done,
        Err(LeaseRefusal::Taken(driver)) => refused(
            OfferRefusal::Leased,
            format!("{} teleoperates the robot", driver.name),
        ),
        Err(LeaseRefusal::Over) => refused(OfferRefusal::Ended, "this lease is over"),
    }
}

/// Takes a limit.
pub(crate) fn limit(safety: &Safety, limit: &ExternalLimit) -> Outcome {
    match safety.limit(limit) {
        Ok(()) => Outcome::Done,
        Err(LimitRefusal::Foreign) => refused(
            OfferRefusal::Conflict,
            "the limit is for another run of the agent",
        ),
        Err(LimitRefusal::OutOfOrder) => refused(
            OfferRefusal::Conflict,
            "a newer limit of this owner is in force",
        ),
        Err(LimitRefusal::TooLong) => refused(
            OfferRefusal::Impossible,
            "its end is more than an hour ahead",
        ),
        Err(LimitRefusal::Invalid(detail)) => refused(OfferRefusal::Impossible, detail),
        Err(LimitRefusal::TooMany) => {
            refused(OfferRefusal::TooMany, "too many owners limit the robot")
        }
    }
}
