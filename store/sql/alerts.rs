//! Alerts of robots: raised, acknowledged, cleared.

use jiff::Timestamp;
use tread_api::geometry::Point;
use tread_api::ids::{AlertCode, AlertId, RobotId, SiteId};
use tread_api::robot::{Alert, AlertReport, Severity};
pub use tread_store::alerts::{AlertFilter, AlertLocation};

use super::{Connection, EngineError, corrupt, from_us, parse, scope_text, to_us};

struct Raw {
    id: String,
    site: String,
    robot: String,
    code: String,
    severity: String,
    text: String,
    mission_id: Option<String>,
    x_m: Option<f64>,
    y_m: Option<f64>,
    raised_at_us: i64,
    acknowledged_at_us: Option<i64>,
    cleared_at_us: Option<i64>,
}

impl TryFrom<Raw> for Alert {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        let severity = Severity::from_name(&raw.severity);
        let mission = raw.mission_id.map(|mission| parse("mission", &mission));
        let place = raw.x_m.zip(raw.y_m);
        Ok(Self {
            id: parse("alert", &raw.id)?,
            site: Some(parse("site", &raw.site)?),
            robot: Some(parse("robot", &raw.robot)?),
            code: parse("alert code", &raw.code)?,
            severity: severity.ok_or_else(|| corrupt("severity", &raw.severity))?,
            text: raw.text,
            mission: mission.transpose()?,
            place: place.map(|(x_m, y_m)| Point { x_m, y_m }),
            raised_at: from_us(raw.raised_at_us)?,
            acknowledged_at: raw.acknowledged_at_us.map(from_us).transpose()?,
            cleared_at: raw.cleared_at_us.map(from_us).transpose()?,
        })
    }
}

macro_rules! alerts {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT alerts.id, sites.id AS site, robots.id AS robot, alerts.code,
                   alerts.severity, alerts.text, alerts.mission_id, alerts.x_m, alerts.y_m,
                   alerts.raised_at_us, alerts.acknowledged_at_us, alerts.cleared_at_us
               FROM alerts
               JOIN robots ON robots.pk = alerts.robot_pk
               JOIN sites ON sites.pk = robots.site_pk "# + $condition
            $(, $argument)*
        )
    };
}

fn rows(raw: Vec<Raw>) -> Result<Vec<Alert>, EngineError> {
    raw.into_iter().map(Alert::try_from).collect()
}

/// Returns alerts, newest first.
pub async fn list(
    db: &mut Connection,
    filter: &AlertFilter,
    limit: u32,
) -> Result<Vec<Alert>, EngineError> {
    let site = filter.site.as_ref().map(SiteId::as_str);
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let kind = filter.kind.as_ref().map(AlertCode::as_str);
    let before = filter.before.map(|id| id.to_string());
    let within = scope_text(&filter.within)?;
    let raw = alerts!(
        "WHERE (CAST($1 AS TEXT) IS NULL OR sites.id = $1) AND (CAST($2 AS TEXT) IS NULL OR robots.id = $2)
           AND ($3 = FALSE OR alerts.cleared_at_us IS NULL) AND (CAST($4 AS TEXT) IS NULL OR alerts.id < $4)
           AND (CAST($6 AS TEXT) IS NULL OR sites.id IN (SELECT value FROM json_each($6))
               OR sites.id || '/' || robots.id IN (SELECT value FROM json_each($6)))
           AND (CAST($7 AS TEXT) IS NULL OR alerts.code = $7)
         ORDER BY alerts.id DESC LIMIT $5",
        site,
        robot,
        filter.raised,
        before,
        i64::from(limit),
        within,
        kind,
    )
    .fetch_all(db)
    .await?;
    rows(raw)
}

/// Returns the alerts that are not cleared, oldest first, at most `limit`.
pub async fn raised(db: &mut Connection, limit: u32) -> Result<Vec<Alert>, EngineError> {
    let raw = alerts!(
        "WHERE alerts.cleared_at_us IS NULL ORDER BY alerts.id LIMIT $1",
        i64::from(limit),
    )
    .fetch_all(db)
    .await?;
    rows(raw)
}

