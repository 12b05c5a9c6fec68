//! The audit log: who changed what, and who was refused, in a chain of hashes
//! ([`tread_api::audit`]).

use tread_api::audit::{AuditChain, FIRST_PREVIOUS_HASH, hash_after};
use tread_api::identity::{AuditEntry, AuditOrder, Role};
use tread_api::ids::TokenId;
pub use tread_store::audit::{AuditFilter, AuditRetention};

use super::tokens::role;
use super::{Connection, EngineError, from_json, from_us, parse, to_json, to_us, unsigned};

struct Raw {
    id: i64,
    at_us: i64,
    since_us: Option<i64>,
    count: i64,
    who: Option<String>,
    token_id: Option<String>,
    person: Option<String>,
    role: Option<String>,
    address: String,
    method: String,
    route: String,
    path: String,
    status: i64,
    request_id: String,
    what: Option<String>,
    previous_hash: Option<String>,
    hash: Option<String>,
}

impl TryFrom<Raw> for AuditEntry {
    type Error = EngineError;

    fn try_from(raw: Raw) -> Result<Self, EngineError> {
        let token = raw.token_id.as_deref();
        let what = raw.what.as_deref();
        let person = raw.person.as_deref();
        Ok(Self {
            id: unsigned("number", raw.id)?,
            at: from_us(raw.at_us)?,
            since: raw.since_us.map(from_us).transpose()?,
            count: unsigned("count", raw.count)?,
            who: raw.who,
            token: token.map(|id| parse("token", id)).transpose()?,
            person: person
                .map(|person| from_json("person", person))
                .transpose()?,
            role: raw.role.as_deref().map(role).transpose()?,
            address: raw.address,
            method: raw.method,
            route: raw.route,
            path: raw.path,
            status: unsigned("status", raw.status)?,
            request_id: raw.request_id,
            what: what.map(|what| from_json("body", what)).transpose()?,
            previous_hash: raw.previous_hash,
            hash: raw.hash,
        })
    }
}

/// Returns entries in the requested order.
pub async fn list(
    db: &mut Connection,
    filter: &AuditFilter,
    limit: u32,
) -> Result<Vec<AuditEntry>, EngineError> {
    let beyond = filter.beyond.map(i64::try_from).transpose();
    let beyond = beyond.map_err(|_range| EngineError::DoesNotFit("number"))?;
    let raw =
        match filter.order {
            AuditOrder::Newest => sqlx::query_as!(
                Raw,
                r#"SELECT id, at_us, since_us, count, who, token_id, person, role, address, method,
                       route, path, status, request_id, what, previous_hash, hash
                   FROM audit
                   WHERE (CAST($1 AS BIGINT) IS NULL OR id < $1) AND (CAST($2 AS TEXT) IS NULL OR who = $2)
                     AND ($3 = FALSE OR status >= 400)
                   ORDER BY id DESC LIMIT $4"#,
                beyond,
                filter.who,
                filter.refused,
                i64::from(limit),
            )
            .fetch_all(db)
            .await?,
            AuditOrder::Oldest => sqlx::query_as!(
                Raw,
                r#"SELECT id, at_us, since_us, count, who, token_id, person, role, address, method,
                       route, path, status, request_id, what, previous_hash, hash
                   FROM audit
                   WHERE (CAST($1 AS BIGINT) IS NULL OR id > $1) AND (CAST($2 AS TEXT) IS NULL OR who = $2)
                     AND ($3 = FALSE OR status >= 400)
                   ORDER BY id LIMIT $4"#,
                beyond,
                filter.who,
                filter.refused,
                i64::from(limit),
            )
            .fetch_all(db)
            .await?,
        };
    raw.into_iter().map(AuditEntry::try_from).collect()
}

/// Returns the data that anchors the chain; `None` if it was removed.
pub async fn chain(db: &mut Connection) -> Result<Option<AuditChain>, EngineError> {
    let row = sqlx::query!(
        "SELECT before_id, before_hash, last_id, last_hash FROM audit_chain WHERE id = 1"
    )
    .fetch_optional(db)
    .await?;
    row.map(|row| {
        Ok(AuditChain {
            before_id: unsigned("number", row.before_id)?,
            before_hash: row.before_hash,
            last_id: unsigned("number", row.last_id)?,
            last_hash: row.last_hash,
        })
    })
    .transpose()
}

