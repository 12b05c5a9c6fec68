use std::collections::BTreeMap;

use jiff::Timestamp;
use proptest::prelude::*;
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::terrain::TerrainRef;
use tread_store::withdrawals::Hours;
use uuid::Uuid;

use super::super::{
    CELLS_PER_BLOCK, CellSummary, FusionBuffers, FusionContext, Horizons, LabelledSum,
};
use super::*;
use crate::friction::epoch_h;
use crate::friction::epochs::{DAY_H, HOUR_S};
use crate::friction::tests::{at_us, measured};
use crate::friction::weights::FrictionConfig;

/// Beyond two months, so that all kinds of epochs occur.
const HOURS: i64 = 70 * DAY_H;

/// What a sum is stored under, by numbers.
type Key = (u8, i64, i32, i32, u8, u8);

#[derive(Debug, Clone)]
enum Step {
    Add(Key, f64),
    Withdraw(u8, i64, i64),
    /// Ages of the horizons of days and months, hours.
    Merge(i64, i64),
    Evict(i32, i32),
    Load(i32, i32),
}

fn newest_h() -> i64 {
    epoch_h(Timestamp::from_microsecond(at_us(0)).unwrap())
}

fn coordinate() -> impl Strategy<Value = i32> {
    prop_oneof![-70..70_i32, Just(-64), Just(63), Just(64)]
}

fn step() -> impl Strategy<Value = Step> {
    let key = (
        0_u8..3,
        0..HOURS,
        coordinate(),
        coordinate(),
        0_u8..3,
        0_u8..2,
    );
    prop_oneof![
        8 => (key, 0.05_f64..1.0).prop_map(|(key, theta)| Step::Add(key, theta)),
        1 => (0_u8..4, 0..HOURS, 0..HOURS)
            .prop_map(|(robot, one, other)| Step::Withdraw(robot, one.max(other), one.min(other))),
        1 => (0..HOURS, 0..HOURS)
            .prop_map(|(one, other)| Step::Merge(one.min(other), one.max(other))),
        4 => (-2..2_i32, -2..2_i32).prop_map(|(row, column)| Step::Evict(row, column)),
        4 => (-2..2_i32, -2..2_i32).prop_map(|(row, column)| Step::Load(row, column)),
    ]
}

fn robot(number: u8) -> RobotId {
    // Not in the order of the numbers.
    ["rover-b", "rover-c", "rover-a", "rover-d"][usize::from(number)]
        .parse()
        .unwrap()
}

fn terrain(number: u8) -> Option<TerrainRef> {
    (number > 0).then(|| TerrainRef {
        id: "lawn".parse().unwrap(),
        revision: u32::from(number),
    })
}

fn configuration(number: u8) -> ConfigurationId {
    ConfigurationId::from_uuid(Uuid::from_u128(u128::from(number)))
}

/// The names in a key.
struct Named(RobotId, Option<TerrainRef>);

impl Named {
    fn of(key: Key) -> Self {
        Self(robot(key.0), terrain(key.4))
    }

    fn labelled(&self, key: Key) -> LabelledSum<'_> {
        LabelledSum {
            cell: Cell {
                ix: key.2,
                iy: key.3,
            },
            grid_revision: 1,
            terrain: &self.1,
            configuration: configuration(key.5),
            robot: &self.0,
            epoch_h: newest_h() - key.1,
        }
    }
}

/// Reads a block of the stored sums.
fn load(map: &mut SiteMap, stored: &BTreeMap<Key, Sums>, block: Block) {
    let of_block = |(key, _): &(&Key, &Sums)| {
        let cell = Cell {
            ix: key.2,
            iy: key.3,
        };
        Block::of(cell) == block
    };
    let mut cells = BlockBuilder::default();
    for (&key, sums) in stored.iter().filter(of_block) {
        let named = Named::of(key);
        assert!(cells.add(map, named.labelled(key), sums));
    }
    map.insert(block, cells.build(), []);
}

