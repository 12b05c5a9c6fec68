//! The cells of a map, by block, as far as they are in memory.
//!
//! All sums are stored as well, or are among those that are stored behind the receipts. So a block
//! can leave memory at any time, and be read again. A reader notes the blocks that it needs and
//! that are absent ([`MissingBlocks`]); the caller reads these and repeats it.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tread_api::friction::CellBox;
use tread_api::ids::RobotId;
use tread_api::site::Cell;

use super::changes::Block;
use super::names::Number;
use super::part::{Part, PartKey};
use super::partial::ReadTime;
use super::{Choice, Group, LabelledSum, SiteMap, Sums, place};

/// Approximate memory of a cell beside its sums: its share of the tree, and the allocator's.
const CELL_BYTES: usize = 64;
/// Approximate memory of a block beside its cells.
const BLOCK_BYTES: usize = 256;
/// Number of absent blocks that are noted at a time where cells are read row by row.
const NOTED_MAX: usize = 16;

/// Keeps a block in memory as long as it exists.
#[derive(Debug, Clone)]
pub struct Pin(#[expect(dead_code, reason = "counted by its reference")] Arc<()>);

/// Cells of one block.
#[derive(Debug, Default)]
pub struct BlockCells {
    /// The sums of each cell, by its index in the block, sorted by key.
    cells: BTreeMap<u16, Box<[Part]>>,
    parts: usize,
    pins: Arc<()>,
    /// Time of its last use, see [`SiteMap::cells`].
    used: AtomicU64,
}

/// Adds up neighbours with the same key.
fn added_up(parts: impl Iterator<Item = Part>) -> Vec<Part> {
    let mut added: Vec<Part> = Vec::new();
    for part in parts {
        match added.last_mut().filter(|last| last.key == part.key) {
            Some(last) => last.add(&part.sums()),
            None => added.push(part),
        }
    }
    added
}

impl BlockCells {
    fn of(mut sums: Vec<(u16, Part)>) -> Self {
        sums.sort_unstable_by_key(|(place, part)| (*place, part.key));
        let mut block = Self::default();
        for of_cell in sums.chunk_by(|left, right| left.0 == right.0) {
            let parts = added_up(of_cell.iter().map(|(_, part)| *part));
            block.parts += parts.len();
            block.cells.insert(of_cell[0].0, parts.into_boxed_slice());
        }
        block
    }

    /// Returns about how much memory it takes, bytes.
    fn bytes(&self) -> usize {
        BLOCK_BYTES + self.cells.len() * CELL_BYTES + self.parts * size_of::<Part>()
    }

    fn add(&mut self, place: u16, key: PartKey, sums: &Sums) {
        let parts = self.cells.entry(place).or_default();
        match parts.binary_search_by_key(&key, |part| part.key) {
            Ok(index) => parts[index].add(sums),
            Err(index) => {
                let mut longer = Vec::with_capacity(parts.len() + 1);
                longer.extend_from_slice(&parts[..index]);
                longer.push(Part::new(key, sums));
                longer.extend_from_slice(&parts[index..]);
                *parts = longer.into_boxed_slice();
                self.parts += 1;
            }
        }
    }

    /// Removes the sums for which `is_removed` is true.
    fn remove(&mut self, is_removed: impl Fn(&PartKey) -> bool) {
        for parts in self.cells.values_mut() {
            if parts.iter().any(|part| is_removed(&part.key)) {
                let before = parts.len();
                let kept = parts.iter().filter(|part| !is_removed(&part.key));
                *parts = kept.copied().collect();
                self.parts -= before - parts.len();
            }
        }
        self.cells.retain(|_place, parts| !parts.is_empty());
    }

    /// Adds up the sums whose keys become the same.
    fn merge(&mut self, bucket: impl Fn(PartKey) -> PartKey) {
        for parts in self.cells.values_mut() {
            if parts.iter().all(|part| bucket(part.key) == part.key) {
                continue;
            }
            let merged = added_up(parts.iter().map(|part| part.moved(bucket(part.key))));
            self.parts -= parts.len() - merged.len();
            *parts = merged.into_boxed_slice();
        }
    }
}

/// Stored sums of a block, of which its cells are made.
#[derive(Debug, Default)]
pub struct BlockBuilder {
    /// Sums with the indices of their cells, in any order.
    sums: Vec<(u16, Part)>,
}

impl BlockBuilder {
    /// Adds a sum, unless it is of another grid revision than the map's; `false` if a name is new to
    /// the map.
    pub fn add(&mut self, map: &SiteMap, labelled: LabelledSum<'_>, sums: &Sums) -> bool {
        if labelled.grid_revision != map.grid_revision {
            return true;
        }
        let Some(key) = map.found_key(labelled) else {
            return false;
        };
        let place = Block::place(labelled.cell);
        self.sums.push((place, Part::new(key, sums)));
        true
    }

    /// Makes the cells.
    pub fn build(self) -> BlockCells {
        BlockCells::of(self.sums)
    }
}

/// The blocks in memory.
#[derive(Debug, Default)]
pub(super) struct Blocks {
    present: BTreeMap<Block, BlockCells>,
    bytes: usize,
}

impl Blocks {
    pub(super) fn contains(&self, block: Block) -> bool {
        self.present.contains_key(&block)
    }

    /// Returns the number of blocks in memory, and about how many bytes they take.
    pub(super) fn size(&self) -> (usize, usize) {
        (self.present.len(), self.bytes)
    }

    pub(super) fn part_count(&self) -> usize {
        self.present.values().map(|block| block.parts).sum()
    }

    /// Adds to a cell whose block is in memory; returns whether it is.
    pub(super) fn add(&mut self, cell: Cell, key: PartKey, sums: &Sums) -> bool {
        let Some(block) = self.present.get_mut(&Block::of(cell)) else {
            return false;
        };
        self.bytes -= block.bytes();
        block.add(Block::place(cell), key, sums);
        self.bytes += block.bytes();
        true
    }

    pub(super) fn insert(&mut self, block: Block, cells: BlockCells, used: u64) {
        cells.used.store(used, Ordering::Relaxed);
        self.bytes += cells.bytes();
        if let Some(before) = self.present.insert(block, cells) {
            self.bytes -= before.bytes();
        }
    }

    /// Takes a block out, unless it is pinned.
    pub(super) fn take(&mut self, block: Block) -> Option<BlockCells> {
        if Arc::strong_count(&self.present.get(&block)?.pins) > 1 {
            return None;
        }
        let taken = self.present.remove(&block)?;
        self.bytes -= taken.bytes();
        Some(taken)
    }

    pub(super) fn remove(&mut self, is_removed: impl Fn(&PartKey) -> bool) {
        for cells in self.present.values_mut() {
            self.bytes -= cells.bytes();
            cells.remove(&is_removed);
            self.bytes += cells.bytes();
        }
    }

    pub(super) fn merge(&mut self, bucket: impl Fn(PartKey) -> PartKey) {
        for cells in self.present.values_mut() {
            self.bytes -= cells.bytes();
            cells.merge(&bucket);
            self.bytes += cells.bytes();
        }
    }

    pub(super) fn pin(&self, block: Block) -> Option<(Pin, usize)> {
        let found = self.present.get(&block)?;
        Some((Pin(Arc::clone(&found.pins)), found.bytes()))
    }

    /// Returns the blocks that nothing keeps in memory, with the time of the last use
    /// of each and its bytes.
    pub(super) fn idle(&self) -> impl Iterator<Item = (u64, Block, usize)> + '_ {
        let is_idle = |cells: &BlockCells| Arc::strong_count(&cells.pins) == 1;
        let idle = self.present.iter().filter(move |(_, cells)| is_idle(cells));
        idle.map(|(&block, cells)| (cells.used.load(Ordering::Relaxed), block, cells.bytes()))
    }
}

