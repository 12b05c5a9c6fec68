//! Summaries of cells for raster images: one estimate per cell, for one configuration and the
//! ground at the cell's centre. Allocates nothing per cell, except as of a past time.

use tread_api::friction::CellBox;
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use super::changes::{BLOCK_CELLS, Block};
use super::part::{Part, PartKey};
use super::partial::ReadTime;
use super::{Cells, Choice, SiteMap, Sums};
use crate::friction::weights::FrictionConfig;
use crate::friction::{EpochMeasurement, Fused, Fuser, Ground};

/// Number of the ground outside of all terrains.
pub const GROUND_NONE: u16 = 0;
/// Number of terrain revisions that no longer exist; never the ground of a cell.
const GROUND_LOST: u16 = u16::MAX;
/// Flag in `segments` of a disputed estimate.
const DISPUTED: u32 = 1 << 31;

/// Estimate of a square of one or several cells, in 16 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CellSummary {
    /// θ; 0 without an estimate.
    theta: f32,
    std_dev: f32,
    /// Peak friction coefficient; negative if none was measured.
    mu_peak: f32,
    /// Number of segments, with the flag [`DISPUTED`].
    segments: u32,
}

/// Unpacked estimate of a square.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownCell {
    /// Estimated θ.
    pub theta: f64,
    /// Standard deviation of θ.
    pub std_dev: f64,
    /// Recent peak friction coefficient.
    pub mu_peak: Option<f64>,
    /// Number of segments ever measured here, at most 2³¹ − 1.
    pub segments: u32,
    /// Whether the estimate is disputed, see [`Fused::is_disputed`].
    pub is_disputed: bool,
}

impl CellSummary {
    /// Packs a fused estimate.
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

    /// Unpacks the estimate; `None` without one.
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

/// Compiled filter of measurements for rasters, with the internal numbers of the map.
#[derive(Debug, Clone)]
pub struct CompiledFilter<'choice> {
    /// Number of the ground of each terrain revision.
    grounds: Vec<u16>,
    /// Divisor of θ of each configuration; `None` for configurations that are filtered out.
    ratios: Vec<Option<f64>>,
    when: ReadTime<'choice>,
}

impl CompiledFilter<'_> {
    fn ratio_of(&self, key: &PartKey, ground: u16) -> Option<f64> {
        let is_here = self.grounds.get(key.terrain as usize) == Some(&ground);
        if !is_here {
            return None;
        }
        *self.ratios.get(key.configuration as usize)?
    }
}

/// Time and settings of a fusion.
#[derive(Debug, Clone, Copy)]
pub struct FusionContext<'config> {
    /// Weights of measurements.
    pub config: &'config FrictionConfig,
    /// Time to which ages refer, microseconds since 1970.
    pub now_us: i64,
}

/// Buffers that are reused for each square of the picture.
#[derive(Debug, Default)]
pub struct FusionBuffers {
    fuser: Fuser<u32>,
    seen: Vec<EpochMeasurement<u32>>,
    /// Number of passes without information.
    uninformative_passes: u64,
}

