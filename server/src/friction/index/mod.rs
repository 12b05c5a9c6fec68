//! The friction map in memory: all sums, indexed by cell and by terrain.
//!
//! The index equals the stored sums with those that are stored behind the receipts, and is updated
//! with each commit. Cells are sorted row by row, so a rectangle is a few ranges of neighbours. Each
//! sum of a (cell, terrain, robot, configuration, epoch) takes 168 bytes in addition to its key.

mod changes;
mod names;
mod part;
mod partial;
mod summaries;

use std::collections::BTreeMap;
use std::ops::Bound;

use jiff::Timestamp;
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

pub use self::changes::{BLOCK_CELLS, Block, Changes};
use self::names::{Names, Number};
use self::part::{Part, PartKey};
use self::partial::When;
pub use self::partial::{Measurement, PartialEpoch, Timeline};
pub use self::summaries::{
    At, CELLS_PER_BLOCK, CellSummary, CompiledFilter, GROUND_NONE, KnownCell, Room,
};
use super::{Horizons, Seen, Sums};

/// Labels of a sum.
#[derive(Debug, Clone, Copy)]
pub struct Labelled<'names> {
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
    /// Sums by cell; the key has row and column, shifted to unsigned numbers, see [`place`].
    cells: BTreeMap<u64, Box<[Part]>>,
    /// Sums over all cells, for terrains.
    totals: BTreeMap<PartKey, Sums>,
    changes: Changes,
    /// Number of times that measurements may have left the map.
    removals: u64,
    /// Number of measurements of each epoch.
    segments: BTreeMap<i32, u64>,
}

fn place(cell: Cell) -> u64 {
    let unsigned = |index: i32| u64::from((index ^ i32::MIN).cast_unsigned());
    unsigned(cell.iy) << 32 | unsigned(cell.ix)
}

