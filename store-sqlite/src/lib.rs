//! The store in one SQLite file. Contains SQL and no decisions.
//!
//! There is one writer connection ([`Db::write`], `BEGIN IMMEDIATE`) and a pool of readers
//! ([`Db::read`], each transaction a snapshot). `synchronous=FULL`: a commit that returned
//! survives a power cut.

#[path = "../../store/sql/alerts.rs"]
pub mod alerts;
#[path = "../../store/sql/archive_mark.rs"]
pub mod archive_mark;
#[path = "../../store/sql/attendance.rs"]
pub mod attendance;
#[path = "../../store/sql/audit.rs"]
pub mod audit;
#[path = "../../store/sql/column_names.rs"]
mod column_names;
mod connections;
pub mod copy;
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
pub mod lock;
#[path = "../../store/sql/missions.rs"]
pub mod missions;
mod private;
#[path = "../../store/sql/removed.rs"]
pub mod removed;
#[path = "../../store/sql/restorations.rs"]
pub mod restorations;
#[path = "../../store/sql/robots.rs"]
pub mod robots;
mod rows;
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

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use nix::sys::statvfs::statvfs;
use sqlx::AssertSqlSafe;
use sqlx::migrate::MigrateError;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous};
use tokio::sync::Semaphore;
use tokio::time::Instant;
use tread_api::release::VERSION;
use tread_store::metrics::DatabaseMetrics;
use tread_store::timeouts::{COMMIT_TIMEOUT, DISK_TIMEOUT};
use tread_store::{DbError, Disk};

use self::connections::{Connections, TransactionConnection};
pub use self::error::EngineError;
pub use self::transaction::Tx;
use self::transaction::{Commits, DurationRecorder};
use self::values::{
    corrupt, from_json, from_us, parse, robots_text, scope_text, to_json, to_us, unsigned,
};

/// Connection that the statements of all aggregates run on.
pub(crate) type Connection = sqlx::SqliteConnection;

/// Minimum version of SQLite: earlier ones have a bug that can lose a write-ahead log.
pub const SQLITE_VERSION_MIN: (u32, u32, u32) = (3, 51, 3);
/// Number of connections that read at the same time.
const READERS_MAX: u32 = 4;
/// Pages of the write-ahead log (512 MiB) at which a commit also checkpoints it, if
/// [`Db::checkpoint`] has not. The commit takes as long as what is left to copy, so this is for the
/// case that nothing else helps.
const WAL_PAGES: u32 = 131_072;
/// Pages of the log (16 MiB) from which on a checkpoint also resets it.
const WAL_RESET_PAGES: i64 = 4_096;
/// Pages (4 MiB) that a reset may copy while commits wait. Of a larger log it may copy this part,
/// because fewer never remain where writers are as fast as the disk.
const WAL_REMAINING_PAGES_MAX: i64 = 1_024;
const WAL_REMAINING_DIVISOR: i64 = 8;
/// Maximum number of passive checkpoints before a reset. Each copies what was written during the one
/// before, so that ever fewer pages remain.
const PASSES_MAX: u32 = 8;
/// Page cache of the writer, KiB: holds the cells that robots drive over now.
const WRITER_CACHE_KIB: u32 = 32 * 1_024;
/// Maximum time that SQLite waits for a lock of another process.
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

/// Reason why the database cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The folder of the file is missing.
    #[error(
        "the folder `{}` of the database does not exist; create it first, for the user that the \
         server runs as", .0.display()
    )]
    NoFolder(PathBuf),
    /// The file cannot be opened.
    #[error(
        "cannot open the database `{}`: {}", path.display(), failure::advice_on_database(cause)
    )]
    Open {
        /// The file.
        path: PathBuf,
        /// The cause.
        #[source]
        cause: sqlx::Error,
    },
    /// The file is of a newer version.
    #[error(
        "the database `{}` has schema {found}{by}, and tread-server {version} knows schemas up to \
         {known}: a server never goes back. Install {wanted}, or restore a backup that was made \
         before the upgrade with `tread-server restore --from FILE --force`", path.display()
    )]
    Newer {
        /// The file.
        path: PathBuf,
        /// Its schema.
        found: i64,
        /// ` of tread-server V`, or empty if the version is not known.
        by: String,
        /// The version to install, for people.
        wanted: String,
        /// The newest schema that this program knows.
        known: i64,
        /// Version of this program.
        version: &'static str,
    },
    /// A migration failed.
    #[error("cannot bring the database `{}` up to date", path.display())]
    Migrate {
        /// The file.
        path: PathBuf,
        /// The cause.
        #[source]
        cause: sqlx::migrate::MigrateError,
    },
    /// The version of SQLite is too old.
    #[error("SQLite {0} may lose data; 3.51.3 or newer is needed")]
    TooOld(String),
}