/// Looks until all blocks are there.
fn look<T>(map: &mut SiteMap, stored: &BTreeMap<Key, Sums>, look: impl Fn(Cells<'_>) -> T) -> T {
    loop {
        let absent = MissingBlocks::default();
        let found = look(map.cells(&absent, 1));
        let absent = absent.into_blocks();
        if absent.is_empty() {
            return found;
        }
        for block in absent {
            load(map, stored, block);
        }
    }
}

fn take(step: &Step, kept: &mut SiteMap, evicting: &mut SiteMap, stored: &mut BTreeMap<Key, Sums>) {
    match *step {
        Step::Add(key, theta) => {
            let sums = measured(theta, 0.1, key.1 * HOUR_S);
            let named = Named::of(key);
            kept.add(named.labelled(key), &sums);
            evicting.add(named.labelled(key), &sums);
            let entry = stored.entry(key);
            entry.and_modify(|stored| stored.add(&sums)).or_insert(sums);
        }
        Step::Withdraw(of, oldest, newest) => {
            let hours = Hours {
                from_h: newest_h() - oldest,
                to_h: newest_h() - newest,
            };
            kept.withdraw(&robot(of), hours);
            evicting.withdraw(&robot(of), hours);
            stored.retain(|key, _| {
                let first_h = i64::from(kept.bucket(newest_h() - key.1));
                key.0 != of || !hours.contains(first_h)
            });
        }
        Step::Merge(days, months) => {
            let of_months = Horizons {
                months_before_h: i64::MAX,
                ..Horizons::default()
            };
            let horizons = Horizons {
                days_before_h: (newest_h() - days).div_euclid(DAY_H) * DAY_H,
                months_before_h: of_months.epoch_of(newest_h() - months).first_h,
            };
            kept.merge_before(horizons);
            evicting.merge_before(horizons);
        }
        Step::Evict(row, column) => {
            evicting.evict(Block { row, column });
        }
        Step::Load(row, column) => {
            let block = Block { row, column };
            if evicting.changes().contains(block) && evicting.pin(block).is_none() {
                load(evicting, stored, block);
            }
        }
    }
}

proptest! {
    #[test]
    fn a_map_whose_blocks_leave_memory_answers_as_one_that_keeps_them(
        steps in prop::collection::vec(step(), 1..60),
    ) {
        let mut kept = SiteMap::new(1, Horizons::default());
        let mut evicting = SiteMap::new(1, Horizons::default());
        let mut stored = BTreeMap::new();
        for step in &steps {
            take(step, &mut kept, &mut evicting, &mut stored);
        }
        let never = MissingBlocks::default();
        let all = kept.cells(&never, 1);
        let area = CellBox { min: Cell { ix: -70, iy: -70 }, max: Cell { ix: 70, iy: 70 } };
        let cells: Vec<Cell> = all.cells_in(area, None).collect();
        prop_assert_eq!(&look(&mut evicting, &stored, |map| {
            map.cells_in(area, None).collect::<Vec<_>>()
        }), &cells);
        let choice = Choice::default();
        for &cell in &cells {
            let of_cell = look(&mut evicting, &stored, |map| format!("{:?}", map.cell(cell, choice)));
            prop_assert_eq!(of_cell, format!("{:?}", all.cell(cell, choice)));
        }
        let config = FrictionConfig::default();
        let at = FusionContext { config: &config, now_us: at_us(0) };
        let of_one = Choice { configuration: Some(configuration(0)), ..choice };
        let squares = |map: Cells<'_>| {
            let filter = map.map().filter(of_one, |ground| Some(u16::from(ground.is_some())));
            let mut made = Vec::new();
            for (block, _) in map.map().changes().blocks() {
                let mut of_block = vec![CellSummary::default(); CELLS_PER_BLOCK];
                map.fuse_block((block, None), &[0; CELLS_PER_BLOCK], &filter, at, &mut of_block);
                made.extend(of_block);
            }
            made.push(map.fuse_square(area, (1, &filter), at, &mut FusionBuffers::default()));
            made
        };
        prop_assert_eq!(look(&mut evicting, &stored, squares), squares(all));
        let counted = |map: Cells<'_>| {
            let mut counts = BTreeMap::new();
            for (block, _) in map.map().changes().blocks() {
                map.count_cells(block, &mut counts);
            }
            counts
        };
        prop_assert_eq!(look(&mut evicting, &stored, counted), counted(all));
        prop_assert_eq!(evicting.contributions(), kept.contributions());
        // All blocks are in memory now, so they take the same.
        prop_assert_eq!(evicting.part_count(), kept.part_count());
    }

    #[test]
    fn the_cells_of_a_rectangle_are_found_row_by_row(
        driven in prop::collection::btree_set((coordinate(), coordinate()), 0..80),
        x in (coordinate(), coordinate()), y in (coordinate(), coordinate()),
        after in prop::option::of((coordinate(), coordinate())),
    ) {
        let mut map = SiteMap::new(1, Horizons::default());
        for &(ix, iy) in &driven {
            let key = (0, 0, ix, iy, 0, 0);
            map.add(Named::of(key).labelled(key), &measured(0.3, 0.1, 0));
        }
        let area = CellBox { min: Cell { ix: x.0, iy: y.0 }, max: Cell { ix: x.1, iy: y.1 } };
        let CellBox { min, max } = area;
        let after = after.map(|(ix, iy)| Cell { ix, iy });
        let absent = MissingBlocks::default();
        let found: Vec<(i32, i32)> = map
            .cells(&absent, 1)
            .cells_in(area, after)
            .map(|cell| (cell.iy, cell.ix))
            .collect();
        let mut expected: Vec<(i32, i32)> = driven
            .iter()
            .filter(|(ix, iy)| (min.ix..=max.ix).contains(ix) && (min.iy..=max.iy).contains(iy))
            .map(|&(ix, iy)| (iy, ix))
            .filter(|&at| after.is_none_or(|after| at > (after.iy, after.ix)))
            .collect();
        expected.sort_unstable();
        prop_assert_eq!(found, expected);
        prop_assert!(absent.into_blocks().is_empty());
    }
}

