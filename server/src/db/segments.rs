//! Raw measurements, in the order of their commits.

use std::collections::BTreeSet;
use std::sync::LazyLock;

use jiff::Timestamp;
use serde_json::value::RawValue;
use sqlx::SqliteConnection;
use tread_api::friction::{Segment, StoredSegment};
use tread_api::ids::{RobotId, TerrainId};

use super::rows::{Row, RowsStatement};
use super::{DbError, from_json, from_us, parse, robots_text, to_us, unsigned};

/// A measurement to be stored.
#[derive(Debug)]
pub struct NewSegment<'segment>(
    /// Key of the run of the agent.
    pub i64,
    /// Its sequence number within that run.
    pub i64,
    /// Key of the robot.
    pub i64,
    /// Key of the site.
    pub i64,
    /// Identifier of the terrain; `""` for none.
    pub &'segment str,
    /// The measurement as JSON.
    pub &'segment RawValue,
);

/// Number of columns of a measurement.
const COLUMNS: usize = 7;

static INSERT: LazyLock<RowsStatement> = LazyLock::new(|| {
    RowsStatement::new(
        "INSERT INTO segments
             (boot_pk, seq, robot_pk, site_pk, terrain, received_at_us, measurement)",
        COLUMNS,
        "ON CONFLICT (boot_pk, seq) DO NOTHING",
    )
});

/// Those of the given measurements that were new.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum New {
    /// All of them.
    All,
    /// Those with these names (run and sequence number), in the given order.
    Only(Vec<(i64, i64)>),
}

/// Keys of measurements that were added together; empty if `last` is before `first`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Added {
    /// Key of the first one.
    pub first: i64,
    /// Key of the last one.
    pub last: i64,
}

/// Stores the measurements that are not stored yet.
pub async fn insert_new(
    db: &mut SqliteConnection,
    segments: &[NewSegment<'_>],
    received_at: Timestamp,
) -> Result<(New, Added), DbError> {
    if segments.is_empty() {
        return Ok((New::All, Added { first: 1, last: 0 }));
    }
    let last = sqlx::query!(
        r#"SELECT pk AS "pk!", received_at_us FROM segments ORDER BY pk DESC LIMIT 1"#
    );
    let last = last.fetch_optional(&mut *db).await?;
    let (last, last_us) = last.map_or((0, i64::MIN), |row| (row.pk, row.received_at_us));
    // Times are in the order of commits, whatever the clock did.
    let received_at_us = to_us(received_at).max(last_us);
    let bind = |row: &mut Row<'_>, segment: &NewSegment<'_>| {
        let NewSegment(boot_pk, seq, robot_pk, site_pk, terrain, measurement) = *segment;
        row.add(boot_pk)?
            .add(seq)?
            .add(robot_pk)?
            .add(site_pk)?
            .add(terrain)?
            .add(received_at_us)?
            .add(measurement.get())?;
        Ok(())
    };
    let inserted = INSERT.execute(&mut *db, segments, bind).await?;
    // The one writer assigns increasing keys without gaps, so the rows added now follow the earlier
    // ones.
    let added = Added {
        first: last + 1,
        last: last.saturating_add_unsigned(inserted),
    };
    if usize::try_from(inserted) == Ok(segments.len()) {
        return Ok((New::All, added));
    }
    let rows = sqlx::query!(
        "SELECT boot_pk, seq FROM segments WHERE pk > ? ORDER BY pk",
        last
    );
    let rows = rows.fetch_all(db).await?;
    let names = rows.into_iter().map(|row| (row.boot_pk, row.seq)).collect();
    Ok((New::Only(names), added))
}

/// Filter of a list of measurements.
#[derive(Debug, Clone, Default)]
pub struct SegmentFilter {
    /// Only those of this robot.
    pub robot: Option<RobotId>,
    /// Only those on this terrain.
    pub terrain: Option<TerrainId>,
    /// Only those of these robots.
    pub robots: Option<BTreeSet<RobotId>>,
    /// Only those with a larger key (cursor).
    pub after: i64,
}

struct Raw {
    pk: i64,
    robot: String,
    boot: String,
    seq: i64,
    received_at_us: i64,
    measurement: String,
}

impl TryFrom<Raw> for StoredSegment {
    type Error = DbError;

    fn try_from(raw: Raw) -> Result<Self, DbError> {
        Ok(Self {
            id: raw.pk,
            robot: parse("robot", &raw.robot)?,
            boot: parse("boot", &raw.boot)?,
            seq: unsigned("number", raw.seq)?,
            received_at: from_us(raw.received_at_us)?,
            segment: from_json("measurement", &raw.measurement)?,
        })
    }
}

macro_rules! segments {
    ($condition:tt, $($argument:expr),* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT segments.pk AS "pk!", robots.id AS robot, boots.id AS boot, segments.seq,
                   segments.received_at_us, segments.measurement
               FROM segments
               JOIN robots ON robots.pk = segments.robot_pk
               JOIN boots ON boots.pk = segments.boot_pk "# + $condition,
            $($argument),*
        )
    };
}

