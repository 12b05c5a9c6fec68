//! Sums: adding to the stored ones, and the hours that are to be merged.
//!
//! Sums are read, added in memory and written. Only one transaction writes at a time, so nobody changes
//! them meanwhile, and the result is that of [`Sums::add`] by construction.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use tread_store::friction::fixed::Fixed;
use tread_store::friction::{Horizons, Sums};
use tread_store::sums::{StoredHour, SumKey, SumRow};

use super::sum_columns::RawSum;
use super::{Connection, EngineError, ground};

/// Number of sums that are read and written together.
const CHUNK: usize = 2_000;

/// Columns of the key, without the terrain's name, which is text.
const KEY: [&str; 8] = [
    "robot_pk",
    "epoch_h",
    "iy",
    "ix",
    "terrain_revision",
    "grid_revision",
    "site_pk",
    "configuration_pk",
];
/// Other columns of integers.
const INTEGERS: [&str; 22] = [
    "information_hi",
    "information_lo",
    "weighted_hi",
    "weighted_lo",
    "square_hi",
    "square_lo",
    "track_information_hi",
    "track_information_lo",
    "track_weighted_hi",
    "track_weighted_lo",
    "rolling_information_hi",
    "rolling_information_lo",
    "rolling_weighted_hi",
    "rolling_weighted_lo",
    "robot_error_hi",
    "robot_error_lo",
    "tyre_error_hi",
    "tyre_error_lo",
    "segments",
    "samples",
    "newest_at_us",
    "pass_at_us",
];
const REALS: [&str; 4] = [
    "mu_peak",
    "newest_information",
    "newest_weighted",
    "newest_mu",
];

/// Writes sums, whether they exist already or not.
static PUT: LazyLock<String> = LazyLock::new(|| {
    let integers = KEY.iter().chain(&INTEGERS);
    let columns = ["terrain"].iter().chain(integers).chain(&REALS);
    let columns: Vec<&str> = columns.copied().collect();
    let arrays = (1..=columns.len()).map(|place| {
        let kind = match place {
            1 => "TEXT",
            place if place <= 1 + KEY.len() + INTEGERS.len() => "BIGINT",
            _ => "DOUBLE PRECISION",
        };
        format!("CAST(${place} AS {kind}[])")
    });
    let arrays: Vec<String> = arrays.collect();
    let values = INTEGERS.iter().chain(&REALS);
    let values: Vec<String> = values
        .map(|name| format!("{name} = excluded.{name}"))
        .collect();
    format!(
        "INSERT INTO cell_sums ({}) SELECT * FROM UNNEST({})
         ON CONFLICT (terrain, {}) DO UPDATE SET {}",
        columns.join(", "),
        arrays.join(", "),
        KEY.join(", "),
        values.join(", ")
    )
});

/// Columns of keys, each as a list.
#[derive(Debug, Default)]
struct KeyColumns {
    terrain: Vec<String>,
    integers: [Vec<i64>; KEY.len()],
}

impl KeyColumns {
    fn push(&mut self, key: &SumKey) {
        let (terrain, terrain_revision) = ground::columns(key.terrain.as_ref());
        self.terrain.push(terrain.to_owned());
        let integers = [
            key.robot_pk,
            key.epoch_h,
            key.cell.iy.into(),
            key.cell.ix.into(),
            terrain_revision.into(),
            key.grid_revision.into(),
            key.site_pk,
            key.configuration_pk,
        ];
        for (column, value) in self.integers.iter_mut().zip(integers) {
            column.push(value);
        }
    }
}

fn count(number: u64) -> Result<i64, EngineError> {
    i64::try_from(number).map_err(|_range| EngineError::DoesNotFit("count"))
}

/// Returns the numbers in fixed point, in the order of their columns.
fn fixed(sums: &Sums) -> [Fixed; 9] {
    [
        sums.theta.information,
        sums.theta.weighted,
        sums.theta_square,
        sums.track.information,
        sums.track.weighted,
        sums.rolling.information,
        sums.rolling.weighted,
        sums.robot_error,
        sums.tyre_error,
    ]
}

/// Returns the values of [`INTEGERS`].
fn integers(sums: &Sums) -> Result<[i64; INTEGERS.len()], EngineError> {
    let mut values = [0; INTEGERS.len()];
    // One robot's sum that overflows must not fail the transaction of all.
    let halves = fixed(sums).into_iter().map(|fixed| {
        let (hi, lo) = fixed.clamped_halves();
        [hi, lo]
    });
    let others = [
        count(sums.segments)?,
        count(sums.samples)?,
        sums.newest_at_us,
        sums.newest.ended_at_us,
    ];
    for (value, number) in values.iter_mut().zip(halves.flatten().chain(others)) {
        *value = number;
    }
    Ok(values)
}

/// Returns the values of [`REALS`].
fn reals(sums: &Sums) -> [Option<f64>; REALS.len()] {
    let theta = sums.newest.theta;
    [
        sums.mu_peak,
        theta.map(|theta| theta.information),
        theta.map(|theta| theta.weighted),
        sums.newest.mu_peak,
    ]
}