#[test]
fn squares_of_a_block_that_left_memory_are_made_again_only_after_a_change() {
    let key = (0, 0, 5, 5, 0, 0);
    let block = Block { row: 0, column: 0 };
    let mut map = SiteMap::new(1, Horizons::default());
    map.add(Named::of(key).labelled(key), &measured(0.3, 0.1, 0));
    let before = map.changes().newest_of(block);
    map.evict(block);
    assert_eq!(map.changes().newest_of(block), before);
    let hours = Hours {
        from_h: 0,
        to_h: i64::MAX,
    };
    map.withdraw(&robot(0), hours);
    assert!(map.changes().newest_of(block) > before);
    assert_eq!(
        map.changes().since(block, before),
        None,
        "any cell may have changed"
    );
}

#[test]
fn a_pinned_block_stays_and_one_that_was_never_driven_on_is_not_absent() {
    let key = (0, 0, 5, 5, 0, 0);
    let block = Block { row: 0, column: 0 };
    let mut map = SiteMap::new(1, Horizons::default());
    map.add(Named::of(key).labelled(key), &measured(0.3, 0.1, 0));
    let (pin, bytes) = map.pin(block).unwrap();
    assert_eq!(map.size(), (1, bytes));
    assert_eq!(map.idle_blocks().count(), 0);
    drop(pin);
    assert_eq!(map.idle_blocks().count(), 1);
    map.evict(block);
    assert_eq!(map.size(), (0, 0));
    let absent = MissingBlocks::default();
    let elsewhere = Cell { ix: 900, iy: 5 };
    assert!(
        map.cells(&absent, 1)
            .cell(elsewhere, Choice::default())
            .is_empty()
    );
    assert!(absent.into_blocks().is_empty());
    let absent = MissingBlocks::default();
    let here = Cell { ix: 7, iy: 7 };
    assert!(
        map.cells(&absent, 1)
            .cell(here, Choice::default())
            .is_empty()
    );
    assert_eq!(
        absent.into_blocks().into_iter().collect::<Vec<_>>(),
        [block]
    );
}
