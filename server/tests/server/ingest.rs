//! Sent twice is counted once, in whatever order it comes; and the map says what was measured.

use std::path::PathBuf;

use jiff::SignedDuration;
use proptest::prelude::*;
use proptest::test_runner::{Config as ProptestConfig, TestRunner};
use serde_json::{Value, json};
use tokio::sync::{mpsc, oneshot};
use tread_api::friction::{CellFriction, StoredSegment, TerrainFriction};
use tread_api::ids::BootId;
use tread_api::page::Page;
use tread_api::wire::hello::Hello;
use tread_api::wire::ingest::{Batch, Receipt, Record};
use tread_server::app::ingest::{self, UPLOADS_WAITING_MAX, Upload};
use tread_server::app::{App, Dependencies, map_blocks};
use tread_server::archive::SegmentArchive;
use tread_server::clock::Clock;
use tread_server::config::MapConfig;
use tread_server::db::sums::SumRow;
use tread_server::db::{self, Db};
use tread_server::supervisor::Supervisor;
use uuid::Uuid;

use crate::harness::{Yard, database, measured, model, segment, site, time};
use crate::robot::Robot;

/// The writer on a database of its own, without a network.
pub(crate) struct Writer {
    _folder: Option<tempfile::TempDir>,
    pub(crate) app: App,
    pub(crate) uploads: mpsc::Sender<Upload>,
    supervisor: Supervisor,
}

pub(crate) fn boot(number: u128) -> BootId {
    BootId::from_uuid(Uuid::from_u128(number))
}

impl Writer {
    pub(crate) async fn start() -> Self {
        Self::start_with(None).await
    }

    /// The same, with an archive in a folder.
    pub(crate) async fn start_with(archive: Option<PathBuf>) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&database(folder.path())).await.unwrap();
        let clock = Clock::manual(time("2026-11-01T00:00:00Z"));
        let archive =
            archive.map(|location| SegmentArchive::new(location.into(), db.path()).unwrap());
        let app = App::new(Dependencies {
            archive,
            ..Dependencies::on_database(db, clock)
        });
        Self::with(app, Some(folder)).await
    }

    /// The same, with a map of which nothing stays in memory.
    pub(crate) async fn start_without_memory() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&database(folder.path())).await.unwrap();
        let clock = Clock::manual(time("2026-11-01T00:00:00Z"));
        let app = App::new(Dependencies {
            map: MapConfig { memory_max_mib: 0 },
            ..Dependencies::on_database(db, clock)
        });
        Self::with(app, Some(folder)).await
    }

    /// The writer on a database that is open already.
    pub(crate) async fn on(app: App) -> Self {
        Self::with(app, None).await
    }

    async fn with(app: App, folder: Option<tempfile::TempDir>) -> Self {
        app.ensure_site(&site()).await.unwrap();
        for robot in ["rover-1", "rover-2"] {
            let hello = Hello {
                robot: robot.parse().unwrap(),
                boot: boot(1),
                agent_version: "0".to_owned(),
                model: model(),
                robot_time: app.clock().now(),
                capabilities: tread_api::robot::Capabilities::default(),
            };
            app.hello(&site(), &hello).await.unwrap();
        }
        let (uploads, uploads_in) = mpsc::channel(UPLOADS_WAITING_MAX);
        let supervisor = Supervisor::new();
        let writer = ingest::run(app.clone(), uploads_in, supervisor.stop_token());
        supervisor.spawn_vital("ingest", writer);
        let evicting = map_blocks::run(app.clone(), supervisor.stop_token());
        supervisor.spawn_vital("map blocks", evicting);
        Self {
            _folder: folder,
            app,
            uploads,
            supervisor,
        }
    }

    /// Uploads without waiting, so that several may share a transaction.
    async fn upload(
        &self,
        robot: &str,
        records: Vec<Record>,
    ) -> oneshot::Receiver<Result<Receipt, tread_api::wire::Refusal>> {
        self.send(robot, boot(1), records).await
    }

    async fn send(
        &self,
        robot: &str,
        boot: BootId,
        records: Vec<Record>,
    ) -> oneshot::Receiver<Result<Receipt, tread_api::wire::Refusal>> {
        let (answer, answered) = oneshot::channel();
        let batch = Batch {
            robot: robot.parse().unwrap(),
            boot,
            robot_time: None,
            records,
        };
        let upload = Upload {
            site: site(),
            batch,
            answer,
        };
        self.uploads.send(upload).await.unwrap();
        answered
    }

    /// Uploads, and waits for the answer.
    pub(crate) async fn upload_as(&self, robot: &str, records: Vec<Record>) -> Receipt {
        self.upload(robot, records).await.await.unwrap().unwrap()
    }

    /// The same as one run of its agent, with what it is refused.
    pub(crate) async fn upload_of(
        &self,
        robot: &str,
        boot: BootId,
        records: Vec<Record>,
    ) -> Result<Receipt, tread_api::wire::Refusal> {
        self.send(robot, boot, records).await.await.unwrap()
    }

    /// The stored sums, after those that are unwritten were stored.
    pub(crate) async fn sums(&self) -> Vec<SumRow> {
        self.app.write_sums().await.unwrap();
        stored_sums(&self.app).await
    }
}

