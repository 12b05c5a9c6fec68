//! Ledger of stored measurements: ranges with consecutive keys and sequence numbers that agree in
//! everything but their values. A measurement that is sent again lies in one of them.

use std::collections::HashMap;
use std::sync::LazyLock;

use futures_util::future::ready;
use futures_util::{Stream, TryStreamExt as _};
use sqlx::SqliteConnection;
use tread_api::ids::MissionId;
use tread_api::terrain::TerrainRef;

use super::rows::RowsStatement;
use super::{EngineError, ground};

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

/// Number of columns of a range.
const COLUMNS: usize = 13;

static INSERT: LazyLock<RowsStatement> = LazyLock::new(|| {
    RowsStatement::new(
        "INSERT INTO segment_ranges (first_pk, last_pk, first_seq, last_seq, boot_pk, robot_pk,
             site_pk, configuration_pk, mission, grid_revision, terrain, terrain_revision,
             received_at_us)",
        COLUMNS,
        "",
    )
});

/// Stores ranges of measurements that were received at one time.
pub(super) async fn insert(
    db: &mut SqliteConnection,
    ranges: &[NewRange<'_>],
    received_at_us: i64,
) -> Result<(), EngineError> {
    let inserting = INSERT.execute(db, ranges, |row, range| {
        let after = range.count.saturating_sub(1);
        let (terrain, terrain_revision) = ground::columns(range.terrain);
        row.add(range.first_pk)?
            .add(range.first_pk.saturating_add_unsigned(after))?
            .add(range.first_seq)?
            .add(range.first_seq.saturating_add_unsigned(after))?
            .add(range.boot_pk)?
            .add(range.robot_pk)?
            .add(range.site_pk)?
            .add(range.configuration_pk)?
            .add(range.mission.map(|mission| mission.to_string()))?
            .add(i64::from(range.grid_revision))?
            .add(terrain)?
            .add(terrain_revision)?
            .add(received_at_us)?;
        Ok(())
    });
    inserting.await.map(|_inserted| ())
}

/// Returns the last key and the time at which its measurement was received, microseconds since 1970;
/// `None` without measurements.
pub async fn last(db: &mut SqliteConnection) -> Result<Option<(i64, i64)>, EngineError> {
    let last = sqlx::query!(
        "SELECT last_pk, received_at_us FROM segment_ranges ORDER BY first_pk DESC LIMIT 1"
    );
    let last = last.fetch_optional(db).await?;
    Ok(last.map(|row| (row.last_pk, row.received_at_us)))
}

/// Returns the first and the last key; `None` without measurements.
pub async fn ends(db: &mut SqliteConnection) -> Result<Option<(i64, i64)>, EngineError> {
    let ends = sqlx::query!(
        r#"SELECT (SELECT MIN(first_pk) FROM segment_ranges) AS "first: i64",
               (SELECT last_pk FROM segment_ranges ORDER BY first_pk DESC LIMIT 1) AS "last: i64""#
    );
    let ends = ends.fetch_one(db).await?;
    Ok(ends.first.zip(ends.last))
}

/// Returns the time at which the measurement with a key was received, microseconds since 1970; `None`
/// if there is none at that key or before it.
pub async fn received_at_us(
    db: &mut SqliteConnection,
    pk: i64,
) -> Result<Option<i64>, EngineError> {
    let at_us = sqlx::query_scalar!(
        "SELECT received_at_us FROM segment_ranges WHERE first_pk <= ?
         ORDER BY first_pk DESC LIMIT 1",
        pk
    );
    Ok(at_us.fetch_optional(db).await?)
}

/// Returns the stored ranges of a run's sequence numbers that touch a range, both ends included.
pub async fn within(
    db: &mut SqliteConnection,
    boot_pk: i64,
    (from, to): (i64, i64),
) -> Result<Vec<(i64, i64)>, EngineError> {
    let rows = sqlx::query!(
        "SELECT first_seq, last_seq FROM segment_ranges WHERE boot_pk = ? AND first_seq <= ?
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
pub async fn newest_seq(
    db: &mut SqliteConnection,
    boot_pk: i64,
) -> Result<Option<i64>, EngineError> {
    let newest = sqlx::query_scalar!(
        "SELECT last_seq FROM segment_ranges WHERE boot_pk = ? ORDER BY first_seq DESC LIMIT 1",
        boot_pk
    );
    Ok(newest.fetch_optional(db).await?)
}

/// Returns the last key of each robot's measurements, of those robots that have some.
pub async fn last_keys(db: &mut SqliteConnection) -> Result<HashMap<i64, i64>, EngineError> {
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
