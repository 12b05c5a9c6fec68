//! Stops of robots: requested, confirmed, cleared or replaced.
//!
//! A stop is open while it is neither cleared nor replaced. A robot has at most one open stop,
//! which a unique index enforces.

use jiff::Timestamp;
use tread_api::ids::{RobotId, SiteId, StopId};
use tread_api::stop::Stop;
pub use tread_store::stops::StopFilter;

use super::{Connection, EngineError, from_us, parse, scope_text, to_json, to_us};

struct Raw {
    id: String,
    site: String,
    robot: String,
    stopped_by: String,
    reason: String,
    wanted_at_us: i64,
    confirmed_at_us: Option<i64>,
    standing_at_us: Option<i64>,
    clear_asked_by: Option<String>,
    clear_asked_at_us: Option<i64>,
    cleared_at_us: Option<i64>,
    replaced_by: Option<String>,
}

impl TryFrom<Raw> for Stop {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        Ok(Self {
            id: parse("stop", &raw.id)?,
            site: parse("site", &raw.site)?,
            robot: parse("robot", &raw.robot)?,
            by: raw.stopped_by,
            reason: raw.reason,
            requested_at: from_us(raw.wanted_at_us)?,
            confirmed_at: raw.confirmed_at_us.map(from_us).transpose()?,
            standstill_at: raw.standing_at_us.map(from_us).transpose()?,
            // Derived from the present time when it is shown.
            unconfirmed: false,
            clear_requested_by: raw.clear_asked_by,
            clear_requested_at: raw.clear_asked_at_us.map(from_us).transpose()?,
            cleared_at: raw.cleared_at_us.map(from_us).transpose()?,
            replaced_by: raw.replaced_by.map(|id| parse("stop", &id)).transpose()?,
        })
    }
}

macro_rules! stops {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT stops.id, sites.id AS site, robots.id AS robot, stops.stopped_by,
                   stops.reason, stops.wanted_at_us, stops.confirmed_at_us, stops.standing_at_us,
                   stops.clear_asked_by, stops.clear_asked_at_us, stops.cleared_at_us,
                   stops.replaced_by
               FROM stops
               JOIN robots ON robots.pk = stops.robot_pk
               JOIN sites ON sites.pk = robots.site_pk "# + $condition
            $(, $argument)*
        )
    };
}

fn rows(raw: Vec<Raw>) -> Result<Vec<Stop>, EngineError> {
    raw.into_iter().map(Stop::try_from).collect()
}

/// Returns stops, newest first. A robot names its own stops, so identifiers do not rise with time.
pub async fn list(
    db: &mut Connection,
    filter: &StopFilter,
    limit: u32,
) -> Result<Vec<Stop>, EngineError> {
    let site = filter.site.as_ref().map(SiteId::as_str);
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let before = filter.before.map(|id| id.to_string());
    let within = scope_text(&filter.within)?;
    let raw = stops!(
        "WHERE (CAST($1 AS TEXT) IS NULL OR sites.id = $1) AND (CAST($2 AS TEXT) IS NULL OR robots.id = $2)
           AND ($3 = FALSE OR (stops.cleared_at_us IS NULL AND stops.replaced_by IS NULL))
           AND (CAST($4 AS TEXT) IS NULL OR (stops.wanted_at_us, stops.id) <
               (SELECT earlier.wanted_at_us, earlier.id FROM stops AS earlier
                WHERE earlier.id = $4))
           AND (CAST($6 AS TEXT) IS NULL OR sites.id IN (SELECT value FROM json_each($6))
               OR sites.id || '/' || robots.id IN (SELECT value FROM json_each($6)))
         ORDER BY stops.wanted_at_us DESC, stops.id DESC LIMIT $5",
        site,
        robot,
        filter.in_force,
        before,
        i64::from(limit),
        within,
    )
    .fetch_all(db)
    .await?;
    rows(raw)
}

/// Returns the open stop of each robot that has one and is not retired, oldest first.
pub async fn in_force(db: &mut Connection) -> Result<Vec<Stop>, EngineError> {
    let raw = stops!(
        "WHERE stops.cleared_at_us IS NULL AND stops.replaced_by IS NULL
           AND robots.retired_at_us IS NULL
         ORDER BY stops.wanted_at_us, stops.id"
    )
    .fetch_all(db)
    .await?;
    rows(raw)
}

/// Returns a robot's open stop; `None` also for a retired robot.
pub async fn in_force_of(db: &mut Connection, robot_pk: i64) -> Result<Option<Stop>, EngineError> {
    let raw = stops!(
        "WHERE stops.robot_pk = $1 AND stops.cleared_at_us IS NULL AND stops.replaced_by IS NULL
           AND robots.retired_at_us IS NULL",
        robot_pk
    )
    .fetch_optional(db)
    .await?;
    raw.map(Stop::try_from).transpose()
}

