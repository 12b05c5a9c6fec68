//! Durable reports of robots on their missions, and the transitions that follow from them.

use jiff::Timestamp;
use tread_api::ids::{BootId, MissionId};
use tread_api::mission::{
    Actor, Cause, DRIVEN_POINTS_MAX, Mission, MissionState, THETA_SAMPLES_MAX,
};
use tread_api::robot::MissionProgress;
use tread_api::wire::ingest::{MissionPhase, MissionReport};

use super::transitions::Change;
use super::{EVENTS_MAX, Step, apply_transition, bounded, record_note};
use crate::db::missions::{Facts, MissionRow};
use crate::db::{self, DbError, Tx};

/// Origin and times of a report.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Reporting {
    /// The robot's key.
    pub(crate) robot_pk: i64,
    /// The run of the agent that made the report.
    pub(crate) boot: BootId,
    /// Present time of the server.
    pub(crate) now: Timestamp,
    /// Time of the reported event, corrected by the offset of the robot's clock.
    pub(crate) at: Timestamp,
    /// Time at which the cause of a pause began, by the server's clock; `at` if it is not known.
    pub(crate) since: Timestamp,
    /// Progress of this mission that the robot showed last.
    pub(crate) shown: Option<MissionProgress>,
    /// Time of the last restoration of the database from a backup, if there was one.
    pub(crate) restored_at: Option<Timestamp>,
}

/// Effect of an accepted report: the state in which it ended the mission and the reason, if it did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ReportEffect {
    pub(crate) ended: Option<(MissionState, String)>,
}

/// A report that did not end the mission.
const NOTED: ReportEffect = ReportEffect { ended: None };

/// Reason why a report is refused for ever.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Foreign(pub(crate) String);

/// Applies a robot's durable report on one of its own missions. The caller ensures that each report
/// is applied once.
///
/// A report on a revision that was being sent shows that the robot has it: that revision becomes
/// the present one. An end under an earlier revision ends the mission all the same: the robot had
/// finished before the new one arrived. So does an end under a later revision that a restoration
/// from a backup has taken from the server.
pub(crate) async fn apply_mission_report(
    tx: &mut Tx,
    reporting: Reporting,
    report: &MissionReport,
) -> Result<Result<ReportEffect, Foreign>, DbError> {
    let id = report.mission;
    let row = db::missions::find(tx, id).await?;
    let Some(row) = row.filter(|row| row.robot_pk == reporting.robot_pk) else {
        let reason = format!("mission `{id}` is not one of this robot");
        return Ok(Err(Foreign(reason)));
    };
    if let Some(reason) = impossible(report) {
        return Ok(Err(Foreign(reason)));
    }
    let row = match content_of(report, &row.mission, reporting.restored_at) {
        Content::Present => row,
        Content::Replacement => {
            adopt(tx, &row, Actor::Robot, reporting.now).await?;
            match db::missions::find(tx, id).await? {
                Some(row) => row,
                None => row,
            }
        }
        Content::Earlier | Content::Lost if is_end(report.phase) => row,
        Content::Lost => {
            let text = format!(
                "the robot reported of revision {}, which was lost with a restoration",
                report.revision
            );
            record_note(tx, &row, Actor::Robot, reporting.now, &text).await?;
            return Ok(Ok(NOTED));
        }
        Content::Earlier => {
            let text = format!("the robot reported late of revision {}", report.revision);
            record_note(tx, &row, Actor::Robot, reporting.now, &text).await?;
            return Ok(Ok(NOTED));
        }
        Content::Other => {
            let reason = format!("mission `{id}` was sent with other content");
            return Ok(Err(Foreign(reason)));
        }
    };
    let ended = apply_phase(tx, reporting, report, &row).await?;
    if is_end(report.phase) {
        let (quality, driven) = (report.quality.as_ref(), report.driven.as_ref());
        db::missions::add_outcome(tx, id, quality, driven).await?;
        // The robot's report is final, also for a mission that was ended without it.
        if report.progress.is_some() {
            let facts = Facts {
                progress: report.progress,
                ..Facts::default()
            };
            db::missions::add_facts(tx, id, facts).await?;
        }
    }
    Ok(Ok(ReportEffect { ended }))
}

