//! The database of a fleet, whichever engine it has. Contains no SQL.
//!
//! [`Db`] and [`Tx`] are enums over the engines. Each aggregate is a module whose functions take a
//! transaction of either engine. What only a database in a file has is in [`mod@file`].

mod forward;
pub mod lock;

pub mod alerts;
pub mod archive_mark;
pub mod attendance;
pub mod audit;
pub mod deferred_segments;
pub mod enrolments;
pub mod file;
pub mod geofences;
pub mod history;
pub mod idempotency;
pub mod inspection;
pub mod join_tokens;
pub mod leader;
pub mod missions;
pub mod removed;
pub mod restorations;
pub mod robots;
pub mod schema;
pub mod segment_ranges;
pub mod segments;
pub mod sessions;
pub mod sites;
pub mod stops;
pub mod sums;
pub mod terrains;
pub mod times;
pub mod tokens;
pub mod transfer;
pub mod watermarks;
pub mod webhooks;
pub mod withdrawals;

use std::path::Path;
use std::time::Duration;

use tread_store::failure::StorageFailure;
use tread_store::metrics::DatabaseMetrics;
pub use tread_store::{DbError, Disk, Location, Outcome, RecordKey, failure, limited, secrets};

use self::forward::forward;

/// A transaction on the database, rolled back unless it is committed.
#[derive(Debug)]
pub enum Tx {
    /// On a file of SQLite.
    Sqlite(tread_store_sqlite::Tx),
    /// On a PostgreSQL database.
    Postgres(tread_store_postgres::Tx),
}

impl Tx {
    /// Commits the transaction.
    ///
    /// # Errors
    /// The engine failed; nothing is written, or the outcome is unknown.
    pub async fn commit(self) -> Result<(), DbError> {
        match self {
            Self::Sqlite(tx) => tx.commit().await,
            Self::Postgres(tx) => Box::pin(tx.commit()).await,
        }
    }

    /// Commits the transaction and then calls `then` with the outcome. Cancellation of the caller
    /// interrupts neither.
    ///
    /// # Errors
    /// As [`Tx::commit`].
    pub async fn commit_then(
        self,
        then: impl FnOnce(Outcome) + Send + 'static,
    ) -> Result<(), DbError> {
        match self {
            Self::Sqlite(tx) => tx.commit_then(then).await,
            Self::Postgres(tx) => Box::pin(tx.commit_then(then)).await,
        }
    }

    /// Returns the transaction of a file of SQLite; `None` for another engine.
    pub fn as_sqlite(&mut self) -> Option<&mut tread_store_sqlite::Tx> {
        match self {
            Self::Sqlite(tx) => Some(tx),
            Self::Postgres(_) => None,
        }
    }
}