/// Returns whether a robot has an open stop.
pub async fn is_stopped(
    db: &mut Connection,
    site: &SiteId,
    robot: &RobotId,
) -> Result<bool, EngineError> {
    let (site, robot) = (site.as_str(), robot.as_str());
    let found = sqlx::query_scalar!(
        r#"SELECT EXISTS (
               SELECT 1 FROM stops
               JOIN robots ON robots.pk = stops.robot_pk
               JOIN sites ON sites.pk = robots.site_pk
               WHERE sites.id = $1 AND robots.id = $2 AND stops.cleared_at_us IS NULL
                   AND stops.replaced_by IS NULL)
           AS "found!: bool""#,
        site,
        robot,
    )
    .fetch_one(db)
    .await?;
    Ok(found)
}

/// Returns a stop by its identifier.
pub async fn find(db: &mut Connection, id: StopId) -> Result<Option<Stop>, EngineError> {
    let id = id.to_string();
    let raw = stops!("WHERE stops.id = $1", id).fetch_optional(db).await?;
    raw.map(Stop::try_from).transpose()
}

/// Stores new stops, at most one for each robot in a call. Stops of unknown robots, and those
/// stored before, are ignored.
///
/// A robot's newest stop is the open one and replaces the others, in whatever order they are
/// stored. Afterwards only the newest `kept` stops of each robot remain; older ones are deleted.
pub async fn insert(db: &mut Connection, stops: &[Stop], kept: u32) -> Result<(), EngineError> {
    let entry = |stop: &Stop| {
        (
            stop.id.to_string(),
            stop.site.to_string(),
            stop.robot.to_string(),
            stop.by.clone(),
            stop.reason.clone(),
            to_us(stop.requested_at),
            stop.confirmed_at.map(to_us),
        )
    };
    let entries: Vec<_> = stops.iter().map(entry).collect();
    let entries = to_json("stops", &entries)?;
    sqlx::query!(
        "UPDATE stops SET replaced_by = new.id
         FROM (
             SELECT entry.value ->> 0 AS id, robots.pk AS robot_pk, CAST(entry.value ->> 5 AS BIGINT) AS wanted_at_us
             FROM json_each($1) AS entry
             JOIN sites ON sites.id = entry.value ->> 1
             JOIN robots ON robots.site_pk = sites.pk AND robots.id = entry.value ->> 2
         ) AS new
         WHERE stops.robot_pk = new.robot_pk AND stops.cleared_at_us IS NULL
           AND stops.replaced_by IS NULL
           AND (stops.wanted_at_us, stops.id) < (new.wanted_at_us, new.id)
           AND NOT EXISTS (SELECT 1 FROM stops AS there WHERE there.id = new.id)",
        entries,
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!(
        "INSERT INTO stops (id, robot_pk, stopped_by, reason, wanted_at_us, confirmed_at_us,
             replaced_by)
         SELECT entry.value ->> 0, robots.pk, entry.value ->> 3, entry.value ->> 4,
             CAST(entry.value ->> 5 AS BIGINT), CAST(entry.value ->> 6 AS BIGINT),
             (SELECT newer.id FROM stops AS newer
              WHERE newer.robot_pk = robots.pk AND newer.cleared_at_us IS NULL
                AND newer.replaced_by IS NULL)
         FROM json_each($1) AS entry
         JOIN sites ON sites.id = entry.value ->> 1
         JOIN robots ON robots.site_pk = sites.pk AND robots.id = entry.value ->> 2
         WHERE TRUE ON CONFLICT (id) DO NOTHING",
        entries,
    )
    .execute(&mut *db)
    .await?;
    prune(db, &entries, kept).await
}

