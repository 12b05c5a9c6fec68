//! The friction map in memory: all sums, indexed by cell and by terrain.
//!
//! The index equals the stored sums with those that are stored behind the receipts, and is updated
//! with each commit. The sums of all ground are always in memory, those of cells only for some
//! blocks ([`cells`]). Each sum of a (cell, terrain, robot, configuration, epoch) takes 168 bytes in
//! addition to its key.

mod cells;
mod changes;
mod names;
mod part;
mod partial;
mod summaries;

use std::collections::BTreeMap;

use jiff::Timestamp;
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;
use tread_store::withdrawals::Hours;

use self::cells::Blocks;
pub use self::cells::{BlockBuilder, BlockCells, Cells, MissingBlocks, Pin};
pub use self::changes::{BLOCK_CELLS, Block, Changes};
use self::names::{Names, Number};
use self::part::{Part, PartKey};
use self::partial::ReadTime;
pub use self::partial::{Measurement, PartialEpoch, Timeline};
pub use self::summaries::{
    CELLS_PER_BLOCK, CellSummary, CompiledFilter, FusionBuffers, FusionContext, GROUND_NONE,
    KnownCell,
};
use super::{EpochMeasurement, Horizons, Sums};

/// Labels of a sum.
#[derive(Debug, Clone, Copy)]
pub struct LabelledSum<'names> {
    /// Cell of the measurements.
    pub cell: Cell,
    /// Revision of the grid of `cell`; sums of another revision than the map's are ignored.
    pub grid_revision: u32,
    /// Terrain revision, if the cell is on a terrain.
    pub terrain: &'names Option<TerrainRef>,
    /// Configuration of the robot.
    pub configuration: ConfigurationId,
    /// Robot that measured.
    pub robot: &'names RobotId,
    /// Epoch of the measurements, hours since 1970.
    pub epoch_h: i64,
}

/// Friction map of one site.
#[derive(Debug, Default)]
pub struct SiteMap {
    names: Names,
    grid_revision: u32,
    horizons: Horizons,
    /// Sums by cell, of some of the blocks that `changes` lists; the others are absent.
    blocks: Blocks,
    /// Sums over all cells, for terrains.
    totals: BTreeMap<PartKey, Sums>,
    changes: Changes,
    /// Number of times that measurements may have left the map.
    removals: u64,
    /// Number of measurements of each epoch.
    segments: BTreeMap<i32, u64>,
    /// Time of the last use of blocks that come into memory.
    lru_time: u64,
}

/// Returns row and column of a cell as one number, which rises row by row.
fn place(cell: Cell) -> u64 {
    let unsigned = |index: i32| u64::from((index ^ i32::MIN).cast_unsigned());
    unsigned(cell.iy) << 32 | unsigned(cell.ix)
}

/// Changes whenever measurements may have left a map or moved to another epoch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Stamp {
    horizons: Horizons,
    removals: u64,
}

/// Filter of measurements, and the normalisation to apply.
#[derive(Debug, Clone, Copy, Default)]
pub struct Choice<'choice> {
    /// Only epochs that had ended by this time, because a sum cannot be divided in time.
    pub as_of: Option<Timestamp>,
    /// What was measured before `as_of` in the epoch that this time lies within.
    pub partial: Option<&'choice PartialEpoch>,
    /// Only this configuration.
    pub configuration: Option<ConfigurationId>,
    /// Only this robot.
    pub robot: Option<&'choice RobotId>,
    /// Ratios by which θ of other configurations is converted.
    pub normalisation: Option<&'choice Normalisation>,
}

impl<'choice> Choice<'choice> {
    fn when(&self) -> ReadTime<'choice> {
        ReadTime {
            as_of: self.as_of,
            partial: self.partial,
        }
    }

    /// Returns the configuration to whose θ the measurements of `found` are converted, and the
    /// divisor for that; `None` if they are filtered out. Configurations of the normalisation are
    /// converted to the chosen configuration, or to the reference if none is chosen.
    fn converted_to(&self, found: ConfigurationId) -> Option<(ConfigurationId, f64)> {
        let ratio = |of: ConfigurationId| self.normalisation.and_then(|joined| joined.ratio(of));
        let reference = self.normalisation.map(|joined| joined.reference);
        match (self.configuration, reference) {
            (Some(chosen), _) if chosen == found => Some((found, 1.0)),
            (Some(chosen), _) => Some((chosen, ratio(found)? / ratio(chosen)?)),
            (None, Some(reference)) => {
                Some(ratio(found).map_or((found, 1.0), |ratio| (reference, ratio)))
            }
            (None, None) => Some((found, 1.0)),
        }
    }
}

