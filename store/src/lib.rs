//! What the server stores, apart from the engine that stores it: the types of rows, the errors, and
//! the rules that every engine follows. Contains no SQL.
//!
//! [`friction`] holds the sums of the map, which an engine adds up as the server does in memory.

pub mod error;
pub mod failure;
mod fingerprint;
pub mod friction;
mod issued;
mod limited;
pub mod metrics;
mod outcome;
mod subject;

pub use self::error::DbError;
pub use self::fingerprint::Fingerprint;
pub use self::issued::Issued;
pub use self::limited::limited;
pub use self::outcome::{Disk, Outcome};
pub use self::subject::SubjectId;
