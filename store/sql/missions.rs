//! Missions: their content, state and outcome.

#[path = "missions/open_missions.rs"]
mod open_missions;

use futures_util::StreamExt as _;
use jiff::Timestamp;
use tread_api::ids::{MissionId, RobotId, SiteId};
use tread_api::mission::{Cause, DrivenPath, Mission, MissionQuality, MissionState, Replacement};
pub use tread_store::missions::{Facts, Inserted, MissionFilter, MissionRow, Transition};

pub use self::open_missions::{OpenMission, in_progress, next_in_queues, open_of_robot, overdue};
use super::{
    Connection, EngineError, corrupt, from_json, from_us, parse, scope_text, to_json, to_us,
    unsigned,
};

struct Raw {
    id: String,
    robot_pk: i64,
    site: String,
    robot: String,
    state: String,
    reason: Option<String>,
    cause: String,
    pause_wanted: bool,
    revision: i64,
    plan_hash: String,
    trajectory: String,
    replacement: Option<String>,
    latest_start_us: Option<i64>,
    priority: i64,
    link_policy: String,
    lost_after_s: Option<f64>,
    boot: Option<String>,
    plan: Option<String>,
    progress: Option<String>,
    created_at_us: i64,
    started_at_us: Option<i64>,
    ended_at_us: Option<i64>,
}

impl TryFrom<Raw> for MissionRow {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        let optional_time = |time_us: Option<i64>| time_us.map(from_us).transpose();
        let mission = Mission {
            id: parse("mission", &raw.id)?,
            site: parse("site", &raw.site)?,
            robot: parse("robot", &raw.robot)?,
            state: state(&raw.state)?,
            reason: raw.reason,
            cause: cause(&raw.cause)?,
            pause_requested: raw.pause_wanted,
            revision: unsigned("mission revision", raw.revision)?,
            plan_hash: from_json("plan hash", &format!("\"{}\"", raw.plan_hash))?,
            trajectory: from_json("trajectory", &raw.trajectory)?,
            replacement: raw
                .replacement
                .as_deref()
                .map(|replacement| from_json("replacement", replacement))
                .transpose()?,
            latest_start: optional_time(raw.latest_start_us)?,
            priority: i32::try_from(raw.priority)
                .map_err(|_range| corrupt("priority", raw.priority))?,
            link_policy: from_json("link policy", &raw.link_policy)?,
            lost_after_s: raw.lost_after_s,
            boot: raw
                .boot
                .as_deref()
                .map(|boot| parse("boot", boot))
                .transpose()?,
            plan: raw
                .plan
                .as_deref()
                .map(|plan| from_json("plan", plan))
                .transpose()?,
            progress: raw
                .progress
                .as_deref()
                .map(|progress| from_json("progress", progress))
                .transpose()?,
            created_at: from_us(raw.created_at_us)?,
            started_at: optional_time(raw.started_at_us)?,
            ended_at: optional_time(raw.ended_at_us)?,
        };
        Ok(Self {
            robot_pk: raw.robot_pk,
            mission,
        })
    }
}

pub(super) fn cause(name: &str) -> Result<Cause, EngineError> {
    Cause::from_name(name).ok_or_else(|| corrupt("cause", name))
}

pub(super) fn state(name: &str) -> Result<MissionState, EngineError> {
    MissionState::from_name(name).ok_or_else(|| corrupt("mission state", name))
}

macro_rules! missions {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT missions.id, missions.robot_pk, sites.id AS site, robots.id AS robot,
                   missions.state, missions.reason, missions.cause,
                   missions.pause_wanted AS "pause_wanted: bool", missions.revision,
                   missions.plan_hash, missions.trajectory, missions.replacement,
                   missions.latest_start_us, missions.priority, missions.link_policy,
                   missions.lost_after_s, missions.boot, missions.plan, missions.progress,
                   missions.created_at_us, missions.started_at_us, missions.ended_at_us
               FROM missions
               JOIN robots ON robots.pk = missions.robot_pk
               JOIN sites ON sites.pk = robots.site_pk "# + $condition
            $(, $argument)*
        )
    };
}