/// The blocks that a reader of a map needed and that were not in memory.
#[derive(Debug, Default)]
pub struct MissingBlocks(RefCell<BTreeSet<Block>>);

impl MissingBlocks {
    fn record(&self, block: Block) {
        self.0.borrow_mut().insert(block);
    }

    /// Returns whether no block was absent so far.
    pub fn is_empty(&self) -> bool {
        self.0.borrow().is_empty()
    }

    /// Returns the blocks.
    pub fn into_blocks(self) -> BTreeSet<Block> {
        self.0.into_inner()
    }
}

/// The cells of a map, for one read. What it returns is incomplete if a block was absent.
#[derive(Debug, Clone, Copy)]
pub struct Cells<'map> {
    map: &'map SiteMap,
    absent: &'map MissingBlocks,
    /// Time of this read.
    time: u64,
}

impl SiteMap {
    /// Returns the cells for a read at a time of any clock that never goes back; absent blocks are noted
    /// in `absent`.
    pub fn cells<'map>(&'map self, absent: &'map MissingBlocks, time: u64) -> Cells<'map> {
        Cells {
            map: self,
            absent,
            time,
        }
    }
}

impl<'map> Cells<'map> {
    /// Returns the map, without its cells.
    pub fn map(self) -> &'map SiteMap {
        self.map
    }

    /// Returns whether a block was absent, so that the answer will be discarded.
    pub fn is_incomplete(self) -> bool {
        !self.absent.is_empty()
    }

    /// Returns the sums of a block by the indices of its cells; `None` without any, or if it is
    /// absent.
    pub(super) fn of_block(self, block: Block) -> Option<&'map BTreeMap<u16, Box<[Part]>>> {
        if let Some(found) = self.map.blocks.present.get(&block) {
            found.used.store(self.time, Ordering::Relaxed);
            return Some(&found.cells);
        }
        if self.map.changes.contains(block) {
            self.absent.record(block);
        }
        None
    }

    /// Returns the sums of a cell.
    pub(super) fn parts(self, cell: Cell) -> &'map [Part] {
        let parts = self.of_block(Block::of(cell));
        let parts = parts.and_then(|cells| cells.get(&Block::place(cell)));
        parts.map_or(&[], |parts| &**parts)
    }

    /// Returns the measurements of one cell, per terrain and configuration.
    pub fn cell(self, cell: Cell, choice: Choice<'_>) -> Vec<Group<'map>> {
        self.map.groups(&self.parts_at(cell, choice.when()), choice)
    }

    /// Returns the end of the newest pass through a cell, microseconds since 1970; `None` without
    /// one.
    pub fn newest_at_us(self, cell: Cell, choice: Choice<'_>) -> Option<i64> {
        let parts = self.parts_at(cell, choice.when());
        let counted = parts
            .iter()
            .filter(|part| self.map.counts(&part.key, &choice));
        counted.map(|part| part.newest_at_us).max()
    }

    /// Returns the measurements of several cells together, summed per robot and epoch, per terrain
    /// and configuration.
    pub fn area(self, cells: &[Cell], choice: Choice<'_>) -> Vec<Group<'map>> {
        let mut sums: BTreeMap<PartKey, Sums> = BTreeMap::new();
        for &cell in cells {
            for part in &*self.parts_at(cell, choice.when()) {
                if self.map.counts(&part.key, &choice) {
                    sums.entry(part.key)
                        .and_modify(|sums| sums.add(&part.sums()))
                        .or_insert_with(|| part.sums());
                }
            }
        }
        let parts: Vec<Part> = sums
            .iter()
            .map(|(&key, sums)| Part::new(key, sums))
            .collect();
        self.map.groups(&parts, choice)
    }

    /// Returns the cells with measurements in a box, row by row; those after the cell `after` if it
    /// is given. Ends at the first absent block, with which it notes some of those that would
    /// follow.
    pub fn cells_in(
        self,
        CellBox { min, max }: CellBox,
        after: Option<Cell>,
    ) -> impl Iterator<Item = Cell> + use<'map> {
        let first_iy = after.map_or(min.iy, |after| after.iy.max(min.iy));
        let start = Block::of(Cell {
            iy: first_iy,
            ..min
        });
        let last = Block::of(max);
        let is_any = first_iy <= max.iy && min.ix <= max.ix;
        let rows = self
            .map
            .changes
            .rows(is_any.then_some(start.row..=last.row));
        let lines = rows.flat_map(move |row| {
            let of_row = Block { row, column: 0 };
            of_row.first().iy.max(first_iy)..=of_row.last().iy.min(max.iy)
        });
        let found = lines.flat_map(move |iy| {
            // Of the line of `after` nothing before it is needed.
            let of_line = after.filter(|after| after.iy == iy);
            let begun = of_line.map_or(start, Block::of).column.max(start.column);
            let blocks = self.map.changes.of_line(iy, begun..=last.column);
            blocks.flat_map(move |block| {
                let cells = self.of_block(block);
                if cells.is_none() {
                    self.record_absent_from(block, (start.column..=last.column, last.row));
                }
                let from = block.first().ix.max(min.ix);
                let to = block.last().ix.min(max.ix);
                let place = |ix| Block::place(Cell { ix, iy });
                let range = cells.map(|cells| cells.range(place(from)..=place(to)));
                let found = range.into_iter().flatten();
                let found = found.map(move |(&place, _parts)| Some(block.cell(place)));
                found.chain(cells.is_none().then_some(None))
            })
        });
        found
            .map_while(|cell| cell)
            .filter(move |&cell| after.is_none_or(|after| place(cell) > place(after)))
    }

    /// Notes absent blocks from one on in its row, and in the rows below up to `last_row`.
    fn record_absent_from(self, from: Block, (columns, last_row): (RangeInclusive<i32>, i32)) {
        let rest = from.column..=*columns.end();
        let rest = self.map.changes.row(from.row, rest);
        let below = from.row.checked_add(1).filter(|&row| row <= last_row);
        let below = self.map.changes.rows(below.map(|row| row..=last_row));
        let below = below.flat_map(|row| self.map.changes.row(row, columns.clone()));
        let absent = rest
            .chain(below)
            .filter(|&block| !self.map.blocks.contains(block));
        for block in absent.take(NOTED_MAX) {
            self.absent.record(block);
        }
    }

    /// Adds the number of cells of a block that each robot has measured to `counts`.
    pub fn count_cells(self, block: Block, counts: &mut BTreeMap<RobotId, u64>) {
        let mut found: BTreeMap<Number, u64> = BTreeMap::new();
        for parts in self.of_block(block).into_iter().flat_map(BTreeMap::values) {
            let mut robots: Vec<Number> = parts.iter().map(|part| part.key.robot).collect();
            robots.sort_unstable();
            robots.dedup();
            for robot in robots {
                *found.entry(robot).or_default() += 1;
            }
        }
        for (robot, count) in found {
            let robot = self.map.names.robots.name(robot);
            *counts.entry(robot.clone()).or_default() += count;
        }
    }

    /// Returns the parts of a cell that count at a time.
    pub(super) fn parts_at(self, cell: Cell, when: ReadTime<'_>) -> std::borrow::Cow<'map, [Part]> {
        self.map.parts_then((place(cell), self.parts(cell)), when)
    }
}

#[cfg(test)]
mod tests;
