//! A model of the database: whatever is committed, stored, withdrawn and killed, stored and unwritten
//! sums together are those of all segments.

use proptest::prelude::*;
use tread_api::site::Cell;

use super::*;
use crate::friction::fixed::Fixed;
use crate::friction::sums::{Pair, Pass};

#[derive(Debug, Clone)]
enum Act {
    /// Segments are committed together: robot, cell, hour and value of each.
    Commit(Vec<(i64, i32, i64, f64)>),
    /// Sums are stored, so many in each transaction, for at most so many transactions.
    Store {
        limit: usize,
        transactions: usize,
        /// Whether a block's snapshot is taken between the first commit and its change of memory.
        is_seen_between: bool,
    },
    /// A block is about to be read, by one of two readers.
    BeginRead(usize),
    /// Its snapshot is taken.
    Snapshot(usize),
    /// It is put into memory.
    EndRead(usize),
    Withdraw(i64, Hours),
    Kill,
}

fn act() -> impl Strategy<Value = Act> {
    // Two blocks.
    let segment = (0_i64..4, 62_i32..66, 0_i64..4, 0.0_f64..1e6);
    prop_oneof![
        5 => prop::collection::vec(segment, 0..8).prop_map(Act::Commit),
        3 => (1_usize..6, 1_usize..4, any::<bool>()).prop_map(
            |(limit, transactions, is_seen_between)| Act::Store {
                limit,
                transactions,
                is_seen_between,
            }
        ),
        3 => (0_usize..2).prop_map(Act::BeginRead),
        3 => (0_usize..2).prop_map(Act::Snapshot),
        3 => (0_usize..2).prop_map(Act::EndRead),
        1 => (0_i64..4, 0_i64..4, 0_i64..4)
            .prop_map(|(robot, from_h, span_h)| {
                let to_h = from_h + span_h;
                Act::Withdraw(robot, Hours { from_h, to_h })
            }),
        2 => Just(Act::Kill),
    ]
}

fn key(robot_pk: i64, ix: i32, epoch_h: i64) -> SumKey {
    SumKey {
        robot_pk,
        epoch_h,
        cell: Cell { ix, iy: 0 },
        terrain: None,
        grid_revision: 1,
        site_pk: 1,
        configuration_pk: 1,
    }
}

fn one(value: f64) -> Sums {
    let fixed = Fixed::from_f64(value).unwrap();
    let pair = Pair {
        information: fixed,
        weighted: fixed,
    };
    Sums {
        theta: pair,
        theta_square: fixed,
        robot_error: fixed,
        tyre_error: fixed,
        track: pair,
        rolling: pair,
        segments: 1,
        samples: 1,
        mu_peak: Some(value),
        newest_at_us: 1,
        newest: Pass {
            ended_at_us: 1,
            theta: None,
            mu_peak: Some(value),
        },
    }
}

type Table = BTreeMap<SumKey, Sums>;

fn add_to(table: &mut Table, key: &SumKey, sums: &Sums) {
    table
        .entry(key.clone())
        .and_modify(|present| present.add(sums))
        .or_insert(*sums);
}

fn add<'sums>(
    unwritten: &mut Unwritten,
    sums: impl IntoIterator<Item = (&'sums SumKey, &'sums Sums)>,
    added: Added,
) {
    let sums: Vec<_> = sums
        .into_iter()
        .map(|(key, sums)| (key, [(key.cell, *sums)]))
        .collect();
    let sums = sums.iter().map(|(key, cells)| (*key, cells.as_slice()));
    unwritten.add(sums, added, Duration::ZERO);
}

/// What a disk keeps, and the memory of a server on it.
#[derive(Debug, Default)]
struct Server {
    /// The key of each is its index plus one.
    segments: Vec<(SumKey, Sums)>,
    stored: Table,
    watermarks: HashMap<i64, i64>,
    withdrawals: Vec<(i64, Hours)>,
    unwritten: Unwritten,
    /// Numbers of two reads of blocks.
    reads: [Option<u64>; 2],
    /// Their snapshots, once they are taken.
    snapshots: [Option<Snapshot>; 2],
}

