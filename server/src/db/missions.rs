//! Missions and their histories.

use futures_util::StreamExt as _;
use jiff::Timestamp;
use sqlx::SqliteConnection;
use tread_api::ids::{BootId, MissionId, RobotId, SiteId};
use tread_api::mission::{Actor, Mission, MissionEvent, MissionState, PlanSummary};
use tread_api::robot::MissionProgress;

use super::{DbError, corrupt, from_json, from_us, parse, to_json, to_us, unsigned};

/// A mission with the key of its robot.
#[derive(Debug, Clone, PartialEq)]
pub struct MissionRow {
    /// The robot's key.
    pub robot_pk: i64,
    /// The mission; its progress is the last one that was reported durably.
    pub mission: Mission,
}

struct Raw {
    id: String,
    robot_pk: i64,
    site: String,
    robot: String,
    state: String,
    reason: Option<String>,
    revision: i64,
    plan_hash: String,
    trajectory: String,
    latest_start_us: Option<i64>,
    boot: Option<String>,
    plan: Option<String>,
    progress: Option<String>,
    created_at_us: i64,
    started_at_us: Option<i64>,
    ended_at_us: Option<i64>,
}

impl TryFrom<Raw> for MissionRow {
    type Error = DbError;

    fn try_from(raw: Raw) -> Result<Self, DbError> {
        let optional_time = |time_us: Option<i64>| time_us.map(from_us).transpose();
        let mission = Mission {
            id: parse("mission", &raw.id)?,
            site: parse("site", &raw.site)?,
            robot: parse("robot", &raw.robot)?,
            state: state(&raw.state)?,
            reason: raw.reason,
            revision: unsigned("mission revision", raw.revision)?,
            plan_hash: from_json("plan hash", &format!("\"{}\"", raw.plan_hash))?,
            trajectory: from_json("trajectory", &raw.trajectory)?,
            latest_start: optional_time(raw.latest_start_us)?,
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

fn state(name: &str) -> Result<MissionState, DbError> {
    MissionState::from_name(name).ok_or_else(|| corrupt("mission state", name))
}

macro_rules! missions {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT missions.id, missions.robot_pk, sites.id AS site, robots.id AS robot,
                   missions.state, missions.reason, missions.revision, missions.plan_hash,
                   missions.trajectory, missions.latest_start_us, missions.boot, missions.plan,
                   missions.progress, missions.created_at_us, missions.started_at_us,
                   missions.ended_at_us
               FROM missions
               JOIN robots ON robots.pk = missions.robot_pk
               JOIN sites ON sites.pk = robots.site_pk "# + $condition
            $(, $argument)*
        )
    };
}

/// Adds a mission.
pub async fn insert(db: &mut SqliteConnection, row: &MissionRow) -> Result<(), DbError> {
    let mission = &row.mission;
    let (id, state) = (mission.id.to_string(), mission.state.as_str());
    let (revision, plan_hash) = (i64::from(mission.revision), mission.plan_hash.to_string());
    let trajectory = to_json("trajectory", &mission.trajectory)?;
    let latest_start_us = mission.latest_start.map(to_us);
    let created_at_us = to_us(mission.created_at);
    sqlx::query!(
        "INSERT INTO missions (id, robot_pk, state, revision, plan_hash, trajectory,
             latest_start_us, created_at_us)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
        id,
        row.robot_pk,
        state,
        revision,
        plan_hash,
        trajectory,
        latest_start_us,
        created_at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// The mission of that identifier.
pub async fn find(db: &mut SqliteConnection, id: MissionId) -> Result<Option<MissionRow>, DbError> {
    let id = id.to_string();
    let raw = missions!("WHERE missions.id = ?", id)
        .fetch_optional(db)
        .await?;
    raw.map(MissionRow::try_from).transpose()
}

/// Which missions to list.
#[derive(Debug, Clone, Default)]
pub struct MissionFilter {
    /// Only those of this site.
    pub site: Option<SiteId>,
    /// Only those of robots of this name.
    pub robot: Option<RobotId>,
    /// Only those in this state.
    pub state: Option<MissionState>,
    /// Only those older than this one.
    pub before: Option<MissionId>,
}

/// Missions, newest first, until there are `limit` or their trajectories pass `bytes_max`; and
/// whether there are more.
pub async fn list(
    db: &mut SqliteConnection,
    filter: &MissionFilter,
    limit: u32,
    bytes_max: usize,
) -> Result<(Vec<MissionRow>, bool), DbError> {
    let site = filter.site.as_ref().map(SiteId::as_str);
    let robot = filter.robot.as_ref().map(RobotId::as_str);
    let state = filter.state.map(MissionState::as_str);
    let before = filter.before.map(|id| id.to_string());
    let limit_and_one = i64::from(limit) + 1;
    let query = missions!(
        "WHERE (?1 IS NULL OR sites.id = ?1) AND (?2 IS NULL OR robots.id = ?2)
           AND (?3 IS NULL OR missions.state = ?3) AND (?4 IS NULL OR missions.id < ?4)
         ORDER BY missions.id DESC LIMIT ?5",
        site,
        robot,
        state,
        before,
        limit_and_one,
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

/// Where an open mission stands, without what is to be driven, which may be long.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Standing {
    /// The mission.
    pub id: MissionId,
    /// The robot's site.
    pub site: SiteId,
    /// The robot.
    pub robot: RobotId,
    /// Where it stands.
    pub state: MissionState,
    /// Why it stands there.
    pub reason: Option<String>,
    /// The run of the agent that took it.
    pub boot: Option<BootId>,
}

impl From<&Mission> for Standing {
    fn from(mission: &Mission) -> Self {
        Self {
            id: mission.id,
            site: mission.site.clone(),
            robot: mission.robot.clone(),
            state: mission.state,
            reason: mission.reason.clone(),
            boot: mission.boot,
        }
    }
}

struct RawStanding {
    id: String,
    site: String,
    robot: String,
    state: String,
    reason: Option<String>,
    boot: Option<String>,
}

impl TryFrom<RawStanding> for Standing {
    type Error = DbError;

    fn try_from(raw: RawStanding) -> Result<Self, DbError> {
        Ok(Self {
            id: parse("mission", &raw.id)?,
            site: parse("site", &raw.site)?,
            robot: parse("robot", &raw.robot)?,
            state: state(&raw.state)?,
            reason: raw.reason,
            boot: raw
                .boot
                .as_deref()
                .map(|boot| parse("boot", boot))
                .transpose()?,
        })
    }
}

macro_rules! standings {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            RawStanding,
            r#"SELECT missions.id, sites.id AS site, robots.id AS robot, missions.state,
                   missions.reason, missions.boot
               FROM missions
               JOIN robots ON robots.pk = missions.robot_pk
               JOIN sites ON sites.pk = robots.site_pk "# + $condition
            $(, $argument)*
        )
    };
}

fn standings(raw: Vec<RawStanding>) -> Result<Vec<Standing>, DbError> {
    raw.into_iter().map(Standing::try_from).collect()
}

/// All missions that a robot has in hand, or that wait for its answer.
pub async fn in_hand(db: &mut SqliteConnection) -> Result<Vec<Standing>, DbError> {
    let raw = standings!("WHERE missions.state IN ('offered', 'active', 'paused', 'cancelling')")
        .fetch_all(db)
        .await?;
    standings(raw)
}

/// The oldest queued mission of each robot that has nothing in hand.
pub async fn next_in_queues(db: &mut SqliteConnection) -> Result<Vec<Standing>, DbError> {
    let raw = standings!(
        "WHERE missions.id IN (
             SELECT MIN(id) FROM missions WHERE state = 'queued' GROUP BY robot_pk)
           AND NOT EXISTS (
             SELECT 1 FROM missions AS other WHERE other.robot_pk = missions.robot_pk
               AND other.state IN ('offered', 'active', 'paused', 'cancelling'))"
    )
    .fetch_all(db)
    .await?;
    standings(raw)
}

