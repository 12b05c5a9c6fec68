//! The addition of sums equals that of the server in memory.

use std::collections::BTreeMap;

use proptest::prelude::*;
use proptest::strategy::ValueTree as _;
use proptest::test_runner::TestRunner;
use tokio::time::Instant;
use tread_api::friction::Information;
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;
use tread_store::friction::fixed::Fixed;
use tread_store::friction::sums::{Pair, Pass};
use tread_store::friction::{Horizons, Sums};
use tread_store::withdrawals::Hours;

use crate::sums::{SumKey, add, each, of_hour, remove, remove_hours, unmerged};
use crate::testing::{TestDatabase, with_database};
use crate::{Connection, Db};

/// Number of random sequences of uploads.
const CASES: usize = 40;

fn fixed() -> impl Strategy<Value = Fixed> {
    let hi = prop_oneof![-4_i64..4, -(1_i64 << 58)..1_i64 << 58];
    let lo = prop_oneof![Just(0_i64), Just(0xFFFF_FFFF), 0..1_i64 << 32];
    (hi, lo).prop_map(|(hi, lo)| Fixed::from_units(hi) + Fixed::from_steps(lo))
}

fn pair() -> impl Strategy<Value = Pair> {
    (fixed(), fixed()).prop_map(|(information, weighted)| Pair {
        information,
        weighted,
    })
}

fn pass() -> impl Strategy<Value = Pass> {
    // Squares of the smallest and largest numbers have no floating-point value.
    let number =
        prop_oneof![4 => 1e-5_f64..1e6, 1 => Just(1e-300), 1 => Just(1e300), 1 => Just(2.0)];
    let theta = (number.clone(), number);
    (
        0_i64..4,
        prop::option::of(theta),
        prop::option::of(0.0_f64..1.5),
    )
        .prop_map(|(ended_at_us, theta, mu_peak)| Pass {
            ended_at_us,
            theta: theta.map(|(information, weighted)| Information {
                information,
                weighted,
            }),
            mu_peak,
        })
}

fn sums() -> impl Strategy<Value = Sums> {
    let counts = (0_u64..1 << 40, 0_u64..1 << 40, any::<i64>());
    let mu_peak = prop::option::of(0.0_f64..1.5);
    let fixed = (pair(), pair(), pair(), fixed(), fixed(), fixed());
    (fixed, counts, mu_peak, pass()).prop_map(|(fixed, counts, mu_peak, newest)| {
        let (theta, track, rolling, theta_square, robot_error, tyre_error) = fixed;
        let (segments, samples, newest_at_us) = counts;
        Sums {
            theta,
            theta_square,
            robot_error,
            tyre_error,
            track,
            rolling,
            segments,
            samples,
            mu_peak,
            newest_at_us,
            newest,
        }
    })
}

fn key() -> impl Strategy<Value = SumKey> {
    let terrain = prop::option::of((prop::bool::ANY, 1_u32..3));
    let cell = (
        prop_oneof![Just(i32::MIN), -2..2],
        prop_oneof![Just(i32::MAX), -2..2],
    );
    (1_i64..3, 0_i64..2, cell, terrain, 1_u32..3).prop_map(
        |(robot_pk, epoch_h, (ix, iy), terrain, grid_revision)| SumKey {
            robot_pk,
            epoch_h,
            cell: Cell { ix, iy },
            terrain: terrain.map(|(is_mud, revision)| TerrainRef {
                id: if is_mud { "mud" } else { "gravel" }.parse().unwrap(),
                revision,
            }),
            grid_revision,
            site_pk: 1,
            configuration_pk: 9,
        },
    )
}

async fn open(database: &TestDatabase) -> Db {
    database
        .run(
            "INSERT INTO sites (pk, id, name, grid_revision, cell_m, created_at_us, merged_before_h,
                     months_before_h)
                 VALUES (1, 'yard', 'Yard', 2, 0.5, 1, 1440, 744);
             INSERT INTO configurations (pk, id) VALUES (9, '00000000-0000-0000-0000-000000000001');
             INSERT INTO robots (pk, site_pk, id, configuration_pk, agent_version, boot,
                     first_seen_at_us, last_hello_at_us)
                 VALUES (1, 1, 'rover-1', 9, '0', '', 1, 1), (2, 1, 'rover-2', 9, '0', '', 1, 1);",
        )
        .await;
    database.open().await
}

async fn all(db: &mut Connection) -> BTreeMap<SumKey, Sums> {
    let mut found = BTreeMap::new();
    each(db, |row| {
        let before = found.insert(row.key, row.sums);
        assert_eq!(before, None);
    })
    .await
    .unwrap();
    found
}

