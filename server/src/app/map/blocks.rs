//! Loads blocks of cells into memory when a reader of the map needs them, and evicts the least recently
//! used ones when all together need too much.
//!
//! ```text
//! stored sums ──snapshot──► cells of a block ──with the unwritten sums──► map ──► evicted
//! ```
//!
//! A block is read without the [`super::MapWriteGuard`], so that uploads never wait for it. The
//! watermarks that are read in the same snapshot tell which of the unwritten sums are not in the
//! stored ones: those of generations that end after the watermark of their robot. Generations that
//! are stored meanwhile are kept until the read is over ([`super::unwritten`]). If sums were
//! removed or merged in the map meanwhile, the block is read again.

use std::collections::{BTreeSet, HashMap};
use std::sync::PoisonError;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::sync::SemaphorePermit;
use tokio_util::sync::CancellationToken;

use super::block_memory::MIB;
use super::{Maps, labelled};
use crate::app::{App, AppError};
use crate::db::sites::SiteRow;
use crate::db::sums::SumRow;
use crate::db::{self, DbError, Tx};
use crate::friction::index::{
    Block, BlockBuilder, BlockCells, Cells, MissingBlocks, Pin, SiteMap, Stamp,
};

/// One read may have so many blocks, however large: with fewer none could go from one to the next.
const READ_BLOCKS_MIN: usize = 4;
/// Maximum number of blocks that are read in one snapshot.
const BLOCKS_AT_ONCE: usize = 16;
/// Maximum number of times that a block is read because sums were removed or merged meanwhile.
const READ_AGAIN_MAX: usize = 5;
/// Minimum time between two evictions after uploads.
const EVICT_EVERY_MIN: Duration = Duration::from_millis(100);
/// Number of blocks that are evicted at a time under the lock of the map.
const EVICTED_AT_ONCE: usize = 256;

/// Memory used by the blocks of all maps, and counters since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct BlockCounts {
    /// Number of blocks with measurements.
    pub driven: usize,
    /// Number of those whose cells are in memory.
    pub in_memory: usize,
    /// About how many bytes these take.
    pub bytes: usize,
    /// Number of blocks that were read from the database.
    pub read: u64,
    /// Number of blocks that left memory.
    pub evicted: u64,
}

/// Blocks that are kept in memory as long as this exists.
#[derive(Debug, Default)]
pub(in crate::app) struct Pins {
    pins: Vec<Pin>,
    bytes: usize,
}

impl Pins {
    /// Returns whether nothing is kept.
    pub(in crate::app) fn is_empty(&self) -> bool {
        self.pins.is_empty()
    }

    /// Keeps a block in memory; `false` if it is absent.
    fn add(&mut self, map: &SiteMap, block: Block) -> bool {
        let Some((pin, bytes)) = map.pin(block) else {
            return !map.changes().contains(block);
        };
        self.pins.push(pin);
        self.bytes += bytes;
        true
    }
}

/// Blocks that were read in one snapshot.
struct Snapshot {
    stamp: Stamp,
    blocks: Vec<(Block, BlockCells)>,
    watermarks: HashMap<i64, i64>,
}

/// A read of blocks: generations of unwritten sums that are stored meanwhile are kept until it is
/// dropped.
struct Reading<'maps> {
    maps: &'maps Maps,
    number: u64,
}

impl Drop for Reading<'_> {
    fn drop(&mut self) {
        let ended = self.maps.unwritten().end_read(self.number);
        drop(ended);
    }
}

impl Maps {
    /// Reads the cells of a site's map; blocks that were absent are noted in `absent`, and then what
    /// `read` returned is to be discarded.
    pub(in crate::app) fn read_cells<T>(
        &self,
        row: &SiteRow,
        absent: &MissingBlocks,
        read: impl FnOnce(Cells<'_>) -> T,
    ) -> T {
        let number = self.memory.tick();
        self.with_map(row, |map| read(map.cells(absent, number)))
    }

    /// Takes blocks out of memory if all together need too much of it.
    pub(in crate::app) fn evict(&self) {
        let candidates = {
            let sites = self.sites.read().unwrap_or_else(PoisonError::into_inner);
            self.memory.eviction_candidates(&sites)
        };
        for some in candidates.chunks(EVICTED_AT_ONCE) {
            let taken = {
                let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
                self.memory.take(&mut sites, some)
            };
            drop(taken);
        }
    }

    /// Waits for a turn to have blocks loaded. `None` cannot occur, since the
    /// semaphores are never closed.
    pub(in crate::app) async fn load_turn(
        &self,
        is_for_robot: bool,
    ) -> Option<SemaphorePermit<'_>> {
        let turns = if is_for_robot {
            &self.memory.load_turns_of_robots
        } else {
            &self.memory.load_turns
        };
        turns.acquire().await.ok()
    }

