//! Measurements: what is stored is read again to the bit, in the same ranges as by the other engine.

use std::collections::BTreeSet;
use std::path::Path;

use futures_util::TryStreamExt as _;
use jiff::Timestamp;
use proptest::prelude::*;
use proptest::strategy::ValueTree as _;
use proptest::test_runner::TestRunner;
use tokio::time::Instant;
use tread_api::friction::{Information, Segment, ThetaErrors};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;

use crate::segments::{NewSegment, RobotCursor, SegmentFilter, SiteCursor};
use crate::testing::with_database;
use crate::{removed, segment_ranges, segments};

/// Number of random sequences of uploads.
const CASES: usize = 15;

/// Rows that measurements name, for both engines.
pub(crate) const NAMED: &str = "
    INSERT INTO sites (pk, id, name, grid_revision, cell_m, created_at_us)
        VALUES (1, 'yard', 'Yard', 2, 0.5, 1), (2, 'field', 'Field', 2, 0.5, 1);
    INSERT INTO configurations (pk, id) VALUES (9, '00000000-0000-0000-0000-000000000001');
    INSERT INTO robots (pk, site_pk, id, configuration_pk, agent_version, boot, first_seen_at_us,
            last_hello_at_us)
        VALUES (1, 1, 'rover-1', 9, '0', '', 1, 1), (2, 2, 'rover-2', 9, '0', '', 1, 1);
    INSERT INTO boots (pk, robot_pk, id) VALUES (1, 1, '00000000-0000-0000-0000-000000000011'),
        (2, 2, '00000000-0000-0000-0000-000000000012');";

fn information() -> impl Strategy<Value = Information> {
    (1e-5_f64..1e10, 1e-9_f64..1e9).prop_map(|(information, weighted)| Information {
        information,
        weighted,
    })
}

