//! The audit log: who changed what, and who was refused.

use jiff::Timestamp;
use sqlx::SqliteConnection;
use tread_api::identity::{AuditEntry, Role};
use tread_api::ids::TokenId;

use super::tokens::role;
use super::{DbError, from_json, from_us, parse, to_json, to_us, unsigned};

struct Raw {
    id: i64,
    at_us: i64,
    who: Option<String>,
    token_id: Option<String>,
    role: Option<String>,
    address: String,
    method: String,
    route: String,
    path: String,
    status: i64,
    request_id: String,
    what: Option<String>,
}

impl TryFrom<Raw> for AuditEntry {
    type Error = DbError;

    fn try_from(raw: Raw) -> Result<Self, DbError> {
        let token = raw.token_id.as_deref();
        let what = raw.what.as_deref();
        Ok(Self {
            id: unsigned("number", raw.id)?,
            at: from_us(raw.at_us)?,
            who: raw.who,
            token: token.map(|id| parse("token", id)).transpose()?,
            role: raw.role.as_deref().map(role).transpose()?,
            address: raw.address,
            method: raw.method,
            route: raw.route,
            path: raw.path,
            status: unsigned("status", raw.status)?,
            request_id: raw.request_id,
            what: what.map(|what| from_json("body", what)).transpose()?,
        })
    }
}

/// Which entries to list.
#[derive(Debug, Clone, Default)]
pub struct AuditFilter {
    /// Only those of the token of this name.
    pub who: Option<String>,
    /// Only those that were refused.
    pub refused: bool,
    /// Only those before this one.
    pub before: Option<u64>,
}

/// Entries, newest first.
pub async fn list(
    db: &mut SqliteConnection,
    filter: &AuditFilter,
    limit: u32,
) -> Result<Vec<AuditEntry>, DbError> {
    let before = filter.before.map(i64::try_from).transpose();
    let before = before.map_err(|_range| DbError::DoesNotFit("number"))?;
    let raw = sqlx::query_as!(
        Raw,
        r#"SELECT id, at_us, who, token_id, role, address, method, route, path, status,
               request_id, what
           FROM audit
           WHERE (?1 IS NULL OR id < ?1) AND (?2 IS NULL OR who = ?2)
             AND (?3 = FALSE OR status >= 400)
           ORDER BY id DESC LIMIT ?4"#,
        before,
        filter.who,
        filter.refused,
        limit,
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(AuditEntry::try_from).collect()
}

/// Writes one entry, not before the one that precedes it; its number is made here.
pub async fn insert(db: &mut SqliteConnection, entry: &AuditEntry) -> Result<(), DbError> {
    let (at_us, status) = (to_us(entry.at), i64::from(entry.status));
    let token = entry.token.map(|id: TokenId| id.to_string());
    let role = entry.role.map(Role::as_str);
    let what = entry.what.as_ref().map(|what| to_json("body", what));
    let what = what.transpose()?;
    sqlx::query!(
        "INSERT INTO audit (at_us, who, token_id, role, address, method, route, path, status,
             request_id, what)
         VALUES (MAX(?1, COALESCE((SELECT at_us FROM audit ORDER BY id DESC LIMIT 1), ?1)),
             ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11)",
        at_us,
        entry.who,
        token,
        role,
        entry.address,
        entry.method,
        entry.route,
        entry.path,
        status,
        entry.request_id,
        what,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Forgets entries that are older than a time or beyond the newest `kept`, at most `limit`.
pub async fn forget(
    db: &mut SqliteConnection,
    before: Timestamp,
    kept: u32,
    limit: u32,
) -> Result<(), DbError> {
    let before_us = to_us(before);
    sqlx::query!(
        "DELETE FROM audit WHERE id IN (
             SELECT id FROM audit
             WHERE id <= (SELECT MAX(id) FROM audit) - ?1 OR at_us < ?2
             ORDER BY id LIMIT ?3)",
        kept,
        before_us,
        limit,
    )
    .execute(db)
    .await?;
    Ok(())
}
