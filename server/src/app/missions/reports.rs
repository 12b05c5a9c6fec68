//! What robots report of their missions, durably, and what the server makes of it.

use jiff::Timestamp;
use tread_api::ids::{BootId, MissionId};
use tread_api::mission::{Actor, Cause, DRIVEN_POINTS_MAX, Mission, THETA_SAMPLES_MAX};
use tread_api::robot::MissionProgress;
use tread_api::wire::ingest::{MissionPhase, MissionReport};

use super::transitions::Change;
use super::{Step, note, take_step};
use crate::db::missions::{Facts, MissionRow};
use crate::db::{self, DbError, Tx};

/// Most events of a mission that are looked through; of more, a pause is held to be wanted.
const EVENTS_MAX: u32 = 1_000;

/// Who reports, and when.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Reporting {
    /// The robot's key.
    pub(crate) robot_pk: i64,
    /// The run of the agent that made the report.
    pub(crate) boot: BootId,
    /// The server's time.
    pub(crate) now: Timestamp,
    /// When it happened, put right by the offset of the robot's clock.
    pub(crate) at: Timestamp,
    /// When what paused the mission began, by the server's clock; `at` if that is not known.
    pub(crate) since: Timestamp,
}

/// Why a report can never be taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Foreign(pub(crate) String);

/// Takes a robot's durable report on a mission of its own, once; the caller has seen to that.
///
/// A report of the revision that was on its way shows that the robot holds it: it counts from
/// here on. An end under an earlier revision is the mission's end all the same: the robot had
/// finished before the new one came.
pub(crate) async fn take_report(
    tx: &mut Tx,
    reporting: Reporting,
    report: &MissionReport,
) -> Result<Result<(), Foreign>, DbError> {
    let id = report.mission;
    let row = db::missions::find(tx, id).await?;
    let Some(row) = row.filter(|row| row.robot_pk == reporting.robot_pk) else {
        let reason = format!("mission `{id}` is not one of this robot");
        return Ok(Err(Foreign(reason)));
    };
    if let Some(reason) = impossible(report) {
        return Ok(Err(Foreign(reason)));
    }
    let row = match content_of(report, &row.mission) {
        Content::Present => row,
        Content::Replacement => {
            adopt(tx, &row, Actor::Robot, reporting.now).await?;
            match db::missions::find(tx, id).await? {
                Some(row) => row,
                None => row,
            }
        }
        Content::Earlier if is_end(report.phase) => row,
        Content::Earlier => {
            let text = format!("the robot reported late of revision {}", report.revision);
            note(tx, &row, Actor::Robot, reporting.now, &text).await?;
            return Ok(Ok(()));
        }
        Content::Other => {
            let reason = format!("mission `{id}` was sent with other content");
            return Ok(Err(Foreign(reason)));
        }
    };
    take_phase(tx, reporting, report, &row).await?;
    if is_end(report.phase) {
        let (quality, driven) = (report.quality.as_ref(), report.driven.as_ref());
        db::missions::add_outcome(tx, id, quality, driven).await?;
    }
    Ok(Ok(()))
}

enum Content {
    Present,
    Replacement,
    Earlier,
    Other,
}

fn content_of(report: &MissionReport, mission: &Mission) -> Content {
    let said = (report.revision, report.plan_hash);
    let replacement = mission.replacement.as_ref();
    if said == (mission.revision, mission.plan_hash) {
        Content::Present
    } else if replacement.is_some_and(|next| said == (next.revision, next.plan_hash)) {
        Content::Replacement
    } else if report.revision < mission.revision {
        Content::Earlier
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

/// What no agent of ours would send: more than the bounds allow.
fn impossible(report: &MissionReport) -> Option<String> {
    let samples = report.quality.as_ref().map_or(0, |said| said.theta.len());
    let points = report.driven.as_ref().map_or(0, |said| said.points.len());
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
        .is_some_and(|said| !said.has_possible_times())
    {
        Some("a driven path has a time for each of its points, in order, or none".to_owned())
    } else {
        None
    }
}

async fn take_phase(
    tx: &mut Tx,
    reporting: Reporting,
    report: &MissionReport,
    row: &MissionRow,
) -> Result<(), DbError> {
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
        progress: report.progress,
        started_at: started.then_some(reporting.at),
        ended_at: is_end(report.phase).then_some(reporting.at),
    };
    let mission = &row.mission;
    let Some(change) = change else {
        return Ok(());
    };
    let is_for_safety = |progress: &MissionProgress| progress.is_paused_for_safety();
    let is_safety_pause =
        report.phase == MissionPhase::Paused && report.progress.as_ref().is_some_and(is_for_safety);
    if is_safety_pause && !was_resumed_since(tx, mission.id, reporting.since).await? {
        db::missions::want_pause(tx, mission.id, true).await?;
    }
    let reason = report.reason.as_deref();
    let step = Step {
        change,
        actor: Actor::Robot,
        reason,
        at: reporting.now,
        facts,
    };
    if take_step(tx, &mission.into(), step).await?.is_some() {
        return Ok(());
    }
    let open = !mission.state.is_terminal();
    if started && open && mission.started_at.is_none() {
        db::missions::add_facts(tx, mission.id, facts).await?;
        let text = "the robot began to drive";
        return note(tx, row, Actor::Robot, reporting.now, text).await;
    }
    // The robot says what its answer to the command had said before.
    let is_known = open && next_is_reached(change, mission);
    if is_known {
        return Ok(());
    }
    let reason = reason
        .map(|reason| format!(": {reason}"))
        .unwrap_or_default();
    let text = format!("the robot reported late that it {name}{reason}");
    note(tx, row, Actor::Robot, reporting.now, &text).await
}

/// Whether a person let a mission go on after this: then a pause from before, reported late, is not
/// what is wanted any more. A stop or a lease has to end before anybody can resume, so the time when
/// it began tells the two orders apart, by far more than clocks are off; the time when the robot
/// stood does not.
async fn was_resumed_since(tx: &mut Tx, id: MissionId, at: Timestamp) -> Result<bool, DbError> {
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

/// Makes the revision that was on its way the one that counts.
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