/// Adds a mission in a state that counts instead of its own.
pub async fn insert(
    db: &mut Connection,
    row: &MissionRow,
    inserted: Inserted<'_>,
) -> Result<(), EngineError> {
    let mission = &row.mission;
    let (id, state) = (mission.id.to_string(), inserted.state.as_str());
    let (revision, plan_hash) = (i64::from(mission.revision), mission.plan_hash.to_string());
    let trajectory = to_json("trajectory", &mission.trajectory)?;
    let latest_start_us = mission.latest_start.map(to_us);
    let created_at_us = to_us(mission.created_at);
    let cause = inserted.cause.as_str();
    let link_policy = to_json("link policy", &mission.link_policy)?;
    sqlx::query!(
        "INSERT INTO missions (id, robot_pk, state, cause, reason, pause_wanted, revision,
             plan_hash, trajectory, latest_start_us, priority, link_policy, lost_after_s,
             created_at_us)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14)",
        id,
        row.robot_pk,
        state,
        cause,
        inserted.reason,
        mission.pause_requested,
        revision,
        plan_hash,
        trajectory,
        latest_start_us,
        i64::from(mission.priority),
        link_policy,
        mission.lost_after_s,
        created_at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns a mission by its identifier.
pub async fn find(db: &mut Connection, id: MissionId) -> Result<Option<MissionRow>, EngineError> {
    let id = id.to_string();
    let raw = missions!("WHERE missions.id = $1", id)
        .fetch_optional(db)
        .await?;
    raw.map(MissionRow::try_from).transpose()
}

/// Returns missions, newest first, until there are `limit` or their trajectories exceed `bytes_max`
/// bytes; and whether there are more.
pub async fn list(
    db: &mut Connection,
    filter: &MissionFilter,
    limit: u32,
    bytes_max: usize,
) -> Result<(Vec<MissionRow>, bool), EngineError> {
    let site = filter.site.as_ref().map(SiteId::as_str);
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let state = filter.state.map(MissionState::as_str);
    let before = filter.before.map(|id| id.to_string());
    let limit_and_one = i64::from(limit) + 1;
    let within = scope_text(&filter.within)?;
    let query = missions!(
        "WHERE (CAST($1 AS TEXT) IS NULL OR sites.id = $1) AND (CAST($2 AS TEXT) IS NULL OR robots.id = $2)
           AND (CAST($3 AS TEXT) IS NULL OR missions.state = $3) AND (CAST($4 AS TEXT) IS NULL OR missions.id < $4)
           AND (CAST($6 AS TEXT) IS NULL OR sites.id IN (SELECT value FROM json_each($6))
               OR sites.id || '/' || robots.id IN (SELECT value FROM json_each($6)))
         ORDER BY missions.id DESC LIMIT $5",
        site,
        robot,
        state,
        before,
        limit_and_one,
        within,
    );
    let mut found = query.fetch(db);
    let (mut rows, mut bytes) = (Vec::new(), 0);
    while let Some(raw) = found.next().await {
        let raw = raw?;
        if rows.len() >= limit as usize || bytes > bytes_max {
            return Ok((rows, true));
        }
        bytes += raw.trajectory.len();
        rows.push(MissionRow::try_from(raw)?);
    }
    Ok((rows, false))
}

/// Changes a mission's state; `false` if it is no longer in the expected state.
pub async fn compare_and_set(
    db: &mut Connection,
    id: MissionId,
    transition: Transition<'_>,
) -> Result<bool, EngineError> {
    let (id, from) = (id.to_string(), transition.from.as_str());
    let (to, cause) = (transition.to.as_str(), transition.cause.as_str());
    let result = sqlx::query!(
        "UPDATE missions SET state = $1, cause = $2, reason = $3 WHERE id = $4 AND state = $5",
        to,
        cause,
        transition.reason,
        id,
        from,
    )
    .execute(db)
    .await?;
    Ok(result.rows_affected() == 1)
}

