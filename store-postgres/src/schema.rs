//! The schema of the database: what this program knows, what a database has, and which versions of
//! the server have opened it.

use jiff::Timestamp;
use sqlx::migrate::Migrator;

pub use tread_store::inspection::FoundSchema;

use super::{Connection, EngineError, to_us};

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

/// Reads the schema of a database, and changes nothing.
///
/// # Errors
/// The database cannot be read.
pub async fn of_connection(db: &mut Connection) -> Result<FoundSchema, EngineError> {
    let applied = applied(&mut *db).await.map_err(EngineError::Postgres)?;
    let is_known = is_table(&mut *db, "server_versions").await;
    let version = if is_known.map_err(EngineError::Postgres)? {
        let newest: Option<(String,)> =
            sqlx::query_as("SELECT version FROM server_versions ORDER BY pk DESC LIMIT 1")
                .fetch_optional(db)
                .await
                .map_err(EngineError::Postgres)?;
        newest.map(|(version,)| version)
    } else {
        None
    };
    Ok(FoundSchema {
        schema: applied.last().map(|(version, _checksum)| *version),
        version,
    })
}

/// Returns versions and checksums of the migrations that a database has, oldest first.
pub(super) async fn applied(db: &mut Connection) -> Result<Vec<(i64, Vec<u8>)>, sqlx::Error> {
    if !is_table(&mut *db, "_sqlx_migrations").await? {
        return Ok(Vec::new());
    }
    sqlx::query_as("SELECT version, checksum FROM _sqlx_migrations ORDER BY version")
        .fetch_all(db)
        .await
}

async fn is_table(db: &mut Connection, name: &str) -> Result<bool, sqlx::Error> {
    let found: (bool,) = sqlx::query_as("SELECT to_regclass($1) IS NOT NULL")
        .bind(name)
        .fetch_one(db)
        .await?;
    Ok(found.0)
}

/// Returns the versions of the migrations that a database with this schema lacks, oldest first.
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
    db: &mut Connection,
    version: &str,
    at: Timestamp,
) -> Result<(), EngineError> {
    let at_us = to_us(at);
    sqlx::query!(
        "INSERT INTO server_versions (version, opened_at_us)
         SELECT CAST($1 AS TEXT), CAST($2 AS BIGINT) WHERE CAST($1 AS TEXT) IS DISTINCT FROM
             (SELECT version FROM server_versions ORDER BY pk DESC LIMIT 1)",
        version,
        at_us,
    )
    .execute(db)
    .await?;
    Ok(())
}
