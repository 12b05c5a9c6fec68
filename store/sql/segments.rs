//! Raw measurements, in the order of their commits.
//!
//! Their values have a table of typed columns; what the measurements of a range have in common is in
//! the ledger ([`super::segment_ranges`]).

use std::ops::RangeInclusive;

use futures_util::{Stream, StreamExt as _};
use jiff::Timestamp;
use tread_api::friction::{Information, Segment, StoredSegment, ThetaErrors};
use tread_api::ids::{RobotId, TerrainId};
pub use tread_store::segments::{
    Added, Extent, KeyedSegment, NewSegment, RobotCursor, SegmentFilter, SiteCursor,
};

pub use super::segment_ranges::first_since;
pub use super::segment_rows::insert;
use super::segment_rows::measurements;
use super::{
    Connection, EngineError, corrupt, from_us, ground, parse, robots_text, segment_ranges, unsigned,
};

/// Limit beyond every number of measurements; a statement may add to it.
const EVERYTHING: i64 = i64::MAX - 1;

/// A row of the statement of `measurements!`.
struct Raw {
    pk: i64,
    range_pk: i64,
    robot_pk: i64,
    site_pk: i64,
    configuration_pk: i64,
    robot: String,
    boot: String,
    seq: i64,
    received_at_us: i64,
    configuration: String,
    mission: Option<String>,
    grid_revision: i64,
    terrain: String,
    terrain_revision: i64,
    started_at_ns: i64,
    ended_at_ns: i64,
    ix: i64,
    iy: i64,
    theta_information: f64,
    theta_weighted: f64,
    independent_information: Option<f64>,
    robot_error_ratio: Option<f64>,
    tyre_error_ratio: Option<f64>,
    track_information: Option<f64>,
    track_weighted: Option<f64>,
    rolling_information: Option<f64>,
    rolling_weighted: Option<f64>,
    mu_peak_lower_bound: Option<f64>,
    samples: i64,
    distance_m: f64,
    saturation_ratio: f64,
}

fn from_ns(ns: i64) -> Result<Timestamp, EngineError> {
    Timestamp::from_nanosecond(ns.into()).map_err(|_range| corrupt("time", ns))
}

impl Raw {
    fn segment(&self) -> Result<Segment, EngineError> {
        let errors = self.independent_information.zip(self.robot_error_ratio);
        let track = self.track_information.zip(self.track_weighted);
        let rolling = self.rolling_information.zip(self.rolling_weighted);
        let mission = self.mission.as_deref().map(|id| parse("mission", id));
        Ok(Segment {
            configuration: parse("configuration", &self.configuration)?,
            mission: mission.transpose()?,
            started_at: from_ns(self.started_at_ns)?,
            ended_at: from_ns(self.ended_at_ns)?,
            grid_revision: unsigned("revision", self.grid_revision)?,
            cell: ground::cell(self.ix, self.iy)?,
            terrain: ground::terrain(&self.terrain, self.terrain_revision)?,
            theta: Information {
                information: self.theta_information,
                weighted: self.theta_weighted,
            },
            theta_errors: errors.zip(self.tyre_error_ratio).map(
                |((independent_information, robot_ratio), tyre_ratio)| ThetaErrors {
                    independent_information,
                    robot_ratio,
                    tyre_ratio,
                },
            ),
            effective_track_ratio: track.map(|(information, weighted)| Information {
                information,
                weighted,
            }),
            rolling_resistance: rolling.map(|(information, weighted)| Information {
                information,
                weighted,
            }),
            mu_peak_lower_bound: self.mu_peak_lower_bound,
            samples: unsigned("number", self.samples)?,
            distance_m: self.distance_m,
            saturation_ratio: self.saturation_ratio,
        })
    }
}

impl TryFrom<Raw> for StoredSegment {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        Ok(Self {
            id: raw.pk,
            robot: parse("robot", &raw.robot)?,
            boot: parse("boot", &raw.boot)?,
            seq: unsigned("number", raw.seq)?,
            received_at: from_us(raw.received_at_us)?,
            segment: raw.segment()?,
        })
    }
}

/// Returns the range of measurements of a robot or terrain; without a filter of all sites, since a
/// needless reload of a list costs less than an index.
pub async fn extent(
    db: &mut Connection,
    site_pk: i64,
    filter: &SegmentFilter,
) -> Result<Extent, EngineError> {
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let terrain = filter.terrain.as_ref().map(TerrainId::as_str);
    let (first, last) = match (robot, terrain) {
        (Some(robot), _) => {
            let row = sqlx::query!(
                r#"SELECT
                       (SELECT MIN(first_pk) FROM segment_ranges WHERE robot_pk = robots.pk) AS "first: i64",
                       (SELECT MAX(last_pk) FROM segment_ranges WHERE robot_pk = robots.pk) AS "last: i64"
                   FROM robots WHERE site_pk = $1 AND id = $2"#,
                site_pk,
                robot,
            );
            let row = row.fetch_optional(&mut *db).await?;
            row.map_or((None, None), |row| (row.first, row.last))
        }
        (None, Some(terrain)) => {
            let row = sqlx::query!(
                r#"SELECT
                       (SELECT MIN(first_pk) FROM segment_ranges WHERE site_pk = $1 AND terrain = $2)
                           AS "first: i64",
                       (SELECT MAX(last_pk) FROM segment_ranges WHERE site_pk = $1 AND terrain = $2)
                           AS "last: i64""#,
                site_pk,
                terrain,
            );
            let row = row.fetch_one(&mut *db).await?;
            (row.first, row.last)
        }
        (None, None) => segment_ranges::ends(db).await?.unzip(),
    };
    let last_at_us = match last {
        Some(last) => segment_ranges::received_at_us(db, last).await?,
        None => None,
    };
    Ok(Extent {
        first,
        last,
        last_at_us,
    })
}

