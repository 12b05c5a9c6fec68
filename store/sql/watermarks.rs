//! Watermarks: up to which raw measurement those of a robot are in the stored sums.

use std::collections::HashMap;

pub use tread_store::watermarks::WatermarkStep;

use super::{Connection, EngineError, corrupt};

/// Moves a watermark.
///
/// # Errors
/// The stored watermark is another one, so the sums of the step may be stored already.
pub async fn advance(db: &mut Connection, step: WatermarkStep) -> Result<(), EngineError> {
    let WatermarkStep {
        robot_pk,
        from_pk,
        to_pk,
    } = step;
    let done = sqlx::query!(
        "INSERT INTO watermarks (robot_pk, segment_pk) VALUES ($1, $3)
         ON CONFLICT (robot_pk) DO UPDATE SET segment_pk = excluded.segment_pk
             WHERE watermarks.segment_pk = $2",
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
pub async fn all(db: &mut Connection) -> Result<HashMap<i64, i64>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT robot_pk AS "robot_pk!", segment_pk AS "segment_pk!" FROM watermarks"#
    );
    let rows = rows.fetch_all(db).await?;
    Ok(rows
        .into_iter()
        .map(|row| (row.robot_pk, row.segment_pk))
        .collect())
}
