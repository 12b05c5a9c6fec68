//! Old measurements are archived before they are removed, and lists go on through the archive.

mod buckets;
mod failures;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use reqwest::StatusCode;
use serde_json::json;
use tempfile::TempDir;
use tokio_util::sync::CancellationToken;
use tread_api::friction::StoredSegment;
use tread_api::identity::Role;
use tread_api::ids::RobotId;
use tread_api::rights::Scope;
use tread_api::terrain::TerrainRef;
use tread_api::wire::ingest::Record;
use tread_server::app::{App, Dependencies};
use tread_server::archive::SegmentArchive;
use tread_server::config::RetentionConfig;
use tread_server::db::alerts::AlertFilter;
use tread_server::db::file::copy::{self, CopyPaths};
use tread_server::db::segments::SegmentFilter;
use tread_server::db::{Db, segment_ranges};

use crate::harness::{Yard, client, eventually, measured, segment, site, time};
use crate::ingest::Writer;
use crate::map::said;

const DAY: Duration = Duration::from_hours(24);
/// Measurements of one upload, and of one day.
const OF_A_DAY: u64 = 40;

fn week(archive: &Path) -> RetentionConfig {
    RetentionConfig {
        segments_days: 7,
        archive: Some(archive.to_owned().into()),
        ..RetentionConfig::default()
    }
}

/// Measurements of three cells, some of them on a terrain.
fn drive(from: u64) -> Vec<Record> {
    let record = |seq: u64| {
        let place = i32::try_from(seq % 3).unwrap();
        let mut pass = segment((place, 0), 0.2 + 0.001 * f64::from(place), 60);
        pass.terrain = seq.is_multiple_of(4).then(|| TerrainRef {
            id: "mud".parse().unwrap(),
            revision: 1,
        });
        measured(seq, pass)
    };
    (from..from + OF_A_DAY).map(record).collect()
}

/// A server's database with an archive, after uploads on so many days.
struct Ground {
    writer: Writer,
    folder: TempDir,
}

impl Ground {
    async fn start(days: u64) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let writer = Writer::start_with(Some(folder.path().join("archive"))).await;
        let ground = Self { writer, folder };
        for day in 0..days {
            ground.a_day(day).await;
        }
        ground
    }

    /// Two robots upload, and the day ends.
    async fn a_day(&self, day: u64) {
        for robot in ["rover-1", "rover-2"] {
            let receipt = self.writer.upload_as(robot, drive(day * OF_A_DAY)).await;
            assert_eq!(receipt.committed, OF_A_DAY);
        }
        self.app().clock().advance(DAY);
    }

    fn app(&self) -> &App {
        &self.writer.app
    }

    fn archive(&self) -> PathBuf {
        self.folder.path().join("archive")
    }

    /// What a server would know that starts now on the same database and archive.
    async fn restarted(&self) -> App {
        self.restarted_on(self.app().db().clone()).await
    }

    async fn restarted_on(&self, db: Db) -> App {
        let archive = SegmentArchive::new(self.archive().into(), db.path()).unwrap();
        let app = App::new(Dependencies {
            archive: Some(archive),
            ..Dependencies::on_database(db, self.app().clock().clone())
        });
        app.load_map().await.unwrap();
        app
    }

    async fn archive_and_remove(&self, app: &App, file_rows_max: u32) {
        let stop = CancellationToken::new();
        let config = week(&self.archive());
        app.archive_and_remove(&config, file_rows_max, &stop)
            .await
            .unwrap();
    }

    /// Names in the archive, in order.
    fn names(&self) -> Vec<String> {
        let Ok(entries) = fs::read_dir(self.archive()) else {
            return Vec::new();
        };
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }
}

/// First key of the database.
async fn first_key(app: &App) -> i64 {
    let mut tx = app.db().read("test").await.unwrap();
    let ends = segment_ranges::ends(&mut tx).await.unwrap();
    ends.unwrap().0
}