/// The stored sums.
pub(crate) async fn stored_sums(app: &App) -> Vec<SumRow> {
    let mut tx = app.db().read("test").await.unwrap();
    let mut rows = Vec::new();
    let taken = db::sums::each(&mut tx, |row| rows.push(row)).await;
    taken.unwrap();
    rows.sort_by(|left: &SumRow, right| left.key.cmp(&right.key));
    rows
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.supervisor.stop_token().cancel();
    }
}

fn record(seq: u64) -> Record {
    let number = i32::try_from(seq).unwrap();
    let theta = 0.1 + f64::from(number) / 7.0;
    measured(
        seq,
        segment((number % 3, -number % 2), theta, i64::from(number) * 1_700),
    )
}

async fn sums_after(batches: &[(&str, Vec<u64>)]) -> (Vec<SumRow>, u64, u64) {
    let writer = Writer::start().await;
    let mut answers = Vec::new();
    for (robot, seqs) in batches {
        let records = seqs.iter().map(|&seq| record(seq)).collect();
        answers.push(writer.upload(robot, records).await);
    }
    let (mut committed, mut duplicates) = (0, 0);
    for answer in answers {
        let receipt = answer.await.unwrap().unwrap();
        assert_eq!(receipt.refused, []);
        committed += receipt.committed;
        duplicates += receipt.duplicates;
    }
    (writer.sums().await, committed, duplicates)
}

