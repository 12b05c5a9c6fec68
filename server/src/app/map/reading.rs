//! Reads the map into memory: the stored sums, and the segments that follow each robot's watermark.

use std::collections::HashMap;
use std::pin::pin;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use futures_util::TryStreamExt as _;
use tread_api::rights::Scope;

use super::block_memory::BlockMemory;
use super::names::Names;
use super::unwritten::Unwritten;
use super::{Maps, Sites};
use crate::app::App;
use crate::db::segments::{Added, RobotCursor};
use crate::db::{self, DbError, Tx};
use crate::friction::index::SiteMap;

/// Number of sums after which cells leave memory if all together need too much of it.
const EVICT_EVERY: usize = 10_000;

/// Sums that were read, with what they refer to.
struct LoadedSums {
    sites: Sites,
    unwritten: Unwritten,
    names: Names,
    watermarks: HashMap<i64, i64>,
}

impl App {
    /// Reads all sums into memory, and the runs of which raw measurements were removed.
    ///
    /// # Errors
    /// The database failed.
    pub async fn load_map(&self) -> Result<(), DbError> {
        self.load_map_again(self.db().unknown_outcomes()).await
    }

    /// Reads everything again when `ended` commits of unknown outcome have ended. No sums change
    /// meanwhile.
    ///
    /// # Errors
    /// The database failed; memory is unchanged.
    pub(in crate::app) async fn load_map_again(&self, ended: u64) -> Result<(), DbError> {
        let mut order = Arc::clone(&self.maps().order).lock_owned().await;
        let maps = self.maps();
        let mut following = match maps.follower() {
            Some(follower) => Some(follower.turn().await),
            None => None,
        };
        let mut tx = self.db().read("map").await?;
        let now = self.clock().elapsed();
        let empty = match following {
            Some(_) => Unwritten::of_ranges(),
            None => Unwritten::default(),
        };
        let read = read(&mut tx, now, (&maps.memory, empty)).await?;
        self.removed().extend(db::removed::boots(&mut tx).await?);
        if let Some(following) = &mut following {
            let leader = db::leader::get(&mut tx).await?;
            let last = db::segment_ranges::last(&mut tx).await?;
            let (last_pk, _) = last.unwrap_or_default();
            self.db().set_generation(leader.generation);
            let (names, watermarks) = (read.names, read.watermarks);
            following.begin(last_pk, leader, (names, watermarks));
        }
        drop(tx);
        maps.replace(read.sites, read.unwritten);
        *order = ended;
        Ok(())
    }
}

impl Maps {
    /// Replaces the maps by those read from the database.
    fn replace(&self, mut read: Sites, mut read_unwritten: Unwritten) {
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        for (pk, before) in sites.maps.drain() {
            match read.maps.get_mut(&pk) {
                Some(map) => map.follow(&before),
                None => {
                    read.maps.insert(pk, before);
                }
            }
        }
        *sites = read;
        let mut unwritten = self.unwritten();
        read_unwritten.follow(&mut unwritten);
        *unwritten = read_unwritten;
    }
}

/// Reads all sums. Cells stay in memory as far as there is room; a block that has left it once gets
/// no further sums, so it is read again as a whole when it is needed.
async fn read(
    tx: &mut Tx,
    now: Duration,
    (memory, mut unwritten): (&BlockMemory, Unwritten),
) -> Result<LoadedSums, DbError> {
    let mut sites = Sites::default();
    let mut after = String::new();
    loop {
        let rows = db::sites::list(tx, &Scope::EVERYWHERE, &after, 100).await?;
        let Some(last) = rows.last() else { break };
        after = last.site.id.to_string();
        for row in &rows {
            sites.ensure(row);
        }
    }
    let names = Names::read(tx).await?;
    let mut added = 0_usize;
    db::sums::each(tx, |row| {
        // The foreign keys of a sum guarantee both names.
        if let Some(folded) = names.named(row.key, row.sums) {
            sites.add(std::slice::from_ref(&folded), SiteMap::load_cells);
            added += 1;
            if added.is_multiple_of(EVICT_EVERY) {
                memory.evict(&mut sites);
            }
        }
    })
    .await?;
    let watermarks = db::watermarks::all(tx).await?;
    unwritten.start_at(watermarks.clone());
    for (robot_pk, last_pk) in db::segment_ranges::last_keys(tx).await? {
        let watermark = watermarks.get(&robot_pk).copied().unwrap_or_default();
        // A damaged table of measurements does not keep a server from starting that needs none.
        if last_pk <= watermark {
            continue;
        }
        let cursor = RobotCursor {
            robot_pk,
            after: watermark,
        };
        let mut following = pin!(db::segments::of_robot(tx, cursor));
        while let Some(row) = following.try_next().await? {
            // What was committed together is stored together.
            let keys = Added {
                first: row.range_pk,
                last: row.pk,
            };
            let Some(folded) = names.folded(row)? else {
                unwritten.cover(robot_pk, keys);
                continue;
            };
            unwritten.add([(&folded.key, &*folded.cells)], keys, now);
            sites.add(std::slice::from_ref(&folded), SiteMap::load_cells);
            added += 1;
            if added.is_multiple_of(EVICT_EVERY) {
                memory.evict(&mut sites);
            }
        }
    }
    memory.evict(&mut sites);
    Ok(LoadedSums {
        sites,
        unwritten,
        names,
        watermarks,
    })
}
