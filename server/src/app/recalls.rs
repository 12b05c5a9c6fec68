//! Recalls of commands: what a person wants is not overtaken by a command that was decided before.

use std::sync::atomic::Ordering;

use super::{App, DbError};
use crate::db::Tx;

impl App {
    /// Commits a change of what a robot is to do. A command that was decided before, and is not sent yet,
    /// is decided again.
    pub(in crate::app) async fn commit_recalling(&self, tx: Tx) -> Result<(), DbError> {
        let app = self.clone();
        // Also after an unknown outcome.
        tx.commit_then(move |_outcome| app.recall()).await
    }

    /// Recalls the commands that are decided and not sent yet.
    pub(in crate::app) fn recall(&self) {
        self.inner.recalls.fetch_add(1, Ordering::AcqRel);
        self.wake();
    }

    /// Returns how often commands were recalled. To be read before the state that a command follows from,
    /// and compared right before the command is sent.
    pub(in crate::app) fn recalls(&self) -> u64 {
        self.inner.recalls.load(Ordering::Acquire)
    }
}
