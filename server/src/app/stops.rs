//! Stops: of one robot or of a fleet, and their clearing.
//!
//! ```text
//! request ─┬─► sent to every robot at once ─► confirmed
//!          └─► stored at the same time ─► not confirmed within 300 ms: shown, raises an alert, and
//!                                         sent again by the reconciler until the robot confirms,
//!                                         also after a restart of the server
//! state of the robot ─► measured standstill ─► stored by the reconciler
//! clear ──► the database ─► the robot ─► cleared, or refused: a newer stop, or it still moves
//! ```
//!
//! A robot has at most one open stop. A new stop replaces it; the replaced one stays in the
//! history. The number of robots therefore limits the number of stops that are sent again.
//!
//! The robot decides which stop is in force: the one that reached it last. Clearing this stop ends
//! all earlier ones. If a robot no longer shows a stop that it had confirmed and that nobody cleared,
//! the server sends the stop again; the robot may answer that it was cleared (`decision`). All active
//! and queued missions of a stopped robot are held, and only a person resumes them.

mod decision;
mod delivery;
mod reconciliation;
mod unrecorded;

use std::collections::HashSet;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio::sync::{mpsc, oneshot, watch};
use tracing::{info, warn};
use tread_api::ids::{RobotId, SiteId, StopId};
use tread_api::page::Page;
use tread_api::rights::Scope;
use tread_api::robot::{Alert, Severity};
use tread_api::safety::StopLatch;
use tread_api::stop::{FleetStop, STOP_CONFIRM_MAX_MS, STOP_TEXT_MAX, Stop};
use tread_api::wire::reply::Acknowledgement;
use tread_api::wire::safety::ClearStop;

use self::delivery::{Outgoing, StopRecorder};
pub(super) use self::delivery::{StopDelivery, send_stop};
pub(super) use self::unrecorded::Unrecorded;
use super::missions::control::hold_all;
use super::own_alert::OwnAlert;
use super::{App, AppError, page, site_row};
use crate::app::presence::RobotKey;
pub use crate::db::stops::StopFilter;
use crate::db::{self, DbError, Tx};

/// Time within which a robot must confirm a stop; later it is shown as unconfirmed.
pub const STOP_CONFIRM_MAX: Duration = Duration::from_millis(STOP_CONFIRM_MAX_MS);
/// Maximum number of stops stored per robot; the oldest that are over are deleted first.
const KEPT_MAX: u32 = 200;
/// Maximum time for looking up a robot that is not known in memory, when it is stopped.
const LOOK_UP_MAX: Duration = Duration::from_secs(2);
/// Code of the alert about a robot that has not confirmed a stop.
pub(super) const UNCONFIRMED_ALERT: &str = "stop-unconfirmed";
/// Author of a stop if none was given.
const SOMEBODY: &str = "somebody";

/// Author and reason of a stop, for people.
#[derive(Debug, Clone, Default)]
pub struct StopReason {
    /// The author.
    pub by: Option<String>,
    /// The reason.
    pub reason: Option<String>,
}

fn key_of(stop: &Stop) -> RobotKey {
    (stop.site.clone(), stop.robot.clone())
}

