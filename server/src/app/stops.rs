//! Stops: of one robot, of a fleet, in any state, by anybody, and their clearing.
//!
//! ```text
//! asked ─┬─► every robot at once ─► confirmed ──────────────┐
//!        └─► the database, beside ─► not confirmed in 300 ms: shown, an alert, ─► sent again
//!                                    by the reconciler until the robot confirms, over restarts
//! the robot's state ─► standing, measured: noted by the reconciler
//! clear ──► the database ─► the robot ─► cleared, or refused: a newer stop, or it still moves
//! ```
//!
//! The robot is the truth of what is in force, in the order in which stops came to it: the clear of
//! the last one ends those before. A robot that does not show a stop which it had confirmed and
//! which nobody asked to clear is told again, and may answer that it was cleared. Everything that a stopped robot had in
//! hand or in its queue is held, and goes on only when a person says so.

mod delivery;
mod unrecorded;

use std::collections::HashSet;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::sync::{mpsc, oneshot, watch};
use tracing::{error, info, warn};
use tread_api::ids::{RobotId, SiteId, StopId};
use tread_api::keys::Verb;
use tread_api::page::Page;
use tread_api::robot::Severity;
use tread_api::safety::StandingState;
use tread_api::stop::{FleetStop, STOP_CONFIRM_MAX_MS, STOP_TEXT_MAX, Stop};
use tread_api::wire::command::Outcome;
use tread_api::wire::safety::ClearStop;

use self::delivery::{Outgoing, Settling};
pub(super) use self::delivery::{Told, tell};
pub(super) use self::unrecorded::Unrecorded;
use super::missions::control::hold_all;
use super::{App, AppError, page, site_row};
use crate::db::stops::StopFilter;
use crate::db::{self, Tx};
use crate::fleet::presence::RobotKey;

/// How long a robot may take to confirm before the stop is shown as unconfirmed.
pub const STOP_CONFIRM_MAX: Duration = Duration::from_millis(STOP_CONFIRM_MAX_MS);
/// Most stops that are looked at in one pass of the reconciler.
const IN_FORCE_MAX: u32 = 20_000;
/// The alert of a robot that has not confirmed a stop.
pub(super) const UNCONFIRMED_ALERT: &str = "stop-unconfirmed";
/// How old a confirmation must be before a robot's state that does not show the stop counts
/// against it: states overtake answers.
const SHOWN_GRACE: SignedDuration = SignedDuration::from_secs(2);
/// Who stopped, when nobody said.
const SOMEBODY: &str = "somebody";

/// Who stops, and why, for people.
#[derive(Debug, Clone, Default)]
pub struct StopWords {
    /// Who.
    pub by: Option<String>,
    /// Why.
    pub reason: Option<String>,
}

fn words(text: Option<String>, otherwise: &str) -> String {
    let text: String = text
        .unwrap_or_default()
        .chars()
        .take(STOP_TEXT_MAX)
        .collect();
    match text.trim() {
        "" => otherwise.to_owned(),
        text => text.to_owned(),
    }
}

