//! Errors of the store, whichever engine it has.

use std::error::Error;

use crate::failure::{self, StorageFailure};

/// Error of the database.
#[derive(Debug, thiserror::Error)]
pub enum DbError {
    /// The engine failed, or refused a statement.
    #[error("the database failed")]
    Engine {
        /// The storage failure; `None` for an error of the statement or its values.
        failure: Option<StorageFailure>,
        /// Whether a unique constraint refused the write.
        is_unique_violation: bool,
        /// The error of the engine's library.
        #[source]
        cause: Box<dyn Error + Send + Sync>,
    },
    /// A stored value cannot be parsed.
    #[error("the database holds a {what} that does not read back: `{value}`")]
    Corrupt {
        /// The expected kind of value.
        what: &'static str,
        /// The stored value.
        value: String,
    },
    /// A value is out of the range that the database can store.
    #[error("a {0} does not fit into the database")]
    DoesNotFit(&'static str),
    /// The outcome of a commit is unknown, and memory has not been read again since.
    #[error("what became of a commit is not known yet")]
    Unsettled,
    /// The database did not answer in time.
    #[error("the database did not answer in time")]
    Unanswered,
    /// The turn to use the database did not come in time.
    #[error("the turn to use the database did not come in time")]
    Busy,
}

impl DbError {
    /// Returns the error of work that the database did not complete in time, and records the failure:
    /// connections that are open now are replaced before they are used again.
    pub fn unanswered() -> Self {
        failure::record(StorageFailure::Connection);
        Self::Unanswered
    }

    /// Returns the error of a database that was busy for too long, and records the failure.
    pub fn busy() -> Self {
        failure::record(StorageFailure::Busy);
        Self::Busy
    }

    /// Returns the storage failure; `None` for an error of the statement or of the stored data.
    pub fn failure(&self) -> Option<StorageFailure> {
        match self {
            Self::Engine { failure, .. } => *failure,
            Self::Unsettled | Self::Unanswered => Some(StorageFailure::Connection),
            Self::Busy => Some(StorageFailure::Busy),
            Self::Corrupt { .. } | Self::DoesNotFit(_) => None,
        }
    }

    /// Returns whether a unique constraint refused the write.
    pub fn is_unique_violation(&self) -> bool {
        matches!(
            self,
            Self::Engine {
                is_unique_violation: true,
                ..
            }
        )
    }
}