impl SiteMap {
    /// Returns the filter for the configuration in `choice` and those that its normalisation
    /// converts to it. `ground_of` gives the number of each terrain revision's ground, `None` if it
    /// no longer exists. Without a configuration in `choice` everything is filtered out.
    pub fn filter<'choice>(
        &self,
        choice: Choice<'choice>,
        ground_of: impl Fn(Option<&TerrainRef>) -> Option<u16>,
    ) -> CompiledFilter<'choice> {
        let terrains = self.names.terrains.names.iter();
        let configurations = self.names.configurations.names.iter();
        CompiledFilter {
            grounds: terrains
                .map(|terrain| ground_of(terrain.as_ref()).unwrap_or(GROUND_LOST))
                .collect(),
            ratios: configurations
                .map(|&found| {
                    let (reference, ratio) = choice.converted_to(found)?;
                    (Some(reference) == choice.configuration).then_some(ratio)
                })
                .collect(),
            when: choice.when(),
        }
    }

    fn gather(
        &self,
        parts: &[Part],
        (ground, filter): (u16, &CompiledFilter<'_>),
        room: &mut FusionBuffers,
    ) {
        room.seen.clear();
        room.uninformative_passes = 0;
        for part in parts {
            let Some(ratio) = filter.ratio_of(&part.key, ground) else {
                continue;
            };
            let rank = self.names.robots.rank(part.key.robot);
            match part.seen(rank) {
                Some(seen) => room.seen.push(seen.scaled(ratio)),
                None => room.uninformative_passes += part.passes(),
            }
        }
    }

    /// Returns the first and last cell of the smallest rectangle of whole blocks with all
    /// measurements; `None` without any.
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

    /// Returns the configurations with measurements in this map, the one with most segments first.
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

impl Cells<'_> {
    /// Recomputes the squares of a block, those with the indices `places` or all of them. `grounds`
    /// has the number of the ground at the centre of each cell. `grounds` and `squares` are row by
    /// row, with [`BLOCK_CELLS`] per row.
    pub fn fuse_block(
        self,
        (block, places): (Block, Option<&[u16]>),
        grounds: &[u16],
        filter: &CompiledFilter<'_>,
        at: FusionContext<'_>,
        squares: &mut [CellSummary],
    ) {
        if places.is_none() {
            squares.fill(CellSummary::default());
        }
        let mut room = FusionBuffers::default();
        let mut put = |place: u16, parts: &[Part]| {
            let index = usize::from(place);
            if let (Some(&ground), Some(square)) = (grounds.get(index), squares.get_mut(index)) {
                *square = self.square(parts, (ground, filter), at, &mut room);
            }
        };
        if let Some(places) = places {
            for &one in places {
                put(one, &self.parts_at(block.cell(one), filter.when));
            }
            return;
        }
        for (&one, parts) in self.of_block(block).into_iter().flatten() {
            let at_place = super::place(block.cell(one));
            put(one, &self.map().parts_then((at_place, parts), filter.when));
        }
    }

    /// Returns the estimate of one square with the cells of a box on the given ground.
    pub fn fuse_square(
        self,
        area: CellBox,
        (ground, filter): (u16, &CompiledFilter<'_>),
        at: FusionContext<'_>,
        room: &mut FusionBuffers,
    ) -> CellSummary {
        let mut sums: std::collections::BTreeMap<PartKey, Sums> = std::collections::BTreeMap::new();
        for cell in self.cells_in(area, None) {
            for part in &*self.parts_at(cell, filter.when) {
                if filter.ratio_of(&part.key, ground).is_some() {
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
        self.map().gather(&parts, (ground, filter), room);
        let fused = room
            .fuser
            .fuse(&mut room.seen, Ground::Area, at.config, at.now_us)
            .map(|fused| fused.with_uninformative(room.uninformative_passes));
        fused.map_or_else(CellSummary::default, |fused| CellSummary::of(&fused))
    }

    /// Fuses the measurements of a cell on the ground with the number in `which`; `None` without
    /// any.
    pub fn fuse_cell(
        self,
        cell: Cell,
        which: (u16, &CompiledFilter<'_>),
        at: FusionContext<'_>,
        room: &mut FusionBuffers,
    ) -> Option<Fused> {
        let parts = self.parts_at(cell, which.1.when);
        self.fuse_parts(&parts, which, at, room)
    }

    fn fuse_parts(
        self,
        parts: &[Part],
        which: (u16, &CompiledFilter<'_>),
        at: FusionContext<'_>,
        room: &mut FusionBuffers,
    ) -> Option<Fused> {
        self.map().gather(parts, which, room);
        let (fuser, seen) = (&mut room.fuser, &mut room.seen);
        let known = fuser.fuse(seen, Ground::Cell, at.config, at.now_us)?;
        Some(known.with_uninformative(room.uninformative_passes))
    }

    fn square(
        self,
        parts: &[Part],
        which: (u16, &CompiledFilter<'_>),
        at: FusionContext<'_>,
        room: &mut FusionBuffers,
    ) -> CellSummary {
        let fused = self.fuse_parts(parts, which, at, room);
        fused.map_or_else(CellSummary::default, |fused| CellSummary::of(&fused))
    }
}

/// Number of cells of a block.
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
