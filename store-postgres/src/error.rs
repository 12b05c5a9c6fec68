//! Errors of this engine.

use sqlx::error::DatabaseError;
use tread_store::DbError;
use tread_store::failure::StorageFailure;

use super::failure;

/// Error of PostgreSQL, or of a value that it stores.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// PostgreSQL, the connection or the pool of connections failed.
    #[error("the database failed")]
    Postgres(#[source] sqlx::Error),
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
}

impl EngineError {
    /// Returns the storage failure; `None` for an error of the statement or of the stored data.
    pub fn failure(&self) -> Option<StorageFailure> {
        match self {
            Self::Postgres(error) => failure::of(error),
            Self::Corrupt { .. } | Self::DoesNotFit(_) => None,
        }
    }
}

impl From<sqlx::Error> for EngineError {
    fn from(error: sqlx::Error) -> Self {
        failure::record(&error);
        Self::Postgres(error)
    }
}

impl From<EngineError> for DbError {
    fn from(error: EngineError) -> Self {
        match error {
            EngineError::Postgres(cause) => Self::Engine {
                failure: failure::of(&cause),
                is_unique_violation: cause
                    .as_database_error()
                    .is_some_and(DatabaseError::is_unique_violation),
                cause: Box::new(cause),
            },
            EngineError::Corrupt { what, value } => Self::Corrupt { what, value },
            EngineError::DoesNotFit(what) => Self::DoesNotFit(what),
        }
    }
}
