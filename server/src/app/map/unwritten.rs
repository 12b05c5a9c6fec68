//! Sums that receipts promise and the stored sums do not contain yet.
//!
//! ```text
//! commit of segments ─► added here and to the map ─► stored with the robot's watermark ─► removed
//! restart ─► empty; the segments that follow each watermark are added again
//! a block of cells is read ─► sums that its snapshot of the database lacks are added to the block
//! ```
//!
//! The sums of a robot are stored up to a watermark, so those of the same segments are stored in one
//! transaction, for which receipts wait. A robot that has driven through many cells therefore has
//! several generations of sums, each of the segments after those of the one before.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet, VecDeque};
use std::time::Duration;

use foldhash::fast::RandomState;
use tread_api::site::Cell;

use crate::db::segments::Added;
use crate::db::sums::SumKey;
use crate::db::watermarks::WatermarkStep;
use crate::db::withdrawals::Hours;
use crate::friction::Sums;
use crate::friction::index::Block;

/// Maximum number of unwritten sums, about 300 bytes each; beyond it sums are stored before further
/// receipts.
pub(super) const UNWRITTEN_SUMS_MAX: usize = 200_000;
/// Maximum number of segments in unwritten sums, which a killed server adds again when it starts.
pub(super) const UNWRITTEN_SEGMENTS_MAX: u64 = 1_000_000;

/// Number of sums from which a robot's further segments are added to another generation, and beyond which
/// a transaction takes no further generation: receipts wait for it.
pub(super) const TRANSACTION_SUMS: usize = 2_000;

/// The unwritten sums of all robots.
#[derive(Debug)]
pub(super) struct Unwritten {
    /// The generations of each robot, oldest first; at least one.
    robots: BTreeMap<i64, VecDeque<Generation>>,
    /// [`TRANSACTION_SUMS`], and fewer in tests.
    generation_sums: usize,
    /// Stored watermarks by robot.
    watermarks: HashMap<i64, i64>,
    sums: usize,
    segments: u64,
    /// Number of additions so far.
    additions: u64,
    /// Numbers of the reads of blocks that have begun and not ended.
    reads: BTreeSet<u64>,
    /// Number of the next one.
    next_read: u64,
    /// Generations that were stored while blocks were read, in the order in which they were: the
    /// snapshots of those reads may lack them.
    stored_during_read: VecDeque<StoredDuringRead>,
}

/// Sums of some segments of one robot.
#[derive(Debug)]
struct Generation {
    sums: HashMap<SumKey, Sums, RandomState>,
    /// Site and block of each of the sums, and of sums that were removed since.
    blocks: HashSet<(i64, Block), RandomState>,
    /// Keys between which all segments in `sums` are.
    keys: Added,
    /// Number of the first addition, and its time.
    began: (u64, Duration),
}

/// A generation that was stored while blocks were read.
#[derive(Debug)]
pub(super) struct StoredDuringRead {
    robot_pk: i64,
    generation: Generation,
    /// Number of the first read that began after it was stored.
    until_read: u64,
}

/// How much is unwritten.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct UnwrittenCounts {
    /// Number of sums.
    pub sums: usize,
    /// Number of segments in them.
    pub segments: u64,
    /// Time of the oldest, on the server's monotonic clock.
    pub oldest_at: Option<Duration>,
}

/// Sums that are stored in one transaction: the oldest generations of some robots.
#[derive(Debug, Default)]
pub(super) struct StoreBatch {
    /// In the order of the table, so that neighbours share database pages.
    pub(super) sums: Vec<(SumKey, Sums)>,
    pub(super) steps: Vec<WatermarkStep>,
}

impl Default for Unwritten {
    fn default() -> Self {
        Self {
            robots: BTreeMap::new(),
            generation_sums: TRANSACTION_SUMS,
            watermarks: HashMap::new(),
            sums: 0,
            segments: 0,
            additions: 0,
            reads: BTreeSet::new(),
            next_read: 0,
            stored_during_read: VecDeque::new(),
        }
    }
}

impl Generation {
    /// Adds a later generation of the same robot.
    fn join(&mut self, later: Self) {
        for (key, sums) in later.sums {
            let present = self.sums.entry(key);
            present
                .and_modify(|present| present.add(&sums))
                .or_insert(sums);
        }
        self.blocks.extend(later.blocks);
        self.keys.last = self.keys.last.max(later.keys.last);
    }

    fn segments(&self) -> u64 {
        self.sums.values().map(|sums| sums.segments).sum()
    }
}

impl Unwritten {
    /// Creates unwritten sums of a standby: those of each range of the ledger are a generation, since another
    /// server stores them up to the end of any.
    pub(super) fn of_ranges() -> Self {
        Self {
            generation_sums: 0,
            ..Self::default()
        }
    }

