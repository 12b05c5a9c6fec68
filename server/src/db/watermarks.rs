//! Watermarks: up to which raw measurement those of a robot are in the stored sums.

use std::collections::HashMap;

use futures_util::TryStreamExt as _;
use sqlx::SqliteConnection;
use tread_api::friction::Segment;

use super::{DbError, corrupt, from_json};

/// Step of a robot's watermark, from the key of one raw measurement to that of a later one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WatermarkStep {
    /// Key of the robot.
    pub robot_pk: i64,
    /// The stored watermark; 0 if there is none.
    pub from_pk: i64,
    /// The next watermark.
    pub to_pk: i64,
}

/// Moves a watermark.
///
/// # Errors
/// The stored watermark is another one, so the sums of the step may be stored already.
pub async fn advance(db: &mut SqliteConnection, step: WatermarkStep) -> Result<(), DbError> {
    let WatermarkStep {
        robot_pk,
        from_pk,
        to_pk,
    } = step;
    let done = sqlx::query!(
        "INSERT INTO watermarks (robot_pk, segment_pk) VALUES (?1, ?3)
         ON CONFLICT (robot_pk) DO UPDATE SET segment_pk = excluded.segment_pk
             WHERE segment_pk = ?2",
        robot_pk,
        from_pk,
        to_pk,
    )
    .execute(db)
    .await?;
    if done.rows_affected() == 1 {
        Ok(())
    } else {
        Err(corrupt("watermark that was moved by others", from_pk))
    }
}

/// Returns all watermarks by the keys of their robots.
pub async fn all(db: &mut SqliteConnection) -> Result<HashMap<i64, i64>, DbError> {
    let rows = sqlx::query!(
        r#"SELECT robot_pk AS "robot_pk!", segment_pk AS "segment_pk!" FROM watermarks"#
    );
    let rows = rows.fetch_all(db).await?;
    Ok(rows
        .into_iter()
        .map(|row| (row.robot_pk, row.segment_pk))
        .collect())
}

/// A raw measurement that follows the watermark of its robot.
#[derive(Debug)]
pub struct Following {
    /// Its key.
    pub pk: i64,
    /// Key of the robot.
    pub robot_pk: i64,
    /// Key of the site.
    pub site_pk: i64,
    /// The measurement.
    pub segment: Segment,
}

/// Calls `take` with every raw measurement that follows the watermark of its robot, robot by robot,
/// each in the order of commits.
///
/// # Errors
/// The database failed, a measurement is damaged, or `take` failed.
pub async fn following(
    db: &mut SqliteConnection,
    mut take: impl FnMut(Following) -> Result<(), DbError>,
) -> Result<(), DbError> {
    // A cross join keeps its order: each robot's measurements are found by the index of robots.
    let mut rows = sqlx::query!(
        r#"SELECT segments.pk AS "pk!", segments.robot_pk AS "robot_pk!",
               segments.site_pk AS "site_pk!", segments.measurement AS "measurement!"
           FROM robots LEFT JOIN watermarks ON watermarks.robot_pk = robots.pk
           CROSS JOIN segments
           WHERE segments.robot_pk = robots.pk
               AND segments.pk > COALESCE(watermarks.segment_pk, 0)"#
    )
    .fetch(db);
    while let Some(row) = rows.try_next().await? {
        take(Following {
            pk: row.pk,
            robot_pk: row.robot_pk,
            site_pk: row.site_pk,
            segment: from_json("measurement", &row.measurement)?,
        })?;
    }
    Ok(())
}