/// Returns a site's measurements in the order of their commits.
pub async fn list(
    db: &mut Connection,
    site_pk: i64,
    filter: &SegmentFilter,
    limit: u32,
) -> Result<Vec<StoredSegment>, EngineError> {
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let terrain = filter.terrain.as_ref().map(TerrainId::as_str);
    let named = robots_text(filter.robots.as_ref())?;
    // One statement per kind of filter, so that each uses its own index. A plus sign excludes a
    // column from the choice of index.
    let raw = match (robot, terrain) {
        (Some(robot), _) => {
            measurements!(
            "AND segment_ranges.robot_pk = (SELECT pk FROM robots WHERE site_pk = $3 AND id = $4)
                 AND (CAST($5 AS TEXT) IS NULL OR terrain = $5)
                 AND (CAST($6 AS TEXT) IS NULL OR robots.id IN (SELECT value FROM json_each($6)))",
            filter.after,
            i64::from(limit),
            site_pk,
            robot,
            terrain,
            named,
        )
            .fetch_all(db)
            .await?
        }
        (None, Some(terrain)) => {
            measurements!(
                "AND segment_ranges.site_pk = $3 AND terrain = $4
                 AND (CAST($5 AS TEXT) IS NULL OR robots.id IN (SELECT value FROM json_each($5)))",
                filter.after,
                i64::from(limit),
                site_pk,
                terrain,
                named,
            )
            .fetch_all(db)
            .await?
        }
        (None, None) => {
            measurements!(
                "AND +segment_ranges.site_pk = $3
                 AND (CAST($4 AS TEXT) IS NULL OR robots.id IN (SELECT value FROM json_each($4)))",
                filter.after,
                i64::from(limit),
                site_pk,
                named,
            )
            .fetch_all(db)
            .await?
        }
    };
    raw.into_iter().map(StoredSegment::try_from).collect()
}

impl TryFrom<Raw> for KeyedSegment {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        Ok(Self {
            pk: raw.pk,
            range_pk: raw.range_pk,
            robot_pk: raw.robot_pk,
            robot: parse("robot", &raw.robot)?,
            site_pk: raw.site_pk,
            configuration_pk: raw.configuration_pk,
            segment: raw.segment()?,
        })
    }
}

/// Returns all measurements of a robot after a cursor, in the order of their commits.
pub fn of_robot(
    db: &mut Connection,
    cursor: RobotCursor,
) -> impl Stream<Item = Result<KeyedSegment, EngineError>> {
    let rows = measurements!(
        "AND segment_ranges.robot_pk = $3",
        cursor.after,
        EVERYTHING,
        cursor.robot_pk,
    );
    rows.fetch(db).map(|raw| KeyedSegment::try_from(raw?))
}

/// Returns at most `limit` measurements of a site in the order of their commits, after a cursor.
pub async fn of_site(
    db: &mut Connection,
    cursor: SiteCursor,
    limit: u32,
) -> Result<Vec<KeyedSegment>, EngineError> {
    let rows = measurements!(
        "AND +segment_ranges.site_pk = $3",
        cursor.after,
        i64::from(limit),
        cursor.site_pk
    );
    let rows = rows.fetch_all(db).await?;
    rows.into_iter().map(KeyedSegment::try_from).collect()
}

/// Returns at most `limit` measurements of all sites in a range of keys, in the order of their commits,
/// each with the key of its site.
pub async fn of_all_sites(
    db: &mut Connection,
    keys: RangeInclusive<i64>,
    limit: u32,
) -> Result<Vec<(i64, StoredSegment)>, EngineError> {
    let (first, last) = keys.into_inner();
    let after = first - 1;
    let rows = measurements!(
        "AND segment_ranges.first_pk <= $3",
        after,
        i64::from(limit),
        last
    );
    let rows = rows.fetch_all(db).await?;
    let wanted = rows.into_iter().take_while(|raw| raw.pk <= last);
    wanted
        .map(|raw| Ok((raw.site_pk, raw.try_into()?)))
        .collect()
}

/// Returns at most `limit` measurements of all sites in the order of their commits, after a key.
pub async fn after(
    db: &mut Connection,
    after: i64,
    limit: u32,
) -> Result<Vec<KeyedSegment>, EngineError> {
    let rows = measurements!(
        "AND segment_ranges.first_pk <= $3",
        after,
        i64::from(limit),
        i64::MAX
    );
    let rows = rows.fetch_all(db).await?;
    rows.into_iter().map(KeyedSegment::try_from).collect()
}
