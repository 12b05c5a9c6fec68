//! Values of measurements are in partitions, which are dropped as a whole after their removal.

use jiff::Timestamp;
use proptest::prelude::*;
use proptest::strategy::ValueTree as _;
use proptest::test_runner::TestRunner;
use tokio::time::Instant;

use crate::segments::{NewSegment, SegmentFilter};
use crate::testing::{TestDatabase, with_database};
use crate::tests_of_segments::{NAMED, segment};
use crate::{Db, partitions, removed, schema, segment_ranges, segments};

fn at(second: i64) -> Timestamp {
    Timestamp::from_second(second).unwrap()
}

/// Stores measurements of one robot that follow those before.
async fn upload(db: &Db, count: i64, received_at: Timestamp) {
    let mut runner = TestRunner::deterministic();
    let some = segment().new_tree(&mut runner).unwrap().current();
    let mut tx = db.write("db").await.unwrap();
    let last = segment_ranges::last(&mut tx).await.unwrap();
    let next = last.map_or(1, |(last, _)| last + 1);
    let new = |seq| NewSegment {
        boot_pk: 1,
        seq,
        robot_pk: 1,
        site_pk: 1,
        configuration_pk: 9,
        segment: &some,
        times_ns: (seq, seq),
    };
    let segments: Vec<_> = (next..next + count).map(new).collect();
    let inserted = segments::insert(&mut tx, &segments, received_at).await;
    inserted.unwrap();
    tx.commit().await.unwrap();
}

async fn remove_until(db: &Db, key: i64) {
    let mut tx = db.write("db").await.unwrap();
    removed::remove(&mut tx, key).await.unwrap();
    tx.commit().await.unwrap();
}

async fn release(db: &Db) -> Option<u64> {
    let mut tx = db.write("db").await.unwrap();
    let dropped = removed::release_removed(&mut tx).await.unwrap();
    if dropped.is_some() {
        tx.commit().await.unwrap();
    }
    dropped
}

async fn keys(db: &Db) -> Vec<i64> {
    let mut tx = db.read("db").await.unwrap();
    let listed = segments::list(&mut tx, 1, &SegmentFilter::default(), 1_000).await;
    listed.unwrap().iter().map(|one| one.id).collect()
}

