//! The store in a PostgreSQL database. Contains SQL and no decisions.
//!
//! Most statements are those of the SQLite engine, from `store/sql`: the first migration defines the
//! functions of SQLite that they use. A write ([`Db::write`]) begins with a lock that only one
//! transaction of the whole database holds, so every write sees all earlier ones, and keys rise in the
//! order of commits. A read ([`Db::read`]) is a snapshot.

#[path = "../../store/sql/alerts.rs"]
pub mod alerts;
#[path = "../../store/sql/archive_mark.rs"]
pub mod archive_mark;
#[path = "../../store/sql/attendance.rs"]
pub mod attendance;
#[path = "../../store/sql/audit.rs"]
pub mod audit;
mod begin;
#[path = "../../store/sql/column_names.rs"]
mod column_names;
mod connections;
mod copy_rows;
#[path = "../../store/sql/deferred_segments.rs"]
pub mod deferred_segments;
#[path = "../../store/sql/enrolments.rs"]
pub mod enrolments;
mod error;
mod failure;
#[path = "../../store/sql/geofences.rs"]
pub mod geofences;
#[path = "../../store/sql/ground.rs"]
mod ground;
#[path = "../../store/sql/history.rs"]
pub mod history;
#[path = "../../store/sql/idempotency.rs"]
pub mod idempotency;
pub mod inspection;
#[path = "../../store/sql/join_tokens.rs"]
pub mod join_tokens;
pub mod leader;
pub mod lock;
#[path = "../../store/sql/missions.rs"]
pub mod missions;
pub mod open;
mod partitions;
#[path = "../../store/sql/removed.rs"]
pub mod removed;
#[path = "../../store/sql/restorations.rs"]
pub mod restorations;
#[path = "../../store/sql/robots.rs"]
pub mod robots;
pub mod schema;
#[path = "../../store/sql/secrets.rs"]
pub mod secrets;
#[path = "../../store/sql/segment_ranges.rs"]
pub mod segment_ranges;
mod segment_rows;
#[path = "../../store/sql/segments.rs"]
pub mod segments;
#[path = "../../store/sql/sessions.rs"]
pub mod sessions;
#[path = "../../store/sql/sites.rs"]
pub mod sites;
#[path = "../../store/sql/stops.rs"]
pub mod stops;
#[path = "../../store/sql/sum_columns.rs"]
mod sum_columns;
mod sum_rows;
#[path = "../../store/sql/sums.rs"]
pub mod sums;
#[path = "../../store/sql/terrains.rs"]
pub mod terrains;
#[path = "../../store/sql/times.rs"]
pub mod times;
#[path = "../../store/sql/tokens.rs"]
pub mod tokens;
#[path = "../../store/sql/transaction.rs"]
mod transaction;
#[path = "../../store/sql/transfer.rs"]
pub mod transfer;
mod transfer_rows;
#[path = "../../store/sql/values.rs"]
mod values;
#[path = "../../store/sql/watermarks.rs"]
pub mod watermarks;
#[path = "../../store/sql/webhooks.rs"]
pub mod webhooks;
#[path = "../../store/sql/withdrawals.rs"]
pub mod withdrawals;

use std::sync::atomic::Ordering;
use std::sync::{Arc, LazyLock, OnceLock};
use std::time::Duration;

use sqlx::AssertSqlSafe;
use sqlx::postgres::PgConnectOptions;
use tokio::sync::watch;
use tokio::time::{Instant, timeout};
use tread_store::failure::StorageFailure;
use tread_store::metrics::DatabaseMetrics;
use tread_store::timeouts::{COMMIT_TIMEOUT, DISK_TIMEOUT};
use tread_store::{DbError, Disk};

use self::begin::{BEGIN_READ, BeginWrite};
use self::connections::{Bounds, Connections, TransactionConnection};
pub use self::error::EngineError;
pub use self::open::{OpenError, refuse_newer};
pub use self::transaction::Tx;
use self::transaction::{Commits, DurationRecorder};
use self::values::{
    corrupt, from_json, from_us, parse, robots_text, scope_text, to_json, to_us, unsigned,
};

/// Connection that the statements of all aggregates run on.
pub(crate) type Connection = sqlx::PgConnection;

