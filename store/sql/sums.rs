//! Sums of measurements per cell, ground, robot, configuration and hour of measuring, up to the
//! watermark of each robot ([`super::watermarks`]).

use futures_util::TryStreamExt as _;
use tread_api::site::Cell;
pub use tread_store::sums::{StoredHour, SumKey, SumRow};
use tread_store::withdrawals::Hours;

use super::sum_columns::RawSum;
pub use super::sum_rows::{add, unmerged};
use super::{Connection, EngineError, ground};

/// Calls `take` with every sum, in no particular order, one at a time.
pub async fn each(db: &mut Connection, mut take: impl FnMut(SumRow)) -> Result<(), EngineError> {
    let mut rows = sqlx::query_as!(
        RawSum,
        r#"SELECT site_pk, ix, iy, grid_revision, terrain, terrain_revision, robot_pk,
               configuration_pk, epoch_h, information_hi, information_lo, weighted_hi, weighted_lo,
               square_hi, square_lo, track_information_hi, track_information_lo,
               track_weighted_hi, track_weighted_lo, rolling_information_hi,
               rolling_information_lo, rolling_weighted_hi, rolling_weighted_lo, segments,
               samples, mu_peak, newest_at_us, newest_information, newest_weighted, newest_mu,
               pass_at_us, robot_error_hi, robot_error_lo, tyre_error_hi, tyre_error_lo
           FROM cell_sums"#,
    )
    .fetch(db);
    while let Some(raw) = rows.try_next().await? {
        take(SumRow::try_from(raw)?);
    }
    Ok(())
}

/// Calls `take` with every sum of a block of 64 × 64 cells of a site, given by one of these cells, in no
/// particular order, one at a time.
pub async fn of_block(
    db: &mut Connection,
    site_pk: i64,
    cell: Cell,
    mut take: impl FnMut(SumRow),
) -> Result<(), EngineError> {
    let mut rows = sqlx::query_as!(
        RawSum,
        r#"SELECT site_pk AS "site_pk!", ix AS "ix!", iy AS "iy!", grid_revision AS "grid_revision!",
               terrain AS "terrain!", terrain_revision AS "terrain_revision!",
               robot_pk AS "robot_pk!", configuration_pk AS "configuration_pk!",
               epoch_h AS "epoch_h!", information_hi, information_lo, weighted_hi, weighted_lo,
               square_hi, square_lo, track_information_hi, track_information_lo,
               track_weighted_hi, track_weighted_lo, rolling_information_hi,
               rolling_information_lo, rolling_weighted_hi, rolling_weighted_lo, segments,
               samples, mu_peak, newest_at_us, newest_information, newest_weighted, newest_mu,
               pass_at_us, robot_error_hi, robot_error_lo, tyre_error_hi, tyre_error_lo
           FROM cell_sums WHERE site_pk = $1 AND iy >> 6 = $2 AND ix >> 6 = $3"#,
        site_pk,
        i64::from(cell.iy >> 6),
        i64::from(cell.ix >> 6),
    )
    .fetch(db);
    while let Some(raw) = rows.try_next().await? {
        take(SumRow::try_from(raw)?);
    }
    Ok(())
}

/// Returns at most `limit` sums of one robot and hour, in the order of the table.
pub async fn of_hour(
    db: &mut Connection,
    hour: StoredHour,
    limit: usize,
) -> Result<Vec<SumRow>, EngineError> {
    let limit = i64::try_from(limit).unwrap_or(i64::MAX);
    let raw = sqlx::query_as!(
        RawSum,
        r#"SELECT site_pk, ix, iy, grid_revision, terrain, terrain_revision, robot_pk,
               configuration_pk, epoch_h, information_hi, information_lo, weighted_hi, weighted_lo,
               square_hi, square_lo, track_information_hi, track_information_lo,
               track_weighted_hi, track_weighted_lo, rolling_information_hi,
               rolling_information_lo, rolling_weighted_hi, rolling_weighted_lo, segments,
               samples, mu_peak, newest_at_us, newest_information, newest_weighted, newest_mu,
               pass_at_us, robot_error_hi, robot_error_lo, tyre_error_hi, tyre_error_lo
           FROM cell_sums WHERE robot_pk = $1 AND epoch_h = $2
           ORDER BY iy, ix, terrain, terrain_revision, grid_revision, site_pk, configuration_pk
           LIMIT $3"#,
        hour.robot_pk,
        hour.epoch_h,
        i64::from(limit),
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(SumRow::try_from).collect()
}

/// Removes one sum; `false` if it does not exist.
pub async fn remove(db: &mut Connection, key: &SumKey) -> Result<bool, EngineError> {
    let (id, revision) = ground::columns(key.terrain.as_ref());
    let SumKey {
        robot_pk,
        epoch_h,
        cell,
        grid_revision,
        site_pk,
        configuration_pk,
        ..
    } = *key;
    let done = sqlx::query!(
        "DELETE FROM cell_sums WHERE robot_pk = $1 AND epoch_h = $2 AND iy = $3 AND ix = $4
             AND terrain = $5 AND terrain_revision = $6 AND grid_revision = $7 AND site_pk = $8
             AND configuration_pk = $9",
        robot_pk,
        epoch_h,
        i64::from(cell.iy),
        i64::from(cell.ix),
        id,
        i64::from(revision),
        i64::from(grid_revision),
        site_pk,
        configuration_pk,
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected() == 1)
}

/// Removes the sums of a robot in these hours. Returns their number.
pub async fn remove_hours(
    db: &mut Connection,
    robot_pk: i64,
    hours: Hours,
) -> Result<u64, EngineError> {
    let done = sqlx::query!(
        "DELETE FROM cell_sums WHERE robot_pk = $1 AND epoch_h BETWEEN $2 AND $3",
        robot_pk,
        hours.from_h,
        hours.to_h,
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected())
}
