//! Commands to robots on behalf of missions, and what their answers change.

use tracing::warn;
use tread_api::ids::MissionId;
use tread_api::keys::Verb;
use tread_api::mission::{Actor, MissionState};
use tread_api::wire::command::{Answer, Cancel, Offer, OfferRefusal, Outcome};

use crate::app::missions::transitions::Change;
use crate::app::missions::{Step, take_step};
use crate::app::terrains::site_definition;
use crate::app::{App, AppError};
use crate::db;
use crate::db::missions::{Facts, Standing};
use crate::fleet::commands::Commands;
use crate::fleet::presence::RobotKey;

/// How a command went.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Finished {
    /// It needs no repetition.
    Settled,
    /// It was not delivered, or the robot cannot yet.
    Again,
    /// The robot says that the mission has ended there.
    EndedThere,
}

/// Moves a mission without its robot.
pub(super) async fn settle(
    app: &App,
    mission: &Standing,
    change: Change,
    reason: &str,
) -> Result<(), AppError> {
    let step = server_step(app, change, Some(reason), Facts::default());
    let mut tx = app.db().write().await?;
    take_step(&mut tx, mission, step).await?;
    tx.commit().await?;
    // The robot's next mission may go now.
    app.wake();
    Ok(())
}

fn server_step<'step>(
    app: &App,
    change: Change,
    reason: Option<&'step str>,
    facts: Facts,
) -> Step<'step> {
    Step {
        change,
        actor: Actor::Server,
        reason,
        at: app.clock().now(),
        facts,
    }
}

/// Offers a mission and writes down the answer.
pub(super) async fn offer(
    app: App,
    commands: Commands,
    standing: Standing,
) -> Result<Finished, AppError> {
    if standing.state == MissionState::Queued {
        let mut tx = app.db().write().await?;
        let step = server_step(&app, Change::Offer, None, Facts::default());
        match take_step(&mut tx, &standing, step).await {
            Ok(Some(_)) => tx.commit().await?,
            // Cancelled meanwhile, or the robot has another one in hand.
            Ok(None) => return Ok(Finished::Settled),
            Err(error) if error.is_unique_violation() => return Ok(Finished::Again),
            Err(error) => return Err(error.into()),
        }
    }
    let mut tx = app.db().read().await?;
    let row = db::missions::find(&mut tx, standing.id).await?;
    drop(tx);
    // Cancelled meanwhile.
    let Some(row) = row.filter(|row| row.mission.state == MissionState::Offered) else {
        return Ok(Finished::Settled);
    };
    let mission = row.mission;
    let left = mission.latest_start.map(|latest| {
        let left_ms = latest.duration_since(app.clock().now()).as_millis();
        u64::try_from(left_ms).unwrap_or(0)
    });
    let command = Offer {
        mission: mission.id,
        revision: mission.revision,
        plan_hash: mission.plan_hash,
        trajectory: mission.trajectory,
        start_within_ms: left,
    };
    app.counters().offers_sent.one();
    let key = (mission.site, mission.robot);
    let Some(answer) = commands.send(&key, Verb::Offer, &command).await else {
        app.counters().commands_unanswered.one();
        return Ok(Finished::Again);
    };
    take_offer_answer(&app, mission.id, &answer).await
}

