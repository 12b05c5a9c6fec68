//! Stops of robots: wanted, confirmed, cleared.

use jiff::Timestamp;
use sqlx::SqliteConnection;
use tread_api::ids::{RobotId, SiteId, StopId};
use tread_api::stop::Stop;

use super::{DbError, from_us, parse, to_json, to_us};

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
}

impl TryFrom<Raw> for Stop {
    type Error = DbError;

    fn try_from(raw: Raw) -> Result<Self, DbError> {
        Ok(Self {
            id: parse("stop", &raw.id)?,
            site: parse("site", &raw.site)?,
            robot: parse("robot", &raw.robot)?,
            by: raw.stopped_by,
            reason: raw.reason,
            wanted_at: from_us(raw.wanted_at_us)?,
            confirmed_at: raw.confirmed_at_us.map(from_us).transpose()?,
            standing_at: raw.standing_at_us.map(from_us).transpose()?,
            // Whoever shows it knows the time.
            unconfirmed: false,
            clear_asked_by: raw.clear_asked_by,
            clear_asked_at: raw.clear_asked_at_us.map(from_us).transpose()?,
            cleared_at: raw.cleared_at_us.map(from_us).transpose()?,
        })
    }
}

macro_rules! stops {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT stops.id, sites.id AS site, robots.id AS robot, stops.stopped_by,
                   stops.reason, stops.wanted_at_us, stops.confirmed_at_us, stops.standing_at_us,
                   stops.clear_asked_by, stops.clear_asked_at_us, stops.cleared_at_us
               FROM stops
               JOIN robots ON robots.pk = stops.robot_pk
               JOIN sites ON sites.pk = robots.site_pk "# + $condition
            $(, $argument)*
        )
    };
}

fn rows(raw: Vec<Raw>) -> Result<Vec<Stop>, DbError> {
    raw.into_iter().map(Stop::try_from).collect()
}

/// Which stops to list.
#[derive(Debug, Clone, Default)]
pub struct StopFilter {
    /// Only those of this site.
    pub site: Option<SiteId>,
    /// Only those of robots of this name.
    pub robot: Option<RobotId>,
    /// Only those that are not cleared.
    pub in_force: bool,
    /// Only those older than this one.
    pub before: Option<StopId>,
}

/// Stops, newest first.
pub async fn list(
    db: &mut SqliteConnection,
    filter: &StopFilter,
    limit: u32,
) -> Result<Vec<Stop>, DbError> {
    let site = filter.site.as_ref().map(SiteId::as_str);
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let before = filter.before.map(|id| id.to_string());
    let raw = stops!(
        "WHERE (?1 IS NULL OR sites.id = ?1) AND (?2 IS NULL OR robots.id = ?2)
           AND (?3 = FALSE OR stops.cleared_at_us IS NULL) AND (?4 IS NULL OR stops.id < ?4)
         ORDER BY stops.id DESC LIMIT ?5",
        site,
        robot,
        filter.in_force,
        before,
        limit,
    )
    .fetch_all(db)
    .await?;
    rows(raw)
}

/// Stops that are not cleared, of robots that are not retired; oldest first, at most `limit`.
pub async fn in_force(db: &mut SqliteConnection, limit: u32) -> Result<Vec<Stop>, DbError> {
    let raw = stops!(
        "WHERE stops.cleared_at_us IS NULL AND robots.retired_at_us IS NULL
         ORDER BY stops.id LIMIT ?",
        limit
    )
    .fetch_all(db)
    .await?;
    rows(raw)
}

/// Whether a robot has a stop that is not cleared.
pub async fn is_stopped(
    db: &mut SqliteConnection,
    site: &SiteId,
    robot: &RobotId,
) -> Result<bool, DbError> {
    let (site, robot) = (site.as_str(), robot.as_str());
    let found = sqlx::query_scalar!(
        r#"SELECT EXISTS (
               SELECT 1 FROM stops
               JOIN robots ON robots.pk = stops.robot_pk
               JOIN sites ON sites.pk = robots.site_pk
               WHERE sites.id = ? AND robots.id = ? AND stops.cleared_at_us IS NULL)
           AS "found!: bool""#,
        site,
        robot,
    )
    .fetch_one(db)
    .await?;
    Ok(found)
}

/// The stop of that identifier.
pub async fn find(db: &mut SqliteConnection, id: StopId) -> Result<Option<Stop>, DbError> {
    let id = id.to_string();
    let raw = stops!("WHERE stops.id = ?", id).fetch_optional(db).await?;
    raw.map(Stop::try_from).transpose()
}

