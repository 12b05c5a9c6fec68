//! The schema of the database: what this program knows, what a file has, and which versions of the
//! server have opened it.

use std::path::Path;

use jiff::Timestamp;
use sqlx::migrate::Migrator;
use sqlx::{Connection as _, SqliteConnection};

pub use tread_store::inspection::FoundSchema;

use super::copy::{connect, schema_with};
use super::{EngineError, to_us};

/// All migrations.
static MIGRATOR: Migrator = sqlx::migrate!();

/// Returns the migrations of this program.
pub(super) fn migrator() -> &'static Migrator {
    &MIGRATOR
}

/// Returns the schema of this program: its newest migration.
pub fn known() -> i64 {
    MIGRATOR.iter().map(|one| one.version).max().unwrap_or(0)
}

/// Reads the schema of a file, which must exist, and changes nothing.
///
/// # Errors
/// The file cannot be read.
pub async fn of_file(file: &Path) -> Result<FoundSchema, EngineError> {
    let mut connection = connect(file, false).await?;
    let found = of_connection(&mut connection).await;
    connection.close().await.map_err(EngineError::Sqlite)?;
    found
}

pub(super) async fn of_connection(
    connection: &mut SqliteConnection,
) -> Result<FoundSchema, EngineError> {
    let schema = schema_with(&mut *connection).await?;
    // A database of before this table has none; whatever a later version made of it is no failure.
    let newest: Result<Option<(String,)>, _> =
        sqlx::query_as("SELECT version FROM server_versions ORDER BY pk DESC LIMIT 1")
            .fetch_optional(connection)
            .await;
    Ok(FoundSchema {
        schema,
        version: newest.ok().flatten().map(|(version,)| version),
    })
}

/// Returns the versions of the migrations that a file with this schema lacks, oldest first.
pub fn missing_after(schema: Option<i64>) -> Vec<(i64, &'static str)> {
    let is_missing = |version: i64| schema.is_none_or(|schema| version > schema);
    let all = MIGRATOR.iter();
    let missing = all.filter(|one| is_missing(one.version));
    missing
        .map(|one| (one.version, &*one.description))
        .collect()
}

/// Stores the version of the server that opens the database, unless it was the last one too.
pub async fn record_version(
    db: &mut SqliteConnection,
    version: &str,
    at: Timestamp,
) -> Result<(), EngineError> {
    let at_us = to_us(at);
    sqlx::query!(
        "INSERT INTO server_versions (version, opened_at_us)
         SELECT ?1, ?2 WHERE ?1 IS NOT
             (SELECT version FROM server_versions ORDER BY pk DESC LIMIT 1)",
        version,
        at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}

/// Creates a database of an earlier schema: the last one before a migration.
#[cfg(test)]
pub(super) async fn open_before(path: &Path, version: i64) -> SqliteConnection {
    use sqlx::ConnectOptions as _;
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(path);
    let mut old = options.create_if_missing(true).connect().await.unwrap();
    let before = MIGRATOR.iter().filter(|step| step.version < version);
    let before = Migrator {
        migrations: before.cloned().collect::<Vec<_>>().into(),
        ..Migrator::DEFAULT
    };
    before.run(&mut old).await.unwrap();
    old
}
