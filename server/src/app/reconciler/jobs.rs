//! Commands that the reconciler sends to robots, and the changes that follow from the answers.

use std::time::Duration;

use jiff::SignedDuration;
use tracing::warn;
use tread_api::ids::MissionId;
use tread_api::mission::{Actor, Cause, MissionState};
use tread_api::robot::MissionProgress;
use tread_api::stop::Stop;
use tread_api::wire::command::{Cancel, Offer, Pause, Resume};
use tread_api::wire::reply::{Acknowledgement, Answer, CommandRefusalCode, OfferReply};
use tread_telemetry::Place;

use crate::app::missions::immediate_offer::OfferedNow;
use crate::app::missions::reports::{adopt, was_resumed_since};
use crate::app::missions::transitions::Change;
use crate::app::missions::{Step, add_note, apply_transition};
use crate::app::presence::RobotKey;
use crate::app::stops::{StopDelivery, send_stop};
use crate::app::terrains::site_definition;
use crate::app::{App, AppError};
use crate::db;
use crate::db::missions::{Facts, MissionRow, OpenMission};

/// Result of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Finished {
    /// Done; no repetition is needed.
    Settled,
    /// The robot accepted it and will report when it is done; repeated only if that takes long.
    Delivered,
    /// It was not delivered, or the robot cannot execute it yet.
    Again,
    /// The robot reports that the mission has already ended.
    EndedThere,
}

/// Changes a mission's state without a report of its robot, which has shown that state for a time if it is
/// the robot's.
pub(super) async fn apply_change(
    app: &App,
    mission: &OpenMission,
    change: Change,
    shown_for: Duration,
) -> Result<(), AppError> {
    // A robot that shows a mission is in the run that took it.
    let taken_by = || app.presences().get(&key_of(mission)).boot();
    let facts = Facts {
        boot: (change == Change::Accept)
            .then(taken_by)
            .flatten()
            .map(|(boot, _since)| boot),
        progress: last_progress(app, mission),
        ..Facts::default()
    };
    let mut tx = app.db().write_uncounted("reconciler").await?;
    let step = server_step(app, change, None, facts);
    let mut alerts = Vec::new();
    let moved = apply_transition(&mut tx, mission, step).await?;
    let is_for_safety = |shown: MissionProgress| shown.is_paused_for_safety();
    if moved == Some(MissionState::Paused) && facts.progress.is_some_and(is_for_safety) {
        let shown_for = SignedDuration::try_from(shown_for).unwrap_or_default();
        let since = app.clock().now() - shown_for;
        // Only a person resumes it, or has done so already.
        if !was_resumed_since(&mut tx, mission.id, since).await? {
            db::missions::set_pause_requested(&mut tx, mission.id, true).await?;
        }
    }
    if let Some(state) = moved
        && let Some(robot_pk) = db::robots::pk_of(&mut tx, &mission.site, &mission.robot).await?
    {
        let ended = (mission.id, state, change.reason());
        alerts = app.alert_mission_end(&mut tx, robot_pk, ended).await?;
    }
    app.commit_alerts(tx, alerts).await?;
    // The robot's next mission may be offered now.
    app.wake();
    Ok(())
}

/// Returns the progress of the mission's present revision that the robot showed last; it stays true
/// if the robot never reports an end.
fn last_progress(app: &App, mission: &OpenMission) -> Option<MissionProgress> {
    let progress = app
        .presences()
        .get(&key_of(mission))
        .progress_of(mission.id);
    progress.filter(|progress| (progress.revision, progress.plan_hash) == mission.content)
}

fn key_of(mission: &OpenMission) -> RobotKey {
    (mission.site.clone(), mission.robot.clone())
}

/// Makes a transition caused by the server. Called within the transaction, so that times are in the
/// order of commits.
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

/// Returns the time left until the mission's latest start, milliseconds, which the robot then
/// measures by its own clock.
fn start_within_ms(app: &App, row: &MissionRow) -> Option<u64> {
    row.mission.latest_start.map(|latest| {
        let left_ms = latest.duration_since(app.clock().now()).as_millis();
        u64::try_from(left_ms).unwrap_or(0)
    })
}

