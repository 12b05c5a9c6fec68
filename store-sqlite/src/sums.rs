//! Sums of measurements per cell, ground, robot, configuration and hour of measuring, up to the
//! watermark of each robot ([`super::watermarks`]).

use std::sync::LazyLock;

use futures_util::TryStreamExt as _;
use sqlx::SqliteConnection;
use tread_api::friction::Information;
pub use tread_store::sums::{StoredHour, SumKey, SumRow};

use super::rows::{Row, RowsStatement};
use super::{EngineError, ground, unsigned};
use tread_store::friction::fixed::Fixed;
use tread_store::friction::sums::{Pair, Pass, TELLING_DEVIATIONS};
use tread_store::friction::{Horizons, Sums};

/// Number of columns.
const COLUMNS: usize = 35;

static ADD: LazyLock<RowsStatement> = LazyLock::new(|| {
    RowsStatement::new(
        "INSERT INTO cell_sums (site_pk, iy, ix, grid_revision, terrain, terrain_revision,
             robot_pk, configuration_pk, epoch_h, information_hi, information_lo, weighted_hi,
             weighted_lo, square_hi, square_lo, track_information_hi, track_information_lo,
             track_weighted_hi, track_weighted_lo, rolling_information_hi, rolling_information_lo,
             rolling_weighted_hi, rolling_weighted_lo, segments, samples, mu_peak, newest_at_us,
             newest_information, newest_weighted, newest_mu, pass_at_us, robot_error_hi,
             robot_error_lo, tyre_error_hi, tyre_error_lo)",
        COLUMNS,
        &added(),
    )
});

/// Fixed-point numbers, each in two columns.
const FIXED: [&str; 9] = [
    "information",
    "weighted",
    "square",
    "track_information",
    "track_weighted",
    "rolling_information",
    "rolling_weighted",
    "robot_error",
    "tyre_error",
];
/// Columns of the pass that is kept separately.
const PASS: [&str; 4] = [
    "newest_information",
    "newest_weighted",
    "newest_mu",
    "pass_at_us",
];

/// Returns the SQL that adds a sum to a stored one, equal to [`Sums::add`].
fn added() -> String {
    // SQLite adds integers beyond 64 bits as real numbers, and the cast brings those back to the end
    // of the range: one robot's sum that overflows must not fail the transaction of all.
    let fixed = FIXED.map(|name| {
        format!(
            "{name}_hi = CAST({name}_hi + excluded.{name}_hi
                 + (({name}_lo + excluded.{name}_lo) >> 32) AS INTEGER),
             {name}_lo = ({name}_lo + excluded.{name}_lo) & 4294967295,"
        )
    });
    // Of two passes an informative one counts, of two such the later one, of equally late ones the
    // one with larger numbers; NULL is smaller than any number, and none is smaller than -1 here.
    let least = TELLING_DEVIATIONS * TELLING_DEVIATIONS;
    let order = |of: &str| {
        format!(
            "(COALESCE({of}newest_weighted * {of}newest_weighted
                 >= {least} * {of}newest_information, 0), {of}pass_at_us,
              COALESCE({of}newest_information, -1), COALESCE({of}newest_weighted, -1),
              COALESCE({of}newest_mu, -1))"
        )
    };
    let (new, present) = (order("excluded."), order(""));
    let pass = PASS.map(|name| {
        format!("{name} = CASE WHEN {new} > {present} THEN excluded.{name} ELSE {name} END,")
    });
    format!(
        "ON CONFLICT DO UPDATE SET {} {}
             segments = segments + excluded.segments,
             samples = samples + excluded.samples,
             mu_peak = COALESCE(MAX(mu_peak, excluded.mu_peak), mu_peak, excluded.mu_peak),
             newest_at_us = MAX(newest_at_us, excluded.newest_at_us)",
        fixed.join(" "),
        pass.join(" ")
    )
}

fn count(number: u64) -> Result<i64, EngineError> {
    i64::try_from(number).map_err(|_range| EngineError::DoesNotFit("count"))
}