#[test]
fn repeated_overlapping_and_reordered_batches_leave_the_same_sums_to_the_bit() {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    let once = [
        ("rover-1", (0..12).collect::<Vec<_>>()),
        ("rover-2", (0..12).collect()),
    ];
    let (expected, committed, duplicates) = runtime.block_on(sums_after(&once));
    assert_eq!((committed, duplicates), (24, 0));
    let total: u64 = expected.iter().map(|row| row.sums.segments).sum();
    assert_eq!(total, 24);

    let batch = (
        prop::sample::select(vec!["rover-1", "rover-2"]),
        prop::collection::vec(0_u64..12, 0..20),
    );
    let mut runner = TestRunner::new(ProptestConfig {
        cases: 24,
        ..ProptestConfig::default()
    });
    runner
        .run(&prop::collection::vec(batch, 0..8), |mut batches| {
            // Whatever came before, in the end everything has come.
            batches.extend(
                once.iter()
                    .map(|(robot, seqs)| (*robot, seqs.iter().rev().copied().collect())),
            );
            let sent: u64 = batches.iter().map(|(_, seqs)| seqs.len() as u64).sum();
            let (sums, committed, duplicates) = runtime.block_on(sums_after(&batches));
            prop_assert_eq!(&sums, &expected);
            prop_assert_eq!((committed, committed + duplicates), (24, sent));
            Ok(())
        })
        .unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_segment_that_is_not_possible_is_refused_alone() {
    let writer = Writer::start().await;
    let mut bad = segment((0, 0), 0.2, 0);
    bad.theta.information = -1.0;
    let records = vec![
        record(0),
        measured(1, bad),
        record(2),
        measured(1 << 53, segment((0, 0), 0.2, 0)),
    ];
    let receipt = writer
        .upload("rover-1", records)
        .await
        .await
        .unwrap()
        .unwrap();
    assert_eq!(receipt.committed, 2);
    let refused: Vec<u64> = receipt.refused.iter().map(|refused| refused.seq).collect();
    assert_eq!(refused, [1, 1 << 53]);
    assert!(receipt.refused[0].reason.contains("theta"), "{receipt:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_robots_upload_is_on_the_map_per_terrain_cell_and_raw() {
    let yard = Yard::start_at(segment((0, 0), 0.2, 60).ended_at).await;
    let corners =
        json!([{"x_m": 0.0, "y_m": 0.0}, {"x_m": 9.0, "y_m": 0.0}, {"x_m": 9.0, "y_m": 9.0}]);
    let lawn = json!({"id": "lawn", "class": "grass", "polygon": corners});
    yard.post("/v1/sites/yard/terrains", &lawn).await;
    let one = Robot::join(&yard, "rover-1").await;
    let two = Robot::join(&yard, "rover-2").await;
    let unknown: TerrainFriction = yard.get("/v1/sites/yard/friction/terrains/lawn").await;
    assert!(unknown.models.is_empty(), "unknown is not a number");

    let drive = |theta: f64| -> Vec<Record> {
        (0..4)
            .map(|seq| measured(u64::try_from(seq).unwrap(), segment((seq, 0), theta, 0)))
            .collect()
    };
    let receipt = one.upload(drive(0.19)).await.unwrap();
    assert_eq!((receipt.committed, receipt.duplicates), (4, 0));
    let receipt = one.upload(drive(0.19)).await.unwrap();
    assert_eq!((receipt.committed, receipt.duplicates), (0, 4));
    two.upload(drive(0.21)).await.unwrap();

    let terrain: TerrainFriction = yard.get("/v1/sites/yard/friction/terrains/lawn").await;
    assert_eq!(terrain.models.len(), 1);
    assert_eq!(terrain.models[0].model, "test rover");
    let friction = terrain.models[0].friction.unwrap();
    assert_eq!((friction.segments, friction.robots), (8, 2));
    assert!((friction.theta - 0.2).abs() < 1e-3, "{friction:?}");
    assert!((friction.stiffness - 5.0).abs() < 0.05, "{friction:?}");
    assert_eq!(friction.mu_peak_lower_bound, Some(0.4));
    assert!(friction.theta_low_95 < 0.2 && friction.theta_high_95 > 0.2);

    let mut seen = Vec::new();
    let mut path = "/v1/sites/yard/friction/cells?x_min_m=1&x_max_m=100&limit=2".to_owned();
    let base = path.clone();
    loop {
        let page: Page<CellFriction> = yard.get(&path).await;
        seen.extend(page.items.iter().map(|item| item.cell.ix));
        assert!(page.items.iter().all(|item| item.friction.segments == 2));
        let Some(cursor) = page.next_cursor else {
            break;
        };
        path = format!("{base}&cursor={cursor}");
    }
    assert_eq!(seen, [1, 2, 3]);

    let raw: Page<StoredSegment> = yard
        .get("/v1/sites/yard/segments?robot=rover-1&limit=3")
        .await;
    assert_eq!(raw.items.len(), 3);
    assert_eq!(raw.items[0].segment, segment((0, 0), 0.19, 0));
    assert_eq!(raw.items[0].boot, one.boot);
    let cursor = raw.next_cursor.unwrap();
    let path = format!("/v1/sites/yard/segments?robot=rover-1&limit=3&cursor={cursor}");
    let rest: Page<StoredSegment> = yard.get(&path).await;
    assert_eq!((rest.items.len(), rest.items[0].seq), (1, 3));
    for (filter, count) in [
        ("", 8),
        ("?terrain=lawn", 8),
        ("?terrain=road", 0),
        ("?robot=rover-2&terrain=lawn", 4),
    ] {
        let page: Page<Value> = yard.get(&format!("/v1/sites/yard/segments{filter}")).await;
        assert_eq!(page.items.len(), count, "{filter}");
    }
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_new_name_keeps_the_friction_of_the_ground_and_a_new_outline_does_not() {
    let yard = Yard::start().await;
    let lawn = |name: &str, side_m: f64| {
        json!({"name": name, "class": "grass", "polygon": [
            {"x_m": 0.0, "y_m": 0.0}, {"x_m": side_m, "y_m": 0.0}, {"x_m": side_m, "y_m": side_m}]})
    };
    let mut first = lawn("Lawn", 9.0);
    first["id"] = "lawn".into();
    yard.post("/v1/sites/yard/terrains", &first).await;
    let robot = Robot::join(&yard, "rover-1").await;
    robot
        .upload(vec![measured(0, segment((0, 0), 0.2, 0))])
        .await
        .unwrap();
    let known = async || {
        let terrain: TerrainFriction = yard.get("/v1/sites/yard/friction/terrains/lawn").await;
        terrain.models.len()
    };
    let replace = async |body: Value| {
        let url = yard.url("/v1/sites/yard/terrains/lawn");
        let (status, body) = yard.send(yard.client().put(url).json(&body)).await;
        assert_eq!(status, 200, "{body}");
    };
    assert_eq!(known().await, 1);
    replace(lawn("South lawn", 9.0)).await;
    assert_eq!(known().await, 1);
    replace(lawn("South lawn", 8.0)).await;
    assert_eq!(known().await, 0);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn times_of_a_wrong_clock_are_put_right_and_nothing_of_it_is_lost() {
    let writer = Writer::start().await;
    let now = time("2026-11-01T00:00:00Z");
    let day_s = 86_400;
    // How far the records' clock is ahead, what the batch says of the clock, when it counts.
    let cases = [
        (5 * day_s, Some(5 * day_s), -60),
        (-9 * day_s, Some(-9 * day_s), -60),
        // What the network takes is no wrong clock.
        (0, Some(-2), -60),
    ];
    for (number, (ahead_s, said_s, counts_s)) in (0_u16..).zip(cases) {
        let seq = u64::from(number);
        let shifted = |by_s: i64| now + SignedDuration::from_secs(by_s);
        let mut segment = segment((i32::from(number), 0), 0.2, 0);
        segment.started_at = shifted(ahead_s - 70);
        segment.ended_at = shifted(ahead_s - 60);
        let (answer, answered) = oneshot::channel();
        let batch = Batch {
            robot: "rover-1".parse().unwrap(),
            boot: boot(1),
            robot_time: said_s.map(shifted),
            records: vec![measured(seq, segment)],
        };
        let upload = Upload {
            site: site(),
            batch,
            answer,
        };
        writer.uploads.send(upload).await.unwrap();
        assert_eq!(answered.await.unwrap().unwrap().committed, 1);
        let mut tx = writer.app.db().read("test").await.unwrap();
        let (started_at_ns, ended_at_ns): (i64, i64) =
            sqlx::query_as("SELECT started_at_ns, ended_at_ns FROM segments WHERE seq = ?")
                .bind(i64::from(number))
                .fetch_one(&mut **tx.as_sqlite().unwrap())
                .await
                .unwrap();
        let expected = shifted(counts_s).as_nanosecond();
        assert_eq!(i128::from(ended_at_ns), expected, "case {number}");
        let span_ns = ended_at_ns - started_at_ns;
        assert_eq!(span_ns, 10_000_000_000, "case {number}");
    }
}