impl App {
    /// Stops one robot. Gives the stop when the robot has confirmed it, or after
    /// [`STOP_CONFIRM_MAX`]; it is sent again until it is confirmed.
    ///
    /// # Errors
    /// The robot has never said hello.
    pub async fn stop_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
        words: StopWords,
    ) -> Result<Stop, AppError> {
        let key = (site.clone(), robot.clone());
        // What is in memory decides, so that a slow database does not delay a stop.
        if !self.presences().is_known(&key) {
            let mut tx = self.db().read().await?;
            let site_pk = site_row(&mut tx, site).await?.pk;
            let found = db::robots::find(&mut tx, site_pk, robot).await?;
            let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
            found.ok_or_else(unknown)?;
        }
        let stops = self.stop_all(vec![key], words).await;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        stops.into_iter().next().ok_or_else(unknown)
    }

    /// Stops every robot that has ever said hello, of all sites or of one.
    ///
    /// # Errors
    /// There is no such site.
    pub async fn stop_fleet(
        &self,
        site: Option<&SiteId>,
        words: StopWords,
    ) -> Result<FleetStop, AppError> {
        let known = self.presences().known();
        let wanted = |key: &RobotKey| site.is_none_or(|site| *site == key.0);
        let keys: Vec<RobotKey> = known.into_iter().filter(wanted).collect();
        if let (Some(site), true) = (site, keys.is_empty()) {
            let mut tx = self.db().read().await?;
            site_row(&mut tx, site).await?;
        }
        let stops = self.stop_all(keys, words).await;
        let confirmed = stops
            .iter()
            .filter(|stop| stop.confirmed_at.is_some())
            .count();
        Ok(FleetStop {
            confirmed,
            unconfirmed: stops.len() - confirmed,
            stops,
        })
    }

    async fn stop_all(&self, keys: Vec<RobotKey>, said: StopWords) -> Vec<Stop> {
        let wanted_at = self.clock().now();
        let by = words(said.by, SOMEBODY);
        let reason = words(said.reason, "no reason was given");
        let stop = |(site, robot): RobotKey| Stop {
            id: StopId::from_uuid(self.clock().mission_id().as_uuid()),
            site,
            robot,
            by: by.clone(),
            reason: reason.clone(),
            wanted_at,
            confirmed_at: None,
            standing_at: None,
            unconfirmed: false,
            clear_asked_by: None,
            clear_asked_at: None,
            cleared_at: None,
        };
        let mut stops: Vec<Stop> = keys.into_iter().map(stop).collect();
        let Some(links) = self.links() else {
            error!("a stop was asked for before the network was open");
            return stops;
        };
        self.unrecorded().extend(&stops);
        let (tell, confirmations) = mpsc::channel(stops.len().max(1));
        let (recorded, is_recorded) = watch::channel(false);
        for stop in &stops {
            let outgoing = Outgoing {
                app: self.clone(),
                links: links.clone(),
                stop: stop.clone(),
                recorded: is_recorded.clone(),
            };
            links
                .supervisor
                .spawn_passing("stop", outgoing.deliver(tell.clone()));
        }
        drop(tell);
        warn!("{} robots are told to stop by {by}: {reason}", stops.len());
        let (shown, seen) = oneshot::channel();
        let settling = Settling {
            app: self.clone(),
            stops: stops.clone(),
            stop: links.supervisor.stop_token(),
            confirm_max: links.stop_confirm_max,
        };
        let settling = settling.run(confirmations, shown, recorded);
        links.supervisor.spawn_passing("stops", settling);
        // It answers within the bound; without it nothing is confirmed.
        let confirmed = seen.await.unwrap_or_default();
        for stop in &mut stops {
            let found = confirmed.iter().find(|(id, _)| *id == stop.id);
            stop.confirmed_at = found.map(|(_, at)| *at);
            stop.unconfirmed = found.is_none();
        }
        stops
    }

    /// Clears a stop, if it is the robot's newest and the robot stands. Nothing starts by it.
    ///
    /// # Errors
    /// The stop is not known, the robot does not answer, or it refuses.
    pub async fn clear_stop(
        &self,
        site: &SiteId,
        robot: &RobotId,
        id: StopId,
        by: Option<String>,
    ) -> Result<Stop, AppError> {
        let by = words(by, SOMEBODY);
        let key = (site.clone(), robot.clone());
        let mut tx = self.db().write().await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        db::robots::find(&mut tx, site_pk, robot)
            .await?
            .ok_or_else(unknown)?;
        self.adopt_shown_stop(&mut tx, &key).await?;
        let found = db::stops::find(&mut tx, id).await?;
        found
            .filter(|stop| (&stop.site, &stop.robot) == (site, robot))
            .ok_or(AppError::UnknownStop(id))?;
        db::stops::ask_clear(&mut tx, id, &by, self.clock().now()).await?;
        tx.commit().await?;
        let unreachable = || AppError::RobotUnreachable(robot.clone());
        let links = self.links().ok_or_else(unreachable)?;
        let command = ClearStop { stop: id, by };
        let answer = links.commands.send(&key, Verb::Clear, &command).await;
        let Some(answer) = answer else {
            self.counters().commands_unanswered.one();
            return Err(unreachable());
        };
        let mut tx = self.db().write().await?;
        if let Outcome::Refused { detail, .. } = answer.outcome {
            db::stops::refuse_clear(&mut tx, id).await?;
            tx.commit().await?;
            let robot = robot.clone();
            return Err(AppError::StopNotCleared { robot, detail });
        }
        self.presences().stop_cleared(&key, id);
        db::stops::clear(&mut tx, id, self.clock().now()).await?;
        let cleared = db::stops::find(&mut tx, id).await?;
        tx.commit().await?;
        info!(robot.id = %robot, "the stop of robot `{robot}` was cleared by {}", command.by);
        self.wake();
        let cleared = cleared.ok_or(AppError::UnknownStop(id))?;
        Ok(self.with_confirmation(cleared))
    }

    /// Stops, newest first.
    pub async fn stops(&self, filter: &StopFilter, limit: u32) -> Result<Page<Stop>, AppError> {
        let mut tx = self.db().read().await?;
        // Looked at first: one that is written down meanwhile is in both.
        let mut stops = self.unrecorded().list(filter);
        for stop in db::stops::list(&mut tx, filter, limit + 1).await? {
            stops.retain(|unrecorded| unrecorded.id != stop.id);
            stops.push(stop);
        }
        stops.sort_by_key(|stop| std::cmp::Reverse(stop.id));
        let shown = stops.into_iter().map(|stop| self.with_confirmation(stop));
        Ok(page(shown.collect(), limit, |stop: &Stop| {
            stop.id.to_string()
        }))
    }

    /// Stops that the reconciler looks at.
    pub(crate) async fn stops_in_force(&self) -> Result<Vec<Stop>, AppError> {
        let mut tx = self.db().read().await?;
        let stops = db::stops::in_force(&mut tx, IN_FORCE_MAX).await?;
        let shown = stops.into_iter().map(|stop| self.with_confirmation(stop));
        Ok(shown.collect())
    }

    fn with_confirmation(&self, mut stop: Stop) -> Stop {
        let age = self.clock().now().duration_since(stop.wanted_at);
        let bound = SignedDuration::from_millis(300);
        stop.unconfirmed = stop.confirmed_at.is_none() && stop.cleared_at.is_none() && age > bound;
        stop
    }

    /// Writes down a stop that a robot shows and that is not known here: it stopped by itself, or
    /// was stopped by another program.
    async fn adopt_shown_stop(&self, tx: &mut Tx, key: &RobotKey) -> Result<(), AppError> {
        let presence = self.presences().get(key);
        let Some(latch) = presence.state().and_then(|state| state.safety.stop.clone()) else {
            return Ok(());
        };
        if db::stops::find(tx, latch.id).await?.is_some() {
            return Ok(());
        }
        let now = self.clock().now();
        let stop = Stop {
            id: latch.id,
            site: key.0.clone(),
            robot: key.1.clone(),
            by: words(Some(latch.by), SOMEBODY),
            reason: words(Some(latch.reason), "the robot did not say why"),
            wanted_at: now,
            confirmed_at: Some(now),
            standing_at: None,
            unconfirmed: false,
            clear_asked_by: None,
            clear_asked_at: None,
            cleared_at: None,
        };
        self.record_stops(tx, &[stop]).await
    }

    /// Writes stops down, and holds everything that their robots have in hand.
    async fn record_stops(&self, tx: &mut Tx, stops: &[Stop]) -> Result<(), AppError> {
        db::stops::insert(tx, stops).await?;
        for stop in stops {
            let Some(robot_pk) = db::robots::pk_of(tx, &stop.site, &stop.robot).await? else {
                continue;
            };
            let reason = format!("the robot was stopped by {}: {}", stop.by, stop.reason);
            hold_all(tx, robot_pk, &reason, self.clock().now()).await?;
        }
        Ok(())
    }

    /// Writes down that robots have confirmed, and ends the alerts on it.
    pub(super) async fn note_confirmed(
        &self,
        stops: &[Stop],
        confirmed: &[(StopId, Timestamp)],
    ) -> Result<(), AppError> {
        let ids: Vec<StopId> = confirmed.iter().map(|(id, _)| *id).collect();
        let mut tx = self.db().write().await?;
        db::stops::confirm(&mut tx, &ids, self.clock().now()).await?;
        let mut alerts = Vec::new();
        for stop in stops.iter().filter(|stop| ids.contains(&stop.id)) {
            if let Some(robot_pk) = db::robots::pk_of(&mut tx, &stop.site, &stop.robot).await? {
                alerts.extend(self.end_alert(&mut tx, robot_pk, UNCONFIRMED_ALERT).await?);
            }
        }
        tx.commit().await?;
        self.show_alerts(&alerts);
        Ok(())
    }

    /// Writes down that a stop was in force on its robot and has been cleared there, with one that
    /// came later there.
    pub(super) async fn note_over(&self, stop: &Stop) -> Result<(), AppError> {
        let mut tx = self.db().write().await?;
        db::stops::end(&mut tx, stop.id, self.clock().now()).await?;
        let mut alerts = Vec::new();
        if let Some(robot_pk) = db::robots::pk_of(&mut tx, &stop.site, &stop.robot).await? {
            alerts.extend(self.end_alert(&mut tx, robot_pk, UNCONFIRMED_ALERT).await?);
        }
        tx.commit().await?;
        self.show_alerts(&alerts);
        self.wake();
        Ok(())
    }

    /// Raises the alert of robots that have not confirmed.
    pub(super) async fn note_unconfirmed(&self, stops: &[&Stop]) -> Result<(), AppError> {
        let mut alerts = Vec::new();
        let mut tx = self.db().write().await?;
        for stop in stops {
            let Some(robot_pk) = db::robots::pk_of(&mut tx, &stop.site, &stop.robot).await? else {
                continue;
            };
            let text = format!(
                "it has not confirmed the stop by {} ({}); it is told again until it does",
                stop.by, stop.reason
            );
            let severity = Severity::Critical;
            let alert = (UNCONFIRMED_ALERT, severity, text);
            alerts.extend(self.begin_alert(&mut tx, robot_pk, alert).await?);
        }
        tx.commit().await?;
        self.show_alerts(&alerts);
        Ok(())
    }

    /// Compares the stops in force with what robots show, and gives those to be sent again.
    pub(super) async fn tend_stops(&self) -> Result<Vec<Stop>, AppError> {
        let stops = self.stops_in_force().await?;
        let now = self.clock().now();
        let (mut lost, mut cleared, mut standing) = (Vec::new(), Vec::new(), Vec::new());
        let mut known: HashSet<StopId> = HashSet::new();
        let mut again = Vec::new();
        for stop in stops {
            known.insert(stop.id);
            let presence = self
                .presences()
                .get(&(stop.site.clone(), stop.robot.clone()));
            let shows_none = presence
                .state()
                .is_some_and(|state| state.safety.stop.is_none());
            let stands = presence.state().is_some_and(|state| {
                let is_this = state.safety.stop.as_ref().map(|latch| latch.id) == Some(stop.id);
                let standing = state.safety.standing.map(|standing| standing.state);
                is_this && standing == Some(StandingState::Standing)
            });
            if stands && stop.standing_at.is_none() {
                standing.push(stop.id);
            }
            let since = stop.clear_asked_at.or(stop.confirmed_at);
            let is_later = presence
                .state_age(self.clock().elapsed())
                .is_some_and(|age| {
                    let age = SignedDuration::try_from(age).unwrap_or(SignedDuration::MAX);
                    since.is_some_and(|since| now.duration_since(since) > age + SHOWN_GRACE)
                });
            match (stop.confirmed_at, &stop.clear_asked_by) {
                (None, _) if stop.unconfirmed => again.push(stop),
                (Some(_), None) if shows_none && is_later => lost.push(stop),
                (Some(_), Some(_)) if shows_none && is_later => cleared.push(stop.id),
                (None | Some(_), _) => {}
            }
        }
        let shown = self.presences().shown_stops();
        let new: Vec<RobotKey> = shown
            .into_iter()
            .filter(|(_, id)| !known.contains(id))
            .map(|(key, _)| key)
            .collect();
        if lost.is_empty() && cleared.is_empty() && standing.is_empty() && new.is_empty() {
            return Ok(again);
        }
        let writing = async {
            let mut tx = self.db().write().await?;
            for stop in &lost {
                db::stops::unconfirm(&mut tx, stop.id).await?;
            }
            for id in standing {
                db::stops::stand(&mut tx, id, now).await?;
            }
            for id in cleared {
                db::stops::clear(&mut tx, id, now).await?;
            }
            for key in new {
                self.adopt_shown_stop(&mut tx, &key).await?;
            }
            tx.commit().await?;
            for stop in &lost {
                let robot = &stop.robot;
                warn!(robot.id = %robot, "robot `{robot}` no longer shows its stop; it is told again");
                self.counters().stops_lost.one();
            }
            Ok::<(), AppError>(())
        };
        // Robots are told again also while nothing can be written.
        if let Err(error) = writing.await {
            self.log_failure("write down what became of stops", &error);
        }
        again.extend(lost);
        Ok(again)
    }
}
