//! Brings the database's log into its file a little at a time, so that no commit has to bring in
//! much of it, and nobody who waits for a receipt waits for that.

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::App;
use crate::db;

/// Time between two looks at the log.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Brings the log in now and then until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    while !stop.is_cancelled() {
        if let Err(cause) = db::limited(app.db().checkpoint()).await {
            app.log_failure("bring the database's log into its file", &cause);
        }
        tokio::select! {
            () = stop.cancelled() => {}
            () = tokio::time::sleep(LOOK_EVERY) => {}
        }
    }
}