enum Content {
    Present,
    Replacement,
    Earlier,
    /// A later revision that the server had before it was restored from a backup.
    Lost,
    Other,
}

fn content_of(
    report: &MissionReport,
    mission: &Mission,
    restored_at: Option<Timestamp>,
) -> Content {
    let content = (report.revision, report.plan_hash);
    let replacement = mission.replacement.as_ref();
    if content == (mission.revision, mission.plan_hash) {
        Content::Present
    } else if replacement.is_some_and(|next| content == (next.revision, next.plan_hash)) {
        Content::Replacement
    } else if report.revision < mission.revision {
        Content::Earlier
    } else if report.revision > mission.revision
        && restored_at.is_some_and(|at| mission.created_at < at)
    {
        Content::Lost
    } else {
        Content::Other
    }
}

const fn is_end(phase: MissionPhase) -> bool {
    match phase {
        MissionPhase::Started
        | MissionPhase::Paused
        | MissionPhase::Resumed
        | MissionPhase::Replaced => false,
        MissionPhase::Succeeded
        | MissionPhase::Failed
        | MissionPhase::Cancelled
        | MissionPhase::Expired => true,
    }
}

/// Returns why a report exceeds the limits that agents observe; `None` if it does not.
fn impossible(report: &MissionReport) -> Option<String> {
    let samples = report.quality.as_ref().map_or(0, |part| part.theta.len());
    let points = report.driven.as_ref().map_or(0, |part| part.points.len());
    if samples > THETA_SAMPLES_MAX {
        Some(format!(
            "a quality report has at most {THETA_SAMPLES_MAX} samples of theta"
        ))
    } else if points > DRIVEN_POINTS_MAX {
        Some(format!(
            "a driven path has at most {DRIVEN_POINTS_MAX} points"
        ))
    } else if report
        .driven
        .as_ref()
        .is_some_and(|part| !part.has_possible_times())
    {
        Some("a driven path has a time for each of its points, in order, or none".to_owned())
    } else {
        None
    }
}

async fn apply_phase(
    tx: &mut Tx,
    reporting: Reporting,
    report: &MissionReport,
    row: &MissionRow,
) -> Result<Option<(MissionState, String)>, DbError> {
    let (change, name) = match report.phase {
        MissionPhase::Started => (Some(Change::Accept), "started"),
        MissionPhase::Paused => (Some(Change::Pause), "paused"),
        MissionPhase::Resumed => (Some(Change::Resume), "drove on"),
        MissionPhase::Replaced => (None, "took the new revision"),
        MissionPhase::Succeeded => (Some(Change::Succeed), "succeeded"),
        MissionPhase::Failed => (Some(Change::Fail), "failed"),
        MissionPhase::Cancelled => (Some(Change::Cancel), "cancelled"),
        MissionPhase::Expired => (Some(Change::Expire), "expired"),
    };
    let started = report.phase == MissionPhase::Started;
    let facts = Facts {
        boot: Some(reporting.boot),
        plan: None,
        progress: report.progress.or_else(|| shown_of(reporting, report)),
        started_at: started.then_some(reporting.at),
        ended_at: is_end(report.phase).then_some(reporting.at),
    };
    let mission = &row.mission;
    let Some(change) = change else {
        return Ok(None);
    };
    let is_for_safety = |progress: &MissionProgress| progress.is_paused_for_safety();
    let is_safety_pause =
        report.phase == MissionPhase::Paused && report.progress.as_ref().is_some_and(is_for_safety);
    if is_safety_pause && !was_resumed_since(tx, mission.id, reporting.since).await? {
        db::missions::set_pause_requested(tx, mission.id, true).await?;
    }
    let reason = report.reason.as_deref();
    let step = Step {
        change,
        actor: Actor::Robot,
        reason,
        at: reporting.now,
        facts,
    };
    if let Some(state) = apply_transition(tx, &mission.into(), step).await? {
        let why = reason.unwrap_or(change.reason()).to_owned();
        return Ok(state.is_terminal().then_some((state, why)));
    }
    let open = !mission.state.is_terminal();
    if started && open && mission.started_at.is_none() {
        db::missions::add_facts(tx, mission.id, facts).await?;
        let text = "the robot began to drive";
        record_note(tx, row, Actor::Robot, reporting.now, text).await?;
        return Ok(None);
    }
    // The robot's answer to the command has caused this transition already.
    let is_known = open && next_is_reached(change, mission);
    // An agent that was killed while it recorded this end reports it again.
    let is_known = is_known || has_same_end(tx, mission, change, reason).await?;
    if is_known {
        return Ok(None);
    }
    let reason = reason
        .map(|reason| format!(": {reason}"))
        .unwrap_or_default();
    let text = format!("the robot reported late that it {name}{reason}");
    record_note(tx, row, Actor::Robot, reporting.now, &text).await?;
    Ok(None)
}

