//! What an open mission needs, from where it stands and what its robot says. Pure.

use std::time::Duration;

use jiff::Timestamp;
use tread_api::mission::{LinkPolicy, MissionState};
use tread_api::robot::{LinkState, MissionProgress};

use crate::app::missions::transitions::Change;
use crate::app::presence::Presence;
use crate::db::missions::Standing;

/// How long the records of an earlier run may take to arrive before a mission counts as lost.
pub(super) const RESTART_GRACE: Duration = Duration::from_secs(3);
/// How long a robot may be there without its mission, and without anything left to report, before
/// the mission counts as forgotten.
pub(super) const FORGET_GRACE: Duration = Duration::from_secs(5);
/// How long a robot may show a mission as paused, or as driven, before that counts although its
/// record has not come; the other way round, before the command is sent again.
pub(super) const HOLD_GRACE: Duration = Duration::from_secs(1);
/// How long a robot may stay away beyond what was left of its plan, seconds.
pub const LOST_MARGIN_S: f64 = 60.0;
/// How long a robot may stay away when nobody knows how long its plan is, seconds.
pub const LOST_UNPLANNED_S: f64 = 300.0;
/// How long a robot may stay away beyond the silence after which it stops by itself, seconds.
pub const LOST_STOPPED_MARGIN_S: f64 = 30.0;

/// What a mission needs now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Need {
    /// Nothing but time.
    Wait,
    /// Offer it to its robot.
    Offer,
    /// Offer its new revision to its robot.
    Replace,
    /// The robot holds the new revision: it counts.
    Adopt,
    /// Tell its robot to hold it.
    Pause,
    /// Tell its robot to drive on.
    Resume,
    /// Tell its robot to end it.
    Cancel,
    /// Settle it here.
    Settle(Change),
}

/// What the reconciler remembers of a mission while it is open; losing it does no harm.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Memory {
    /// Since when the robot says that the mission has ended there.
    pub(super) ended_since: Option<Duration>,
    /// Since when the robot has been there without the mission and with nothing left to report.
    pub(super) absent_since: Option<Duration>,
    /// Since when the robot has shown it as paused while it is not, or the other way round.
    pub(super) differs_from: Option<Duration>,
    /// How long the robot has not been heard.
    pub(super) silence: Option<Silence>,
}

/// A robot's silence: by the wall clock as far as it lies before the first look of this process, by
/// the monotonic clock from then on, so that a step of the wall clock loses no robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Silence {
    before: Duration,
    looked_at: Duration,
}

impl Silence {
    /// The silence of a mission's robot, which goes on if it was there before; `None` while the
    /// robot is heard.
    pub(super) fn of(mission: &Standing, before: Option<Self>, now: Now) -> Option<Self> {
        let since = mission.silent_since?;
        let silence = || Self {
            before: Duration::try_from(now.wall.duration_since(since)).unwrap_or_default(),
            looked_at: now.elapsed,
        };
        Some(before.unwrap_or_else(silence))
    }

    fn lasts(self, now: Now) -> Duration {
        self.before + now.elapsed.saturating_sub(self.looked_at)
    }
}

/// The two clocks.
#[derive(Debug, Clone, Copy)]
pub(super) struct Now {
    /// For ages.
    pub(super) elapsed: Duration,
    /// For what must hold over a restart.
    pub(super) wall: Timestamp,
}

/// Whether a robot is heard well enough to be commanded.
pub(super) fn is_heard(presence: &Presence, now: Duration) -> bool {
    presence.link(now) != LinkState::Offline
}

/// What a robot says of a mission.
pub(super) fn driven(mission: &Standing, presence: &Presence) -> Option<MissionProgress> {
    let said = presence.state().and_then(|state| state.mission);
    said.filter(|driven| driven.id == mission.id)
}

/// Whether a robot is there without a mission that it took, and with nothing left to report. While
/// it thinks about an offer, however long, it has not taken it.
pub(super) fn is_absent(mission: &Standing, presence: &Presence, now: Duration) -> bool {
    let is_taken = match mission.state {
        MissionState::Active | MissionState::Paused | MissionState::Cancelling => true,
        MissionState::Queued
        | MissionState::Offered
        | MissionState::Succeeded
        | MissionState::Failed
        | MissionState::Cancelled
        | MissionState::Rejected
        | MissionState::Expired => false,
    };
    let nothing_left = |state: &tread_api::wire::state::RobotState| {
        // A mission that only the robot's state showed as taken has no run yet.
        mission.boot.is_none_or(|boot| boot == state.boot) && state.outbox.pending == 0
    };
    is_taken
        && is_heard(presence, now)
        && driven(mission, presence).is_none()
        && presence.state().is_some_and(nothing_left)
}

/// Whether a robot shows a mission as paused that is active here, or the other way round.
pub(super) fn is_held_otherwise(mission: &Standing, presence: &Presence) -> bool {
    let here = match mission.state {
        MissionState::Active => false,
        MissionState::Paused => true,
        MissionState::Queued
        | MissionState::Offered
        | MissionState::Cancelling
        | MissionState::Succeeded
        | MissionState::Failed
        | MissionState::Cancelled
        | MissionState::Rejected
        | MissionState::Expired => return false,
    };
    driven(mission, presence).is_some_and(|said| said.paused != here)
}