fn bind(row: &mut Row<'_>, (key, sums): &(&SumKey, &Sums)) -> Result<(), EngineError> {
    let (terrain, terrain_revision) = ground::columns(key.terrain.as_ref());
    row.add(key.site_pk)?
        .add(key.cell.iy)?
        .add(key.cell.ix)?
        .add(key.grid_revision)?
        .add(terrain)?
        .add(terrain_revision)?
        .add(key.robot_pk)?
        .add(key.configuration_pk)?
        .add(key.epoch_h)?;
    for fixed in [
        sums.theta.information,
        sums.theta.weighted,
        sums.theta_square,
        sums.track.information,
        sums.track.weighted,
        sums.rolling.information,
        sums.rolling.weighted,
    ] {
        let (hi, lo) = fixed.halves().ok_or(EngineError::DoesNotFit("sum"))?;
        row.add(hi)?.add(lo)?;
    }
    let newest = sums.newest;
    row.add(count(sums.segments)?)?
        .add(count(sums.samples)?)?
        .add(sums.mu_peak)?
        .add(sums.newest_at_us)?
        .add(newest.theta.map(|theta| theta.information))?
        .add(newest.theta.map(|theta| theta.weighted))?
        .add(newest.mu_peak)?
        .add(newest.ended_at_us)?;
    for fixed in [sums.robot_error, sums.tyre_error] {
        let (hi, lo) = fixed.halves().ok_or(EngineError::DoesNotFit("sum"))?;
        row.add(hi)?.add(lo)?;
    }
    Ok(())
}

/// Adds sums to the stored ones.
pub async fn add<'sums>(
    db: &mut SqliteConnection,
    sums: impl Iterator<Item = (&'sums SumKey, &'sums Sums)>,
) -> Result<(), EngineError> {
    let rows: Vec<_> = sums.collect();
    ADD.execute(db, &rows, bind).await?;
    Ok(())
}

struct Raw {
    site_pk: i64,
    ix: i64,
    iy: i64,
    grid_revision: i64,
    terrain: String,
    terrain_revision: i64,
    robot_pk: i64,
    configuration_pk: i64,
    epoch_h: i64,
    information_hi: i64,
    information_lo: i64,
    weighted_hi: i64,
    weighted_lo: i64,
    square_hi: i64,
    square_lo: i64,
    track_information_hi: i64,
    track_information_lo: i64,
    track_weighted_hi: i64,
    track_weighted_lo: i64,
    rolling_information_hi: i64,
    rolling_information_lo: i64,
    rolling_weighted_hi: i64,
    rolling_weighted_lo: i64,
    segments: i64,
    samples: i64,
    mu_peak: Option<f64>,
    newest_at_us: i64,
    newest_information: Option<f64>,
    newest_weighted: Option<f64>,
    newest_mu: Option<f64>,
    pass_at_us: i64,
    robot_error_hi: i64,
    robot_error_lo: i64,
    tyre_error_hi: i64,
    tyre_error_lo: i64,
}

impl TryFrom<Raw> for SumRow {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        let key = SumKey {
            robot_pk: raw.robot_pk,
            epoch_h: raw.epoch_h,
            cell: ground::cell(raw.ix, raw.iy)?,
            terrain: ground::terrain(&raw.terrain, raw.terrain_revision)?,
            grid_revision: unsigned("grid revision", raw.grid_revision)?,
            site_pk: raw.site_pk,
            configuration_pk: raw.configuration_pk,
        };
        let fixed = Fixed::from_halves;
        let newest_theta = raw.newest_information.zip(raw.newest_weighted);
        let sums = Sums {
            theta: Pair {
                information: fixed(raw.information_hi, raw.information_lo),
                weighted: fixed(raw.weighted_hi, raw.weighted_lo),
            },
            theta_square: fixed(raw.square_hi, raw.square_lo),
            robot_error: fixed(raw.robot_error_hi, raw.robot_error_lo),
            tyre_error: fixed(raw.tyre_error_hi, raw.tyre_error_lo),
            track: Pair {
                information: fixed(raw.track_information_hi, raw.track_information_lo),
                weighted: fixed(raw.track_weighted_hi, raw.track_weighted_lo),
            },
            rolling: Pair {
                information: fixed(raw.rolling_information_hi, raw.rolling_information_lo),
                weighted: fixed(raw.rolling_weighted_hi, raw.rolling_weighted_lo),
            },
            segments: unsigned("count", raw.segments)?,
            samples: unsigned("count", raw.samples)?,
            mu_peak: raw.mu_peak,
            newest_at_us: raw.newest_at_us,
            newest: Pass {
                ended_at_us: raw.pass_at_us,
                theta: newest_theta.map(|(information, weighted)| Information {
                    information,
                    weighted,
                }),
                mu_peak: raw.newest_mu,
            },
        };
        Ok(Self { key, sums })
    }
}

