//! Answers that were given under an idempotency key of a token or person.

use jiff::Timestamp;
pub use tread_store::idempotency::{OwnKey, StoredAnswer};
use uuid::Uuid;

use super::{DbError, Tx, forward};

forward! {
    idempotency;
    fn find(key: OwnKey<'_>, request_hash: Uuid) -> Option<StoredAnswer>;
    fn insert(key: OwnKey<'_>, stored: &StoredAnswer, at: Timestamp) -> ();
    fn delete_before(before: Timestamp, limit: u32) -> ();
}
