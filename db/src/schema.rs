//! The schema of the database: what this program knows, what a file has, and which versions of the
//! server have opened it.

use jiff::Timestamp;

pub use tread_store::inspection::FoundSchema;

use super::inspection::InspectError;
use super::{DbError, Location, OpenError, Tx, forward};

forward! {
    schema;
    fn record_version(version: &str, at: Timestamp) -> ();
}

/// Returns the schema of this program for a database: its newest migration.
pub fn known(location: &Location) -> i64 {
    match location {
        Location::File(_) => tread_store_sqlite::schema::known(),
        Location::Postgres(_) => tread_store_postgres::schema::known(),
    }
}

/// Returns the versions of the migrations that a database with this schema lacks, oldest first.
pub fn missing_after(location: &Location, schema: Option<i64>) -> Vec<(i64, &'static str)> {
    match location {
        Location::File(_) => tread_store_sqlite::schema::missing_after(schema),
        Location::Postgres(_) => tread_store_postgres::schema::missing_after(schema),
    }
}

/// Reads the schema of a database, whose file must exist, and changes nothing.
///
/// # Errors
/// The database cannot be read.
pub async fn of(location: &Location) -> Result<FoundSchema, InspectError> {
    Ok(match location {
        Location::File(path) => {
            let found = tread_store_sqlite::schema::of_file(path).await;
            found.map_err(tread_store_sqlite::inspection::InspectError::Value)?
        }
        Location::Postgres(address) => {
            let found = tread_store_postgres::open::schema_of(address).await;
            found.map_err(tread_store_postgres::inspection::InspectError::Open)?
        }
    })
}

/// Refuses a database that a newer version has written.
///
/// # Errors
/// `Newer` of [`OpenError`].
pub fn refuse_newer(location: &Location, found: &FoundSchema) -> Result<(), OpenError> {
    match location {
        Location::File(path) => tread_store_sqlite::refuse_newer(path, found)?,
        Location::Postgres(_) => {
            tread_store_postgres::refuse_newer(&location.to_string(), found)?;
        }
    }
    Ok(())
}
