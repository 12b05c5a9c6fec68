//! Histories of missions, and the reports of robots that were applied.

use tread_api::event::MissionStep;
use tread_api::ids::MissionId;
use tread_api::mission::{Actor, MissionEvent, MissionState};
use tread_store::RecordKey;

use super::missions::{cause, state};
use super::{Connection, EngineError, corrupt, from_us, parse, to_us, unsigned};

/// Returns the actor, both states and the cause of an event as they are stored.
fn columns(
    event: &MissionEvent,
) -> (
    &'static str,
    Option<&'static str>,
    &'static str,
    &'static str,
) {
    let from = event.from.map(MissionState::as_str);
    let (actor, to, cause) = (
        event.actor.as_str(),
        event.to.as_str(),
        event.cause.as_str(),
    );
    (actor, from, to, cause)
}

/// Adds the first event of a new mission, and a second one that happened at once.
pub async fn begin(
    db: &mut Connection,
    id: MissionId,
    first: &MissionEvent,
    second: Option<&MissionEvent>,
) -> Result<(), EngineError> {
    let id = id.to_string();
    let (at_us, (actor, from, to, cause)) = (to_us(first.at), columns(first));
    let then_at_us = second.map(|event| to_us(event.at).max(at_us));
    let (then_actor, then_from, then_to, then_cause) = second
        .map(columns)
        .map_or((None, None, None, None), |(actor, from, to, cause)| {
            (Some(actor), from, Some(to), Some(cause))
        });
    let then_reason = second.and_then(|event| event.reason.as_deref());
    sqlx::query!(
        "INSERT INTO mission_events (mission, at_us, actor, from_state, to_state, cause, reason)
         SELECT CAST($1 AS TEXT), CAST($2 AS BIGINT), CAST($3 AS TEXT), CAST($4 AS TEXT),
             CAST($5 AS TEXT), CAST($6 AS TEXT), CAST($7 AS TEXT)
         UNION ALL SELECT CAST($1 AS TEXT), CAST($8 AS BIGINT), CAST($9 AS TEXT),
             CAST($10 AS TEXT), CAST($11 AS TEXT), CAST($12 AS TEXT), CAST($13 AS TEXT)
         WHERE CAST($8 AS BIGINT) IS NOT NULL",
        id,
        at_us,
        actor,
        from,
        to,
        cause,
        first.reason,
        then_at_us,
        then_actor,
        then_from,
        then_to,
        then_cause,
        then_reason,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Adds an event to a mission's history, with a time not before the preceding event's.
pub async fn add_event(
    db: &mut Connection,
    id: MissionId,
    event: &MissionEvent,
) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(event.at));
    let (actor, from, to, cause) = columns(event);
    sqlx::query!(
        "INSERT INTO mission_events (mission, at_us, actor, from_state, to_state, cause, reason)
         VALUES ($1,
             MAX($2, COALESCE((SELECT MAX(at_us) FROM mission_events WHERE mission = $1), $2)),
             $3, $4, $5, $6, $7)",
        id,
        at_us,
        actor,
        from,
        to,
        cause,
        event.reason,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns a mission's history, oldest first, at most `limit` events.
pub async fn events(
    db: &mut Connection,
    id: MissionId,
    limit: u32,
) -> Result<Vec<MissionEvent>, EngineError> {
    let id = id.to_string();
    let raw = sqlx::query_as!(
        RawEvent,
        "SELECT at_us, actor, from_state, to_state, cause, reason FROM mission_events
         WHERE mission = $1 ORDER BY pk LIMIT $2",
        id,
        i64::from(limit),
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
    cause: String,
    reason: Option<String>,
}

impl TryFrom<RawEvent> for MissionEvent {
    type Error = EngineError;

    fn try_from(raw: RawEvent) -> Result<Self, EngineError> {
        Ok(Self {
            at: from_us(raw.at_us)?,
            actor: Actor::from_name(&raw.actor).ok_or_else(|| corrupt("actor", &raw.actor))?,
            from: raw.from_state.as_deref().map(state).transpose()?,
            to: state(&raw.to_state)?,
            cause: cause(&raw.cause)?,
            reason: raw.reason,
        })
    }
}

/// Returns the number of events in a mission's history.
pub async fn event_count(db: &mut Connection, id: MissionId) -> Result<u32, EngineError> {
    let id = id.to_string();
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM mission_events WHERE mission = $1"#,
        id
    )
    .fetch_one(db)
    .await?;
    unsigned("count", count)
}

/// Returns whether a report was applied before.
pub async fn has_report(db: &mut Connection, key: RecordKey) -> Result<bool, EngineError> {
    let found = sqlx::query_scalar!(
        r#"SELECT EXISTS (SELECT 1 FROM reports_seen WHERE boot_pk = $1 AND seq = $2)
               AS "found!: bool""#,
        key.boot_pk,
        key.seq,
    );
    Ok(found.fetch_one(db).await?)
}

/// Records that a report was applied.
pub async fn record_report(db: &mut Connection, key: RecordKey) -> Result<(), EngineError> {
    sqlx::query!(
        "INSERT INTO reports_seen (boot_pk, seq) VALUES ($1, $2)",
        key.boot_pk,
        key.seq
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Returns the key of the newest event of all histories; 0 if there is none.
pub async fn newest_step(db: &mut Connection) -> Result<i64, EngineError> {
    let newest =
        sqlx::query_scalar!(r#"SELECT COALESCE(MAX(pk), 0) AS "newest!: i64" FROM mission_events"#);
    Ok(newest.fetch_one(db).await?)
}

struct RawStep {
    pk: i64,
    mission: String,
    site: String,
    robot: String,
    at_us: i64,
    actor: String,
    from_state: Option<String>,
    to_state: String,
    cause: String,
    reason: Option<String>,
}

/// Returns at most `limit` events of all histories after a key, in order, each with its key.
pub async fn steps_after(
    db: &mut Connection,
    after: i64,
    limit: u32,
) -> Result<Vec<(i64, MissionStep)>, EngineError> {
    let raw = sqlx::query_as!(
        RawStep,
        r#"SELECT e.pk AS "pk!", e.mission, sites.id AS site, robots.id AS robot, e.at_us, e.actor,
               e.from_state, e.to_state, e.cause, e.reason
           FROM mission_events AS e
           JOIN missions ON missions.id = e.mission
           JOIN robots ON robots.pk = missions.robot_pk
           JOIN sites ON sites.pk = robots.site_pk
           WHERE e.pk > $1 ORDER BY e.pk LIMIT $2"#,
        after,
        i64::from(limit),
    )
    .fetch_all(db)
    .await?;
    raw.into_iter()
        .map(|raw| {
            let step = RawEvent {
                at_us: raw.at_us,
                actor: raw.actor,
                from_state: raw.from_state,
                to_state: raw.to_state,
                cause: raw.cause,
                reason: raw.reason,
            };
            let step = MissionStep {
                mission: parse("mission", &raw.mission)?,
                site: parse("site", &raw.site)?,
                robot: parse("robot", &raw.robot)?,
                step: step.try_into()?,
            };
            Ok((raw.pk, step))
        })
        .collect()
}
