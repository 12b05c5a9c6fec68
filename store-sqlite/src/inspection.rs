//! Looks at a database without changing it, beside a running server or without one.

use std::fs;
use std::path::Path;

use jiff::Timestamp;
use sqlx::migrate::Migrator;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions as _, Connection as _, SqliteConnection};

use tread_store::failure::StorageFailure;
pub use tread_store::inspection::{InspectOptions, Inspection, Schema};

use super::failure;
use super::{BUSY_TIMEOUT, EngineError, archive_mark, times};

/// Migrations of this version.
static MIGRATIONS: Migrator = sqlx::migrate!();

/// Reason why a database cannot be inspected.
#[derive(Debug, thiserror::Error)]
pub enum InspectError {
    /// The operating system does not show the file.
    #[error("cannot look at the file")]
    File(#[source] std::io::Error),
    /// SQLite failed.
    #[error("SQLite cannot read it")]
    Sqlite(#[source] sqlx::Error),
    /// A stored value cannot be parsed.
    #[error("a value in it does not read")]
    Value(#[source] EngineError),
}

impl InspectError {
    /// Returns the storage failure; `None` for an error of another kind.
    pub fn failure(&self) -> Option<StorageFailure> {
        match self {
            Self::File(_) => Some(StorageFailure::Io),
            Self::Sqlite(error) => failure::of(error),
            Self::Value(error) => error.failure(),
        }
    }
}

/// Inspects a database; `None` if the file does not exist.
///
/// # Errors
/// [`InspectError`]: the file cannot be opened or read.
pub async fn inspect(
    path: &Path,
    InspectOptions { is_in_use, is_deep }: InspectOptions,
) -> Result<Option<Inspection>, InspectError> {
    match fs::metadata(path) {
        Ok(_) => {}
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(InspectError::File(error)),
    }
    let mut log = path.as_os_str().to_owned();
    log.push("-wal");
    let has_log = fs::metadata(Path::new(&log)).is_ok_and(|log| log.len() > 0);
    let options = SqliteConnectOptions::new()
        .filename(path)
        .read_only(true)
        .busy_timeout(BUSY_TIMEOUT)
        // Without a log there is nothing but the file, and no other file is made beside it.
        .immutable(!is_in_use && !has_log);
    let mut connection = options.connect().await.map_err(InspectError::Sqlite)?;
    let inspected = inspect_open(&mut connection, is_deep).await;
    // It was opened for reading, so an error of closing it loses nothing.
    let _ = connection.close().await;
    inspected.map(Some)
}

async fn inspect_open(
    connection: &mut SqliteConnection,
    is_deep: bool,
) -> Result<Inspection, InspectError> {
    let schema = schema(connection).await.map_err(InspectError::Sqlite)?;
    let damage = damage(connection, is_deep).await?;
    let read = match (schema, &damage) {
        (Schema::Current(_), None) => read_values(connection).await,
        (_, _) => Ok((None, None)),
    };
    let (newest, archived) = read.map_err(|error| match error {
        EngineError::Sqlite(error) => InspectError::Sqlite(error),
        EngineError::Corrupt { .. } | EngineError::DoesNotFit(_) => InspectError::Value(error),
    })?;
    Ok(Inspection {
        schema,
        newest,
        archived,
        damage,
    })
}

/// Returns the newest time, and which measurements were archived.
async fn read_values(
    connection: &mut SqliteConnection,
) -> Result<(Option<Timestamp>, Option<(i64, i64)>), EngineError> {
    let newest = times::newest(&mut *connection).await?;
    Ok((newest, archive_mark::get(connection).await?))
}

async fn schema(connection: &mut SqliteConnection) -> Result<Schema, sqlx::Error> {
    let known: Option<(String,)> =
        sqlx::query_as("SELECT name FROM sqlite_schema WHERE name = '_sqlx_migrations'")
            .fetch_optional(&mut *connection)
            .await?;
    if known.is_none() {
        return Ok(Schema::Empty);
    }
    let applied: Vec<(i64, Vec<u8>)> =
        sqlx::query_as("SELECT version, checksum FROM _sqlx_migrations ORDER BY version")
            .fetch_all(connection)
            .await?;
    let mut newest = 0;
    for (version, checksum) in &applied {
        let of_ours = MIGRATIONS.iter().find(|ours| ours.version == *version);
        match of_ours {
            None => return Ok(Schema::Newer(*version)),
            Some(ours) if *ours.checksum != **checksum => return Ok(Schema::Differs(*version)),
            Some(_) => newest = *version,
        }
    }
    match MIGRATIONS.iter().count().saturating_sub(applied.len()) {
        0 => Ok(Schema::Current(newest)),
        pending => Ok(Schema::Older { pending }),
    }
}

/// Returns SQLite's finding about the tables, or about the whole file.
async fn damage(
    connection: &mut SqliteConnection,
    is_deep: bool,
) -> Result<Option<String>, InspectError> {
    let checked = if is_deep {
        let finding: Result<(String,), sqlx::Error> = sqlx::query_as("PRAGMA quick_check(1)")
            .fetch_one(connection)
            .await;
        finding.map(|(finding,)| (finding != "ok").then_some(finding))
    } else {
        read_tables(connection).await.map(|()| None)
    };
    match checked {
        Ok(finding) => Ok(finding),
        Err(error) if failure::of(&error) == Some(StorageFailure::Damaged) => {
            Ok(Some(error.to_string()))
        }
        Err(error) => Err(InspectError::Sqlite(error)),
    }
}

async fn read_tables(connection: &mut SqliteConnection) -> Result<(), sqlx::Error> {
    let tables: Vec<(String,)> =
        sqlx::query_as("SELECT name FROM sqlite_schema WHERE type = 'table'")
            .fetch_all(&mut *connection)
            .await?;
    for (table,) in tables {
        let look = AssertSqlSafe(format!("SELECT 1 FROM \"{table}\" LIMIT 1"));
        sqlx::query(look).fetch_optional(&mut *connection).await?;
    }
    Ok(())
}
