//! Sums: adding to the stored ones, and the hours that are to be merged.

use std::sync::LazyLock;

use tread_store::friction::sums::TELLING_DEVIATIONS;
use tread_store::friction::{Horizons, Sums};
use tread_store::sums::{StoredHour, SumKey};

use super::rows::{Row, RowsStatement, RowsText};
use super::{Connection, EngineError, ground};

/// Number of columns.
const COLUMNS: usize = 35;

static ADD: LazyLock<RowsStatement> = LazyLock::new(|| {
    RowsStatement::new(&RowsText {
        into: "INSERT INTO cell_sums (site_pk, iy, ix, grid_revision, terrain, terrain_revision,
             robot_pk, configuration_pk, epoch_h, information_hi, information_lo, weighted_hi,
             weighted_lo, square_hi, square_lo, track_information_hi, track_information_lo,
             track_weighted_hi, track_weighted_lo, rolling_information_hi, rolling_information_lo,
             rolling_weighted_hi, rolling_weighted_lo, segments, samples, mu_peak, newest_at_us,
             newest_information, newest_weighted, newest_mu, pass_at_us, robot_error_hi,
             robot_error_lo, tyre_error_hi, tyre_error_lo)",
        columns: COLUMNS,
        then: &added(),
    })
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
    db: &mut Connection,
    sums: impl Iterator<Item = (&'sums SumKey, &'sums Sums)>,
) -> Result<(), EngineError> {
    let rows: Vec<_> = sums.collect();
    ADD.execute(db, &rows, bind).await?;
    Ok(())
}

/// Returns at most `limit` hours whose sums are to be merged into their days or months, those of a robot
/// one after the other. It looks at each stored hour before a horizon once, not at each sum.
pub async fn unmerged(db: &mut Connection, limit: u32) -> Result<Vec<StoredHour>, EngineError> {
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
           LIMIT $1"#,
        i64::from(limit),
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