/// Returns whether the robot's own report has ended the mission already by this change and for this
/// reason.
async fn has_same_end(
    tx: &mut Tx,
    mission: &Mission,
    change: Change,
    reason: Option<&str>,
) -> Result<bool, DbError> {
    if !mission.state.is_terminal() {
        return Ok(false);
    }
    let reason = bounded(reason.unwrap_or(change.reason()));
    let events = db::history::events(tx, mission.id, EVENTS_MAX).await?;
    let end = events
        .iter()
        .rev()
        .find(|event| event.to.is_terminal() && event.from != Some(event.to));
    Ok(end.is_some_and(|end| {
        (end.actor, end.cause) == (Actor::Robot, change.cause())
            && end.reason.as_deref() == Some(reason.as_str())
    }))
}

/// Returns the progress that the robot showed last, for a report that ends the mission without
/// giving any, as after a restart of its agent.
fn shown_of(reporting: Reporting, report: &MissionReport) -> Option<MissionProgress> {
    let is_same = |shown: &MissionProgress| {
        (shown.id, shown.revision, shown.plan_hash)
            == (report.mission, report.revision, report.plan_hash)
    };
    reporting
        .shown
        .filter(is_same)
        .filter(|_| is_end(report.phase))
}

/// Returns whether a person resumed a mission after `at`, the time at which a stop or lease began. The
/// pause that it caused, if the robot reports it late, is then obsolete. The begin of the stop or lease
/// is used because nobody can resume before its end: the order is unambiguous in spite of
/// clock errors, which is not true for the time at which the robot came to rest.
pub(in crate::app) async fn was_resumed_since(
    tx: &mut Tx,
    id: MissionId,
    at: Timestamp,
) -> Result<bool, DbError> {
    let events = db::history::events(tx, id, EVENTS_MAX).await?;
    let mut newest_first = events.iter().rev();
    let resumed = newest_first.find(|event| event.cause == Cause::ResumeRequested);
    Ok(resumed.is_some_and(|event| event.at > at))
}

fn next_is_reached(change: Change, mission: &Mission) -> bool {
    use tread_api::mission::MissionState as S;
    matches!(
        (change, mission.state),
        (Change::Pause, S::Paused) | (Change::Resume, S::Active)
    )
}

/// Makes the revision that was being sent the present one.
pub(crate) async fn adopt(
    tx: &mut Tx,
    row: &MissionRow,
    actor: Actor,
    at: Timestamp,
) -> Result<bool, DbError> {
    let mission = &row.mission;
    let Some(replacement) = &mission.replacement else {
        return Ok(false);
    };
    if mission.state.is_terminal()
        || !db::missions::swap_content(tx, mission.id, mission.revision, replacement).await?
    {
        return Ok(false);
    }
    let reason = format!("the robot holds revision {}", replacement.revision);
    super::add_note(tx, mission, (actor, Cause::Replaced), at, &reason).await?;
    Ok(true)
}
