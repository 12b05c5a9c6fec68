//! Reads the copies of the database in memory again after a commit of unknown outcome.
//!
//! ```text
//!  commit ─► written ──────────────────► memory changes, in the same task
//!         ├► nothing written ──────────► memory stays
//!         └► SQLite did not answer ────► no sums change until that commit has ended, with success or
//!                                        not, and memory was read again
//! ```

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::{App, AppError};
use crate::db::DbError;

/// Delay before memory is read again after a failure.
const RETRY: Duration = Duration::from_secs(1);
/// Maximum time for reading memory.
const READ_MAX: Duration = Duration::from_mins(10);

/// Reads memory again whenever needed, until the stop.
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
                settled = settling => settled.unwrap_or_else(|_elapsed| Err(DbError::unanswered().into())),
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
    /// Waits until all commits of unknown outcome have ended, and reads again what memory copies.
    ///
    /// Tokens and sessions are not included: their cache reads the database periodically.
    ///
    /// # Errors
    /// The database failed, or such a commit is still under way.
    pub async fn settle_outcomes(&self) -> Result<(), AppError> {
        let unknown = self.db().unknown_outcomes();
        self.db().await_commits().await?;
        self.load_map_again(unknown).await?;
        self.load_enrolments().await?;
        self.load_robots().await?;
        self.robots_changed();
        self.wake();
        Ok(())
    }
}