/// Pages in the write-ahead log, and how many of them are in the database file.
#[derive(Debug, Clone, Copy)]
struct Checkpointed {
    pages: i64,
    copied: i64,
}

/// The open database; clones share it.
#[derive(Debug, Clone)]
pub struct Db {
    writer: Connections,
    readers: Connections,
    path: PathBuf,
    /// Connection that checkpoints the log, beside the writer.
    checkpoints: Connections,
    version: String,
    metrics: DatabaseMetrics,
    commits: Arc<Commits>,
    /// One permit, held while the operating system is asked about the disk.
    asking_disk: Arc<Semaphore>,
}

impl Db {
    /// Opens the file, creates it if it is missing, and applies migrations.
    ///
    /// # Errors
    /// [`OpenError`] names file or folder.
    pub async fn open(path: &Path) -> Result<Self, OpenError> {
        Self::open_with(path, COMMIT_TIMEOUT).await
    }

    /// As [`Db::open`], with a given maximum time for a commit.
    ///
    /// # Errors
    /// As [`Db::open`].
    pub async fn open_with(path: &Path, commit_max: Duration) -> Result<Self, OpenError> {
        let folder = path
            .parent()
            .filter(|folder| !folder.as_os_str().is_empty());
        if let Some(folder) = folder.filter(|folder| !folder.is_dir()) {
            return Err(OpenError::NoFolder(folder.to_owned()));
        }
        let failed = |cause| OpenError::Open {
            path: path.to_owned(),
            cause,
        };
        private::keep(path).map_err(|cause| failed(cause.into()))?;
        let options = SqliteConnectOptions::new()
            .filename(path)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT)
            .pragma("wal_autocheckpoint", WAL_PAGES.to_string());
        let cache = format!("-{WRITER_CACHE_KIB}");
        let of_writer = options.clone().pragma("cache_size", cache);
        let writer = Connections::open(of_writer, 1, commit_max)
            .await
            .map_err(failed)?;
        let version = writer
            .with_first(async |connection| {
                sqlx::query_scalar!(r#"SELECT sqlite_version() AS "version!: String""#)
                    .fetch_one(connection)
                    .await
            })
            .await
            .flatten()
            .map_err(failed)?;
        if !is_new_enough(&version) {
            return Err(OpenError::TooOld(version));
        }
        let found = writer
            .with_first(async |connection| schema::of_connection(connection).await)
            .await
            .map_err(failed)?;
        if let Ok(found) = found {
            refuse_newer(path, &found)?;
        }
        writer
            .with_first(async |connection| schema::migrator().run(connection).await)
            .await
            .map_err(failed)?
            .map_err(|cause| {
                let migrate = |cause| OpenError::Migrate {
                    path: path.to_owned(),
                    cause,
                };
                let MigrateError::Execute(cause) = cause else {
                    return migrate(cause);
                };
                // Such a file cannot be read, whatever its version is.
                if failure::of(&cause).is_some() {
                    return failed(cause);
                }
                migrate(MigrateError::Execute(cause))
            })?;
        // This connection has no transactions that could stay open, and is never replaced: while
        // one connection is open the log's index exists, for which a full disk has no room.
        let checkpoints = Connections::open(options.clone(), 1, commit_max)
            .await
            .map_err(failed)?;
        let readers = Connections::open(options.read_only(true), READERS_MAX, commit_max)
            .await
            .map_err(failed)?;
        Ok(Self {
            writer,
            readers,
            path: path.to_owned(),
            checkpoints,
            version,
            metrics: DatabaseMetrics::default(),
            commits: Arc::default(),
            asking_disk: Arc::new(Semaphore::new(1)),
        })
    }

