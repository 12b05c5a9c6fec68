//! What comes onto the map, what does not, and what is taken off it again.

use std::time::Duration;

use jiff::SignedDuration;
use reqwest::StatusCode;
use serde_json::{Value, json};
use tokio::sync::oneshot;
use tread_api::friction::{CellFriction, Information, Segment, Withdrawal};
use tread_api::page::{MapPage, Page};
use tread_api::robot::Robot as ShownRobot;
use tread_api::wire::ingest::{Batch, Receipt, Record};
use tread_server::app::App;
use tread_server::app::friction::{Area, CellRequest, ReadingParameters};
use tread_server::app::ingest::Upload;
use tread_server::config::{FrictionConfig, StorageConfig};
use tread_server::friction::epoch_h;

use crate::harness::{Yard, measured, segment, site, time};
use crate::ingest::{Writer, boot};
use crate::robot::Robot;

const CELLS: &str = "/v1/sites/yard/friction/cells";

/// The robot's own clock says `robot_time`; hours of the harness's segments count from here.
async fn upload_at(writer: &Writer, robot_time: Option<&str>, records: Vec<Record>) -> Receipt {
    let (answer, answered) = oneshot::channel();
    let batch = Batch {
        robot: "rover-1".parse().unwrap(),
        boot: boot(1),
        robot_time: robot_time.map(time),
        records,
    };
    let site = site();
    let upload = Upload {
        site,
        batch,
        answer,
    };
    writer.uploads.send(upload).await.unwrap();
    answered.await.unwrap().unwrap()
}

async fn deferred(writer: &Writer) -> u64 {
    let everywhere = tread_api::rights::Scope::EVERYWHERE;
    let place = (&site(), &everywhere);
    let page = writer.app.robots(place, None, false, 10).await.unwrap();
    page.items[0].measurements.deferred
}