/// Offers a mission to its robot and stores the answer.
pub(super) async fn offer(app: App, open: OpenMission) -> Result<Finished, AppError> {
    if open.state == MissionState::Queued {
        let mut tx = app.db().write_uncounted("reconciler").await?;
        let step = server_step(&app, Change::Offer, None, Facts::default());
        match apply_transition(&mut tx, &open, step).await {
            Ok(Some(_)) => {
                tx.commit().await?;
                app.announce();
            }
            // It was cancelled meanwhile, or the robot has another active mission.
            Ok(None) => return Ok(Finished::Settled),
            Err(error) if error.is_unique_violation() => return Ok(Finished::Again),
            Err(error) => return Err(error.into()),
        }
    }
    let recalls = app.recalls();
    let Some(row) = offered_row(&app, open.id).await? else {
        return Ok(Finished::Settled);
    };
    let named = (&row.mission.site, &row.mission.robot);
    let prior = app.prior_along(named, &row.mission.trajectory).await?;
    let offered = OfferedNow {
        row,
        prior,
        recalls,
    };
    send_offer(app, offered).await
}

async fn row_of(app: &App, id: MissionId) -> Result<Option<MissionRow>, AppError> {
    let mut tx = app.db().read("reconciler").await?;
    Ok(db::missions::find(&mut tx, id).await?)
}

/// Returns a mission that is to be offered; `None` if it was cancelled meanwhile.
async fn offered_row(app: &App, id: MissionId) -> Result<Option<MissionRow>, AppError> {
    let row = row_of(app, id).await?;
    Ok(row.filter(|row| row.mission.state == MissionState::Offered))
}

/// Sends the offer of a mission that is set to `offered`, and stores the answer.
pub(super) async fn send_offer(app: App, offered: OfferedNow) -> Result<Finished, AppError> {
    let OfferedNow {
        mut row,
        prior,
        mut recalls,
    } = offered;
    // A person may have held or cancelled it since it was read. Nothing is awaited between the last
    // comparison and the sending.
    while app.recalls() != recalls {
        recalls = app.recalls();
        let Some(again) = offered_row(&app, row.mission.id).await? else {
            return Ok(Finished::Settled);
        };
        row = again;
    }
    let start_within_ms = start_within_ms(&app, &row);
    let mission = row.mission;
    let place = app.trace_offer(&mission);
    let command = Offer {
        prior,
        mission: mission.id,
        revision: mission.revision,
        plan_hash: mission.plan_hash,
        trajectory: mission.trajectory.clone(),
        start_within_ms,
        link_policy: mission.link_policy,
        on_hold: mission.pause_requested,
    };
    app.counters().offers_sent.one();
    let key = (mission.site.clone(), mission.robot.clone());
    let traceparent = place.map(Place::context);
    let began_at = app.clock().now();
    let answer = app
        .commands()
        .send_traced(&key, &command, traceparent)
        .await;
    app.trace_offered(place, &mission, began_at, &answer);
    let Ok(answer) = answer else {
        return Ok(Finished::Again);
    };
    handle_offer_reply(&app, mission.id, &answer).await
}

async fn handle_offer_reply(
    app: &App,
    id: MissionId,
    answer: &Answer<OfferReply>,
) -> Result<Finished, AppError> {
    let mut facts = Facts {
        boot: Some(answer.boot),
        ..Facts::default()
    };
    let (change, reason, how) = match &answer.reply {
        OfferReply::Accepted { plan } => {
            facts.plan = *plan;
            (Change::Accept, None, Finished::Settled)
        }
        // The report of how it ended is in the robot's outbox.
        OfferReply::Refused(refusal) if refusal.code == CommandRefusalCode::Ended => {
            return Ok(Finished::EndedThere);
        }
        OfferReply::Refused(refusal) => {
            let detail = Some(refusal.detail.as_str());
            if refusal.is_transient() {
                facts = Facts::default();
                (Change::Return, detail, Finished::Again)
            } else if refusal.code == CommandRefusalCode::TooLate {
                (Change::Expire, detail, Finished::Settled)
            } else {
                (Change::Reject, detail, Finished::Settled)
            }
        }
    };
    let mut tx = app.db().write_uncounted("reconciler").await?;
    // Read again: the robot's own report or a cancellation may have come first.
    if let Some(row) = db::missions::find(&mut tx, id).await? {
        let step = Step {
            actor: Actor::Robot,
            ..server_step(app, change, reason, facts)
        };
        let moved = apply_transition(&mut tx, &(&row.mission).into(), step).await?;
        if moved.is_none() && change == Change::Accept && !row.mission.state.is_terminal() {
            db::missions::add_facts(&mut tx, id, facts).await?;
        }
        let mut alerts = Vec::new();
        let named = (&row.mission.site, &row.mission.robot);
        if let Some(state) = moved.filter(|state| state.is_terminal())
            && let Some(robot_pk) = db::robots::pk_of(&mut tx, named.0, named.1).await?
        {
            let ended = (id, state, reason.unwrap_or(change.reason()));
            alerts = app.alert_mission_end(&mut tx, robot_pk, ended).await?;
        }
        app.commit_alerts(tx, alerts).await?;
    }
    app.wake();
    Ok(how)
}

