//! The lock that one server holds on a database, so that no second one works on it.

use std::future::pending;
use std::time::Duration;

use futures_util::future::Either;
use tread_store_postgres::lock::LockError as PostgresLockError;

use super::Location;

/// Reason why a server may not use a database.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// A file of SQLite cannot be locked.
    #[error(transparent)]
    Sqlite(#[from] tread_store_sqlite::lock::LockError),
    /// A PostgreSQL database cannot be locked.
    #[error(transparent)]
    Postgres(#[from] tread_store_postgres::lock::LockError),
}

/// Exclusive use of a database by this process, until it is dropped.
#[derive(Debug)]
pub enum DatabaseLock {
    /// Of a file of SQLite.
    Sqlite(tread_store_sqlite::lock::DatabaseLock),
    /// Of a PostgreSQL database.
    Postgres(tread_store_postgres::lock::DatabaseLock),
}

impl DatabaseLock {
    /// Locks a database; a file may not exist yet.
    ///
    /// # Errors
    /// [`LockError`] says who uses it, or why it cannot be locked.
    pub async fn take(location: &Location) -> Result<Self, LockError> {
        Ok(match location {
            Location::File(path) => {
                Self::Sqlite(tread_store_sqlite::lock::DatabaseLock::take(path)?)
            }
            Location::Postgres(address) => {
                Self::Postgres(tread_store_postgres::lock::DatabaseLock::take(address).await?)
            }
        })
    }

    /// As [`DatabaseLock::take`], but waits while another server has the lock of a PostgreSQL database, and
    /// takes over from one that has been silent for `silence_max`. `waiting` is called at each attempt with
    /// the reason, and whether another server has the lock.
    ///
    /// # Errors
    /// [`LockError`]: a file is in use, or the address cannot be read.
    pub async fn wait(
        location: &Location,
        silence_max: Duration,
        mut waiting: impl FnMut(&str, bool),
    ) -> Result<Self, LockError> {
        let Location::Postgres(address) = location else {
            return Self::take(location).await;
        };
        let waiting = |reason: &PostgresLockError| match reason {
            PostgresLockError::InUse { address, holder } => {
                waiting(&format!("another server{holder} uses `{address}`"), true);
            }
            PostgresLockError::Open(cause) => waiting(&cause.to_string(), false),
        };
        let lock = tread_store_postgres::lock::DatabaseLock::wait(address, silence_max, waiting);
        Ok(Self::Postgres(lock.await?))
    }

    /// Notes the epoch of this server, if its database has one: once another one has a newer epoch, this one does
    /// not take the lock again after it lost its connection.
    pub fn claimed(&self, epoch: Option<i64>) {
        if let (Self::Postgres(lock), Some(epoch)) = (self, epoch) {
            lock.claimed(epoch);
        }
    }

    /// Waits until another server has the lock, and returns why this one must stop. A file stays locked as
    /// long as it is open.
    pub fn lost(&self) -> impl Future<Output = String> + Send + 'static {
        match self {
            Self::Sqlite(_) => Either::Left(pending()),
            Self::Postgres(lock) => Either::Right(lock.lost()),
        }
    }

    /// Releases the lock.
    pub async fn release(self) {
        match self {
            Self::Sqlite(lock) => drop(lock),
            Self::Postgres(lock) => lock.release().await,
        }
    }
}

/// Returns the process of the server that holds the lock of a file; `None` if none does, or it is not
/// known.
pub fn holder_of(location: &Location) -> Option<u32> {
    location
        .file()
        .and_then(tread_store_sqlite::lock::holder_of)
}
