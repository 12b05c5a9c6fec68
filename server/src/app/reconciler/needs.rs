//! Decides what an open mission needs, from its state and its robot's last state. Pure functions.

use std::time::Duration;

use jiff::Timestamp;
use tread_api::mission::{LinkPolicy, MissionState};
use tread_api::robot::{LinkState, MissionProgress};

use crate::app::missions::transitions::Change;
use crate::app::presence::Presence;
use crate::db::missions::OpenMission;

/// Time for which the records of an earlier run may be under way before a mission counts as lost.
pub(super) const RESTART_GRACE: Duration = Duration::from_secs(3);
/// Time for which a heard robot may lack its mission, with an empty outbox, before the mission
/// counts as forgotten.
pub(super) const FORGET_GRACE: Duration = Duration::from_secs(5);
/// Time for which a robot may show a mission as paused or driven before that counts although its
/// record has not come; if the mission is wanted otherwise, before the command is sent again.
pub(super) const HOLD_GRACE: Duration = Duration::from_secs(1);
/// Time for which a robot may be unheard beyond the remaining duration of its plan, seconds.
pub const LOST_MARGIN_S: f64 = 60.0;
/// Time for which a robot may be unheard if the duration of its plan is not known, seconds.
pub const LOST_UNPLANNED_S: f64 = 300.0;
/// Time for which a robot may be unheard beyond the silence after which it stops by itself,
/// seconds.
pub const LOST_STOPPED_MARGIN_S: f64 = 30.0;

/// Next action for a mission.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Need {
    /// No action.
    Wait,
    /// Offer it to its robot.
    Offer,
    /// Offer its new revision to its robot.
    Replace,
    /// Make the new revision the present one: the robot has it.
    Adopt,
    /// Command its robot to pause it.
    Pause,
    /// Command its robot to resume it.
    Resume,
    /// Command its robot to end it.
    Cancel,
    /// Change its state without its robot.
    Apply(Change),
}

/// What the reconciler remembers of an open mission; it may be lost in a restart without harm.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Memory {
    /// Time since which the robot has reported that the mission has ended.
    pub(super) ended_since: Option<Duration>,
    /// Time since which the robot has been heard without the mission and with an empty outbox.
    pub(super) absent_since: Option<Duration>,
    /// Time since which the robot has shown it as paused while it is active here, or the reverse.
    pub(super) differs_from: Option<Duration>,
    /// Silence of the robot; `None` while it is heard.
    pub(super) silence: Option<Silence>,
}

/// Silence of a robot. Its part before the first check of this process is by the wall clock, the
/// rest by the monotonic clock, so that a step of the wall clock makes no robot lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Silence {
    before: Duration,
    looked_at: Duration,
}

