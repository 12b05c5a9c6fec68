//! Tracks changes of cells, so that values derived from the map are recomputed only for changed
//! cells.

use std::collections::{BTreeMap, VecDeque};
use std::ops::RangeInclusive;

use tread_api::site::Cell;

/// Side of a [`Block`], in cells.
pub const BLOCK_CELLS: i32 = 64;
/// Maximum number of changes recorded per block; beyond it the oldest is dropped, and
/// [`Changes::since`] returns `None` for times before it.
const KEPT_MAX: usize = 1_024;

/// Square of [`BLOCK_CELLS`] × [`BLOCK_CELLS`] cells, by its row and column in units of blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Block {
    /// Row, along y.
    pub row: i32,
    /// Column, along x.
    pub column: i32,
}

impl Block {
    /// Returns the block that contains `cell`.
    pub fn of(cell: Cell) -> Self {
        Self {
            row: cell.iy.div_euclid(BLOCK_CELLS),
            column: cell.ix.div_euclid(BLOCK_CELLS),
        }
    }

    /// Returns the cell with the lowest indices.
    pub fn first(self) -> Cell {
        Cell {
            ix: self.column.saturating_mul(BLOCK_CELLS),
            iy: self.row.saturating_mul(BLOCK_CELLS),
        }
    }

    /// Returns the cell with the highest indices.
    pub fn last(self) -> Cell {
        let first = self.first();
        Cell {
            ix: first.ix.saturating_add(BLOCK_CELLS - 1),
            iy: first.iy.saturating_add(BLOCK_CELLS - 1),
        }
    }

    /// Returns the index of `cell` within its block, row by row.
    pub fn place(cell: Cell) -> u16 {
        let place = cell.iy.rem_euclid(BLOCK_CELLS) * BLOCK_CELLS + cell.ix.rem_euclid(BLOCK_CELLS);
        u16::try_from(place).unwrap_or_default()
    }

    /// Returns the cell with index `place` in this block.
    pub fn cell(self, place: u16) -> Cell {
        let (first, place) = (self.first(), i32::from(place));
        Cell {
            ix: first.ix.saturating_add(place % BLOCK_CELLS),
            iy: first.iy.saturating_add(place / BLOCK_CELLS),
        }
    }
}

/// Recorded changes of one block.
#[derive(Debug, Default)]
struct BlockChanges {
    /// One bit for each line of cells in which anything was ever measured.
    lines: u64,
    newest: u64,
    /// Number of the newest change that is no longer recorded; all later ones are.
    kept_after: u64,
    /// Number of each change, and index of its cell in the block; oldest first.
    kept: VecDeque<(u64, u16)>,
}

impl BlockChanges {
    /// Makes `newest` the number of the newest change, of which it is not known which cells it was of.
    fn discard_until(&mut self, newest: u64) {
        self.newest = newest;
        self.kept_after = newest;
        self.kept = VecDeque::new();
    }
}

/// Returns the bit of a line of cells within its block.
fn line(iy: i32) -> u64 {
    1 << iy.rem_euclid(BLOCK_CELLS)
}

/// Changes of a map, numbered consecutively from 1.
#[derive(Debug, Default)]
pub struct Changes {
    newest: u64,
    blocks: BTreeMap<Block, BlockChanges>,
}

impl Changes {
    pub(super) fn record(&mut self, cell: Cell) {
        self.newest += 1;
        let block = self.blocks.entry(Block::of(cell)).or_default();
        block.lines |= line(cell.iy);
        block.newest = self.newest;
        if block.kept.len() >= KEPT_MAX
            && let Some((oldest, _place)) = block.kept.pop_front()
        {
            block.kept_after = oldest;
        }
        block.kept.push_back((self.newest, Block::place(cell)));
    }

    /// Records a change of all cells.
    pub(super) fn record_all(&mut self) {
        self.newest += 1;
        for block in self.blocks.values_mut() {
            block.discard_until(self.newest);
        }
    }

    /// Records a change of any cell of the block of this one, in which something was measured.
    pub(super) fn record_block_of(&mut self, cell: Cell) {
        self.newest += 1;
        let block = self.blocks.entry(Block::of(cell)).or_default();
        block.lines |= line(cell.iy);
        block.discard_until(self.newest);
    }

    /// Forgets which cells of a block have changed until now.
    pub(super) fn discard(&mut self, block: Block) {
        if let Some(found) = self.blocks.get_mut(&block) {
            found.discard_until(found.newest);
        }
    }

    /// Returns whether any change of a block was recorded.
    pub fn contains(&self, block: Block) -> bool {
        self.blocks.contains_key(&block)
    }

