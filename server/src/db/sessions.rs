//! Sessions of browsers, each of one token.

use jiff::Timestamp;
use sqlx::SqliteConnection;
use tread_api::ids::{SessionId, TokenId};

use super::{DbError, from_us, parse, to_us};
use crate::identity::secret::Fingerprint;

/// A session as it is kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Kept {
    /// The session.
    pub id: SessionId,
    /// The token it was opened with.
    pub token: TokenId,
    /// The hash of its secret.
    pub hash: Vec<u8>,
    /// From when on it is refused.
    pub expires_at: Timestamp,
}

/// A session about to be kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NewSession {
    /// The session.
    pub id: SessionId,
    /// The token it was opened with.
    pub token: TokenId,
    /// The hash of its secret.
    pub fingerprint: Fingerprint,
    /// When it was opened.
    pub created_at: Timestamp,
    /// From when on it is refused.
    pub expires_at: Timestamp,
}

/// Keeps a new session.
pub async fn insert(db: &mut SqliteConnection, session: &NewSession) -> Result<(), DbError> {
    let (id, token) = (session.id.to_string(), session.token.to_string());
    let (lookup, hash) = (session.fingerprint.lookup(), session.fingerprint.as_bytes());
    let (created_at_us, expires_at_us) = (to_us(session.created_at), to_us(session.expires_at));
    sqlx::query!(
        "INSERT INTO sessions (id, token_id, lookup, hash, created_at_us, expires_at_us)
         VALUES (?, ?, ?, ?, ?, ?)",
        id,
        token,
        lookup,
        hash,
        created_at_us,
        expires_at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// The session whose hash begins like this one.
pub async fn by_lookup(
    db: &mut SqliteConnection,
    fingerprint: &Fingerprint,
) -> Result<Option<Kept>, DbError> {
    let lookup = fingerprint.lookup();
    let row = sqlx::query!(
        "SELECT id, token_id, hash, expires_at_us FROM sessions WHERE lookup = ?",
        lookup
    )
    .fetch_optional(db)
    .await?;
    row.map(|row| {
        Ok(Kept {
            id: parse("session", &row.id)?,
            token: parse("token", &row.token_id)?,
            hash: row.hash,
            expires_at: from_us(row.expires_at_us)?,
        })
    })
    .transpose()
}

/// Every session that is valid at a time.
pub async fn all_valid(
    db: &mut SqliteConnection,
    at: Timestamp,
) -> Result<Vec<SessionId>, DbError> {
    let at_us = to_us(at);
    let ids = sqlx::query_scalar!("SELECT id FROM sessions WHERE expires_at_us > ?", at_us)
        .fetch_all(db)
        .await?;
    ids.iter().map(|id| parse("session", id)).collect()
}

/// Ends a session.
pub async fn delete(db: &mut SqliteConnection, id: SessionId) -> Result<(), DbError> {
    let id = id.to_string();
    sqlx::query!("DELETE FROM sessions WHERE id = ?", id)
        .execute(db)
        .await?;
    Ok(())
}

/// Forgets sessions that have ended.
pub async fn forget_expired(db: &mut SqliteConnection, at: Timestamp) -> Result<(), DbError> {
    let at_us = to_us(at);
    sqlx::query!("DELETE FROM sessions WHERE expires_at_us <= ?", at_us)
        .execute(db)
        .await?;
    Ok(())
}

/// The oldest sessions of a token beyond the newest `kept`.
pub async fn surplus(
    db: &mut SqliteConnection,
    token: TokenId,
    kept: u32,
) -> Result<Vec<SessionId>, DbError> {
    let token = token.to_string();
    let ids = sqlx::query_scalar!(
        "SELECT id FROM sessions WHERE token_id = ? ORDER BY id DESC LIMIT -1 OFFSET ?",
        token,
        kept
    )
    .fetch_all(db)
    .await?;
    ids.iter().map(|id| parse("session", id)).collect()
}
