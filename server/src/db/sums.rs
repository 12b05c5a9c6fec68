//! Sums of measurements per cell, ground, robot, configuration and hour of measuring.

use sqlx::SqliteConnection;
use tread_api::ids::{ConfigurationId, RobotId, TerrainId};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use super::{DbError, corrupt, from_us, object_json, parse, to_json, unsigned};
use crate::friction::Sums;
use crate::friction::fixed::Fixed;

/// What one sum is about.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SumKey {
    /// Key of the robot.
    pub robot_pk: i64,
    /// Hours since 1970 at the end of the measurement.
    pub epoch_h: i64,
    /// The cell.
    pub cell: Cell,
    /// The ground, if any is drawn.
    pub terrain: Option<TerrainRef>,
    /// The grid that cut the cell.
    pub grid_revision: u32,
    /// Key of the site.
    pub site_pk: i64,
    /// Key of the configuration.
    pub configuration_pk: i64,
}

/// Adds sums to those that are there, in one statement.
pub async fn add<'sums>(
    db: &mut SqliteConnection,
    sums: impl Iterator<Item = (&'sums SumKey, &'sums Sums)>,
) -> Result<(), DbError> {
    let mut rows = Vec::new();
    for (key, sums) in sums {
        let terrain = key.terrain.as_ref();
        let out_of_range = || DbError::DoesNotFit("sum");
        let (information_hi, information_lo) =
            sums.information.halves().ok_or_else(out_of_range)?;
        let (weighted_hi, weighted_lo) = sums.weighted.halves().ok_or_else(out_of_range)?;
        let (cell, newest_at_us) = (key.cell, sums.newest_at.as_microsecond());
        let numbers = to_json(
            "sum",
            &(
                (key.site_pk, cell.iy, cell.ix, key.grid_revision),
                terrain.map_or(0, |terrain| terrain.revision),
                (key.robot_pk, key.configuration_pk, key.epoch_h),
                (information_hi, information_lo, weighted_hi, weighted_lo),
                (sums.segments, sums.samples, sums.mu_peak, newest_at_us),
            ),
        )?;
        rows.push((numbers, terrain.map_or("", |terrain| terrain.id.as_str())));
    }
    if rows.is_empty() {
        return Ok(());
    }
    // The numbers are the key and the terrain is the value, which is the cheapest to take apart.
    let rows = object_json("sum", rows)?;
    sqlx::query!(
        "INSERT INTO cell_sums (site_pk, iy, ix, grid_revision, terrain, terrain_revision,
             robot_pk, configuration_pk, epoch_h, information_hi, information_lo, weighted_hi,
             weighted_lo, segments, samples, mu_peak, newest_at_us)
         SELECT key ->> '$[0][0]', key ->> '$[0][1]', key ->> '$[0][2]', key ->> '$[0][3]',
             value, key ->> 1, key ->> '$[2][0]', key ->> '$[2][1]', key ->> '$[2][2]',
             key ->> '$[3][0]', key ->> '$[3][1]', key ->> '$[3][2]', key ->> '$[3][3]',
             key ->> '$[4][0]', key ->> '$[4][1]', key ->> '$[4][2]', key ->> '$[4][3]'
         FROM json_each(?) WHERE true
         ON CONFLICT DO UPDATE SET
             information_hi = information_hi + excluded.information_hi
                 + ((information_lo + excluded.information_lo) >> 32),
             information_lo = (information_lo + excluded.information_lo) & 4294967295,
             weighted_hi = weighted_hi + excluded.weighted_hi
                 + ((weighted_lo + excluded.weighted_lo) >> 32),
             weighted_lo = (weighted_lo + excluded.weighted_lo) & 4294967295,
             segments = segments + excluded.segments,
             samples = samples + excluded.samples,
             mu_peak = COALESCE(MAX(mu_peak, excluded.mu_peak), mu_peak, excluded.mu_peak),
             newest_at_us = MAX(newest_at_us, excluded.newest_at_us)",
        rows,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// A sum over cells for one robot, configuration and hour.
#[derive(Debug, Clone, PartialEq)]
pub struct SumRow {
    /// The cell; the first one where several are summed.
    pub cell: Cell,
    /// The ground, if any is drawn.
    pub terrain: Option<TerrainRef>,
    /// The configuration that measured.
    pub configuration: ConfigurationId,
    /// The configuration's model, if a robot has declared it.
    pub model: Option<String>,
    /// The robot that measured.
    pub robot: RobotId,
    /// The sums.
    pub sums: Sums,
}

struct Raw {
    ix: i64,
    iy: i64,
    terrain: String,
    terrain_revision: i64,
    configuration: String,
    model: Option<String>,
    robot: String,
    information_hi: i64,
    information_lo: i64,
    weighted_hi: i64,
    weighted_lo: i64,
    segments: i64,
    samples: i64,
    mu_peak: Option<f64>,
    newest_at_us: i64,
}

impl TryFrom<Raw> for SumRow {
    type Error = DbError;

    fn try_from(raw: Raw) -> Result<Self, DbError> {
        let index = |value: i64| i32::try_from(value).map_err(|_range| corrupt("cell", value));
        let terrain = if raw.terrain.is_empty() {
            None
        } else {
            Some(TerrainRef {
                id: parse("terrain", &raw.terrain)?,
                revision: unsigned("terrain revision", raw.terrain_revision)?,
            })
        };
        let sums = Sums {
            information: Fixed::from_halves(raw.information_hi, raw.information_lo),
            weighted: Fixed::from_halves(raw.weighted_hi, raw.weighted_lo),
            segments: unsigned("count", raw.segments)?,
            samples: unsigned("count", raw.samples)?,
            mu_peak: raw.mu_peak,
            newest_at: from_us(raw.newest_at_us)?,
        };
        Ok(Self {
            cell: Cell {
                ix: index(raw.ix)?,
                iy: index(raw.iy)?,
            },
            terrain,
            configuration: parse("configuration", &raw.configuration)?,
            model: raw.model,
            robot: parse("robot", &raw.robot)?,
            sums,
        })
    }
}

/// Sums over all cells of one terrain, by configuration, robot and hour, in that order.
///
/// All revisions with the present polygon and class count: a new name changes no ground.
pub async fn of_terrain(
    db: &mut SqliteConnection,
    site_pk: i64,
    terrain: &TerrainId,
) -> Result<Vec<SumRow>, DbError> {
    let terrain = terrain.as_str();
    let raw = sqlx::query_as!(
        Raw,
        r#"SELECT MIN(s.ix) AS "ix!: i64", MIN(s.iy) AS "iy!: i64", t.id AS "terrain!",
               t.revision AS "terrain_revision!",
               configurations.id AS "configuration!",
               configurations.model ->> '$.name' AS "model: String", robots.id AS "robot!",
               SUM(s.information_hi) AS "information_hi!: i64",
               SUM(s.information_lo) AS "information_lo!: i64",
               SUM(s.weighted_hi) AS "weighted_hi!: i64",
               SUM(s.weighted_lo) AS "weighted_lo!: i64",
               SUM(s.segments) AS "segments!: i64", SUM(s.samples) AS "samples!: i64",
               MAX(s.mu_peak) AS "mu_peak: f64", MAX(s.newest_at_us) AS "newest_at_us!: i64"
           FROM terrains t
           JOIN terrain_revisions r ON r.site_pk = t.site_pk AND r.id = t.id
               AND r.polygon = t.polygon AND r.class = t.class
           JOIN cell_sums s ON s.site_pk = r.site_pk AND s.terrain = r.id
               AND s.terrain_revision = r.revision
           JOIN robots ON robots.pk = s.robot_pk
           JOIN configurations ON configurations.pk = s.configuration_pk
           WHERE t.site_pk = ?1 AND t.id = ?2
           GROUP BY configurations.id, robots.id, s.epoch_h
           ORDER BY configurations.id, robots.id, s.epoch_h"#,
        site_pk,
        terrain,
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(SumRow::try_from).collect()
}

/// A rectangle of cells, both ends included, of one grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CellRange {
    /// The grid.
    pub grid_revision: u32,
    /// The lowest column and row.
    pub min: Cell,
    /// The highest column and row.
    pub max: Cell,
    /// Only cells after this one, row by row.
    pub after: Option<Cell>,
}

/// Sums of the first `limit` cells of a rectangle that hold any, row by row; within a cell by
/// terrain, configuration, robot and hour.
pub async fn of_cells(
    db: &mut SqliteConnection,
    site_pk: i64,
    range: CellRange,
    limit: u32,
) -> Result<Vec<SumRow>, DbError> {
    let CellRange {
        grid_revision,
        min,
        max,
        after,
    } = range;
    // Before the first cell of all: the row below the rectangle.
    let after_row = after.map_or(i64::from(min.iy) - 1, |cell| i64::from(cell.iy));
    let after_column = after.map_or(0, |cell| i64::from(cell.ix));
    let raw = sqlx::query_as!(
        Raw,
        r#"WITH found AS MATERIALIZED (
               SELECT DISTINCT iy, ix FROM cell_sums
               WHERE site_pk = ?1 AND iy BETWEEN ?3 AND ?5 AND ix BETWEEN ?4 AND ?6
                   AND (iy, ix) > (?7, ?8) AND grid_revision = ?2
               ORDER BY iy, ix LIMIT ?9)
           SELECT s.ix AS "ix!", s.iy AS "iy!", s.terrain AS "terrain!",
               s.terrain_revision AS "terrain_revision!", configurations.id AS "configuration!",
               configurations.model ->> '$.name' AS "model: String", robots.id AS "robot!",
               s.information_hi AS "information_hi!", s.information_lo AS "information_lo!",
               s.weighted_hi AS "weighted_hi!", s.weighted_lo AS "weighted_lo!",
               s.segments AS "segments!", s.samples AS "samples!", s.mu_peak,
               s.newest_at_us AS "newest_at_us!"
           FROM found
           JOIN cell_sums s ON s.site_pk = ?1 AND s.iy = found.iy AND s.ix = found.ix
               AND s.grid_revision = ?2
           JOIN robots ON robots.pk = s.robot_pk
           JOIN configurations ON configurations.pk = s.configuration_pk
           ORDER BY s.iy, s.ix, s.terrain, s.terrain_revision, configurations.id, robots.id,
               s.epoch_h"#,
        site_pk,
        grid_revision,
        min.iy,
        min.ix,
        max.iy,
        max.ix,
        after_row,
        after_column,
        limit,
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(SumRow::try_from).collect()
}

/// Every sum of a site, for comparing whole states.
pub async fn all(db: &mut SqliteConnection, site_pk: i64) -> Result<Vec<SumRow>, DbError> {
    let raw = sqlx::query_as!(
        Raw,
        r#"SELECT s.ix AS "ix!", s.iy AS "iy!", s.terrain AS "terrain!",
               s.terrain_revision AS "terrain_revision!", configurations.id AS "configuration!",
               configurations.model ->> '$.name' AS "model: String", robots.id AS "robot!",
               s.information_hi AS "information_hi!", s.information_lo AS "information_lo!",
               s.weighted_hi AS "weighted_hi!", s.weighted_lo AS "weighted_lo!",
               s.segments AS "segments!", s.samples AS "samples!", s.mu_peak,
               s.newest_at_us AS "newest_at_us!"
           FROM cell_sums s
           JOIN robots ON robots.pk = s.robot_pk
           JOIN configurations ON configurations.pk = s.configuration_pk
           WHERE s.site_pk = ?
           ORDER BY s.iy, s.ix, s.grid_revision, s.terrain, s.terrain_revision, robots.id,
               configurations.id, s.epoch_h"#,
        site_pk,
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(SumRow::try_from).collect()
}