/// Number of connections that write: one, since only one transaction may write anyway.
const WRITERS_MAX: u32 = 1;
/// Number of connections that read at the same time.
const READERS_MAX: u32 = 8;
/// Number of connections that are opened with the database, for its first transactions.
const WRITERS_FIRST: usize = 1;
const READERS_FIRST: usize = 2;
/// Maximum time for these.
const FIRST_TIMEOUT: Duration = Duration::from_millis(500);
/// Bounds of writes. A statement waits for the disk and for no client.
const WRITER_BOUNDS: Bounds = Bounds {
    statement: Duration::from_mins(1),
    idle: Duration::from_mins(1),
};
/// Bounds of reads, some of which stream a whole table to where it is processed.
const READER_BOUNDS: Bounds = Bounds {
    statement: Duration::from_mins(15),
    idle: Duration::from_mins(15),
};
/// PostgreSQL's code, of `check_server_epoch`, for a server that another one has taken the place of.
const TAKEN_OVER: &str = "TR001";

/// The open database; clones share it.
#[derive(Debug, Clone)]
pub struct Db {
    writer: Connections,
    readers: Connections,
    address: String,
    version: String,
    metrics: DatabaseMetrics,
    commits: Arc<Commits>,
    claim: Arc<Claim>,
}

/// What this process may write.
#[derive(Debug, Default)]
struct Claim {
    /// What begins a write, with the epoch of this server; unset for a program that is no server.
    begin_write: OnceLock<BeginWrite>,
    is_taken_over: watch::Sender<bool>,
}

impl Db {
    /// Connects to the database of an address, `postgres://USER:PASSWORD@HOST:PORT/NAME`, and applies
    /// migrations.
    ///
    /// # Errors
    /// [`OpenError`] names the address without its password.
    pub async fn open(url: &str) -> Result<Self, OpenError> {
        Self::open_with(url, COMMIT_TIMEOUT).await
    }

    /// As [`Db::open`], with a given maximum time for a commit.
    ///
    /// # Errors
    /// As [`Db::open`].
    pub async fn open_with(url: &str, commit_max: Duration) -> Result<Self, OpenError> {
        let (options, address) = open::options_of(url)?;
        let mut db = Self::of(&options, address.clone(), commit_max);
        let opening = async {
            tokio::join!(
                db.writer.open_first(WRITERS_FIRST),
                db.readers.open_first(READERS_FIRST)
            )
        };
        // Transactions open what is missing after that.
        let opening = timeout(FIRST_TIMEOUT, opening);
        let preparing = open::prepare(&options, &address);
        let (prepared, _opened) = tokio::join!(preparing, opening);
        db.version = prepared?;
        Ok(db)
    }

    /// Connects to the database of an address to read it, beside the server that has it, and changes nothing.
    /// [`Db::set_generation`] makes its generation that of the database.
    ///
    /// # Errors
    /// [`OpenError`]: also if its schema is not the one of this program.
    pub async fn open_to_read(url: &str) -> Result<Self, OpenError> {
        let prepared = open::prepare_to_read(url).await?;
        let mut db = Self::of(&prepared.options, prepared.address, COMMIT_TIMEOUT);
        db.version = prepared.version;
        // Nobody else has it yet.
        let _ = db.claim.begin_write.set(BeginWrite::of_reader());
        Ok(db)
    }

    /// A database of which no connection is open, and the version is not known yet.
    fn of(options: &PgConnectOptions, address: String, commit_max: Duration) -> Self {
        let pool = |bounds, connections_max| {
            Connections::new(options.clone(), bounds, connections_max, commit_max)
        };
        Self {
            writer: pool(WRITER_BOUNDS, WRITERS_MAX),
            readers: pool(READER_BOUNDS, READERS_MAX),
            address,
            version: String::new(),
            metrics: DatabaseMetrics::default(),
            commits: Arc::default(),
            claim: Arc::default(),
        }
    }

    /// Makes the generation that of the database, which other processes write.
    pub fn set_generation(&self, generation: i64) {
        let generation = u64::try_from(generation).unwrap_or_default();
        self.commits.generation.store(generation, Ordering::Release);
    }

    /// Returns the generation: a counter of all commits but those of [`Db::write_uncounted`]. Data that
    /// those do not change are unchanged while it is the same. It counts the commits of this process.
    pub fn generation(&self) -> u64 {
        self.commits.generation.load(Ordering::Acquire)
    }