/// Deletes the oldest stops of robots beyond `kept`; open ones stay.
async fn prune(db: &mut Connection, entries: &str, kept: u32) -> Result<(), EngineError> {
    sqlx::query!(
        "DELETE FROM stops WHERE id IN (
             SELECT old.id FROM json_each($1) AS entry
             JOIN sites ON sites.id = entry.value ->> 1
             JOIN robots ON robots.site_pk = sites.pk AND robots.id = entry.value ->> 2
             JOIN stops AS old ON old.robot_pk = robots.pk
             WHERE (old.cleared_at_us IS NOT NULL OR old.replaced_by IS NOT NULL)
               AND (old.wanted_at_us, old.id) <= (
                   SELECT more.wanted_at_us, more.id FROM stops AS more
                   WHERE more.robot_pk = robots.pk
                   ORDER BY more.wanted_at_us DESC, more.id DESC LIMIT 1 OFFSET $2))",
        entries,
        i64::from(kept),
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Makes the stop that a robot shows its open one, whatever was open before; keeps its stored data,
/// except that it had ended. A stop of another robot is left alone.
pub async fn adopt(
    db: &mut Connection,
    robot_pk: i64,
    stop: &Stop,
    kept: u32,
) -> Result<(), EngineError> {
    let id = stop.id.to_string();
    let (wanted_at_us, confirmed_at_us) = (to_us(stop.requested_at), stop.confirmed_at.map(to_us));
    sqlx::query!(
        "UPDATE stops SET replaced_by = $1
         WHERE robot_pk = $2 AND cleared_at_us IS NULL AND replaced_by IS NULL AND id <> $1
           AND NOT EXISTS (SELECT 1 FROM stops AS foreign_one
               WHERE foreign_one.id = $1 AND foreign_one.robot_pk <> $2)",
        id,
        robot_pk,
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!(
        "INSERT INTO stops (id, robot_pk, stopped_by, reason, wanted_at_us, confirmed_at_us)
         VALUES ($1, $2, $3, $4, $5, $6)
         ON CONFLICT (id) DO UPDATE SET replaced_by = NULL, cleared_at_us = NULL,
             clear_asked_by = NULL, clear_asked_at_us = NULL,
             confirmed_at_us = MAX($6, stops.wanted_at_us)
         WHERE stops.robot_pk = $2",
        id,
        robot_pk,
        stop.by,
        stop.reason,
        wanted_at_us,
        confirmed_at_us,
    )
    .execute(&mut *db)
    .await?;
    let named = to_json("stops", &[(&id, &stop.site, &stop.robot)])?;
    prune(db, &named, kept).await
}

/// Stores the confirmations of robots; only the first time counts.
pub async fn confirm(
    db: &mut Connection,
    ids: &[StopId],
    at: Timestamp,
) -> Result<(), EngineError> {
    let (ids, at_us) = (to_json("stops", &ids)?, to_us(at));
    sqlx::query!(
        "UPDATE stops SET confirmed_at_us = COALESCE(confirmed_at_us, MAX($1, wanted_at_us))
         WHERE id IN (SELECT value FROM json_each($2))",
        at_us,
        ids,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Stores that a robot was measured to be stopped, with a time not before its confirmation; only
/// the first time counts.
pub async fn record_standstill(
    db: &mut Connection,
    id: StopId,
    at: Timestamp,
) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE stops SET standing_at_us = COALESCE(standing_at_us,
             MAX($1, wanted_at_us, COALESCE(confirmed_at_us, wanted_at_us)))
         WHERE id = $2",
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Removes a confirmation: the robot shows that the stop is not in force, and nobody cleared it.
pub async fn unconfirm(db: &mut Connection, id: StopId) -> Result<(), EngineError> {
    let id = id.to_string();
    sqlx::query!(
        "UPDATE stops SET confirmed_at_us = NULL, standing_at_us = NULL
         WHERE id = $1 AND clear_asked_at_us IS NULL AND cleared_at_us IS NULL",
        id
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Stores a request to clear a stop.
pub async fn request_clear(
    db: &mut Connection,
    id: StopId,
    by: &str,
    at: Timestamp,
) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE stops SET clear_asked_by = $1,
             clear_asked_at_us = MAX($2, wanted_at_us, COALESCE(confirmed_at_us, wanted_at_us))
         WHERE id = $3 AND cleared_at_us IS NULL",
        by,
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Removes the request to clear a stop, because the robot refused.
pub async fn refuse_clear(db: &mut Connection, id: StopId) -> Result<(), EngineError> {
    let id = id.to_string();
    sqlx::query!(
        "UPDATE stops SET clear_asked_by = NULL, clear_asked_at_us = NULL
         WHERE id = $1 AND cleared_at_us IS NULL",
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Stores that a robot has cleared a stop.
pub async fn clear(db: &mut Connection, id: StopId, at: Timestamp) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE stops SET cleared_at_us = MAX($1, wanted_at_us,
             COALESCE(confirmed_at_us, wanted_at_us), COALESCE(clear_asked_at_us, wanted_at_us))
         WHERE id = $2 AND cleared_at_us IS NULL",
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Stores that a stop was in force and has ended, whoever cleared it.
pub async fn end(db: &mut Connection, id: StopId, at: Timestamp) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE stops SET confirmed_at_us = COALESCE(confirmed_at_us, MAX($1, wanted_at_us)),
             cleared_at_us = MAX($1, wanted_at_us, COALESCE(confirmed_at_us, wanted_at_us),
                 COALESCE(clear_asked_at_us, wanted_at_us))
         WHERE id = $2 AND cleared_at_us IS NULL",
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}