/// Range of stored measurements; it changes whenever one is added or removed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Extent {
    /// Key of the oldest one; measurements are removed from the oldest on.
    pub first: Option<i64>,
    /// Key of the newest one.
    pub last: Option<i64>,
    /// Time at which the newest one was received, microseconds since 1970: keys may restart after
    /// all were removed.
    pub last_at_us: Option<i64>,
}

/// Returns the range of measurements of a robot or terrain; without a filter of all sites, since a
/// needless reload of a list costs less than an index.
pub async fn extent(
    db: &mut SqliteConnection,
    site_pk: i64,
    filter: &SegmentFilter,
) -> Result<Extent, DbError> {
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let terrain = filter.terrain.as_ref().map(TerrainId::as_str);
    let (first, last) = match (robot, terrain) {
        (Some(robot), _) => {
            let row = sqlx::query!(
                r#"SELECT
                       (SELECT MIN(pk) FROM segments WHERE robot_pk = robots.pk) AS "first: i64",
                       (SELECT MAX(pk) FROM segments WHERE robot_pk = robots.pk) AS "last: i64"
                   FROM robots WHERE site_pk = ? AND id = ?"#,
                site_pk,
                robot,
            );
            let row = row.fetch_optional(&mut *db).await?;
            row.map_or((None, None), |row| (row.first, row.last))
        }
        (None, Some(terrain)) => {
            let row = sqlx::query!(
                r#"SELECT
                       (SELECT MIN(pk) FROM segments WHERE site_pk = ?1 AND terrain = ?2)
                           AS "first: i64",
                       (SELECT MAX(pk) FROM segments WHERE site_pk = ?1 AND terrain = ?2)
                           AS "last: i64""#,
                site_pk,
                terrain,
            );
            let row = row.fetch_one(&mut *db).await?;
            (row.first, row.last)
        }
        (None, None) => {
            let row = sqlx::query!(
                r#"SELECT (SELECT MIN(pk) FROM segments) AS "first: i64",
                       (SELECT MAX(pk) FROM segments) AS "last: i64""#
            );
            let row = row.fetch_one(&mut *db).await?;
            (row.first, row.last)
        }
    };
    let last_at_us = match last {
        Some(last) => {
            let at_us =
                sqlx::query_scalar!("SELECT received_at_us FROM segments WHERE pk = ?", last);
            at_us.fetch_optional(db).await?
        }
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
    db: &mut SqliteConnection,
    site_pk: i64,
    filter: &SegmentFilter,
    limit: u32,
) -> Result<Vec<StoredSegment>, DbError> {
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let terrain = filter.terrain.as_ref().map(TerrainId::as_str);
    let named = robots_text(filter.robots.as_ref())?;
    // One statement per kind of filter, so that each uses its own index. A plus sign excludes a
    // column from the choice of index.
    let raw = match (robot, terrain) {
        (Some(robot), _) => {
            segments!(
                "WHERE segments.robot_pk = (SELECT pk FROM robots WHERE site_pk = ?1 AND id = ?2)
                   AND segments.pk > ?3 AND (?4 IS NULL OR segments.terrain = ?4)
                   AND (?6 IS NULL OR robots.id IN (SELECT value FROM json_each(?6)))
                 ORDER BY segments.pk LIMIT ?5",
                site_pk,
                robot,
                filter.after,
                terrain,
                limit,
                named,
            )
            .fetch_all(db)
            .await?
        }
        (None, Some(terrain)) => {
            segments!(
                "WHERE segments.site_pk = ?1 AND segments.terrain = ?2 AND segments.pk > ?3
                   AND (?5 IS NULL OR robots.id IN (SELECT value FROM json_each(?5)))
                 ORDER BY segments.pk LIMIT ?4",
                site_pk,
                terrain,
                filter.after,
                limit,
                named,
            )
            .fetch_all(db)
            .await?
        }
        (None, None) => {
            segments!(
                "WHERE +segments.site_pk = ?1 AND segments.pk > ?2
                   AND (?4 IS NULL OR robots.id IN (SELECT value FROM json_each(?4)))
                 ORDER BY segments.pk LIMIT ?3",
                site_pk,
                filter.after,
                limit,
                named,
            )
            .fetch_all(db)
            .await?
        }
    };
    raw.into_iter().map(StoredSegment::try_from).collect()
}

/// A measurement of a site as it is stored, with what decides whether it is on the map.
#[derive(Debug)]
pub struct SiteSegment {
    /// Key of the robot.
    pub robot_pk: i64,
    /// The robot.
    pub robot: RobotId,
    measurement: String,
}

impl SiteSegment {
    /// Decodes the measurement.
    ///
    /// # Errors
    /// The stored measurement is damaged.
    pub fn segment(&self) -> Result<Segment, DbError> {
        from_json("measurement", &self.measurement)
    }
}

/// Returns the key of the first measurement that was received at a time or later, if none that was
/// can have been removed; else `None`. Keys are in the order of receipt, begin at 1 and have no
/// gaps; the first ones are removed first, the last one never is.
pub async fn first_since(db: &mut SqliteConnection, at: Timestamp) -> Result<Option<i64>, DbError> {
    let at_us = to_us(at);
    let ends = sqlx::query!(
        r#"SELECT (SELECT MIN(pk) FROM segments) AS "first: i64",
               (SELECT MAX(pk) FROM segments) AS "last: i64""#
    );
    let ends = ends.fetch_one(&mut *db).await?;
    let Some((first, last)) = ends.first.zip(ends.last) else {
        return Ok(None);
    };
    let (mut low, mut high) = (first, last + 1);
    while low < high {
        let middle = low + (high - low) / 2;
        let received = sqlx::query_scalar!(
            "SELECT received_at_us FROM segments WHERE pk >= ? ORDER BY pk LIMIT 1",
            middle
        );
        if received.fetch_one(&mut *db).await? < at_us {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    let is_known = low <= last && (low > first || first == 1);
    Ok(is_known.then_some(low))
}

/// Returns measurements of all sites in the order of their commits, after a key; those of other
/// sites without their content.
pub async fn of_site(
    db: &mut SqliteConnection,
    site_pk: i64,
    after: i64,
    limit: u32,
) -> Result<Vec<(i64, Option<SiteSegment>)>, DbError> {
    let rows = sqlx::query!(
        r#"SELECT segments.pk AS "pk!", segments.robot_pk, robots.id AS robot,
               CASE WHEN segments.site_pk = ?1 THEN segments.measurement END AS "measurement: String"
           FROM segments JOIN robots ON robots.pk = segments.robot_pk
           WHERE segments.pk > ?2 ORDER BY segments.pk LIMIT ?3"#,
        site_pk,
        after,
        limit,
    );
    let rows = rows.fetch_all(db).await?;
    let read = rows.into_iter().map(|row| {
        let Some(measurement) = row.measurement else {
            return Ok((row.pk, None));
        };
        let segment = SiteSegment {
            robot_pk: row.robot_pk,
            robot: parse("robot", &row.robot)?,
            measurement,
        };
        Ok((row.pk, Some(segment)))
    });
    read.collect()
}