fn filters() -> [SegmentFilter; 6] {
    let robots = |names: &[&str]| -> Option<std::collections::BTreeSet<RobotId>> {
        Some(names.iter().map(|name| name.parse().unwrap()).collect())
    };
    let everything = SegmentFilter::default();
    [
        everything.clone(),
        SegmentFilter {
            robot: Some("rover-2".parse().unwrap()),
            ..everything.clone()
        },
        SegmentFilter {
            terrain: Some("mud".parse().unwrap()),
            ..everything.clone()
        },
        SegmentFilter {
            robot: Some("rover-1".parse().unwrap()),
            terrain: Some("mud".parse().unwrap()),
            robots: robots(&["rover-1"]),
            ..everything.clone()
        },
        SegmentFilter {
            robots: robots(&["rover-2", "rover-7"]),
            ..everything.clone()
        },
        SegmentFilter {
            robots: robots(&[]),
            ..everything
        },
    ]
}

/// The whole list in pages of a size.
async fn listed(app: &App, filter: &SegmentFilter, limit: u32) -> Vec<StoredSegment> {
    let mut filter = filter.clone();
    let mut all = Vec::new();
    loop {
        let page = app.segments(&site(), &filter, limit).await.unwrap();
        assert!(page.items.len() <= usize::try_from(limit).unwrap());
        all.extend(page.items);
        match page.next_cursor {
            Some(cursor) => filter.after = cursor.parse().unwrap(),
            None => return all,
        }
    }
}

async fn everything(app: &App) -> Vec<StoredSegment> {
    listed(app, &SegmentFilter::default(), 1_000).await
}