    /// Makes the unwritten sums of a standby those of the server that it becomes: small generations of a
    /// robot are joined.
    pub(super) fn may_be_stored(&mut self) {
        self.generation_sums = TRANSACTION_SUMS;
        for generations in self.robots.values_mut() {
            let mut joined: VecDeque<Generation> = VecDeque::new();
            for generation in generations.drain(..) {
                match joined.back_mut() {
                    Some(last) if last.sums.len() < TRANSACTION_SUMS => {
                        self.sums -= last.sums.len() + generation.sums.len();
                        last.join(generation);
                        self.sums += last.sums.len();
                    }
                    Some(_) | None => joined.push_back(generation),
                }
            }
            *generations = joined;
        }
    }

    /// Extends the key range of a robot's newest generation to `keys`: segments that add nothing to the sums, but
    /// were committed together with segments of that generation.
    pub(super) fn cover(&mut self, robot_pk: i64, keys: Added) {
        let newest = self.robots.get_mut(&robot_pk);
        if let Some(newest) = newest.and_then(VecDeque::back_mut)
            && newest.keys.last >= keys.first
        {
            newest.keys.last = newest.keys.last.max(keys.last);
        }
    }

    /// Sets the stored watermarks. All sums that are added later must follow them.
    pub(super) fn start_at(&mut self, watermarks: HashMap<i64, i64>) {
        self.watermarks = watermarks;
    }

    /// Returns whether one of these watermarks lies within a generation: then [`Self::since`] cannot determine
    /// which of its sums are stored.
    pub(super) fn is_divided_by(&self, watermarks: &HashMap<i64, i64>) -> bool {
        self.robots.iter().any(|(robot_pk, generations)| {
            let stored_to = watermarks.get(robot_pk).copied().unwrap_or_default();
            let is_divided = |generation: &Generation| {
                generation.keys.first <= stored_to && stored_to < generation.keys.last
            };
            generations.iter().any(is_divided)
        })
    }

