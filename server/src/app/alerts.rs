//! Alerts: conditions that robots report for a person's attention, stored with their history.
//!
//! Each state message lists all alerts of its robot. Comparing that list with the alerts that are
//! raised here raises and clears alerts; a robot that is offline clears none. Alerts about the
//! server itself are in [`super::storage`].

use tread_api::ids::{AlertCode, AlertId, MissionId};
use tread_api::mission::MissionState;
use tread_api::page::Page;
use tread_api::robot::{ALERT_TEXT_MAX, ALERTS_MAX, Alert, AlertReport, Severity};
use tread_api::webhook::NoticeEvent;
use tread_api::wire::ingest::MissionReport;

use super::enrolment::{RETIRED_ALERT, REVOKED_ALERT, UNISSUED_ALERT};
use super::missions::reports::ReportEffect;
use super::own_alert::OwnAlert;
use super::reconciler::attendance::ROBOT_LOST_ALERT;
use super::reconciler::conditions::{CLOCK_WRONG_ALERT, ROBOT_WAITING_ALERT};
use super::reconciler::delays::MISSION_WAITING_ALERT;
use super::stops::UNCONFIRMED_ALERT;
use super::storage::SERVER_RESTARTED_ALERT;
use super::{App, AppError, check_named, page};
use crate::app::presence::RobotKey;
pub use crate::db::alerts::AlertFilter;
use crate::db::alerts::AlertLocation;
use crate::db::{self, DbError, Outcome};

/// Code of the alert about a mission that failed.
pub(super) const MISSION_FAILED_ALERT: &str = "mission-failed";
/// Code of the alert about a mission whose latest start passed before it began.
pub(super) const MISSION_EXPIRED_ALERT: &str = "mission-expired";
/// Code of the alert about a mission that its robot rejected for ever.
pub(super) const MISSION_REJECTED_ALERT: &str = "mission-rejected";
/// Codes of the alerts about missions that did not succeed. Each is raised until a person
/// acknowledges it, or until a mission of the robot succeeds.
const MISSION_ALERTS: [&str; 3] = [
    MISSION_FAILED_ALERT,
    MISSION_EXPIRED_ALERT,
    MISSION_REJECTED_ALERT,
];
/// Codes of the alerts about a robot's presence and work. They end when the robot is retired or
/// revoked: nobody expects it to report or to drive.
const WORK_ALERTS: [&str; 7] = [
    ROBOT_LOST_ALERT,
    ROBOT_WAITING_ALERT,
    MISSION_WAITING_ALERT,
    CLOCK_WRONG_ALERT,
    MISSION_FAILED_ALERT,
    MISSION_EXPIRED_ALERT,
    MISSION_REJECTED_ALERT,
];
/// Maximum number of alerts stored per robot. Beyond it the oldest cleared ones are deleted first.
const KEPT_MAX: u32 = 500;
/// Codes of alerts that the server itself raises and clears, independently of the robot's reports.
const OWN_ALERTS: [&str; 11] = [
    UNCONFIRMED_ALERT,
    REVOKED_ALERT,
    RETIRED_ALERT,
    UNISSUED_ALERT,
    ROBOT_LOST_ALERT,
    ROBOT_WAITING_ALERT,
    MISSION_WAITING_ALERT,
    CLOCK_WRONG_ALERT,
    MISSION_FAILED_ALERT,
    MISSION_EXPIRED_ALERT,
    MISSION_REJECTED_ALERT,
];

impl App {
    /// Returns a page of alerts, newest first.
    pub async fn alerts(&self, filter: &AlertFilter, limit: u32) -> Result<Page<Alert>, AppError> {
        let mut tx = self.db().read("alerts").await?;
        check_named(
            &mut tx,
            filter.site.as_ref(),
            filter.robot.as_ref(),
            &filter.within,
        )
        .await?;
        let mut alerts = self.storage().alerts(filter);
        alerts.extend(db::alerts::list(&mut tx, filter, limit + 1).await?);
        alerts.sort_by_key(|alert| std::cmp::Reverse(alert.id));
        Ok(page(alerts, limit, |alert: &Alert| alert.id.to_string()))
    }

    /// Returns the robot that an alert is about; `None` for one about the server itself or an
    /// unknown identifier.
    pub async fn alert_place(&self, id: AlertId) -> Result<Option<RobotKey>, AppError> {
        let mut tx = self.db().read("alerts").await?;
        let found = db::alerts::find(&mut tx, id).await?;
        Ok(found.and_then(|alert| alert.robot_key()))
    }

    /// Returns an alert.
    ///
    /// # Errors
    /// [`AppError::UnknownAlert`].
    pub async fn alert(&self, id: AlertId) -> Result<Alert, AppError> {
        if let Some(alert) = self.storage().alert(id) {
            return Ok(alert);
        }
        let mut tx = self.db().read("alerts").await?;
        let found = db::alerts::find(&mut tx, id).await?;
        found.ok_or(AppError::UnknownAlert(id))
    }