/// First and last keys of the partitions, and the number of values in them, as the catalogue says.
async fn partitions(database: &TestDatabase) -> Vec<(i64, i64, i64)> {
    let mut connection = database.connect().await;
    let known: Vec<(i64, i64)> =
        sqlx::query_as("SELECT first_pk, last_pk FROM segment_partitions ORDER BY first_pk")
            .fetch_all(&mut connection)
            .await
            .unwrap();
    let attached: (i64,) = sqlx::query_as(
        "SELECT COUNT(*) FROM pg_inherits WHERE inhparent = CAST('segment_values' AS regclass)",
    )
    .fetch_one(&mut connection)
    .await
    .unwrap();
    assert_eq!(usize::try_from(attached.0).unwrap(), known.len());
    let mut found = Vec::new();
    for (first, last) in known {
        let counting = format!("SELECT COUNT(*) FROM segment_values_{first}");
        let (count,): (i64,) = sqlx::query_as(sqlx::AssertSqlSafe(counting))
            .fetch_one(&mut connection)
            .await
            .unwrap();
        found.push((first, last, count));
    }
    found
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn removed_measurements_leave_the_lists_at_once_and_the_disk_with_their_partition() {
    let test = "removed_measurements_leave_the_lists_at_once";
    with_database(test, async |database| {
        database.run(NAMED).await;
        let db = database.open().await;
        assert_eq!(partitions(database).await, [], "none without measurements");
        assert_eq!(release(&db).await, Some(0));
        let mut tx = db.write("db").await.unwrap();
        partitions::add(&mut tx, 1..=3).await.unwrap();
        partitions::add(&mut tx, 4..=9).await.unwrap();
        tx.commit().await.unwrap();
        // One upload for all partitions, and for one that is created for it.
        upload(&db, 12, at(1)).await;
        let created = (10, 1_000_009, 3);
        assert_eq!(partitions(database).await, [(1, 3, 3), (4, 9, 6), created]);
        assert_eq!(keys(&db).await, (1..=12).collect::<Vec<_>>());

        remove_until(&db, 5).await;
        assert_eq!(keys(&db).await, (6..=12).collect::<Vec<_>>());
        assert_eq!(release(&db).await, Some(1));
        assert_eq!(partitions(database).await, [(4, 9, 6), created]);
        remove_until(&db, 9).await;
        assert_eq!(release(&db).await, Some(1));
        assert_eq!(release(&db).await, Some(0));
        assert_eq!(partitions(database).await, [created]);
        assert_eq!(keys(&db).await, [10, 11, 12]);
        let mut tx = db.read("db").await.unwrap();
        assert_eq!(removed::within(&mut tx, 1, 1..=99).await.unwrap(), [(1, 9)]);
        drop(tx);
        upload(&db, 2, at(2)).await;
        assert_eq!(keys(&db).await, [10, 11, 12, 13, 14]);
        db.close().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reader_delays_the_drop_of_a_partition_and_loses_nothing() {
    let test = "a_reader_delays_the_drop_of_a_partition";
    with_database(test, async |database| {
        database.run(NAMED).await;
        let db = database.open().await;
        let mut tx = db.write("db").await.unwrap();
        partitions::add(&mut tx, 1..=3).await.unwrap();
        tx.commit().await.unwrap();
        upload(&db, 6, at(1)).await;
        let mut reader = db.read("db").await.unwrap();
        let filter = SegmentFilter::default();
        let before = segments::list(&mut reader, 1, &filter, 99).await.unwrap();
        remove_until(&db, 3).await;
        let began = Instant::now();
        assert_eq!(release(&db).await, None);
        assert!(began.elapsed().as_secs() < 5, "{:?}", began.elapsed());
        // The snapshot still has everything, and others write.
        assert_eq!(
            segments::list(&mut reader, 1, &filter, 99).await.unwrap(),
            before
        );
        upload(&db, 1, at(2)).await;
        drop(reader);
        assert_eq!(release(&db).await, Some(1));
        assert_eq!(keys(&db).await, [4, 5, 6, 7]);
        db.close().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_partition_is_as_wide_as_the_measurements_of_a_week() {
    let test = "a_partition_is_as_wide_as_the_measurements_of_a_week";
    with_database(test, async |database| {
        database.run(NAMED).await;
        let db = database.open().await;
        // Ranges of many measurements, of which only the ledger has a row: 2 million a day.
        for day in 0..9_i64 {
            let (first, at_us) = (1 + day * 2_000_000, day * 86_400_000_000);
            let last = first + 1_999_999;
            database
                .run(&format!(
                    "INSERT INTO segment_ranges VALUES ({first}, {last}, {first}, {last}, 1, 1, 1, 9,
                         NULL, 1, '', 0, {at_us})"
                ))
                .await;
        }
        let mut tx = db.write("db").await.unwrap();
        let next = 9 * 2_000_000 + 1;
        partitions::prepare(&mut tx, next..=next).await.unwrap();
        tx.commit().await.unwrap();
        // From the second day on.
        let width = 8 * 2_000_000;
        assert_eq!(
            partitions(database).await,
            [(next, next + width - 1, 0)]
        );
        db.close().await;
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn measurements_of_a_database_without_partitions_remain() {
    let test = "measurements_of_a_database_without_partitions_remain";
    with_database(test, async |database| {
        // A database as its first migration left it.
        let mut connection = database.connect().await;
        database
            .run("DROP SCHEMA public CASCADE; CREATE SCHEMA public")
            .await;
        schema::migrator().run_to(1, &mut connection).await.unwrap();
        database.run(NAMED).await;
        database
            .run(
                "INSERT INTO segment_ranges VALUES (7, 9, 1, 3, 1, 1, 1, 9, NULL, 1, '', 0, 5);
                 INSERT INTO segment_values SELECT pk, 1, 2, 3, 4, 5, 6, NULL, NULL, NULL, NULL,
                     NULL, NULL, NULL, NULL, 8, 9, 0.5 FROM generate_series(7, 9) AS pk",
            )
            .await;
        let db = database.open().await;
        assert_eq!(partitions(database).await, [(0, 9, 3)]);
        assert_eq!(keys(&db).await, [7, 8, 9]);
        upload(&db, 2, at(1)).await;
        assert_eq!(partitions(database).await, [(0, 9, 3), (10, 1_000_009, 2)]);
        assert_eq!(keys(&db).await, [7, 8, 9, 10, 11]);
        // It may be as large as all that follow, so its values are removed at once.
        remove_until(&db, 8).await;
        assert_eq!(partitions(database).await, [(0, 9, 1), (10, 1_000_009, 2)]);
        assert_eq!(keys(&db).await, [9, 10, 11]);
        remove_until(&db, 9).await;
        assert_eq!(release(&db).await, Some(1));
        assert_eq!(keys(&db).await, [10, 11]);
        // A partition that an operator has dropped is no error.
        remove_until(&db, 10).await;
        database
            .run("INSERT INTO segment_partitions VALUES (3, 4)")
            .await;
        assert_eq!(release(&db).await, Some(1));
        db.close().await;
    })
    .await;
}