    fn begin_read(&self) -> Reading<'_> {
        let number = self.unwritten().begin_read();
        Reading { maps: self, number }
    }

    /// Keeps those of the blocks that are in memory there, and returns the absent ones.
    fn pin(&self, row: &SiteRow, blocks: &[Block], pins: &mut Pins) -> Vec<Block> {
        self.with_map(row, |map| {
            let absent = blocks.iter().filter(|&&block| !pins.add(map, block));
            absent.copied().collect()
        })
    }

    /// Adds a stored sum to a block; `false` if a name is new to the map.
    fn build(&self, row: &SiteRow, block: &mut BlockBuilder, sum: &SumRow) -> bool {
        let sites = self.sites.read().unwrap_or_else(PoisonError::into_inner);
        let map = sites.maps.get(&row.pk);
        let named = map.zip(sites.names.of(&sum.key));
        let added = named.map(|(map, (robot, configuration))| {
            block.add(map, labelled(&sum.key, robot, configuration), &sum.sums)
        });
        added.unwrap_or_default()
    }

    /// Puts the blocks of a snapshot into memory, with the sums that are unwritten in it, and keeps them
    /// there. Returns their number; `None` if sums were removed or merged since, or if the snapshot was
    /// `followed` by a standby that is the server now.
    ///
    /// # Errors
    /// A sum has a name that the map does not know.
    fn insert(
        &self,
        row: &SiteRow,
        (snapshot, is_followed): (Snapshot, bool),
        pins: &mut Pins,
    ) -> Result<Option<usize>, DbError> {
        let Snapshot {
            stamp,
            blocks,
            watermarks,
        } = snapshot;
        let count = blocks.len();
        let mut sites = self.sites.write().unwrap_or_else(PoisonError::into_inner);
        if is_followed && self.follower().is_none() {
            return Ok(None);
        }
        let sites = &mut *sites;
        let Some(map) = sites.maps.get_mut(&row.pk) else {
            return Ok(None);
        };
        if map.stamp() != stamp {
            return Ok(None);
        }
        map.set_lru_time(self.memory.lru_time());
        let unwritten = self.unwritten();
        for (block, cells) in blocks {
            // Another reader may have loaded it meanwhile.
            if pins.add(map, block) {
                continue;
            }
            let since = unwritten.since(&watermarks, row.pk, block);
            let since = since.map(|(key, sums)| {
                let (robot, configuration) = sites.names.of(key)?;
                Some((labelled(key, robot, configuration), sums))
            });
            let since: Option<Vec<_>> = since.collect();
            map.insert(block, cells, since.ok_or_else(|| unnamed(row, block))?);
            pins.add(map, block);
        }
        Ok(Some(count))
    }
}

fn unnamed(row: &SiteRow, block: Block) -> DbError {
    DbError::Corrupt {
        what: "sum of a block whose robot or terrain is new to the map",
        value: format!(
            "{}: row {}, column {}",
            row.site.id, block.row, block.column
        ),
    }
}

impl App {
    /// Loads blocks of a map into memory, and keeps them there for one read, as long as `pins` exist:
    /// at least the first, and further ones while less than half of what it may have at once is kept.
    ///
    /// # Errors
    /// [`AppError::MapReadTooLarge`] if it has as many as it may already; [`DbError::Unsettled`] if sums
    /// are removed or merged again and again; those of the database.
    pub(in crate::app) async fn load_blocks(
        &self,
        row: &SiteRow,
        blocks: &BTreeSet<Block>,
        pins: &mut Pins,
    ) -> Result<(), AppError> {
        let maps = self.maps();
        let bytes_max = maps.memory.read_bytes_max();
        if pins.bytes > bytes_max && pins.pins.len() >= READ_BLOCKS_MIN {
            return Err(AppError::MapReadTooLarge {
                mib_max: bytes_max / MIB,
            });
        }
        let mut tries = 0;
        // The next one is the last.
        let mut rest: Vec<Block> = blocks.iter().rev().copied().collect();
        let mut is_first = true;
        while !rest.is_empty() && (is_first || pins.bytes < bytes_max / 2) {
            let mut some = rest.split_off(rest.len().saturating_sub(BLOCKS_AT_ONCE));
            some.reverse();
            // Another reader may have loaded them meanwhile.
            let absent = maps.pin(row, &some, pins);
            if absent.is_empty() {
                is_first = false;
                continue;
            }
            let loading = db::limited(self.load_some(row, &absent, pins));
            if let Some(count) = loading.await? {
                let read = u64::try_from(count).unwrap_or_default();
                maps.memory.read.fetch_add(read, Ordering::Relaxed);
                (tries, is_first) = (0, false);
                rest.extend(absent.get(count..).unwrap_or_default().iter().rev());
            } else if tries >= READ_AGAIN_MAX {
                return Err(DbError::Unsettled.into());
            } else {
                tries += 1;
                rest.extend(absent.into_iter().rev());
            }
        }
        Ok(())
    }

