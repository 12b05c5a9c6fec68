//! Consistent copies of a database, made beside whoever writes it, and what a copy contains.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions as _, Connection as _, SqliteConnection};

use super::{BUSY_TIMEOUT, EngineError, corrupt, unsigned};

/// Tables and views whose rows are counted in a copy.
const COUNTED: [&str; 8] = [
    "audit",
    "cell_sums",
    "enrolments",
    "missions",
    "robots",
    "segments",
    "stops",
    "tokens",
];

/// Interval at which a copy is synced while SQLite writes it. Otherwise the kernel writes everything at
/// the end at once, which delays the commits of the server.
const SYNC_EVERY: Duration = Duration::from_millis(50);

/// What a copy contains.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CopyContents {
    /// Its newest migration.
    pub schema: i64,
    /// Rows of the main tables.
    pub rows: BTreeMap<String, u64>,
}

/// Paths of a copy.
#[derive(Debug, Clone, Copy)]
pub struct CopyPaths<'path> {
    /// The database.
    pub database: &'path Path,
    /// The new file.
    pub target: &'path Path,
}

/// Maximum size of a copy: that of the database with its log.
///
/// # Errors
/// The database cannot be read.
pub async fn size_bytes(database: &Path) -> Result<u64, EngineError> {
    let mut connection = connect(database, false).await?;
    let size: Result<(i64,), _> = sqlx::query_as(
        "SELECT page_count * page_size FROM pragma_page_count(), pragma_page_size()",
    )
    .fetch_one(&mut connection)
    .await;
    connection.close().await?;
    unsigned("size", size?.0)
}

/// Copies the database as of one moment into a new file, readable by its owner alone.
///
/// Writers go on. Until it is done the log of the database cannot be shortened, because the moment
/// of the copy is kept in it.
///
/// # Errors
/// The database cannot be read, or the file not be written; then the file is removed.
pub async fn copy_into(CopyPaths { database, target }: CopyPaths<'_>) -> Result<(), EngineError> {
    let Some(name) = target.to_str() else {
        return Err(corrupt("file name", target.display()));
    };
    // SQLite writes into an empty file that exists, and would give others access to a new one.
    let created = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(target);
    let file = created.map_err(sqlx::Error::Io)?;
    let copying = async {
        let mut connection = connect(database, false).await?;
        let copied = sqlx::query("VACUUM INTO ?").bind(name);
        let copied = copied.execute(&mut connection).await;
        connection.close().await?;
        copied.map(|_done| ())
    };
    let copied = tokio::select! {
        copied = copying => copied,
        never = sync_periodically(file) => match never {},
    };
    if copied.is_err() {
        remove(target).map_err(sqlx::Error::Io)?;
    }
    // A full disk at the target is no failure of the server's own storage, so it is not noted.
    copied.map_err(EngineError::Sqlite)
}

/// Syncs a file periodically. It ignores failures, because SQLite syncs the copy itself at the end.
async fn sync_periodically(file: File) -> Infallible {
    let file = Arc::new(file);
    loop {
        tokio::time::sleep(SYNC_EVERY).await;
        let file = Arc::clone(&file);
        let _ = tokio::task::spawn_blocking(move || file.sync_data()).await;
    }
}

/// Removes a file if it is there.
fn remove(file: &Path) -> io::Result<()> {
    match fs::remove_file(file) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        Ok(()) | Err(_) => Ok(()),
    }
}

/// Reads a whole copy, checks its structure, and counts what it contains.
///
/// # Errors
/// It cannot be read, or SQLite finds damage.
pub async fn examine(copy: &Path) -> Result<CopyContents, EngineError> {
    let mut connection = connect(copy, true).await?;
    let found = examine_with(&mut connection).await;
    connection.close().await.map_err(EngineError::Sqlite)?;
    found
}

async fn examine_with(connection: &mut SqliteConnection) -> Result<CopyContents, EngineError> {
    let failed = EngineError::Sqlite;
    let (finding,): (String,) = sqlx::query_as("PRAGMA quick_check(1)")
        .fetch_one(&mut *connection)
        .await
        .map_err(failed)?;
    if finding != "ok" {
        return Err(corrupt("page", finding));
    }
    let schema = schema_with(&mut *connection).await?;
    let schema = schema.ok_or_else(|| corrupt("schema", "no migration"))?;
    let mut rows = BTreeMap::new();
    for table in COUNTED {
        let is_there: Option<(i64,)> = sqlx::query_as(
            "SELECT 1 FROM sqlite_schema WHERE type IN ('table', 'view') AND name = ?",
        )
        .bind(table)
        .fetch_optional(&mut *connection)
        .await
        .map_err(failed)?;
        if is_there.is_none() {
            continue;
        }
        let count = AssertSqlSafe(format!("SELECT COUNT(*) FROM {table}"));
        let (count,): (i64,) = sqlx::query_as(count)
            .fetch_one(&mut *connection)
            .await
            .map_err(failed)?;
        rows.insert(table.to_owned(), unsigned("count", count)?);
    }
    Ok(CopyContents { schema, rows })
}

/// Returns the newest migration of a connected database; `None` if it is empty.
pub(super) async fn schema_with(
    connection: &mut SqliteConnection,
) -> Result<Option<i64>, EngineError> {
    let is_there: Option<(i64,)> =
        sqlx::query_as("SELECT 1 FROM sqlite_schema WHERE name = '_sqlx_migrations'")
            .fetch_optional(&mut *connection)
            .await
            .map_err(EngineError::Sqlite)?;
    if is_there.is_none() {
        return Ok(None);
    }
    let (schema,): (Option<i64>,) =
        sqlx::query_as("SELECT MAX(version) FROM _sqlx_migrations WHERE success")
            .fetch_one(connection)
            .await
            .map_err(EngineError::Sqlite)?;
    Ok(schema)
}

/// Moves the log of a database into its file, so that one file contains the complete database.
///
/// # Errors
/// The database cannot be read or written; it keeps its log.
pub async fn settle_log(database: &Path) -> Result<(), EngineError> {
    let mut connection = connect(database, false).await?;
    sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)")
        .execute(&mut connection)
        .await?;
    Ok(connection.close().await?)
}

/// Opens a file that must exist. A copy that nobody writes is opened without locks.
///
/// # Errors
/// It is missing, or cannot be opened.
pub(super) async fn connect(file: &Path, is_copy: bool) -> Result<SqliteConnection, sqlx::Error> {
    let options = SqliteConnectOptions::new()
        .filename(file)
        .create_if_missing(false)
        .busy_timeout(BUSY_TIMEOUT);
    let options = if is_copy {
        options.read_only(true).immutable(true)
    } else {
        options
    };
    options.connect().await
}
