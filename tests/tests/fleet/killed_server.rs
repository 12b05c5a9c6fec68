//! Sums are stored behind the receipts; a server that is killed in between says the same, to the bit,
//! as one that never was.

use std::path::Path;

use jiff::{SignedDuration, Timestamp};
use serde_json::Value;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions as _, Row as _};
use tokio::task::JoinSet;
use tread_api::friction::{Information, Segment, ThetaErrors};
use tread_api::ids::{BootId, ConfigurationId, RobotId};
use tread_api::site::Cell;
use tread_api::wire::ingest::{Batch, Record, RecordContent};
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::light_robot::{LightRobot, now, paper_robot};
use tread_tests::stored::{self, await_sums};
use tread_tests::wait::{DRIVE, SHORT, eventually};
use uuid::Uuid;

use crate::fleet;

const ROBOTS: usize = 3;
const RECORDS_PER_BATCH: u64 = 20;
/// So many batches that a robot uploads for longer than the server takes to store sums twice.
const BATCHES: u64 = 250;
/// Receipts after which the server is killed for the first time, usually before any sums are stored,
/// and after sums were stored.
const RECEIPTS: usize = 3;

/// What one robot uploads, and how many batches have a receipt.
struct Work {
    id: RobotId,
    boot: BootId,
    number: u32,
    begin: Timestamp,
    received: usize,
}

impl Work {
    fn all(begin: Timestamp) -> Vec<Self> {
        let work = |number: u32| Self {
            id: format!("rover-{number}").parse().unwrap(),
            boot: BootId::from_uuid(Uuid::from_u128((7 << 76) + u128::from(number))),
            number,
            begin,
            received: 0,
        };
        (0..u32::try_from(ROBOTS).unwrap()).map(work).collect()
    }

    fn batch(&self, batch: u64, records: u64) -> Batch {
        let record = |seq| Record {
            seq,
            content: RecordContent::Segment(self.segment(seq)),
        };
        let first = batch * records;
        Batch {
            robot: self.id.clone(),
            boot: self.boot,
            robot_time: None,
            records: (first..first + records).map(record).collect(),
        }
    }

    /// Numbers that no binary fraction gives exactly, in cells that all robots visit again and again.
    fn segment(&self, seq: u64) -> Segment {
        let place = i32::try_from(seq % 37).unwrap();
        let step = u32::try_from(seq).unwrap();
        let theta = 0.2 + f64::from(self.number) / 70.0 + f64::from(step % 101) / 3_000.0;
        let information = 1.0e4 + f64::from(step % 7) / 3.0;
        let pair = |value: f64| Information {
            information,
            weighted: information * value,
        };
        let at = self.begin + SignedDuration::from_secs(i64::from(step % 9_000));
        Segment {
            configuration: configuration(),
            mission: None,
            started_at: at - SignedDuration::from_millis(1_300),
            ended_at: at,
            grid_revision: 1,
            cell: Cell {
                ix: place % 8,
                iy: place / 8,
            },
            terrain: None,
            theta: pair(theta),
            theta_errors: (step % 3 == 0).then_some(ThetaErrors {
                independent_information: information / 1.1,
                robot_ratio: 0.12,
                tyre_ratio: 0.1,
            }),
            effective_track_ratio: (step % 5 == 0).then(|| pair(1.1 + theta / 9.0)),
            rolling_resistance: (step % 4 == 0).then(|| pair(0.03 + theta / 90.0)),
            mu_peak_lower_bound: (step % 2 == 0).then(|| 0.3 + theta / 7.0),
            samples: 160,
            distance_m: 1.0,
            saturation_ratio: 0.0,
        }
    }

    /// Uploads what has no receipt yet, until all has one or the server is gone.
    async fn go_on(mut self, endpoint: String, receipts: tokio::sync::mpsc::Sender<()>) -> Self {
        let site = SITE.parse().unwrap();
        let robot = LightRobot::start(&endpoint, &site, self.id.clone()).await;
        let robot = robot.unwrap();
        while let Ok(batch) = u64::try_from(self.received)
            && batch < BATCHES
        {
            let Ok((receipt, _)) = robot.upload(&self.batch(batch, RECORDS_PER_BATCH)).await else {
                break;
            };
            assert_eq!(receipt.refused, []);
            self.received += 1;
            // Fails when nobody counts any more.
            let _ = receipts.send(()).await;
        }
        self
    }
}

fn configuration() -> ConfigurationId {
    paper_robot().configuration()
}

/// Lets all robots upload until `enough` returns or all have ended, kills the server, and returns what
/// each has done.
async fn until_killed(
    fleet: &mut Fleet,
    works: Vec<Work>,
    enough: impl AsyncFnOnce(&Path, &mut tokio::sync::mpsc::Receiver<()>),
) -> Vec<Work> {
    let (receipts, mut received) = tokio::sync::mpsc::channel(10_000);
    let mut working = JoinSet::new();
    for work in works {
        working.spawn(work.go_on(fleet.zenoh_endpoint(), receipts.clone()));
    }
    drop(receipts);
    enough(&fleet.database_file(), &mut received).await;
    fleet.kill_server();
    drop(received);
    let mut works = working.join_all().await;
    works.sort_by_key(|work| work.number);
    works
}

