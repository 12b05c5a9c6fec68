//! An older backup is restored while real robots went on: nothing is driven twice, and nothing that
//! they still have is lost or counted twice.

use std::process::Command;

use serde_json::{Value, json};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions as _, Row as _};
use tread_agent::missions::memory::Memory;
use tread_api::friction::StoredSegment;
use tread_api::ids::{MissionId, RobotId};
use tread_api::keys;
use tread_api::mission::MissionState;
use tread_api::wire::ingest::{Batch, Receipt, Record, RecordContent};
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::light_robot::{LightRobot, ask};
use tread_tests::stored::await_sums;
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::{arc, fleet, slalom};

/// Columns of the sums that say what was measured; keys of rows are a matter of each database.
const SUMS: &str = "ix, iy, grid_revision, terrain, terrain_revision, epoch_h, information_hi, \
    information_lo, weighted_hi, weighted_lo, square_hi, square_lo, track_information_hi, \
    track_information_lo, track_weighted_hi, track_weighted_lo, rolling_information_hi, \
    rolling_information_lo, rolling_weighted_hi, rolling_weighted_lo, robot_error_hi, \
    robot_error_lo, tyre_error_hi, tyre_error_lo, segments, samples, mu_peak, newest_at_us, \
    newest_information, newest_weighted, newest_mu, pass_at_us";

async fn server_command(arguments: Vec<String>) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_node"));
    command.arg("server").args(arguments);
    let ended = tokio::task::spawn_blocking(move || command.output()).await;
    let ended = ended.unwrap().unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.success(), "{said}");
}

/// The sums of a database, each as one text, sorted, once all segments are in them.
async fn sums(fleet: &Fleet) -> Vec<String> {
    await_sums(fleet.database()).await.unwrap();
    let options = SqliteConnectOptions::new().filename(fleet.database_file());
    let mut connection = options.read_only(true).connect().await.unwrap();
    let columns: Vec<&str> = SUMS.split(", ").map(str::trim).collect();
    let quoted: Vec<String> = columns
        .iter()
        .map(|name| format!("quote({name})"))
        .collect();
    let select = format!("SELECT {} FROM cell_sums", quoted.join(" || ',' || "));
    let rows = sqlx::query(sqlx::AssertSqlSafe(select)).fetch_all(&mut connection);
    let rows = rows.await.unwrap();
    let mut sums: Vec<String> = rows.iter().map(|row| row.get(0)).collect();
    sums.sort();
    sums
}

async fn segments(fleet: &Fleet) -> Vec<StoredSegment> {
    fleet.rest.all(&format!("/v1/sites/{SITE}/segments")).await
}

/// The sums of a new server that gets each segment once.
async fn sums_of(stored: &[StoredSegment]) -> Vec<String> {
    let fleet = fleet().await;
    let site = fleet.site();
    let id: RobotId = "rover-1".parse().unwrap();
    let robot = LightRobot::start(&fleet.zenoh_endpoint(), &site, id.clone())
        .await
        .unwrap();
    for one in stored {
        let batch = Batch {
            robot: id.clone(),
            boot: one.boot,
            robot_time: None,
            records: vec![Record {
                seq: one.seq,
                content: RecordContent::Segment(one.segment.clone()),
            }],
        };
        let receipt: Receipt = ask(&robot.session, &keys::ingest(&site, &id), &batch)
            .await
            .unwrap();
        assert_eq!(receipt.committed, 1, "{receipt:?}");
    }
    sums(&fleet).await
}

async fn nothing_is_pending(fleet: &Fleet, robot: &RobotId) {
    let look = || fleet.rest.robot(robot);
    eventually("all is uploaded", SHORT, look, |seen| {
        let live = seen.as_ref().and_then(|seen| seen.live.as_ref());
        live.is_some_and(|live| live.outbox.pending == 0)
    })
    .await;
}

