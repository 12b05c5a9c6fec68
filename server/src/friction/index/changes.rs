//! Which cells have changed since when, so that what was made of them is made again only there.

use std::collections::{BTreeMap, VecDeque};

use tread_api::site::Cell;

/// Side of the squares of cells whose changes are kept together, cells.
pub const BLOCK_CELLS: i32 = 64;
/// Changes of one block that are kept one by one; of older ones only that there were some.
const KEPT_MAX: usize = 1_024;

/// A square of cells, by row and column of such squares.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Block {
    /// Row.
    pub row: i32,
    /// Column.
    pub column: i32,
}

impl Block {
    /// The block that a cell lies in.
    pub fn of(cell: Cell) -> Self {
        Self {
            row: cell.iy.div_euclid(BLOCK_CELLS),
            column: cell.ix.div_euclid(BLOCK_CELLS),
        }
    }

    /// Its cell with the lowest coordinates.
    pub fn first(self) -> Cell {
        Cell {
            ix: self.column.saturating_mul(BLOCK_CELLS),
            iy: self.row.saturating_mul(BLOCK_CELLS),
        }
    }

    /// Its cell with the highest coordinates.
    pub fn last(self) -> Cell {
        let first = self.first();
        Cell {
            ix: first.ix.saturating_add(BLOCK_CELLS - 1),
            iy: first.iy.saturating_add(BLOCK_CELLS - 1),
        }
    }

    /// Where a cell of this block stands in it, row by row.
    pub fn place(cell: Cell) -> u16 {
        let place = cell.iy.rem_euclid(BLOCK_CELLS) * BLOCK_CELLS + cell.ix.rem_euclid(BLOCK_CELLS);
        u16::try_from(place).unwrap_or_default()
    }

    /// The cell that stands there.
    pub fn cell(self, place: u16) -> Cell {
        let (first, place) = (self.first(), i32::from(place));
        Cell {
            ix: first.ix.saturating_add(place % BLOCK_CELLS),
            iy: first.iy.saturating_add(place / BLOCK_CELLS),
        }
    }
}

/// Changes of one block.
#[derive(Debug, Default)]
struct OfBlock {
    newest: u64,
    /// All changes after this one are kept.
    kept_after: u64,
    /// Number of the change, and where it was.
    kept: VecDeque<(u64, u16)>,
}

/// All changes of a map, counted.
#[derive(Debug, Default)]
pub struct Changes {
    newest: u64,
    blocks: BTreeMap<Block, OfBlock>,
}

impl Changes {
    pub(super) fn note(&mut self, cell: Cell) {
        self.newest += 1;
        let block = self.blocks.entry(Block::of(cell)).or_default();
        block.newest = self.newest;
        if block.kept.len() >= KEPT_MAX
            && let Some((oldest, _place)) = block.kept.pop_front()
        {
            block.kept_after = oldest;
        }
        block.kept.push_back((self.newest, Block::place(cell)));
    }

    /// Everything that is there has changed.
    pub(super) fn note_all(&mut self) {
        self.newest += 1;
        for block in self.blocks.values_mut() {
            *block = OfBlock {
                newest: self.newest,
                kept_after: self.newest,
                kept: VecDeque::new(),
            };
        }
    }

    /// Counts on from older changes, after which everything may have changed.
    pub(super) fn follow(&mut self, before: &Self) {
        self.newest = self.newest.max(before.newest);
        for &block in before.blocks.keys() {
            self.blocks.entry(block).or_default();
        }
        self.note_all();
    }

    /// The number of the newest change.
    pub fn newest(&self) -> u64 {
        self.newest
    }

    /// The number of a block's newest change; 0 if nothing was ever there.
    pub fn newest_of(&self, block: Block) -> u64 {
        self.blocks.get(&block).map_or(0, |found| found.newest)
    }

    /// The number of the newest change of the blocks of a box.
    pub fn newest_in(&self, low: Block, high: Block) -> u64 {
        let rows = self.blocks.range(low..=high);
        let columns = low.column..=high.column;
        let within = rows.filter(|(block, _)| columns.contains(&block.column));
        within.fold(0, |newest, (_, found)| newest.max(found.newest))
    }

    /// The cells of a block that have changed since; `None` if that is not kept, so that all may
    /// have.
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

    /// Blocks that hold anything, row by row, with the number of their newest change.
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
                changes.note(cell);
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
            before.note(cell);
        }
        let mut after = Changes::default();
        after.note(here);
        after.follow(&before);
        for cell in [here, gone] {
            assert!(after.newest_of(Block::of(cell)) > before.newest());
            assert_eq!(after.since(Block::of(cell), before.newest()), None);
        }
    }

    #[test]
    fn a_change_of_everything_is_one_of_each_block() {
        let mut changes = Changes::default();
        changes.note(Cell { ix: 1, iy: 1 });
        let before = changes.newest();
        changes.note_all();
        let block = Block::of(Cell { ix: 1, iy: 1 });
        assert_eq!(changes.since(block, before), None);
        assert_eq!(changes.since(block, changes.newest()), Some(Vec::new()));
    }
}
