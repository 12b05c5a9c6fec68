//! A few connections to the database, lent for one transaction each.
//!
//! This is no general pool, because what matters here is that no failure is final. A connection
//! comes back only after a commit or a rollback that succeeded; otherwise it is closed, and the next
//! transaction opens another. Nothing waits without a bound: when the library's thread of a
//! connection ends without memory, what is sent to it meanwhile is never answered.

use std::ops::{Deref, DerefMut};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions as _, Connection as _, SqliteConnection};
use tokio::runtime::Handle;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout};

use super::failure;

/// How long a request waits for a connection.
pub(super) const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a transaction may take to begin: longer than SQLite waits for another process's lock.
const BEGIN_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a commit may take, with its sync.
const COMMIT_TIMEOUT: Duration = Duration::from_secs(15);
/// How long a rollback may take before its connection is closed instead.
const ROLLBACK_TIMEOUT: Duration = Duration::from_secs(2);
/// How long connections may take to come back and to close.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(5);

/// Connections with the same options; clones are handles to the same.
#[derive(Debug, Clone)]
pub(super) struct Connections {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    options: SqliteConnectOptions,
    connections_max: u32,
    permits: Arc<Semaphore>,
    idle: Mutex<Vec<Opened>>,
}

#[derive(Debug)]
struct Opened {
    connection: SqliteConnection,
    at: Instant,
}

impl Opened {
    /// Whether a failure since it was opened may have spoiled it.
    fn is_spoiled(&self) -> bool {
        failure::is_older_than_last(self.at.elapsed())
    }
}

/// A connection in a transaction; dropped without [`Lent::commit`] it is rolled back.
#[derive(Debug)]
pub(super) struct Lent {
    opened: Option<Opened>,
    permit: Option<OwnedSemaphorePermit>,
    inner: Arc<Inner>,
}

impl Connections {
    /// Opens the first of at most so many connections.
    pub(super) async fn open(
        options: SqliteConnectOptions,
        connections_max: u32,
    ) -> Result<Self, sqlx::Error> {
        let permits = usize::try_from(connections_max).unwrap_or(Semaphore::MAX_PERMITS);
        let inner = Inner {
            options,
            connections_max,
            permits: Arc::new(Semaphore::new(permits)),
            idle: Mutex::default(),
        };
        let first = inner.connect().await?;
        inner.idle().push(first);
        // A file that is gone later, as with its disk, is not made anew.
        let options = inner.options.create_if_missing(false);
        Ok(Self {
            inner: Arc::new(Inner { options, ..inner }),
        })
    }

    /// Begins a transaction with a statement of SQLite's.
    ///
    /// # Errors
    /// No connection became free in time, or SQLite failed.
    pub(super) async fn begin(&self, statement: &'static str) -> Result<Lent, sqlx::Error> {
        let waiting = Arc::clone(&self.inner.permits).acquire_owned();
        let permit = timeout(ACQUIRE_TIMEOUT, waiting)
            .await
            .map_err(|_elapsed| sqlx::Error::PoolTimedOut)?
            .map_err(|_closed| sqlx::Error::PoolClosed)?;
        let mut opened = match self.inner.take_idle() {
            Some(opened) => opened,
            None => self.inner.connect().await?,
        };
        // Whoever goes away meanwhile takes the connection along.
        let beginning = sqlx::query(statement).execute(&mut opened.connection);
        timeout(BEGIN_TIMEOUT, beginning)
            .await
            .map_err(|_elapsed| sqlx::Error::WorkerCrashed)??;
        Ok(Lent {
            opened: Some(opened),
            permit: Some(permit),
            inner: Arc::clone(&self.inner),
        })
    }

