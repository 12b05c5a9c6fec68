//! What the server stores, apart from the engine that stores it: the types of rows, the errors, and
//! the rules that every engine follows. Contains no SQL.
//!
//! [`friction`] holds the sums of the map, which an engine adds up as the server does in memory.

pub mod alerts;
pub mod attendance;
pub mod audit;
pub mod deferred_segments;
pub mod enrolments;
pub mod error;
pub mod failure;
pub mod friction;
pub mod idempotency;
pub mod inspection;
mod issued;
mod limited;
mod location;
pub mod metrics;
pub mod missions;
mod outcome;
mod record_key;
pub mod restorations;
pub mod robots;
pub mod secrets;
pub mod segments;
pub mod sessions;
pub mod sites;
pub mod stops;
mod subject;
pub mod sums;
pub mod timeouts;
pub mod transfer;
pub mod watermarks;
pub mod webhooks;
pub mod withdrawals;

pub use self::error::DbError;
pub use self::issued::Issued;
pub use self::limited::limited;
pub use self::location::Location;
pub use self::outcome::{Disk, Outcome};
pub use self::record_key::RecordKey;
pub use self::secrets::Fingerprint;
pub use self::subject::SubjectId;