/// Appends entries in their order, each with a time not before its predecessor's. Assigns their
/// numbers and hashes, and returns the entries with them.
pub async fn append(
    db: &mut Connection,
    entries: &[AuditEntry],
) -> Result<Vec<AuditEntry>, EngineError> {
    let newest = sqlx::query!("SELECT id, at_us, hash FROM audit ORDER BY id DESC LIMIT 1")
        .fetch_optional(&mut *db)
        .await?;
    let mut newest_us = newest.as_ref().map_or(i64::MIN, |newest| newest.at_us);
    // A chain whose anchor was removed restarts after the present entries, which verification
    // detects.
    let head = chain(&mut *db).await?;
    let (mut last_id, mut last_hash) = match head {
        Some(head) => (head.last_id, head.last_hash),
        None => (0, FIRST_PREVIOUS_HASH.to_owned()),
    };
    if let Some(newest) = newest {
        // Numbers are not reused, whatever the anchor contains.
        last_id = last_id.max(unsigned("number", newest.id)?);
    }
    let mut written = Vec::with_capacity(entries.len());
    for entry in entries {
        newest_us = newest_us.max(to_us(entry.at));
        last_id = last_id.saturating_add(1);
        let mut entry = AuditEntry {
            id: last_id,
            at: from_us(newest_us)?,
            since: entry.since.map(|since| from_us(to_us(since))).transpose()?,
            ..entry.clone()
        };
        let hash = hash_after(&last_hash, &entry);
        entry.previous_hash = Some(std::mem::replace(&mut last_hash, hash.clone()));
        entry.hash = Some(hash);
        insert(&mut *db, &entry).await?;
        written.push(entry);
    }
    let last_id = i64::try_from(last_id).map_err(|_range| EngineError::DoesNotFit("number"))?;
    sqlx::query!(
        "INSERT INTO audit_chain (id, before_id, before_hash, last_id, last_hash)
         VALUES (1, 0, $1, $2, $3)
         ON CONFLICT (id) DO UPDATE SET last_id = $2, last_hash = $3",
        FIRST_PREVIOUS_HASH,
        last_id,
        last_hash,
    )
    .execute(db)
    .await?;
    Ok(written)
}

async fn insert(db: &mut Connection, entry: &AuditEntry) -> Result<(), EngineError> {
    let does_not_fit = |what| move |_range| EngineError::DoesNotFit(what);
    let id = i64::try_from(entry.id).map_err(does_not_fit("number"))?;
    let count = i64::try_from(entry.count).map_err(does_not_fit("count"))?;
    let (at_us, since_us) = (to_us(entry.at), entry.since.map(to_us));
    let status = i64::from(entry.status);
    let token = entry.token.map(|id: TokenId| id.to_string());
    let role = entry.role.map(Role::as_str);
    let person = entry.person.as_ref();
    let person = person.map(|person| to_json("person", person)).transpose()?;
    let what = entry.what.as_ref().map(|what| to_json("body", what));
    let what = what.transpose()?;
    sqlx::query!(
        "INSERT INTO audit (id, at_us, since_us, count, who, token_id, person, role, address, method,
             route, path, status, request_id, what, previous_hash, hash)
         VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, $16, $17)",
        id,
        at_us,
        since_us,
        count,
        entry.who,
        token,
        person,
        role,
        entry.address,
        entry.method,
        entry.route,
        entry.path,
        status,
        entry.request_id,
        what,
        entry.previous_hash,
        entry.hash,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Deletes at most `limit` of the oldest entries, of those that are not `kept`. Keeps number and hash of
/// the last one deleted, so that the rest can be verified.
pub async fn prune(
    db: &mut Connection,
    kept: AuditRetention,
    limit: u32,
) -> Result<(), EngineError> {
    let since_us = to_us(kept.since);
    let gone = sqlx::query!(
        "SELECT id, hash FROM audit
         WHERE id <= (SELECT MAX(id) FROM audit) - $1 OR at_us < $2
         ORDER BY id LIMIT $3",
        i64::from(kept.newest_max),
        since_us,
        i64::from(limit),
    )
    .fetch_all(&mut *db)
    .await?;
    let Some(last) = gone.into_iter().next_back() else {
        return Ok(());
    };
    sqlx::query!("DELETE FROM audit WHERE id <= $1", last.id)
        .execute(&mut *db)
        .await?;
    // An entry without a hash is from before the chain was introduced.
    if let Some(hash) = last.hash {
        sqlx::query!(
            "UPDATE audit_chain SET before_id = $1, before_hash = $2 WHERE id = 1 AND before_id < $1",
            last.id,
            hash,
        )
        .execute(db)
        .await?;
    }
    Ok(())
}