#[tokio::test]
async fn stored_sums_equal_those_in_memory_to_the_bit_in_any_batches() {
    let test = "stored_sums_equal_those_in_memory_to_the_bit_in_any_batches";
    with_database(test, async |database| {
        let db = open(database).await;
        let mut runner = TestRunner::deterministic();
        // A batch may name a key twice.
        let batches = prop::collection::vec(prop::collection::vec((key(), sums()), 0..40), 1..6);
        for case in 0..CASES {
            let batches = batches.new_tree(&mut runner).unwrap().current();
            let mut expected: BTreeMap<SumKey, Sums> = BTreeMap::new();
            let mut tx = db.write("db").await.unwrap();
            for batch in &batches {
                add(&mut tx, batch.iter().map(|(key, sums)| (key, sums)))
                    .await
                    .unwrap();
                for (key, sums) in batch {
                    let total = expected.entry(key.clone());
                    total.and_modify(|total| total.add(sums)).or_insert(*sums);
                }
            }
            assert_eq!(all(&mut tx).await, expected, "case {case}");
        }
        db.close().await;
    })
    .await;
}

fn unit(hi: i64) -> Sums {
    let mut runner = TestRunner::deterministic();
    let some = sums().new_tree(&mut runner).unwrap().current();
    let information = Fixed::from_units(hi) + Fixed::from_steps(0xFFFF_FFFF);
    Sums {
        theta: Pair {
            information,
            ..some.theta
        },
        ..some
    }
}

#[tokio::test]
async fn a_sum_beyond_the_range_stays_at_its_end_and_fails_no_transaction() {
    let test = "a_sum_beyond_the_range_stays_at_its_end_and_fails_no_transaction";
    with_database(test, async |database| {
        let db = open(database).await;
        let mut runner = TestRunner::deterministic();
        let key = key().new_tree(&mut runner).unwrap().current();
        for (hi, end) in [(i64::MAX, i64::MAX), (i64::MIN, i64::MIN)] {
            let mut tx = db.write("db").await.unwrap();
            for _ in 0..3 {
                add(&mut tx, [(&key, &unit(hi))].into_iter()).await.unwrap();
            }
            let found = all(&mut tx).await[&key];
            let (hi, _lo) = found.theta.information.halves().unwrap();
            assert_eq!(hi, end);
        }
        db.close().await;
    })
    .await;
}

/// A report, not a test: `cargo test … --ignored --nocapture speed`.
#[tokio::test]
#[ignore = "measures"]
async fn the_speed_of_adding_sums() {
    with_database("the_speed_of_adding_sums", async |database| {
        let db = open(database).await;
        let mut runner = TestRunner::deterministic();
        let some = key().new_tree(&mut runner).unwrap().current();
        let added = unit(1);
        for what in ["new", "stored", "stored"] {
            let keys: Vec<SumKey> = (0..20_000)
                .map(|ix| SumKey {
                    cell: Cell { ix, iy: 0 },
                    ..some.clone()
                })
                .collect();
            let begun = Instant::now();
            let mut tx = db.write("db").await.unwrap();
            add(&mut tx, keys.iter().map(|key| (key, &added)))
                .await
                .unwrap();
            tx.commit().await.unwrap();
            eprintln!("{} {what} sums: {:?}", keys.len(), begun.elapsed());
        }
        db.close().await;
    })
    .await;
}

#[tokio::test]
async fn hours_to_be_merged_are_listed_robot_by_robot() {
    with_database(
        "hours_to_be_merged_are_listed_robot_by_robot",
        async |database| {
            let db = open(database).await;
            let mut runner = TestRunner::deterministic();
            let some = key().new_tree(&mut runner).unwrap().current();
            let mut tx = db.write("db").await.unwrap();
            // The months before 1970-02-01 are complete, the days before 1970-03-02.
            for robot_pk in [2, 1] {
                for epoch_h in [0, 1, 24, 744, 745, 768, 1439, 1440, 1441] {
                    let key = SumKey {
                        robot_pk,
                        epoch_h,
                        ..some.clone()
                    };
                    add(&mut tx, [(&key, &unit(1))].into_iter()).await.unwrap();
                }
            }
            let listed = unmerged(&mut tx, 100).await.unwrap();
            let hours: Vec<_> = listed
                .iter()
                .map(|hour| (hour.robot_pk, hour.epoch_h))
                .collect();
            let expected = |robot_pk| [1, 24, 745, 1439].map(|hour| (robot_pk, hour));
            assert_eq!(hours, [expected(1), expected(2)].concat());
            let horizons = Horizons {
                days_before_h: 1_440,
                months_before_h: 744,
            };
            assert!(listed.iter().all(|hour| hour.horizons == horizons));
            assert_eq!(unmerged(&mut tx, 3).await.unwrap(), listed[..3]);
            let of_one = of_hour(&mut tx, listed[1], 10).await.unwrap();
            assert_eq!(of_one.len(), 1);
            assert!(remove(&mut tx, &of_one[0].key).await.unwrap());
            assert!(!remove(&mut tx, &of_one[0].key).await.unwrap());
            let hours = Hours {
                from_h: 24,
                to_h: 745,
            };
            assert_eq!(remove_hours(&mut tx, 2, hours).await.unwrap(), 3);
            assert_eq!(all(&mut tx).await.len(), 14);
            drop(tx);
            db.close().await;
        },
    )
    .await;
}
