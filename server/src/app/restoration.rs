//! What follows from a restoration of a backup. What happened after the backup is unknown, so
//! nothing is dispatched to a robot until an operator releases it.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use tread_api::ids::{RobotId, SiteId};
use tread_api::robot::{Robot, Severity};

use super::{App, AppError, site_row};
use crate::db;
use crate::db::restorations::{Restoration, RestrictedRobot};

/// Code of the alert about robots that await their release.
pub const AWAITING_RELEASE_ALERT: &str = "robots-await-release";

/// What memory keeps of a restoration, which only happens while no server runs.
#[derive(Debug, Default)]
pub(super) struct Restored {
    newest: OnceLock<Restoration>,
    /// Number of robots that await their release.
    awaiting: AtomicU64,
}

impl App {
    fn restored(&self) -> &Restored {
        &self.inner.restored
    }

    /// Loads the newest restoration from the database.
    ///
    /// # Errors
    /// The database failed.
    pub async fn load_restoration(&self) -> Result<(), AppError> {
        let mut tx = self.db().read("restoration").await?;
        if let Some(newest) = db::restorations::newest(&mut tx).await? {
            let awaiting = db::restorations::awaiting_count(&mut tx).await?;
            self.restored().awaiting.store(awaiting, Ordering::Relaxed);
            // It is loaded once, at the start.
            let _ = self.restored().newest.set(newest);
        }
        Ok(())
    }

    /// Returns the newest restoration, with the number of robots that await their release; `None`
    /// if this database was never restored.
    pub fn restoration(&self) -> Option<(Restoration, u64)> {
        let newest = self.restored().newest.get()?;
        let awaiting = self.restored().awaiting.load(Ordering::Relaxed);
        Some((newest.clone(), awaiting))
    }

    /// Releases a robot after a restoration: its missions are dispatched again. Does nothing if it
    /// does not await that.
    pub async fn release_robot(&self, site: &SiteId, id: &RobotId) -> Result<Robot, AppError> {
        let mut tx = self.db().write("restoration").await?;
        let site_pk = site_row(&mut tx, site).await?.pk;
        let unknown = || AppError::UnknownRobot(site.clone(), id.clone());
        let found = db::robots::find(&mut tx, site_pk, id).await?;
        let row = found.ok_or_else(unknown)?;
        if db::restorations::release(&mut tx, row.pk).await? {
            tracing::info!(robot.id = %id, "robot `{id}` was released after a restoration");
        }
        tx.commit().await?;
        self.robots_changed();
        self.wake();
        self.robot(site, id).await
    }

    /// Raises and clears the alert about robots that await their release.
    pub(super) fn show_awaiting(&self, restricted: &[RestrictedRobot]) {
        let mut awaiting = restricted.iter().filter(|robot| robot.awaits_release);
        let first = awaiting.next();
        let count = first.map_or(0, |_first| 1 + awaiting.count() as u64);
        self.restored().awaiting.store(count, Ordering::Relaxed);
        let text = first.zip(self.restored().newest.get());
        let text = text.map(|(first, restoration)| {
            format!(
                "the server was restored from a backup of {:.0}, and does not know what happened \
                 since: no mission is sent to {count} robots (`{}` is one) until they are released; \
                 look at their missions, then `tread robots release`",
                restoration.taken_at, first.robot
            )
        });
        self.set_server_alert(AWAITING_RELEASE_ALERT, Severity::Critical, text);
    }
}