    /// Marks an alert as acknowledged by a person. This also clears an alert about a mission that
    /// did not succeed, and the note about a restart of the server.
    pub async fn acknowledge_alert(&self, id: AlertId) -> Result<Alert, AppError> {
        if let Some(alert) = self.storage().acknowledge(id, self.clock().now()) {
            self.hub().alert(&alert);
            if alert.cleared_at.is_none() && alert.code.as_str() == SERVER_RESTARTED_ALERT {
                self.set_server_alert(SERVER_RESTARTED_ALERT, Severity::Warning, None);
                return Ok(self.storage().alert(id).unwrap_or(alert));
            }
            return Ok(alert);
        }
        let mut tx = self.db().write_uncounted("alerts").await?;
        db::alerts::acknowledge(&mut tx, id, self.clock().now()).await?;
        let found = db::alerts::find(&mut tx, id).await?;
        let mut alert = found.ok_or(AppError::UnknownAlert(id))?;
        if MISSION_ALERTS.contains(&alert.code.as_str()) && alert.cleared_at.is_none() {
            let now = self.clock().now();
            let robot_pk = match alert.robot_key() {
                Some((site, robot)) => db::robots::pk_of(&mut tx, &site, &robot).await?,
                None => None,
            };
            if let Some(robot_pk) = robot_pk {
                db::alerts::clear(&mut tx, robot_pk, &alert.code, now).await?;
            }
            alert = db::alerts::find(&mut tx, id).await?.unwrap_or(alert);
            self.queue_alert(&mut tx, NoticeEvent::Ended, &alert)
                .await?;
        }
        self.commit_alerts(tx, vec![alert.clone()]).await?;
        Ok(alert)
    }