async fn take_offer_answer(
    app: &App,
    id: MissionId,
    answer: &Answer,
) -> Result<Finished, AppError> {
    let mut facts = Facts {
        boot: Some(answer.boot),
        ..Facts::default()
    };
    let (change, reason, how) = match &answer.outcome {
        Outcome::Accepted { plan } => {
            facts.plan = *plan;
            (Change::Accept, None, Finished::Settled)
        }
        // Out of place, but it says that the robot will do it.
        Outcome::Done => (Change::Accept, None, Finished::Settled),
        Outcome::Refused { code, detail } => {
            let detail = Some(detail.as_str());
            match code {
                OfferRefusal::Busy | OfferRefusal::NotReady => {
                    facts = Facts::default();
                    (Change::Return, detail, Finished::Again)
                }
                OfferRefusal::TooLate => (Change::Expire, detail, Finished::Settled),
                // How it ended is in the robot's store and on its way.
                OfferRefusal::Ended => return Ok(Finished::EndedThere),
                OfferRefusal::Conflict
                | OfferRefusal::Impossible
                | OfferRefusal::Unknown
                | OfferRefusal::Other => (Change::Reject, detail, Finished::Settled),
            }
        }
    };
    let mut tx = app.db().write().await?;
    // Read afresh: the robot's own report or a cancellation may have come first.
    if let Some(row) = db::missions::find(&mut tx, id).await? {
        let step = Step {
            actor: Actor::Robot,
            ..server_step(app, change, reason, facts)
        };
        let moved = take_step(&mut tx, &(&row.mission).into(), step).await?;
        if moved.is_none() && change == Change::Accept && !row.mission.state.is_terminal() {
            db::missions::add_facts(&mut tx, id, facts).await?;
        }
        tx.commit().await?;
    }
    app.wake();
    Ok(how)
}

/// Tells a robot to end a mission and writes down the answer.
pub(super) async fn cancel(
    app: App,
    commands: Commands,
    mission: Standing,
) -> Result<Finished, AppError> {
    let reason = mission
        .reason
        .clone()
        .unwrap_or_else(|| "cancelled by request".to_owned());
    let command = Cancel {
        mission: mission.id,
        reason,
    };
    let key = (mission.site.clone(), mission.robot.clone());
    let Some(answer) = commands.send(&key, Verb::Cancel, &command).await else {
        app.counters().commands_unanswered.one();
        return Ok(Finished::Again);
    };
    let detail = match &answer.outcome {
        Outcome::Done | Outcome::Accepted { .. } => None,
        Outcome::Refused {
            code: OfferRefusal::Unknown,
            ..
        } => Some("it had not reached the robot"),
        // How it ended is in the robot's store and on its way.
        Outcome::Refused {
            code: OfferRefusal::Ended,
            ..
        } => return Ok(Finished::EndedThere),
        Outcome::Refused { detail, .. } => {
            warn!(mission.id = %mission.id, "robot `{}` does not cancel: {detail}", key.1);
            return Ok(Finished::Again);
        }
    };
    let mut tx = app.db().write().await?;
    if let Some(row) = db::missions::find(&mut tx, mission.id).await? {
        let reason = detail.or(row.mission.reason.as_deref());
        let step = server_step(&app, Change::Cancel, reason, Facts::default());
        take_step(
            &mut tx,
            &(&row.mission).into(),
            Step {
                actor: Actor::Robot,
                ..step
            },
        )
        .await?;
        tx.commit().await?;
    }
    app.wake();
    Ok(Finished::Settled)
}

/// Brings a robot its site's terrains.
pub(super) async fn push_site(
    app: App,
    commands: Commands,
    key: RobotKey,
) -> Result<Finished, AppError> {
    let mut tx = app.db().read().await?;
    let definition = site_definition(&mut tx, &key.0).await?;
    drop(tx);
    let Some(definition) = definition else {
        return Ok(Finished::Settled);
    };
    match commands.send(&key, Verb::Site, &definition).await {
        // Its next state shows the new revision; if not, it is sent again.
        Some(Answer {
            outcome: Outcome::Done | Outcome::Accepted { .. },
            ..
        }) => Ok(Finished::Again),
        Some(Answer {
            outcome: Outcome::Refused { detail, .. },
            ..
        }) => {
            warn!(
                "robot `{}` does not take its site's terrains: {detail}",
                key.1
            );
            Ok(Finished::Again)
        }
        None => {
            app.counters().commands_unanswered.one();
            Ok(Finished::Again)
        }
    }
}
