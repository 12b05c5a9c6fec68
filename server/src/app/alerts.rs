//! Alerts: what robots say needs a person's attention, kept with its history.
//!
//! A robot says all its alerts in each state; the difference to what is raised here raises and
//! clears. A robot that is not heard clears nothing. Alerts about the server itself are those of
//! [`super::storage`].

use jiff::Timestamp;
use tread_api::ids::{AlertCode, AlertId};
use tread_api::page::Page;
use tread_api::robot::{ALERT_TEXT_MAX, ALERTS_MAX, Alert, AlertReport, Severity};

use super::enrolment::REVOKED_ALERT;
use super::stops::UNCONFIRMED_ALERT;
use super::{App, AppError, check_named, page};
use crate::db;
use crate::db::alerts::AlertFilter;
use crate::fleet::presence::RobotKey;

impl App {
    /// Alerts, newest first.
    pub async fn alerts(&self, filter: &AlertFilter, limit: u32) -> Result<Page<Alert>, AppError> {
        let mut tx = self.db().read().await?;
        check_named(&mut tx, filter.site.as_ref(), filter.robot.as_ref()).await?;
        let mut alerts = self.storage().alerts(filter);
        alerts.extend(db::alerts::list(&mut tx, filter, limit + 1).await?);
        alerts.sort_by_key(|alert| std::cmp::Reverse(alert.id));
        Ok(page(alerts, limit, |alert: &Alert| alert.id.to_string()))
    }

    /// Notes that a person has seen an alert.
    pub async fn acknowledge_alert(&self, id: AlertId) -> Result<Alert, AppError> {
        if let Some(alert) = self.storage().acknowledge(id, self.clock().now()) {
            self.hub().alert(&alert);
            return Ok(alert);
        }
        let mut tx = self.db().write().await?;
        db::alerts::acknowledge(&mut tx, id, self.clock().now()).await?;
        let found = db::alerts::find(&mut tx, id).await?;
        let alert = found.ok_or(AppError::UnknownAlert(id))?;
        tx.commit().await?;
        self.robots_changed();
        self.hub().alert(&alert);
        Ok(alert)
    }

    /// Writes down what robots have begun or ceased to say.
    pub(super) async fn sync_alerts(&self) -> Result<(), AppError> {
        for (key, said) in self.presences().take_alert_changes() {
            match self.sync_alerts_of(&key, &said).await {
                Ok(true) => {}
                // A robot may speak before it has introduced itself.
                Ok(false) => self.presences().return_alert_change(&key),
                Err(error) => {
                    self.presences().return_alert_change(&key);
                    return Err(error);
                }
            }
        }
        Ok(())
    }

    /// False for a robot that is not known yet.
    async fn sync_alerts_of(&self, key: &RobotKey, said: &[AlertReport]) -> Result<bool, AppError> {
        let said = &said[..said.len().min(ALERTS_MAX)];
        let mut tx = self.db().read().await?;
        let Some(site) = db::sites::find(&mut tx, &key.0).await? else {
            return Ok(false);
        };
        let Some(robot) = db::robots::find(&mut tx, site.pk, &key.1).await? else {
            return Ok(false);
        };
        let raised = db::alerts::raised_of(&mut tx, robot.pk).await?;
        drop(tx);
        let now = self.clock().now();
        let has = |alert: &Alert| said.iter().any(|report| report.code == alert.code);
        let is_new = |report: &&AlertReport| !raised.iter().any(|alert| alert.code == report.code);
        // What the server itself has raised is not for the robot to end.
        let own =
            |alert: &&Alert| [UNCONFIRMED_ALERT, REVOKED_ALERT].contains(&alert.code.as_str());
        let gone = raised.iter().filter(|alert| !has(alert) && !own(alert));
        let gone: Vec<&Alert> = gone.collect();
        let new: Vec<&AlertReport> = said.iter().filter(is_new).collect();
        if gone.is_empty() && new.is_empty() {
            return Ok(true);
        }
        let mut changed = Vec::new();
        let mut tx = self.db().write().await?;
        for alert in gone {
            db::alerts::clear(&mut tx, robot.pk, &alert.code, now).await?;
            changed.push(alert.id);
        }
        for report in new {
            let id = self.raise(&mut tx, robot.pk, report, now).await?;
            changed.push(id);
        }
        let mut alerts = Vec::new();
        for id in changed {
            alerts.extend(db::alerts::find(&mut tx, id).await?);
        }
        tx.commit().await?;
        self.robots_changed();
        for alert in &alerts {
            self.hub().alert(alert);
        }
        Ok(true)
    }

    /// Raises an alert of the server's own about a robot, unless it is raised already.
    pub(super) async fn begin_alert(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        (code, severity, text): (&'static str, Severity, String),
    ) -> Result<Option<Alert>, AppError> {
        let Ok(code) = code.parse::<AlertCode>() else {
            return Ok(None);
        };
        let raised = db::alerts::raised_of(tx, robot_pk).await?;
        if raised.iter().any(|alert| alert.code == code) {
            return Ok(None);
        }
        let report = AlertReport {
            code,
            severity,
            text,
        };
        let id = self
            .raise(tx, robot_pk, &report, self.clock().now())
            .await?;
        Ok(db::alerts::find(tx, id).await?)
    }

    /// Ends an alert of the server's own.
    pub(super) async fn end_alert(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        code: &'static str,
    ) -> Result<Option<Alert>, AppError> {
        let raised = db::alerts::raised_of(tx, robot_pk).await?;
        let Some(alert) = raised.into_iter().find(|alert| alert.code.as_str() == code) else {
            return Ok(None);
        };
        db::alerts::clear(tx, robot_pk, &alert.code, self.clock().now()).await?;
        Ok(db::alerts::find(tx, alert.id).await?)
    }

    /// Shows alerts that were written.
    pub(super) fn show_alerts(&self, alerts: &[Alert]) {
        if !alerts.is_empty() {
            self.robots_changed();
        }
        for alert in alerts {
            self.hub().alert(alert);
        }
    }

    async fn raise(
        &self,
        tx: &mut db::Tx,
        robot_pk: i64,
        report: &AlertReport,
        now: Timestamp,
    ) -> Result<AlertId, AppError> {
        let id = AlertId::from_uuid(self.clock().mission_id().as_uuid());
        let report = AlertReport {
            text: report.text.chars().take(ALERT_TEXT_MAX).collect(),
            ..report.clone()
        };
        db::alerts::raise(tx, robot_pk, id, &report, now).await?;
        Ok(id)
    }
}