async fn alert(app: &App) -> Option<String> {
    let filter = AlertFilter {
        site: None,
        robot: None,
        kind: Some("archive-failed".parse().unwrap()),
        raised: true,
        before: None,
        within: Scope::EVERYWHERE,
    };
    let page = app.alerts(&filter, 100).await.unwrap();
    page.items.into_iter().next().map(|alert| alert.text)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_list_over_archive_and_database_is_the_list_of_before() {
    let ground = Ground::start(12).await;
    let app = ground.app();
    let map = said(app).await;
    let mut expected = Vec::new();
    for filter in filters() {
        expected.push(listed(app, &filter, 1_000).await);
    }
    assert_eq!(expected[0].len(), 960);
    assert_eq!(ground.names(), Vec::<String>::new());

    // Two whole days fit into a file.
    ground.archive_and_remove(app, 180).await;
    let first = first_key(app).await;
    assert_eq!(first, 401, "five days are older than a week");
    assert_eq!(ground.names().len(), 3, "{:?}", ground.names());
    assert_eq!(app.counters().values().segments_archived, 400);
    assert_eq!(app.counters().values().segments_removed, 400);
    for (filter, expected) in filters().iter().zip(&expected) {
        for limit in [1, 3, 64, 399, 400, 401, 1_000] {
            if limit == 1 && expected.len() > 500 {
                continue;
            }
            let found = listed(app, filter, limit).await;
            assert!(
                found == *expected,
                "{filter:?} in pages of {limit}: {}",
                found.len()
            );
        }
    }
    assert_eq!(said(app).await, map, "the map does not change");
    // Nothing else is due until the day ends.
    ground.archive_and_remove(app, 180).await;
    assert_eq!(first_key(app).await, first);
    ground.a_day(12).await;
    ground.archive_and_remove(app, 180).await;
    assert_eq!(first_key(app).await, 481);
    assert_eq!(ground.names().len(), 4);
    assert_eq!(everything(app).await.len(), 1_040);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_day_that_does_not_fit_into_a_file_is_divided() {
    let ground = Ground::start(10).await;
    let expected = everything(ground.app()).await;
    ground.archive_and_remove(ground.app(), 50).await;
    assert_eq!(
        first_key(ground.app()).await,
        241,
        "three days are older than a week"
    );
    assert_eq!(ground.names().len(), 6, "{:?}", ground.names());
    assert_eq!(everything(ground.app()).await, expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_limit_of_number_is_kept_by_whole_days() {
    let ground = Ground::start(5).await;
    let config = RetentionConfig {
        segments_max: 100,
        ..week(&ground.archive())
    };
    let stop = CancellationToken::new();
    let app = ground.app();
    app.archive_and_remove(&config, 10_000, &stop)
        .await
        .unwrap();
    // 300 are beyond the limit: three whole days, and a part of the fourth, which stays.
    assert_eq!(first_key(app).await, 241);
    assert_eq!(ground.names().len(), 1);
    assert_eq!(everything(app).await.len(), 400);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_crash_between_the_file_and_the_removal_changes_no_list() {
    let ground = Ground::start(9).await;
    let expected = everything(ground.app()).await;
    let config = week(&ground.archive());
    let stop = CancellationToken::new();
    ground.archive_and_remove(ground.app(), 10_000).await;
    let names = ground.names();
    assert_eq!((names.len(), first_key(ground.app()).await), (1, 161));

    // Another server, whose file was written and whose rows are all there.
    let other = Ground::start(9).await;
    fs::create_dir(other.archive()).unwrap();
    for name in &names {
        fs::copy(ground.archive().join(name), other.archive().join(name)).unwrap();
    }
    let left = "segments-0000000000000000161-0000000000000000240.parquet.partial";
    fs::write(other.archive().join(left), "half a file").unwrap();
    assert_eq!(everything(other.app()).await.len(), expected.len());
    let app = other.restarted().await;
    let of_other = everything(&app).await;
    assert_eq!(
        app.remove_some(&config, 30).await.unwrap(),
        0,
        "not compared yet"
    );
    let archived = app.counters().values().segments_archived;
    app.archive_and_remove(&config, 10_000, &stop)
        .await
        .unwrap();
    assert_eq!(first_key(&app).await, 161);
    assert_eq!(
        other.names(),
        names,
        "the file was used again, the unfinished one is gone"
    );
    assert_eq!(app.counters().values().segments_archived, archived);
    assert_eq!(everything(&app).await, of_other);

    // A third one, which was killed after it had removed some.
    let third = Ground::start(9).await;
    let expected = everything(third.app()).await;
    fs::create_dir(third.archive()).unwrap();
    for name in &names {
        fs::copy(ground.archive().join(name), third.archive().join(name)).unwrap();
    }
    let without = Dependencies::on_database(third.app().db().clone(), third.app().clock().clone());
    let without = App::new(without);
    without.load_map().await.unwrap();
    assert_eq!(without.remove_some(&config, 30).await.unwrap(), 30);
    assert_eq!(everything(&without).await.len(), expected.len() - 30);
    let app = third.restarted().await;
    assert_eq!(
        (first_key(&app).await, everything(&app).await),
        (31, expected.clone())
    );
    app.archive_and_remove(&config, 10_000, &stop)
        .await
        .unwrap();
    assert_eq!(
        (first_key(&app).await, everything(&app).await),
        (161, expected)
    );
    assert_eq!(third.names(), names);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn keys_that_are_given_again_after_a_restoration_supersede_their_files() {
    let ground = Ground::start(4).await;
    let backup = ground.folder.path().join("backup.db");
    let paths = CopyPaths {
        database: ground.app().db().path().unwrap(),
        target: &backup,
    };
    copy::copy_into(paths).await.unwrap();
    for day in 4..14 {
        ground.a_day(day).await;
    }
    ground.archive_and_remove(ground.app(), 100).await;
    assert_eq!(first_key(ground.app()).await, 561);
    let names = ground.names();
    assert_eq!(names.len(), 7, "{names:?}");

    // The database of the fourth day. Other measurements get the keys after it.
    let db = Db::open(&backup).await.unwrap();
    let app = ground.restarted_on(db).await;
    let before = everything(&app).await;
    assert_eq!(
        before.len(),
        320,
        "files show nothing beyond the database's first key"
    );
    let stop = CancellationToken::new();
    let config = week(&ground.archive());
    app.archive_and_remove(&config, 100, &stop).await.unwrap();
    assert_eq!(first_key(&app).await, 320, "the last one stays");
    let present = |names: &[String]| {
        names
            .iter()
            .filter(|name| name.ends_with(".parquet"))
            .count()
    };
    assert_eq!(
        present(&ground.names()),
        7,
        "the same contents are not written again"
    );
    assert_eq!(everything(&app).await, before);

    // The next measurements, a week before they are removed.
    let other = Writer::on(app.clone()).await;
    let receipt = other
        .upload_of("rover-1", crate::ingest::boot(9), drive(0))
        .await
        .unwrap();
    assert_eq!(receipt.committed, OF_A_DAY);
    app.clock().advance(9 * DAY);
    let receipt = other
        .upload_of("rover-2", crate::ingest::boot(9), drive(0))
        .await
        .unwrap();
    assert_eq!(receipt.committed, OF_A_DAY);
    let expected = everything(&app).await;
    assert_eq!(expected.len(), 400);
    app.archive_and_remove(&config, 100, &stop).await.unwrap();
    assert_eq!(first_key(&app).await, 361);
    assert_eq!(everything(&app).await, expected);
    let superseded: Vec<String> = ground.names();
    let superseded = superseded
        .iter()
        .filter(|name| name.ends_with(".superseded"));
    assert_eq!(superseded.count(), 1, "{:?}", ground.names());
    app.db().close().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_consumer_of_the_api_reads_on_through_the_archive() {
    let at = time("2026-11-01T00:00:00Z");
    let folder = tempfile::tempdir().unwrap();
    let archive = folder.path().join("archive");
    let yard = Yard::start_with(at, |config| {
        config.retention = week(&archive);
    })
    .await;
    let robot = crate::robot::Robot::join(&yard, "rover-1").await;
    for day in 0..10 {
        robot.upload(drive(day * OF_A_DAY)).await.unwrap();
        yard.server.app().clock().advance(DAY);
    }
    // The admin's token has expired.
    let reader = client(Some(&yard.token("reader", Role::Viewer).await.secret));
    let get = async |query: &str| {
        let url = yard.url(&format!("/v1/sites/yard/segments?{query}"));
        yard.send(reader.get(url)).await
    };
    let csv = async || get("format=csv").await.1;
    let (_, page) = get("limit=1000").await;
    let (expected, table) = (page["items"].clone(), csv().await);
    assert_eq!(expected.as_array().unwrap().len(), 400);
    let app = yard.server.app();
    let stop = CancellationToken::new();
    app.archive_and_remove(&week(&archive), 100, &stop)
        .await
        .unwrap();
    assert_eq!(first_key(app).await, 121);
    let (_, page) = get("limit=1000").await;
    assert_eq!(page, json!({"items": expected, "next_cursor": null}));
    assert_eq!(csv().await, table);

    let metrics = format!("http://{}/metrics", yard.server.metrics_address().unwrap());
    let shown = async || reqwest::get(&metrics).await.unwrap().text().await.unwrap();
    let text = shown().await;
    assert!(text.contains("tread_archive_failed 0"), "{text}");
    assert!(text.contains("tread_segments_archived_total 120"), "{text}");

    let file = fs::read_dir(&archive)
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    fs::write(&file, "another file").unwrap();
    let (status, problem) = get("limit=1000").await;
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{problem}");
    assert_eq!(problem["type"], "/problems/unavailable", "{problem}");
    let name = file.file_name().unwrap().to_str().unwrap();
    assert!(
        problem["detail"].as_str().unwrap().contains(name),
        "{problem}"
    );
    let (status, page) = get("limit=1000&cursor=120").await;
    assert_eq!(status, StatusCode::OK, "{page}");
    assert_eq!(page["items"].as_array().unwrap().len(), 280);
    let text = eventually("the failure is counted", async || {
        let text = shown().await;
        if text.contains("tread_archive_failures_total 1") {
            Ok(text)
        } else {
            Err(text)
        }
    });
    text.await;
    yard.server.stop().await.unwrap();
}