    /// Returns the generation: a counter of all commits but those of [`Db::write_uncounted`]. Data that
    /// those do not change are unchanged while it is the same.
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
    /// The writing connection did not become free in time: such a commit goes on, or another
    /// process writes.
    pub async fn await_commits(&self) -> Result<(), DbError> {
        // SQLite lets nobody begin to write as long as an earlier transaction may still be
        // committed.
        drop(self.write("refresh").await?);
        self.commits.generation.fetch_add(1, Ordering::AcqRel);
        Ok(())
    }

    /// Returns the path of the database file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the version of the SQLite library.
    pub fn sqlite_version(&self) -> &str {
        &self.version
    }

    /// Begins a write transaction; waits for the writing connection. Await nothing but the database
    /// before the commit. `kind` names the use case in the metrics.
    ///
    /// # Errors
    /// The connection did not become free in time, or SQLite failed.
    pub async fn write(&self, kind: &'static str) -> Result<Tx, DbError> {
        let asked_at = Instant::now();
        let inner = self
            .writer
            .begin("BEGIN IMMEDIATE")
            .await
            .map_err(EngineError::from)?;
        self.metrics.write_wait(asked_at.elapsed());
        let tx = self.timed(inner, kind, true);
        Ok(Tx {
            is_counted: true,
            ..tx
        })
    }

