//! Robots, their configurations, and the runs of their agents.

use std::collections::{BTreeSet, HashMap};

use jiff::Timestamp;
use tread_api::ids::{BootId, ConfigurationId, RobotId, SiteId, Tag};
use tread_api::robot::UnmappedMeasurements;
pub use tread_store::robots::{Introduction, RobotRow};

use super::{
    Connection, EngineError, from_json, from_us, parse, robots_text, to_json, to_us, unsigned,
};

/// Maximum number of runs removed with each new one.
const FORGET_MAX: i64 = 50;

struct Raw {
    pk: i64,
    site: String,
    id: String,
    model: String,
    configuration: String,
    name: Option<String>,
    tags: String,
    retired_at_us: Option<i64>,
    awaits_release_since_us: Option<i64>,
    capabilities: String,
    agent_version: String,
    boot: String,
    first_seen_at_us: i64,
    last_hello_at_us: i64,
    segments_refused: i64,
    segments_refused_why: Option<String>,
    segments_deferred: i64,
}

impl TryFrom<Raw> for RobotRow {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        Ok(Self {
            pk: raw.pk,
            site: parse("site", &raw.site)?,
            id: parse("robot", &raw.id)?,
            name: raw.name.unwrap_or(raw.id),
            tags: from_json("tags", &raw.tags)?,
            retired_at: raw.retired_at_us.map(from_us).transpose()?,
            awaits_release_since: raw.awaits_release_since_us.map(from_us).transpose()?,
            capabilities: from_json("capabilities", &raw.capabilities)?,
            model: from_json("robot model", &raw.model)?,
            configuration: parse("configuration", &raw.configuration)?,
            agent_version: raw.agent_version,
            boot: parse("boot", &raw.boot)?,
            first_seen_at: from_us(raw.first_seen_at_us)?,
            last_hello_at: from_us(raw.last_hello_at_us)?,
            measurements: UnmappedMeasurements {
                refused: unsigned("count", raw.segments_refused)?,
                refusal_reason: raw.segments_refused_why,
                deferred: unsigned("count", raw.segments_deferred)?,
            },
        })
    }
}

macro_rules! robots {
    ($condition:tt, $($argument:expr),* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT robots.pk AS "pk!", sites.id AS site, robots.id,
                   configurations.model AS "model!", configurations.id AS configuration,
                   robots.name, robots.tags, robots.retired_at_us,
                   robots.awaits_release_since_us, robots.capabilities,
                   robots.agent_version, robots.boot, robots.first_seen_at_us,
                   robots.last_hello_at_us, robots.segments_refused,
                   robots.segments_refused_why,
                   (SELECT COUNT(*) FROM deferred_segments a WHERE a.robot_pk = robots.pk)
                       AS "segments_deferred!: i64"
               FROM robots
               JOIN sites ON sites.pk = robots.site_pk
               JOIN configurations ON configurations.pk = robots.configuration_pk "# + $condition,
            $($argument),*
        )
    };
}

/// Returns a robot by its site and identifier.
pub async fn find(
    db: &mut Connection,
    site_pk: i64,
    id: &RobotId,
) -> Result<Option<RobotRow>, EngineError> {
    let id = id.as_str();
    let raw = robots!("WHERE robots.site_pk = $1 AND robots.id = $2", site_pk, id)
        .fetch_optional(db)
        .await?;
    raw.map(RobotRow::try_from).transpose()
}

/// Returns whether a robot of this identifier exists, in the given site or, with `None`, in any.
pub async fn is_known(
    db: &mut Connection,
    site: Option<&SiteId>,
    id: &RobotId,
) -> Result<bool, EngineError> {
    let (id, site) = (id.as_str(), site.map(SiteId::as_str));
    let found = sqlx::query_scalar!(
        r#"SELECT EXISTS (
               SELECT 1 FROM robots JOIN sites ON sites.pk = robots.site_pk
               WHERE robots.id = $1 AND (CAST($2 AS TEXT) IS NULL OR sites.id = $2)) AS "found!: bool""#,
        id,
        site,
    );
    Ok(found.fetch_one(db).await?)
}

/// Returns the key of a robot by its site and identifier.
pub async fn pk_of(
    db: &mut Connection,
    site: &SiteId,
    robot: &RobotId,
) -> Result<Option<i64>, EngineError> {
    let (site, robot) = (site.as_str(), robot.as_str());
    let pk = sqlx::query_scalar!(
        r#"SELECT robots.pk AS "pk!" FROM robots JOIN sites ON sites.pk = robots.site_pk
           WHERE sites.id = $1 AND robots.id = $2"#,
        site,
        robot,
    )
    .fetch_optional(db)
    .await?;
    Ok(pk)
}

