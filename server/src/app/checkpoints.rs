//! Checkpoints the database's write-ahead log in small steps, so that no commit, and no receipt
//! that depends on one, waits for a large checkpoint.

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::App;
use crate::db;

/// Interval between two checkpoints.
const CHECKPOINT_EVERY: Duration = Duration::from_millis(250);

/// Checkpoints the log periodically until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    while !stop.is_cancelled() {
        if let Err(cause) = db::limited(app.db().checkpoint()).await {
            app.log_failure("bring the database's log into its file", &cause);
        }
        tokio::select! {
            () = stop.cancelled() => {}
            () = tokio::time::sleep(CHECKPOINT_EVERY) => {}
        }
    }
}