    /// Stores the alerts that robots have raised or cleared in their reports since the last call.
    pub(super) async fn sync_alerts(&self) -> Result<(), AppError> {
        for (key, said) in self.presences().take_alert_changes() {
            match self.sync_alerts_of(&key, &said).await {
                Ok(true) => {}
                // A robot may report alerts before its hello.
                Ok(false) => self.presences().return_alert_change(&key),
                Err(error) => {
                    self.presences().return_alert_change(&key);
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    /// Returns false if the robot is not known yet, or if its allowance did not cover all new
    /// alerts.
    async fn sync_alerts_of(
        &self,
        key: &RobotKey,
        reported: &[AlertReport],
    ) -> Result<bool, AppError> {
        let reported = &reported[..reported.len().min(ALERTS_MAX)];
        let mut tx = self.db().read("alerts").await?;
        let Some(site) = db::sites::find(&mut tx, &key.0).await? else {
            return Ok(false);
        };
        let Some(robot) = db::robots::find(&mut tx, site.pk, &key.1).await? else {
            return Ok(false);
        };
        let raised = db::alerts::raised_of(&mut tx, robot.pk).await?;
        drop(tx);
        let has = |alert: &Alert| reported.iter().any(|report| report.code == alert.code);
        let is_new = |report: &&AlertReport| !raised.iter().any(|alert| alert.code == report.code);
        // A robot cannot clear an alert that the server itself raised.
        let own = |alert: &&Alert| OWN_ALERTS.contains(&alert.code.as_str());
        let ended = raised.iter().filter(|alert| !has(alert) && !own(alert));
        let ended: Vec<&Alert> = ended.collect();
        // An alert beyond the allowance is tried again until it is raised or no longer reported.
        let (mut new, mut has_all) = (Vec::new(), true);
        for report in reported.iter().filter(is_new) {
            let elapsed = self.clock().elapsed();
            if self.allowances().take_alert(key, &report.code, elapsed) {
                new.push(report);
            } else {
                has_all = false;
            }
        }
        if ended.is_empty() && new.is_empty() {
            return Ok(has_all);
        }
        let mut alerts = Vec::new();
        let mut tx = self.db().write_uncounted("alerts").await?;
        for alert in ended {
            let ended = self.end(&mut tx, robot.pk, alert).await?;
            alerts.extend(ended);
        }
        for report in new {
            let raised = self.raise(&mut tx, robot.pk, report, None).await?;
            alerts.extend(raised);
        }
        self.commit_alerts(tx, alerts).await?;
        Ok(has_all)
    }

    /// Raises the alert of a mission that did not succeed and clears that of an earlier one of the
    /// same kind. A mission that succeeds clears them all.
    pub(super) async fn alert_mission_end(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        (mission, state, reason): (MissionId, MissionState, &str),
    ) -> Result<Vec<Alert>, DbError> {
        let (raised, verb) = match state {
            MissionState::Failed => (Some(MISSION_FAILED_ALERT), "failed"),
            MissionState::Expired => (Some(MISSION_EXPIRED_ALERT), "expired"),
            MissionState::Rejected => (Some(MISSION_REJECTED_ALERT), "was rejected"),
            MissionState::Succeeded => (None, ""),
            MissionState::Queued
            | MissionState::Offered
            | MissionState::Active
            | MissionState::Paused
            | MissionState::Cancelling
            | MissionState::Cancelled => return Ok(Vec::new()),
        };
        let mut changed = Vec::new();
        for code in MISSION_ALERTS {
            if raised.is_none_or(|raised| raised == code) {
                changed.extend(self.end_alert(tx, robot_pk, code).await?);
            }
        }
        if let Some(code) = raised {
            let alert = OwnAlert {
                code,
                severity: Severity::Warning,
                text: format!("mission `{mission}` {verb}: {reason}"),
                mission: Some(mission),
            };
            changed.extend(self.begin_alert(tx, robot_pk, alert).await?);
        }
        Ok(changed)
    }

    /// Raises or clears the alerts of a mission after a robot's mission report was accepted.
    pub(super) async fn alert_report(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        report: &MissionReport,
        taken: &ReportEffect,
    ) -> Result<Vec<Alert>, DbError> {
        let Some((state, reason)) = &taken.ended else {
            return Ok(Vec::new());
        };
        let ended = (report.mission, *state, reason.as_str());
        self.alert_mission_end(tx, robot_pk, ended).await
    }

    /// Raises one of the server's own alerts about a robot, unless it is raised already.
    pub(super) async fn begin_alert(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        alert: OwnAlert,
    ) -> Result<Option<Alert>, DbError> {
        let Ok(code) = alert.code.parse::<AlertCode>() else {
            return Ok(None);
        };
        let raised = db::alerts::raised_of(tx, robot_pk).await?;
        if raised.iter().any(|alert| alert.code == code) {
            return Ok(None);
        }
        let report = AlertReport {
            code,
            severity: alert.severity,
            text: alert.text,
        };
        self.raise(tx, robot_pk, &report, alert.mission).await
    }

    /// Clears one of the server's own alerts about a robot.
    pub(super) async fn end_alert(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        code: &'static str,
    ) -> Result<Option<Alert>, DbError> {
        let raised = db::alerts::raised_of(tx, robot_pk).await?;
        let Some(alert) = raised.into_iter().find(|alert| alert.code.as_str() == code) else {
            return Ok(None);
        };
        self.end(tx, robot_pk, &alert).await
    }

    /// Clears the alerts about the presence and the work of a robot that is retired or revoked.
    pub(super) async fn end_work_alerts(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
    ) -> Result<Vec<Alert>, DbError> {
        let mut ended = Vec::new();
        for code in WORK_ALERTS {
            ended.extend(self.end_alert(tx, robot_pk, code).await?);
        }
        Ok(ended)
    }

    /// Clears an alert, and queues what webhooks are to be sent of it.
    async fn end(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        alert: &Alert,
    ) -> Result<Option<Alert>, DbError> {
        db::alerts::clear(tx, robot_pk, &alert.code, self.clock().now()).await?;
        let ended = db::alerts::find(tx, alert.id).await?;
        if let Some(ended) = &ended {
            self.queue_alert(tx, NoticeEvent::Ended, ended).await?;
        }
        Ok(ended)
    }

    /// Commits, and then publishes the alerts that were written, even if the caller is cancelled.
    pub(super) async fn commit_alerts(
        &self,
        tx: db::Tx,
        alerts: Vec<Alert>,
    ) -> Result<(), DbError> {
        let app = self.clone();
        tx.commit_then(move |outcome| {
            if outcome == Outcome::Written {
                app.show_alerts(&alerts);
            }
        })
        .await
    }

    /// Publishes alerts that were written to the feed of events.
    pub(super) fn show_alerts(&self, alerts: &[Alert]) {
        if !alerts.is_empty() {
            self.robots_changed();
            self.wake_webhooks();
        }
        for alert in alerts {
            self.hub().alert(alert);
        }
    }

    /// Stores an alert with its mission and place, and queues what webhooks are to be sent of it.
    async fn raise(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        report: &AlertReport,
        mission: Option<MissionId>,
    ) -> Result<Option<Alert>, DbError> {
        let now = self.clock().now();
        let id = self.clock().new_id::<AlertId>();
        let report = AlertReport {
            text: report.text.chars().take(ALERT_TEXT_MAX).collect(),
            ..report.clone()
        };
        db::alerts::raise(tx, robot_pk, id, &report, now).await?;
        db::alerts::prune(tx, robot_pk, KEPT_MAX).await?;
        let Some(mut alert) = db::alerts::find(tx, id).await? else {
            return Ok(None);
        };
        let shown = alert.robot_key().and_then(|key| self.location(&key));
        let shown = shown.unwrap_or_default();
        alert.mission = mission.or(shown.mission);
        alert.place = shown.place;
        if alert.mission.is_some() || alert.place.is_some() {
            let location = AlertLocation {
                mission: alert.mission,
                place: alert.place,
            };
            db::alerts::locate(tx, id, location).await?;
        }
        self.queue_alert(tx, NoticeEvent::Opened, &alert).await?;
        Ok(Some(alert))
    }

    /// Returns the mission and the position that a robot showed last.
    fn location(&self, key: &RobotKey) -> Option<AlertLocation> {
        let presence = self.presences().get(key);
        let state = presence.state()?;
        let place = state.pose.map(|pose| pose.value.position());
        Some(AlertLocation {
            mission: state.mission.map(|mission| mission.id),
            place: place.filter(|place| place.x_m.is_finite() && place.y_m.is_finite()),
        })
    }
}