    /// Returns the number of commits of unknown outcome.
    pub fn unknown_outcomes(&self) -> u64 {
        self.commits.unknown.load(Ordering::Acquire)
    }

    /// Waits for the next commit of unknown outcome.
    pub async fn outcome_unknown(&self) {
        self.commits.became_unknown.notified().await;
    }

    /// Waits until every earlier commit has ended, in whatever way, and increments the generation:
    /// data read meanwhile may be from before.
    ///
    /// # Errors
    /// The turn to write did not come in time: such a commit goes on, or another process writes.
    pub async fn await_commits(&self) -> Result<(), DbError> {
        // A transaction whose connection was lost holds the lock as long as it may still be committed.
        drop(self.write("refresh").await?);
        self.commits.generation.fetch_add(1, Ordering::AcqRel);
        Ok(())
    }

    /// Returns the address of the database, without a password.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Returns the version of the PostgreSQL server when the database was opened.
    pub fn server_version(&self) -> &str {
        &self.version
    }

    /// Begins a write transaction; waits until no other transaction writes. Await nothing but the
    /// database before the commit. `kind` names the use case in the metrics.
    ///
    /// # Errors
    /// The turn to write did not come in time, or PostgreSQL failed.
    pub async fn write(&self, kind: &'static str) -> Result<Tx, DbError> {
        self.begin_write(kind, true).await
    }

    async fn begin_write(&self, kind: &'static str, is_counted: bool) -> Result<Tx, DbError> {
        static OF_PROGRAM: LazyLock<BeginWrite> = LazyLock::new(BeginWrite::of_program);
        let asked_at = Instant::now();
        let begin = self.claim.begin_write.get().unwrap_or(&OF_PROGRAM);
        let begin = if is_counted {
            &begin.counted
        } else {
            &begin.uncounted
        };
        let inner = self.writer.begin(begin).await;
        if let Err(sqlx::Error::Database(error)) = &inner
            && error.code().as_deref() == Some(TAKEN_OVER)
        {
            self.claim.is_taken_over.send_replace(true);
        }
        let inner = inner.map_err(EngineError::from)?;
        self.metrics.write_wait(asked_at.elapsed());
        let tx = self.timed(inner, kind, true);
        Ok(Tx { is_counted, ..tx })
    }

    /// Begins a write transaction that [`Db::generation`] does not count, since it changes no site,
    /// terrain or robot: of uploads, missions, alerts, identities and the audit log.
    ///
    /// # Errors
    /// As [`Db::write`].
    pub async fn write_uncounted(&self, kind: &'static str) -> Result<Tx, DbError> {
        self.begin_write(kind, false).await
    }

    /// Makes this process the server of the database: all that were so before cannot write any more. To be
    /// called once, with the lock. Standbys send to `advertise_url` what only this server can answer. Returns its
    /// epoch.
    ///
    /// # Errors
    /// The database cannot be written.
    pub async fn claim(&self, advertise_url: Option<&str>) -> Result<i64, DbError> {
        let mut tx = self.write_uncounted("lock").await?;
        let epoch = leader::claim(&mut tx, advertise_url).await?;
        tx.commit().await?;
        // Set once: a second claim of the same process keeps the first epoch, and fails with it.
        let _ = self.claim.begin_write.set(BeginWrite::of_server(epoch));
        Ok(epoch)
    }

    /// Waits until a write has failed since another server has claimed the database.
    pub async fn taken_over(&self) {
        let mut is_taken_over = self.claim.is_taken_over.subscribe();
        // The sender lives as long as this database.
        let _ = is_taken_over.wait_for(|is| *is).await;
    }

    fn timed(&self, inner: TransactionConnection, kind: &'static str, writes: bool) -> Tx {
        let duration_recorder = DurationRecorder {
            metrics: self.metrics.clone(),
            kind,
            writes,
            began_at: Instant::now(),
        };
        Tx {
            inner,
            duration_recorder,
            commits: Arc::clone(&self.commits),
            is_counted: false,
        }
    }

    /// Returns the metrics of the database.
    pub fn metrics(&self) -> &DatabaseMetrics {
        &self.metrics
    }

