//! Deferred segments: measurements with times in the future, kept until the clock of their run is
//! known.

use serde_json::value::RawValue;
use tread_store::RecordKey;
pub use tread_store::deferred_segments::{DeferredFilter, DeferredSegment, DeferredTimes, Origin};

use super::{Connection, EngineError, from_json, to_us, unsigned};

/// Defers a segment; `false` if it is deferred or on the map already.
pub async fn put(
    db: &mut Connection,
    origin: Origin,
    times: DeferredTimes,
    measurement: &RawValue,
) -> Result<bool, EngineError> {
    let Origin {
        key: RecordKey { boot_pk, seq },
        site_pk,
        robot_pk,
    } = origin;
    let text = measurement.get();
    let done = sqlx::query!(
        "INSERT INTO deferred_segments
             (boot_pk, seq, site_pk, robot_pk, ended_at_us, received_at_us, measurement)
         SELECT CAST($1 AS BIGINT), CAST($2 AS BIGINT), CAST($3 AS BIGINT), CAST($4 AS BIGINT),
             CAST($5 AS BIGINT), CAST($6 AS BIGINT), CAST($7 AS TEXT)
         WHERE COALESCE((SELECT last_seq FROM segment_ranges WHERE boot_pk = $1 AND first_seq <= $2
                 ORDER BY first_seq DESC LIMIT 1) < $2, TRUE)
             AND NOT EXISTS (SELECT 1 FROM segments_removed
                 WHERE boot_pk = $1 AND $2 BETWEEN from_seq AND to_seq)
         ON CONFLICT DO NOTHING",
        boot_pk,
        seq,
        site_pk,
        robot_pk,
        to_us(times.ended_at),
        to_us(times.received_at),
        text,
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected() == 1)
}

/// Returns the number of a robot's deferred segments.
pub async fn count(db: &mut Connection, robot_pk: i64) -> Result<u64, EngineError> {
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM deferred_segments WHERE robot_pk = $1"#,
        robot_pk
    );
    unsigned("count", count.fetch_one(db).await?)
}

/// Returns whether there is any deferred segment.
pub async fn is_any(db: &mut Connection) -> Result<bool, EngineError> {
    let first = sqlx::query_scalar!("SELECT seq FROM deferred_segments LIMIT 1");
    Ok(first.fetch_optional(db).await?.is_some())
}

/// Removes and returns at most `limit` deferred segments.
pub async fn take(
    db: &mut Connection,
    filter: DeferredFilter,
    limit: u32,
) -> Result<Vec<DeferredSegment>, EngineError> {
    let rows = sqlx::query!(
        r#"DELETE FROM deferred_segments WHERE boot_pk = $1 AND seq IN (
               SELECT seq FROM deferred_segments WHERE boot_pk = $1 AND ended_at_us <= $2
               ORDER BY seq LIMIT $3)
           RETURNING seq AS "seq!", measurement AS "measurement!""#,
        filter.boot_pk,
        filter.ended_until_us,
        i64::from(limit),
    )
    .fetch_all(db)
    .await?;
    let taken = rows.into_iter().map(|row| {
        Ok(DeferredSegment {
            seq: row.seq,
            segment: from_json("measurement", &row.measurement)?,
        })
    });
    let mut taken = taken.collect::<Result<Vec<_>, EngineError>>()?;
    // Engines return what they delete in any order.
    taken.sort_unstable_by_key(|deferred| deferred.seq);
    Ok(taken)
}