/// Sends a new revision of an active mission and stores the answer.
pub(super) async fn replace(app: App, open: OpenMission) -> Result<Finished, AppError> {
    let recalls = app.recalls();
    let row = row_of(&app, open.id).await?;
    let Some(row) = row.filter(|row| !row.mission.state.is_terminal()) else {
        return Ok(Finished::Settled);
    };
    let Some(replacement) = row.mission.replacement.clone() else {
        return Ok(Finished::Settled);
    };
    let named = (&row.mission.site, &row.mission.robot);
    let prior = app.prior_along(named, &replacement.trajectory).await?;
    let command = Offer {
        prior,
        mission: row.mission.id,
        revision: replacement.revision,
        plan_hash: replacement.plan_hash,
        trajectory: replacement.trajectory.clone(),
        // It has begun, so its latest start no longer applies.
        start_within_ms: None,
        link_policy: row.mission.link_policy,
        on_hold: row.mission.pause_requested,
    };
    if app.recalls() != recalls {
        return Ok(Finished::Again);
    }
    app.counters().offers_sent.one();
    let key = (row.mission.site.clone(), row.mission.robot.clone());
    let Ok(answer) = app.commands().send(&key, &command).await else {
        return Ok(Finished::Again);
    };
    let mut tx = app.db().write_uncounted("reconciler").await?;
    let row = db::missions::find(&mut tx, open.id).await?;
    let as_sent = |row: &MissionRow| {
        let hash = row.mission.replacement.as_ref().map(|next| next.plan_hash);
        hash == Some(replacement.plan_hash) && !row.mission.state.is_terminal()
    };
    let Some(row) = row.filter(as_sent) else {
        return Ok(Finished::Settled);
    };
    match answer.reply {
        OfferReply::Accepted { plan } => {
            adopt(&mut tx, &row, Actor::Robot, app.clock().now()).await?;
            let facts = Facts {
                plan,
                ..Facts::default()
            };
            db::missions::add_facts(&mut tx, row.mission.id, facts).await?;
        }
        OfferReply::Refused(refusal) if refusal.is_transient() => return Ok(Finished::Again),
        OfferReply::Refused(refusal) if refusal.code == CommandRefusalCode::Ended => {
            return Ok(Finished::EndedThere);
        }
        OfferReply::Refused(refusal) => {
            db::missions::set_replacement(&mut tx, row.mission.id, None).await?;
            let why = (Actor::Robot, Cause::ReplaceRefused);
            let detail = &refusal.detail;
            add_note(&mut tx, &row.mission, why, app.clock().now(), detail).await?;
        }
    }
    tx.commit().await?;
    app.wake();
    Ok(Finished::Settled)
}

/// Makes the revision that the robot shows the present one.
pub(super) async fn adopt_reported_revision(app: &App, open: &OpenMission) -> Result<(), AppError> {
    let mut tx = app.db().write_uncounted("reconciler").await?;
    if let Some(row) = db::missions::find(&mut tx, open.id).await? {
        adopt(&mut tx, &row, Actor::Robot, app.clock().now()).await?;
        tx.commit().await?;
        app.wake();
    }
    Ok(())
}