    /// Begins to read one snapshot. `kind` names the use case in the metrics.
    ///
    /// # Errors
    /// No connection became free in time, or PostgreSQL failed.
    pub async fn read(&self, kind: &'static str) -> Result<Tx, DbError> {
        let inner = self.readers.begin(BEGIN_READ).await;
        let inner = inner.map_err(EngineError::from)?;
        Ok(self.timed(inner, kind, false))
    }

    /// Does nothing: PostgreSQL makes its checkpoints by itself.
    ///
    /// # Errors
    /// None.
    #[expect(clippy::unused_async, reason = "as the other engine")]
    pub async fn checkpoint(&self) -> Result<(), DbError> {
        Ok(())
    }

    /// Makes a write without effect, as durable as any other.
    ///
    /// # Errors
    /// The database cannot be written.
    pub async fn probe_write(&self) -> Result<(), DbError> {
        let mut tx = self.write_uncounted("storage").await?;
        sqlx::query!("UPDATE write_probe SET writes = writes + 1")
            .execute(&mut *tx)
            .await
            .map_err(EngineError::from)?;
        tx.commit().await
    }

    /// Reads from every table, which detects a lost or damaged one.
    ///
    /// # Errors
    /// A table cannot be read.
    pub async fn probe_tables(&self) -> Result<(), DbError> {
        let mut tx = self.read("storage").await?;
        for table in tables(&mut tx).await? {
            let look = AssertSqlSafe(format!("SELECT 1 FROM {table} LIMIT 1"));
            sqlx::query(look)
                .persistent(false)
                .fetch_optional(&mut *tx)
                .await
                .map_err(EngineError::from)?;
        }
        Ok(())
    }

    /// Reads every row of every table, which is slow. Returns the first finding, if any.
    ///
    /// # Errors
    /// The database cannot be read, for another reason than damage.
    pub async fn quick_check(&self) -> Result<Option<String>, DbError> {
        let mut tx = self.read("storage").await?;
        for table in tables(&mut tx).await? {
            let all = AssertSqlSafe(format!("SELECT COUNT(whole.*) FROM {table} AS whole"));
            let counted = sqlx::query(all).persistent(false).execute(&mut *tx).await;
            match counted.map_err(EngineError::from) {
                Ok(_) => {}
                Err(EngineError::Postgres(error))
                    if failure::of(&error) == Some(StorageFailure::Damaged) =>
                {
                    return Ok(Some(format!("table {table}: {error}")));
                }
                Err(error) => return Err(error.into()),
            }
        }
        Ok(None)
    }

    /// Returns the size of the database; `None` if the server does not report it in time. The free space
    /// on the server's disk is not known.
    pub async fn disk(&self) -> Option<Disk> {
        let asking = async {
            let mut tx = self.read("storage").await.ok()?;
            let size = sqlx::query_scalar!("SELECT pg_database_size(current_database())");
            size.fetch_one(&mut *tx).await.ok()?
        };
        let bytes = timeout(DISK_TIMEOUT, asking).await.ok()??;
        Some(Disk {
            free_bytes: None,
            database_bytes: u64::try_from(bytes).ok(),
            log_bytes: None,
        })
    }

    /// Closes all connections after their present work.
    pub async fn close(&self) {
        self.readers.close().await;
        self.writer.close().await;
    }
}

/// Returns the names of all tables, quoted.
async fn tables(db: &mut Connection) -> Result<Vec<String>, EngineError> {
    let tables = sqlx::query_scalar!(
        r#"SELECT quote_ident(nspname) || '.' || quote_ident(relname) AS "table!"
           FROM pg_class JOIN pg_namespace ON pg_namespace.oid = relnamespace
           WHERE nspname = current_schema() AND relkind IN ('r', 'p') AND NOT relispartition
           ORDER BY relname"#
    );
    let tables = tables.fetch_all(db).await?;
    if tables.is_empty() {
        // The database was emptied, or the address leads to another one now.
        failure::record(&sqlx::Error::WorkerCrashed);
        return Err(corrupt("schema", "no tables"));
    }
    Ok(tables)
}

#[cfg(test)]
mod testing;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_of_opening;
#[cfg(test)]
mod tests_of_parity;
#[cfg(test)]
mod tests_of_partitions;
#[cfg(test)]
mod tests_of_segments;
#[cfg(test)]
mod tests_of_sums;
#[cfg(test)]
mod tests_of_transfer;