fn text_or(text: Option<String>, otherwise: &str) -> String {
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

/// Returns the robots with a raised alert about an unconfirmed stop.
async fn alerted(tx: &mut Tx) -> Result<HashSet<RobotKey>, AppError> {
    let alerted = db::alerts::raised_about(tx, UNCONFIRMED_ALERT).await?;
    Ok(alerted.into_iter().collect())
}

/// Runs a look-up for at most [`LOOK_UP_MAX`].
async fn looked_up(looking_up: impl Future<Output = Result<(), AppError>>) -> Result<(), AppError> {
    let looked_up = tokio::time::timeout(LOOK_UP_MAX, looking_up).await;
    looked_up.unwrap_or_else(|_elapsed| Err(DbError::busy().into()))
}

impl App {
    /// Stops one robot. Returns the stop when the robot has confirmed it, or after
    /// [`STOP_CONFIRM_MAX`]; it is sent again until it is confirmed.
    ///
    /// # Errors
    /// The robot has never sent a hello.
    pub async fn stop_robot(
        &self,
        site: &SiteId,
        robot: &RobotId,
        reason: StopReason,
    ) -> Result<Stop, AppError> {
        let key = (site.clone(), robot.clone());
        // Memory decides, so that a slow database does not delay a stop.
        if !self.presences().is_known(&key) {
            let looking_up = async {
                let mut tx = self.db().read("stops").await?;
                let site_pk = site_row(&mut tx, site).await?.pk;
                let found = db::robots::find(&mut tx, site_pk, robot).await?;
                let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
                found.map(|_known| ()).ok_or_else(unknown)
            };
            looked_up(looking_up).await?;
        }
        let stops = self.stop_all(vec![key], reason).await;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        stops.into_iter().next().ok_or_else(unknown)
    }

    /// Stops every robot of a scope that has ever sent a hello, in all its sites or in one.
    ///
    /// # Errors
    /// The site is not known.
    pub async fn stop_fleet(
        &self,
        within: &Scope,
        site: Option<&SiteId>,
        reason: StopReason,
    ) -> Result<FleetStop, AppError> {
        let known = self.presences().known();
        let wanted = |key: &RobotKey| {
            site.is_none_or(|site| *site == key.0) && within.includes_robot(&key.0, &key.1)
        };
        let keys: Vec<RobotKey> = known.into_iter().filter(wanted).collect();
        if let (Some(site), true) = (site, keys.is_empty()) {
            let looking_up = async {
                let mut tx = self.db().read("stops").await?;
                site_row(&mut tx, site).await.map(|_known| ())
            };
            looked_up(looking_up).await?;
        }
        let stops = self.stop_all(keys, reason).await;
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

    async fn stop_all(&self, keys: Vec<RobotKey>, reason: StopReason) -> Vec<Stop> {
        let requested_at = self.clock().now();
        let by = text_or(reason.by, SOMEBODY);
        let reason = text_or(reason.reason, "no reason was given");
        let stop = |(site, robot): RobotKey| Stop {
            id: self.clock().new_id::<StopId>(),
            site,
            robot,
            by: by.clone(),
            reason: reason.clone(),
            requested_at,
            confirmed_at: None,
            standstill_at: None,
            unconfirmed: false,
            clear_requested_by: None,
            clear_requested_at: None,
            cleared_at: None,
            replaced_by: None,
        };
        let mut stops: Vec<Stop> = keys.into_iter().map(stop).collect();
        self.unrecorded().extend(&stops);
        let (tell, confirmations) = mpsc::channel(stops.len().max(1));
        let (recorded, is_recorded) = watch::channel(false);
        for stop in &stops {
            let outgoing = Outgoing {
                app: self.clone(),
                stop: stop.clone(),
                recorded: is_recorded.clone(),
            };
            self.supervisor()
                .spawn_passing("stop", outgoing.deliver(tell.clone()));
        }
        drop(tell);
        warn!("{by} stops {} robots: {reason}", stops.len());
        let (shown, seen) = oneshot::channel();
        let settling = StopRecorder {
            app: self.clone(),
            stops: stops.clone(),
            stop: self.supervisor().stop_token(),
            confirm_max: self.robot_link().stop_confirm_max,
        };
        let settling = settling.run(confirmations, shown, recorded);
        self.supervisor().spawn_passing("stops", settling);
        // The task answers within the limit; if it is gone, nothing is confirmed.
        let confirmed = seen.await.unwrap_or_default();
        for stop in &mut stops {
            let found = confirmed.iter().find(|(id, _)| *id == stop.id);
            stop.confirmed_at = found.map(|(_, at)| *at);
            stop.unconfirmed = found.is_none();
        }
        stops
    }

    /// Clears a stop, if it is the robot's newest and the robot is stopped. This does not start
    /// anything.
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
        let by = text_or(by, SOMEBODY);
        let key = (site.clone(), robot.clone());
        let mut tx = self.db().write("stops").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let unknown = || AppError::UnknownRobot(site.clone(), robot.clone());
        let row = db::robots::find(&mut tx, site_pk, robot).await?;
        let robot_pk = row.ok_or_else(unknown)?.pk;
        let is_open = db::stops::in_force_of(&mut tx, robot_pk)
            .await?
            .is_some_and(|open| open.id == id);
        if !is_open && self.shown_latch(&key).is_some_and(|latch| latch.id == id) {
            self.adopt_reported_stop(&mut tx, &key).await?;
        }
        let found = db::stops::find(&mut tx, id).await?;
        found
            .filter(|stop| (&stop.site, &stop.robot) == (site, robot))
            .ok_or(AppError::UnknownStop(id))?;
        db::stops::request_clear(&mut tx, id, &by, self.clock().now()).await?;
        self.commit_recalling(tx).await?;
        let unreachable = || AppError::RobotUnreachable(robot.clone());
        let command = ClearStop { stop: id, by };
        let answer = self.commands().send(&key, &command).await;
        let answer = answer.map_err(|_undelivered| unreachable())?;
        let mut tx = self.db().write("stops").await?;
        if let Acknowledgement::Refused(refusal) = answer.reply {
            db::stops::refuse_clear(&mut tx, id).await?;
            tx.commit().await?;
            let (robot, detail) = (robot.clone(), refusal.detail);
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
        let mut tx = self.db().read("stops").await?;
        // Read first: a stop that is stored meanwhile is then in both lists.
        let mut stops = self.unrecorded().list(filter);
        for mut stop in db::stops::list(&mut tx, filter, limit + 1).await? {
            stops.retain(|unrecorded| unrecorded.id != stop.id);
            if stop.cleared_at.is_none() && stop.replaced_by.is_none() {
                stop.replaced_by = self.unrecorded().successor_of(&stop);
            }
            if !(filter.in_force && stop.replaced_by.is_some()) {
                stops.push(stop);
            }
        }
        stops.sort_by_key(|stop| std::cmp::Reverse((stop.requested_at, stop.id)));
        let shown = stops.into_iter().map(|stop| self.with_confirmation(stop));
        Ok(page(shown.collect(), limit, |stop: &Stop| {
            stop.id.to_string()
        }))
    }

    /// Returns the open stop of each robot that has one.
    pub(crate) async fn stops_in_force(&self) -> Result<Vec<Stop>, AppError> {
        let mut tx = self.db().read("stops").await?;
        let stops = db::stops::in_force(&mut tx).await?;
        let shown = stops.into_iter().map(|stop| self.with_confirmation(stop));
        Ok(shown.collect())
    }

    fn with_confirmation(&self, mut stop: Stop) -> Stop {
        let age = self.clock().now().duration_since(stop.requested_at);
        let bound = SignedDuration::try_from(STOP_CONFIRM_MAX).unwrap_or(SignedDuration::MAX);
        let is_open = stop.cleared_at.is_none() && stop.replaced_by.is_none();
        stop.unconfirmed = stop.confirmed_at.is_none() && is_open && age > bound;
        stop
    }

    fn shown_latch(&self, key: &RobotKey) -> Option<StopLatch> {
        let presence = self.presences().get(key);
        presence.state().and_then(|state| state.safety.stop.clone())
    }

    /// Makes the stop that a robot shows its open one: it stopped by itself, was stopped by another
    /// program, or received the stops in another order.
    async fn adopt_reported_stop(&self, tx: &mut Tx, key: &RobotKey) -> Result<(), AppError> {
        let Some(latch) = self.shown_latch(key) else {
            return Ok(());
        };
        let Some(robot_pk) = db::robots::pk_of(tx, &key.0, &key.1).await? else {
            return Ok(());
        };
        // An unconfirmed stop is newer than what the robot shows, and is still to be sent; so is
        // one that is not stored yet.
        let open = db::stops::in_force_of(tx, robot_pk).await?;
        let is_pending =
            open.is_some_and(|open| open.id != latch.id && open.confirmed_at.is_none());
        if is_pending || self.unrecorded().has_of(key) {
            return Ok(());
        }
        let now = self.clock().now();
        let stop = Stop {
            id: latch.id,
            site: key.0.clone(),
            robot: key.1.clone(),
            by: text_or(Some(latch.by), SOMEBODY),
            reason: text_or(Some(latch.reason), "the robot did not say why"),
            requested_at: now,
            confirmed_at: Some(now),
            standstill_at: None,
            unconfirmed: false,
            clear_requested_by: None,
            clear_requested_at: None,
            cleared_at: None,
            replaced_by: None,
        };
        db::stops::adopt(tx, robot_pk, &stop, KEPT_MAX).await?;
        self.hold_stopped(tx, robot_pk, &stop).await
    }

    async fn hold_stopped(&self, tx: &mut Tx, robot_pk: i64, stop: &Stop) -> Result<(), AppError> {
        let reason = format!("the robot was stopped by {}: {}", stop.by, stop.reason);
        hold_all(tx, robot_pk, &reason, self.clock().now()).await?;
        Ok(())
    }

    /// Stores stops, and holds all active missions of their robots.
    async fn record_stops(&self, tx: &mut Tx, stops: &[Stop]) -> Result<(), AppError> {
        db::stops::insert(tx, stops, KEPT_MAX).await?;
        let mut busy = None;
        if stops.len() > 1 {
            // Most robots of a fleet may have nothing to hold.
            let mut missions = db::missions::in_progress(tx).await?;
            missions.extend(db::missions::next_in_queues(tx).await?);
            let keys = missions
                .into_iter()
                .map(|mission| (mission.site, mission.robot));
            busy = Some(keys.collect::<HashSet<RobotKey>>());
        }
        let is_idle = |stop: &Stop| {
            let busy = busy.as_ref();
            busy.is_some_and(|busy| !busy.contains(&key_of(stop)))
        };
        for stop in stops.iter().filter(|stop| !is_idle(stop)) {
            if let Some(robot_pk) = db::robots::pk_of(tx, &stop.site, &stop.robot).await? {
                self.hold_stopped(tx, robot_pk, stop).await?;
            }
        }
        Ok(())
    }

    /// Stores the confirmations of robots, and clears the alerts about these stops.
    pub(super) async fn record_confirmed(
        &self,
        stops: &[Stop],
        confirmed: &[(StopId, Timestamp)],
    ) -> Result<(), AppError> {
        let ids: Vec<StopId> = confirmed.iter().map(|(id, _)| *id).collect();
        let mut tx = self.db().write("stops").await?;
        db::stops::confirm(&mut tx, &ids, self.clock().now()).await?;
        let alerted = alerted(&mut tx).await?;
        let is_over = |stop: &&Stop| ids.contains(&stop.id) && alerted.contains(&key_of(stop));
        let mut alerts = Vec::new();
        for stop in stops.iter().filter(is_over) {
            alerts.extend(self.settle_alert(&mut tx, &key_of(stop), false).await?);
        }
        Ok(self.commit_alerts(tx, alerts).await?)
    }

    /// Stores that a stop was in force on its robot and has been cleared there, or that a later one
    /// was.
    pub(super) async fn record_over(&self, stop: &Stop) -> Result<(), AppError> {
        let mut tx = self.db().write("stops").await?;
        db::stops::end(&mut tx, stop.id, self.clock().now()).await?;
        let ended = self.settle_alert(&mut tx, &key_of(stop), false).await?;
        self.commit_alerts(tx, ended.into_iter().collect()).await?;
        self.wake();
        Ok(())
    }

    /// Raises the alerts of robots that have not confirmed a stop.
    pub(super) async fn alert_unconfirmed(&self, stops: &[&Stop]) -> Result<(), AppError> {
        let mut tx = self.db().read("stops").await?;
        let open = db::stops::in_force(&mut tx).await?;
        let open: HashSet<StopId> = open.into_iter().map(|stop| stop.id).collect();
        let alerted = alerted(&mut tx).await?;
        drop(tx);
        // Most stops may have been replaced, if a fleet is stopped repeatedly.
        let is_missing =
            |stop: &&&Stop| open.contains(&stop.id) && !alerted.contains(&key_of(stop));
        let missing: Vec<&&Stop> = stops.iter().filter(is_missing).collect();
        if missing.is_empty() {
            return Ok(());
        }
        let mut alerts = Vec::new();
        let mut tx = self.db().write("stops").await?;
        for stop in missing {
            alerts.extend(self.settle_alert(&mut tx, &key_of(stop), true).await?);
        }
        Ok(self.commit_alerts(tx, alerts).await?)
    }

    /// Clears the alert of a robot without an unconfirmed stop, or raises that of a robot with one
    /// if `is_overdue`.
    async fn settle_alert(
        &self,
        tx: &mut Tx,
        (site, robot): &RobotKey,
        is_overdue: bool,
    ) -> Result<Option<Alert>, AppError> {
        let Some(robot_pk) = db::robots::pk_of(tx, site, robot).await? else {
            return Ok(None);
        };
        let open = db::stops::in_force_of(tx, robot_pk).await?;
        let Some(stop) = open.filter(|stop| stop.confirmed_at.is_none()) else {
            return Ok(self.end_alert(tx, robot_pk, UNCONFIRMED_ALERT).await?);
        };
        if !is_overdue {
            return Ok(None);
        }
        let text = format!(
            "it has not confirmed the stop by {} ({}); the stop is sent again until it does",
            stop.by, stop.reason
        );
        let alert = OwnAlert {
            code: UNCONFIRMED_ALERT,
            severity: Severity::Critical,
            text,
            mission: None,
        };
        Ok(self.begin_alert(tx, robot_pk, alert).await?)
    }
}