/// Queued missions whose latest start has passed.
pub async fn overdue(
    db: &mut SqliteConnection,
    now: Timestamp,
    limit: u32,
) -> Result<Vec<Standing>, DbError> {
    let now_us = to_us(now);
    let raw = standings!(
        "WHERE missions.state = 'queued' AND missions.latest_start_us < ? LIMIT ?",
        now_us,
        limit,
    )
    .fetch_all(db)
    .await?;
    standings(raw)
}

/// How many missions of a robot wait.
pub async fn queued_count(db: &mut SqliteConnection, robot_pk: i64) -> Result<usize, DbError> {
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM missions
           WHERE robot_pk = ? AND state = 'queued'"#,
        robot_pk,
    )
    .fetch_one(db)
    .await?;
    unsigned("count", count)
}

/// Moves a mission from one state to another; `false` if it did not stand there any more.
pub async fn compare_and_set(
    db: &mut SqliteConnection,
    id: MissionId,
    from: MissionState,
    to: MissionState,
    reason: Option<&str>,
) -> Result<bool, DbError> {
    let (id, from, to) = (id.to_string(), from.as_str(), to.as_str());
    let result = sqlx::query!(
        "UPDATE missions SET state = ?, reason = ? WHERE id = ? AND state = ?",
        to,
        reason,
        id,
        from,
    )
    .execute(db)
    .await?;
    Ok(result.rows_affected() == 1)
}