    /// Runs a statement outside of any transaction. Its connection stays open also if the statement
    /// fails, unless it is broken.
    ///
    /// # Errors
    /// As [`Connections::begin`].
    pub(super) async fn run(&self, statement: &'static str) -> Result<(), sqlx::Error> {
        let permit = self.inner.permits.acquire().await;
        let _permit = permit.map_err(|_closed| sqlx::Error::PoolClosed)?;
        let idle = self.inner.idle().pop();
        let is_new = idle.is_none();
        let mut opened = match idle {
            Some(opened) => opened,
            None => self.inner.connect().await?,
        };
        let ran = sqlx::query(statement).execute(&mut opened.connection).await;
        // SQLite has answered, so the connection goes on.
        if matches!(ran, Ok(_) | Err(sqlx::Error::Database(_))) {
            self.inner.idle().push(opened);
        } else if !is_new {
            // Its thread had ended after the statement before.
            let mut opened = self.inner.connect().await?;
            sqlx::query(statement)
                .execute(&mut opened.connection)
                .await?;
            self.inner.idle().push(opened);
            return Ok(());
        }
        ran.map(|_done| ())
    }

    /// Works with one connection before there are any transactions.
    pub(super) async fn with_first<T>(
        &self,
        work: impl AsyncFnOnce(&mut SqliteConnection) -> T,
    ) -> Result<T, sqlx::Error> {
        let idle = self.inner.take_idle();
        let mut opened = match idle {
            Some(opened) => opened,
            None => self.inner.connect().await?,
        };
        let worked = work(&mut opened.connection).await;
        self.inner.idle().push(opened);
        Ok(worked)
    }

    /// Closes all connections after what they are doing, if that ends.
    pub(super) async fn close(&self) {
        let Inner {
            connections_max,
            permits,
            ..
        } = &*self.inner;
        // What does not come back is closed by whoever has it.
        let _ = timeout(CLOSE_TIMEOUT, permits.acquire_many(*connections_max)).await;
        permits.close();
        let idle = std::mem::take(&mut *self.inner.idle());
        for opened in idle {
            let _ = timeout(CLOSE_TIMEOUT, opened.connection.close()).await;
        }
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

    async fn connect(&self) -> Result<Opened, sqlx::Error> {
        // It is as old as what it has read while it was opened.
        let at = Instant::now();
        let connection = timeout(ACQUIRE_TIMEOUT, self.options.connect())
            .await
            .map_err(|_elapsed| sqlx::Error::PoolTimedOut)??;
        Ok(Opened { connection, at })
    }
}

impl Lent {
    /// Commits.
    ///
    /// # Errors
    /// SQLite failed; the connection is closed, and nothing is written. After a commit that did not
    /// end in time nobody knows.
    pub(super) async fn commit(mut self) -> Result<(), sqlx::Error> {
        let Some(mut opened) = self.opened.take() else {
            return Err(sqlx::Error::WorkerCrashed);
        };
        let committing = sqlx::query("COMMIT").execute(&mut opened.connection);
        timeout(COMMIT_TIMEOUT, committing)
            .await
            .map_err(|_elapsed| sqlx::Error::WorkerCrashed)??;
        self.inner.idle().push(opened);
        Ok(())
    }
}

impl Drop for Lent {
    fn drop(&mut self) {
        let Some(mut opened) = self.opened.take() else {
            return;
        };
        // Without a runtime the connection is closed, which rolls back too.
        let Ok(runtime) = Handle::try_current() else {
            return;
        };
        let (inner, permit) = (Arc::clone(&self.inner), self.permit.take());
        runtime.spawn(async move {
            let rolling_back = sqlx::query("ROLLBACK").execute(&mut opened.connection);
            let is_over = matches!(timeout(ROLLBACK_TIMEOUT, rolling_back).await, Ok(Ok(_)));
            if is_over && !opened.is_spoiled() {
                inner.idle().push(opened);
            } else {
                drop(opened);
            }
            drop(permit);
        });
    }
}

impl Deref for Lent {
    type Target = SqliteConnection;

    fn deref(&self) -> &SqliteConnection {
        let opened = self.opened.as_ref();
        &opened
            .expect("only a commit takes it, with the whole")
            .connection
    }
}

impl DerefMut for Lent {
    fn deref_mut(&mut self) -> &mut SqliteConnection {
        let opened = self.opened.as_mut();
        &mut opened
            .expect("only a commit takes it, with the whole")
            .connection
    }
}