/// What a snapshot has of the stored sums, with the number of withdrawals in memory at the time.
#[derive(Debug, Clone)]
struct Snapshot {
    stored: Table,
    watermarks: HashMap<i64, i64>,
    withdrawals: usize,
}

impl Server {
    fn is_withdrawn(&self, key: &SumKey) -> bool {
        let mut withdrawals = self.withdrawals.iter();
        withdrawals
            .any(|(robot_pk, hours)| *robot_pk == key.robot_pk && hours.contains(key.epoch_h))
    }

    fn run(&mut self, act: Act) {
        match act {
            Act::Commit(segments) => {
                let first = last_key(&self.segments) + 1;
                let mut folded = Table::new();
                for (robot_pk, ix, hour, value) in segments {
                    let (key, sums) = (key(robot_pk, ix, hour), one(value));
                    if !self.is_withdrawn(&key) {
                        add_to(&mut folded, &key, &sums);
                    }
                    self.segments.push((key, sums));
                }
                let last = last_key(&self.segments);
                let added = Added { first, last };
                add(&mut self.unwritten, &folded, added);
            }
            Act::BeginRead(of) => {
                if self.reads[of].is_none() {
                    self.reads[of] = Some(self.unwritten.begin_read());
                }
            }
            Act::Snapshot(of) => self.take_snapshot(of),
            Act::EndRead(of) => self.end_read(of),
            Act::Store {
                limit,
                transactions,
                is_seen_between,
            } => {
                let until = self.unwritten.additions();
                for transaction in 0..transactions {
                    let portion = self.unwritten.portion(until, limit);
                    for (key, sums) in &portion.sums {
                        add_to(&mut self.stored, key, sums);
                    }
                    for step in &portion.steps {
                        let before = self.watermarks.insert(step.robot_pk, step.to_pk);
                        assert_eq!(before.unwrap_or_default(), step.from_pk);
                    }
                    if is_seen_between && transaction == 0 {
                        self.take_snapshot(0);
                    }
                    self.unwritten.written(&portion.steps);
                }
            }
            Act::Withdraw(robot_pk, hours) => {
                self.withdrawals.push((robot_pk, hours));
                self.stored
                    .retain(|key, _| key.robot_pk != robot_pk || !hours.contains(key.epoch_h));
                self.unwritten.withdraw(robot_pk, hours);
            }
            Act::Kill => {
                let generation_sums = self.unwritten.generation_sums;
                self.unwritten = Unwritten::default();
                self.unwritten.start_at(self.watermarks.clone());
                self.unwritten.generation_sums = generation_sums;
                (self.reads, self.snapshots) = ([None; 2], [None, None]);
                for (pk, (key, sums)) in (1..).zip(&self.segments) {
                    let watermark = self.watermarks.get(&key.robot_pk);
                    if pk > watermark.copied().unwrap_or_default() && !self.is_withdrawn(key) {
                        let added = Added {
                            first: pk,
                            last: pk,
                        };
                        add(&mut self.unwritten, [(key, sums)], added);
                    }
                }
            }
        }
    }

    fn take_snapshot(&mut self, of: usize) {
        if self.reads[of].is_some() {
            self.snapshots[of] = Some(Snapshot {
                stored: self.stored.clone(),
                watermarks: self.watermarks.clone(),
                withdrawals: self.withdrawals.len(),
            });
        }
    }

    /// Checks that the snapshot's blocks with the unwritten sums are those of all segments.
    fn end_read(&mut self, of: usize) {
        let Some(snapshot) = self.snapshots[of].take() else {
            return;
        };
        if snapshot.withdrawals == self.withdrawals.len() {
            for column in 0..2 {
                let block = Block { row: 0, column };
                let is_of_block = |key: &SumKey| Block::of(key.cell) == block;
                let mut read = snapshot.stored.clone();
                read.retain(|key, _| is_of_block(key));
                for (key, sums) in self.unwritten.since(&snapshot.watermarks, 1, block) {
                    add_to(&mut read, key, sums);
                }
                let mut expected = self.expected();
                expected.retain(|key, _| is_of_block(key));
                assert_eq!(read, expected);
            }
        }
        let number = self.reads[of].take().unwrap();
        self.unwritten.end_read(number);
        // What the other reader needs is kept, and nothing without one.
        let other = self.reads[1 - of];
        let kept = self.unwritten.stored_during_read.iter();
        let mut needed = kept.map(|stored| other.is_some_and(|other| stored.until_read > other));
        assert!(needed.all(|is_needed| is_needed));
    }