fn cells_of(rows: &[CellFriction]) -> Vec<i32> {
    rows.iter().map(|row| row.cell.ix).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_segment_from_the_future_waits_until_the_clock_of_its_run_is_known() {
    let writer = Writer::start().await;
    let now = time("2026-11-01T00:00:00Z");
    let five_days = SignedDuration::from_hours(5 * 24);
    let ahead = |seq: u64, age_s: i64| {
        let mut ahead = segment((i32::try_from(seq).unwrap(), 0), 0.2, 0);
        ahead.ended_at = now + five_days - SignedDuration::from_secs(age_s);
        ahead.started_at = ahead.ended_at - SignedDuration::from_secs(10);
        measured(seq, ahead)
    };
    let receipt = upload_at(&writer, None, vec![ahead(0, 60), ahead(1, 60)]).await;
    assert_eq!((receipt.committed, receipt.duplicates), (2, 0), "kept");
    let receipt = upload_at(&writer, None, vec![ahead(0, 60)]).await;
    assert_eq!((receipt.committed, receipt.duplicates), (0, 1), "once");
    assert_eq!(writer.sums().await, [], "and not on the map");
    // An upload of a later run's clock says nothing about this one's.
    let receipt = upload_at(&writer, Some("2026-11-01T00:00:00Z"), vec![ahead(2, 60)]).await;
    assert_eq!(receipt.committed, 1);
    assert_eq!(writer.sums().await, []);
    assert_eq!(deferred(&writer).await, 3);

    let receipt = upload_at(&writer, Some("2026-11-06T00:00:00Z"), vec![ahead(3, 60)]).await;
    assert_eq!((receipt.committed, receipt.duplicates), (1, 0));
    let sums = writer.sums().await;
    assert_eq!(sums.len(), 4);
    let at = now - SignedDuration::from_secs(60);
    assert!(
        sums.iter().all(|row| row.sums.newest_at() == at),
        "{sums:?}"
    );
    let receipt = upload_at(&writer, None, vec![ahead(1, 60)]).await;
    assert_eq!((receipt.committed, receipt.duplicates), (0, 1), "known");
    assert_eq!(deferred(&writer).await, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_impossible_is_refused_counted_and_shown_and_its_neighbours_are_kept() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let with = |change: fn(&mut Segment)| {
        let mut segment = segment((0, 0), 0.2, 0);
        change(&mut segment);
        segment
    };
    let bad = [
        with(|segment| segment.theta.weighted = 0.0),
        with(|segment| segment.theta.weighted = -2.0),
        with(|segment| segment.theta.information = -1.0),
        with(|segment| segment.theta.weighted = 51.0 * segment.theta.information),
        with(|segment| segment.cell.ix = 1_000_001),
        with(|segment| segment.grid_revision = 2),
        with(|segment| segment.started_at += SignedDuration::from_secs(1)),
    ];
    let mut records = vec![measured(0, segment((7, 0), 0.2, 0))];
    records.extend((1..).zip(bad.clone()).map(|(seq, bad)| measured(seq, bad)));
    records.push(measured(100, segment((8, 0), 0.2, 0)));
    let receipt = robot.upload(records).await.unwrap();
    assert_eq!(receipt.committed, 2, "{receipt:?}");
    assert_eq!(receipt.refused.len(), bad.len(), "{receipt:?}");
    assert!(
        receipt.refused[4].reason.contains("outside the site"),
        "{receipt:?}"
    );
    let cells: Page<CellFriction> = yard.get(CELLS).await;
    assert_eq!(cells_of(&cells.items), [7, 8]);
    let shown: ShownRobot = yard.get("/v1/sites/yard/robots/rover-1").await;
    assert_eq!(shown.measurements.refused, 7);
    assert!(
        shown
            .measurements
            .refusal_reason
            .unwrap()
            .contains("ended_at")
    );
    assert_eq!(yard.counters().await.records_refused, 7);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restart_reads_the_same_map() {
    let yard =
        Yard::start_at(segment((0, 0), 0.2, 0).ended_at + SignedDuration::from_hours(12)).await;
    for name in ["rover-2", "rover-1"] {
        let robot = Robot::join(&yard, name).await;
        let drive = (0..40).map(|seq| {
            let place = i32::try_from(seq % 7).unwrap();
            let second = i64::try_from(seq).unwrap() * 977;
            measured(
                seq,
                segment((place, -place), 0.2 + 0.001 * f64::from(place), second),
            )
        });
        robot.upload(drive.collect()).await.unwrap();
    }
    let before = said(yard.server.app()).await;
    assert_eq!(before.items.len(), 7);
    assert_eq!(said(&restarted(yard.server.app()).await).await, before);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_pass_that_is_kept_by_itself_is_the_same_in_memory_and_on_the_disk() {
    let begin = segment((0, 0), 0.2, 0).ended_at;
    let yard = Yard::start_at(begin + SignedDuration::from_hours(12)).await;
    let robot = Robot::join(&yard, "rover-1").await;
    // Each pass comes by itself, so that the database adds them up; cells have them in two orders.
    let pass = |seq: u64, ix: i32, theta: f64, std_dev_ratio: f64, second: i64| {
        let mut pass = segment((ix, 0), theta, second);
        let information = (std_dev_ratio * theta).powi(-2);
        pass.theta = Information {
            information,
            weighted: information * theta,
        };
        measured(seq, pass)
    };
    let old = |seq, ix| pass(seq, ix, 0.2, 0.05, 0);
    let ice = |seq, ix| pass(seq, ix, 1.4, 0.05, 60);
    let vague = |seq, ix| pass(seq, ix, 0.7, 0.3, 120);
    let passes = [old(0, 0), ice(1, 0), vague(2, 0)];
    let reversed = [vague(3, 1), ice(4, 1), old(5, 1)];
    for one in passes.into_iter().chain(reversed) {
        let receipt = robot.upload(vec![one]).await.unwrap();
        assert_eq!(receipt.committed, 1, "{receipt:?}");
    }
    let before = said(yard.server.app()).await;
    let [first, second] = before.items.as_slice() else {
        panic!("two cells: {before:?}");
    };
    assert!((first.friction.theta - 1.4).abs() < 0.1, "{first:?}");
    assert_eq!(first.friction, second.friction);
    assert_eq!(said(&restarted(yard.server.app()).await).await, before);
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_is_withdrawn_leaves_the_map_as_if_it_had_never_come() {
    let yard =
        Yard::start_at(segment((0, 0), 0.2, 0).ended_at + SignedDuration::from_hours(12)).await;
    let good = Robot::join(&yard, "rover-1").await;
    let bad = Robot::join(&yard, "rover-2").await;
    let drive = |theta: f64| {
        (0..6).map(move |seq| {
            let hour = i64::try_from(seq).unwrap() * 3_600;
            measured(
                seq,
                segment((i32::try_from(seq % 3).unwrap(), 0), theta, hour),
            )
        })
    };
    let as_of = CELLS.to_owned();
    good.upload(drive(0.2).collect()).await.unwrap();
    let without: Value = yard.get(&as_of).await;
    bad.upload(drive(0.9).take(4).collect()).await.unwrap();
    assert_ne!(yard.get::<Value>(&as_of).await, without);

    let path = "/v1/sites/yard/robots/rover-2/withdrawals";
    let begin = segment((0, 0), 0.2, 0).ended_at;
    let second = json!({"to": begin + SignedDuration::from_hours(1), "reason": "worn tyres"});
    let (status, body) = yard.post(path, &second).await;
    assert_eq!(status, StatusCode::CREATED, "{body}");
    let partly: Value = yard.get(&as_of).await;
    assert_ne!(partly, without, "two of its hours are left");
    let (status, body) = yard.post(path, &json!({"reason": "worn tyres"})).await;
    assert_eq!(status, StatusCode::CREATED, "{body}");
    assert_eq!(yard.get::<Value>(&as_of).await, without);

    // What it still had to say of those hours comes too late.
    let receipt = bad.upload(drive(0.9).collect()).await.unwrap();
    assert_eq!((receipt.committed, receipt.duplicates), (2, 4));
    assert_eq!(yard.get::<Value>(&as_of).await, without);
    let again = said(&restarted(yard.server.app()).await).await;
    assert_eq!(
        serde_json::to_value(again).unwrap(),
        without,
        "after a restart"
    );
    let listed: Page<Withdrawal> = yard.get("/v1/sites/yard/withdrawals").await;
    assert_eq!(listed.items.len(), 2);
    assert_eq!(listed.items[0].by, "tests");

    for (body, field) in [
        (json!({"reason": " "}), "reason"),
        (
            json!({"from": "2026-11-02T00:00:00Z", "to": "2026-11-01T00:00:00Z", "reason": "x"}),
            "to",
        ),
    ] {
        let (status, said) = yard.post(path, &body).await;
        assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{said}");
        assert_eq!(said["field"], field, "{said}");
    }
    yard.server.stop().await.unwrap();
}

/// What a server has in memory that starts now on the same database.
pub(crate) async fn restarted(app: &App) -> App {
    let config = FrictionConfig::default();
    let restarted = App::without_robots(
        app.db().clone(),
        app.clock().clone(),
        config,
        StorageConfig::default(),
    );
    restarted.load_map().await.unwrap();
    restarted
}

/// What the map says of all cells.
pub(crate) async fn said(app: &App) -> MapPage<CellFriction> {
    let cells = CellRequest {
        area: Area::WHOLE,
        resolution_m: None,
        cursor: None,
        limit: 1_000,
    };
    let parameters = ReadingParameters::default();
    app.friction_of_cells(&site(), &parameters, cells)
        .await
        .unwrap()
}

/// Merges all that the horizons have passed, with a kill after each transaction; the map must stay
/// the same. Returns the number of transactions.
async fn merged_with_kills(app: &App) -> u32 {
    app.move_horizons().await.unwrap();
    let expected = said(app).await;
    let mut rounds = 0;
    loop {
        // What a server would say that was killed here and started again.
        let restarted = App::without_robots(
            app.db().clone(),
            app.clock().clone(),
            FrictionConfig::default(),
            StorageConfig::default(),
        );
        restarted.load_map().await.unwrap();
        assert_eq!(said(&restarted).await, expected, "after {rounds} rounds");
        if !app.merge_some(1).await.unwrap() {
            break;
        }
        rounds += 1;
    }
    assert_eq!(said(app).await, expected);
    rounds
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn hours_become_days_and_then_months_and_a_kill_on_the_way_changes_nothing_that_is_said() {
    let writer = Writer::start().await;
    let app = &writer.app;
    // Thirty hours over two days, all before the clock's 1 November.
    let drive = (0..30).map(|seq| {
        let place = i32::try_from(seq % 3).unwrap();
        let hour = i64::try_from(seq).unwrap();
        measured(
            seq,
            segment((place, 0), 0.2 + 0.001 * f64::from(place), hour * 3_600),
        )
    });
    upload_at(&writer, None, drive.collect()).await;
    assert_eq!(writer.sums().await.len(), 30);
    // Three cells on three days, two of them in October; then in one month.
    for (days, rows) in [(10, 6..=9), (130, 3..=3)] {
        app.clock().advance(Duration::from_hours(days * 24));
        let rounds = merged_with_kills(app).await;
        assert!(rounds > 1, "{rounds} rounds");
        let merged = writer.sums().await;
        assert!(
            rows.contains(&merged.len()),
            "after {days} days: {}",
            merged.len()
        );
        assert!(merged.iter().all(|row| row.key.epoch_h % 24 == 0));
        let segments: u64 = merged.iter().map(|row| row.sums.segments).sum();
        assert_eq!(segments, 30, "nothing lost, nothing twice");
    }
    assert_eq!(
        merged_with_kills(app).await,
        0,
        "there is nothing left to merge"
    );
    let october = "2026-10-01T00:00:00Z".parse().unwrap();
    assert!(
        writer
            .sums()
            .await
            .iter()
            .all(|row| row.key.epoch_h == epoch_h(october))
    );

    // What comes late falls into its month.
    upload_at(
        &writer,
        None,
        vec![measured(30, segment((0, 0), 0.2, 1_800))],
    )
    .await;
    let restarted = restarted(app).await;
    assert_eq!(said(&restarted).await, said(app).await);
}