/// Commands a robot to pause or to resume a mission, as it was read after so many recalls.
pub(super) async fn hold(
    app: App,
    open: OpenMission,
    held: bool,
    recalls: u64,
) -> Result<Finished, AppError> {
    let (mission, (revision, _)) = (open.id, open.content);
    // A person may have held or ended it since. A pause does no harm. Nothing is awaited between the last
    // comparison and the sending.
    let mut recalls = recalls;
    while !held && app.recalls() != recalls {
        recalls = app.recalls();
        let row = row_of(&app, mission).await?;
        let is_to_be_driven = row.is_some_and(|row| {
            let state = row.mission.state;
            matches!(state, MissionState::Active | MissionState::Paused)
                && !row.mission.pause_requested
                && row.mission.revision == revision
        });
        if !is_to_be_driven {
            return Ok(Finished::Settled);
        }
    }
    let key = (open.site.clone(), open.robot.clone());
    let answer = if held {
        let command = Pause { mission, revision };
        app.commands().send(&key, &command).await
    } else {
        let command = Resume { mission, revision };
        app.commands().send(&key, &command).await
    };
    let Ok(answer) = answer else {
        return Ok(Finished::Again);
    };
    match answer.reply {
        // The robot now brakes or accelerates. The mission changes when the robot reports that it
        // is stopped, or that it drives again.
        Acknowledgement::Done => Ok(Finished::Delivered),
        Acknowledgement::Refused(refusal) if refusal.code == CommandRefusalCode::Ended => {
            Ok(Finished::EndedThere)
        }
        Acknowledgement::Refused(refusal) => {
            let wanted = if held { "pause" } else { "resume" };
            let detail = refusal.detail;
            warn!(mission.id = %mission, "robot `{}` does not {wanted}: {detail}", key.1);
            Ok(Finished::Again)
        }
    }
}

/// Commands a robot to end a mission and stores the answer.
pub(super) async fn cancel(app: App, mission: OpenMission) -> Result<Finished, AppError> {
    let command = Cancel {
        mission: mission.id,
        reason: mission.reason.clone().unwrap_or_default(),
    };
    let key = (mission.site.clone(), mission.robot.clone());
    let Ok(answer) = app.commands().send(&key, &command).await else {
        return Ok(Finished::Again);
    };
    let detail = match answer.reply {
        Acknowledgement::Done => None,
        Acknowledgement::Refused(refusal) if refusal.code == CommandRefusalCode::Unknown => {
            Some("it had not reached the robot")
        }
        // The report of how it ended is in the robot's outbox.
        Acknowledgement::Refused(refusal) if refusal.code == CommandRefusalCode::Ended => {
            return Ok(Finished::EndedThere);
        }
        Acknowledgement::Refused(refusal) => {
            let detail = refusal.detail;
            warn!(mission.id = %mission.id, "robot `{}` does not cancel: {detail}", key.1);
            return Ok(Finished::Again);
        }
    };
    let mut tx = app.db().write_uncounted("reconciler").await?;
    if let Some(row) = db::missions::find(&mut tx, mission.id).await? {
        let reason = detail.or(row.mission.reason.as_deref());
        let open = (&row.mission).into();
        let facts = Facts {
            progress: last_progress(&app, &open),
            ..Facts::default()
        };
        let step = server_step(&app, Change::Cancel, reason, facts);
        apply_transition(
            &mut tx,
            &open,
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

/// Sends a stop again, and stores the robot's confirmation.
pub(super) async fn stop_again(app: App, stop: Stop) -> Result<Finished, AppError> {
    match send_stop(&app, &stop).await {
        StopDelivery::Confirmed => {
            let confirmed = (stop.id, app.clock().now());
            app.record_confirmed(&[stop], &[confirmed]).await?;
        }
        StopDelivery::Over => app.record_over(&stop).await?,
        StopDelivery::Unconfirmed => {
            app.alert_unconfirmed(&[&stop]).await?;
            return Ok(Finished::Again);
        }
    }
    Ok(Finished::Settled)
}

/// Sends a robot the terrains and the geofence of its site.
pub(super) async fn push_site(app: App, key: RobotKey) -> Result<Finished, AppError> {
    let mut tx = app.db().read("reconciler").await?;
    let definition = site_definition(&mut tx, &key.0).await?;
    drop(tx);
    let Some(definition) = definition else {
        return Ok(Finished::Settled);
    };
    let answer = app.commands().send(&key, &definition).await;
    if let Ok(Acknowledgement::Refused(refusal)) = answer.map(|answer| answer.reply) {
        warn!(
            "robot `{}` does not take its site's terrains: {}",
            key.1, refusal.detail
        );
    }
    // Its next state shows the new revision; if not, it is sent again.
    Ok(Finished::Again)
}
