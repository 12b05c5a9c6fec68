//! Tokens of people and programs. What is kept of a secret is its hash.

use jiff::Timestamp;
use sqlx::SqliteConnection;
use tread_api::identity::{Role, Token};
use tread_api::ids::TokenId;

use super::{DbError, corrupt, from_us, parse, to_us};
use crate::identity::secret::Fingerprint;

struct Raw {
    id: String,
    name: String,
    role: String,
    created_at_us: i64,
    created_by: String,
    expires_at_us: i64,
    revoked_at_us: Option<i64>,
    last_used_at_us: Option<i64>,
}

pub(super) fn role(name: &str) -> Result<Role, DbError> {
    Role::from_name(name).ok_or_else(|| corrupt("role", name))
}

impl TryFrom<Raw> for Token {
    type Error = DbError;

    fn try_from(raw: Raw) -> Result<Self, DbError> {
        Ok(Self {
            id: parse("token", &raw.id)?,
            name: raw.name,
            role: role(&raw.role)?,
            created_at: from_us(raw.created_at_us)?,
            created_by: raw.created_by,
            expires_at: from_us(raw.expires_at_us)?,
            revoked_at: raw.revoked_at_us.map(from_us).transpose()?,
            last_used_at: raw.last_used_at_us.map(from_us).transpose()?,
        })
    }
}

macro_rules! tokens {
    ($condition:tt $(, $argument:expr)* $(,)?) => {
        sqlx::query_as!(
            Raw,
            r#"SELECT id, name, role, created_at_us, created_by, expires_at_us, revoked_at_us,
                   last_used_at_us
               FROM tokens "# + $condition
            $(, $argument)*
        )
    };
}

/// Tokens older than one, newest first; dead ones too.
pub async fn list(
    db: &mut SqliteConnection,
    before: Option<TokenId>,
    limit: u32,
) -> Result<Vec<Token>, DbError> {
    let before = before.map(|id| id.to_string());
    let raw = tokens!(
        "WHERE (?1 IS NULL OR id < ?1) ORDER BY id DESC LIMIT ?2",
        before,
        limit
    )
    .fetch_all(db)
    .await?;
    raw.into_iter().map(Token::try_from).collect()
}

/// The token of that identifier.
pub async fn find(db: &mut SqliteConnection, id: TokenId) -> Result<Option<Token>, DbError> {
    let id = id.to_string();
    let raw = tokens!("WHERE id = ?", id).fetch_optional(db).await?;
    raw.map(Token::try_from).transpose()
}

/// The token that is valid at a time under a name.
pub async fn valid_by_name(
    db: &mut SqliteConnection,
    name: &str,
    at: Timestamp,
) -> Result<Option<Token>, DbError> {
    let at_us = to_us(at);
    let raw = tokens!(
        "WHERE name = ? AND revoked_at_us IS NULL AND expires_at_us > ? LIMIT 1",
        name,
        at_us
    )
    .fetch_optional(db)
    .await?;
    raw.map(Token::try_from).transpose()
}

/// How many tokens are valid at a time, of all roles and of admins.
pub async fn valid_counts(db: &mut SqliteConnection, at: Timestamp) -> Result<(i64, i64), DbError> {
    let at_us = to_us(at);
    let row = sqlx::query!(
        r#"SELECT COUNT(*) AS "all_count!: i64",
               COUNT(CASE WHEN role = 'admin' THEN 1 END) AS "admin_count!: i64"
           FROM tokens WHERE revoked_at_us IS NULL AND expires_at_us > ?"#,
        at_us
    )
    .fetch_one(db)
    .await?;
    Ok((row.all_count, row.admin_count))
}

/// Keeps a new token.
pub async fn insert(
    db: &mut SqliteConnection,
    token: &Token,
    fingerprint: &Fingerprint,
) -> Result<(), DbError> {
    let (id, role) = (token.id.to_string(), token.role.as_str());
    let (lookup, hash) = (fingerprint.lookup(), fingerprint.as_bytes());
    let (created_at_us, expires_at_us) = (to_us(token.created_at), to_us(token.expires_at));
    sqlx::query!(
        "INSERT INTO tokens (id, name, role, lookup, hash, created_at_us, created_by,
             expires_at_us)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
        id,
        token.name,
        role,
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

/// Revokes a token and ends its sessions; a first time counts.
pub async fn revoke(db: &mut SqliteConnection, id: TokenId, at: Timestamp) -> Result<(), DbError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE tokens SET revoked_at_us = COALESCE(revoked_at_us,
             MAX(?, created_at_us, COALESCE(last_used_at_us, created_at_us)))
         WHERE id = ?",
        at_us,
        id
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!("DELETE FROM sessions WHERE token_id = ?", id)
        .execute(db)
        .await?;
    Ok(())
}

/// Notes when a token was used last.
pub async fn touch(db: &mut SqliteConnection, id: TokenId, at: Timestamp) -> Result<(), DbError> {
    let (id, at_us) = (id.to_string(), to_us(at));
    sqlx::query!(
        "UPDATE tokens SET last_used_at_us =
             MAX(?, created_at_us, COALESCE(last_used_at_us, created_at_us))
         WHERE id = ?",
        at_us,
        id
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Forgets tokens that have been dead since before a time, and their sessions, at most `limit`.
pub async fn forget_dead(
    db: &mut SqliteConnection,
    before: Timestamp,
    limit: u32,
) -> Result<(), DbError> {
    let before_us = to_us(before);
    sqlx::query!(
        "DELETE FROM sessions WHERE token_id IN (
             SELECT id FROM tokens
             WHERE MIN(expires_at_us, COALESCE(revoked_at_us, expires_at_us)) < ?
             ORDER BY id LIMIT ?)",
        before_us,
        limit
    )
    .execute(&mut *db)
    .await?;
    sqlx::query!(
        "DELETE FROM tokens WHERE id IN (
             SELECT id FROM tokens
             WHERE MIN(expires_at_us, COALESCE(revoked_at_us, expires_at_us)) < ?
             ORDER BY id LIMIT ?)",
        before_us,
        limit
    )
    .execute(db)
    .await?;
    Ok(())
}

/// What is kept of a secret, with what it opens.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Kept {
    /// The hash of the secret.
    pub hash: Vec<u8>,
    /// The token.
    pub token: Token,
}

/// The token whose hash begins like this one.
pub async fn by_lookup(
    db: &mut SqliteConnection,
    fingerprint: &Fingerprint,
) -> Result<Option<Kept>, DbError> {
    let lookup = fingerprint.lookup();
    let row = sqlx::query!("SELECT id, hash FROM tokens WHERE lookup = ?", lookup)
        .fetch_optional(&mut *db)
        .await?;
    let Some(row) = row else {
        return Ok(None);
    };
    let token = find(db, parse("token", &row.id)?).await?;
    Ok(token.map(|token| Kept {
        hash: row.hash,
        token,
    }))
}
