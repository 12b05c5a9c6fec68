//! Raw measurements that were removed after their retention; their names (`boot`, `seq`) are kept
//! as ranges.

use std::collections::{BTreeMap, HashSet};

use futures_util::TryStreamExt as _;
use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::{DbError, to_us};

/// A raw measurement to be removed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Oldest {
    /// Its key; keys are in the order of commits.
    pub pk: i64,
    /// Key of the run of the agent.
    pub boot_pk: i64,
    /// Its sequence number within that run.
    pub seq: i64,
    /// Time at which it was received, microseconds since 1970.
    pub received_at_us: i64,
}

/// Returns at most `limit` of the oldest measurements that were received before a time or lie
/// before a key.
///
/// Keys increase with commits, so later measurements have larger ones.
pub async fn oldest(
    db: &mut SqliteConnection,
    before: Timestamp,
    before_pk: i64,
    limit: u32,
) -> Result<Vec<Oldest>, DbError> {
    let rows = sqlx::query_as!(
        Oldest,
        r#"SELECT pk AS "pk!", boot_pk, seq, received_at_us FROM segments
           ORDER BY pk LIMIT ?"#,
        limit,
    );
    let mut rows = rows.fetch_all(db).await?;
    let before_us = to_us(before);
    let is_over = |row: &Oldest| row.received_at_us < before_us || row.pk < before_pk;
    let over = rows.iter().take_while(|row| is_over(row)).count();
    rows.truncate(over);
    Ok(rows)
}

/// Returns the last key; `None` without measurements.
pub async fn last_key(db: &mut SqliteConnection) -> Result<Option<i64>, DbError> {
    let last = sqlx::query_scalar!(r#"SELECT MAX(pk) AS "last: i64" FROM segments"#);
    Ok(last.fetch_one(db).await?)
}

/// Removes measurements, and records their names.
pub async fn remove(db: &mut SqliteConnection, rows: &[Oldest]) -> Result<(), DbError> {
    let Some(last) = rows.last() else {
        return Ok(());
    };
    let mut seqs: BTreeMap<i64, Vec<i64>> = BTreeMap::new();
    for row in rows {
        seqs.entry(row.boot_pk).or_default().push(row.seq);
    }
    for (boot_pk, mut seqs) in seqs {
        seqs.sort_unstable();
        for run in seqs.chunk_by(|left, right| left + 1 == *right) {
            if let (Some(&from), Some(&to)) = (run.first(), run.last()) {
                note(db, boot_pk, (from, to)).await?;
            }
        }
    }
    sqlx::query!("DELETE FROM segments WHERE pk <= ?", last.pk)
        .execute(db)
        .await?;
    Ok(())
}

/// Records a range, joined with the ranges that it touches.
async fn note(
    db: &mut SqliteConnection,
    boot_pk: i64,
    (mut from, mut to): (i64, i64),
) -> Result<(), DbError> {
    let touched = sqlx::query!(
        r#"DELETE FROM segments_removed
           WHERE boot_pk = ?1 AND from_seq <= ?3 + 1 AND to_seq >= ?2 - 1
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
        "INSERT INTO segments_removed (boot_pk, from_seq, to_seq) VALUES (?, ?, ?)",
        boot_pk,
        from,
        to,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns the runs of agents with removed measurements.
pub async fn boots(db: &mut SqliteConnection) -> Result<HashSet<i64>, DbError> {
    let rows = sqlx::query_scalar!(r#"SELECT DISTINCT boot_pk AS "pk!" FROM segments_removed"#);
    Ok(rows.fetch_all(db).await?.into_iter().collect())
}

/// Returns the removed ranges of a run's sequence numbers that touch a range, both ends included.
pub async fn within(
    db: &mut SqliteConnection,
    boot_pk: i64,
    (from, to): (i64, i64),
) -> Result<Vec<(i64, i64)>, DbError> {
    // In descending order: the ranges do not overlap, so the search ends at the first that ends too
    // early.
    let mut rows = sqlx::query!(
        "SELECT from_seq, to_seq FROM segments_removed WHERE boot_pk = ? AND from_seq <= ?
         ORDER BY from_seq DESC",
        boot_pk,
        to,
    )
    .fetch(db);
    let mut found = Vec::new();
    while let Some(row) = rows.try_next().await? {
        if row.to_seq < from {
            break;
        }
        found.push((row.from_seq, row.to_seq));
    }
    Ok(found)
}
