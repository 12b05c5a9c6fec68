//! Attendance of robots: which ones were on the network and have not left by themselves.

pub use tread_store::attendance::Expected;

use super::{Connection, EngineError, parse};

/// Returns the attendance of all robots, with whether their alert of this code is raised.
pub async fn all(db: &mut Connection, code: &str) -> Result<Vec<Expected>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT sites.id AS site, robots.id AS robot, robots.is_present AS "is_present: bool",
               EXISTS (SELECT 1 FROM alerts WHERE alerts.robot_pk = robots.pk
                   AND alerts.code = $1 AND alerts.cleared_at_us IS NULL) AS "is_alerted!: bool"
           FROM robots JOIN sites ON sites.pk = robots.site_pk ORDER BY robots.pk"#,
        code,
    );
    let rows = rows.fetch_all(db).await?;
    rows.into_iter()
        .map(|row| {
            Ok(Expected {
                site: parse("site", &row.site)?,
                robot: parse("robot", &row.robot)?,
                is_present: row.is_present,
                is_alerted: row.is_alerted,
            })
        })
        .collect()
}

/// Stores whether a robot is on the network.
pub async fn set_present(
    db: &mut Connection,
    robot_pk: i64,
    is_present: bool,
) -> Result<(), EngineError> {
    sqlx::query!(
        "UPDATE robots SET is_present = $1 WHERE pk = $2",
        is_present,
        robot_pk
    )
    .execute(db)
    .await?;
    Ok(())
}