/// Writes stops down; those of robots that are not known, and those that are there, are left out.
pub async fn insert(db: &mut SqliteConnection, stops: &[Stop]) -> Result<(), DbError> {
    let entry = |stop: &Stop| {
        (
            stop.id.to_string(),
            stop.site.to_string(),
            stop.robot.to_string(),
            stop.by.clone(),
            stop.reason.clone(),
            to_us(stop.wanted_at),
            stop.confirmed_at.map(to_us),
        )
    };
    let entries: Vec<_> = stops.iter().map(entry).collect();
    let entries = to_json("stops", &entries)?;
    sqlx::query!(
        "INSERT INTO stops (id, robot_pk, stopped_by, reason, wanted_at_us, confirmed_at_us)
         SELECT entry.value ->> 0, robots.pk, entry.value ->> 3, entry.value ->> 4,
             entry.value ->> 5, entry.value ->> 6
         FROM json_each(?) AS entry
         JOIN sites ON sites.id = entry.value ->> 1
         JOIN robots ON robots.site_pk = sites.pk AND robots.id = entry.value ->> 2
         WHERE TRUE ON CONFLICT DO NOTHING",
        entries,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Notes that robots have confirmed; the first time counts.
pub async fn confirm(
    db: &mut SqliteConnection,
    ids: &[StopId],
    at: Timestamp,
) -> Result<(), DbError> {
    let (ids, at_us) = (to_json("stops", &ids)?, to_us(at));
    sqlx::query!(
        "UPDATE stops SET confirmed_at_us = COALESCE(confirmed_at_us, MAX(?, wanted_at_us))
         WHERE id IN (SELECT value FROM json_each(?))",
        at_us,
        ids,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Notes that a robot was measured to stand; the first time counts.
pub async fn stand(db: &mut SqliteConnection, id: StopId, at: Timestamp) -> Result<(), DbError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE stops SET standing_at_us = COALESCE(standing_at_us, ?) WHERE id = ?",
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Takes a confirmation back: the robot shows that the stop is not in force, and nobody asked to
/// clear it.
pub async fn unconfirm(db: &mut SqliteConnection, id: StopId) -> Result<(), DbError> {
    let id = id.to_string();
    sqlx::query!(
        "UPDATE stops SET confirmed_at_us = NULL, standing_at_us = NULL
         WHERE id = ? AND clear_asked_at_us IS NULL AND cleared_at_us IS NULL",
        id
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Notes that somebody asks to clear a robot's stops up to this one, in the order in which they
/// were asked for or came to the robot: what it has confirmed came before what is cleared now.
pub async fn ask_clear(
    db: &mut SqliteConnection,
    id: StopId,
    by: &str,
    at: Timestamp,
) -> Result<(), DbError> {
    let id = id.to_string();
    // All that are cleared together have one time, which is not before any of theirs.
    let newest_us = sqlx::query_scalar!(
        r#"SELECT COALESCE(MAX(MAX(wanted_at_us, COALESCE(confirmed_at_us, 0))), 0)
               AS "newest!: i64"
           FROM stops
           WHERE cleared_at_us IS NULL AND robot_pk = (SELECT robot_pk FROM stops WHERE id = ?)"#,
        id,
    );
    let at_us = to_us(at).max(newest_us.fetch_one(&mut *db).await?);
    sqlx::query!(
        "UPDATE stops SET clear_asked_by = ?1, clear_asked_at_us = ?2
         WHERE robot_pk = (SELECT robot_pk FROM stops WHERE id = ?3)
           AND (wanted_at_us <= (SELECT wanted_at_us FROM stops WHERE id = ?3)
               OR confirmed_at_us <= ?2)
           AND cleared_at_us IS NULL",
        by,
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Forgets that somebody asked: the robot refused.
pub async fn refuse_clear(db: &mut SqliteConnection, id: StopId) -> Result<(), DbError> {
    let id = id.to_string();
    sqlx::query!(
        "UPDATE stops SET clear_asked_by = NULL, clear_asked_at_us = NULL
         WHERE robot_pk = (SELECT robot_pk FROM stops WHERE id = ?1)
           AND clear_asked_at_us = (SELECT clear_asked_at_us FROM stops WHERE id = ?1)
           AND cleared_at_us IS NULL",
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Notes that a robot has cleared this stop and all that were to be cleared with it.
pub async fn clear(db: &mut SqliteConnection, id: StopId, at: Timestamp) -> Result<(), DbError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE stops SET cleared_at_us = MAX(?1, wanted_at_us,
             COALESCE(confirmed_at_us, wanted_at_us), COALESCE(clear_asked_at_us, wanted_at_us))
         WHERE robot_pk = (SELECT robot_pk FROM stops WHERE id = ?2)
           AND (id = ?2
               OR clear_asked_at_us = (SELECT clear_asked_at_us FROM stops WHERE id = ?2))
           AND cleared_at_us IS NULL",
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Notes that a stop was in force and has ended, whoever cleared it.
pub async fn end(db: &mut SqliteConnection, id: StopId, at: Timestamp) -> Result<(), DbError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE stops SET confirmed_at_us = COALESCE(confirmed_at_us, MAX(?1, wanted_at_us)),
             cleared_at_us = MAX(?1, wanted_at_us, COALESCE(confirmed_at_us, wanted_at_us),
                 COALESCE(clear_asked_at_us, wanted_at_us))
         WHERE id = ?2 AND cleared_at_us IS NULL",
        at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}
