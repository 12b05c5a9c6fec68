//! Partitions of the table with the values of measurements, each for a range of keys.
//!
//! A partition is as wide as the number of measurements of a week, within bounds: so a database has few
//! partitions, and retention, which drops them as a whole, keeps values little longer than it must. The
//! ledger ([`super::segment_ranges`]) says which measurements there are; values of others are never read.

use std::ops::RangeInclusive;
use std::time::Duration;

use jiff::SignedDuration;
use sqlx::AssertSqlSafe;
use tread_store::failure::StorageFailure;

use super::{Connection, EngineError, failure, from_us, segment_ranges};

/// Smallest number of keys of a partition.
const KEYS_MIN: i64 = 1_000_000;
/// Largest number of keys of a partition; about 9 GB.
const KEYS_MAX: i64 = 50_000_000;
/// Time whose measurements a partition should have.
const SPAN: SignedDuration = SignedDuration::from_hours(7 * 24);
/// Age of a snapshot from which it may be older than the removal of what is dropped; less than the interval
/// of the removals.
const SNAPSHOT_MAX: Duration = Duration::from_mins(9);
/// Maximum time for which the drop of a partition waits for readers; others wait behind it.
const LOCK_TIMEOUT: &str = "SET LOCAL lock_timeout = '1s'";

/// Creates the partitions that these keys need, of which all earlier ones have theirs.
pub(super) async fn prepare(
    db: &mut Connection,
    keys: RangeInclusive<i64>,
) -> Result<(), EngineError> {
    let (first, last) = keys.into_inner();
    let end = sqlx::query_scalar!(
        "SELECT last_pk FROM segment_partitions ORDER BY first_pk DESC LIMIT 1"
    );
    let end = end.fetch_optional(&mut *db).await?;
    if end.is_some_and(|end| last <= end) {
        return Ok(());
    }
    let count = keys_of_span(db).await?.clamp(KEYS_MIN, KEYS_MAX);
    let mut next = end.map_or(first, |end| end + 1);
    while next <= last {
        let end = next.saturating_add(count) - 1;
        add(db, next..=end).await?;
        next = end + 1;
    }
    Ok(())
}

/// Returns how many measurements were received in the [`SPAN`] before the last one.
async fn keys_of_span(db: &mut Connection) -> Result<i64, EngineError> {
    let Some((last, received_at_us)) = segment_ranges::last(db).await? else {
        return Ok(0);
    };
    let begin = from_us(received_at_us)?.checked_sub(SPAN);
    let first = match begin {
        Ok(begin) => segment_ranges::first_since(db, begin).await?,
        Err(_before_all_times) => None,
    };
    let ends = segment_ranges::ends(db).await?;
    let first = first.or(ends.map(|(first, _)| first));
    Ok(first.map_or(0, |first| last - first + 1))
}

/// Creates a partition. It is attached after its creation, which does not wait for readers.
pub(super) async fn add(db: &mut Connection, keys: RangeInclusive<i64>) -> Result<(), EngineError> {
    let (first, last) = keys.into_inner();
    let end = last.saturating_add(1);
    for statement in [
        format!(
            "CREATE TABLE segment_values_{first}
                 (LIKE segment_values INCLUDING CONSTRAINTS INCLUDING INDEXES)"
        ),
        format!(
            "ALTER TABLE segment_values ATTACH PARTITION segment_values_{first}
                 FOR VALUES FROM ({first}) TO ({end})"
        ),
    ] {
        let creating = sqlx::query(AssertSqlSafe(statement)).persistent(false);
        creating.execute(&mut *db).await?;
    }
    sqlx::query!(
        "INSERT INTO segment_partitions (first_pk, last_pk) VALUES ($1, $2)",
        first,
        last
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Drops the partitions without measurements in the ledger. Returns how many; `None` if readers kept a
/// lock for too long, then the transaction must end without a commit.
///
/// A snapshot that is older than the removal of their measurements would miss values, so nothing is dropped
/// while a transaction is open since [`SNAPSHOT_MAX`]. Call this before a removal and not after it.
pub async fn drop_removed(db: &mut Connection) -> Result<Option<u64>, EngineError> {
    let Some((first, _last)) = segment_ranges::ends(db).await? else {
        return Ok(Some(0));
    };
    let unused = sqlx::query_scalar!(
        "SELECT first_pk FROM segment_partitions WHERE last_pk < $1 ORDER BY first_pk",
        first
    );
    let unused = unused.fetch_all(&mut *db).await?;
    if unused.is_empty() {
        return Ok(Some(0));
    }
    let is_read = sqlx::query_scalar!(
        r#"SELECT EXISTS (SELECT 1 FROM pg_stat_activity
               WHERE datname = current_database() AND pid <> pg_backend_pid()
                   AND backend_type = 'client backend'
                   AND xact_start < now() - make_interval(secs => $1)) AS "is_read!""#,
        SNAPSHOT_MAX.as_secs_f64(),
    );
    if is_read.fetch_one(&mut *db).await? {
        return Ok(None);
    }
    sqlx::query(LOCK_TIMEOUT).execute(&mut *db).await?;
    for first in &unused {
        let statement = format!("DROP TABLE IF EXISTS segment_values_{first}");
        let dropping = sqlx::query(AssertSqlSafe(statement)).persistent(false);
        match dropping.execute(&mut *db).await {
            Ok(_) => {}
            // No lock in time, or none ever.
            Err(error) if failure::of(&error) == Some(StorageFailure::Busy) => return Ok(None),
            Err(error) => return Err(error.into()),
        }
    }
    sqlx::query!("DELETE FROM segment_partitions WHERE last_pk < $1", first)
        .execute(db)
        .await?;
    Ok(Some(unused.len() as u64))
}
