//! What memory mirrors of the database, read again after a commit of which nobody knows what became.
//!
//! ```text
//!  commit ─► written ──────────────────► memory changes, in the same task
//!         ├► nothing written ──────────► memory stays
//!         └► SQLite did not answer ────► no sums change until that commit has ended, in whatever
//!                                        way, and memory was read again
//! ```

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::{App, AppError};

/// How long after a failure memory is read again.
const RETRY: Duration = Duration::from_secs(1);
/// How long reading it may take.
const READ_MAX: Duration = Duration::from_mins(10);

/// Reads memory again when it must be, until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = app.db().outcome_unknown() => {}
        }
        loop {
            let settling = tokio::time::timeout(READ_MAX, app.settle_outcomes());
            let settled = tokio::select! {
                biased;
                () = stop.cancelled() => return,
                settled = settling => settled.unwrap_or_else(|_elapsed| Err(sqlx::Error::WorkerCrashed.into())),
            };
            let Err(cause) = settled else { break };
            app.log_failure("read again what memory mirrors of the database", &cause);
            tokio::select! {
                biased;
                () = stop.cancelled() => return,
                () = tokio::time::sleep(RETRY) => {}
            }
        }
    }
}

impl App {
    /// Waits until every commit before has ended, and reads again what memory mirrors.
    ///
    /// Of tokens and sessions memory keeps nothing that it does not look up again by itself.
    ///
    /// # Errors
    /// The database failed, or such a commit goes on.
    pub async fn settle_outcomes(&self) -> Result<(), AppError> {
        let unknown = self.db().unknown_outcomes();
        self.db().await_commits().await?;
        self.load_map_again(unknown).await?;
        self.know_enrolments().await?;
        self.know_robots().await?;
        self.robots_changed();
        self.wake();
        Ok(())
    }
}
