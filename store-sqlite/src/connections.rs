//! A small pool of database connections, lent for one transaction each.
//!
//! Unlike a general pool it makes no failure permanent. A connection is returned only after a
//! successful commit or rollback; otherwise it is closed, and the next transaction opens another.
//! Every wait is bounded: when the library's thread of a connection ends for lack of memory,
//! statements sent to it are never answered.
//!
//! Each connection has a thread, which a hanging disk can block. A connection that is being opened
//! or was given up counts until its thread has ended. There may be [`SPARE_MAX`] more threads than
//! working connections; beyond that no connection is opened.

use std::ops::{Deref, DerefMut};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use sqlx::sqlite::{SqliteConnectOptions, SqliteRow};
use sqlx::{ConnectOptions as _, Connection as _, FromRow, SqliteConnection};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout};
use tread_store::Outcome;
use tread_store::timeouts::{ACQUIRE_TIMEOUT, CLOSE_TIMEOUT, ROLLBACK_TIMEOUT};

use super::failure;

/// Maximum time that opening a connection waits for the thread of one that is being closed.
const THREAD_TIMEOUT: Duration = Duration::from_secs(1);
/// Maximum time for beginning a transaction: longer than SQLite waits for another process's lock.
const BEGIN_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of connections with hanging threads, in addition to the working ones.
const SPARE_MAX: u32 = 4;

/// A pool of connections with the same options; clones share it.
#[derive(Debug, Clone)]
pub(super) struct Connections {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    options: SqliteConnectOptions,
    connections_max: u32,
    commit_max: Duration,
    permits: Arc<Semaphore>,
    /// One permit for each thread that may exist.
    threads: Arc<Semaphore>,
    idle: Mutex<Vec<Opened>>,
}

#[derive(Debug)]
struct Opened {
    /// `Some` until it is dropped.
    connection: Option<SqliteConnection>,
    /// Released when the connection's thread has ended.
    thread: Option<OwnedSemaphorePermit>,
    at: Instant,
}

impl Opened {
    fn connection(&mut self) -> Result<&mut SqliteConnection, sqlx::Error> {
        self.connection.as_mut().ok_or(sqlx::Error::WorkerCrashed)
    }

    /// Closes the connection, and waits until its thread has ended.
    async fn close(mut self) {
        if let Some(connection) = self.connection.take() {
            // The connection is closed even after an error.
            let _ = connection.close().await;
        }
    }

    /// Returns whether a failure since it was opened may have spoiled it.
    fn is_spoiled(&self) -> bool {
        failure::is_older_than_last(self.at.elapsed())
    }
}

impl Drop for Opened {
    fn drop(&mut self) {
        let (Some(connection), Some(thread)) = (self.connection.take(), self.thread.take()) else {
            return;
        };
        // Without a runtime the process is ending, and its threads with it.
        if let Ok(runtime) = Handle::try_current() {
            runtime.spawn(async move {
                // The connection is closed even after an error.
                let _ = connection.close().await;
                drop(thread);
            });
        }
    }
}

/// A connection in a transaction; dropped without [`TransactionConnection::commit`] it is rolled back.
#[derive(Debug)]
pub(super) struct TransactionConnection {
    opened: Option<Opened>,
    permit: Option<OwnedSemaphorePermit>,
    inner: Arc<Inner>,
}

impl Connections {
    /// Creates a pool of at most `connections_max` connections, and opens the first.
    pub(super) async fn open(
        options: SqliteConnectOptions,
        connections_max: u32,
        commit_max: Duration,
    ) -> Result<Self, sqlx::Error> {
        let permits = usize::try_from(connections_max).unwrap_or(Semaphore::MAX_PERMITS);
        let spare = usize::try_from(SPARE_MAX).unwrap_or_default();
        let inner = Inner {
            options,
            connections_max,
            commit_max,
            permits: Arc::new(Semaphore::new(permits)),
            threads: Arc::new(Semaphore::new(permits.saturating_add(spare))),
            idle: Mutex::default(),
        };
        let first = inner.connect().await?;
        inner.idle().push(first);
        // A file that disappears later, as with its disk, is not created again.
        let options = inner.options.create_if_missing(false);
        Ok(Self {
            inner: Arc::new(Inner { options, ..inner }),
        })
    }

    /// Begins a transaction with a statement of SQLite's.
    ///
    /// # Errors
    /// No connection became free in time, or SQLite failed.
    pub(super) async fn begin(
        &self,
        statement: &'static str,
    ) -> Result<TransactionConnection, sqlx::Error> {
        let permit = self.reserve().await?;
        let mut opened = match self.inner.take_idle() {
            Some(opened) => opened,
            None => self.inner.connect().await?,
        };
        // If the caller is cancelled here, the connection is closed.
        let beginning = sqlx::query(statement).execute(opened.connection()?);
        timeout(BEGIN_TIMEOUT, beginning)
            .await
            .map_err(|_elapsed| sqlx::Error::WorkerCrashed)??;
        Ok(TransactionConnection {
            opened: Some(opened),
            permit: Some(permit),
            inner: Arc::clone(&self.inner),
        })
    }