    /// The sums of all segments that are not withdrawn.
    fn expected(&self) -> Table {
        let mut table = Table::new();
        for (key, sums) in &self.segments {
            if !self.is_withdrawn(key) {
                add_to(&mut table, key, sums);
            }
        }
        table
    }

    /// What the map shows.
    fn shown(&self) -> Table {
        let mut table = self.stored.clone();
        for (key, sums) in &self.unwritten.portion(u64::MAX, usize::MAX).sums {
            add_to(&mut table, key, sums);
        }
        table
    }
}

fn last_key(segments: &[(SumKey, Sums)]) -> i64 {
    i64::try_from(segments.len()).unwrap()
}

proptest! {
    #[test]
    fn stored_and_unwritten_sums_are_those_of_all_segments_whenever_the_server_is_killed(
        acts in prop::collection::vec(act(), 0..40),
        generation_sums in 1_usize..6,
    ) {
        let mut server = Server::default();
        server.unwritten.generation_sums = generation_sums;
        for act in acts {
            server.run(act);
            prop_assert_eq!(server.shown(), server.expected());
            // No transaction is larger than the limit by more than what was added together.
            let one = server.unwritten.portion(u64::MAX, 1).sums.len();
            prop_assert!(one < generation_sums + 8, "{one} sums");
            let all = server.unwritten.portion(u64::MAX, usize::MAX);
            let counts = server.unwritten.counts();
            let segments = all.sums.iter().map(|(_, sums)| sums.segments).sum::<u64>();
            prop_assert_eq!((counts.sums, counts.segments), (all.sums.len(), segments));
            prop_assert_eq!(counts.oldest_at.is_some(), counts.sums > 0);
            // Retention removes nothing that a killed server would miss.
            let first = server.unwritten.first_key();
            for (pk, (key, _)) in (1..).zip(&server.segments) {
                let watermark = server.watermarks.get(&key.robot_pk);
                if pk > watermark.copied().unwrap_or_default() && !server.is_withdrawn(key) {
                    prop_assert!(first.is_some_and(|first| first <= pk));
                }
            }
        }
    }
}

#[test]
fn a_portion_has_whole_generations_and_none_that_began_later() {
    let mut unwritten = Unwritten::default();
    let added = Added { first: 1, last: 9 };
    let sums: Table = (0..3)
        .flat_map(|robot| (0..4).map(move |ix| (key(robot, ix, 0), one(1.0))))
        .collect();
    add(&mut unwritten, &sums, added);
    let until = unwritten.additions();
    let later: Table = [(key(7, 0, 0), one(1.0))].into();
    add(&mut unwritten, &later, added);
    let robots = |portion: &StoreBatch| -> Vec<i64> {
        portion.steps.iter().map(|step| step.robot_pk).collect()
    };
    let first = unwritten.portion(until, 1);
    assert_eq!((robots(&first), first.sums.len()), (vec![0], 4));
    let two = unwritten.portion(until, 9);
    assert_eq!((robots(&two), two.sums.len()), (vec![0, 1], 8));
    unwritten.written(&two.steps);
    let rest = unwritten.portion(until, 9);
    assert_eq!(robots(&rest), [2]);
    unwritten.written(&rest.steps);
    assert!(unwritten.portion(until, 9).steps.is_empty());
    assert_eq!(unwritten.counts().sums, 1);
}