fn cell_at(place: u64) -> Cell {
    let signed = |bits: u64| (u32::try_from(bits).unwrap_or_default().cast_signed()) ^ i32::MIN;
    Cell {
        ix: signed(place & 0xFFFF_FFFF),
        iy: signed(place >> 32),
    }
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
    fn when(&self) -> When<'choice> {
        When {
            as_of: self.as_of,
            partial: self.partial,
        }
    }

    /// Returns the configuration to whose θ the measurements of `found` are converted, and the
    /// divisor for that; `None` if they are filtered out. Configurations of the normalisation are
    /// converted to the chosen configuration, or to the reference if none is chosen.
    fn brought_to(&self, found: ConfigurationId) -> Option<(ConfigurationId, f64)> {
        let ratio = |of: ConfigurationId| self.normalisation.and_then(|joined| joined.ratio(of));
        let reference = self.normalisation.map(|joined| joined.reference);
        match (self.configuration, reference) {
            (Some(asked), _) if asked == found => Some((found, 1.0)),
            (Some(asked), _) => Some((asked, ratio(found)? / ratio(asked)?)),
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
    pub seen: Vec<Seen<u32>>,
    /// Number of passes whose information is below the resolution of the sums.
    pub uninformative_passes: u64,
}

impl Group<'_> {
    /// Returns whether any pass has information.
    fn tells(&self) -> bool {
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
    pub fn add(&mut self, labelled: Labelled<'_>, sums: &Sums) {
        self.add_cells(labelled, &[(labelled.cell, *sums)]);
    }

    /// Adds sums that agree in all labels but their cells; `labelled.cell` is ignored.
    pub fn add_cells(&mut self, labelled: Labelled<'_>, cells: &[(Cell, Sums)]) {
        if labelled.grid_revision != self.grid_revision {
            return;
        }
        let epoch_h = self.horizons.epoch_of(labelled.epoch_h).first_h;
        let key = PartKey {
            terrain: self.names.terrains.number(labelled.terrain),
            configuration: self.names.configurations.number(&labelled.configuration),
            robot: self.names.robots.number(labelled.robot),
            epoch_h: i32::try_from(epoch_h).unwrap_or(i32::MAX),
        };
        let mut all: Option<Sums> = None;
        for (cell, sums) in cells {
            self.add_part(*cell, key, sums);
            self.changes.note(*cell);
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

    fn add_part(&mut self, cell: Cell, key: PartKey, sums: &Sums) {
        let parts = self.cells.entry(place(cell)).or_default();
        match parts.binary_search_by_key(&key, |part| part.key) {
            Ok(index) => parts[index].add(sums),
            Err(index) => {
                let mut longer = Vec::with_capacity(parts.len() + 1);
                longer.extend_from_slice(&parts[..index]);
                longer.push(Part::new(key, sums));
                longer.extend_from_slice(&parts[index..]);
                *parts = longer.into_boxed_slice();
            }
        }
    }

    fn count_segments(&mut self) {
        self.segments.clear();
        for (key, sums) in &self.totals {
            *self.segments.entry(key.epoch_h).or_default() += sums.segments;
        }
    }

    /// Removes the measurements of a robot from hour `from_h` to hour `to_h`, both included.
    pub fn withdraw(&mut self, robot: &RobotId, (from_h, to_h): (i64, i64)) {
        self.removals += 1;
        let Some(&robot) = self.names.robots.numbers.get(robot) else {
            return;
        };
        let goes =
            |key: &PartKey| key.robot == robot && (from_h..=to_h).contains(&i64::from(key.epoch_h));
        let mut changed = Vec::new();
        for (&place, parts) in &mut self.cells {
            if parts.iter().any(|part| goes(&part.key)) {
                let kept = parts.iter().filter(|part| !goes(&part.key));
                *parts = kept.copied().collect();
                changed.push(cell_at(place));
            }
        }
        self.cells.retain(|_place, parts| !parts.is_empty());
        self.totals.retain(|key, _sums| !goes(key));
        self.count_segments();
        for cell in changed {
            self.changes.note(cell);
        }
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
        for parts in self.cells.values_mut() {
            if parts.iter().all(|part| bucket(part.key) == part.key) {
                continue;
            }
            let mut merged: Vec<Part> = Vec::with_capacity(parts.len());
            for part in &*parts {
                let key = bucket(part.key);
                match merged.last_mut().filter(|last| last.key == key) {
                    Some(last) => last.add(&part.sums()),
                    None => merged.push(part.moved(key)),
                }
            }
            *parts = merged.into_boxed_slice();
        }
        let mut totals: BTreeMap<PartKey, Sums> = BTreeMap::new();
        for (&key, sums) in &self.totals {
            let total = totals.entry(bucket(key));
            total.and_modify(|total| total.add(sums)).or_insert(*sums);
        }
        self.totals = totals;
        self.count_segments();
        self.changes.note_all();
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

    /// Returns the number of sums of (cell, terrain, robot, configuration, epoch).
    pub fn part_count(&self) -> usize {
        self.cells.values().map(|parts| parts.len()).sum()
    }

    /// Returns the measurements of one cell, per terrain and configuration.
    pub fn cell(&self, cell: Cell, choice: Choice<'_>) -> Vec<Group<'_>> {
        self.groups(&self.parts_at(place(cell), choice.when()), choice)
    }

    /// Returns the end of the newest pass through a cell, microseconds since 1970; `None` without
    /// one.
    pub fn newest_at_us(&self, cell: Cell, choice: Choice<'_>) -> Option<i64> {
        let parts = self.parts_at(place(cell), choice.when());
        let counted = parts.iter().filter(|part| self.counts(&part.key, &choice));
        counted.map(|part| part.newest_at_us).max()
    }

    /// Returns the robot with this rank in the order of names.
    pub fn robot_of_rank(&self, rank: u32) -> Option<&RobotId> {
        self.names.robots.numbers.keys().nth(rank as usize)
    }

    /// Returns the measurements of several cells together, summed per robot and epoch, per terrain
    /// and configuration.
    pub fn area(&self, cells: &[Cell], choice: Choice<'_>) -> Vec<Group<'_>> {
        let mut sums: BTreeMap<PartKey, Sums> = BTreeMap::new();
        for &cell in cells {
            for part in &*self.parts_at(place(cell), choice.when()) {
                if self.counts(&part.key, &choice) {
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
        self.groups(&parts, choice)
    }

    /// Returns the cells with measurements in the rectangle from `min` to `max`, both included, row
    /// by row; those after the cell `after` if it is given.
    pub fn cells_in(
        &self,
        min: Cell,
        max: Cell,
        after: Option<Cell>,
    ) -> impl Iterator<Item = Cell> + '_ {
        let start = match after {
            Some(after) if place(after) >= place(min) => Bound::Excluded(place(after)),
            Some(_) | None => Bound::Included(place(min)),
        };
        let mut next = start;
        std::iter::from_fn(move || {
            loop {
                let last = Bound::Included(place(max));
                if let (Bound::Included(low) | Bound::Excluded(low), Bound::Included(high)) =
                    (next, last)
                    && (low > high || (low == high && matches!(next, Bound::Excluded(_))))
                {
                    return None;
                }
                let (&found, _parts) = self.cells.range((next, last)).next()?;
                let cell = cell_at(found);
                if cell.ix < min.ix {
                    next = Bound::Included(place(Cell { ix: min.ix, ..cell }));
                } else if cell.ix > max.ix {
                    // Continue with the next row, if there is one.
                    let iy = cell.iy.checked_add(1)?;
                    next = Bound::Included(place(Cell { ix: min.ix, iy }));
                } else {
                    next = Bound::Excluded(found);
                    return Some(cell);
                }
            }
        })
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
            let Some((configuration, ratio)) = choice.brought_to(configuration) else {
                continue;
            };
            let group = groups.entry(configuration).or_insert_with(|| Group {
                terrain: None,
                configuration,
                seen: Vec::new(),
                uninformative_passes: 0,
            });
            match Seen::of(rank, i64::from(epoch_h), &sums) {
                Some(seen) => group.seen.push(seen.scaled(ratio)),
                None => group.uninformative_passes += sums.segments,
            }
        }
        groups.into_values().filter(Group::tells).collect()
    }

    /// Returns whether measurements of this robot and configuration are chosen.
    fn counts(&self, key: &PartKey, choice: &Choice<'_>) -> bool {
        let names = &self.names;
        choice
            .robot
            .is_none_or(|robot| names.robots.name(key.robot) == robot)
            && choice
                .brought_to(*names.configurations.name(key.configuration))
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
            let Some((configuration, ratio)) = choice.brought_to(configuration) else {
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
        groups.retain(Group::tells);
        groups.sort_unstable_by_key(|group| (group.terrain, group.configuration));
        groups
    }

    /// Returns the contribution of each robot to the map, sorted by robot.
    pub fn contributions(&self) -> Vec<Contribution> {
        let mut found: BTreeMap<Number, Contribution> = BTreeMap::new();
        let mut note = |key: &PartKey, cells: u64, sums: Option<&Sums>| {
            let entry = found.entry(key.robot).or_insert_with(|| Contribution {
                robot: self.names.robots.name(key.robot).clone(),
                cells: 0,
                segments: 0,
                first_epoch_h: i64::MAX,
                newest_at_us: i64::MIN,
            });
            entry.cells += cells;
            if let Some(sums) = sums {
                entry.segments += sums.segments;
                entry.first_epoch_h = entry.first_epoch_h.min(i64::from(key.epoch_h));
                entry.newest_at_us = entry.newest_at_us.max(sums.newest_at_us);
            }
        };
        for (key, sums) in &self.totals {
            note(key, 0, Some(sums));
        }
        for parts in self.cells.values() {
            let mut robots: Vec<&PartKey> = parts.iter().map(|part| &part.key).collect();
            robots.sort_unstable_by_key(|key| key.robot);
            robots.dedup_by_key(|key| key.robot);
            for key in robots {
                note(key, 1, None);
            }
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
    /// Number of cells that it has measured.
    pub cells: u64,
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
    fn places_sort_row_by_row_and_give_back_their_cell() {
        let cells = [(5, -2), (-7, -1), (3, -1), (i32::MIN, 0), (0, 0), (4, 9)];
        let places: Vec<u64> = cells
            .iter()
            .map(|&(ix, iy)| place(Cell { ix, iy }))
            .collect();
        assert!(places.is_sorted(), "{places:?}");
        for ((ix, iy), place) in cells.into_iter().zip(places) {
            assert_eq!(cell_at(place), Cell { ix, iy });
        }
    }
}
