//! Writing of measurements, and the statement that reads them.

use jiff::Timestamp;
use tread_store::segments::{Added, NewSegment};

use super::copy_rows::CopyRows;
use super::partitions;
pub use super::partitions::drop_removed as release_removed;
use super::segment_ranges::{self, NewRange};
use super::{Connection, EngineError, ground, to_us};

/// Columns of a measurement.
const COPY: &str = "COPY segment_values (pk, started_at_ns, ended_at_ns, ix, iy, theta_information,
         theta_weighted, independent_information, robot_error_ratio, tyre_error_ratio,
         track_information, track_weighted, rolling_information, rolling_weighted,
         mu_peak_lower_bound, samples, distance_m, saturation_ratio)
     FROM STDIN (FORMAT binary)";
const COLUMNS: i16 = 18;

/// Columns of a range.
const COPY_RANGES: &str = "COPY segment_ranges (first_pk, last_pk, first_seq, last_seq, boot_pk,
         robot_pk, site_pk, configuration_pk, mission, grid_revision, terrain, terrain_revision,
         received_at_us)
     FROM STDIN (FORMAT binary)";
const RANGE_COLUMNS: i16 = 13;

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
    let added = Added {
        first: last + 1,
        last: last.saturating_add_unsigned(segments.len() as u64),
    };
    partitions::prepare(db, (added.first, added.last)).await?;
    let mut rows = CopyRows::new(COLUMNS);
    for (pk, new) in (last + 1..).zip(segments) {
        let (segment, (started_at_ns, ended_at_ns)) = (new.segment, new.times_ns);
        let errors = segment.theta_errors;
        let (track, rolling) = (segment.effective_track_ratio, segment.rolling_resistance);
        rows.row()
            .integer(pk)
            .integer(started_at_ns)
            .integer(ended_at_ns)
            .integer(segment.cell.ix)
            .integer(segment.cell.iy)
            .real(segment.theta.information)
            .real(segment.theta.weighted)
            .real(errors.map(|errors| errors.independent_information))
            .real(errors.map(|errors| errors.robot_ratio))
            .real(errors.map(|errors| errors.tyre_ratio))
            .real(track.map(|pair| pair.information))
            .real(track.map(|pair| pair.weighted))
            .real(rolling.map(|pair| pair.information))
            .real(rolling.map(|pair| pair.weighted))
            .real(segment.mu_peak_lower_bound)
            .integer(segment.samples)
            .real(segment.distance_m)
            .real(segment.saturation_ratio);
    }
    rows.write(db, COPY).await?;
    Ok(added)
}

/// Does nothing: values that are no longer in the ledger remain until their partition is dropped.
///
/// # Errors
/// None.
#[expect(clippy::unused_async, reason = "as the other engine")]
pub(super) async fn remove_values(_db: &mut Connection, _until_pk: i64) -> Result<(), EngineError> {
    Ok(())
}

/// Stores ranges of measurements that were received at one time.
async fn insert_ranges(
    db: &mut Connection,
    ranges: &[NewRange<'_>],
    received_at_us: i64,
) -> Result<(), EngineError> {
    let mut rows = CopyRows::new(RANGE_COLUMNS);
    for range in ranges {
        let after = range.count.saturating_sub(1);
        let (terrain, terrain_revision) = ground::columns(range.terrain);
        let mission = range.mission.map(|mission| mission.to_string());
        rows.row()
            .integer(range.first_pk)
            .integer(range.first_pk.saturating_add_unsigned(after))
            .integer(range.first_seq)
            .integer(range.first_seq.saturating_add_unsigned(after))
            .integer(range.boot_pk)
            .integer(range.robot_pk)
            .integer(range.site_pk)
            .integer(range.configuration_pk)
            .text(mission.as_deref())
            .integer(range.grid_revision)
            .text(Some(terrain))
            .integer(terrain_revision)
            .integer(received_at_us);
    }
    rows.write(db, COPY_RANGES).await?;
    Ok(())
}

/// Reads measurements range by range: the ranges in their order, and from each its measurements by their
/// keys. The limits make PostgreSQL do so whatever sizes it assumes: the measurements of a range are read
/// when it is its turn, in their order, so the whole has no other order than that of the ranges, and no
/// sort waits for what is beyond the limit. A range has at least one measurement, and only in the first
/// there can be none that is wanted.
///
/// The first argument is a key: only later measurements are read. Of the ranges that begin before it only
/// the last can reach beyond it. The condition is one of ranges.
macro_rules! measurements {
    ($condition:tt, $after:expr, $($argument:expr),* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT measured.pk AS "pk!", named.robot_pk AS "robot_pk!",
                   named.site_pk AS "site_pk!", named.configuration_pk AS "configuration_pk!",
                   named.robot AS "robot!", named.boot AS "boot!",
                   named.first_seq + measured.pk - named.first_pk AS "seq!: i64",
                   received_at_us AS "received_at_us!", named.configuration AS "configuration!",
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
               FROM (
                   SELECT segment_ranges.*, robots.id AS robot, boots.id AS boot,
                       configurations.id AS configuration
                   FROM segment_ranges
                   JOIN robots ON robots.pk = segment_ranges.robot_pk
                   JOIN boots ON boots.pk = segment_ranges.boot_pk
                   JOIN configurations ON configurations.pk = segment_ranges.configuration_pk
                   WHERE segment_ranges.first_pk >= COALESCE(
                       (SELECT MAX(first_pk) FROM segment_ranges WHERE first_pk <= $1), 0) "#
                + $condition
                + r#"
                   ORDER BY segment_ranges.first_pk LIMIT CAST($2 AS BIGINT) + 1
               ) AS named
               CROSS JOIN LATERAL (
                   SELECT * FROM segment_values
                   WHERE segment_values.pk BETWEEN named.first_pk AND named.last_pk
                       AND segment_values.pk > $1
                   ORDER BY segment_values.pk LIMIT $2
               ) AS measured
               ORDER BY named.first_pk LIMIT $2"#,
            $after,
            $($argument),*
        )
    };
}

pub(super) use measurements;