/// Returns the robots about which this alert is raised.
pub async fn raised_about(
    db: &mut Connection,
    code: &str,
) -> Result<Vec<(SiteId, RobotId)>, EngineError> {
    let rows = sqlx::query!(
        "SELECT sites.id AS site, robots.id AS robot
         FROM alerts
         JOIN robots ON robots.pk = alerts.robot_pk
         JOIN sites ON sites.pk = robots.site_pk
         WHERE alerts.code = $1 AND alerts.cleared_at_us IS NULL",
        code,
    );
    let rows = rows.fetch_all(db).await?;
    let named = |site: &str, robot: &str| Ok((parse("site", site)?, parse("robot", robot)?));
    rows.iter()
        .map(|row| named(&row.site, &row.robot))
        .collect()
}

/// Returns a robot's alerts that are not cleared, oldest first.
pub async fn raised_of(db: &mut Connection, robot_pk: i64) -> Result<Vec<Alert>, EngineError> {
    let raw = alerts!(
        "WHERE alerts.robot_pk = $1 AND alerts.cleared_at_us IS NULL ORDER BY alerts.id",
        robot_pk
    )
    .fetch_all(db)
    .await?;
    rows(raw)
}

/// Returns an alert by its identifier.
pub async fn find(db: &mut Connection, id: AlertId) -> Result<Option<Alert>, EngineError> {
    let id = id.to_string();
    let raw = alerts!("WHERE alerts.id = $1", id)
        .fetch_optional(db)
        .await?;
    raw.map(Alert::try_from).transpose()
}

/// Raises an alert; has no effect if the robot's alert of this code is raised already.
pub async fn raise(
    db: &mut Connection,
    robot_pk: i64,
    id: AlertId,
    report: &AlertReport,
    at: Timestamp,
) -> Result<(), EngineError> {
    let (id, code, severity) = (
        id.to_string(),
        report.code.as_str(),
        report.severity.as_str(),
    );
    let at_us = to_us(at);
    sqlx::query!(
        "INSERT INTO alerts (id, robot_pk, code, severity, text, raised_at_us)
         VALUES ($1, $2, $3, $4, $5, $6) ON CONFLICT DO NOTHING",
        id,
        robot_pk,
        code,
        severity,
        report.text,
        at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Stores mission and place of an alert.
pub async fn locate(
    db: &mut Connection,
    id: AlertId,
    location: AlertLocation,
) -> Result<(), EngineError> {
    let id = id.to_string();
    let mission = location.mission.map(|mission| mission.to_string());
    let place = location.place;
    let (x_m, y_m) = (place.map(|place| place.x_m), place.map(|place| place.y_m));
    sqlx::query!(
        "UPDATE alerts SET mission_id = $1, x_m = $2, y_m = $3 WHERE id = $4",
        mission,
        x_m,
        y_m,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Deletes a robot's oldest cleared alerts beyond `kept` alerts.
pub async fn prune(db: &mut Connection, robot_pk: i64, kept: u32) -> Result<(), EngineError> {
    sqlx::query!(
        "DELETE FROM alerts
         WHERE robot_pk = $1 AND cleared_at_us IS NOT NULL
           AND id <= (SELECT more.id FROM alerts AS more WHERE more.robot_pk = $1
               ORDER BY more.id DESC LIMIT 1 OFFSET $2)",
        robot_pk,
        i64::from(kept),
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Clears a robot's alert of this code, with a time not before it was raised or acknowledged.
pub async fn clear(
    db: &mut Connection,
    robot_pk: i64,
    code: &AlertCode,
    at: Timestamp,
) -> Result<(), EngineError> {
    let (code, at_us) = (code.as_str(), to_us(at));
    sqlx::query!(
        "UPDATE alerts
         SET cleared_at_us = MAX($1, COALESCE(acknowledged_at_us, raised_at_us), raised_at_us)
         WHERE robot_pk = $2 AND code = $3 AND cleared_at_us IS NULL",
        at_us,
        robot_pk,
        code,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Marks an alert as acknowledged; only the first time counts.
pub async fn acknowledge(
    db: &mut Connection,
    id: AlertId,
    at: Timestamp,
) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE alerts SET acknowledged_at_us = COALESCE(acknowledged_at_us, MAX(raised_at_us, $1))
         WHERE id = $2",
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}