    /// Runs a statement outside of any transaction, and returns its row. Its connection stays open
    /// also if the statement fails, unless it is broken.
    ///
    /// # Errors
    /// As [`Connections::begin`].
    pub(super) async fn run<T>(&self, statement: &'static str) -> Result<T, sqlx::Error>
    where
        T: for<'row> FromRow<'row, SqliteRow> + Send + Unpin,
    {
        let permit = self.inner.permits.acquire().await;
        let _permit = permit.map_err(|_closed| sqlx::Error::PoolClosed)?;
        let idle = self.inner.idle().pop();
        let is_new = idle.is_none();
        let mut opened = match idle {
            Some(opened) => opened,
            None => self.inner.connect().await?,
        };
        let running = sqlx::query_as(statement).fetch_one(opened.connection()?);
        let ran = running.await;
        // SQLite has answered, so the connection can be used further.
        if matches!(ran, Ok(_) | Err(sqlx::Error::Database(_))) {
            self.inner.return_idle(opened);
        } else if !is_new {
            // The connection's thread had ended after the statement before.
            let mut opened = self.inner.connect().await?;
            let row = sqlx::query_as(statement).fetch_one(opened.connection()?);
            let row = row.await?;
            self.inner.return_idle(opened);
            return Ok(row);
        }
        ran
    }

    /// Reserves a connection without using it: with a pool of one, nobody else has any meanwhile.
    ///
    /// # Errors
    /// No connection became free in time, or the pool is closed.
    pub(super) async fn reserve(&self) -> Result<OwnedSemaphorePermit, sqlx::Error> {
        let waiting = Arc::clone(&self.inner.permits).acquire_owned();
        timeout(ACQUIRE_TIMEOUT, waiting)
            .await
            .map_err(|_elapsed| sqlx::Error::PoolTimedOut)?
            .map_err(|_closed| sqlx::Error::PoolClosed)
    }

    /// Runs work on one connection before any transaction begins.
    pub(super) async fn with_first<T>(
        &self,
        work: impl AsyncFnOnce(&mut SqliteConnection) -> T,
    ) -> Result<T, sqlx::Error> {
        let idle = self.inner.take_idle();
        let mut opened = match idle {
            Some(opened) => opened,
            None => self.inner.connect().await?,
        };
        let worked = work(opened.connection()?).await;
        self.inner.return_idle(opened);
        Ok(worked)
    }

    /// Closes all connections after their present work, waiting at most [`CLOSE_TIMEOUT`].
    pub(super) async fn close(&self) {
        let Inner {
            connections_max,
            permits,
            threads,
            ..
        } = &*self.inner;
        // A connection that is not returned in time is closed by its user.
        let _ = timeout(CLOSE_TIMEOUT, permits.acquire_many(*connections_max)).await;
        permits.close();
        let idle = std::mem::take(&mut *self.inner.idle());
        for opened in idle {
            let _ = timeout(CLOSE_TIMEOUT, opened.close()).await;
        }
        // Closing the last connection checkpoints the write-ahead log.
        let all = threads.acquire_many(connections_max.saturating_add(SPARE_MAX));
        let _ = timeout(CLOSE_TIMEOUT, all).await;
        threads.close();
    }
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
        let thread = Arc::clone(&self.threads).acquire_owned();
        let thread = timeout(THREAD_TIMEOUT, thread)
            .await
            .map_err(|_elapsed| sqlx::Error::PoolTimedOut)?
            .map_err(|_closed| sqlx::Error::PoolClosed)?;
        // Its age counts from before it was opened: it reads the file while opening.
        let at = Instant::now();
        let options = self.options.clone();
        #[expect(
            clippy::disallowed_methods,
            reason = "ends when the connection is open; whoever waits may go away, and its thread must be counted"
        )]
        let opening = tokio::spawn(async move {
            let connection = options.connect().await?;
            Ok(Opened {
                connection: Some(connection),
                thread: Some(thread),
                at,
            })
        });
        timeout(ACQUIRE_TIMEOUT, opening)
            .await
            .map_err(|_elapsed| sqlx::Error::PoolTimedOut)?
            .unwrap_or(Err(sqlx::Error::WorkerCrashed))
    }
}

impl TransactionConnection {
    /// Commits the transaction.
    ///
    /// # Errors
    /// SQLite failed; the connection is closed, and nothing is written. After a timeout the outcome
    /// is unknown.
    pub(super) async fn commit(mut self) -> Result<(), sqlx::Error> {
        let Some(mut opened) = self.opened.take() else {
            return Err(sqlx::Error::WorkerCrashed);
        };
        let committing = sqlx::query("COMMIT").execute(opened.connection()?);
        timeout(self.inner.commit_max, committing)
            .await
            .map_err(|_elapsed| sqlx::Error::WorkerCrashed)??;
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
            let is_over = match opened.connection() {
                Ok(connection) => {
                    let rolling_back = sqlx::query("ROLLBACK").execute(connection);
                    matches!(timeout(ROLLBACK_TIMEOUT, rolling_back).await, Ok(Ok(_)))
                }
                Err(_gone) => false,
            };
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
    type Target = SqliteConnection;

    fn deref(&self) -> &SqliteConnection {
        let opened = self.opened.as_ref();
        let connection = opened.and_then(|opened| opened.connection.as_ref());
        connection.expect("only a commit takes it, with the whole")
    }
}

impl DerefMut for TransactionConnection {
    fn deref_mut(&mut self) -> &mut SqliteConnection {
        let opened = self.opened.as_mut();
        let connection = opened.and_then(|opened| opened.connection.as_mut());
        connection.expect("only a commit takes it, with the whole")
    }
}

/// Returns the outcome of a commit that ended so.
pub(super) fn outcome_of(committed: &Result<(), sqlx::Error>) -> Outcome {
    match committed {
        Ok(()) => Outcome::Written,
        // SQLite itself reports that it did not commit.
        Err(sqlx::Error::Database(_)) => Outcome::Nothing,
        Err(_) => Outcome::Unknown,
    }
}
