//! Join tokens of robots. Only the hash of a secret is stored.

use jiff::Timestamp;
use tread_api::enrolment::JoinToken;
use tread_api::ids::{JoinTokenId, RobotId};
use tread_api::rights::Scope;

use super::secrets::{TokenRow, look_up_tokens};
use super::{Connection, EngineError, from_us, parse, scope_text, to_us};
use tread_store::Fingerprint;

struct Raw {
    id: String,
    site: String,
    robot: Option<String>,
    created_at_us: i64,
    created_by: String,
    expires_at_us: i64,
    used_at_us: Option<i64>,
    used_by: Option<String>,
    revoked_at_us: Option<i64>,
}

fn robot(name: Option<String>) -> Result<Option<RobotId>, EngineError> {
    name.map(|name| parse("robot", &name)).transpose()
}

impl TryFrom<Raw> for JoinToken {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        Ok(Self {
            id: parse("join token", &raw.id)?,
            site: parse("site", &raw.site)?,
            robot: robot(raw.robot)?,
            created_at: from_us(raw.created_at_us)?,
            created_by: raw.created_by,
            expires_at: from_us(raw.expires_at_us)?,
            used_at: raw.used_at_us.map(from_us).transpose()?,
            used_by: robot(raw.used_by)?,
            revoked_at: raw.revoked_at_us.map(from_us).transpose()?,
        })
    }
}

macro_rules! join_tokens {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT id, site, robot, created_at_us, created_by, expires_at_us, used_at_us,
                   used_by, revoked_at_us
               FROM join_tokens "# + $condition
            $(, $argument)*
        )
    };
}

/// Returns the join tokens of a scope that are older than one, newest first, with used, revoked and
/// expired ones.
pub async fn list(
    db: &mut Connection,
    within: &Scope,
    before: Option<JoinTokenId>,
    limit: u32,
) -> Result<Vec<JoinToken>, EngineError> {
    let before = before.map(|id| id.to_string());
    let within = scope_text(within)?;
    let raw = join_tokens!(
        "WHERE (CAST($1 AS TEXT) IS NULL OR id < $1)
           AND (CAST($3 AS TEXT) IS NULL OR site IN (SELECT value FROM json_each($3))
               OR site || '/' || robot IN (SELECT value FROM json_each($3)))
         ORDER BY id DESC LIMIT $2",
        before,
        i64::from(limit),
        within
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(JoinToken::try_from).collect()
}

look_up_tokens!(
    "join_tokens",
    join_tokens,
    "join token",
    JoinTokenId,
    JoinToken
);

/// Returns the number of join tokens that are valid at a time.
pub async fn valid_count(db: &mut Connection, at: Timestamp) -> Result<i64, EngineError> {
    let at_us = to_us(at);
    let row = sqlx::query!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM join_tokens
           WHERE used_at_us IS NULL AND revoked_at_us IS NULL AND expires_at_us > $1"#,
        at_us
    )
    .fetch_one(db)
    .await?;
    Ok(row.count)
}

/// Returns the number of join tokens of a scope that are valid at a time.
pub async fn valid_count_within(
    db: &mut Connection,
    within: &Scope,
    at: Timestamp,
) -> Result<i64, EngineError> {
    let (within, at_us) = (scope_text(within)?, to_us(at));
    let row = sqlx::query!(
        r#"SELECT COUNT(*) AS "count!: i64" FROM join_tokens
           WHERE used_at_us IS NULL AND revoked_at_us IS NULL AND expires_at_us > $1
             AND (CAST($2 AS TEXT) IS NULL OR site IN (SELECT value FROM json_each($2))
                 OR site || '/' || robot IN (SELECT value FROM json_each($2)))"#,
        at_us,
        within
    )
    .fetch_one(db)
    .await?;
    Ok(row.count)
}

/// Stores a new join token.
pub async fn insert(
    db: &mut Connection,
    token: &JoinToken,
    fingerprint: &Fingerprint,
) -> Result<(), EngineError> {
    let (id, site) = (token.id.to_string(), token.site.as_str());
    let robot = token.robot.as_ref().map(RobotId::as_str);
    let (lookup, hash) = (fingerprint.lookup(), fingerprint.as_bytes());
    let (created_at_us, expires_at_us) = (to_us(token.created_at), to_us(token.expires_at));
    sqlx::query!(
        "INSERT INTO join_tokens (id, site, robot, lookup, hash, created_at_us, created_by,
             expires_at_us)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8)",
        id,
        site,
        robot,
        lookup,
        hash,
        created_at_us,
        token.created_by,
        expires_at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Marks a join token as used; false if it was used before.
pub async fn consume(
    db: &mut Connection,
    id: JoinTokenId,
    by: &RobotId,
    at: Timestamp,
) -> Result<bool, EngineError> {
    let (id, by, at_us) = (id.to_string(), by.as_str(), to_us(at));
    let done = sqlx::query!(
        "UPDATE join_tokens SET used_at_us = MAX($1, created_at_us), used_by = $2
         WHERE id = $3 AND used_at_us IS NULL AND revoked_at_us IS NULL",
        at_us,
        by,
        id
    )
    .execute(db)
    .await?;
    Ok(done.rows_affected() == 1)
}

/// Revokes a join token; only the first time counts.
pub async fn revoke(
    db: &mut Connection,
    id: JoinTokenId,
    at: Timestamp,
) -> Result<(), EngineError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE join_tokens SET revoked_at_us = COALESCE(revoked_at_us,
             MAX($1, created_at_us, COALESCE(used_at_us, created_at_us)))
         WHERE id = $2",
        at_us,
        id
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Deletes at most `limit` join tokens that ended before a time.
pub async fn delete_ended(
    db: &mut Connection,
    before: Timestamp,
    limit: u32,
) -> Result<(), EngineError> {
    let before_us = to_us(before);
    sqlx::query!(
        "DELETE FROM join_tokens WHERE id IN (
             SELECT id FROM join_tokens WHERE expires_at_us < $1 ORDER BY id LIMIT $2)",
        before_us,
        i64::from(limit),
    )
    .execute(db)
    .await?;
    Ok(())
}