/// Returns the robots of a site after an identifier, in alphabetical order; with a list of robots
/// only these, and retired ones only if requested.
pub async fn list(
    db: &mut Connection,
    (site_pk, named): (i64, Option<&BTreeSet<RobotId>>),
    after: &str,
    retired: bool,
    limit: u32,
) -> Result<Vec<RobotRow>, EngineError> {
    let named = robots_text(named)?;
    let rows = robots!(
        "WHERE robots.site_pk = $1 AND robots.id > $2 AND ($3 OR robots.retired_at_us IS NULL)
           AND (CAST($5 AS TEXT) IS NULL OR robots.id IN (SELECT value FROM json_each($5)))
         ORDER BY robots.id LIMIT $4",
        site_pk,
        after,
        retired,
        i64::from(limit),
        named,
    )
    .fetch_all(db)
    .await?;
    rows.into_iter().map(RobotRow::try_from).collect()
}

/// Stores a robot's hello and the run of its agent; keeps `runs_kept` runs.
pub async fn introduce(
    db: &mut Connection,
    site_pk: i64,
    introduction: Introduction<'_>,
    runs_kept: u32,
) -> Result<(), EngineError> {
    let Introduction {
        id,
        boot,
        agent_version,
        model,
        capabilities,
        at,
    } = introduction;
    let capabilities = to_json("capabilities", capabilities)?;
    let configuration = model.configuration().to_string();
    let model = to_json("robot model", model)?;
    let configuration_pk = configuration_key(db, &configuration).await?;
    sqlx::query!(
        "UPDATE configurations SET model = $1 WHERE pk = $2 AND model IS NULL",
        model,
        configuration_pk,
    )
    .execute(&mut *db)
    .await?;
    let (id, boot_text, at_us) = (id.as_str(), boot.to_string(), to_us(at));
    let robot_pk = sqlx::query_scalar!(
        r#"INSERT INTO robots (site_pk, id, configuration_pk, agent_version, boot,
               first_seen_at_us, last_hello_at_us, capabilities)
           VALUES ($1, $2, $3, $4, $5, $6, $6, $7)
           ON CONFLICT (site_pk, id) DO UPDATE SET configuration_pk = excluded.configuration_pk,
               agent_version = $4, boot = $5, capabilities = $7,
               last_hello_at_us = MAX($6, robots.last_hello_at_us)
           RETURNING pk AS "pk!""#,
        site_pk,
        id,
        configuration_pk,
        agent_version,
        boot_text,
        at_us,
        capabilities,
    )
    .fetch_one(&mut *db)
    .await?;
    boot_key(db, robot_pk, boot, runs_kept).await?;
    Ok(())
}

/// Returns the key of one run of an agent, if it is known.
pub async fn find_boot(
    db: &mut Connection,
    robot_pk: i64,
    boot: BootId,
) -> Result<Option<i64>, EngineError> {
    let boot = boot.to_string();
    let found = sqlx::query_scalar!(
        r#"SELECT pk AS "pk!" FROM boots WHERE robot_pk = $1 AND id = $2"#,
        robot_pk,
        boot,
    );
    Ok(found.fetch_optional(db).await?)
}

/// Returns the key of one run of an agent, after storing it if it is new. Of each robot a limited
/// number of runs is kept, and those with raw measurements.
pub async fn boot_key(
    db: &mut Connection,
    robot_pk: i64,
    boot: BootId,
    kept: u32,
) -> Result<i64, EngineError> {
    if let Some(found) = find_boot(db, robot_pk, boot).await? {
        return Ok(found);
    }
    let boot = boot.to_string();
    let pk = sqlx::query_scalar!(
        r#"INSERT INTO boots (robot_pk, id) VALUES ($1, $2) RETURNING pk AS "pk!""#,
        robot_pk,
        boot,
    );
    let pk = pk.fetch_one(&mut *db).await?;
    delete_oldest_runs(db, robot_pk, kept).await?;
    Ok(pk)
}