/// Calls `take` with every sum, in no particular order, one at a time.
pub async fn each(
    db: &mut SqliteConnection,
    mut take: impl FnMut(SumRow),
) -> Result<(), EngineError> {
    let mut rows = sqlx::query_as!(
        Raw,
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

/// Returns at most `limit` hours whose sums are to be merged into their days or months, those of a robot
/// one after the other. It looks at each stored hour before a horizon once, not at each sum.
pub async fn unmerged(
    db: &mut SqliteConnection,
    limit: u32,
) -> Result<Vec<StoredHour>, EngineError> {
    let rows = sqlx::query!(
        r#"WITH RECURSIVE stored (robot_pk, epoch_h, days_before_h, months_before_h) AS (
               SELECT robots.pk,
                   (SELECT MIN(epoch_h) FROM cell_sums WHERE robot_pk = robots.pk),
                   merged_before_h, months_before_h
               FROM robots JOIN sites ON sites.pk = robots.site_pk
               UNION ALL
               SELECT robot_pk,
                   (SELECT MIN(next.epoch_h) FROM cell_sums AS next
                    WHERE next.robot_pk = stored.robot_pk AND next.epoch_h > stored.epoch_h),
                   days_before_h, months_before_h
               FROM stored WHERE epoch_h < days_before_h
               ORDER BY 1, 2
           )
           SELECT robot_pk AS "robot_pk!: i64", epoch_h AS "epoch_h!: i64",
               days_before_h AS "days_before_h!: i64", months_before_h AS "months_before_h!: i64"
           FROM stored
           WHERE epoch_h < days_before_h AND epoch_h % 24 <> 0
               OR epoch_h < months_before_h
                   AND strftime('%d %H', epoch_h * 3600, 'unixepoch') <> '01 00'
           LIMIT ?"#,
        limit,
    );
    let rows = rows.fetch_all(db).await?;
    let hours = rows.into_iter().map(|row| StoredHour {
        robot_pk: row.robot_pk,
        epoch_h: row.epoch_h,
        horizons: Horizons {
            days_before_h: row.days_before_h,
            months_before_h: row.months_before_h,
        },
    });
    Ok(hours.collect())
}

/// Returns at most `limit` sums of one robot and hour, in the order of the table.
pub async fn of_hour(
    db: &mut SqliteConnection,
    (robot_pk, epoch_h): (i64, i64),
    limit: usize,
) -> Result<Vec<SumRow>, EngineError> {
    let limit = i64::try_from(limit).unwrap_or(i64::MAX);
    let raw = sqlx::query_as!(
        Raw,
        r#"SELECT site_pk, ix, iy, grid_revision, terrain, terrain_revision, robot_pk,
               configuration_pk, epoch_h, information_hi, information_lo, weighted_hi, weighted_lo,
               square_hi, square_lo, track_information_hi, track_information_lo,
               track_weighted_hi, track_weighted_lo, rolling_information_hi,
               rolling_information_lo, rolling_weighted_hi, rolling_weighted_lo, segments,
               samples, mu_peak, newest_at_us, newest_information, newest_weighted, newest_mu,
               pass_at_us, robot_error_hi, robot_error_lo, tyre_error_hi, tyre_error_lo
           FROM cell_sums WHERE robot_pk = ?1 AND epoch_h = ?2 LIMIT ?3"#,
        robot_pk,
        epoch_h,
        limit,
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(SumRow::try_from).collect()
}

/// Removes one sum; `false` if it does not exist.
pub async fn remove(db: &mut SqliteConnection, key: &SumKey) -> Result<bool, EngineError> {
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
        "DELETE FROM cell_sums WHERE robot_pk = ? AND epoch_h = ? AND iy = ? AND ix = ?
             AND terrain = ? AND terrain_revision = ? AND grid_revision = ? AND site_pk = ?
             AND configuration_pk = ?",
        robot_pk,
        epoch_h,
        cell.iy,
        cell.ix,
        id,
        revision,
        grid_revision,
        site_pk,
        configuration_pk,
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected() == 1)
}

/// Removes the sums of a robot between two hours, both included. Returns their number.
pub async fn remove_hours(
    db: &mut SqliteConnection,
    robot_pk: i64,
    (from_h, to_h): (i64, i64),
) -> Result<u64, EngineError> {
    let done = sqlx::query!(
        "DELETE FROM cell_sums WHERE robot_pk = ? AND epoch_h BETWEEN ? AND ?",
        robot_pk,
        from_h,
        to_h,
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected())
}
