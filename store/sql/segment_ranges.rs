//! Ledger of stored measurements: ranges with consecutive keys and sequence numbers that agree in
//! everything but their values. A measurement that is sent again lies in one of them.

use std::collections::HashMap;
use std::ops::RangeInclusive;

use futures_util::future::ready;
use futures_util::{Stream, TryStreamExt as _};
use jiff::Timestamp;
use tread_api::ids::MissionId;
use tread_api::terrain::TerrainRef;
use tread_store::segments::NewSegment;

use super::{Connection, EngineError, to_us};

/// A range to be stored.
#[derive(Debug, Clone, Copy)]
pub(super) struct NewRange<'segment> {
    /// Key of the first measurement.
    pub(super) first_pk: i64,
    /// Sequence number of the first measurement within its run.
    pub(super) first_seq: i64,
    /// Number of measurements, at least 1.
    pub(super) count: u64,
    /// Key of the run of the agent.
    pub(super) boot_pk: i64,
    /// Key of the robot.
    pub(super) robot_pk: i64,
    /// Key of the site.
    pub(super) site_pk: i64,
    /// Key of the configuration.
    pub(super) configuration_pk: i64,
    /// What else the measurements have in common: mission, revision of the grid, and terrain.
    pub(super) mission: Option<MissionId>,
    pub(super) grid_revision: u32,
    pub(super) terrain: Option<&'segment TerrainRef>,
}

/// Returns the ranges of measurements whose keys follow a key.
pub(super) fn following<'segment>(
    last: i64,
    segments: &[NewSegment<'segment>],
) -> Vec<NewRange<'segment>> {
    let mut ranges = Vec::new();
    let mut next_pk = last + 1;
    for range in segments.chunk_by(NewSegment::is_followed_by) {
        let Some(first) = range.first() else { continue };
        let (first_pk, count) = (next_pk, range.len() as u64);
        next_pk = next_pk.saturating_add_unsigned(count);
        ranges.push(NewRange {
            first_pk,
            first_seq: first.seq,
            count,
            boot_pk: first.boot_pk,
            robot_pk: first.robot_pk,
            site_pk: first.site_pk,
            configuration_pk: first.configuration_pk,
            mission: first.segment.mission,
            grid_revision: first.segment.grid_revision,
            terrain: first.segment.terrain.as_ref(),
        });
    }
    ranges
}

/// Returns the last key and the time at which its measurement was received, microseconds since 1970;
/// `None` without measurements.
pub async fn last(db: &mut Connection) -> Result<Option<(i64, i64)>, EngineError> {
    let last = sqlx::query!(
        "SELECT last_pk, received_at_us FROM segment_ranges ORDER BY first_pk DESC LIMIT 1"
    );
    let last = last.fetch_optional(db).await?;
    Ok(last.map(|row| (row.last_pk, row.received_at_us)))
}

/// Returns the first and the last key; `None` without measurements.
pub async fn ends(db: &mut Connection) -> Result<Option<(i64, i64)>, EngineError> {
    let ends = sqlx::query!(
        r#"SELECT (SELECT MIN(first_pk) FROM segment_ranges) AS "first: i64",
               (SELECT last_pk FROM segment_ranges ORDER BY first_pk DESC LIMIT 1) AS "last: i64""#
    );
    let ends = ends.fetch_one(db).await?;
    Ok(ends.first.zip(ends.last))
}

/// Returns the time at which the measurement with a key was received, microseconds since 1970; `None`
/// if there is none at that key or before it.
pub async fn received_at_us(db: &mut Connection, pk: i64) -> Result<Option<i64>, EngineError> {
    let at_us = sqlx::query_scalar!(
        "SELECT received_at_us FROM segment_ranges WHERE first_pk <= $1
         ORDER BY first_pk DESC LIMIT 1",
        pk
    );
    Ok(at_us.fetch_optional(db).await?)
}

/// Returns the key of the first measurement that was received at a time or later, if none that was
/// can have been removed; else `None`. Keys are in the order of receipt, begin at 1 and have no
/// gaps; the first ones are removed first, the last one never is.
pub async fn first_since(db: &mut Connection, at: Timestamp) -> Result<Option<i64>, EngineError> {
    let at_us = to_us(at);
    let Some((first, last)) = ends(db).await? else {
        return Ok(None);
    };
    let (mut low, mut high) = (first, last + 1);
    while low < high {
        let middle = low + (high - low) / 2;
        let received = received_at_us(db, middle).await?;
        if received.is_some_and(|received| received < at_us) {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    let is_known = low <= last && (low > first || first == 1);
    Ok(is_known.then_some(low))
}

/// Returns the stored ranges of a run's sequence numbers that touch a range, both ends included.
pub async fn within(
    db: &mut Connection,
    boot_pk: i64,
    seqs: RangeInclusive<i64>,
) -> Result<Vec<(i64, i64)>, EngineError> {
    let (from, to) = seqs.into_inner();
    let rows = sqlx::query!(
        "SELECT first_seq, last_seq FROM segment_ranges WHERE boot_pk = $1 AND first_seq <= $2
         ORDER BY first_seq DESC",
        boot_pk,
        to,
    );
    let rows = rows.fetch(db);
    ending_from(rows.map_ok(|row| (row.first_seq, row.last_seq)), from).await
}

/// Returns the ranges that end at a number or later, of disjoint ones in descending order: the search
/// ends at the first that ends before.
pub(super) async fn ending_from(
    ranges: impl Stream<Item = Result<(i64, i64), sqlx::Error>>,
    from: i64,
) -> Result<Vec<(i64, i64)>, EngineError> {
    let found = ranges.try_take_while(|&(_, to)| ready(Ok(from <= to)));
    Ok(found.try_collect().await?)
}

/// Returns the largest stored sequence number of a run; `None` without stored measurements.
pub async fn newest_seq(db: &mut Connection, boot_pk: i64) -> Result<Option<i64>, EngineError> {
    let newest = sqlx::query_scalar!(
        "SELECT last_seq FROM segment_ranges WHERE boot_pk = $1 ORDER BY first_seq DESC LIMIT 1",
        boot_pk
    );
    Ok(newest.fetch_optional(db).await?)
}

/// Returns the last key of each robot's measurements, of those robots that have some.
pub async fn last_keys(db: &mut Connection) -> Result<HashMap<i64, i64>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT robots.pk AS "robot_pk!", (SELECT last_pk FROM segment_ranges
               WHERE segment_ranges.robot_pk = robots.pk ORDER BY first_pk DESC LIMIT 1) AS last_pk
           FROM robots"#
    );
    let rows = rows.fetch_all(db).await?;
    Ok(rows
        .into_iter()
        .filter_map(|row| row.last_pk.map(|last| (row.robot_pk, last)))
        .collect())
}