    /// Loads the first of some blocks, and further ones as long as they are small. Returns their number;
    /// `None` if sums were removed or merged meanwhile.
    async fn load_some(
        &self,
        row: &SiteRow,
        absent: &[Block],
        pins: &mut Pins,
    ) -> Result<Option<usize>, DbError> {
        let maps = self.maps();
        let _reading = maps.begin_read();
        let snapshot = match maps.follower() {
            None => {
                let stamp = maps.with_map(row, SiteMap::stamp);
                let mut tx = self.db().read("map block").await?;
                self.snapshot_of(&mut tx, (row, stamp), absent).await?
            }
            Some(follower) => {
                let mut turn = follower.turn().await;
                let mut tx = self.db().read("map block").await?;
                if !self.follow_in(&mut tx, &mut turn).await? {
                    return Err(DbError::Unsettled);
                }
                let stamp = maps.with_map(row, SiteMap::stamp);
                let snapshot = self.snapshot_of(&mut tx, (row, stamp), absent).await?;
                if maps.unwritten().is_divided_by(&snapshot.watermarks) {
                    return Err(DbError::Unsettled);
                }
                // In its turn: nothing is added in between that is in this snapshot.
                return maps.insert(row, (snapshot, true), pins);
            }
        };
        maps.insert(row, (snapshot, false), pins)
    }

    /// Reads the first of some blocks of a map with this stamp, and further ones as long as they are small.
    async fn snapshot_of(
        &self,
        tx: &mut Tx,
        (row, stamp): (&SiteRow, Stamp),
        absent: &[Block],
    ) -> Result<Snapshot, DbError> {
        let maps = self.maps();
        let watermarks = db::watermarks::all(tx).await?;
        let mut blocks = Vec::with_capacity(absent.len());
        let sums_max = maps.memory.sums_at_once();
        let mut sums = 0;
        for &block in absent {
            let mut cells = BlockBuilder::default();
            let mut is_known = true;
            db::sums::of_block(tx, row.pk, block.first(), |sum| {
                sums += 1;
                is_known &= maps.build(row, &mut cells, &sum);
            })
            .await?;
            if !is_known {
                return Err(unnamed(row, block));
            }
            blocks.push((block, cells.build()));
            if sums >= sums_max {
                break;
            }
        }
        Ok(Snapshot {
            stamp,
            blocks,
            watermarks,
        })
    }

    /// Returns what the blocks of all maps take, and what happened to them.
    pub fn map_blocks(&self) -> BlockCounts {
        let maps = self.maps();
        let sites = maps.sites.read().unwrap_or_else(PoisonError::into_inner);
        let mut counts = BlockCounts {
            read: maps.memory.read.load(Ordering::Relaxed),
            evicted: maps.memory.evicted.load(Ordering::Relaxed),
            ..BlockCounts::default()
        };
        for map in sites.maps.values() {
            let (in_memory, bytes) = map.size();
            counts.driven += map.changes().block_count();
            counts.in_memory += in_memory;
            counts.bytes += bytes;
        }
        counts
    }
}

/// Evicts blocks whenever uploads have made all together too large, until the stop.
pub async fn run(app: App, stop: CancellationToken) {
    loop {
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = app.maps().memory.full.notified() => {}
        }
        let evicting = app.clone();
        let evicting = tokio::task::spawn_blocking(move || evicting.maps().evict());
        // Blocks that readers keep may be most of them, so that not much is evicted.
        let evicted = async { tokio::join!(evicting, tokio::time::sleep(EVICT_EVERY_MIN)) };
        tokio::select! {
            () = stop.cancelled() => return,
            (_, ()) = evicted => {}
        }
    }
}
