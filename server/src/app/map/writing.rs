//! Stores unwritten sums behind the receipts, with the watermarks of their robots.
//!
//! A failure loses nothing: sums stay unwritten until a commit is known to have stored them, and
//! after a commit of unknown outcome memory is read again.

use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::unwritten::TRANSACTION_SUMS;
use super::{MapChange, UnwrittenCounts};
use crate::app::App;
use crate::db::{self, DbError};

/// Interval at which unwritten sums are stored.
const WRITE_EVERY: Duration = Duration::from_secs(10);

/// Stores unwritten sums periodically until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = tokio::time::sleep(WRITE_EVERY) => {}
        }
        app.try_to_write_sums().await;
    }
}

impl App {
    /// Stores all sums that are unwritten now; logs a failure, after which they are stored later.
    pub(crate) async fn try_to_write_sums(&self) {
        if let Err(cause) = self.write_sums().await {
            self.log_failure("store the sums of the map", &cause);
        }
    }

    /// Stores all sums that are unwritten now, some in each transaction.
    ///
    /// # Errors
    /// The database failed; the sums of some robots may be stored.
    pub async fn write_sums(&self) -> Result<(), DbError> {
        let mut until = None;
        while db::limited(self.write_some_sums(&mut until)).await? {}
        Ok(())
    }

    /// Stores some of the sums that have been unwritten since the addition `until`, which is the last
    /// one if it is `None`. Returns whether there may be more.
    async fn write_some_sums(&self, until: &mut Option<u64>) -> Result<bool, DbError> {
        let turn = self.lock_map_for_write().await?;
        let portion = {
            let unwritten = self.maps().unwritten();
            let until = *until.get_or_insert(unwritten.additions());
            unwritten.portion(until, TRANSACTION_SUMS)
        };
        if portion.steps.is_empty() {
            return Ok(false);
        }
        let mut tx = self.db().write_uncounted("sums").await?;
        db::sums::add(&mut tx, portion.sums.iter().map(|(key, sums)| (key, sums))).await?;
        for &step in &portion.steps {
            db::watermarks::advance(&mut tx, step).await?;
        }
        let change = MapChange::Store(portion.steps);
        turn.commit(tx, change, Vec::new()).await?;
        Ok(true)
    }

    /// Returns how much is unwritten.
    pub fn unwritten_sums(&self) -> UnwrittenCounts {
        self.maps().unwritten().counts()
    }

    /// Stores some sums while so many are unwritten that no receipt may add to them.
    ///
    /// # Errors
    /// As [`App::write_sums`].
    pub(in crate::app) async fn bound_unwritten_sums(&self) -> Result<(), DbError> {
        let mut until = None;
        let is_full = || self.maps().unwritten().is_full();
        while is_full() && db::limited(self.write_some_sums(&mut until)).await? {}
        Ok(())
    }

    /// Returns a key at or before that of the first raw measurement that is not in the stored sums
    /// and has to be added to them; `None` if there is none.
    pub(in crate::app) fn first_unwritten_key(&self) -> Option<i64> {
        self.maps().unwritten().first_key()
    }
}
