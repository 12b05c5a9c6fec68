//! Merges old hours of measurements into days, and old days into months, so that the map does not
//! grow for ever.
//!
//! First a site's horizons are moved: from then on, hours before one are *read* as days or months, in
//! memory and after a restart. Then the rows are merged a few at a time, each time in one transaction
//! that removes hours and adds them to their epoch. If this is interrupted, the map stays the same.
//! Hours that are unwritten meanwhile are stored as such later, and merged with the next pass.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tread_api::rights::Scope;

use super::map::MapChange;
use super::sites::SITES_MAX;
use super::{App, AppError};
use crate::db;
use crate::db::sums::{StoredHour, SumKey};
use crate::friction::{Horizons, Sums};

/// Interval at which the server checks for hours to merge.
const MERGE_EVERY: Duration = Duration::from_mins(10);
/// Maximum number of rows merged in one transaction; other writers proceed in between. Also the number of
/// hours that are looked up at a time.
const ROWS_MERGED_MAX: u32 = 500;

/// Merges periodically until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    loop {
        if let Err(cause) = merge_all(&app, &stop).await {
            tracing::error!("cannot merge old hours of the map: {cause:?}");
        }
        tokio::select! {
            () = stop.cancelled() => break,
            () = tokio::time::sleep(MERGE_EVERY) => {}
        }
    }
}

async fn merge_all(app: &App, stop: &CancellationToken) -> Result<(), AppError> {
    db::limited(app.move_horizons()).await?;
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return Ok(()),
            more = app.merge_some(ROWS_MERGED_MAX) => if !more? { return Ok(()) },
        }
    }
}

impl App {
    /// Moves the horizons of every site to those of the present time.
    ///
    /// # Errors
    /// The database failed.
    pub async fn move_horizons(&self) -> Result<(), AppError> {
        let present = Horizons::at(self.clock().now());
        let mut tx = self.db().read("merging").await?;
        let sites = db::sites::list(&mut tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
        drop(tx);
        for site in sites {
            let horizons = site.horizons.advanced_to(present);
            if horizons == site.horizons {
                continue;
            }
            let turn = self.lock_map_for_write().await?;
            let mut tx = self.db().write("merging").await?;
            db::sites::set_horizons(&mut tx, site.pk, horizons).await?;
            let change = MapChange::MergeBefore(Box::new(site), horizons);
            turn.commit(tx, change, Vec::new()).await?;
        }
        Ok(())
    }

    /// Merges at most `limit` hours before a horizon into their epochs, in transactions of at most
    /// `limit` rows. Returns whether there may be more.
    ///
    /// # Errors
    /// The database failed.
    pub async fn merge_some(&self, limit: u32) -> Result<bool, AppError> {
        let mut tx = self.db().read("merging").await?;
        let hours = db::sums::unmerged(&mut tx, limit).await?;
        drop(tx);
        let mut remaining = hours.as_slice();
        while !remaining.is_empty() {
            let merged = db::limited(self.merge_rows(remaining, limit)).await?;
            remaining = remaining.get(merged..).unwrap_or_default();
        }
        Ok(!hours.is_empty())
    }

    /// Merges at most `limit` rows of the first of these hours in one transaction. Returns the number of
    /// hours of which no row is left.
    async fn merge_rows(&self, hours: &[StoredHour], limit: u32) -> Result<usize, AppError> {
        let limit = limit as usize;
        let turn = self.lock_map_for_write().await?;
        let mut tx = self.db().write("merging").await?;
        let mut merged: BTreeMap<SumKey, Sums> = BTreeMap::new();
        let (mut taken, mut done) = (0, 0);
        for hour in hours {
            let left = limit - taken;
            if left == 0 {
                break;
            }
            let epoch = hour.horizons.epoch_of(hour.epoch_h);
            let rows = db::sums::of_hour(&mut tx, *hour, left).await?;
            taken += rows.len();
            done += usize::from(rows.len() < left);
            for row in rows {
                db::sums::remove(&mut tx, &row.key).await?;
                let key = SumKey {
                    epoch_h: epoch.first_h,
                    ..row.key
                };
                merged
                    .entry(key)
                    .and_modify(|sums| sums.add(&row.sums))
                    .or_insert(row.sums);
            }
        }
        db::sums::add(&mut tx, merged.iter()).await?;
        turn.commit(tx, MapChange::Nothing, Vec::new()).await?;
        Ok(done)
    }
}
