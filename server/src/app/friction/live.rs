//! Publishes where maps change: on the feed of events, and to whoever publishes it on the network.
//!
//! Changes are put together to the squares of cells in which they are counted, and published once a
//! period: an event is as long however fast robots drive.

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

/// Least time from one word about a site to the next.
pub const PERIOD: Duration = Duration::from_secs(1);
/// Most boxes of one word; where more have changed, everything may have.
pub const BOXES_MAX: usize = 256;
/// Words that wait for a listener on the network; one that misses some hears that it did.
const WAITING_MAX: usize = 64;

/// Where words about maps go besides the feed of events.
#[derive(Debug)]
pub(in crate::app) struct MapNews(broadcast::Sender<MapChange>);

impl Default for MapNews {
    fn default() -> Self {
        Self(broadcast::channel(WAITING_MAX).0)
    }
}

/// What was published last of a site.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Announced {
    change: u64,
    terrain_revision: u64,
}

/// Tells until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    let mut announced = HashMap::new();
    loop {
        if let Err(cause) = db::limited(app.tell_changes(&mut announced)).await {
            app.log_failure("tell where the map has changed", &cause);
        }
        tokio::select! {
            () = stop.cancelled() => break,
            () = tokio::time::sleep(PERIOD) => {}
        }
    }
}

impl App {
    /// Hears where maps change from now on.
    pub fn map_news(&self) -> broadcast::Receiver<MapChange> {
        self.news().0.subscribe()
    }

    async fn tell_changes(&self, announced: &mut HashMap<i64, Announced>) -> Result<(), AppError> {
        let mut tx = self.db().read("friction").await?;
        let rows = db::sites::list(&mut tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
        drop(tx);
        for row in rows {
            let present = Announced {
                change: self.maps().look(&row, |map| map.changes().newest()),
                terrain_revision: row.site.terrain_revision,
            };
            let Some(before) = announced.insert(row.pk, present) else {
                continue;
            };
            if before != present {
                let change = self.change_since(&row, before);
                self.hub().map(&change);
                // Nobody need listen.
                let _ = self.news().0.send(change);
            }
        }
        Ok(())
    }

    fn change_since(&self, row: &SiteRow, before: Announced) -> MapChange {
        let mut boxes: Vec<CellBox> = self.maps().look(row, |map| {
            let changed = map.changes().blocks();
            let changed = changed.filter(|(_, newest)| *newest > before.change);
            let boxes = changed.map(|(block, _)| CellBox {
                min: block.first(),
                max: block.last(),
            });
            boxes.take(BOXES_MAX + 1).collect()
        });
        let is_drawn_anew = row.site.terrain_revision != before.terrain_revision;
        let everything = is_drawn_anew || boxes.len() > BOXES_MAX;
        if everything {
            boxes.clear();
        }
        MapChange {
            site: row.site.id.clone(),
            at: self.clock().now(),
            grid_revision: row.site.grid.revision,
            terrain_revision: row.site.terrain_revision,
            everything,
            boxes,
        }
    }
}