    /// Returns the blocks between two columns, both included, with measurements in a line of cells.
    pub(super) fn of_line(
        &self,
        iy: i32,
        columns: RangeInclusive<i32>,
    ) -> impl Iterator<Item = Block> + '_ {
        let row = iy.div_euclid(BLOCK_CELLS);
        let blocks = self.range(row, columns);
        let of_line = blocks.filter(move |(_, found)| found.lines & line(iy) != 0);
        of_line.map(|(&block, _)| block)
    }

    /// Returns the number of blocks with any change.
    pub fn block_count(&self) -> usize {
        self.blocks.len()
    }

    /// Returns the rows with any change between two rows, both included.
    pub(super) fn rows(
        &self,
        between: Option<RangeInclusive<i32>>,
    ) -> impl Iterator<Item = i32> + '_ {
        let between = between.map(RangeInclusive::into_inner);
        let (mut next, last) = between.map_or((None, i32::MIN), |(low, high)| (Some(low), high));
        std::iter::from_fn(move || {
            let from = Block {
                row: next?,
                column: i32::MIN,
            };
            let (found, _) = self.blocks.range(from..).next()?;
            next = found.row.checked_add(1);
            (found.row <= last).then_some(found.row)
        })
    }

    /// Returns the lowest column with any change in the rectangle between two blocks, both included.
    pub fn first_column(&self, blocks: RangeInclusive<Block>) -> Option<i32> {
        let (low, high) = blocks.into_inner();
        let rows = self.rows(Some(low.row..=high.row));
        let firsts = rows.filter_map(|row| self.row(row, low.column..=high.column).next());
        firsts.map(|block| block.column).min()
    }

    /// Returns the blocks with any change of a row between two columns, both included.
    pub(super) fn row(
        &self,
        row: i32,
        columns: RangeInclusive<i32>,
    ) -> impl Iterator<Item = Block> + '_ {
        self.range(row, columns).map(|(&block, _)| block)
    }

    fn range(
        &self,
        row: i32,
        columns: RangeInclusive<i32>,
    ) -> impl Iterator<Item = (&Block, &BlockChanges)> {
        let (low, high) = columns.into_inner();
        let at = |column| Block { row, column };
        let found = (low <= high).then(|| self.blocks.range(at(low)..=at(high)));
        found.into_iter().flatten()
    }

    /// Continues the numbering of the map `before`, and records a change of all cells of both.
    pub(super) fn follow(&mut self, before: &Self) {
        self.newest = self.newest.max(before.newest);
        for &block in before.blocks.keys() {
            self.blocks.entry(block).or_default();
        }
        self.record_all();
    }

    /// Returns the number of the newest change; 0 without changes.
    pub fn newest(&self) -> u64 {
        self.newest
    }

    /// Returns the number of the newest change of a block; 0 without changes.
    pub fn newest_of(&self, block: Block) -> u64 {
        self.blocks.get(&block).map_or(0, |found| found.newest)
    }

    /// Returns the number of the newest change in the rectangle between two blocks, both included; 0
    /// without changes.
    pub fn newest_in(&self, blocks: RangeInclusive<Block>) -> u64 {
        let columns = blocks.start().column..=blocks.end().column;
        let rows = self.blocks.range(blocks);
        let within = rows.filter(|(block, _)| columns.contains(&block.column));
        within.fold(0, |newest, (_, found)| newest.max(found.newest))
    }

    /// Returns the indices of the cells of a block that changed after change `since`, sorted;
    /// `None` if these are no longer recorded, so that any cell may have changed.
    pub fn since(&self, block: Block, since: u64) -> Option<Vec<u16>> {
        let Some(found) = self.blocks.get(&block) else {
            return Some(Vec::new());
        };
        if since < found.kept_after {
            return None;
        }
        let newer = found.kept.iter().rev().take_while(|(at, _)| *at > since);
        let mut places: Vec<u16> = newer.map(|&(_at, place)| place).collect();
        places.sort_unstable();
        places.dedup();
        Some(places)
    }

    /// Returns the blocks with any change, row by row, with the number of their newest change.
    pub fn blocks(&self) -> impl Iterator<Item = (Block, u64)> + '_ {
        self.blocks
            .iter()
            .map(|(&block, found)| (block, found.newest))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_place_in_a_block_names_its_cell(ix in -9_999..9_999, iy in -9_999..9_999) {
            let cell = Cell { ix, iy };
            let block = Block::of(cell);
            prop_assert_eq!(block.cell(Block::place(cell)), cell);
            prop_assert!(block.first().ix <= ix && ix <= block.last().ix);
            prop_assert!(block.first().iy <= iy && iy <= block.last().iy);
        }

        #[test]
        fn what_has_changed_since_is_reported_or_everything_may_have(
            cells in prop::collection::vec((0..100, 0..3), 1..3_000), share in 0.0_f64..1.0,
        ) {
            let mut changes = Changes::default();
            let cells: Vec<Cell> = cells.iter().map(|&(ix, iy)| Cell { ix, iy }).collect();
            for &cell in &cells {
                changes.record(cell);
            }
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss, reason = "a share of a few thousand")]
            let since = (share * cells.len() as f64) as usize;
            for (block, _newest) in changes.blocks() {
                let mut truth: Vec<u16> = cells[since..].iter()
                    .filter(|&&cell| Block::of(cell) == block).map(|&cell| Block::place(cell)).collect();
                truth.sort_unstable();
                truth.dedup();
                if let Some(found) = changes.since(block, since as u64) {
                    prop_assert_eq!(found, truth);
                } else {
                    prop_assert!(cells.len() - since > KEPT_MAX);
                }
            }
        }
    }

    #[test]
    fn changes_that_follow_others_are_newer_also_where_nothing_is_left() {
        let (here, gone) = (Cell { ix: 1, iy: 1 }, Cell { ix: 999, iy: 1 });
        let mut before = Changes::default();
        for cell in [here, gone, here] {
            before.record(cell);
        }
        let mut after = Changes::default();
        after.record(here);
        after.follow(&before);
        for cell in [here, gone] {
            assert!(after.newest_of(Block::of(cell)) > before.newest());
            assert_eq!(after.since(Block::of(cell), before.newest()), None);
        }
    }

    #[test]
    fn a_change_of_everything_is_one_of_each_block() {
        let mut changes = Changes::default();
        changes.record(Cell { ix: 1, iy: 1 });
        let before = changes.newest();
        changes.record_all();
        let block = Block::of(Cell { ix: 1, iy: 1 });
        assert_eq!(changes.since(block, before), None);
        assert_eq!(changes.since(block, changes.newest()), Some(Vec::new()));
    }
}
