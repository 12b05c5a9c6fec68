//! What an open mission needs, from where it stands and what its robot says. Pure.

use std::time::Duration;

use tread_api::mission::MissionState;
use tread_api::robot::LinkState;

use crate::app::missions::transitions::Change;
use crate::db::missions::Standing;
use crate::fleet::presence::Presence;

/// How long the records of an earlier run may take to arrive before a mission counts as lost.
pub(super) const RESTART_GRACE: Duration = Duration::from_secs(3);

/// What a mission needs now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Need {
    /// Nothing but time.
    Wait,
    /// Offer it to its robot.
    Offer,
    /// Tell its robot to end it.
    Cancel,
    /// Settle it here, for this reason.
    Settle(Change, &'static str),
}

/// What the reconciler remembers of a mission while it is open; losing it does no harm.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Memory {
    /// Since when the robot says that the mission has ended there.
    pub(super) ended_since: Option<Duration>,
}

/// Decides what a mission needs, from where it stands and what its robot says.
pub(super) fn decide(
    mission: &Standing,
    presence: &Presence,
    memory: Memory,
    now: Duration,
) -> Need {
    let online = presence.link(now) == LinkState::Online;
    let driven = presence.state().and_then(|state| state.mission);
    let is_driven = driven.is_some_and(|driven| driven.id == mission.id);
    let waited = |since: Duration| now.saturating_sub(since) > RESTART_GRACE;
    let ended_there = memory.ended_since.is_some_and(waited);
    match mission.state {
        MissionState::Queued | MissionState::Offered if online => {
            if mission.state == MissionState::Offered && is_driven {
                Need::Settle(Change::Accept, "the robot drives it")
            } else if ended_there {
                Need::Settle(Change::Fail, "the robot has ended it without saying how")
            } else {
                Need::Offer
            }
        }
        MissionState::Active | MissionState::Paused => {
            if is_lost_by_restart(mission, presence, is_driven, now) {
                Need::Settle(Change::Fail, "agent restarted during the mission")
            } else {
                Need::Wait
            }
        }
        MissionState::Cancelling => {
            if is_lost_by_restart(mission, presence, is_driven, now) {
                Need::Settle(Change::Cancel, "agent restarted during the mission")
            } else if ended_there {
                Need::Settle(Change::Cancel, "the robot has ended it without saying how")
            } else if online {
                Need::Cancel
            } else {
                Need::Wait
            }
        }
        MissionState::Queued
        | MissionState::Offered
        | MissionState::Succeeded
        | MissionState::Failed
        | MissionState::Cancelled
        | MissionState::Rejected
        | MissionState::Expired => Need::Wait,
    }
}

/// Whether the agent that took a mission is gone, its records have had their say, and its
/// successor does not drive the mission.
fn is_lost_by_restart(
    mission: &Standing,
    presence: &Presence,
    is_driven: bool,
    now: Duration,
) -> bool {
    let (Some(taken_by), Some((present, since))) = (mission.boot, presence.boot()) else {
        return false;
    };
    let uploaded = presence
        .state()
        .is_some_and(|state| state.outbox.pending == 0);
    let patient_enough = now.saturating_sub(since) > RESTART_GRACE;
    taken_by != present && !is_driven && (uploaded || patient_enough)
}

#[cfg(test)]
mod tests;
