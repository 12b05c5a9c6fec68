//! Writing of measurements, and the statement that reads them.

use jiff::Timestamp;
use tread_api::friction::Segment;
use tread_store::segments::{Added, NewSegment};

use super::partitions;
pub use super::partitions::drop_removed as release_removed;
use super::segment_ranges::{self, NewRange};
use super::{Connection, EngineError, ground, to_us};

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
    partitions::prepare(db, added.first..=added.last).await?;
    insert_values(db, last + 1, segments).await?;
    Ok(added)
}

/// Stores the values of measurements with keys from `first` on.
///
/// By arrays and not by COPY: sqlx ends a COPY with a message of its own, which TCP delays by 40 ms since
/// sqlx 0.9.0 does not set `TCP_NODELAY`. Over TLS it delays every statement of more than 16 KB.
async fn insert_values(
    db: &mut Connection,
    first: i64,
    segments: &[NewSegment<'_>],
) -> Result<(), EngineError> {
    let integers =
        |of: &dyn Fn(&NewSegment<'_>) -> i64| -> Vec<i64> { segments.iter().map(of).collect() };
    let reals = |of: &dyn Fn(&Segment) -> f64| -> Vec<f64> {
        segments.iter().map(|new| of(new.segment)).collect()
    };
    let some_reals = |of: &dyn Fn(&Segment) -> Option<f64>| -> Vec<Option<f64>> {
        segments.iter().map(|new| of(new.segment)).collect()
    };
    let keys: Vec<i64> = (first..).take(segments.len()).collect();
    sqlx::query!(
        "INSERT INTO segment_values (pk, started_at_ns, ended_at_ns, ix, iy, theta_information,
             theta_weighted, independent_information, robot_error_ratio, tyre_error_ratio,
             track_information, track_weighted, rolling_information, rolling_weighted,
             mu_peak_lower_bound, samples, distance_m, saturation_ratio)
         SELECT * FROM UNNEST(CAST($1 AS BIGINT[]), CAST($2 AS BIGINT[]), CAST($3 AS BIGINT[]),
             CAST($4 AS BIGINT[]), CAST($5 AS BIGINT[]), CAST($6 AS DOUBLE PRECISION[]),
             CAST($7 AS DOUBLE PRECISION[]), CAST($8 AS DOUBLE PRECISION[]),
             CAST($9 AS DOUBLE PRECISION[]), CAST($10 AS DOUBLE PRECISION[]),
             CAST($11 AS DOUBLE PRECISION[]), CAST($12 AS DOUBLE PRECISION[]),
             CAST($13 AS DOUBLE PRECISION[]), CAST($14 AS DOUBLE PRECISION[]),
             CAST($15 AS DOUBLE PRECISION[]), CAST($16 AS BIGINT[]),
             CAST($17 AS DOUBLE PRECISION[]), CAST($18 AS DOUBLE PRECISION[]))",
        &keys,
        &integers(&|new| new.times_ns.0),
        &integers(&|new| new.times_ns.1),
        &integers(&|new| new.segment.cell.ix.into()),
        &integers(&|new| new.segment.cell.iy.into()),
        &reals(&|segment| segment.theta.information),
        &reals(&|segment| segment.theta.weighted),
        &some_reals(&|segment| Some(segment.theta_errors?.independent_information)) as _,
        &some_reals(&|segment| Some(segment.theta_errors?.robot_ratio)) as _,
        &some_reals(&|segment| Some(segment.theta_errors?.tyre_ratio)) as _,
        &some_reals(&|segment| Some(segment.effective_track_ratio?.information)) as _,
        &some_reals(&|segment| Some(segment.effective_track_ratio?.weighted)) as _,
        &some_reals(&|segment| Some(segment.rolling_resistance?.information)) as _,
        &some_reals(&|segment| Some(segment.rolling_resistance?.weighted)) as _,
        &some_reals(&|segment| segment.mu_peak_lower_bound) as _,
        &integers(&|new| new.segment.samples.into()),
        &reals(&|segment| segment.distance_m),
        &reals(&|segment| segment.saturation_ratio),
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Removes the values of measurements up to a key, which are no longer in the ledger, if they are in the
/// partition of a database that had none before, which may be as large as all others. Other values remain
/// until their partition is dropped.
pub(super) async fn remove_values(db: &mut Connection, until_pk: i64) -> Result<(), EngineError> {
    sqlx::query!(
        "DELETE FROM segment_values WHERE pk <= $1
             AND pk <= (SELECT last_pk FROM segment_partitions WHERE first_pk = 0)",
        until_pk
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Stores ranges of measurements that were received at one time.
async fn insert_ranges(
    db: &mut Connection,
    ranges: &[NewRange<'_>],
    received_at_us: i64,
) -> Result<(), EngineError> {
    let integers =
        |of: &dyn Fn(&NewRange<'_>) -> i64| -> Vec<i64> { ranges.iter().map(of).collect() };
    let after = |range: &NewRange<'_>| range.count.saturating_sub(1);
    let missions: Vec<Option<String>> = ranges
        .iter()
        .map(|range| range.mission.map(|mission| mission.to_string()))
        .collect();
    let terrains: Vec<String> = ranges
        .iter()
        .map(|range| ground::columns(range.terrain).0.to_owned())
        .collect();
    sqlx::query!(
        "INSERT INTO segment_ranges (first_pk, last_pk, first_seq, last_seq, boot_pk, robot_pk,
             site_pk, configuration_pk, mission, grid_revision, terrain, terrain_revision,
             received_at_us)
         SELECT *, CAST($13 AS BIGINT) FROM UNNEST(CAST($1 AS BIGINT[]), CAST($2 AS BIGINT[]),
             CAST($3 AS BIGINT[]), CAST($4 AS BIGINT[]), CAST($5 AS BIGINT[]),
             CAST($6 AS BIGINT[]), CAST($7 AS BIGINT[]), CAST($8 AS BIGINT[]), CAST($9 AS TEXT[]),
             CAST($10 AS BIGINT[]), CAST($11 AS TEXT[]), CAST($12 AS BIGINT[]))",
        &integers(&|range| range.first_pk),
        &integers(&|range| range.first_pk.saturating_add_unsigned(after(range))),
        &integers(&|range| range.first_seq),
        &integers(&|range| range.first_seq.saturating_add_unsigned(after(range))),
        &integers(&|range| range.boot_pk),
        &integers(&|range| range.robot_pk),
        &integers(&|range| range.site_pk),
        &integers(&|range| range.configuration_pk),
        &missions as _,
        &integers(&|range| range.grid_revision.into()),
        &terrains,
        &integers(&|range| ground::columns(range.terrain).1.into()),
        received_at_us,
    )
    .execute(db)
    .await?;
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
            r#"SELECT measured.pk AS "pk!", named.first_pk AS "range_pk!",
                   named.robot_pk AS "robot_pk!",
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
