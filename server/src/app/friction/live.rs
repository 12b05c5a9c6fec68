//! Publishes the changed areas of maps, on the feed of events and to subscribers on the network.
//!
//! Changes are collected per block of cells and published once per period, so the size of an event
//! does not depend on the robots' speed.

use std::collections::HashMap;
use std::time::Duration;

use tokio::sync::broadcast;
use tokio_util::sync::CancellationToken;
use tread_api::friction::{CellBox, MapChange};
use tread_api::rights::Scope;

use super::{App, AppError};
use crate::app::sites::SITES_MAX;
use crate::db;
use crate::db::sites::SiteRow;

/// Minimum interval between two messages about one site.
pub const PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of boxes in one message; beyond it the message says that everything may have
/// changed.
pub const BOXES_MAX: usize = 256;
/// Number of messages buffered for a subscriber on the network; one that falls behind is notified
/// that it missed some.
const WAITING_MAX: usize = 64;

/// Channel for messages about maps to subscribers other than the feed of events.
#[derive(Debug)]
pub(in crate::app) struct MapUpdates(broadcast::Sender<MapChange>);

impl Default for MapUpdates {
    fn default() -> Self {
        Self(broadcast::channel(WAITING_MAX).0)
    }
}

/// State of a site's map that was published last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct PublishedVersion {
    change: u64,
    terrain_revision: u64,
}

/// Publishes changes of maps until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let mut announced = HashMap::new();
    loop {
        if let Err(cause) = db::limited(app.publish_changes(&mut announced)).await {
            app.log_failure("tell where the map has changed", &cause);
        }
        tokio::select! {
            () = stop.cancelled() => break,
            () = tokio::time::sleep(PERIOD) => {}
        }
    }
}

impl App {
    /// Subscribes to changes of maps from now on.
    pub fn map_changes(&self) -> broadcast::Receiver<MapChange> {
        self.map_updates().0.subscribe()
    }

    async fn publish_changes(
        &self,
        announced: &mut HashMap<i64, PublishedVersion>,
    ) -> Result<(), AppError> {
        let mut tx = self.db().read("friction").await?;
        let rows = db::sites::list(&mut tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
        drop(tx);
        for row in rows {
            let present = PublishedVersion {
                change: self.maps().with_map(&row, |map| map.changes().newest()),
                terrain_revision: row.site.terrain_revision,
            };
            let Some(before) = announced.insert(row.pk, present) else {
                continue;
            };
            if before != present {
                let change = self.change_since(&row, before);
                self.hub().map(&change);
                // Fails only without subscribers.
                let _ = self.map_updates().0.send(change);
            }
        }
        Ok(())
    }

    fn change_since(&self, row: &SiteRow, before: PublishedVersion) -> MapChange {
        let mut boxes: Vec<CellBox> = self.maps().with_map(row, |map| {
            let changed = map.changes().blocks();
            let changed = changed.filter(|(_, newest)| *newest > before.change);
            let boxes = changed.map(|(block, _)| CellBox {
                min: block.first(),
                max: block.last(),
            });
            boxes.take(BOXES_MAX + 1).collect()
        });
        let is_drawn_anew = row.site.terrain_revision != before.terrain_revision;
        let entire_map = is_drawn_anew || boxes.len() > BOXES_MAX;
        if entire_map {
            boxes.clear();
        }
        MapChange {
            site: row.site.id.clone(),
            at: self.clock().now(),
            grid_revision: row.site.grid.revision,
            terrain_revision: row.site.terrain_revision,
            entire_map,
            boxes,
        }
    }
}