pub(crate) fn segment() -> impl Strategy<Value = Segment> {
    let named = (
        prop::bool::weighted(0.1),
        prop::option::weighted(0.8, prop::bool::weighted(0.1)),
        (any::<i32>(), any::<i32>()),
    );
    let values = (
        information(),
        prop::option::of((1e-5_f64..1e10, 0.0_f64..10.0, 0.0_f64..10.0)),
        prop::option::of(information()),
        prop::option::of(information()),
        prop::option::of(0.0_f64..1.5),
        (1_u32..10_000_000, 0.0_f64..1e6, 0.0_f64..=1.0),
    );
    (named, values).prop_map(|((has_mission, terrain, (ix, iy)), values)| {
        let (theta, errors, track, rolling, mu_peak_lower_bound, numbers) = values;
        Segment {
            configuration: uuid::Uuid::from_u128(1).into(),
            mission: has_mission.then(|| uuid::Uuid::from_u128(7).into()),
            started_at: Timestamp::UNIX_EPOCH,
            ended_at: Timestamp::UNIX_EPOCH,
            grid_revision: 1,
            cell: Cell { ix, iy },
            terrain: terrain.map(|is_other| TerrainRef {
                id: if is_other { "mud" } else { "gravel" }.parse().unwrap(),
                revision: 1,
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

/// Calls a function of both engines, and compares the answers.
macro_rules! both {
    ($sqlite:ident, $postgres:ident, $module:ident :: $function:ident ($($argument:expr),* $(,)?)) => {{
        let sqlite = tread_store_sqlite::$module::$function(&mut $sqlite, $($argument),*).await;
        let postgres = $module::$function(&mut $postgres, $($argument),*).await;
        let postgres = postgres.unwrap();
        assert_eq!(sqlite.unwrap(), postgres, stringify!($module::$function($($argument),*)));
        postgres
    }};
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn measurements_are_stored_listed_and_removed_as_by_the_other_engine() {
    let test = "measurements_are_stored_listed_and_removed_as_by_the_other_engine";
    with_database(test, async |database| {
        database.run(NAMED).await;
        let folder = std::env::temp_dir().join(format!("tread-segments-{}", uuid::Uuid::new_v4()));
        std::fs::create_dir(&folder).unwrap();
        let sqlite = tread_store_sqlite::Db::open(Path::new(&folder.join("tread.db")))
            .await
            .unwrap();
        let mut tx = sqlite.write("db").await.unwrap();
        sqlx::raw_sql(NAMED).execute(&mut *tx).await.unwrap();
        tx.commit().await.unwrap();
        let db = database.open().await;
        let mut runner = TestRunner::deterministic();
        let gap = prop_oneof![8 => Just(1_i64), 1 => 2_i64..9];
        let upload = prop::collection::vec((1_i64..3, gap, segment()), 0..60);
        let uploads = prop::collection::vec((upload, 0_i64..9), 1..6);
        for _ in 0..CASES {
            let mut theirs = sqlite.write("db").await.unwrap();
            let mut ours = db.write("db").await.unwrap();
            let mut seqs = [0_i64; 2];
            for (upload, second) in uploads.new_tree(&mut runner).unwrap().current() {
                let new: Vec<NewSegment<'_>> = upload
                    .iter()
                    .map(|(pk, gap, segment)| {
                        let seq = &mut seqs[usize::from(*pk == 2)];
                        *seq += gap;
                        NewSegment {
                            boot_pk: *pk,
                            seq: *seq,
                            robot_pk: *pk,
                            site_pk: *pk,
                            configuration_pk: 9,
                            segment,
                            times_ns: (*seq * 1_000_000_007, i64::MAX - *seq),
                        }
                    })
                    .collect();
                let at = Timestamp::from_second(second).unwrap();
                both!(theirs, ours, segments::insert(&new, at));
            }
            let ends = both!(theirs, ours, segment_ranges::ends());
            both!(theirs, ours, segment_ranges::last());
            both!(theirs, ours, segment_ranges::last_keys());
            let named = BTreeSet::from(["rover-2".parse().unwrap()]);
            for (site_pk, robot, terrain, robots, after) in [
                (1, None, None, None, 0),
                (2, None, None, Some(&named), 5),
                (1, Some("rover-1"), None, None, 3),
                (2, Some("rover-2"), Some("mud"), Some(&named), 0),
                (1, None, Some("gravel"), None, 7),
                (1, None, None, Some(&named), 0),
            ] {
                let filter = SegmentFilter {
                    robot: robot.map(|name| name.parse().unwrap()),
                    terrain: terrain.map(|name| name.parse().unwrap()),
                    robots: robots.cloned(),
                    after,
                };
                both!(theirs, ours, segments::list(site_pk, &filter, 50));
                both!(theirs, ours, segments::extent(site_pk, &filter));
            }
            both!(theirs, ours, segments::of_all_sites(4..=40, 30));
            let since = Timestamp::from_second(4).unwrap();
            both!(theirs, ours, segments::first_since(since));
            let (robot_pk, site_pk, after) = (1, 1, 4);
            let of_robot: Vec<_> = segments::of_robot(&mut ours, RobotCursor { robot_pk, after })
                .try_collect()
                .await
                .unwrap();
            let cursor = SiteCursor { site_pk, after };
            let of_site = segments::of_site(&mut ours, cursor, u32::MAX)
                .await
                .unwrap();
            let theirs_of_site =
                tread_store_sqlite::segments::of_site(&mut theirs, cursor, u32::MAX)
                    .await
                    .unwrap();
            assert_eq!(format!("{of_site:?}"), format!("{theirs_of_site:?}"));
            assert_eq!(format!("{of_site:?}"), format!("{of_robot:?}"));
            if let Some((first, last)) = ends {
                for until in [first + (last - first) / 3, last - 1] {
                    both!(theirs, ours, removed::remove(until));
                    both!(theirs, ours, removed::boots());
                    for boot_pk in [1, 2] {
                        both!(theirs, ours, removed::within(boot_pk, 3..=50));
                        both!(theirs, ours, removed::newest_seq(boot_pk));
                        both!(theirs, ours, segment_ranges::within(boot_pk, 3..=50));
                        both!(theirs, ours, segment_ranges::newest_seq(boot_pk));
                    }
                    let before = Timestamp::from_second(5).unwrap();
                    both!(theirs, ours, removed::last_before(before, until + 9));
                    both!(theirs, ours, segments::of_all_sites(1..=i64::MAX, 300));
                }
            }
        }
        sqlite.close().await;
        db.close().await;
        std::fs::remove_dir_all(&folder).unwrap();
    })
    .await;
}

/// A report, not a test: `cargo test … --ignored --nocapture speed`.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "measures"]
async fn the_speed_of_writing_and_reading_measurements() {
    with_database(
        "the_speed_of_writing_and_reading_measurements",
        async |database| {
            database.run(NAMED).await;
            let db = database.open().await;
            let mut runner = TestRunner::deterministic();
            let some = segment().new_tree(&mut runner).unwrap().current();
            let mut seq = 0;
            for rows in [50, 500, 5_000] {
                let (begun, mut written) = (Instant::now(), 0);
                while begun.elapsed().as_secs() < 2 {
                    let new = |seq| NewSegment {
                        boot_pk: 1,
                        seq,
                        robot_pk: 1,
                        site_pk: 1,
                        configuration_pk: 9,
                        segment: &some,
                        times_ns: (seq, seq),
                    };
                    let upload: Vec<_> = (seq..seq + rows).map(new).collect();
                    seq += rows;
                    let mut tx = db.write("db").await.unwrap();
                    segments::insert(&mut tx, &upload, Timestamp::UNIX_EPOCH)
                        .await
                        .unwrap();
                    tx.commit().await.unwrap();
                    written += upload.len() as u128;
                }
                let rate = written * 1_000 / begun.elapsed().as_millis();
                eprintln!("{rows} rows a transaction: {rate} rows/s");
            }
            database.run("ANALYZE").await;
            for after in [0, seq / 2, seq - 6_000] {
                let mut tx = db.read("db").await.unwrap();
                let begun = Instant::now();
                let cursor = SiteCursor { site_pk: 1, after };
                let found = segments::of_site(&mut tx, cursor, 5_000).await.unwrap();
                eprintln!(
                    "{} of {seq} rows after {after}: {:?}",
                    found.len(),
                    begun.elapsed()
                );
            }
            let mut tx = db.read("db").await.unwrap();
            let begun = Instant::now();
            let cursor = RobotCursor {
                robot_pk: 1,
                after: 0,
            };
            let all: Vec<_> = segments::of_robot(&mut tx, cursor)
                .try_collect()
                .await
                .unwrap();
            eprintln!("{} rows streamed: {:?}", all.len(), begun.elapsed());
            drop(tx);
            eprintln!("{:?}", db.disk().await);
            db.close().await;
        },
    )
    .await;
}