async fn receive(received: &mut tokio::sync::mpsc::Receiver<()>, count: usize) {
    for _ in 0..count {
        let waiting = tokio::time::timeout(SHORT, received.recv());
        assert_eq!(waiting.await, Ok(Some(())), "robots upload");
    }
}

/// The number of robots with sums that are stored.
async fn watermarks(database: &Path) -> i64 {
    let options = SqliteConnectOptions::new().filename(database);
    let mut connection = options.read_only(true).connect().await.unwrap();
    let row = sqlx::query("SELECT count(*) FROM watermarks WHERE segment_pk > 0");
    row.fetch_one(&mut connection).await.unwrap().get(0)
}

/// All columns of the sums but keys, which are a matter of each database; the robot is named.
async fn sums(database: &Path) -> Vec<String> {
    let options = SqliteConnectOptions::new().filename(database);
    let mut connection = options.read_only(true).connect().await.unwrap();
    let columns = sqlx::query("SELECT name FROM pragma_table_info('cell_sums') ORDER BY cid");
    let columns = columns.fetch_all(&mut connection).await.unwrap();
    let names = columns.iter().map(|row| row.get::<String, _>(0));
    let quoted: Vec<String> = names
        .filter(|name| !name.ends_with("_pk"))
        .map(|name| format!("quote(cell_sums.{name})"))
        .collect();
    let select = format!(
        "SELECT robots.id || ',' || {} FROM cell_sums \
         JOIN robots ON robots.pk = cell_sums.robot_pk",
        quoted.join(" || ',' || ")
    );
    let rows = sqlx::query(sqlx::AssertSqlSafe(select)).fetch_all(&mut connection);
    let mut sums: Vec<String> = rows.await.unwrap().iter().map(|row| row.get(0)).collect();
    sums.sort();
    sums
}

/// The map of all cells some time after the last measurement, with every digit.
async fn map(fleet: &Fleet, begin: Timestamp) -> Vec<Value> {
    let as_of = begin + SignedDuration::from_hours(12);
    let path = format!("/v1/sites/{SITE}/friction/cells?as_of={as_of}");
    fleet.rest.all(&path).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_killed_between_receipts_and_sums_says_the_same_to_the_bit() {
    let hour = now().as_second() / 3_600 - 30;
    let begin = Timestamp::from_second(hour * 3_600).unwrap();
    let mut fleet = fleet().await;

    // Before all sums are stored.
    let works = Work::all(begin);
    let works = until_killed(&mut fleet, works, async |_database, received| {
        receive(received, RECEIPTS).await;
    })
    .await;
    let left = stored::count(fleet.database()).await.unwrap();
    assert!(left.in_sums < left.segments, "{left:?}");

    // After some were stored, and before all were.
    fleet.start_server().await;
    let works = until_killed(&mut fleet, works, async |database, received| {
        let look = || watermarks(database);
        let all = i64::try_from(ROBOTS).unwrap();
        eventually("sums are stored", DRIVE, look, |found| *found == all).await;
        while received.try_recv().is_ok() {}
        receive(received, RECEIPTS).await;
    })
    .await;
    let left = stored::count(fleet.database()).await.unwrap();
    assert!(left.in_sums > 0 && left.in_sums < left.segments, "{left:?}");

    // At once after the start, before it has stored what followed the watermarks.
    fleet.start_server().await;
    let before = map(&fleet, begin).await;
    fleet.kill_server();
    fleet.start_server().await;
    assert_eq!(map(&fleet, begin).await, before);

    let works = until_killed(
        &mut fleet,
        works,
        async |_database, received| {
            while received.recv().await.is_some() {}
        },
    )
    .await;
    for work in &works {
        assert_eq!(u64::try_from(work.received), Ok(BATCHES), "{}", work.id);
    }
    fleet.start_server().await;
    let of_killed = map(&fleet, begin).await;
    fleet.stop_server().await.unwrap();
    let left = stored::count(fleet.database()).await.unwrap();
    let all = i64::try_from(BATCHES * RECORDS_PER_BATCH).unwrap() * i64::try_from(ROBOTS).unwrap();
    assert_eq!(
        (left.segments, left.doubles),
        (all, 0),
        "a stop stores sums"
    );
    assert_eq!(left.in_sums, all, "a stop stores sums");

    let other = self::fleet().await;
    for work in Work::all(begin) {
        let site = other.site();
        let robot = LightRobot::start(&other.zenoh_endpoint(), &site, work.id.clone()).await;
        let robot = robot.unwrap();
        let records = 10 * RECORDS_PER_BATCH;
        for batch in 0..BATCHES / 10 {
            let (receipt, _) = robot.upload(&work.batch(batch, records)).await.unwrap();
            assert_eq!(receipt.committed, records);
        }
    }
    assert_eq!(map(&other, begin).await, of_killed, "to the bit");
    assert_eq!(of_killed.len(), 37);
    await_sums(other.database()).await.unwrap();
    let expected = sums(&other.database_file()).await;
    assert_eq!(sums(&fleet.database_file()).await, expected, "to the bit");
}