/// What a robot's answer or report adds to a mission; what is `None` stays as it is.
#[derive(Debug, Clone, Copy, Default)]
pub struct Facts {
    /// The run of the agent that took it.
    pub boot: Option<BootId>,
    /// What the robot planned.
    pub plan: Option<PlanSummary>,
    /// How far it has come.
    pub progress: Option<MissionProgress>,
    /// When it began; a first word counts.
    pub started_at: Option<Timestamp>,
    /// When it ended; a first word counts.
    pub ended_at: Option<Timestamp>,
}

/// Adds facts to a mission.
pub async fn add_facts(
    db: &mut SqliteConnection,
    id: MissionId,
    facts: Facts,
) -> Result<(), DbError> {
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
        "UPDATE missions SET boot = COALESCE(?, boot), plan = COALESCE(?, plan),
             progress = COALESCE(?, progress), started_at_us = COALESCE(started_at_us, ?),
             ended_at_us = COALESCE(ended_at_us, ?)
         WHERE id = ?",
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

/// Writes a step into a mission's history.
pub async fn add_event(
    db: &mut SqliteConnection,
    id: MissionId,
    event: &MissionEvent,
) -> Result<(), DbError> {
    let (id, at_us, actor) = (id.to_string(), to_us(event.at), event.actor.as_str());
    let (from, to) = (event.from.map(MissionState::as_str), event.to.as_str());
    sqlx::query!(
        "INSERT INTO mission_events (mission, at_us, actor, from_state, to_state, reason)
         VALUES (?, ?, ?, ?, ?, ?)",
        id,
        at_us,
        actor,
        from,
        to,
        event.reason,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// A mission's history, oldest first, at most `limit` steps.
pub async fn events(
    db: &mut SqliteConnection,
    id: MissionId,
    limit: u32,
) -> Result<Vec<MissionEvent>, DbError> {
    let id = id.to_string();
    let raw = sqlx::query_as!(
        RawEvent,
        "SELECT at_us, actor, from_state, to_state, reason FROM mission_events
         WHERE mission = ? ORDER BY pk LIMIT ?",
        id,
        limit,
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(MissionEvent::try_from).collect()
}

struct RawEvent {
    at_us: i64,
    actor: String,
    from_state: Option<String>,
    to_state: String,
    reason: Option<String>,
}

impl TryFrom<RawEvent> for MissionEvent {
    type Error = DbError;

    fn try_from(raw: RawEvent) -> Result<Self, DbError> {
        Ok(Self {
            at: from_us(raw.at_us)?,
            actor: Actor::from_name(&raw.actor).ok_or_else(|| corrupt("actor", &raw.actor))?,
            from: raw.from_state.as_deref().map(state).transpose()?,
            to: state(&raw.to_state)?,
            reason: raw.reason,
        })
    }
}

/// How many steps a mission's history has.
pub async fn event_count(db: &mut SqliteConnection, id: MissionId) -> Result<u32, DbError> {
    let id = id.to_string();
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM mission_events WHERE mission = ?"#,
        id
    )
    .fetch_one(db)
    .await?;
    unsigned("count", count)
}

/// Whether a report has been taken before.
pub async fn has_report(
    db: &mut SqliteConnection,
    boot_pk: i64,
    seq: i64,
) -> Result<bool, DbError> {
    let found = sqlx::query_scalar!(
        r#"SELECT EXISTS (SELECT 1 FROM reports_seen WHERE boot_pk = ? AND seq = ?)
               AS "found!: bool""#,
        boot_pk,
        seq,
    );
    Ok(found.fetch_one(db).await?)
}

/// Notes that a report has been taken.
pub async fn note_report(db: &mut SqliteConnection, boot_pk: i64, seq: i64) -> Result<(), DbError> {
    sqlx::query!(
        "INSERT INTO reports_seen (boot_pk, seq) VALUES (?, ?)",
        boot_pk,
        seq
    )
    .execute(db)
    .await?;
    Ok(())
}
