//! Cells as pictures have them: one value for each, of one configuration, for the ground under its
//! middle. Nothing is allocated for a cell.

use jiff::Timestamp;
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use super::changes::{BLOCK_CELLS, Block};
use super::part::{Part, PartKey};
use super::{Choice, SiteMap, Sums, place};
use crate::friction::sums::HOUR_S;
use crate::friction::weights::FrictionConfig;
use crate::friction::{Fused, Fuser, Ground, Seen};

/// The number of ground on which no terrain is drawn.
pub const GROUND_NONE: u16 = 0;
/// The number of ground that is drawn no more.
const GROUND_LOST: u16 = u16::MAX;
/// Marks a square whose measurements contradict each other.
const DISPUTED: u32 = 1 << 31;

/// What is known of a cell or of several, in 16 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CellSummary {
    /// 0, which no θ is, where nothing is known.
    theta: f32,
    std_dev: f32,
    /// Below zero where no friction coefficient was shown.
    mu_peak: f32,
    /// Segments, and [`DISPUTED`].
    segments: u32,
}

/// What a square knows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownCell {
    /// θ.
    pub theta: f64,
    /// Its standard deviation.
    pub std_dev: f64,
    /// Largest friction coefficient shown of late.
    pub mu_peak: Option<f64>,
    /// Segments that were ever measured here, at most 2³¹ − 1.
    pub segments: u32,
    /// Whether measurements contradict each other.
    pub is_disputed: bool,
}

impl CellSummary {
    /// The same of a fused estimate.
    #[expect(
        clippy::cast_possible_truncation,
        reason = "as exact as a picture needs"
    )]
    pub fn of(fused: &Fused) -> Self {
        let segments = u32::try_from(fused.passes).unwrap_or(u32::MAX);
        let disputed = if fused.is_disputed { DISPUTED } else { 0 };
        Self {
            theta: fused.theta.value as f32,
            std_dev: fused.theta.std_dev as f32,
            mu_peak: fused.mu_peak.unwrap_or(-1.0) as f32,
            segments: segments.min(DISPUTED - 1) | disputed,
        }
    }

    /// What it knows, if anything.
    pub fn known(&self) -> Option<KnownCell> {
        (self.theta > 0.0).then(|| KnownCell {
            theta: f64::from(self.theta),
            std_dev: f64::from(self.std_dev),
            mu_peak: (self.mu_peak >= 0.0).then(|| f64::from(self.mu_peak)),
            segments: self.segments & (DISPUTED - 1),
            is_disputed: self.segments & DISPUTED != 0,
        })
    }
}

/// Which measurements count for which ground, by the numbers of the map.
#[derive(Debug, Clone)]
pub struct Lens {
    /// The ground of each terrain revision.
    grounds: Vec<u16>,
    /// What each configuration's θ is divided by; `None` for those that do not count.
    ratios: Vec<Option<f64>>,
    /// Epochs that end later do not count; seconds since 1970.
    as_of_s: Option<i64>,
}

impl Lens {
    fn sees(&self, map: &SiteMap, key: &PartKey, ground: u16) -> Option<f64> {
        let is_here = self.grounds.get(key.terrain as usize) == Some(&ground);
        let is_over = self
            .as_of_s
            .is_none_or(|as_of_s| map.end_h(key.epoch_h) * HOUR_S <= as_of_s);
        if !is_here || !is_over {
            return None;
        }
        *self.ratios.get(key.configuration as usize)?
    }
}

/// At what time and with which settings squares are fused.
#[derive(Debug, Clone, Copy)]
pub struct At<'config> {
    /// How measurements are weighed.
    pub config: &'config FrictionConfig,
    /// The time at which ages are counted, microseconds since 1970.
    pub now_us: i64,
}

/// Room that is used again from square to square.
#[derive(Debug, Default)]
pub struct Room {
    fuser: Fuser<u32>,
    seen: Vec<Seen<u32>>,
    /// Passes without information.
    uninformative_passes: u64,
}

impl SiteMap {
    /// Which measurements count: those of the chosen configuration and, by a normalisation, of all
    /// that it joins with it, on the grounds that `ground_of` numbers. None without a configuration.
    pub fn lens(
        &self,
        choice: Choice<'_>,
        ground_of: impl Fn(Option<&TerrainRef>) -> Option<u16>,
    ) -> Lens {
        let terrains = self.names.terrains.names.iter();
        let configurations = self.names.configurations.names.iter();
        Lens {
            grounds: terrains
                .map(|terrain| ground_of(terrain.as_ref()).unwrap_or(GROUND_LOST))
                .collect(),
            ratios: configurations
                .map(|&found| {
                    let (reference, ratio) = choice.brought_to(found)?;
                    (Some(reference) == choice.configuration).then_some(ratio)
                })
                .collect(),
            as_of_s: choice.as_of.map(Timestamp::as_second),
        }
    }

