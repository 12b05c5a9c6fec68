//! Answers that were given under idempotency keys.

use uuid::Uuid;

use crate::SubjectId;

/// An answer that was given under an idempotency key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredAnswer {
    /// Hash of the request that was answered.
    pub request_hash: Uuid,
    /// The answer, JSON.
    pub answer: String,
}

/// An idempotency key with its sender.
pub type OwnKey<'key> = (SubjectId, &'key str);
