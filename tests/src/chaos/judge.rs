//! What must hold after a run, whatever failed in it.

use tread_agent::missions::MissionSlot;
use tread_api::ids::RobotId;
use tread_api::mission::{Cause, MissionDetail, MissionState};
use tread_api::wire::ingest::MissionPhase;

use super::{Followed, RunReport, Violation};
use crate::database::FleetDatabase;
use crate::fleet::Fleet;
use crate::stored::{self, lost_records};

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
    memory: Option<&MissionSlot>,
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
        (MissionState::Failed, Cause::RobotLost) => {
            asked.is_soon_lost || asked.is_server_silent_too_long
        }
        (MissionState::Failed, Cause::AgentRestarted | Cause::RobotLostMission) => agent_was_killed,
        (MissionState::Failed, Cause::Failed) => {
            let is_silence = asked.is_server_silent_too_long && reason.contains("silent");
            is_silence || (agent_was_killed && reason.contains("restart"))
        }
        _ => false,
    };
    (!is_fair).then(|| format!("{} with `{reason}` is against its policy", end_of(detail)))
}

/// What the robot remembers must be what the server says; a mission that the server gave up as
/// lost may have ended otherwise on the robot, and then the server has kept its word as an event.
fn disagreement(detail: &MissionDetail, memory: &MissionSlot) -> Option<String> {
    let id = detail.mission.id;
    if memory.active().is_some_and(|active| active.mission == id) {
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
        Cause::RobotLost | Cause::AgentRestarted | Cause::RobotLostMission
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

/// A step of the server's history.
type Step = (String, String);

/// Whether two missions were in the robot's hands at the same time, by the order in which the
/// server committed its history. Times do not matter.
fn two_at_once(steps: &[Step]) -> Option<String> {
    let mut in_progress: Vec<&str> = Vec::new();
    for (mission, state) in steps {
        let state = MissionState::from_name(state)?;
        let is_active = !state.is_terminal() && state != MissionState::Queued;
        in_progress.retain(|active| active != mission);
        if is_active {
            in_progress.push(mission);
        }
        if in_progress.len() > 1 {
            return Some(format!("{in_progress:?} were active together"));
        }
    }
    None
}

/// Whether the robot took a mission before it had ended the one before, by the order of its own
/// log; a new run begins with nothing.
fn two_on_the_robot(log: &str) -> Option<String> {
    let mut active: Option<&str> = None;
    for line in log.lines() {
        if line.contains("agent of `") {
            active = None;
        } else if let Some((_, taken)) = line.split_once("took mission ") {
            let taken = taken.split_whitespace().next().unwrap_or_default();
            if let Some(active) = active.replace(taken) {
                return Some(format!("the robot took {taken} while it had {active}"));
            }
        } else if line.contains(" ended: ") && active.is_some_and(|active| line.contains(active)) {
            active = None;
        }
    }
    None
}

/// Holds what is on the disks against each other: what the robot ever wrote down is at the server,
/// each record once, and the histories are of one mission after the other.
pub(super) async fn judge_disks(fleet: &Fleet, robot: &RobotId, report: &mut RunReport) {
    let mut note = |kind: &'static str, text: String| {
        report.violations.push(Violation { kind, text });
    };
    match server_side(fleet.database()).await {
        Ok((steps, records)) => {
            if let Some(text) = two_at_once(&steps) {
                note("two_at_once", text);
            }
            if let Some(text) = lost_records(&fleet.robot_folder(robot), robot, records) {
                note("records", text);
            }
        }
        Err(cause) => note("records", format!("the database cannot be read: {cause}")),
    }
    if let Some(text) = two_on_the_robot(&fleet.log(robot.as_str())) {
        note("two_at_once", text);
    }
}

/// The history of all missions in its order, and the names of all records that were taken.
async fn server_side(
    database: &FleetDatabase,
) -> Result<(Vec<Step>, Vec<(String, i64)>), sqlx::Error> {
    let steps = database.rows("SELECT mission, to_state FROM mission_events ORDER BY pk");
    Ok((steps.await?, stored::records(database).await?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps(names: &[(&str, &str)]) -> Vec<Step> {
        let owned = |&(mission, state): &(&str, &str)| (mission.to_owned(), state.to_owned());
        names.iter().map(owned).collect()
    }

    #[test]
    fn one_mission_after_the_other_is_distinguished_from_two_at_once() {
        let after = steps(&[
            ("a", "offered"),
            ("b", "queued"),
            ("a", "active"),
            ("a", "failed"),
            ("b", "offered"),
            ("a", "failed"),
        ]);
        assert_eq!(two_at_once(&after), None);
        let both = steps(&[("a", "offered"), ("b", "offered"), ("a", "failed")]);
        assert!(two_at_once(&both).is_some());
    }

    #[test]
    fn the_robots_own_log_shows_a_second_active_mission() {
        let after = "agent of `r` runs\ntook mission m1 x\nmission m1 ended: Failed\n\
                     took mission m2\nagent of `r` runs\ntook mission m3\n";
        assert_eq!(two_on_the_robot(after), None);
        assert!(two_on_the_robot("took mission m1 x\ntook mission m2 x\n").is_some());
    }
}