#[test]
fn a_robot_in_many_cells_is_stored_in_several_transactions_each_with_its_watermark() {
    let mut unwritten = Unwritten::default();
    let batch = 100;
    let count = i32::try_from(batch).unwrap();
    for begin in (0..10_000).step_by(batch) {
        let cells: Table = (begin..begin + count)
            .map(|ix| (key(1, ix, 0), one(1.0)))
            .collect();
        let keys = Added {
            first: i64::from(begin) + 1,
            last: i64::from(begin + count),
        };
        add(&mut unwritten, &cells, keys);
    }
    let until = unwritten.additions();
    let mut marks = vec![0];
    loop {
        let portion = unwritten.portion(until, TRANSACTION_SUMS);
        let [step] = portion.steps.as_slice() else {
            break;
        };
        assert!(portion.sums.len() <= TRANSACTION_SUMS + batch);
        assert_eq!(Some(&step.from_pk), marks.last());
        marks.push(step.to_pk);
        unwritten.written(&portion.steps);
    }
    assert_eq!(marks, [0, 2_000, 4_000, 6_000, 8_000, 10_000]);
    assert_eq!(unwritten.counts(), UnwrittenCounts::default());
}

#[test]
fn sums_are_stored_before_further_receipts_when_too_many_segments_are_unwritten() {
    let mut unwritten = Unwritten::default();
    let many = Sums {
        segments: UNWRITTEN_SEGMENTS_MAX - 1,
        ..one(1.0)
    };
    let added = Added { first: 1, last: 1 };
    add(&mut unwritten, [(&key(1, 0, 0), &many)], added);
    assert!(!unwritten.is_full());
    add(&mut unwritten, [(&key(1, 0, 0), &one(1.0))], added);
    assert!(unwritten.is_full());
    let all = unwritten.portion(u64::MAX, 1);
    unwritten.written(&all.steps);
    assert!(!unwritten.is_full());
}

/// Segments with consecutive keys that were committed together.
fn range(first: i64, last: i64) -> Added {
    Added { first, last }
}

#[test]
fn a_standby_keeps_ranges_apart_until_it_stores_them_itself() {
    let mut unwritten = Unwritten::of_ranges();
    unwritten.start_at(HashMap::from([(1, 10)]));
    for (keys, ix) in [(range(11, 14), 0), (range(15, 15), 1), (range(16, 20), 0)] {
        let cells = [(Cell { ix, iy: 0 }, one(0.5))];
        unwritten.add([(&key(1, ix, 5), &cells[..])], keys, Duration::ZERO);
    }
    for (watermark, is_divided) in [
        (10, false),
        (13, true),
        (14, false),
        (15, false),
        (18, true),
        (20, false),
    ] {
        let watermarks = HashMap::from([(1, watermark)]);
        assert_eq!(
            unwritten.is_divided_by(&watermarks),
            is_divided,
            "{watermark}"
        );
    }
    let since = |unwritten: &Unwritten, watermark| {
        let watermarks = HashMap::from([(1, watermark)]);
        let mut sums = Table::new();
        for (key, of) in unwritten.since(&watermarks, 1, Block { row: 0, column: 0 }) {
            add_to(&mut sums, key, of);
        }
        sums.values().map(|sums| sums.segments).sum::<u64>()
    };
    assert_eq!((since(&unwritten, 10), since(&unwritten, 15)), (3, 1));
    assert_eq!(unwritten.counts().sums, 3);
    unwritten.may_be_stored();
    // Two of the three are of one cell.
    assert_eq!(
        (unwritten.counts().sums, unwritten.counts().segments),
        (2, 3)
    );
    assert_eq!(since(&unwritten, 10), 3);
    let portion = unwritten.portion(unwritten.additions(), TRANSACTION_SUMS);
    let step = WatermarkStep {
        robot_pk: 1,
        from_pk: 10,
        to_pk: 20,
    };
    assert_eq!(portion.steps, [step]);
    assert_eq!(portion.sums.len(), 2);
    unwritten.written(&portion.steps);
    assert_eq!(unwritten.counts(), UnwrittenCounts::default());
}

#[test]
fn segments_that_are_withdrawn_belong_to_the_generation_of_their_range() {
    let mut unwritten = Unwritten::default();
    let cells = [(Cell { ix: 0, iy: 0 }, one(0.5))];
    unwritten.add([(&key(1, 0, 5), &cells[..])], range(11, 12), Duration::ZERO);
    unwritten.cover(1, range(11, 13));
    // Of another range, of which nothing was added.
    unwritten.cover(1, range(14, 15));
    let portion = unwritten.portion(unwritten.additions(), TRANSACTION_SUMS);
    assert_eq!(portion.steps[0].to_pk, 13);
}