    /// Adds sums of segments that were committed together, with the keys of these. The keys of sums
    /// differ from the given ones in their cells.
    pub(super) fn add<'sums>(
        &mut self,
        sums: impl IntoIterator<Item = (&'sums SumKey, &'sums [(Cell, Sums)])>,
        added: Added,
        at: Duration,
    ) {
        self.additions += 1;
        for (key, cells) in sums {
            let generations = self.robots.entry(key.robot_pk).or_default();
            // What was added together is stored together.
            let has_room = |newest: &Generation| {
                newest.sums.len() < self.generation_sums || newest.keys.last >= added.first
            };
            if !generations.back().is_some_and(has_room) {
                generations.push_back(Generation {
                    sums: HashMap::default(),
                    blocks: HashSet::default(),
                    keys: added,
                    began: (self.additions, at),
                });
            }
            let Some(newest) = generations.back_mut() else {
                continue;
            };
            newest.keys.last = newest.keys.last.max(added.last);
            let mut key = key.clone();
            for (cell, sums) in cells {
                key.cell = *cell;
                self.segments += sums.segments;
                if let Some(present) = newest.sums.get_mut(&key) {
                    present.add(sums);
                } else {
                    newest.sums.insert(key.clone(), *sums);
                    newest.blocks.insert((key.site_pk, Block::of(*cell)));
                    self.sums += 1;
                }
            }
        }
    }

    /// Returns the number of additions so far.
    pub(super) fn additions(&self) -> u64 {
        self.additions
    }

    /// Returns the oldest generations that began before addition `until` ended, with the steps of their
    /// robots' watermarks: as many as have `limit` sums, and at least one.
    pub(super) fn portion(&self, until: u64, limit: usize) -> StoreBatch {
        let mut portion = StoreBatch::default();
        'robots: for (&robot_pk, generations) in &self.robots {
            let mut step = None;
            for generation in generations.iter().take_while(|it| it.began.0 <= until) {
                let is_first = step.is_none() && portion.steps.is_empty();
                if !is_first && portion.sums.len() + generation.sums.len() > limit {
                    portion.steps.extend(step);
                    break 'robots;
                }
                step = Some(WatermarkStep {
                    robot_pk,
                    from_pk: self.watermarks.get(&robot_pk).copied().unwrap_or_default(),
                    to_pk: generation.keys.last,
                });
                let sums = generation.sums.iter();
                portion
                    .sums
                    .extend(sums.map(|(key, sums)| (key.clone(), *sums)));
            }
            portion.steps.extend(step);
        }
        portion
            .sums
            .sort_unstable_by_key(|(key, _)| (key.robot_pk, key.epoch_h, key.cell.iy, key.cell.ix));
        portion
    }

    /// Removes the sums of a portion after they were stored. No sums may have been added since it was taken.
    pub(super) fn written(&mut self, steps: &[WatermarkStep]) {
        for step in steps {
            self.watermarks.insert(step.robot_pk, step.to_pk);
            let Some(generations) = self.robots.get_mut(&step.robot_pk) else {
                continue;
            };
            let is_stored = |oldest: &mut Generation| oldest.keys.last <= step.to_pk;
            while let Some(stored) = generations.pop_front_if(is_stored) {
                self.sums -= stored.sums.len();
                self.segments -= stored.segments();
                if !self.reads.is_empty() {
                    self.stored_during_read.push_back(StoredDuringRead {
                        robot_pk: step.robot_pk,
                        generation: stored,
                        until_read: self.next_read,
                    });
                }
            }
            if generations.is_empty() {
                self.robots.remove(&step.robot_pk);
            }
        }
    }

    /// Begins a read of blocks: sums that are stored until its end are still found by
    /// [`Self::since`]. Returns its number.
    pub(super) fn begin_read(&mut self) -> u64 {
        let number = self.next_read;
        self.next_read += 1;
        self.reads.insert(number);
        number
    }

    /// Ends a read of blocks. Returns the stored sums that were kept for this read only.
    pub(super) fn end_read(&mut self, number: u64) -> Vec<StoredDuringRead> {
        self.reads.remove(&number);
        let oldest = self.reads.first().copied().unwrap_or(self.next_read);
        let is_over = |stored: &mut StoredDuringRead| stored.until_read <= oldest;
        let over = std::iter::from_fn(|| self.stored_during_read.pop_front_if(is_over));
        over.collect()
    }

    /// Takes over the reads that have begun before memory was read again; each of them will find that
    /// its map is another one.
    pub(super) fn follow(&mut self, before: &mut Self) {
        self.reads = std::mem::take(&mut before.reads);
        self.next_read = before.next_read;
    }

    /// Returns the sums of a block that are not in the stored sums as of a snapshot with these
    /// watermarks. A read must have begun before that snapshot.
    pub(super) fn since<'all>(
        &'all self,
        watermarks: &'all HashMap<i64, i64>,
        site_pk: i64,
        block: Block,
    ) -> impl Iterator<Item = (&'all SumKey, &'all Sums)> {
        let stored = self.stored_during_read.iter();
        let stored = stored.map(|stored| (stored.robot_pk, &stored.generation));
        let unwritten = self.robots.iter().flat_map(|(&robot_pk, generations)| {
            generations
                .iter()
                .map(move |generation| (robot_pk, generation))
        });
        let since = stored
            .chain(unwritten)
            .filter(move |(robot_pk, generation)| {
                // A generation is stored whole, with its last key as the watermark.
                let stored_to = watermarks.get(robot_pk).copied().unwrap_or_default();
                generation.keys.last > stored_to && generation.blocks.contains(&(site_pk, block))
            });
        let sums = since.flat_map(|(_, generation)| &generation.sums);
        sums.filter(move |(key, _)| key.site_pk == site_pk && Block::of(key.cell) == block)
    }

    /// Removes the sums of a robot in these hours.
    pub(super) fn withdraw(&mut self, robot_pk: i64, hours: Hours) {
        let Some(mut generations) = self.robots.remove(&robot_pk) else {
            return;
        };
        for generation in &mut generations {
            self.sums -= generation.sums.len();
            self.segments -= generation.segments();
            generation
                .sums
                .retain(|key, _| !hours.contains(key.epoch_h));
            self.sums += generation.sums.len();
            self.segments += generation.segments();
        }
        generations.retain(|generation| !generation.sums.is_empty());
        if !generations.is_empty() {
            self.robots.insert(robot_pk, generations);
        }
    }

    /// Returns a key at or before that of the first segment in unwritten sums; `None` without such
    /// sums.
    pub(super) fn first_key(&self) -> Option<i64> {
        let oldest = self.robots.values().filter_map(VecDeque::front);
        oldest.map(|oldest| oldest.keys.first).min()
    }

    /// Returns how much is unwritten.
    pub(super) fn counts(&self) -> UnwrittenCounts {
        UnwrittenCounts {
            sums: self.sums,
            segments: self.segments,
            oldest_at: self
                .robots
                .values()
                .filter_map(VecDeque::front)
                .map(|oldest| oldest.began.1)
                .min(),
        }
    }

    /// Returns whether sums must be stored before further receipts.
    pub(super) fn is_full(&self) -> bool {
        self.sums >= UNWRITTEN_SUMS_MAX || self.segments >= UNWRITTEN_SEGMENTS_MAX
    }
}

#[cfg(test)]
mod tests;
