//! The map as of a time within an epoch.
//!
//! The sum of an epoch cannot be divided in time. Where the raw measurements of the epoch are still
//! there ([`Timeline`]), those from before the time are summed again ([`PartialEpoch`]), and take
//! the place of the sum of the whole epoch.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;

use jiff::Timestamp;
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use super::names::{Names, Number};
use super::part::{Part, PartKey};
use super::{SiteMap, Sums, place};
use crate::friction::epochs::HOUR_S;
use crate::friction::{Epoch, epoch_h};

/// A raw measurement with what its sum is stored under.
#[derive(Debug, Clone)]
pub struct Measurement {
    /// Its end, microseconds since 1970.
    pub ended_at_us: i64,
    /// Cell.
    pub cell: Cell,
    /// Terrain revision, if the cell is on a terrain.
    pub terrain: Option<TerrainRef>,
    /// Configuration of the robot.
    pub configuration: ConfigurationId,
    /// Robot that measured.
    pub robot: RobotId,
    /// Its sums.
    pub sums: Sums,
}

#[derive(Debug, Clone, Copy)]
struct Row {
    ended_at_us: i64,
    place: u64,
    part: Part,
}

/// All raw measurements of one epoch that are on the map, in the order of their ends. Each takes
/// 184 bytes.
#[derive(Debug, Clone, Default)]
pub struct Timeline {
    epoch_h: i32,
    names: Names,
    rows: Vec<Row>,
}

impl Timeline {
    /// Creates an empty timeline of an epoch.
    pub fn new(epoch: Epoch) -> Self {
        Self {
            epoch_h: i32::try_from(epoch.first_h).unwrap_or(i32::MAX),
            ..Self::default()
        }
    }

    /// Returns the number of measurements.
    pub fn count(&self) -> usize {
        self.rows.len()
    }

    /// Adds measurements of the epoch.
    pub fn extend(&mut self, measurements: impl IntoIterator<Item = Measurement>) {
        for measurement in measurements {
            let key = PartKey {
                terrain: self.names.terrains.number(&measurement.terrain),
                configuration: self.names.configurations.number(&measurement.configuration),
                robot: self.names.robots.number(&measurement.robot),
                epoch_h: self.epoch_h,
            };
            self.rows.push(Row {
                ended_at_us: measurement.ended_at_us,
                place: place(measurement.cell),
                part: Part::new(key, &measurement.sums),
            });
        }
        // Fast for what is mostly in order already.
        self.rows.sort_by_key(|row| row.ended_at_us);
    }
}

/// Sums of the measurements of an epoch from before a time.
#[derive(Debug, Default)]
pub struct PartialEpoch {
    of: Arc<Timeline>,
    /// Number of measurements that are summed, from the first.
    summed: usize,
    cells: BTreeMap<u64, Vec<Part>>,
    totals: BTreeMap<PartKey, Sums>,
}

impl PartialEpoch {
    /// Sums the measurements that ended before a time, microseconds since 1970.
    pub fn before(of: Arc<Timeline>, at_us: i64) -> Self {
        let mut partial = Self {
            of,
            ..Self::default()
        };
        partial.advance(at_us);
        partial
    }

    /// Adds those that ended before a later time.
    pub fn advance(&mut self, at_us: i64) {
        let rest = self.of.rows.get(self.summed..).unwrap_or_default();
        let rows = rest.iter().take_while(|row| row.ended_at_us < at_us);
        for row in rows {
            let sums = row.part.sums();
            let parts = self.cells.entry(row.place);
            let parts = parts.or_insert_with(|| Vec::with_capacity(1));
            match parts.iter_mut().find(|part| part.key == row.part.key) {
                Some(part) => part.add(&sums),
                None => parts.push(row.part),
            }
            let total = self.totals.entry(row.part.key);
            total.and_modify(|total| total.add(&sums)).or_insert(sums);
            self.summed += 1;
        }
    }

    /// Returns the timeline of which this is the beginning.
    pub fn timeline(&self) -> &Arc<Timeline> {
        &self.of
    }
}

/// Time as of which the map is read.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ReadTime<'partial> {
    /// Only epochs that were over by this time; `None` for all.
    pub(super) as_of: Option<Timestamp>,
    /// What was measured before that time in the epoch that it lies within.
    pub(super) partial: Option<&'partial PartialEpoch>,
}

impl SiteMap {
    /// Returns the epoch that a time lies in.
    pub fn epoch_at(&self, at: Timestamp) -> Epoch {
        self.horizons.epoch_of(epoch_h(at))
    }

    /// Returns the number of measurements of an epoch that are on the map.
    pub fn measurements_of(&self, epoch: Epoch) -> u64 {
        let first_h = i32::try_from(epoch.first_h).unwrap_or(i32::MAX);
        self.segments.get(&first_h).copied().unwrap_or(0)
    }