/// Adds facts to a mission; its times never decrease from its creation to its end.
pub async fn add_facts(
    db: &mut Connection,
    id: MissionId,
    facts: Facts,
) -> Result<(), EngineError> {
    if facts == Facts::default() {
        return Ok(());
    }
    let id = id.to_string();
    let boot = facts.boot.map(|boot| boot.to_string());
    let plan = facts.plan.map(|plan| to_json("plan", &plan)).transpose()?;
    let progress = facts
        .progress
        .map(|progress| to_json("progress", &progress))
        .transpose()?;
    let started_at_us = facts.started_at.map(to_us);
    let ended_at_us = facts.ended_at.map(to_us);
    sqlx::query!(
        "UPDATE missions SET boot = COALESCE($1, boot), plan = COALESCE($2, plan),
             progress = COALESCE($3, progress),
             started_at_us = COALESCE(started_at_us,
                 MIN(MAX($4, created_at_us), COALESCE(ended_at_us, MAX($4, created_at_us)))),
             ended_at_us = COALESCE(ended_at_us,
                 MAX($5, COALESCE(started_at_us, $4, created_at_us), created_at_us))
         WHERE id = $6",
        boot,
        plan,
        progress,
        started_at_us,
        ended_at_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Sets whether an open mission is to be paused; `false` if it has ended.
pub async fn set_pause_requested(
    db: &mut Connection,
    id: MissionId,
    requested: bool,
) -> Result<bool, EngineError> {
    let id = id.to_string();
    let result = sqlx::query!(
        "UPDATE missions SET pause_wanted = $1 WHERE id = $2 AND state IN
             ('queued', 'offered', 'active', 'paused')",
        requested,
        id,
    )
    .execute(db)
    .await?;
    Ok(result.rows_affected() == 1)
}

/// Sets or removes the revision that the robot does not have completely yet.
pub async fn set_replacement(
    db: &mut Connection,
    id: MissionId,
    replacement: Option<&Replacement>,
) -> Result<(), EngineError> {
    let id = id.to_string();
    let replacement = replacement
        .map(|replacement| to_json("replacement", replacement))
        .transpose()?;
    sqlx::query!(
        "UPDATE missions SET replacement = $1 WHERE id = $2",
        replacement,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Makes another revision the present one; `false` if the present one is not `from`.
pub async fn swap_content(
    db: &mut Connection,
    id: MissionId,
    from: u32,
    to: &Replacement,
) -> Result<bool, EngineError> {
    let (id, from, revision) = (id.to_string(), i64::from(from), i64::from(to.revision));
    let (plan_hash, trajectory) = (
        to.plan_hash.to_string(),
        to_json("trajectory", &to.trajectory)?,
    );
    let result = sqlx::query!(
        "UPDATE missions SET revision = $1, plan_hash = $2, trajectory = $3, replacement = NULL,
             plan = NULL, progress = NULL
         WHERE id = $4 AND revision = $5",
        revision,
        plan_hash,
        trajectory,
        id,
        from,
    )
    .execute(db)
    .await?;
    Ok(result.rows_affected() == 1)
}

/// Stores since when a mission's robot has not been heard; `None` if it is heard.
pub async fn set_silence(
    db: &mut Connection,
    id: MissionId,
    since: Option<Timestamp>,
) -> Result<(), EngineError> {
    let (id, since_us) = (id.to_string(), since.map(to_us));
    sqlx::query!(
        "UPDATE missions SET silent_since_us = $1 WHERE id = $2",
        since_us,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Stores how a mission was driven; only the first value counts.
pub async fn add_outcome(
    db: &mut Connection,
    id: MissionId,
    quality: Option<&MissionQuality>,
    driven: Option<&DrivenPath>,
) -> Result<(), EngineError> {
    let id = id.to_string();
    let quality = quality
        .map(|quality| to_json("quality", quality))
        .transpose()?;
    let driven = driven
        .map(|driven| to_json("driven path", driven))
        .transpose()?;
    sqlx::query!(
        "UPDATE missions SET quality = COALESCE(quality, $1), driven = COALESCE(driven, $2)
         WHERE id = $3",
        quality,
        driven,
        id,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns how a mission was driven, as far as its robot has reported it.
pub async fn outcome(
    db: &mut Connection,
    id: MissionId,
) -> Result<(Option<MissionQuality>, Option<DrivenPath>), EngineError> {
    let id = id.to_string();
    let found = sqlx::query!("SELECT quality, driven FROM missions WHERE id = $1", id)
        .fetch_optional(db)
        .await?;
    let Some(found) = found else {
        return Ok((None, None));
    };
    let quality = found.quality.as_deref();
    let driven = found.driven.as_deref();
    Ok((
        quality
            .map(|quality| from_json("quality", quality))
            .transpose()?,
        driven
            .map(|driven| from_json("driven path", driven))
            .transpose()?,
    ))
}

/// Returns the number of missions in each state.
pub async fn counts(db: &mut Connection) -> Result<Vec<(MissionState, u64)>, EngineError> {
    let rows =
        sqlx::query!(r#"SELECT state, COUNT(*) AS "count!: i64" FROM missions GROUP BY state"#)
            .fetch_all(db)
            .await?;
    rows.into_iter()
        .map(|row| Ok((state(&row.state)?, unsigned("count", row.count)?)))
        .collect()
}
