//! Looks at a database without changing it, beside a running server or without one.

use jiff::Timestamp;
use sqlx::{AssertSqlSafe, Connection as _};
use tread_store::failure::StorageFailure;
pub use tread_store::inspection::{Inspection, Schema};

use super::{
    Connection, EngineError, OpenError, archive_mark, connections, failure, open, schema, times,
};

/// Reason why a database cannot be inspected.
#[derive(Debug, thiserror::Error)]
pub enum InspectError {
    /// It cannot be opened.
    #[error(transparent)]
    Open(OpenError),
    /// PostgreSQL failed.
    #[error("PostgreSQL cannot read it")]
    Postgres(#[source] sqlx::Error),
    /// A stored value cannot be parsed.
    #[error("a value in it does not read")]
    Value(#[source] EngineError),
}

impl InspectError {
    /// Returns the storage failure; `None` for an error of another kind.
    pub fn failure(&self) -> Option<StorageFailure> {
        match self {
            Self::Open(_) => None,
            Self::Postgres(error) => failure::of(error),
            Self::Value(error) => error.failure(),
        }
    }
}

/// Inspects the database of an address. `is_deep` reads all rows.
///
/// # Errors
/// [`InspectError`]: the database cannot be opened or read.
pub async fn inspect(url: &str, is_deep: bool) -> Result<Inspection, InspectError> {
    let (options, address) = open::options_of(url).map_err(InspectError::Open)?;
    let connecting = connections::connect(&options).await;
    let connecting = connecting.map_err(|cause| open::refused(&address, cause));
    let mut connection = connecting.map_err(InspectError::Open)?;
    let inspected = inspect_open(&mut connection, is_deep).await;
    // It was opened for reading, so an error of closing it loses nothing.
    let _ = connection.close().await;
    inspected
}

async fn inspect_open(db: &mut Connection, is_deep: bool) -> Result<Inspection, InspectError> {
    let snapshot = sqlx::raw_sql("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY");
    let begun = snapshot.execute(&mut *db).await;
    begun.map_err(InspectError::Postgres)?;
    let schema = schema(db).await.map_err(InspectError::Postgres)?;
    let read = match schema {
        Schema::Current(_) => read_values(db).await,
        Schema::Empty | Schema::Older { .. } | Schema::Newer(_) | Schema::Differs(_) => {
            Ok((None, None))
        }
    };
    let damaged = |error: &sqlx::Error| failure::of(error) == Some(StorageFailure::Damaged);
    let ((newest, archived), mut damage) = match read {
        Ok(read) => (read, None),
        Err(EngineError::Postgres(error)) if damaged(&error) => {
            ((None, None), Some(error.to_string()))
        }
        Err(EngineError::Postgres(error)) => return Err(InspectError::Postgres(error)),
        Err(error) => return Err(InspectError::Value(error)),
    };
    if damage.is_none() {
        damage = match read_tables(db, is_deep).await {
            Ok(()) => None,
            Err(error) if damaged(&error) => Some(error.to_string()),
            Err(error) => return Err(InspectError::Postgres(error)),
        };
    }
    Ok(Inspection {
        schema,
        newest,
        archived,
        damage,
    })
}

/// Returns the newest time, and which measurements were archived.
async fn read_values(
    db: &mut Connection,
) -> Result<(Option<Timestamp>, Option<(i64, i64)>), EngineError> {
    let newest = times::newest(&mut *db).await?;
    Ok((newest, archive_mark::get(db).await?))
}

async fn schema(db: &mut Connection) -> Result<Schema, sqlx::Error> {
    let applied = schema::applied(db).await?;
    if applied.is_empty() {
        return Ok(Schema::Empty);
    }
    let mut newest = 0;
    for (version, checksum) in &applied {
        let of_ours = schema::migrator().iter();
        match of_ours.clone().find(|ours| ours.version == *version) {
            None => return Ok(Schema::Newer(*version)),
            Some(ours) if *ours.checksum != **checksum => return Ok(Schema::Differs(*version)),
            Some(_) => newest = *version,
        }
    }
    let known = schema::migrator().iter().count();
    match known.saturating_sub(applied.len()) {
        0 => Ok(Schema::Current(newest)),
        pending => Ok(Schema::Older { pending }),
    }
}

/// Reads one row of every table, or all rows.
async fn read_tables(db: &mut Connection, is_deep: bool) -> Result<(), sqlx::Error> {
    let tables: Vec<(String,)> = sqlx::query_as(
        "SELECT quote_ident(relname) FROM pg_class
         WHERE relnamespace = CAST(current_schema() AS regnamespace)
             AND relkind IN ('r', 'p') AND NOT relispartition",
    )
    .fetch_all(&mut *db)
    .await?;
    for (table,) in tables {
        let look = AssertSqlSafe(if is_deep {
            format!("SELECT COUNT(whole.*) FROM {table} AS whole")
        } else {
            format!("SELECT 1 FROM {table} LIMIT 1")
        });
        sqlx::query(look).fetch_optional(&mut *db).await?;
    }
    Ok(())
}
