//! Transactions: what happens with and after their commit.

use std::ops::{Deref, DerefMut};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::Notify;
use tokio::time::Instant;
use tread_store::metrics::DatabaseMetrics;
use tread_store::{DbError, Outcome};

use super::connections::{TransactionConnection, outcome_of};
use super::{Connection, EngineError};

/// A transaction on the database, rolled back unless it is committed.
#[derive(Debug)]
pub struct Tx {
    pub(super) inner: TransactionConnection,
    pub(super) duration_recorder: DurationRecorder,
    pub(super) commits: Arc<Commits>,
    /// Whether its commit increments the generation.
    pub(super) is_counted: bool,
}

/// Counts of commits.
#[derive(Debug, Default)]
pub(super) struct Commits {
    pub(super) generation: AtomicU64,
    pub(super) unknown: AtomicU64,
    pub(super) became_unknown: Notify,
}

/// Records the duration of a transaction when it ends.
#[derive(Debug)]
pub(super) struct DurationRecorder {
    pub(super) metrics: DatabaseMetrics,
    pub(super) kind: &'static str,
    pub(super) writes: bool,
    pub(super) began_at: Instant,
}

impl Drop for DurationRecorder {
    fn drop(&mut self) {
        let took = self.began_at.elapsed();
        self.metrics.transaction(self.kind, self.writes, took);
    }
}

impl Tx {
    /// Commits the transaction.
    ///
    /// # Errors
    /// The engine failed; nothing is written, or the outcome is unknown.
    pub async fn commit(self) -> Result<(), DbError> {
        self.commit_then(|_outcome| {}).await
    }

    /// Commits the transaction and then calls `then` with the outcome. Both are one task of its
    /// own, so cancellation of the caller interrupts neither.
    ///
    /// # Errors
    /// As [`Tx::commit`].
    pub async fn commit_then(
        self,
        then: impl FnOnce(Outcome) + Send + 'static,
    ) -> Result<(), DbError> {
        let Self {
            inner,
            duration_recorder,
            commits,
            is_counted,
        } = self;
        #[expect(
            clippy::disallowed_methods,
            reason = "ends with the commit; whoever waits for it may go away, and what follows it must not be left out"
        )]
        let committing = tokio::spawn(async move {
            let committed = inner.commit().await;
            let outcome = outcome_of(&committed);
            if is_counted {
                commits.generation.fetch_add(1, Ordering::AcqRel);
            }
            if outcome == Outcome::Unknown {
                commits.unknown.fetch_add(1, Ordering::AcqRel);
            }
            then(outcome);
            if outcome == Outcome::Unknown {
                commits.became_unknown.notify_one();
            }
            drop(duration_recorder);
            committed
        });
        committing
            .await
            .unwrap_or(Err(sqlx::Error::WorkerCrashed))
            .map_err(|cause| EngineError::from(cause).into())
    }
}

impl Deref for Tx {
    type Target = Connection;

    fn deref(&self) -> &Connection {
        &self.inner
    }
}

impl DerefMut for Tx {
    fn deref_mut(&mut self) -> &mut Connection {
        &mut self.inner
    }
}
