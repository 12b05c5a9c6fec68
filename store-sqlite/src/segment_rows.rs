//! Writing of measurements, and the statement that reads them.

use std::sync::LazyLock;

use jiff::Timestamp;
use tread_store::segments::{Added, NewSegment};

use super::rows::{Row, RowsStatement, RowsText};
use super::segment_ranges::{self, NewRange};
use super::{Connection, EngineError, ground, to_us};

/// Number of columns of a measurement.
const COLUMNS: usize = 18;

static INSERT: LazyLock<RowsStatement> = LazyLock::new(|| {
    RowsStatement::new(&RowsText {
        into:
            "INSERT INTO segment_values (pk, started_at_ns, ended_at_ns, ix, iy, theta_information,
             theta_weighted, independent_information, robot_error_ratio, tyre_error_ratio,
             track_information, track_weighted, rolling_information, rolling_weighted,
             mu_peak_lower_bound, samples, distance_m, saturation_ratio)",
        columns: COLUMNS,
        then: "",
    })
});

/// Stores measurements, none of which is stored yet.
///
/// # Errors
/// The database failed, for example because a measurement is stored already.
pub async fn insert(
    db: &mut Connection,
    segments: &[NewSegment<'_>],
    received_at: Timestamp,
) -> Result<Added, EngineError> {
    let (last, last_us) = segment_ranges::last(db).await?.unwrap_or((0, i64::MIN));
    // Times are in the order of commits, whatever the clock did.
    let received_at_us = to_us(received_at).max(last_us);
    let ranges = segment_ranges::following(last, segments);
    insert_ranges(db, &ranges, received_at_us).await?;
    let rows: Vec<(i64, &NewSegment<'_>)> = (last + 1..).zip(segments).collect();
    INSERT.execute(db, &rows, bind).await?;
    Ok(Added {
        first: last + 1,
        last: last.saturating_add_unsigned(segments.len() as u64),
    })
}

fn bind(row: &mut Row<'_>, &(pk, new): &(i64, &NewSegment<'_>)) -> Result<(), EngineError> {
    let (segment, (started_at_ns, ended_at_ns)) = (new.segment, new.times_ns);
    let errors = segment.theta_errors;
    let (track, rolling) = (segment.effective_track_ratio, segment.rolling_resistance);
    row.add(pk)?
        .add(started_at_ns)?
        .add(ended_at_ns)?
        .add(segment.cell.ix)?
        .add(segment.cell.iy)?
        .add(segment.theta.information)?
        .add(segment.theta.weighted)?
        .add(errors.map(|errors| errors.independent_information))?
        .add(errors.map(|errors| errors.robot_ratio))?
        .add(errors.map(|errors| errors.tyre_ratio))?
        .add(track.map(|pair| pair.information))?
        .add(track.map(|pair| pair.weighted))?
        .add(rolling.map(|pair| pair.information))?
        .add(rolling.map(|pair| pair.weighted))?
        .add(segment.mu_peak_lower_bound)?
        .add(i64::from(segment.samples))?
        .add(segment.distance_m)?
        .add(segment.saturation_ratio)?;
    Ok(())
}

/// Number of columns of a range.
const RANGE_COLUMNS: usize = 13;

static INSERT_RANGES: LazyLock<RowsStatement> = LazyLock::new(|| {
    RowsStatement::new(&RowsText {
        into:
            "INSERT INTO segment_ranges (first_pk, last_pk, first_seq, last_seq, boot_pk, robot_pk,
             site_pk, configuration_pk, mission, grid_revision, terrain, terrain_revision,
             received_at_us)",
        columns: RANGE_COLUMNS,
        then: "",
    })
});

/// Removes the values of measurements up to a key, which are no longer in the ledger.
pub(super) async fn remove_values(db: &mut Connection, until_pk: i64) -> Result<(), EngineError> {
    sqlx::query!("DELETE FROM segment_values WHERE pk <= $1", until_pk)
        .execute(db)
        .await?;
    Ok(())
}

/// Does nothing, since values are removed at once.
///
/// # Errors
/// None.
pub async fn release_removed(_db: &mut Connection) -> Result<Option<u64>, EngineError> {
    Ok(Some(0))
}

/// Stores ranges of measurements that were received at one time.
async fn insert_ranges(
    db: &mut Connection,
    ranges: &[NewRange<'_>],
    received_at_us: i64,
) -> Result<(), EngineError> {
    let inserting = INSERT_RANGES.execute(db, ranges, |row, range| {
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

/// Reads measurements range by range; a cross join keeps its order. The first argument is a key: only
/// later measurements are read. Of the ranges that begin before it only the last can reach beyond it.
/// The condition is one of ranges.
macro_rules! measurements {
    ($condition:tt, $after:expr, $($argument:expr),* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT segment_values.pk AS "pk!", segment_ranges.first_pk AS "range_pk!",
                   segment_ranges.robot_pk AS "robot_pk!",
                   segment_ranges.site_pk AS "site_pk!",
                   segment_ranges.configuration_pk AS "configuration_pk!", robots.id AS "robot!",
                   boots.id AS "boot!",
                   segment_ranges.first_seq + segment_values.pk - segment_ranges.first_pk
                       AS "seq!: i64",
                   received_at_us AS "received_at_us!", configurations.id AS "configuration!",
                   mission AS "mission?", grid_revision AS "grid_revision!",
                   terrain AS "terrain!", terrain_revision AS "terrain_revision!",
                   started_at_ns AS "started_at_ns!", ended_at_ns AS "ended_at_ns!", ix AS "ix!",
                   iy AS "iy!", theta_information AS "theta_information!",
                   theta_weighted AS "theta_weighted!",
                   independent_information AS "independent_information?",
                   robot_error_ratio AS "robot_error_ratio?",
                   tyre_error_ratio AS "tyre_error_ratio?",
                   track_information AS "track_information?", track_weighted AS "track_weighted?",
                   rolling_information AS "rolling_information?",
                   rolling_weighted AS "rolling_weighted?",
                   mu_peak_lower_bound AS "mu_peak_lower_bound?", samples AS "samples!",
                   distance_m AS "distance_m!", saturation_ratio AS "saturation_ratio!"
               FROM segment_ranges
               CROSS JOIN robots ON robots.pk = segment_ranges.robot_pk
               CROSS JOIN boots ON boots.pk = segment_ranges.boot_pk
               CROSS JOIN configurations ON configurations.pk = segment_ranges.configuration_pk
               CROSS JOIN segment_values ON segment_values.pk
                   BETWEEN segment_ranges.first_pk AND segment_ranges.last_pk
               WHERE segment_ranges.first_pk >= COALESCE(
                       (SELECT MAX(first_pk) FROM segment_ranges WHERE first_pk <= $1), 0)
                   AND segment_values.pk > $1 "# + $condition
                + " ORDER BY segment_ranges.first_pk, segment_values.pk LIMIT $2",
            $after,
            $($argument),*
        )
    };
}

pub(super) use measurements;