/// Removes the oldest runs of a robot beyond `kept`, with the record of their uploads. Runs with
/// measurements stay, as does the one of the last hello.
async fn delete_oldest_runs(
    db: &mut Connection,
    robot_pk: i64,
    kept: u32,
) -> Result<(), EngineError> {
    let over = sqlx::query_scalar!(
        r#"SELECT boots.pk AS "pk!" FROM boots
           WHERE boots.robot_pk = $1
             AND boots.pk <= (SELECT more.pk FROM boots AS more WHERE more.robot_pk = $1
                 ORDER BY more.pk DESC LIMIT 1 OFFSET $2)
             AND boots.id <> (SELECT robots.boot FROM robots WHERE robots.pk = $1)
             AND NOT EXISTS (SELECT 1 FROM segment_ranges WHERE segment_ranges.boot_pk = boots.pk)
             AND NOT EXISTS (SELECT 1 FROM deferred_segments
                 WHERE deferred_segments.boot_pk = boots.pk)
           ORDER BY boots.pk LIMIT $3"#,
        robot_pk,
        i64::from(kept),
        FORGET_MAX,
    );
    let over = over.fetch_all(&mut *db).await?;
    if over.is_empty() {
        return Ok(());
    }
    let over = to_json("boots", &over)?;
    sqlx::query!(
        "DELETE FROM reports_seen WHERE boot_pk IN (SELECT CAST(value AS BIGINT) FROM json_each($1))",
        over
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!(
        "DELETE FROM segments_removed WHERE boot_pk IN (SELECT CAST(value AS BIGINT) FROM json_each($1))",
        over
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!(
        "DELETE FROM boots WHERE pk IN (SELECT CAST(value AS BIGINT) FROM json_each($1))",
        over
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns the key of a configuration, after storing it without its model if it is new. A new one
/// replaces an unused one, which no robot has and with which nobody measured, if there is one.
pub async fn configuration_key(db: &mut Connection, id: &str) -> Result<i64, EngineError> {
    let found = sqlx::query_scalar!(
        r#"SELECT pk AS "pk!" FROM configurations WHERE id = $1"#,
        id
    );
    if let Some(found) = found.fetch_optional(&mut *db).await? {
        return Ok(found);
    }
    let taken = sqlx::query_scalar!(
        r#"UPDATE configurations SET id = $1, model = NULL
           WHERE pk = (SELECT free.pk FROM configurations AS free
               WHERE NOT EXISTS (SELECT 1 FROM robots WHERE robots.configuration_pk = free.pk)
                 AND NOT EXISTS (SELECT 1 FROM measured_configurations AS measured
                     WHERE measured.configuration_pk = free.pk)
               LIMIT 1)
           RETURNING pk AS "pk!""#,
        id
    );
    if let Some(taken) = taken.fetch_optional(&mut *db).await? {
        return Ok(taken);
    }
    let new = sqlx::query_scalar!(
        r#"INSERT INTO configurations (id) VALUES ($1) RETURNING pk AS "pk!""#,
        id
    );
    Ok(new.fetch_one(db).await?)
}

/// Returns the key of a configuration that a robot has measured with.
pub async fn measured_configuration(
    db: &mut Connection,
    robot_pk: i64,
    id: ConfigurationId,
) -> Result<Option<i64>, EngineError> {
    let id = id.to_string();
    let found = sqlx::query_scalar!(
        r#"SELECT configurations.pk AS "pk!" FROM measured_configurations AS measured
           JOIN configurations ON configurations.pk = measured.configuration_pk
           WHERE measured.robot_pk = $1 AND configurations.id = $2"#,
        robot_pk,
        id,
    );
    Ok(found.fetch_optional(db).await?)
}

/// Returns the number of configurations that a robot has measured with.
pub async fn measured_count(db: &mut Connection, robot_pk: i64) -> Result<i64, EngineError> {
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM measured_configurations WHERE robot_pk = $1"#,
        robot_pk
    );
    Ok(count.fetch_one(db).await?)
}

/// Records that a robot measures with a configuration; returns the configuration's key.
pub async fn record_measured(
    db: &mut Connection,
    robot_pk: i64,
    id: ConfigurationId,
) -> Result<i64, EngineError> {
    let configuration_pk = configuration_key(db, &id.to_string()).await?;
    sqlx::query!(
        "INSERT INTO measured_configurations (robot_pk, configuration_pk) VALUES ($1, $2)
         ON CONFLICT DO NOTHING",
        robot_pk,
        configuration_pk,
    )
    .execute(db)
    .await?;
    Ok(configuration_pk)
}

/// Returns the sites and identifiers of all robots.
pub async fn names(db: &mut Connection) -> Result<Vec<(SiteId, RobotId)>, EngineError> {
    let raw = sqlx::query!(
        "SELECT sites.id AS site, robots.id AS robot
         FROM robots JOIN sites ON sites.pk = robots.site_pk ORDER BY robots.site_pk, robots.id"
    )
    .fetch_all(db)
    .await?;
    raw.into_iter()
        .map(|row| Ok((parse("site", &row.site)?, parse("robot", &row.robot)?)))
        .collect()
}

/// Changes a robot's display name.
pub async fn rename(db: &mut Connection, robot_pk: i64, name: &str) -> Result<(), EngineError> {
    sqlx::query!("UPDATE robots SET name = $1 WHERE pk = $2", name, robot_pk)
        .execute(db)
        .await?;
    Ok(())
}

/// Replaces a robot's tags.
pub async fn set_tags(
    db: &mut Connection,
    robot_pk: i64,
    tags: &BTreeSet<Tag>,
) -> Result<(), EngineError> {
    let tags = to_json("tags", tags)?;
    sqlx::query!("UPDATE robots SET tags = $1 WHERE pk = $2", tags, robot_pk)
        .execute(db)
        .await?;
    Ok(())
}

/// Retires a robot, or ends its retirement.
pub async fn set_retired(
    db: &mut Connection,
    robot_pk: i64,
    at: Option<Timestamp>,
) -> Result<(), EngineError> {
    let at_us = at.map(to_us);
    sqlx::query!(
        "UPDATE robots SET retired_at_us = MAX($1, first_seen_at_us) WHERE pk = $2",
        at_us,
        robot_pk
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns at most `limit` robots of all sites.
pub async fn all(db: &mut Connection, limit: u32) -> Result<Vec<RobotRow>, EngineError> {
    let rows = robots!("ORDER BY robots.pk LIMIT $1", i64::from(limit))
        .fetch_all(db)
        .await?;
    rows.into_iter().map(RobotRow::try_from).collect()
}

/// Returns the identifiers of all robots by their keys.
pub async fn ids_by_key(db: &mut Connection) -> Result<HashMap<i64, RobotId>, EngineError> {
    let rows = sqlx::query!(r#"SELECT pk AS "pk!", id FROM robots"#);
    let rows = rows.fetch_all(db).await?;
    let named = |pk, id: &str| Ok((pk, parse("robot", id)?));
    rows.iter().map(|row| named(row.pk, &row.id)).collect()
}

/// Returns the identifiers of a site's robots by their keys.
pub async fn of_site_by_key(
    db: &mut Connection,
    site_pk: i64,
) -> Result<HashMap<i64, RobotId>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT pk AS "pk!", id FROM robots WHERE site_pk = $1"#,
        site_pk
    );
    let rows = rows.fetch_all(db).await?;
    let named = |pk, id: &str| Ok((pk, parse("robot", id)?));
    rows.iter().map(|row| named(row.pk, &row.id)).collect()
}

/// Returns the identifiers of all configurations by their keys.
pub async fn configurations_by_key(
    db: &mut Connection,
) -> Result<HashMap<i64, ConfigurationId>, EngineError> {
    let rows = sqlx::query!(r#"SELECT pk AS "pk!", id FROM configurations"#);
    let rows = rows.fetch_all(db).await?;
    let named = |pk, id: &str| Ok((pk, parse("configuration", id)?));
    rows.iter().map(|row| named(row.pk, &row.id)).collect()
}

/// Returns the model names of the configurations that a robot has declared.
pub async fn model_names(
    db: &mut Connection,
) -> Result<HashMap<ConfigurationId, String>, EngineError> {
    let rows = sqlx::query!(
        r#"SELECT id, model ->> 'name' AS "name!: String" FROM configurations
           WHERE model IS NOT NULL"#
    );
    let rows = rows.fetch_all(db).await?;
    let named = |id: &str, name| Ok((parse("configuration", id)?, name));
    rows.into_iter()
        .map(|row| named(&row.id, row.name))
        .collect()
}

/// Counts measurements of a robot that are refused for ever, with the reason of the last.
pub async fn count_refused(
    db: &mut Connection,
    pk: i64,
    count: u64,
    why: &str,
) -> Result<(), EngineError> {
    let count = i64::try_from(count).unwrap_or(i64::MAX);
    sqlx::query!(
        "UPDATE robots SET segments_refused = segments_refused + $2, segments_refused_why = $3
         WHERE pk = $1",
        pk,
        count,
        why,
    )
    .execute(db)
    .await?;
    Ok(())
}
