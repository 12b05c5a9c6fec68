//! Raw measurements that were removed after their retention; their names (`boot`, `seq`) are kept
//! as ranges.

use std::collections::HashSet;
use std::ops::RangeInclusive;

use futures_util::TryStreamExt as _;
use jiff::Timestamp;

pub use super::segment_rows::release_removed;
use super::segment_rows::remove_values;
use super::{Connection, EngineError, segment_ranges, to_us};

/// Returns the key of the last measurement that was received before a time and lies in a range that
/// begins at or before a key; `None` without such ones.
pub async fn last_before(
    db: &mut Connection,
    before: Timestamp,
    begins_until_pk: i64,
) -> Result<Option<i64>, EngineError> {
    let before_us = to_us(before);
    let last = sqlx::query_scalar!(
        r#"SELECT MAX(last_pk) AS "last: i64" FROM segment_ranges
           WHERE first_pk <= $1 AND received_at_us < $2"#,
        begins_until_pk,
        before_us,
    );
    Ok(last.fetch_one(db).await?)
}

/// Removes the measurements up to a key, and records their names. Returns how many they were, and the
/// runs of agents that they are of.
pub async fn remove(
    db: &mut Connection,
    until_pk: i64,
) -> Result<(u64, HashSet<i64>), EngineError> {
    let ranges = sqlx::query!(
        r#"SELECT first_pk AS "first_pk!", last_pk, first_seq, boot_pk FROM segment_ranges
           WHERE first_pk <= $1 ORDER BY first_pk"#,
        until_pk
    );
    let (mut removed, mut boots) = (0, HashSet::new());
    for range in ranges.fetch_all(&mut *db).await? {
        let last = range.last_pk.min(until_pk);
        removed += (last - range.first_pk).unsigned_abs() + 1;
        let seqs = range.first_seq..=range.first_seq + (last - range.first_pk);
        record(db, range.boot_pk, seqs).await?;
        boots.insert(range.boot_pk);
    }
    sqlx::query!(
        "DELETE FROM segment_ranges WHERE first_pk <= $1 AND last_pk <= $1",
        until_pk
    )
    .execute(&mut *db)
    .await?;
    // Of a range that remains in part, the first measurements go.
    sqlx::query!(
        "UPDATE segment_ranges SET first_seq = first_seq + (CAST($1 AS BIGINT) + 1 - first_pk),
             first_pk = CAST($1 AS BIGINT) + 1
         WHERE first_pk <= $1",
        until_pk
    )
    .execute(&mut *db)
    .await?;
    remove_values(db, until_pk).await?;
    Ok((removed, boots))
}

/// Records a range, joined with the ranges that it touches.
async fn record(
    db: &mut Connection,
    boot_pk: i64,
    seqs: RangeInclusive<i64>,
) -> Result<(), EngineError> {
    let (mut from, mut to) = seqs.into_inner();
    let touched = sqlx::query!(
        r#"DELETE FROM segments_removed
           WHERE boot_pk = $1 AND from_seq <= CAST($3 AS BIGINT) + 1
               AND to_seq >= CAST($2 AS BIGINT) - 1
           RETURNING from_seq AS "from_seq!", to_seq AS "to_seq!""#,
        boot_pk,
        from,
        to,
    );
    for row in touched.fetch_all(&mut *db).await? {
        from = from.min(row.from_seq);
        to = to.max(row.to_seq);
    }
    sqlx::query!(
        "INSERT INTO segments_removed (boot_pk, from_seq, to_seq) VALUES ($1, $2, $3)",
        boot_pk,
        from,
        to,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns the runs of agents with removed measurements.
pub async fn boots(db: &mut Connection) -> Result<HashSet<i64>, EngineError> {
    let rows = sqlx::query_scalar!(r#"SELECT DISTINCT boot_pk AS "pk!" FROM segments_removed"#);
    Ok(rows.fetch_all(db).await?.into_iter().collect())
}

/// Returns the removed ranges of a run's sequence numbers that touch a range, both ends included.
pub async fn within(
    db: &mut Connection,
    boot_pk: i64,
    seqs: RangeInclusive<i64>,
) -> Result<Vec<(i64, i64)>, EngineError> {
    let (from, to) = seqs.into_inner();
    let rows = sqlx::query!(
        "SELECT from_seq, to_seq FROM segments_removed WHERE boot_pk = $1 AND from_seq <= $2
         ORDER BY from_seq DESC",
        boot_pk,
        to,
    );
    let rows = rows.fetch(db);
    segment_ranges::ending_from(rows.map_ok(|row| (row.from_seq, row.to_seq)), from).await
}

/// Returns the largest removed sequence number of a run; `None` without removed measurements.
pub async fn newest_seq(db: &mut Connection, boot_pk: i64) -> Result<Option<i64>, EngineError> {
    let newest = sqlx::query_scalar!(
        "SELECT to_seq FROM segments_removed WHERE boot_pk = $1 ORDER BY from_seq DESC LIMIT 1",
        boot_pk
    );
    Ok(newest.fetch_optional(db).await?)
}
