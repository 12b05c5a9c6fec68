//! Measurements that an earlier version stored as JSON.

use jiff::Timestamp;
use proptest::prelude::*;
use proptest::strategy::ValueTree as _;
use sqlx::Connection as _;
use tread_api::friction::{Information, Segment, StoredSegment, ThetaErrors};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use crate::segments::{SegmentFilter, list};
use crate::{Db, schema};

/// The migration to columns.
const TO_COLUMNS: i64 = 20_261_126_090_000;

/// A measurement as it was stored: its run, the gap before its sequence number, and its time of receipt.
#[derive(Debug, Clone)]
struct Stored {
    boot_pk: i64,
    gap: i64,
    received_at_us: i64,
    segment: Segment,
}

fn information() -> impl Strategy<Value = Information> {
    (1e-5_f64..1e10, 1e-9_f64..1e9).prop_map(|(information, weighted)| Information {
        information,
        weighted,
    })
}

fn segment() -> impl Strategy<Value = Segment> {
    let named = (
        prop::bool::weighted(0.1),
        prop::bool::weighted(0.1),
        prop::option::weighted(0.8, (prop::bool::weighted(0.1), 1_u32..3)),
        1_u32..3,
        (-2_000_000_i32..2_000_000, any::<i32>()),
    );
    let times = (
        0_i64..4_000_000_000_000_000_000,
        0_i64..4_000_000_000_000_000_000,
    );
    let values = (
        information(),
        prop::option::of((1e-5_f64..1e10, 0.0_f64..10.0, 0.0_f64..10.0)),
        prop::option::of(information()),
        prop::option::of(information()),
        prop::option::of(0.0_f64..1.5),
        (1_u32..10_000_000, 0.0_f64..1e6, 0.0_f64..=1.0),
    );
    (named, times, values).prop_map(|(named, (started, ended), values)| {
        let (is_other, has_mission, terrain, grid_revision, (ix, iy)) = named;
        let (theta, errors, track, rolling, mu_peak_lower_bound, numbers) = values;
        let at = |ns: i64| Timestamp::from_nanosecond(ns.into()).unwrap();
        let configuration = uuid::Uuid::from_u128(1 + u128::from(is_other));
        Segment {
            configuration: configuration.into(),
            mission: has_mission.then(|| uuid::Uuid::from_u128(7).into()),
            started_at: at(started),
            ended_at: at(ended),
            grid_revision,
            cell: Cell { ix, iy },
            terrain: terrain.map(|(is_other, revision)| TerrainRef {
                id: if is_other { "mud" } else { "gravel" }.parse().unwrap(),
                revision,
            }),
            theta,
            theta_errors: errors.map(|(independent_information, robot_ratio, tyre_ratio)| {
                ThetaErrors {
                    independent_information,
                    robot_ratio,
                    tyre_ratio,
                }
            }),
            effective_track_ratio: track,
            rolling_resistance: rolling,
            mu_peak_lower_bound,
            samples: numbers.0,
            distance_m: numbers.1,
            saturation_ratio: numbers.2,
        }
    })
}

fn stored() -> impl Strategy<Value = Stored> {
    let gap = prop_oneof![8 => Just(1_i64), 1 => 2_i64..9];
    (1_i64..3, gap, 0_i64..3, segment()).prop_map(|(boot_pk, gap, received_at_us, segment)| {
        Stored {
            boot_pk,
            gap,
            received_at_us,
            segment,
        }
    })
}

/// Returns what a server of today reads of measurements that an earlier one stored.
async fn migrated(rows: &[(i64, Stored)]) -> Vec<StoredSegment> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tread.db");
    let mut old = schema::open_before(&path, TO_COLUMNS).await;
    sqlx::raw_sql(
        "INSERT INTO sites (pk, id, name, grid_revision, cell_m, created_at_us)
             VALUES (1, 'yard', 'Yard', 2, 0.5, 1);
         INSERT INTO configurations (pk, id) VALUES (9, '00000000-0000-0000-0000-000000000001');
         INSERT INTO robots (pk, site_pk, id, configuration_pk, agent_version, boot, first_seen_at_us,
                 last_hello_at_us)
             VALUES (1, 1, 'rover-1', 9, '0', '', 1, 1);
         INSERT INTO boots (pk, robot_pk, id) VALUES (1, 1, '00000000-0000-0000-0000-000000000011'),
             (2, 1, '00000000-0000-0000-0000-000000000012');",
    )
    .execute(&mut old)
    .await
    .unwrap();
    for (seq, row) in rows {
        let terrain = row.segment.terrain.as_ref();
        sqlx::query(
            "INSERT INTO segments (boot_pk, seq, robot_pk, site_pk, terrain, received_at_us, measurement)
             VALUES (?, ?, 1, 1, ?, ?, ?)",
        )
        .bind(row.boot_pk)
        .bind(seq)
        .bind(terrain.map_or("", |terrain| terrain.id.as_str()))
        .bind(row.received_at_us)
        .bind(serde_json::to_string(&row.segment).unwrap())
        .execute(&mut old)
        .await
        .unwrap();
    }
    old.close().await.unwrap();
    let db = Db::open(&path).await.unwrap();
    let mut tx = db.read("test").await.unwrap();
    let filter = SegmentFilter::default();
    let found = list(&mut tx, 1, &filter, u32::MAX).await.unwrap();
    drop(tx);
    db.close().await;
    found
}

fn read(rows: &[(i64, Stored)]) -> Vec<StoredSegment> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(migrated(rows))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn measurements_that_were_stored_as_json_are_the_same_in_columns_to_the_bit(
        stored in prop::collection::vec(stored(), 1..120),
    ) {
        let mut seqs = [0_i64; 2];
        let mut rows = Vec::new();
        // Times are in the order of commits.
        let mut received_at_us = 0;
        for mut row in stored {
            let seq = &mut seqs[usize::from(row.boot_pk == 2)];
            *seq += row.gap;
            received_at_us += i64::from(row.received_at_us == 0);
            row.received_at_us = received_at_us;
            rows.push((*seq, row));
        }
        let found = read(&rows);
        prop_assert_eq!(found.len(), rows.len());
        for (pk, (found, (seq, row))) in (1_i64..).zip(found.iter().zip(&rows)) {
            let boot = uuid::Uuid::from_u128(0x10 + u128::from(row.boot_pk.unsigned_abs()));
            prop_assert_eq!((found.id, found.boot), (pk, boot.into()));
            prop_assert_eq!(found.seq, seq.unsigned_abs());
            prop_assert_eq!(found.received_at.as_microsecond(), row.received_at_us);
            prop_assert_eq!(&found.segment, &row.segment);
        }
    }
}

#[test]
fn times_that_do_not_fit_become_the_first_second_that_does() {
    let first_s = i64::MIN / 1_000_000_000;
    for (begin, expected_s) in [
        (Timestamp::MIN, first_s),
        ("0001-01-01T00:00:00Z".parse().unwrap(), first_s),
        (Timestamp::UNIX_EPOCH, 0),
    ] {
        let mut runner = proptest::test_runner::TestRunner::deterministic();
        let tree = segment().new_tree(&mut runner).unwrap();
        let segment = Segment {
            started_at: begin,
            ..tree.current()
        };
        let row = Stored {
            boot_pk: 1,
            gap: 1,
            received_at_us: 1,
            segment,
        };
        let found = read(&[(1, row)]);
        assert_eq!(
            found[0].segment.started_at.as_second(),
            expected_s,
            "{begin}"
        );
    }
}
