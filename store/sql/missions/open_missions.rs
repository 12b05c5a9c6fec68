//! States of open missions without their trajectories, for the reconciler.

use jiff::Timestamp;
pub use tread_store::missions::OpenMission;

use super::super::{Connection, EngineError, corrupt, from_json, from_us, parse, to_us, unsigned};
use super::state;

struct RawOpenMission {
    id: String,
    site: String,
    robot: String,
    state: String,
    reason: Option<String>,
    boot: Option<String>,
    pause_wanted: bool,
    priority: i64,
    revision: i64,
    plan_hash: String,
    replacement_revision: Option<i64>,
    replacement_hash: Option<String>,
    silent_since_us: Option<i64>,
    lost_after_s: Option<f64>,
    link_policy: String,
    duration_s: Option<f64>,
}

impl TryFrom<RawOpenMission> for OpenMission {
    type Error = EngineError;

    fn try_from(raw: RawOpenMission) -> Result<Self, EngineError> {
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
            pause_requested: raw.pause_wanted,
            priority: i32::try_from(raw.priority)
                .map_err(|_range| corrupt("priority", raw.priority))?,
            content: (
                unsigned("mission revision", raw.revision)?,
                parse("plan hash", &raw.plan_hash)?,
            ),
            replacement: match (raw.replacement_revision, raw.replacement_hash) {
                (Some(revision), Some(hash)) => Some((
                    unsigned("mission revision", revision)?,
                    parse("plan hash", &hash)?,
                )),
                (Some(_), None) | (None, _) => None,
            },
            silent_since: raw.silent_since_us.map(from_us).transpose()?,
            lost_after_s: raw.lost_after_s,
            link_policy: from_json("link policy", &raw.link_policy)?,
            duration_s: raw.duration_s,
        })
    }
}

macro_rules! open_missions {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            RawOpenMission,
            r#"SELECT missions.id, sites.id AS site, robots.id AS robot, missions.state,
                   missions.reason, missions.boot,
                   missions.pause_wanted AS "pause_wanted: bool", missions.priority,
                   missions.revision,
                   missions.plan_hash,
                   CAST(missions.replacement ->> 'revision' AS BIGINT) AS "replacement_revision: i64",
                   missions.replacement ->> 'plan_hash' AS "replacement_hash: String",
                   missions.silent_since_us, missions.lost_after_s, missions.link_policy,
                   CAST(missions.plan ->> 'duration_s' AS DOUBLE PRECISION) AS "duration_s: f64"
               FROM missions
               JOIN robots ON robots.pk = missions.robot_pk
               JOIN sites ON sites.pk = robots.site_pk "# + $condition
            $(, $argument)*
        )
    };
}

fn open_missions(raw: Vec<RawOpenMission>) -> Result<Vec<OpenMission>, EngineError> {
    raw.into_iter().map(OpenMission::try_from).collect()
}

/// Returns all missions in progress: active ones, and those that await their robot's answer.
pub async fn in_progress(db: &mut Connection) -> Result<Vec<OpenMission>, EngineError> {
    let raw =
        open_missions!("WHERE missions.state IN ('offered', 'active', 'paused', 'cancelling')")
            .fetch_all(db)
            .await?;
    open_missions(raw)
}

/// Returns the first queued mission of each robot without an active one; held missions are skipped.
pub async fn next_in_queues(db: &mut Connection) -> Result<Vec<OpenMission>, EngineError> {
    let raw = open_missions!(
        "WHERE missions.id IN (
             SELECT id FROM (
                 SELECT id, ROW_NUMBER() OVER (PARTITION BY robot_pk ORDER BY priority DESC, id)
                     AS place
                 FROM missions WHERE state = 'queued' AND pause_wanted = FALSE) AS queued
             WHERE place = 1)
           AND NOT EXISTS (
             SELECT 1 FROM missions AS other WHERE other.robot_pk = missions.robot_pk
               AND other.state IN ('offered', 'active', 'paused', 'cancelling'))"
    )
    .fetch_all(db)
    .await?;
    open_missions(raw)
}

/// Returns the queued missions whose latest start has passed.
pub async fn overdue(
    db: &mut Connection,
    now: Timestamp,
    limit: u32,
) -> Result<Vec<OpenMission>, EngineError> {
    let now_us = to_us(now);
    let raw = open_missions!(
        "WHERE missions.state = 'queued' AND missions.latest_start_us < $1 LIMIT $2",
        now_us,
        i64::from(limit),
    )
    .fetch_all(db)
    .await?;
    open_missions(raw)
}

/// Returns a robot's open missions, the active one first, then in the order of the queue.
pub async fn open_of_robot(
    db: &mut Connection,
    robot_pk: i64,
) -> Result<Vec<OpenMission>, EngineError> {
    let raw = open_missions!(
        "WHERE missions.robot_pk = $1 AND missions.state IN
             ('queued', 'offered', 'active', 'paused', 'cancelling')
         ORDER BY missions.state = 'queued', missions.priority DESC, missions.id",
        robot_pk,
    )
    .fetch_all(db)
    .await?;
    open_missions(raw)
}
