//! What must hold after a run, whatever failed in it.

use std::collections::HashMap;

use jiff::SignedDuration;
use tread_agent::missions::Holder;
use tread_api::friction::StoredSegment;
use tread_api::ids::BootId;
use tread_api::mission::{Cause, MissionDetail, MissionState};
use tread_api::wire::ingest::MissionPhase;

use super::{Followed, RunReport, Violation};
use crate::fleet::{Fleet, SITE};

/// An event's time is taken before its commit, which may have to wait for others; two missions that
/// overlap by less follow each other. That they do is also an index of the database.
const EVENT_GRAIN: SignedDuration = SignedDuration::from_millis(250);

/// State and cause of a mission's end.
pub(super) fn end_of(detail: &MissionDetail) -> String {
    format!(
        "{}: {}",
        detail.mission.state.as_str(),
        detail.mission.cause.as_str()
    )
}

/// Holds a run's missions against their policies and against the robot's own memory.
pub(super) fn judge(
    followed: &[Followed],
    details: &[MissionDetail],
    memory: Option<&Holder>,
    report: &mut RunReport,
) {
    let agent_was_killed = report.agent_kills > 0;
    let violations = &mut report.violations;
    let mut note = |kind: &'static str, detail: &MissionDetail, text: &str| {
        let events: Vec<String> = detail
            .events
            .iter()
            .map(|event| {
                let reason = event.reason.as_deref().unwrap_or_default();
                format!(
                    "{} {:?}→{:?} {:?} {reason}",
                    event.at, event.from, event.to, event.cause
                )
            })
            .collect();
        violations.push(Violation {
            kind,
            text: format!("{text}: mission {} {events:#?}", detail.mission.id),
        });
    };
    for (mission, detail) in followed.iter().zip(details) {
        if !detail.mission.state.is_terminal() {
            note("stuck", detail, "it did not end");
            continue;
        }
        if is_revived(detail) {
            note("revived", detail, "it ended more than once");
        }
        if let Some(text) = against_policy(mission, detail, agent_was_killed) {
            note("policy", detail, &text);
        }
        match memory {
            None => note("disagree", detail, "the robot's memory cannot be read"),
            Some(memory) => {
                if let Some(text) = disagreement(detail, memory) {
                    note("disagree", detail, &text);
                }
            }
        }
    }
    if let Some(first) = details.first()
        && let Some(text) = two_at_once(details)
    {
        note("two_at_once", first, &text);
    }
}

/// Whether anything led out of a terminal state.
fn is_revived(detail: &MissionDetail) -> bool {
    let mut ended = None;
    for event in &detail.events {
        match ended {
            Some(state) if event.to != state => return true,
            Some(_) | None => {}
        }
        if event.to.is_terminal() {
            ended = Some(event.to);
        }
    }
    false
}

fn against_policy(
    mission: &Followed,
    detail: &MissionDetail,
    agent_was_killed: bool,
) -> Option<String> {
    let reason = detail.mission.reason.as_deref().unwrap_or_default();
    let asked = &mission.asked;
    let is_fair = match (detail.mission.state, detail.mission.cause) {
        (MissionState::Succeeded, Cause::Succeeded) => true,
        (MissionState::Cancelled, _) => mission.is_cancel_asked,
        (MissionState::Expired, Cause::Expired) => asked.expires,
        (MissionState::Failed, Cause::RobotLost) => asked.is_soon_lost || asked.minds_silence,
        (MissionState::Failed, Cause::AgentRestarted | Cause::RobotForgot) => agent_was_killed,
        (MissionState::Failed, Cause::Failed) => {
            let is_silence = asked.minds_silence && reason.contains("silent");
            is_silence || (agent_was_killed && reason.contains("restart"))
        }
        _ => false,
    };
    (!is_fair).then(|| format!("{} with `{reason}` is against its policy", end_of(detail)))
}

/// What the robot remembers must be what the server says; a mission that the server gave up as
/// lost may have ended otherwise on the robot, and then the server has kept its word as an event.
fn disagreement(detail: &MissionDetail, memory: &Holder) -> Option<String> {
    let id = detail.mission.id;
    if memory.held().is_some_and(|held| held.mission == id) {
        return Some("the robot still holds it".to_owned());
    }
    let remembered = memory.ended().find(|ended| ended.mission == id);
    let Some(phase) = remembered.map(|ended| ended.phase) else {
        // It ended without the robot: before it was taken, or with the agent.
        let was_driven = detail.mission.state == MissionState::Succeeded;
        return was_driven.then(|| "the robot knows nothing of its success".to_owned());
    };
    let expected = match phase {
        MissionPhase::Succeeded => MissionState::Succeeded,
        MissionPhase::Failed => MissionState::Failed,
        MissionPhase::Cancelled => MissionState::Cancelled,
        MissionPhase::Expired => MissionState::Expired,
        MissionPhase::Started
        | MissionPhase::Paused
        | MissionPhase::Resumed
        | MissionPhase::Replaced => {
            return Some(format!("the robot remembers {phase:?} as its end"));
        }
    };
    if detail.mission.state == expected {
        return None;
    }
    let given_up = matches!(
        detail.mission.cause,
        Cause::RobotLost | Cause::AgentRestarted | Cause::RobotForgot
    );
    let end = detail
        .events
        .iter()
        .position(|event| event.to.is_terminal());
    let was_noted = end.is_some_and(|end| detail.events.len() > end + 1);
    // A cancellation of what was given up already is nothing that the robot reports.
    let needs_no_word = phase == MissionPhase::Cancelled;
    let is_kept = given_up && (was_noted || needs_no_word);
    (!is_kept).then(|| format!("the robot says {phase:?}"))
}

/// Whether two missions were in the robot's hands at the same time, by the server's events.
fn two_at_once(details: &[MissionDetail]) -> Option<String> {
    let in_hand = |state: MissionState| {
        matches!(
            state,
            MissionState::Offered
                | MissionState::Active
                | MissionState::Paused
                | MissionState::Cancelling
        )
    };
    let mut spans = Vec::new();
    for detail in details {
        let mut since = None;
        for event in &detail.events {
            if in_hand(event.to) {
                since.get_or_insert(event.at);
            } else if let Some(since) = since.take() {
                spans.push((detail.mission.id, since, event.at));
            }
        }
    }
    for (index, &(id, from, to)) in spans.iter().enumerate() {
        for &(other, other_from, other_to) in &spans[index + 1..] {
            let both = to.min(other_to).duration_since(from.max(other_from));
            if id != other && both > EVENT_GRAIN {
                return Some(format!(
                    "{id} and {other} were in hand together for {both:#}"
                ));
            }
        }
    }
    None
}

/// Every segment is stored once.
pub(super) async fn judge_records(fleet: &Fleet, report: &mut RunReport) {
    let segments: Vec<StoredSegment> = fleet.rest.all(&format!("/v1/sites/{SITE}/segments")).await;
    let mut by_boot: HashMap<BootId, Vec<u64>> = HashMap::new();
    for segment in &segments {
        by_boot.entry(segment.boot).or_default().push(segment.seq);
    }
    for (boot, mut seqs) in by_boot {
        let count = seqs.len();
        seqs.sort_unstable();
        seqs.dedup();
        if seqs.len() != count {
            report.violations.push(Violation {
                kind: "records",
                text: format!("boot {boot} has a segment twice"),
            });
        }
    }
}
