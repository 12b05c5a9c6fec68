//! A small pool of database connections, lent for one transaction each.
//!
//! Unlike a general pool it reports why no connection can be opened instead of trying until a
//! timeout, and makes no failure permanent. A connection is returned only after a successful commit
//! or rollback; otherwise it is closed, and the next transaction opens another. Every wait is
//! bounded: a network that loses packets answers nothing.

use std::fmt;
use std::ops::{Deref, DerefMut};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use futures_util::future::join_all;
use sqlx::postgres::{PgConnectOptions, PgDatabaseError, PgSeverity};
use sqlx::{AssertSqlSafe, ConnectOptions as _, Connection as _, PgConnection};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout};
use tread_store::Outcome;
use tread_store::timeouts::{ACQUIRE_TIMEOUT, CLOSE_TIMEOUT, ROLLBACK_TIMEOUT};

use super::failure;

/// Maximum time for opening a connection.
pub(super) const CONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum time for beginning a transaction: longer than [`LOCK_TIMEOUT`].
const BEGIN_TIMEOUT: Duration = Duration::from_secs(15);
/// Age at which a connection is replaced: memory of its process on the server grows with its use.
const AGE_MAX: Duration = Duration::from_mins(30);
/// Maximum time that the server waits for a lock, above all for the turn to write.
const LOCK_TIMEOUT: Duration = Duration::from_secs(10);

/// Bounds that the server keeps for the connections of a pool.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bounds {
    /// Maximum time for a statement, with the transfer of its rows.
    pub(super) statement: Duration,
    /// Maximum time between two statements of a transaction.
    pub(super) idle: Duration,
}

/// A pool of connections with the same options; clones share it.
#[derive(Debug, Clone)]
pub(super) struct Connections {
    inner: Arc<Inner>,
}

struct Inner {
    /// Not part of any output: contains the password.
    options: PgConnectOptions,
    bounds: Bounds,
    connections_max: u32,
    commit_max: Duration,
    permits: Arc<Semaphore>,
    idle: Mutex<Vec<Opened>>,
}

impl fmt::Debug for Inner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Inner")
            .field("bounds", &self.bounds)
            .field("connections_max", &self.connections_max)
            .finish_non_exhaustive()
    }
}

#[derive(Debug)]
struct Opened {
    connection: PgConnection,
    at: Instant,
}

impl Opened {
    /// Returns whether it is old, or a failure since it was opened may have spoiled it.
    fn is_spoiled(&self) -> bool {
        let age = self.at.elapsed();
        age >= AGE_MAX || failure::is_older_than_last(age)
    }
}

/// A connection in a transaction; dropped without [`TransactionConnection::commit`] it is rolled back.
#[derive(Debug)]
pub(super) struct TransactionConnection {
    opened: Option<Opened>,
    permit: Option<OwnedSemaphorePermit>,
    inner: Arc<Inner>,
}

/// Opens a connection.
///
/// # Errors
/// The server cannot be reached in time, or refuses.
pub(super) async fn connect(options: &PgConnectOptions) -> Result<PgConnection, sqlx::Error> {
    let connecting = timeout(CONNECT_TIMEOUT, options.connect()).await;
    connecting.unwrap_or_else(|_elapsed| Err(no_answer()))
}

/// Error of a server that does not answer in time.
fn no_answer() -> sqlx::Error {
    std::io::Error::from(std::io::ErrorKind::TimedOut).into()
}

impl Connections {
    /// Creates a pool of at most `connections_max` connections, and opens none.
    pub(super) fn new(
        options: PgConnectOptions,
        bounds: Bounds,
        connections_max: u32,
        commit_max: Duration,
    ) -> Self {
        let permits = usize::try_from(connections_max).unwrap_or(Semaphore::MAX_PERMITS);
        let inner = Inner {
            options,
            bounds,
            connections_max,
            commit_max,
            permits: Arc::new(Semaphore::new(permits)),
            idle: Mutex::default(),
        };
        Self {
            inner: Arc::new(inner),
        }
    }

    /// Begins a transaction with statements of PostgreSQL's.
    ///
    /// # Errors
    /// No connection became free in time, or PostgreSQL failed.
    pub(super) async fn begin(
        &self,
        statements: &str,
    ) -> Result<TransactionConnection, sqlx::Error> {
        let waiting = Arc::clone(&self.inner.permits).acquire_owned();
        let permit = timeout(ACQUIRE_TIMEOUT, waiting)
            .await
            .map_err(|_elapsed| sqlx::Error::PoolTimedOut)?
            .map_err(|_closed| sqlx::Error::PoolClosed)?;
        let begun = match self.inner.take_idle() {
            Some(idle) => match begin_on(idle, statements).await {
                // The server may have closed it since it was used last.
                Err(error) if is_broken(&error) => None,
                begun => Some(begun),
            },
            None => None,
        };
        let opened = match begun {
            Some(begun) => begun?,
            None => begin_on(self.inner.connect().await?, statements).await?,
        };
        Ok(TransactionConnection {
            opened: Some(opened),
            permit: Some(permit),
            inner: Arc::clone(&self.inner),
        })
    }

    /// Opens so many connections at once for the first transactions: each takes a tenth of a second with TLS,
    /// since sqlx 0.9.0 does not set `TCP_NODELAY`. A failure shows at the first transaction.
    pub(super) async fn open_first(&self, count: usize) {
        let open = async |_| {
            if let Ok(opened) = self.inner.connect().await {
                self.inner.return_idle(opened);
            }
        };
        join_all((0..count).map(open)).await;
    }