/// Adds sums to the stored ones.
pub async fn add<'sums>(
    db: &mut Connection,
    sums: impl Iterator<Item = (&'sums SumKey, &'sums Sums)>,
) -> Result<(), EngineError> {
    let mut added: BTreeMap<&SumKey, Sums> = BTreeMap::new();
    for (key, sums) in sums {
        // A sum that exceeds what the database can store is refused here, as by the other engine.
        if fixed(sums).iter().any(|fixed| fixed.halves().is_none()) {
            return Err(EngineError::DoesNotFit("sum"));
        }
        added
            .entry(key)
            .and_modify(|present| present.add(sums))
            .or_insert(*sums);
    }
    let mut rows: Vec<(&SumKey, Sums)> = added.into_iter().collect();
    for chunk in rows.chunks_mut(CHUNK) {
        for (key, stored) in stored(db, chunk).await? {
            if let Ok(place) = chunk.binary_search_by(|(of, _)| (*of).cmp(&key)) {
                let mut total = stored;
                total.add(&chunk[place].1);
                chunk[place].1 = total;
            }
        }
        put(db, chunk).await?;
    }
    Ok(())
}

/// Returns the stored sums under some keys.
async fn stored(
    db: &mut Connection,
    rows: &[(&SumKey, Sums)],
) -> Result<Vec<(SumKey, Sums)>, EngineError> {
    let mut keys = KeyColumns::default();
    for (key, _) in rows {
        keys.push(key);
    }
    let [
        robot,
        hour,
        iy,
        ix,
        terrain_revision,
        grid,
        site,
        configuration,
    ] = &keys.integers;
    let found = sqlx::query_as!(
        RawSum,
        "SELECT site_pk, ix, iy, grid_revision, terrain, terrain_revision, robot_pk,
             configuration_pk, epoch_h, information_hi, information_lo, weighted_hi, weighted_lo,
             square_hi, square_lo, track_information_hi, track_information_lo,
             track_weighted_hi, track_weighted_lo, rolling_information_hi,
             rolling_information_lo, rolling_weighted_hi, rolling_weighted_lo, segments,
             samples, mu_peak, newest_at_us, newest_information, newest_weighted, newest_mu,
             pass_at_us, robot_error_hi, robot_error_lo, tyre_error_hi, tyre_error_lo
         FROM cell_sums
         WHERE (robot_pk, epoch_h, iy, ix, terrain, terrain_revision, grid_revision, site_pk,
                 configuration_pk) IN (
             SELECT * FROM UNNEST(CAST($1 AS BIGINT[]), CAST($2 AS BIGINT[]),
                 CAST($3 AS BIGINT[]), CAST($4 AS BIGINT[]), CAST($5 AS TEXT[]),
                 CAST($6 AS BIGINT[]), CAST($7 AS BIGINT[]), CAST($8 AS BIGINT[]),
                 CAST($9 AS BIGINT[])))",
        robot,
        hour,
        iy,
        ix,
        &keys.terrain,
        terrain_revision,
        grid,
        site,
        configuration,
    )
    .fetch_all(db)
    .await?;
    let read = found.into_iter().map(|raw| {
        let row = SumRow::try_from(raw)?;
        Ok((row.key, row.sums))
    });
    read.collect()
}

/// Writes sums in place of the stored ones.
async fn put(db: &mut Connection, rows: &[(&SumKey, Sums)]) -> Result<(), EngineError> {
    let mut keys = KeyColumns::default();
    let mut integer_columns: [Vec<i64>; INTEGERS.len()] = Default::default();
    let mut real_columns: [Vec<Option<f64>>; REALS.len()] = Default::default();
    for (key, sums) in rows {
        keys.push(key);
        for (column, value) in integer_columns.iter_mut().zip(integers(sums)?) {
            column.push(value);
        }
        for (column, value) in real_columns.iter_mut().zip(reals(sums)) {
            column.push(value);
        }
    }
    let mut putting = sqlx::query(PUT.as_str()).bind(keys.terrain);
    for column in keys.integers.into_iter().chain(integer_columns) {
        putting = putting.bind(column);
    }
    for column in real_columns {
        putting = putting.bind(column);
    }
    putting.execute(db).await?;
    Ok(())
}

/// Returns at most `limit` hours whose sums are to be merged into their days or months, those of a robot
/// one after the other. It looks at each stored hour before a horizon once, not at each sum.
pub async fn unmerged(db: &mut Connection, limit: u32) -> Result<Vec<StoredHour>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT robots.pk AS "robot_pk!", hours.epoch_h AS "epoch_h!",
               sites.merged_before_h AS "days_before_h!", sites.months_before_h AS "months_before_h!"
           FROM robots JOIN sites ON sites.pk = robots.site_pk
           CROSS JOIN LATERAL (
               WITH RECURSIVE stored (epoch_h) AS (
                   SELECT (SELECT MIN(epoch_h) FROM cell_sums WHERE robot_pk = robots.pk)
                   UNION ALL
                   SELECT (SELECT MIN(next.epoch_h) FROM cell_sums AS next
                       WHERE next.robot_pk = robots.pk AND next.epoch_h > stored.epoch_h)
                   FROM stored WHERE stored.epoch_h < sites.merged_before_h
               )
               SELECT epoch_h FROM stored
               WHERE epoch_h < sites.merged_before_h AND epoch_h % 24 <> 0
                   OR epoch_h < sites.months_before_h AND NOT is_begin_of_month(epoch_h)
           ) AS hours
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
