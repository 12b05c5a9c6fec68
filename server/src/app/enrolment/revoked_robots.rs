//! Alerts about revoked robots that continue to connect, at a limited rate.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tread_api::enrolment::Enrolment;
use tread_api::robot::{Alert, Severity};

use super::registry::EnrolmentStatus;
use crate::app::own_alert::OwnAlert;
use crate::app::presence::RobotKey;
use crate::app::{App, AppError};
use crate::authority::RobotName;
use crate::db::{self, Tx};

/// Code of the alert about a revoked robot that still tries to connect.
pub(in crate::app) const REVOKED_ALERT: &str = "revoked-robot";
/// Code of the alert about a robot whose certificate was signed by a retired authority.
pub(in crate::app) const RETIRED_ALERT: &str = "retired-authority";
/// Code of the alert about a robot for which a certificate was shown that this server did not
/// issue.
pub(in crate::app) const UNISSUED_ALERT: &str = "unknown-certificate";
/// Minimum interval between two notes about one robot.
const NOTED_EVERY: Duration = Duration::from_mins(1);

/// Time of the last note by robot, since the start of the server. At most one entry for each robot
/// that has ever joined.
#[derive(Debug, Default)]
pub(super) struct RevokedRobots(Mutex<HashMap<RobotKey, Duration>>);

impl RevokedRobots {
    fn is_due(&self, key: &RobotKey, now: Duration) -> bool {
        let mut noted = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let last = noted.get(key);
        let is_due = last.is_none_or(|&last| now.saturating_sub(last) >= NOTED_EVERY);
        if is_due {
            noted.insert(key.clone(), now);
        }
        is_due
    }

    fn remove(&self, key: &RobotKey) {
        let mut noted = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        noted.remove(key);
    }
}

impl App {
    /// Returns whether a robot's messages are accepted. If not, counts the refusal, and raises an
    /// alert for a revoked robot.
    pub fn admits(&self, key: &RobotKey) -> bool {
        if self.enrolment_registry().may_send(key) {
            return true;
        }
        match self.enrolment_registry().status(key) {
            Some(_) => {
                self.counters().refused_revoked_robot.one();
                self.alert_revoked(key);
            }
            None => self.counters().refused_unenrolled_robot.one(),
        }
        false
    }

    /// Raises an alert if the robot is revoked and still tries to connect.
    pub fn alert_revoked(&self, key: &RobotKey) {
        let is_out = matches!(
            self.enrolment_registry().status(key),
            Some(EnrolmentStatus::Revoked(_))
        );
        if is_out {
            let text = "it was put out of the fleet and still tries to connect".to_owned();
            self.warn_and_alert(key, REVOKED_ALERT, text);
        }
    }

    /// Raises an alert that the robot's certificate was signed by a retired authority.
    pub(super) fn alert_retired_authority(&self, name: &RobotName) {
        let key = (name.site.clone(), name.robot.clone());
        if self.enrolment_registry().is_in_force(&key, name.enrolment) {
            let text =
                "its certificate is of an authority that was retired; it must join again by a \
                        join token that names it"
                    .to_owned();
            self.warn_and_alert(&key, RETIRED_ALERT, text);
        }
    }

    /// Raises an alert about a certificate that this server did not issue: somebody else has the
    /// authority's key, or an old copy of the robot's data is in use.
    pub(super) fn alert_unissued_certificate(&self, name: &RobotName) {
        let key = (name.site.clone(), name.robot.clone());
        let text = "a certificate was shown for a renewal that this server did not give, or gave long ago: \
                    the authority's key may be stolen, or an old copy of the robot's disk or of the \
                    server's database is in use"
            .to_owned();
        self.warn_and_alert(&key, UNISSUED_ALERT, text);
    }

    /// Clears a robot's alert about an unissued certificate.
    pub(super) async fn end_unissued(
        &self,
        tx: &mut Tx,
        name: &RobotName,
    ) -> Result<Vec<Alert>, AppError> {
        let key = (name.site.clone(), name.robot.clone());
        let Some(robot_pk) = robot_pk(tx, &key).await? else {
            return Ok(Vec::new());
        };
        let ended = self.end_alert(tx, robot_pk, UNISSUED_ALERT).await?;
        Ok(ended.into_iter().collect())
    }

    /// Logs a warning about a robot and raises its alert in the background, at most once per
    /// interval.
    fn warn_and_alert(&self, key: &RobotKey, code: &'static str, text: String) {
        let revoked_robots = &self.membership().revoked_robots;
        if !revoked_robots.is_due(key, self.clock().elapsed()) {
            return;
        }
        let (site, robot) = key;
        tracing::warn!(robot.id = %robot, "robot `{robot}` of site `{site}`: {text}");
        let (app, key) = (self.clone(), key.clone());
        let raising = async move {
            if let Err(error) = db::limited(app.raise_credential_alert(&key, code, text)).await {
                app.log_failure("raise an alert about a robot that may not connect", &error);
            }
        };
        // The task that reads all robots' messages must not wait for the database.
        self.supervisor().spawn_passing("revoked robot", raising);
    }

    async fn raise_credential_alert(
        &self,
        key: &RobotKey,
        code: &'static str,
        text: String,
    ) -> Result<(), AppError> {
        let mut tx = self.db().write("enrolment").await?;
        let Some(robot_pk) = robot_pk(&mut tx, key).await? else {
            return Ok(());
        };
        let alert = OwnAlert {
            code,
            severity: Severity::Warning,
            text,
            mission: None,
        };
        let raised = self.begin_alert(&mut tx, robot_pk, alert).await?;
        Ok(self.commit_alerts(tx, raised.into_iter().collect()).await?)
    }

    /// Clears the alerts of a robot that has joined again.
    pub(super) async fn end_credential_alerts(
        &self,
        tx: &mut Tx,
        enrolment: &Enrolment,
    ) -> Result<Vec<Alert>, AppError> {
        let key = (enrolment.site.clone(), enrolment.robot.clone());
        self.membership().revoked_robots.remove(&key);
        let Some(robot_pk) = robot_pk(tx, &key).await? else {
            return Ok(Vec::new());
        };
        let mut ended = Vec::new();
        for code in [REVOKED_ALERT, RETIRED_ALERT, UNISSUED_ALERT] {
            ended.extend(self.end_alert(tx, robot_pk, code).await?);
        }
        Ok(ended)
    }
}

async fn robot_pk(tx: &mut Tx, (site, robot): &RobotKey) -> Result<Option<i64>, AppError> {
    let Some(site) = db::sites::find(tx, site).await? else {
        return Ok(None);
    };
    let row = db::robots::find(tx, site.pk, robot).await?;
    Ok(row.map(|row| row.pk))
}