    /// Closes all connections after their present work, waiting at most [`CLOSE_TIMEOUT`].
    pub(super) async fn close(&self) {
        let Inner {
            connections_max,
            permits,
            ..
        } = &*self.inner;
        // A connection that is not returned in time is closed by its user.
        let _ = timeout(CLOSE_TIMEOUT, permits.acquire_many(*connections_max)).await;
        permits.close();
        let idle = std::mem::take(&mut *self.inner.idle());
        for opened in idle {
            // The connection is closed even after an error.
            let _ = timeout(CLOSE_TIMEOUT, opened.connection.close()).await;
        }
    }
}

/// Begins a transaction. If the caller is cancelled, the connection is closed.
async fn begin_on(mut opened: Opened, statements: &str) -> Result<Opened, sqlx::Error> {
    // They are constants of this crate, with a number at most.
    let beginning = sqlx::raw_sql(AssertSqlSafe(statements)).execute(&mut opened.connection);
    timeout(BEGIN_TIMEOUT, beginning)
        .await
        .unwrap_or_else(|_elapsed| Err(no_answer()))?;
    Ok(opened)
}

/// Returns whether an error is of the connection and not of the statement.
fn is_broken(error: &sqlx::Error) -> bool {
    failure::of(error) == Some(tread_store::failure::StorageFailure::Connection)
}

impl Inner {
    fn idle(&self) -> MutexGuard<'_, Vec<Opened>> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take_idle(&self) -> Option<Opened> {
        let mut idle = self.idle();
        idle.retain(|opened| !opened.is_spoiled());
        idle.pop()
    }

    /// Takes back a connection that works.
    fn return_idle(&self, opened: Opened) {
        if !self.permits.is_closed() {
            self.idle().push(opened);
        }
    }

    async fn connect(&self) -> Result<Opened, sqlx::Error> {
        // Its age counts from before it was opened.
        let at = Instant::now();
        let mut connection = connect(&self.options).await?;
        let Bounds { statement, idle } = self.bounds;
        // `off` would lose commits that were reported; stricter values of the operator stay. Statements
        // are short, so compiling one to machine code takes longer than running it.
        let settings = AssertSqlSafe(format!(
            "SET jit = off; SET statement_timeout = {}; SET lock_timeout = {};
             SET idle_in_transaction_session_timeout = {};
             SELECT set_config('synchronous_commit', 'on', FALSE)
             WHERE current_setting('synchronous_commit') = 'off'",
            statement.as_millis(),
            LOCK_TIMEOUT.as_millis(),
            idle.as_millis(),
        ));
        let setting = sqlx::raw_sql(settings).execute(&mut connection);
        timeout(CONNECT_TIMEOUT, setting)
            .await
            .unwrap_or_else(|_elapsed| Err(no_answer()))?;
        Ok(Opened { connection, at })
    }
}

impl TransactionConnection {
    /// Commits the transaction.
    ///
    /// # Errors
    /// PostgreSQL failed, and nothing is written, or the connection was lost, and the outcome is
    /// unknown; see [`outcome_of`].
    pub(super) async fn commit(mut self) -> Result<(), sqlx::Error> {
        let Some(mut opened) = self.opened.take() else {
            return Err(sqlx::Error::WorkerCrashed);
        };
        // `COMMIT` of a transaction with a failed statement rolls back and reports success. The
        // statement before it fails in such a transaction.
        let committing = sqlx::raw_sql("SELECT; COMMIT").execute(&mut opened.connection);
        timeout(self.inner.commit_max, committing)
            .await
            .unwrap_or_else(|_elapsed| Err(no_answer()))?;
        self.inner.return_idle(opened);
        Ok(())
    }
}

impl Drop for TransactionConnection {
    fn drop(&mut self) {
        let Some(mut opened) = self.opened.take() else {
            return;
        };
        // Without a runtime the connection is closed, which also rolls back.
        let Ok(runtime) = Handle::try_current() else {
            return;
        };
        let (inner, permit) = (Arc::clone(&self.inner), self.permit.take());
        runtime.spawn(async move {
            let rolling_back = sqlx::raw_sql("ROLLBACK").execute(&mut opened.connection);
            let is_over = matches!(timeout(ROLLBACK_TIMEOUT, rolling_back).await, Ok(Ok(_)));
            if is_over && !opened.is_spoiled() {
                inner.return_idle(opened);
            } else {
                drop(opened);
            }
            drop(permit);
        });
    }
}

impl Deref for TransactionConnection {
    type Target = PgConnection;

    fn deref(&self) -> &PgConnection {
        let opened = self.opened.as_ref();
        let opened = opened.expect("only a commit takes it, with the whole");
        &opened.connection
    }
}

impl DerefMut for TransactionConnection {
    fn deref_mut(&mut self) -> &mut PgConnection {
        let opened = self.opened.as_mut();
        let opened = opened.expect("only a commit takes it, with the whole");
        &mut opened.connection
    }
}

/// Returns the outcome of a commit that ended so.
pub(super) fn outcome_of(committed: &Result<(), sqlx::Error>) -> Outcome {
    match committed {
        Ok(()) => Outcome::Written,
        // PostgreSQL itself reports that it did not commit. A process that was ended may have
        // committed before.
        Err(sqlx::Error::Database(error)) => match error.try_downcast_ref::<PgDatabaseError>() {
            Some(error) if error.severity() == PgSeverity::Error => Outcome::Nothing,
            Some(_) | None => Outcome::Unknown,
        },
        Err(_) => Outcome::Unknown,
    }
}
