//! Answers that were given under an idempotency key of a token or person.

use jiff::Timestamp;
pub use tread_store::idempotency::{OwnKey, StoredAnswer};
use uuid::Uuid;

use super::{Connection, EngineError, parse, to_us};

/// Returns the answer given to this sender under a key, or to the same request before keys had
/// owners.
pub async fn find(
    db: &mut Connection,
    (owner, key): OwnKey<'_>,
    request_hash: Uuid,
) -> Result<Option<StoredAnswer>, EngineError> {
    let (owner, request_hash) = (owner.to_string(), request_hash.to_string());
    let row = sqlx::query!(
        "SELECT request_hash, answer FROM idempotency_keys
         WHERE key = $1 AND (owner = $2 OR (owner = '' AND request_hash = $3))
         ORDER BY owner DESC LIMIT 1",
        key,
        owner,
        request_hash
    )
    .fetch_optional(db)
    .await?;
    row.map(|row| {
        Ok(StoredAnswer {
            request_hash: parse("request hash", &row.request_hash)?,
            answer: row.answer,
        })
    })
    .transpose()
}

/// Stores an answer under its key.
pub async fn insert(
    db: &mut Connection,
    (owner, key): OwnKey<'_>,
    stored: &StoredAnswer,
    at: Timestamp,
) -> Result<(), EngineError> {
    let (request_hash, at_us) = (stored.request_hash.to_string(), to_us(at));
    let owner = owner.to_string();
    sqlx::query!(
        "INSERT INTO idempotency_keys (owner, key, request_hash, answer, created_at_us)
         VALUES ($1, $2, $3, $4, $5)",
        owner,
        key,
        request_hash,
        stored.answer,
        at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Deletes at most `limit` keys that are older than a time.
pub async fn delete_before(
    db: &mut Connection,
    before: Timestamp,
    limit: u32,
) -> Result<(), EngineError> {
    let before_us = to_us(before);
    sqlx::query!(
        "DELETE FROM idempotency_keys WHERE (owner, key) IN (
             SELECT owner, key FROM idempotency_keys WHERE created_at_us < $1 LIMIT $2)",
        before_us,
        i64::from(limit),
    )
    .execute(db)
    .await?;
    Ok(())
}