/// Reason why the database cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// A file of SQLite cannot be opened.
    #[error(transparent)]
    Sqlite(#[from] tread_store_sqlite::OpenError),
    /// A PostgreSQL database cannot be opened.
    #[error(transparent)]
    Postgres(#[from] tread_store_postgres::OpenError),
}

/// The open database; clones share it.
#[derive(Debug, Clone)]
pub enum Db {
    /// A file of SQLite.
    Sqlite(tread_store_sqlite::Db),
    /// A PostgreSQL database.
    Postgres(tread_store_postgres::Db),
}

impl Db {
    /// Opens the database, creates a file that is missing, and applies migrations.
    ///
    /// # Errors
    /// [`OpenError`] names file or address, without a password.
    pub async fn open(location: impl Into<Location>) -> Result<Self, OpenError> {
        Ok(match location.into() {
            Location::File(path) => Self::Sqlite(tread_store_sqlite::Db::open(&path).await?),
            Location::Postgres(address) => {
                Self::Postgres(tread_store_postgres::Db::open(&address).await?)
            }
        })
    }

    /// As [`Db::open`], with a given maximum time for a commit.
    ///
    /// # Errors
    /// As [`Db::open`].
    pub async fn open_with(
        location: impl Into<Location>,
        commit_max: Duration,
    ) -> Result<Self, OpenError> {
        Ok(match location.into() {
            Location::File(path) => {
                Self::Sqlite(tread_store_sqlite::Db::open_with(&path, commit_max).await?)
            }
            Location::Postgres(address) => {
                Self::Postgres(tread_store_postgres::Db::open_with(&address, commit_max).await?)
            }
        })
    }

    /// Returns the generation: a counter of all commits but those of [`Db::write_uncounted`]. Data
    /// that those do not change are unchanged while it is the same.
    pub fn generation(&self) -> u64 {
        match self {
            Self::Sqlite(db) => db.generation(),
            Self::Postgres(db) => db.generation(),
        }
    }

    /// Returns the number of commits of unknown outcome.
    pub fn unknown_outcomes(&self) -> u64 {
        match self {
            Self::Sqlite(db) => db.unknown_outcomes(),
            Self::Postgres(db) => db.unknown_outcomes(),
        }
    }

    /// Waits for the next commit of unknown outcome.
    pub async fn outcome_unknown(&self) {
        match self {
            Self::Sqlite(db) => db.outcome_unknown().await,
            Self::Postgres(db) => db.outcome_unknown().await,
        }
    }

    /// Waits until every earlier commit has ended, in whatever way, and increments the generation:
    /// data read meanwhile may be from before.
    ///
    /// # Errors
    /// An earlier commit did not end in time.
    pub async fn await_commits(&self) -> Result<(), DbError> {
        match self {
            Self::Sqlite(db) => db.await_commits().await,
            Self::Postgres(db) => db.await_commits().await,
        }
    }

    /// Returns the path of the database file; `None` for an engine without one.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Sqlite(db) => Some(db.path()),
            Self::Postgres(_) => None,
        }
    }

    /// Returns the name by which people know the database, without credentials.
    pub fn name(&self) -> String {
        match self {
            Self::Sqlite(db) => db.path().display().to_string(),
            Self::Postgres(db) => db.address().to_owned(),
        }
    }

    /// Returns the engine and its version.
    pub fn engine(&self) -> (Engine, &str) {
        match self {
            Self::Sqlite(db) => (Engine::Sqlite, db.sqlite_version()),
            Self::Postgres(db) => (Engine::Postgres, db.server_version()),
        }
    }

    /// Returns the schema of this program for the engine: its newest migration, which an open database has.
    pub fn schema(&self) -> i64 {
        match self {
            Self::Sqlite(_) => tread_store_sqlite::schema::known(),
            Self::Postgres(_) => tread_store_postgres::schema::known(),
        }
    }

    /// Begins a write transaction; waits until no other one is open. Await nothing but the database
    /// before the commit. `kind` names the use case in the metrics.
    ///
    /// # Errors
    /// The turn did not come in time, or the engine failed.
    pub async fn write(&self, kind: &'static str) -> Result<Tx, DbError> {
        match self {
            Self::Sqlite(db) => Ok(Tx::Sqlite(db.write(kind).await?)),
            Self::Postgres(db) => Ok(Tx::Postgres(Box::pin(db.write(kind)).await?)),
        }
    }

    /// Begins a write transaction that [`Db::generation`] does not count, since it changes no site,
    /// terrain or robot: of uploads, missions, alerts, identities and the audit log.
    ///
    /// # Errors
    /// As [`Db::write`].
    pub async fn write_uncounted(&self, kind: &'static str) -> Result<Tx, DbError> {
        match self {
            Self::Sqlite(db) => Ok(Tx::Sqlite(db.write_uncounted(kind).await?)),
            Self::Postgres(db) => Ok(Tx::Postgres(Box::pin(db.write_uncounted(kind)).await?)),
        }
    }

    /// Begins to read one snapshot. `kind` names the use case in the metrics.
    ///
    /// # Errors
    /// No connection became free in time, or the engine failed.
    pub async fn read(&self, kind: &'static str) -> Result<Tx, DbError> {
        match self {
            Self::Sqlite(db) => Ok(Tx::Sqlite(db.read(kind).await?)),
            Self::Postgres(db) => Ok(Tx::Postgres(Box::pin(db.read(kind)).await?)),
        }
    }

    /// Makes this process the server of the database, which it has locked: what was so before cannot write
    /// to a PostgreSQL database any more. Standbys of such a database send to `advertise_url` what only this
    /// server can answer. Returns the epoch of a server of a PostgreSQL database.
    ///
    /// # Errors
    /// The database cannot be written.
    pub async fn claim(&self, advertise_url: Option<&str>) -> Result<Option<i64>, DbError> {
        match self {
            // The lock of a file lasts as long as the process.
            Self::Sqlite(_) => Ok(None),
            Self::Postgres(db) => Ok(Some(db.claim(advertise_url).await?)),
        }
    }

    /// Opens a PostgreSQL database to read it beside the server that has it; `None` for a file, which has one
    /// server. Every write fails. [`Db::set_generation`] makes its generation that of the database.
    ///
    /// # Errors
    /// [`OpenError`]: also if its schema is not the one of this program.
    pub async fn open_to_read(location: &Location) -> Result<Option<Self>, OpenError> {
        Ok(match location {
            Location::File(_) => None,
            Location::Postgres(address) => Some(Self::Postgres(
                tread_store_postgres::Db::open_to_read(address).await?,
            )),
        })
    }

    /// Makes the generation that of a PostgreSQL database, which other processes write.
    pub fn set_generation(&self, generation: i64) {
        match self {
            Self::Sqlite(_) => {}
            Self::Postgres(db) => db.set_generation(generation),
        }
    }

    /// Waits until a write has failed since another server has claimed the database.
    pub async fn taken_over(&self) {
        match self {
            Self::Sqlite(_) => std::future::pending().await,
            Self::Postgres(db) => db.taken_over().await,
        }
    }

    /// Returns the metrics of the database.
    pub fn metrics(&self) -> &DatabaseMetrics {
        match self {
            Self::Sqlite(db) => db.metrics(),
            Self::Postgres(db) => db.metrics(),
        }
    }

    /// Copies the write-ahead log of a file into it, as far as readers permit; nothing for an engine
    /// that does so itself.
    ///
    /// # Errors
    /// The engine failed, for instance on a full disk; the log remains valid.
    pub async fn checkpoint(&self) -> Result<(), DbError> {
        match self {
            Self::Sqlite(db) => db.checkpoint().await,
            Self::Postgres(db) => db.checkpoint().await,
        }
    }

    /// Makes a write without effect, as durable as any other.
    ///
    /// # Errors
    /// The database cannot be written.
    pub async fn probe_write(&self) -> Result<(), DbError> {
        match self {
            Self::Sqlite(db) => db.probe_write().await,
            Self::Postgres(db) => db.probe_write().await,
        }
    }

    /// Reads from every table.
    ///
    /// # Errors
    /// A table cannot be read.
    pub async fn probe_tables(&self) -> Result<(), DbError> {
        match self {
            Self::Sqlite(db) => db.probe_tables().await,
            Self::Postgres(db) => db.probe_tables().await,
        }
    }

    /// Checks the structure of a whole file, which is slow. Returns the first finding, if any.
    ///
    /// # Errors
    /// The database cannot be read.
    pub async fn quick_check(&self) -> Result<Option<String>, DbError> {
        match self {
            Self::Sqlite(db) => db.quick_check().await,
            Self::Postgres(db) => db.quick_check().await,
        }
    }

    /// Returns the size of the database and the free space on its disk, as far as they are known;
    /// `None` if nobody answers in time.
    pub async fn disk(&self) -> Option<Disk> {
        match self {
            Self::Sqlite(db) => db.disk().await,
            Self::Postgres(db) => db.disk().await,
        }
    }

    /// Closes all connections after their present work; a file is complete then.
    pub async fn close(&self) {
        match self {
            Self::Sqlite(db) => db.close().await,
            Self::Postgres(db) => db.close().await,
        }
    }
}

/// Kind of database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Engine {
    /// SQLite, in a file.
    Sqlite,
    /// PostgreSQL.
    Postgres,
}

impl Engine {
    /// Returns the engine of a database at a location.
    pub fn at(location: &Location) -> Self {
        match location {
            Location::File(_) => Self::Sqlite,
            Location::Postgres(_) => Self::Postgres,
        }
    }

    /// Returns what to do about a failure of its storage, for operators.
    pub fn advice(self, failure: StorageFailure) -> &'static str {
        match self {
            Self::Sqlite => failure.advice_for_file(),
            Self::Postgres => failure.advice_for_postgres(),
        }
    }

    /// Returns the name of the engine.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sqlite => "SQLite",
            Self::Postgres => "PostgreSQL",
        }
    }
}
