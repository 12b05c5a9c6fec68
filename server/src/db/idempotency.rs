//! Answers that were given under an idempotency key.

use jiff::Timestamp;
use sqlx::SqliteConnection;
use uuid::Uuid;

use super::{DbError, parse, to_us};

/// An answer that was given under a key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Given {
    /// The hash of the request that it answered.
    pub request_hash: Uuid,
    /// The answer, JSON.
    pub answer: String,
}

/// What was answered under a key.
pub async fn find(db: &mut SqliteConnection, key: &str) -> Result<Option<Given>, DbError> {
    let row = sqlx::query!(
        "SELECT request_hash, answer FROM idempotency_keys WHERE key = ?",
        key
    )
    .fetch_optional(db)
    .await?;
    row.map(|row| {
        Ok(Given {
            request_hash: parse("request hash", &row.request_hash)?,
            answer: row.answer,
        })
    })
    .transpose()
}

/// Keeps an answer under its key.
pub async fn insert(
    db: &mut SqliteConnection,
    key: &str,
    given: &Given,
    at: Timestamp,
) -> Result<(), DbError> {
    let (request_hash, at_us) = (given.request_hash.to_string(), to_us(at));
    sqlx::query!(
        "INSERT INTO idempotency_keys (key, request_hash, answer, created_at_us)
         VALUES (?, ?, ?, ?)",
        key,
        request_hash,
        given.answer,
        at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Forgets keys that are older than a time, at most `limit`.
pub async fn forget_before(
    db: &mut SqliteConnection,
    before: Timestamp,
    limit: u32,
) -> Result<(), DbError> {
    let before_us = to_us(before);
    sqlx::query!(
        "DELETE FROM idempotency_keys WHERE key IN (
             SELECT key FROM idempotency_keys WHERE created_at_us < ? LIMIT ?)",
        before_us,
        limit,
    )
    .execute(db)
    .await?;
    Ok(())
}
