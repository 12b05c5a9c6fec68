//! Merges old hours of measurements into days, so that the map does not grow for ever.
//!
//! First a site's horizon is moved: from then on, hours before it are *read* as days, in memory and
//! after a restart. Then the rows are merged a few at a time, each time in one transaction that
//! removes hours and adds them to their day. If this is interrupted, the map stays the same. Hours
//! that are unwritten meanwhile are stored as such later, and merged with the next pass.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use tread_api::rights::Scope;

use super::map::MapChange;
use super::sites::SITES_MAX;
use super::{App, AppError};
use crate::db;
use crate::db::sums::SumKey;
use crate::friction::sums::DAY_H;
use crate::friction::{Sums, bucket_h, epoch_h};

/// Number of hours that are kept separately before their day is merged.
pub const HOURS_KEPT: i64 = 7 * DAY_H;
/// Interval at which the server checks for hours to merge.
const MERGE_EVERY: Duration = Duration::from_mins(10);
/// Maximum number of rows merged in one transaction; other writers proceed in between.
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
    while !stop.is_cancelled() && db::limited(app.merge_some(ROWS_MERGED_MAX)).await? {}
    Ok(())
}

impl App {
    /// Moves the horizon of every site, so that days older than [`HOURS_KEPT`] are read as one
    /// epoch each.
    ///
    /// # Errors
    /// The database failed.
    pub async fn move_horizons(&self) -> Result<(), AppError> {
        let horizon_h = bucket_h(epoch_h(self.clock().now()) - HOURS_KEPT, i64::MAX);
        let mut tx = self.db().read("merging").await?;
        let sites = db::sites::list(&mut tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
        drop(tx);
        for site in sites {
            if site.merged_before_h >= horizon_h {
                continue;
            }
            let turn = self.map_turn_to_change().await?;
            let mut tx = self.db().write("merging").await?;
            db::sites::merge_before(&mut tx, site.pk, horizon_h).await?;
            let change = MapChange::MergeBefore(Box::new(site), horizon_h);
            turn.commit(tx, change, Vec::new()).await?;
        }
        Ok(())
    }

    /// Merges some rows of hours before the horizon. Returns whether there may be more.
    ///
    /// # Errors
    /// The database failed.
    pub async fn merge_some(&self, limit: u32) -> Result<bool, AppError> {
        let mut tx = self.db().read("merging").await?;
        let row = db::sums::one_unmerged(&mut tx).await?;
        drop(tx);
        let Some((robot_pk, horizon_h)) = row else {
            return Ok(false);
        };
        let turn = self.map_turn_to_change().await?;
        let mut tx = self.db().write("merging").await?;
        let rows = db::sums::unmerged(&mut tx, robot_pk, horizon_h, limit).await?;
        let mut days: BTreeMap<SumKey, Sums> = BTreeMap::new();
        for row in rows {
            db::sums::remove(&mut tx, &row.key).await?;
            let key = SumKey {
                epoch_h: bucket_h(row.key.epoch_h, horizon_h),
                ..row.key
            };
            days.entry(key)
                .and_modify(|day| day.add(&row.sums))
                .or_insert(row.sums);
        }
        db::sums::add(&mut tx, days.iter()).await?;
        turn.commit(tx, MapChange::Nothing, Vec::new()).await?;
        Ok(true)
    }
}