    /// Makes squares of a block afresh: those at `places`, or all of them. `grounds` has the ground
    /// under the middle of each cell; both lie row by row, [`BLOCK_CELLS`] to a row.
    pub fn fuse_block(
        &self,
        (block, places): (Block, Option<&[u16]>),
        grounds: &[u16],
        lens: &Lens,
        at: At<'_>,
        squares: &mut [CellSummary],
    ) {
        if places.is_none() {
            squares.fill(CellSummary::default());
        }
        let mut room = Room::default();
        let mut put = |place: u16, parts: &[Part]| {
            let index = usize::from(place);
            if let (Some(&ground), Some(square)) = (grounds.get(index), squares.get_mut(index)) {
                *square = self.square(parts, (ground, lens), at, &mut room);
            }
        };
        if let Some(places) = places {
            for &one in places {
                let parts = self.cells.get(&place(block.cell(one)));
                put(one, parts.map_or(&[], |parts| &**parts));
            }
            return;
        }
        let (first, last) = (block.first(), block.last());
        for iy in first.iy..=last.iy {
            let row = place(Cell { iy, ..first })..=place(Cell { iy, ..last });
            for (&at_place, parts) in self.cells.range(row) {
                put(Block::place(super::cell_at(at_place)), parts);
            }
        }
    }

    /// The squares of several cells each: a square of `factor` cells along its side.
    pub fn fuse_square(
        &self,
        (min, max): (Cell, Cell),
        (ground, lens): (u16, &Lens),
        at: At<'_>,
        room: &mut Room,
    ) -> CellSummary {
        let mut sums: std::collections::BTreeMap<PartKey, Sums> = std::collections::BTreeMap::new();
        for cell in self.cells_in(min, max, None) {
            for part in self.cells.get(&place(cell)).into_iter().flatten() {
                if lens.sees(self, &part.key, ground).is_some() {
                    let added = part.sums();
                    let entry = sums.entry(part.key);
                    entry.and_modify(|sums| sums.add(&added)).or_insert(added);
                }
            }
        }
        let parts: Vec<Part> = sums
            .iter()
            .map(|(&key, sums)| Part::new(key, sums))
            .collect();
        self.gather(&parts, (ground, lens), room);
        let fused = room
            .fuser
            .fuse(&mut room.seen, Ground::Area, at.config, at.now_us)
            .map(|fused| fused.with_uninformative(room.uninformative_passes));
        fused.map_or_else(CellSummary::default, |fused| CellSummary::of(&fused))
    }

    /// What a cell says of the ground with that number.
    pub fn fuse_cell(
        &self,
        cell: Cell,
        which: (u16, &Lens),
        at: At<'_>,
        room: &mut Room,
    ) -> Option<Fused> {
        self.fuse_parts(self.cells.get(&place(cell))?, which, at, room)
    }

    fn fuse_parts(
        &self,
        parts: &[Part],
        which: (u16, &Lens),
        at: At<'_>,
        room: &mut Room,
    ) -> Option<Fused> {
        self.gather(parts, which, room);
        let (fuser, seen) = (&mut room.fuser, &mut room.seen);
        let known = fuser.fuse(seen, Ground::Cell, at.config, at.now_us)?;
        Some(known.with_uninformative(room.uninformative_passes))
    }

    fn square(
        &self,
        parts: &[Part],
        which: (u16, &Lens),
        at: At<'_>,
        room: &mut Room,
    ) -> CellSummary {
        let fused = self.fuse_parts(parts, which, at, room);
        fused.map_or_else(CellSummary::default, |fused| CellSummary::of(&fused))
    }

    fn gather(&self, parts: &[Part], (ground, lens): (u16, &Lens), room: &mut Room) {
        room.seen.clear();
        room.uninformative_passes = 0;
        for part in parts {
            let Some(ratio) = lens.sees(self, &part.key, ground) else {
                continue;
            };
            let rank = self.names.robots.rank(part.key.robot);
            match part.seen(rank) {
                Some(seen) => room.seen.push(seen.scaled(ratio)),
                None => room.uninformative_passes += part.passes(),
            }
        }
    }

    /// The smallest box of whole blocks that holds everything; `None` while there is nothing.
    pub fn extent(&self) -> Option<(Cell, Cell)> {
        let mut blocks = self.changes.blocks().map(|(block, _newest)| block);
        let first = blocks.next()?;
        let (mut min, mut max) = (first, first);
        for block in blocks {
            min.column = min.column.min(block.column);
            max.column = max.column.max(block.column);
            max.row = max.row.max(block.row);
        }
        Some((min.first(), max.last()))
    }

    /// The configurations that have measured here, the one with most segments first.
    pub fn configurations(&self) -> Vec<tread_api::ids::ConfigurationId> {
        let mut segments = vec![0_u64; self.names.configurations.names.len()];
        for (key, sums) in &self.totals {
            if let Some(sum) = segments.get_mut(key.configuration as usize) {
                *sum += sums.segments;
            }
        }
        let names = self.names.configurations.names.iter().copied();
        let mut found: Vec<_> = segments.into_iter().zip(names).collect();
        found.retain(|(segments, _)| *segments > 0);
        found.sort_unstable_by(|left, right| right.0.cmp(&left.0).then(left.1.cmp(&right.1)));
        found.into_iter().map(|(_, name)| name).collect()
    }
}

/// Cells of a block.
pub const CELLS_PER_BLOCK: usize = (BLOCK_CELLS * BLOCK_CELLS).cast_unsigned() as usize;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_takes_16_bytes() {
        assert_eq!(size_of::<CellSummary>(), 16);
        assert_eq!(CellSummary::default().known(), None);
    }
}