/// Ratios that convert θ between configurations.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalisation {
    /// Name of the normalisation.
    pub name: String,
    /// Reference configuration, whose ratio is 1.
    pub reference: ConfigurationId,
    /// Ratio of θ of a configuration to that of the reference on the same ground.
    pub ratios: BTreeMap<ConfigurationId, f64>,
}

impl Normalisation {
    /// Returns the ratio of a configuration; `None` if it is not part of the normalisation.
    fn ratio(&self, configuration: ConfigurationId) -> Option<f64> {
        if configuration == self.reference {
            Some(1.0)
        } else {
            self.ratios.get(&configuration).copied()
        }
    }
}

/// Measurements of one piece of ground by robots of one configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Group<'map> {
    /// Terrain revision; `None` outside of terrains, and for several revisions of a terrain
    /// together.
    pub terrain: Option<&'map TerrainRef>,
    /// Configuration for which θ is stated.
    pub configuration: ConfigurationId,
    /// Measurements of each robot in each epoch; a robot is given by the rank of its name.
    pub seen: Vec<EpochMeasurement<u32>>,
    /// Number of passes whose information is below the resolution of the sums.
    pub uninformative_passes: u64,
}

impl Group<'_> {
    /// Returns whether any pass has information.
    fn has_information(&self) -> bool {
        !self.seen.is_empty()
    }
}

impl SiteMap {
    /// Creates an empty map for a grid revision, whose epochs are merged before these horizons.
    pub fn new(grid_revision: u32, horizons: Horizons) -> Self {
        Self {
            grid_revision,
            horizons,
            ..Self::default()
        }
    }

    /// Adds sums to the map; ignores those of another grid revision.
    pub fn add(&mut self, labelled: LabelledSum<'_>, sums: &Sums) {
        self.add_cells(labelled, &[(labelled.cell, *sums)]);
    }

    /// Adds sums that agree in all labels but their cells; `labelled.cell` is ignored.
    pub fn add_cells(&mut self, labelled: LabelledSum<'_>, cells: &[(Cell, Sums)]) {
        self.add_recording(labelled, cells, Changes::record);
    }

    /// The same for sums that were measured before the map is looked at for the first time: which cells
    /// have changed is not recorded.
    pub fn load_cells(&mut self, labelled: LabelledSum<'_>, cells: &[(Cell, Sums)]) {
        self.add_recording(labelled, cells, Changes::record_block_of);
    }

    fn add_recording(
        &mut self,
        labelled: LabelledSum<'_>,
        cells: &[(Cell, Sums)],
        note: impl Fn(&mut Changes, Cell),
    ) {
        if labelled.grid_revision != self.grid_revision {
            return;
        }
        let key = self.key(labelled);
        let mut all: Option<Sums> = None;
        for (cell, sums) in cells {
            let block = Block::of(*cell);
            if self.blocks.add(*cell, key, sums) {
                note(&mut self.changes, *cell);
            } else if self.changes.contains(block) {
                // Absent: it is read with these sums when it is needed.
                self.changes.record_block_of(*cell);
            } else {
                // Nothing is stored of a block that was never driven on, so this is all of it.
                self.blocks
                    .insert(block, BlockCells::default(), self.lru_time);
                self.blocks.add(*cell, key, sums);
                note(&mut self.changes, *cell);
            }
            match &mut all {
                Some(all) => all.add(sums),
                None => all = Some(*sums),
            }
        }
        if let Some(all) = all {
            let total = self.totals.entry(key);
            total
                .and_modify(|total| total.add(&all))
                .or_insert_with(|| Sums { samples: 0, ..all });
            *self.segments.entry(key.epoch_h).or_default() += all.segments;
        }
    }

    /// Returns the key of sums with these labels.
    fn key(&mut self, labelled: LabelledSum<'_>) -> PartKey {
        PartKey {
            terrain: self.names.terrains.number(labelled.terrain),
            configuration: self.names.configurations.number(&labelled.configuration),
            robot: self.names.robots.number(labelled.robot),
            epoch_h: self.bucket(labelled.epoch_h),
        }
    }

    /// Returns the same; `None` if a name is new to the map.
    fn found_key(&self, labelled: LabelledSum<'_>) -> Option<PartKey> {
        Some(PartKey {
            terrain: self.names.terrains.find(labelled.terrain)?,
            configuration: self.names.configurations.find(&labelled.configuration)?,
            robot: self.names.robots.find(labelled.robot)?,
            epoch_h: self.bucket(labelled.epoch_h),
        })
    }

    /// Returns the first hour of the epoch that an hour belongs to.
    fn bucket(&self, hour: i64) -> i32 {
        let first_h = self.horizons.epoch_of(hour).first_h;
        i32::try_from(first_h).unwrap_or(i32::MAX)
    }

