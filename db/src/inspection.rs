//! Looks at a database without changing it, beside a running server or without one.

use tread_store::failure::StorageFailure;
pub use tread_store::inspection::{InspectOptions, Inspection, Schema};

use super::Location;

/// Reason why a database cannot be inspected.
#[derive(Debug, thiserror::Error)]
pub enum InspectError {
    /// A file of SQLite cannot be inspected.
    #[error(transparent)]
    Sqlite(#[from] tread_store_sqlite::inspection::InspectError),
    /// A PostgreSQL database cannot be inspected.
    #[error(transparent)]
    Postgres(#[from] tread_store_postgres::inspection::InspectError),
}

impl InspectError {
    /// Returns the storage failure; `None` for an error of another kind.
    pub fn failure(&self) -> Option<StorageFailure> {
        match self {
            Self::Sqlite(error) => error.failure(),
            Self::Postgres(error) => error.failure(),
        }
    }
}

/// Inspects a database; `None` if there is no file.
///
/// # Errors
/// [`InspectError`]: the database cannot be opened or read.
pub async fn inspect(
    location: &Location,
    options: InspectOptions,
) -> Result<Option<Inspection>, InspectError> {
    Ok(match location {
        Location::File(path) => tread_store_sqlite::inspection::inspect(path, options).await?,
        Location::Postgres(address) => {
            Some(tread_store_postgres::inspection::inspect(address, options.is_deep).await?)
        }
    })
}