    /// Begins a write transaction that [`Db::generation`] does not count, since it changes no site,
    /// terrain or robot: of uploads, missions, alerts, identities and the audit log.
    ///
    /// # Errors
    /// The connection did not become free in time, or SQLite failed.
    pub async fn write_uncounted(&self, kind: &'static str) -> Result<Tx, DbError> {
        Ok(Tx {
            is_counted: false,
            ..self.write(kind).await?
        })
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
    /// No connection became free in time, or SQLite failed.
    pub async fn read(&self, kind: &'static str) -> Result<Tx, DbError> {
        let inner = self
            .readers
            .begin("BEGIN")
            .await
            .map_err(EngineError::from)?;
        Ok(self.timed(inner, kind, false))
    }

    /// Copies the write-ahead log into the database file (a passive checkpoint), up to the oldest
    /// snapshot that a reader still uses. Writers do not wait for it, unless the log is large and
    /// few pages remain: those are copied between two commits, and the next commit resets the log.
    ///
    /// # Errors
    /// SQLite failed, for instance on a full disk; the log remains valid.
    pub async fn checkpoint(&self) -> Result<(), DbError> {
        let mut copied_before = -1;
        for _ in 0..PASSES_MAX {
            let Checkpointed { pages, copied } = self.passive_checkpoint().await?;
            // The snapshot of a reader prevents that more is copied.
            let is_blocked = copied == copied_before;
            if pages < WAL_RESET_PAGES || pages == copied || is_blocked {
                return Ok(());
            }
            copied_before = copied;
            if pages - copied > WAL_REMAINING_PAGES_MAX.max(pages / WAL_REMAINING_DIVISOR) {
                continue;
            }
            // If the writer is not free in time, the next checkpoint tries again.
            if let Ok(_writer) = self.writer.reserve().await {
                self.passive_checkpoint().await?;
            }
            return Ok(());
        }
        Ok(())
    }

    async fn passive_checkpoint(&self) -> Result<Checkpointed, EngineError> {
        let checkpoint = self.checkpoints.run("PRAGMA wal_checkpoint(PASSIVE)");
        let (_is_busy, pages, copied): (i64, i64, i64) = checkpoint.await?;
        Ok(Checkpointed { pages, copied })
    }

    /// Makes a write without effect, as durable as any other.
    ///
    /// # Errors
    /// The database cannot be written.
    pub async fn probe_write(&self) -> Result<(), DbError> {
        let mut tx = self.write_uncounted("storage").await?;
        // A number in the file's header that is not used otherwise; its page is written each time.
        sqlx::query("PRAGMA user_version = 1")
            .execute(&mut *tx)
            .await
            .map_err(EngineError::from)?;
        tx.commit().await
    }

    /// Reads from every table, which detects a damaged or lost root page.
    ///
    /// # Errors
    /// A table cannot be read.
    pub async fn probe_tables(&self) -> Result<(), DbError> {
        let mut tx = self.read("storage").await?;
        let tables: Vec<(String,)> =
            sqlx::query_as("SELECT name FROM sqlite_schema WHERE type = 'table'")
                .fetch_all(&mut *tx)
                .await
                .map_err(EngineError::from)?;
        if tables.is_empty() {
            // The file was removed, so the open connections are useless.
            failure::record(&sqlx::Error::WorkerCrashed);
            return Err(corrupt("schema", "no tables").into());
        }
        for (table,) in tables {
            let look = AssertSqlSafe(format!("SELECT 1 FROM \"{table}\" LIMIT 1"));
            sqlx::query(look)
                .fetch_optional(&mut *tx)
                .await
                .map_err(EngineError::from)?;
        }
        Ok(())
    }

    /// Checks the structure of the whole file, which is slow. Returns the first finding, if any.
    ///
    /// # Errors
    /// The database cannot be read.
    pub async fn quick_check(&self) -> Result<Option<String>, DbError> {
        let mut tx = self.read("storage").await?;
        let (finding,): (String,) = sqlx::query_as("PRAGMA quick_check(1)")
            .fetch_one(&mut *tx)
            .await
            .map_err(EngineError::from)?;
        Ok((finding != "ok").then_some(finding))
    }

    /// Returns the size of the database's files and the free space on their disk; `None` if the
    /// operating system does not answer in time.
    pub async fn disk(&self) -> Option<Disk> {
        // A hanging disk may block this; meanwhile no further request is made.
        let asking = Arc::clone(&self.asking_disk).try_acquire_owned().ok()?;
        let path = self.path.clone();
        let asked = tokio::task::spawn_blocking(move || {
            let free = statvfs(&path).ok().map(|found| {
                found
                    .blocks_available()
                    .saturating_mul(found.fragment_size())
            });
            let size = |file: &Path| std::fs::metadata(file).ok().map(|found| found.len());
            let mut log = path.clone().into_os_string();
            log.push("-wal");
            let found = Disk {
                free_bytes: free,
                database_bytes: size(&path),
                log_bytes: size(Path::new(&log)),
            };
            drop(asking);
            found
        });
        tokio::time::timeout(DISK_TIMEOUT, asked).await.ok()?.ok()
    }

    /// Closes all connections after their present work; the file is complete then.
    pub async fn close(&self) {
        self.readers.close().await;
        self.checkpoints.close().await;
        self.writer.close().await;
    }
}

/// Refuses a file that a newer version has written.
///
/// # Errors
/// [`OpenError::Newer`].
pub fn refuse_newer(path: &Path, found: &schema::FoundSchema) -> Result<(), OpenError> {
    let known = schema::known();
    let Some(newer) = found.schema.filter(|schema| *schema > known) else {
        return Ok(());
    };
    let by = found.version.as_ref();
    let wanted = by.map_or_else(
        || "the version that wrote it, or a newer one".to_owned(),
        |version| format!("version {version} or newer"),
    );
    Err(OpenError::Newer {
        path: path.to_owned(),
        found: newer,
        by: by.map_or_else(String::new, |version| format!(" of tread-server {version}")),
        wanted,
        known,
        version: VERSION,
    })
}

fn is_new_enough(version: &str) -> bool {
    let mut parts = version.split('.').map(|part| part.parse().unwrap_or(0_u32));
    let mut next = || parts.next().unwrap_or(0);
    (next(), next(), next()) >= SQLITE_VERSION_MIN
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_of_segments;
#[cfg(test)]
mod tests_of_sessions;
