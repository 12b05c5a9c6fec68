//! The mark of the archive: first and last key of the segments that were archived without a gap.

use std::ops::RangeInclusive;

use super::{Connection, EngineError};

/// Returns the first and the last key of the measurements that were archived without a gap; `None` if
/// none was.
pub async fn get(db: &mut Connection) -> Result<Option<(i64, i64)>, EngineError> {
    let mark = sqlx::query!("SELECT first_pk, last_pk FROM archive_mark WHERE id = 1");
    let mark = mark.fetch_optional(db).await?;
    Ok(mark.map(|row| (row.first_pk, row.last_pk)))
}

/// Replaces the mark.
pub async fn set(db: &mut Connection, keys: RangeInclusive<i64>) -> Result<(), EngineError> {
    let (first, last) = keys.into_inner();
    sqlx::query!(
        "INSERT INTO archive_mark (id, first_pk, last_pk) VALUES (1, $1, $2)
         ON CONFLICT (id) DO UPDATE SET first_pk = excluded.first_pk, last_pk = excluded.last_pk",
        first,
        last,
    )
    .execute(db)
    .await?;
    Ok(())
}