    /// Returns those of a cell's parts that count at a time.
    pub(super) fn parts_then<'map>(
        &'map self,
        (place, parts): (u64, &'map [Part]),
        when: ReadTime<'_>,
    ) -> Cow<'map, [Part]> {
        let Some(as_of) = when.as_of else {
            return Cow::Borrowed(parts);
        };
        let over = parts.iter().filter(|part| self.is_over(&part.key, as_of));
        let mut then: Vec<Part> = over.copied().collect();
        if let Some(partial) = when.partial {
            let parts = partial.cells.get(&place).into_iter().flatten();
            then.extend(parts.filter_map(|part| Some(part.moved(self.key_of(partial, part.key)?))));
            then.sort_unstable_by_key(|part| part.key);
        }
        Cow::Owned(then)
    }

    /// Returns the sums over all cells that count at a time.
    pub(super) fn totals_at<'map>(
        &'map self,
        terrain: Number,
        when: ReadTime<'map>,
    ) -> impl Iterator<Item = (PartKey, &'map Sums)> {
        let first = PartKey {
            terrain,
            configuration: 0,
            robot: 0,
            epoch_h: i32::MIN,
        };
        let of_terrain = self.totals.range(first..);
        let of_terrain = of_terrain.take_while(move |(key, _)| key.terrain == terrain);
        let over = of_terrain
            .filter(move |(key, _)| when.as_of.is_none_or(|as_of| self.is_over(key, as_of)));
        let partial = when.partial.into_iter().flat_map(move |partial| {
            let totals = partial.totals.iter();
            let named = totals.filter_map(|(key, sums)| Some((self.key_of(partial, *key)?, sums)));
            named.filter(move |(key, _)| key.terrain == terrain)
        });
        over.map(|(key, sums)| (*key, sums)).chain(partial)
    }

    fn is_over(&self, key: &PartKey, as_of: Timestamp) -> bool {
        let epoch = self.horizons.epoch_of(i64::from(key.epoch_h));
        epoch.end_h * HOUR_S <= as_of.as_second()
    }

    /// Returns a key of a partial epoch with the numbers of this map; `None` if a name is new to
    /// it, as after a withdrawal.
    fn key_of(&self, partial: &PartialEpoch, key: PartKey) -> Option<PartKey> {
        let (own, names) = (&self.names, &partial.of.names);
        Some(PartKey {
            terrain: own.terrains.find(names.terrains.name(key.terrain))?,
            configuration: own
                .configurations
                .find(names.configurations.name(key.configuration))?,
            robot: own.robots.find(names.robots.name(key.robot))?,
            epoch_h: key.epoch_h,
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use uuid::Uuid;

    use super::super::{Choice, FusionBuffers, FusionContext, Group, LabelledSum, MissingBlocks};
    use super::*;
    use crate::friction::EpochMeasurement;
    use crate::friction::epochs::{DAY_H, Horizons};
    use crate::friction::tests::{at_us, measured};
    use crate::friction::weights::FrictionConfig;

    /// Beyond two months, so that all kinds of epochs occur.
    const HOURS: i64 = 70 * DAY_H;

    fn configuration(number: u8) -> ConfigurationId {
        ConfigurationId::from_uuid(Uuid::from_u128(u128::from(number)))
    }

    fn terrain(number: u8) -> Option<TerrainRef> {
        (number > 0).then(|| TerrainRef {
            id: "lawn".parse().unwrap(),
            revision: u32::from(number),
        })
    }

    fn measurement() -> impl Strategy<Value = Measurement> {
        let labels = (0_u8..4, 0..3_i32, 0_u8..3, 0_u8..2);
        (labels, 0.05_f64..1.0, 0.01_f64..0.2, 0..HOURS * HOUR_S).prop_map(
            |((robot, ix, ground, of), theta, std_dev, age_s)| Measurement {
                ended_at_us: at_us(age_s),
                cell: Cell { ix, iy: 0 },
                terrain: terrain(ground),
                configuration: configuration(of),
                robot: format!("rover-{robot}").parse().unwrap(),
                sums: measured(theta, std_dev, age_s),
            },
        )
    }

    fn add(map: &mut SiteMap, measurement: &Measurement) {
        let at = Timestamp::from_microsecond(measurement.ended_at_us).unwrap();
        let labelled = LabelledSum {
            cell: measurement.cell,
            grid_revision: 1,
            terrain: &measurement.terrain,
            configuration: measurement.configuration,
            robot: &measurement.robot,
            epoch_h: epoch_h(at),
        };
        map.add(labelled, &measurement.sums);
    }

    fn map_of<'all>(
        horizons: Horizons,
        measurements: impl IntoIterator<Item = &'all Measurement>,
    ) -> SiteMap {
        let mut map = SiteMap::new(1, horizons);
        for measurement in measurements {
            add(&mut map, measurement);
        }
        map
    }

    /// Returns the groups with the names of robots in the place of their ranks.
    fn named(
        map: &SiteMap,
        groups: Vec<Group<'_>>,
    ) -> Vec<(String, Vec<EpochMeasurement<String>>)> {
        let of_group = |group: Group<'_>| {
            let mut seen: Vec<EpochMeasurement<String>> = group
                .seen
                .iter()
                .map(|seen| EpochMeasurement {
                    robot: map.robot_of_rank(seen.robot).unwrap().to_string(),
                    epoch_h: seen.epoch_h,
                    theta: seen.theta,
                    robot_ratio: seen.robot_ratio,
                    tyre_ratio: seen.tyre_ratio,
                    scatter: seen.scatter,
                    passes: seen.passes,
                    newest_at_us: seen.newest_at_us,
                    newest: seen.newest,
                    newest_mu: seen.newest_mu,
                    mu_peak: seen.mu_peak,
                    track: seen.track,
                    rolling: seen.rolling,
                })
                .collect();
            seen.sort_by(|left, right| {
                (&left.robot, left.epoch_h).cmp(&(&right.robot, right.epoch_h))
            });
            let of = format!("{:?} {:?}", group.terrain, group.configuration);
            (of, seen)
        };
        groups.into_iter().map(of_group).collect()
    }

    proptest! {
        #[test]
        fn as_of_a_time_within_an_epoch_the_map_is_that_of_what_was_measured_before(
            measurements in prop::collection::vec(measurement(), 1..60),
            age_s in 0..HOURS * HOUR_S,
            horizon_ages_h in (0_i64..HOURS, 0_i64..HOURS),
            cut in 0_usize..60,
            earlier_s in 0_i64..HOUR_S,
        ) {
            let as_of_us = at_us(age_s);
            let as_of = Timestamp::from_microsecond(as_of_us).unwrap();
            let newest_h = epoch_h(Timestamp::from_microsecond(at_us(0)).unwrap());
            let month = Horizons { months_before_h: i64::MAX, ..Horizons::default() };
            let horizons = Horizons {
                days_before_h: (newest_h - horizon_ages_h.0).div_euclid(DAY_H) * DAY_H,
                months_before_h: month.epoch_of(newest_h - horizon_ages_h.0.max(horizon_ages_h.1)).first_h,
            };
            let map = map_of(horizons, &measurements);
            let epoch = map.epoch_at(as_of);
            let of_epoch = |found: &&Measurement| {
                let at = Timestamp::from_microsecond(found.ended_at_us).unwrap();
                epoch.includes_h(epoch_h(at))
            };
            let (first, second) = measurements.split_at(cut.min(measurements.len()));
            let mut timeline = Timeline::new(epoch);
            timeline.extend(second.iter().filter(of_epoch).cloned());
            timeline.extend(first.iter().filter(of_epoch).cloned());
            prop_assert_eq!(map.measurements_of(epoch), timeline.count() as u64);
            let mut partial = PartialEpoch::before(Arc::new(timeline), as_of_us - earlier_s * 1_000_000);
            partial.advance(as_of_us);

            let then: Vec<&Measurement> = measurements
                .iter()
                .filter(|found| found.ended_at_us < as_of_us)
                .collect();
            let expected = map_of(horizons, then.iter().copied());
            let choice = Choice {
                as_of: Some(as_of),
                partial: Some(&partial),
                configuration: Some(configuration(0)),
                ..Choice::default()
            };
            let present = Choice { as_of: None, partial: None, ..choice };
            let absent = MissingBlocks::default();
            let cells = [0, 1, 2].map(|ix| Cell { ix, iy: 0 });
            let is_lawn = |_: &TerrainRef| true;
            prop_assert_eq!(
                named(&map, map.terrain(is_lawn, choice)),
                named(&expected, expected.terrain(is_lawn, present))
            );
            prop_assert_eq!(
                named(&map, map.cells(&absent, 1).area(&cells, choice)),
                named(&expected, expected.cells(&absent, 1).area(&cells, present))
            );
            let config = FrictionConfig::default();
            let at = FusionContext { config: &config, now_us: as_of_us };
            let ground_of = |found: Option<&TerrainRef>| Some(found.map_or(0, |_| 1));
            for cell in cells {
                prop_assert_eq!(
                    named(&map, map.cells(&absent, 1).cell(cell, choice)),
                    named(&expected, expected.cells(&absent, 1).cell(cell, present))
                );
                prop_assert_eq!(map.cells(&absent, 1).newest_at_us(cell, choice), expected.cells(&absent, 1).newest_at_us(cell, present));
                let seen = |map: &SiteMap, choice| {
                    let filter = map.filter(choice, ground_of);
                    let mut buffers = FusionBuffers::default();
                    map.cells(&absent, 1).fuse_cell(cell, (1, &filter), at, &mut buffers)
                };
                prop_assert_eq!(seen(&map, choice), seen(&expected, present));
            }
        }
    }
}