impl Silence {
    /// Returns the silence of a mission's robot, continuing `before` if given; `None` while the
    /// robot is heard.
    pub(super) fn of(mission: &OpenMission, before: Option<Self>, now: Now) -> Option<Self> {
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

/// Times of a check.
#[derive(Debug, Clone, Copy)]
pub(super) struct Now {
    /// Monotonic time since the start, for ages.
    pub(super) elapsed: Duration,
    /// Wall-clock time, for what must survive a restart.
    pub(super) wall: Timestamp,
    /// Monotonic time since which the database answers without delay: what robots reported before may
    /// still wait for it.
    pub(super) answering_since: Duration,
}

impl Now {
    /// Returns the time that a robot has had for a report since then.
    fn time_since(self, since: Duration) -> Duration {
        self.elapsed.saturating_sub(since.max(self.answering_since))
    }
}

/// Returns whether a robot's link is online or stale, so that it can be commanded.
pub(super) fn is_heard(presence: &Presence, now: Duration) -> bool {
    presence.link(now) != LinkState::Offline
}

/// Returns the progress of a mission that its robot shows; `None` if it shows another or none.
pub(super) fn driven(mission: &OpenMission, presence: &Presence) -> Option<MissionProgress> {
    let progress = presence.state().and_then(|state| state.mission);
    progress.filter(|driven| driven.id == mission.id)
}

/// Returns whether a robot is heard without a mission that it had accepted, and with an empty
/// outbox. An offer that it still considers, however long, is not yet accepted.
pub(super) fn is_absent(mission: &OpenMission, presence: &Presence, now: Duration) -> bool {
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
        // A mission whose acceptance is only known from the robot's state has no run yet.
        mission.boot.is_none_or(|boot| boot == state.boot) && state.outbox.pending == 0
    };
    is_taken
        && is_heard(presence, now)
        && driven(mission, presence).is_none()
        && presence.state().is_some_and(nothing_left)
}

/// Returns whether a robot shows a mission as paused that is active here, or the reverse.
pub(super) fn is_held_otherwise(mission: &OpenMission, presence: &Presence) -> bool {
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
    driven(mission, presence).is_some_and(|progress| progress.paused != here)
}

/// Decides what a mission needs, from its state and its robot's last state.
pub(super) fn decide(mission: &OpenMission, presence: &Presence, memory: Memory, now: Now) -> Need {
    let heard = is_heard(presence, now.elapsed);
    if !heard && mission.state != MissionState::Queued {
        return if is_lost(mission, presence, memory, now) {
            Need::Apply(Change::LoseRobot)
        } else if is_lost_by_restart(mission, presence, false, now) {
            Need::Apply(Change::LoseRun)
        } else {
            Need::Wait
        };
    }
    let progress = driven(mission, presence);
    let longer_than = |grace: Duration| move |since: Duration| now.time_since(since) > grace;
    let ended_there = memory.ended_since.is_some_and(longer_than(RESTART_GRACE));
    let forgotten = memory.absent_since.is_some_and(longer_than(FORGET_GRACE));
    let restarted = is_lost_by_restart(mission, presence, progress.is_some(), now);
    match mission.state {
        MissionState::Queued | MissionState::Offered if heard => {
            if mission.state == MissionState::Offered && progress.is_some_and(of_present(mission)) {
                Need::Apply(Change::Accept)
            } else if ended_there {
                Need::Apply(Change::Forget)
            } else {
                Need::Offer
            }
        }
        MissionState::Active | MissionState::Paused | MissionState::Cancelling if restarted => {
            Need::Apply(Change::LoseRun)
        }
        MissionState::Active | MissionState::Paused | MissionState::Cancelling
            if ended_there || forgotten =>
        {
            Need::Apply(Change::Forget)
        }
        MissionState::Active | MissionState::Paused => {
            let differs = memory.differs_from.is_some_and(longer_than(HOLD_GRACE));
            let need = in_progress(mission, progress, differs);
            // A stop or a teleoperation is recorded with the wish to hold the mission.
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

fn of_present(mission: &OpenMission) -> impl Fn(MissionProgress) -> bool {
    let content = mission.content;
    move |progress| (progress.revision, progress.plan_hash) == content
}

/// Decides what a mission needs that its robot drives or holds; `differs` when the robot has shown
/// it as paused for [`HOLD_GRACE`] while it is active here, or the reverse.
fn in_progress(mission: &OpenMission, progress: Option<MissionProgress>, differs: bool) -> Need {
    let content = progress.map(|progress| (progress.revision, progress.plan_hash));
    if mission.replacement.is_some() {
        return if content == mission.replacement {
            Need::Adopt
        } else {
            Need::Replace
        };
    }
    match (
        mission.state == MissionState::Paused,
        mission.pause_requested,
    ) {
        // The robot's record normally comes first; its state counts if the record is slow.
        (false, true) if differs => Need::Apply(Change::Pause),
        (true, false) if differs => Need::Apply(Change::Resume),
        (false, true) => Need::Pause,
        (true, false) => Need::Resume,
        // The robot paused it because of a stop or a teleoperation: only a person resumes it. The
        // robot's report of the pause sets what is wanted here accordingly; its state does if the report
        // is slow, or was of an earlier revision.
        (false, false) if progress.is_some_and(|progress| progress.is_paused_for_safety()) => {
            if differs {
                Need::Apply(Change::Pause)
            } else {
                Need::Wait
            }
        }
        // A late or repeated command has taken effect on the robot; the wanted one is sent again.
        (false, false) if differs => Need::Resume,
        (true, true) if differs => Need::Pause,
        (false, false) | (true, true) => Need::Wait,
    }
}

/// Returns the time for which a robot may be unheard before its mission counts as lost, seconds.
pub(super) fn lost_after_s(mission: &OpenMission, progress: Option<MissionProgress>) -> f64 {
    match (mission.lost_after_s, mission.link_policy) {
        (Some(lost_after_s), _) => lost_after_s,
        (None, LinkPolicy::StopAfter { silence_s }) => silence_s + LOST_STOPPED_MARGIN_S,
        (None, LinkPolicy::Continue) => match mission.duration_s {
            Some(duration_s) => {
                let left = progress
                    .filter(|progress| progress.length_m > 0.0)
                    .map_or(1.0, |progress| {
                        (1.0 - progress.driven_m / progress.length_m).clamp(0.0, 1.0)
                    });
                duration_s * left + LOST_MARGIN_S
            }
            None => LOST_UNPLANNED_S,
        },
    }
}

/// Returns whether a mission's robot was unheard for longer than [`lost_after_s`].
fn is_lost(mission: &OpenMission, presence: &Presence, memory: Memory, now: Now) -> bool {
    let bound_s = lost_after_s(mission, driven(mission, presence));
    memory
        .silence
        .is_some_and(|silence| silence.lasts(now).as_secs_f64() > bound_s)
}

/// Returns whether the agent's run that took a mission has ended, its records have arrived or are
/// overdue, and its successor does not drive the mission.
fn is_lost_by_restart(
    mission: &OpenMission,
    presence: &Presence,
    is_driven: bool,
    now: Now,
) -> bool {
    let (Some(taken_by), Some((present, since))) = (mission.boot, presence.boot()) else {
        return false;
    };
    let uploaded = presence
        .state()
        .is_some_and(|state| state.outbox.pending == 0);
    let patient_enough = now.time_since(since) > RESTART_GRACE;
    taken_by != present && !is_driven && (uploaded || patient_enough)
}

#[cfg(test)]
mod tests;
