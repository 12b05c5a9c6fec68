//! Retention of raw measurements, limited in age and number; their sums, and with them the map, are
//! kept for ever.
//!
//! The oldest are removed first, a few at a time. Each transaction removes some and records their
//! names (`boot`, `seq`), so that one that is sent again after years is still recognised. None is
//! removed before its sum is stored. If this is interrupted, the map stays the same. With an archive
//! ([`super::archive`]) none is removed before it is in there either.

use std::collections::HashSet;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use jiff::SignedDuration;
use tokio_util::sync::CancellationToken;

use super::archive::FILE_ROWS_MAX;
use super::map::MapChange;
use super::{App, AppError};
use crate::archive::KeyRange;
use crate::config::RetentionConfig;
use crate::db;
use crate::friction::epochs::DAY_H;

/// Interval at which the server checks for measurements to remove.
const CHECK_EVERY: Duration = Duration::from_mins(10);
/// Maximum number of measurements removed in one transaction; other writers proceed in between.
const REMOVED_MAX: u32 = 2_000;

/// Runs with removed measurements: only their uploads are compared with the recorded names.
#[derive(Debug, Default)]
pub(super) struct Removed {
    boots: Mutex<HashSet<i64>>,
}

impl Removed {
    pub(super) fn has(&self, boot_pk: i64) -> bool {
        let boots = self.boots.lock().unwrap_or_else(PoisonError::into_inner);
        boots.contains(&boot_pk)
    }

    pub(super) fn extend(&self, found: impl IntoIterator<Item = i64>) {
        let mut boots = self.boots.lock().unwrap_or_else(PoisonError::into_inner);
        boots.extend(found);
    }
}

/// Removes measurements periodically until the stop.
pub async fn run(app: App, config: RetentionConfig, stop: CancellationToken) {
    loop {
        let removing = app.archive_and_remove(&config, FILE_ROWS_MAX, &stop);
        if let Err(cause) = removing.await {
            tracing::error!("cannot remove old measurements: {cause:?}");
        }
        tokio::select! {
            () = stop.cancelled() => break,
            () = tokio::time::sleep(CHECK_EVERY) => {}
        }
    }
}

impl App {
    /// Archives, if an archive is configured, and removes all measurements beyond the limits of age or
    /// number. A failure of the archive raises an alert. `file_rows_max` is
    /// [`FILE_ROWS_MAX`], and less in tests.
    ///
    /// # Errors
    /// The database failed.
    pub async fn archive_and_remove(
        &self,
        config: &RetentionConfig,
        file_rows_max: u32,
        stop: &CancellationToken,
    ) -> Result<(), AppError> {
        let mut removed = 0;
        let ended = self.remove_all(config, file_rows_max, stop, &mut removed);
        let ended = ended.await;
        if removed > 0 {
            tracing::info!("{removed} raw measurements were removed after their time");
        }
        match ended {
            Err(AppError::Archive(cause)) => self.show_archived(Some(&cause)),
            Err(cause) => return Err(cause),
            Ok(()) => self.show_archived(None),
        }
        Ok(())
    }

    async fn remove_all(
        &self,
        config: &RetentionConfig,
        file_rows_max: u32,
        stop: &CancellationToken,
        removed: &mut u64,
    ) -> Result<(), AppError> {
        if let Err(cause) = self.release_removed().await {
            // Measurements are archived and removed nevertheless.
            self.log_failure("drop the partitions of removed measurements", &cause);
        }
        tokio::select! {
            () = stop.cancelled() => return Ok(()),
            prepared = self.prepare_archive() => prepared?,
        }
        while !stop.is_cancelled() {
            let Some(next) = db::limited(self.due(config, REMOVED_MAX)).await? else {
                break;
            };
            let archive = self.archive();
            if archive.is_some_and(|archive| archive.removable_to(next.first).is_none()) {
                let due = db::limited(self.due(config, file_rows_max)).await?;
                let Some(due) = due else { break };
                tokio::select! {
                    () = stop.cancelled() => break,
                    archived = self.archive_due(due, file_rows_max) => archived?,
                }
            }
            let some = db::limited(self.remove_some(config, REMOVED_MAX)).await?;
            *removed += some;
            if some == 0 {
                break;
            }
        }
        Ok(())
    }

    /// Lets the database release the space of the measurements that were removed in earlier passes: no
    /// reader has a snapshot from before their removal any more.
    async fn release_removed(&self) -> Result<(), AppError> {
        let mut tx = self.db().write_uncounted("retention").await?;
        match db::removed::release_removed(&mut tx).await? {
            Some(0) => Ok(()),
            Some(partitions) => {
                tracing::info!("{partitions} partitions of removed measurements were dropped");
                Ok(tx.commit().await?)
            }
            None => {
                tracing::info!(
                    "readers use the partitions of removed measurements: they are dropped later"
                );
                Ok(())
            }
        }
    }

    /// Returns the keys of at most `limit` measurements beyond the limits of age or number.
    async fn due(
        &self,
        config: &RetentionConfig,
        limit: u32,
    ) -> Result<Option<KeyRange>, AppError> {
        let mut tx = self.db().read("retention").await?;
        let now = self.clock().now();
        let kept = SignedDuration::from_hours(i64::from(config.segments_days) * DAY_H);
        let before = now.checked_sub(kept).unwrap_or(jiff::Timestamp::MIN);
        let Some((first, last)) = db::segment_ranges::ends(&mut tx).await? else {
            return Ok(None);
        };
        let until = first.saturating_add(i64::from(limit)) - 1;
        let old = db::removed::last_before(&mut tx, before, until).await?;
        // Keys have no gaps, since only the first ones are ever removed. The last one stays, so that
        // keys, which are cursors of lists, never restart.
        let over = last.saturating_sub(config.segments_max);
        let last = until.min(over.max(old.unwrap_or_default())).min(last - 1);
        Ok((first <= last).then_some(KeyRange { first, last }))
    }

    /// Removes at most `limit` raw measurements beyond the limits of age or number, with an archive only
    /// those that are in there. Returns how many.
    ///
    /// # Errors
    /// The database failed; nothing is removed.
    pub async fn remove_some(&self, config: &RetentionConfig, limit: u32) -> Result<u64, AppError> {
        let Some(KeyRange { first, last }) = self.due(config, limit).await? else {
            return Ok(0);
        };
        let until = match self.archive() {
            Some(archive) => archive
                .removable_to(first)
                .map(|removable| last.min(removable)),
            None => Some(last),
        };
        let Some(until) = until else { return Ok(0) };
        let unwritten = self.first_unwritten_key();
        if unwritten.is_some_and(|unwritten| unwritten <= until) {
            self.write_sums().await?;
        }
        // Uploads wait meanwhile: none is between checking the names and its commit.
        let turn = self.lock_map_for_write().await?;
        let unwritten = self.first_unwritten_key();
        let until = unwritten.map_or(until, |unwritten| until.min(unwritten - 1));
        if until < first {
            return Ok(0);
        }
        let mut tx = self.db().write("retention").await?;
        let (removed, boots) = db::removed::remove(&mut tx, until).await?;
        turn.commit(tx, MapChange::Remove(boots), Vec::new())
            .await?;
        self.counters().segments_removed.add(removed);
        Ok(removed)
    }
}