/// Decides what a mission needs, from where it stands and what its robot says.
pub(super) fn decide(mission: &Standing, presence: &Presence, memory: Memory, now: Now) -> Need {
    let heard = is_heard(presence, now.elapsed);
    if !heard && mission.state != MissionState::Queued {
        return if is_lost(mission, presence, memory, now) {
            Need::Settle(Change::LoseRobot)
        } else if is_lost_by_restart(mission, presence, false, now.elapsed) {
            Need::Settle(Change::LoseRun)
        } else {
            Need::Wait
        };
    }
    let said = driven(mission, presence);
    let longer_than =
        |grace: Duration| move |since: Duration| now.elapsed.saturating_sub(since) > grace;
    let ended_there = memory.ended_since.is_some_and(longer_than(RESTART_GRACE));
    let forgotten = memory.absent_since.is_some_and(longer_than(FORGET_GRACE));
    let restarted = is_lost_by_restart(mission, presence, said.is_some(), now.elapsed);
    match mission.state {
        MissionState::Queued | MissionState::Offered if heard => {
            if mission.state == MissionState::Offered && said.is_some_and(of_present(mission)) {
                Need::Settle(Change::Accept)
            } else if ended_there {
                Need::Settle(Change::Forget)
            } else {
                Need::Offer
            }
        }
        MissionState::Active | MissionState::Paused | MissionState::Cancelling if restarted => {
            Need::Settle(Change::LoseRun)
        }
        MissionState::Active | MissionState::Paused | MissionState::Cancelling
            if ended_there || forgotten =>
        {
            Need::Settle(Change::Forget)
        }
        MissionState::Active | MissionState::Paused => {
            let differs = memory.differs_from.is_some_and(longer_than(HOLD_GRACE));
            let need = in_progress(mission, said, differs);
            // Whoever stopped it or teleoperates it has written down that it is to be held.
            if need == Need::Resume && presence.is_operator_controlled() {
                Need::Wait
            } else {
                need
            }
        }
        MissionState::Cancelling => Need::Cancel,
        MissionState::Queued
        | MissionState::Offered
        | MissionState::Succeeded
        | MissionState::Failed
        | MissionState::Cancelled
        | MissionState::Rejected
        | MissionState::Expired => Need::Wait,
    }
}

fn of_present(mission: &Standing) -> impl Fn(MissionProgress) -> bool {
    let content = mission.content;
    move |said| (said.revision, said.plan_hash) == content
}

/// What a mission needs that its robot drives or holds; `differs` when the robot has shown it as
/// paused for a while and the server has not, or the other way round.
fn in_progress(mission: &Standing, said: Option<MissionProgress>, differs: bool) -> Need {
    let content = said.map(|said| (said.revision, said.plan_hash));
    if mission.replacement.is_some() {
        return if content == mission.replacement {
            Need::Adopt
        } else {
            Need::Replace
        };
    }
    match (mission.state == MissionState::Paused, mission.pause_wanted) {
        // The robot's record says so at once; its state, when that is slow.
        (false, true) if differs => Need::Settle(Change::Pause),
        (true, false) if differs => Need::Settle(Change::Resume),
        (false, true) => Need::Pause,
        (true, false) => Need::Resume,
        // Whoever stopped the robot, or teleoperated it: only a person lets the mission go on. The
        // robot's report of the pause makes that what is wanted here too.
        (false, false) if said.is_some_and(|said| said.is_paused_for_safety()) => Need::Wait,
        // A command that came late or twice had its way on the robot: once more.
        (false, false) if differs => Need::Resume,
        (true, true) if differs => Need::Pause,
        (false, false) | (true, true) => Need::Wait,
    }
}

/// How long a robot may stay away from a mission.
pub(super) fn lost_after_s(mission: &Standing, said: Option<MissionProgress>) -> f64 {
    match (mission.lost_after_s, mission.link_policy) {
        (Some(lost_after_s), _) => lost_after_s,
        (None, LinkPolicy::StopAfter { silence_s }) => silence_s + LOST_STOPPED_MARGIN_S,
        (None, LinkPolicy::Continue) => match mission.duration_s {
            Some(duration_s) => {
                let left = said.filter(|said| said.length_m > 0.0).map_or(1.0, |said| {
                    (1.0 - said.driven_m / said.length_m).clamp(0.0, 1.0)
                });
                duration_s * left + LOST_MARGIN_S
            }
            None => LOST_UNPLANNED_S,
        },
    }
}

/// Whether a mission's robot has stayed away past its bound.
fn is_lost(mission: &Standing, presence: &Presence, memory: Memory, now: Now) -> bool {
    let bound_s = lost_after_s(mission, driven(mission, presence));
    memory
        .silence
        .is_some_and(|silence| silence.lasts(now).as_secs_f64() > bound_s)
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