    /// Puts the cells of an absent block into memory, which were made with the present
    /// [`Self::stamp`], and adds those sums to them that they lack.
    pub fn insert<'sums>(
        &mut self,
        block: Block,
        cells: BlockCells,
        lacking: impl IntoIterator<Item = (LabelledSum<'sums>, &'sums Sums)>,
    ) {
        self.blocks.insert(block, cells, self.lru_time);
        for (labelled, sums) in lacking {
            if labelled.grid_revision == self.grid_revision {
                let key = self.key(labelled);
                self.blocks.add(labelled.cell, key, sums);
            }
        }
    }

    /// Counts blocks that come into memory from now on as used at this time, see [`Self::cells`].
    pub fn set_lru_time(&mut self, time: u64) {
        self.lru_time = time;
    }

    /// Keeps a block in memory as long as the returned pin exists, and returns its bytes; `None` if it
    /// is absent or nothing was ever measured in it.
    pub fn pin(&self, block: Block) -> Option<(Pin, usize)> {
        self.blocks.pin(block)
    }

    /// Returns the number of blocks in memory, and about how many bytes they take.
    pub fn size(&self) -> (usize, usize) {
        self.blocks.size()
    }

    /// Returns the blocks that may leave memory, with the time of the last use of each and its
    /// bytes.
    pub fn idle_blocks(&self) -> impl Iterator<Item = (u64, Block, usize)> + '_ {
        self.blocks.idle()
    }

    /// Takes the cells of a block out of memory, unless it is pinned.
    pub fn evict(&mut self, block: Block) -> Option<BlockCells> {
        let evicted = self.blocks.take(block)?;
        self.changes.discard(block);
        Some(evicted)
    }

    fn count_segments(&mut self) {
        self.segments.clear();
        for (key, sums) in &self.totals {
            *self.segments.entry(key.epoch_h).or_default() += sums.segments;
        }
    }

    /// Removes the measurements of a robot in these hours.
    pub fn withdraw(&mut self, robot: &RobotId, hours: Hours) {
        self.removals += 1;
        let Some(&robot) = self.names.robots.numbers.get(robot) else {
            return;
        };
        let is_withdrawn =
            |key: &PartKey| key.robot == robot && hours.contains(i64::from(key.epoch_h));
        self.blocks.remove(is_withdrawn);
        self.totals.retain(|key, _sums| !is_withdrawn(key));
        self.count_segments();
        // A block may have been absent, or been read after the removal from the database.
        self.changes.record_all();
    }

    /// Merges the epochs before these horizons; none is ever divided again.
    pub fn merge_before(&mut self, horizons: Horizons) {
        let horizons = self.horizons.advanced_to(horizons);
        if horizons == self.horizons {
            return;
        }
        self.horizons = horizons;
        let bucket = |key: PartKey| {
            let first_h = horizons.epoch_of(i64::from(key.epoch_h)).first_h;
            PartKey {
                epoch_h: i32::try_from(first_h).unwrap_or(i32::MAX),
                ..key
            }
        };
        self.blocks.merge(bucket);
        let mut totals: BTreeMap<PartKey, Sums> = BTreeMap::new();
        for (&key, sums) in &self.totals {
            let total = totals.entry(bucket(key));
            total.and_modify(|total| total.add(sums)).or_insert(*sums);
        }
        self.totals = totals;
        self.count_segments();
        self.changes.record_all();
    }

    /// Continues the numbering of changes of `before`, an older map of the site that this one
    /// replaces, and records a change of all cells.
    pub fn follow(&mut self, before: &Self) {
        self.changes.follow(&before.changes);
        self.removals = before.removals + 1;
    }

    /// Returns the horizons before which epochs are merged.
    pub fn horizons(&self) -> Horizons {
        self.horizons
    }

    /// Returns what changes whenever measurements may have left the map or moved to another epoch.
    pub fn stamp(&self) -> Stamp {
        Stamp {
            horizons: self.horizons,
            removals: self.removals,
        }
    }

    /// Returns the recorded changes of cells.
    pub fn changes(&self) -> &Changes {
        &self.changes
    }

    /// Returns the number of sums of (cell, terrain, robot, configuration, epoch) in memory.
    pub fn part_count(&self) -> usize {
        self.blocks.part_count()
    }

    /// Returns the robot with this rank in the order of names.
    pub fn robot_of_rank(&self, rank: u32) -> Option<&RobotId> {
        self.names.robots.numbers.keys().nth(rank as usize)
    }

    /// Returns the measurements of all terrain revisions that satisfy `is_wanted`, as one ground,
    /// summed over cells per robot and epoch, per configuration.
    pub fn terrain(
        &self,
        is_wanted: impl Fn(&TerrainRef) -> bool,
        choice: Choice<'_>,
    ) -> Vec<Group<'_>> {
        let wanted: Vec<Number> = (0..)
            .zip(&self.names.terrains.names)
            .filter(|(_, terrain)| terrain.as_ref().is_some_and(&is_wanted))
            .map(|(number, _)| number)
            .collect();
        let mut sums: BTreeMap<(ConfigurationId, u32, i32), Sums> = BTreeMap::new();
        for &terrain in &wanted {
            for (key, total) in self.totals_at(terrain, choice.when()) {
                if self.counts(&key, &choice) {
                    let configuration = *self.names.configurations.name(key.configuration);
                    let rank = self.names.robots.rank(key.robot);
                    sums.entry((configuration, rank, key.epoch_h))
                        .and_modify(|sums| sums.add(total))
                        .or_insert(*total);
                }
            }
        }
        let mut groups: BTreeMap<ConfigurationId, Group<'_>> = BTreeMap::new();
        for ((configuration, rank, epoch_h), sums) in sums {
            let Some((configuration, ratio)) = choice.converted_to(configuration) else {
                continue;
            };
            let group = groups.entry(configuration).or_insert_with(|| Group {
                terrain: None,
                configuration,
                seen: Vec::new(),
                uninformative_passes: 0,
            });
            match EpochMeasurement::of(rank, i64::from(epoch_h), &sums) {
                Some(seen) => group.seen.push(seen.scaled(ratio)),
                None => group.uninformative_passes += sums.segments,
            }
        }
        groups
            .into_values()
            .filter(Group::has_information)
            .collect()
    }

    /// Returns whether measurements of this robot and configuration are chosen.
    fn counts(&self, key: &PartKey, choice: &Choice<'_>) -> bool {
        let names = &self.names;
        choice
            .robot
            .is_none_or(|robot| names.robots.name(key.robot) == robot)
            && choice
                .converted_to(*names.configurations.name(key.configuration))
                .is_some()
    }

    /// Groups the parts of one cell, which are sorted by key, by terrain and configuration.
    fn groups(&self, parts: &[Part], choice: Choice<'_>) -> Vec<Group<'_>> {
        let mut groups: Vec<Group<'_>> = Vec::new();
        for part in parts.iter().filter(|part| self.counts(&part.key, &choice)) {
            let PartKey {
                terrain,
                configuration,
                robot,
                ..
            } = part.key;
            let rank = self.names.robots.rank(robot);
            let seen = part.seen(rank);
            let configuration = *self.names.configurations.name(configuration);
            let terrain = self.names.terrains.name(terrain).as_ref();
            let Some((configuration, ratio)) = choice.converted_to(configuration) else {
                continue;
            };
            let is_same = |group: &Group<'_>| {
                group.configuration == configuration && group.terrain == terrain
            };
            let index = groups.iter().position(is_same).unwrap_or_else(|| {
                groups.push(Group {
                    terrain,
                    configuration,
                    seen: Vec::new(),
                    uninformative_passes: 0,
                });
                groups.len() - 1
            });
            match seen {
                Some(seen) => groups[index].seen.push(seen.scaled(ratio)),
                None => groups[index].uninformative_passes += part.passes(),
            }
        }
        groups.retain(Group::has_information);
        groups.sort_unstable_by_key(|group| (group.terrain, group.configuration));
        groups
    }

    /// Returns the contribution of each robot to the map, sorted by robot.
    pub fn contributions(&self) -> Vec<Contribution> {
        let mut found: BTreeMap<Number, Contribution> = BTreeMap::new();
        for (key, sums) in &self.totals {
            let entry = found.entry(key.robot).or_insert_with(|| Contribution {
                robot: self.names.robots.name(key.robot).clone(),
                segments: 0,
                first_epoch_h: i64::MAX,
                newest_at_us: i64::MIN,
            });
            entry.segments += sums.segments;
            entry.first_epoch_h = entry.first_epoch_h.min(i64::from(key.epoch_h));
            entry.newest_at_us = entry.newest_at_us.max(sums.newest_at_us);
        }
        let mut contributions: Vec<Contribution> = found.into_values().collect();
        contributions.sort_unstable_by(|left, right| left.robot.cmp(&right.robot));
        contributions
    }
}

/// Contribution of one robot to a map.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Contribution {
    /// Identifier of the robot.
    pub robot: RobotId,
    /// Number of its segments.
    pub segments: u64,
    /// First hour of its first epoch.
    pub first_epoch_h: i64,
    /// End of its newest segment, microseconds since 1970.
    pub newest_at_us: i64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_takes_no_more_room_than_was_promised() {
        assert_eq!(size_of::<Part>(), 168);
    }

    #[test]
    fn places_sort_row_by_row() {
        let cells = [(5, -2), (-7, -1), (3, -1), (i32::MIN, 0), (0, 0), (4, 9)];
        let places: Vec<u64> = cells
            .iter()
            .map(|&(ix, iy)| place(Cell { ix, iy }))
            .collect();
        assert!(places.is_sorted(), "{places:?}");
    }
}
