//! After a restoration from a backup: asks each robot how its open missions ended since, and closes
//! them accordingly, before anything else is decided about them.

use std::collections::HashMap;

use tracing::{info, warn};
use tread_api::ids::{BootId, MissionId};
use tread_api::mission::{Actor, MissionState};
use tread_api::wire::command::{OUTCOMES_MAX, Outcomes};
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::reply::{MissionOutcomes, OutcomesReply};

use super::jobs::Finished;
use crate::app::missions::transitions::Change;
use crate::app::missions::{Step, apply_transition};
use crate::app::{App, AppError};
use crate::db::missions::{Facts, OpenMission};
use crate::db::restorations::RestrictedRobot;
use crate::db::{self, Tx};

/// Reason of the end of a mission that its robot has reported.
const REPORTED: &str = "the robot had ended it before this server was restored from a backup";
/// Reason of the end of a mission of which its robot does not know whether it drove it.
const FORGOTTEN: &str = "this server was restored from a backup, and the robot no longer remembers \
                         whether it drove this mission: send it again if it did not";

/// Queries a robot for the outcomes of its missions and stores the answer. If the last attempt gets no
/// answer, the queries end.
pub(super) async fn ask(
    app: App,
    robot: RestrictedRobot,
    is_last: bool,
) -> Result<Finished, AppError> {
    let mut tx = app.db().read("restoration").await?;
    let open = db::missions::open_of_robot(&mut tx, robot.pk).await?;
    drop(tx);
    // A queue is shorter than that.
    let missions = open.iter().map(|mission| mission.id).take(OUTCOMES_MAX);
    let command = Outcomes {
        missions: missions.collect(),
    };
    let key = (robot.site.clone(), robot.robot.clone());
    let (outcomes, boot) = match app.commands().send(&key, &command).await {
        Ok(answer) => match answer.reply {
            OutcomesReply::Outcomes(outcomes) => (outcomes, Some(answer.boot)),
            OutcomesReply::Refused(refusal) => {
                let detail = refusal.detail;
                warn!(
                    "robot `{}` does not say how missions ended: {detail}",
                    key.1
                );
                return Ok(Finished::Again);
            }
        },
        Err(_undelivered) if is_last => {
            warn!(
                "robot `{}` does not say how its missions ended since the backup: its agent is too \
                 old; what it is offered again it refuses by itself",
                key.1
            );
            let nothing = MissionOutcomes {
                ended: Vec::new(),
                active: None,
                forgotten: None,
            };
            (nothing, None)
        }
        Err(_undelivered) => return Ok(Finished::Again),
    };
    take(&app, &robot, (&outcomes, boot)).await?;
    app.wake();
    Ok(Finished::Settled)
}

async fn take(
    app: &App,
    robot: &RestrictedRobot,
    (outcomes, boot): (&MissionOutcomes, Option<BootId>),
) -> Result<(), AppError> {
    let ended = outcomes.ended.iter().map(|it| (it.mission, it.phase));
    let ended: HashMap<MissionId, MissionPhase> = ended.collect();
    let active = outcomes.active;
    let mut tx = app.db().write("restoration").await?;
    let mut alerts = Vec::new();
    let mut closed = 0_usize;
    let (mut begun, mut others) = (None, Vec::new());
    // Those that ended come first: at most one mission of a robot is active.
    for mission in db::missions::open_of_robot(&mut tx, robot.pk).await? {
        let is_active = active.is_some_and(|active| active.mission == mission.id);
        let is_forgotten = outcomes
            .forgotten
            .is_some_and(|forgotten| mission.id <= forgotten);
        let (change, reason) = match ended.get(&mission.id).and_then(|phase| end_of(*phase)) {
            Some(change) => (change, REPORTED),
            None if is_active => {
                begun = Some(mission);
                continue;
            }
            None if is_forgotten => (Change::Forget, FORGOTTEN),
            None => {
                others.push(mission);
                continue;
            }
        };
        let step = step(app, change, Some(reason), Facts::default());
        if let Some(state) = apply_transition(&mut tx, &mission, step).await? {
            closed += 1;
            let end = (mission.id, state, reason);
            alerts.extend(app.alert_mission_end(&mut tx, robot.pk, end).await?);
        }
    }
    if let Some(mission) = begun {
        begin(app, &mut tx, mission, boot).await?;
    }
    db::restorations::record_outcomes(&mut tx, robot.pk).await?;
    app.commit_alerts(tx, alerts).await?;
    info!(
        robot.id = %robot.robot,
        "robot `{}` has said how its missions ended since the backup: {closed} of them did, {} did \
         not",
        robot.robot,
        others.len(),
    );
    Ok(())
}

/// Takes a mission that was queued or offered for begun: its robot has accepted it since.
async fn begin(
    app: &App,
    tx: &mut Tx,
    mut mission: OpenMission,
    boot: Option<BootId>,
) -> Result<(), AppError> {
    let facts = Facts {
        boot,
        ..Facts::default()
    };
    for (state, change) in [
        (MissionState::Queued, Change::Offer),
        (MissionState::Offered, Change::Accept),
    ] {
        if mission.state == state
            && let Some(next) =
                apply_transition(tx, &mission, step(app, change, None, facts)).await?
        {
            mission.state = next;
        }
    }
    Ok(())
}

fn step<'step>(app: &App, change: Change, reason: Option<&'step str>, facts: Facts) -> Step<'step> {
    Step {
        change,
        actor: Actor::Robot,
        reason,
        at: app.clock().now(),
        facts,
    }
}

/// Returns the change of a mission that ended in a phase; `None` for a phase that ends none.
const fn end_of(phase: MissionPhase) -> Option<Change> {
    match phase {
        MissionPhase::Succeeded => Some(Change::Succeed),
        MissionPhase::Failed => Some(Change::Fail),
        MissionPhase::Cancelled => Some(Change::Cancel),
        MissionPhase::Expired => Some(Change::Expire),
        MissionPhase::Started
        | MissionPhase::Paused
        | MissionPhase::Resumed
        | MissionPhase::Replaced => None,
    }
}
