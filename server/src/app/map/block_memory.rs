//! The memory for blocks of cells: how much they may take, which were used least recently, and who has a
//! turn to load some.

use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::{Notify, Semaphore};

use super::Sites;
use crate::friction::index::{Block, BlockCells, SiteMap};

/// Bytes of a MiB.
pub(super) const MIB: usize = 1 << 20;
/// Minimum of the memory that one read may take.
const READ_BYTES_MIN: usize = 64 * MIB;
/// The same with a memory of 0, which tests have: a few small blocks.
const READ_BYTES_WITHOUT_MEMORY: usize = 16_384;
/// One read may take this share of the memory.
const READ_SHARE: usize = 8;
/// Number of requests that may have blocks loaded for them at a time, and of robots' missions; each
/// uses a connection to the database, one block after another.
const LOADS_MAX: usize = 2;
/// Number of sums after which a snapshot reads no further block.
const SUMS_AT_ONCE: usize = 32_768;

/// The memory for blocks.
#[derive(Debug)]
pub(super) struct BlockMemory {
    pub(super) limit_bytes: usize,
    /// Number of reads of maps so far, the clock of their last uses.
    pub(super) lru_clock: AtomicU64,
    pub(super) load_turns: Semaphore,
    pub(super) load_turns_of_robots: Semaphore,
    /// Blocks take more than the limit.
    pub(super) full: Notify,
    pub(super) read: AtomicU64,
    pub(super) evicted: AtomicU64,
}

impl BlockMemory {
    pub(super) fn new(limit_mib: u64) -> Self {
        let limit_mib = usize::try_from(limit_mib).unwrap_or(usize::MAX);
        Self {
            limit_bytes: limit_mib.saturating_mul(MIB),
            lru_clock: AtomicU64::new(0),
            load_turns: Semaphore::new(LOADS_MAX),
            load_turns_of_robots: Semaphore::new(LOADS_MAX),
            full: Notify::new(),
            read: AtomicU64::new(0),
            evicted: AtomicU64::new(0),
        }
    }

    /// Returns how many bytes of blocks one read may need.
    pub(super) fn read_bytes_max(&self) -> usize {
        match self.limit_bytes / READ_SHARE {
            0 => READ_BYTES_WITHOUT_MEMORY,
            share => share.max(READ_BYTES_MIN),
        }
    }

    /// Returns the number of sums after which a snapshot reads no further block.
    pub(super) fn sums_at_once(&self) -> usize {
        match self.limit_bytes {
            0 => 1,
            _ => SUMS_AT_ONCE,
        }
    }

    /// Returns the time on the clock of last uses.
    pub(super) fn lru_time(&self) -> u64 {
        self.lru_clock.load(Ordering::Relaxed)
    }

    pub(super) fn tick(&self) -> u64 {
        self.lru_clock.fetch_add(1, Ordering::Relaxed)
    }

    /// Wakes the task that evicts blocks if they take too much.
    pub(super) fn wake_if_full(&self, sites: &Sites) {
        if sites.bytes() > self.limit_bytes {
            self.full.notify_one();
        }
    }

    /// Returns the blocks to evict, the least recently used first, and so many that it is done rarely;
    /// none if all fit.
    pub(super) fn eviction_candidates(&self, sites: &Sites) -> Vec<(i64, Block)> {
        let bytes = sites.bytes();
        if bytes <= self.limit_bytes {
            return Vec::new();
        }
        let of_map = |(&pk, map): (&i64, &SiteMap)| {
            let idle = map.idle_blocks();
            let idle = idle.map(|(used, block, bytes)| (used, pk, block, bytes));
            idle.collect::<Vec<_>>()
        };
        let mut idle: Vec<_> = sites.maps.iter().flat_map(of_map).collect();
        idle.sort_unstable();
        let mut spare = bytes - (self.limit_bytes - self.limit_bytes / 8);
        let enough = idle.into_iter().take_while(move |(_, _, _, bytes)| {
            let is_needed = spare > 0;
            spare = spare.saturating_sub(*bytes);
            is_needed
        });
        enough.map(|(_, pk, block, _)| (pk, block)).collect()
    }

    /// Takes these blocks out of memory, unless something uses them by now.
    pub(super) fn take(&self, sites: &mut Sites, blocks: &[(i64, Block)]) -> Vec<BlockCells> {
        let mut taken = Vec::new();
        for (pk, block) in blocks {
            let map = sites.maps.get_mut(pk);
            taken.extend(map.and_then(|map| map.evict(*block)));
        }
        let count = u64::try_from(taken.len()).unwrap_or_default();
        self.evicted.fetch_add(count, Ordering::Relaxed);
        taken
    }

    /// Evicts blocks of maps that nobody else has yet.
    pub(super) fn evict(&self, sites: &mut Sites) {
        let candidates = self.eviction_candidates(sites);
        self.take(sites, &candidates);
    }
}