/// Size of what a robot keeps for the server.
fn outbox_bytes(fleet: &Fleet, robot: &RobotId) -> u64 {
    let files = std::fs::read_dir(fleet.robot_folder(robot).join("outbox")).unwrap();
    files
        .map(|file| file.unwrap().metadata().map_or(0, |about| about.len()))
        .sum()
}

fn times_ended(fleet: &Fleet, robot: &RobotId, mission: MissionId) -> usize {
    let slot = Memory::new(&fleet.robot_folder(robot)).load().unwrap();
    slot.ended()
        .filter(|ended| ended.mission == mission)
        .count()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_and_a_restored_server_agree_again_and_nothing_is_done_twice() {
    let mut fleet = fleet().await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.start_agent(&robot, 0.0).await;
    // A circle alone may end without a measurement.
    let active = fleet.rest.send(&robot, slalom(0.0, 6)).await;
    let queued = fleet.rest.send(&robot, arc(0.0, 1.0)).await;
    fleet
        .rest
        .mission_reaches(active, &[MissionState::Active], SHORT)
        .await;
    let look = || segments(&fleet);
    eventually("it measures", DRIVE, look, |found| found.len() > 2).await;
    let target = fleet.file("backup.tar").display().to_string();
    let database = format!("--database={}", fleet.database_file().display());
    server_command(vec![
        "backup".to_owned(),
        database.clone(),
        format!("--to={target}"),
    ])
    .await;

    // The fleet goes on: both missions end, and a third one is half driven when the server dies.
    let succeeded = [MissionState::Succeeded];
    fleet.rest.mission_reaches(active, &succeeded, DRIVE).await;
    fleet.rest.mission_reaches(queued, &succeeded, DRIVE).await;
    let later = fleet.rest.send(&robot, slalom(0.0, 12)).await;
    fleet
        .rest
        .mission_reaches(later, &[MissionState::Active], SHORT)
        .await;
    fleet.kill_server();
    let kept = outbox_bytes(&fleet, &robot);
    let look = || async { outbox_bytes(&fleet, &robot) };
    eventually("the robot keeps what it measures", DRIVE, look, |now| {
        *now > kept + 2_000
    })
    .await;
    let restore = [
        "restore".to_owned(),
        database,
        format!("--from={target}"),
        "--force".to_owned(),
    ];
    server_command(restore.to_vec()).await;
    fleet.start_server().await;

    for mission in [active, queued] {
        let detail = fleet.rest.mission_reaches(mission, &succeeded, SHORT).await;
        assert_eq!(times_ended(&fleet, &robot, mission), 1, "{detail:#?}");
    }
    // Nobody here knows the third one, so the robot is commanded to end it.
    let look = || fleet.rest.robot(&robot);
    eventually("the robot ends what nobody knows", SHORT, look, |seen| {
        let live = seen.as_ref().and_then(|seen| seen.live.as_ref());
        live.is_some_and(|live| live.mission.is_none())
    })
    .await;
    nothing_is_pending(&fleet, &robot).await;
    assert_eq!(
        fleet.counter("offers_sent").await,
        0,
        "nothing was dispatched"
    );
    let status: Value = fleet.rest.get("/v1/server").await;
    assert_eq!(
        status["restoration"]["robots_awaiting_release"], 1,
        "{status}"
    );

    let stored = segments(&fleet).await;
    let mut names: Vec<_> = stored.iter().map(|one| (one.boot, one.seq)).collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len(), stored.len(), "each of them once");
    assert_eq!(sums(&fleet).await, sums_of(&stored).await, "to the bit");

    // An operator releases the robot, and it drives again.
    let path = format!("/v1/sites/{SITE}/robots/{robot}/release");
    fleet.rest.post(&path, &json!({})).await;
    let next = fleet.rest.send(&robot, arc(0.0, 0.3)).await;
    fleet.rest.mission_reaches(next, &succeeded, DRIVE).await;
    for mission in [active, queued] {
        assert_eq!(times_ended(&fleet, &robot, mission), 1);
    }
}
