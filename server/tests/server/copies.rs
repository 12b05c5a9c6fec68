//! `tread-server copy`: everything that a database holds is in the copy, of either engine, and a server
//! goes on with it.

use std::path::Path;

use tread_api::friction::StoredSegment;
use tread_api::mission::MissionState;
use tread_api::page::Page;
use tread_server::db::Location;

use crate::backups::{run, words};
use crate::harness::{Yard, eventually, measured, segment};
use crate::postgres::{address_of, created, server_of_tests};
use crate::releases::present_database;
use crate::robot::Robot;

/// Runs `tread-server copy` to its end, and returns whether it succeeded and what it printed.
async fn copy(from: &str, to: &str) -> (bool, String) {
    let (from, to) = (from.to_owned(), to.to_owned());
    let running = tokio::task::spawn_blocking(move || run(&["copy", "--quiet", &from, &to]));
    let ended = running.await.unwrap();
    (ended.status.success(), words(&ended))
}

/// Returns the lines with the tables: names, numbers and checksums of rows.
fn tables(printed: &str) -> Vec<&str> {
    let lines = printed.lines().skip(1);
    let is_table = |line: &&str| line.split_whitespace().count() == 3;
    lines.take_while(is_table).collect()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_copy_of_a_file_has_the_same_rows_and_replaces_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (from, to) = (
        folder.path().join("tread.db"),
        folder.path().join("copy.db"),
    );
    present_database(&from);
    let (is_copied, printed) = copy(text(&from), text(&to)).await;
    assert!(is_copied, "{printed}");
    assert!(tables(&printed).len() > 20, "{printed}");
    assert!(printed.contains("were read back"), "{printed}");
    let (is_copied, again) = copy(text(&to), text(&folder.path().join("third.db"))).await;
    assert!(is_copied, "{again}");
    assert_eq!(tables(&printed), tables(&again));
    let (is_copied, refused) = copy(text(&from), text(&to)).await;
    assert!(
        !is_copied && refused.contains("exists already"),
        "{refused}"
    );
    let nowhere = folder.path().join("nowhere/tread.db");
    let (is_copied, refused) = copy(text(&from), text(&nowhere)).await;
    assert!(
        !is_copied && refused.contains("create its folder first"),
        "{refused}"
    );
    let missing = folder.path().join("missing.db");
    let (is_copied, refused) = copy(text(&missing), text(&folder.path().join("x.db"))).await;
    assert!(
        !is_copied && refused.contains("there is no database"),
        "{refused}"
    );
    // SQLite would take a log that is left over for that of the copy.
    std::fs::write(folder.path().join("moved.db-wal"), "log").unwrap();
    let (is_copied, refused) = copy(text(&from), text(&folder.path().join("moved.db"))).await;
    assert!(
        !is_copied && refused.contains("exists already"),
        "{refused}"
    );
    let begun = folder.path().join("fourth.db.copying");
    std::fs::copy(&to, &begun).unwrap();
    let (is_copied, refused) = copy(text(&begun), text(&folder.path().join("fourth.db"))).await;
    assert!(!is_copied && refused.contains("another name"), "{refused}");
    std::fs::remove_file(&begun).unwrap();
    std::fs::remove_file(folder.path().join("fourth.db.copying.lock")).ok();
    let empty = folder.path().join("empty.db");
    std::fs::write(&empty, "").unwrap();
    let (is_copied, refused) = copy(text(&empty), text(&folder.path().join("x.db"))).await;
    assert!(
        !is_copied && refused.contains("is no database of a server"),
        "{refused}"
    );
    let names = folder.path().read_dir().unwrap();
    let names: Vec<String> = names
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.contains("copying") || name.contains("missing"))
        .collect();
    assert!(names.is_empty(), "{names:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_that_a_server_uses_or_that_is_older_is_not_copied() {
    let yard = Yard::start_configured(|config, folder| {
        config.database = Location::from(folder.join("tread.db"));
    })
    .await;
    let (from, to) = (
        yard.folder.path().join("tread.db"),
        yard.folder.path().join("copy.db"),
    );
    let (is_copied, refused) = copy(text(&from), text(&to)).await;
    assert!(
        !is_copied && refused.contains("stop its server first"),
        "{refused}"
    );
    assert!(!to.exists());
    let folder = tempfile::tempdir().unwrap();
    let old = folder.path().join("old.db");
    crate::releases::earlier_database(&old);
    let (is_copied, refused) = copy(text(&old), text(&to)).await;
    assert!(
        !is_copied && refused.contains("tread-server migrate"),
        "{refused}"
    );
    assert!(!to.exists());
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_rows_of_a_release_are_the_same_in_postgresql_and_back_in_a_file() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (from, back) = (
        folder.path().join("tread.db"),
        folder.path().join("back.db"),
    );
    present_database(&from);
    let there = address_of(&created(&admin, folder.path()));
    let (is_copied, first) = copy(text(&from), &there).await;
    assert!(is_copied, "{first}");
    let (is_copied, second) = copy(&there, text(&back)).await;
    assert!(is_copied, "{second}");
    assert_eq!(tables(&first), tables(&second));
    let (is_copied, refused) = copy(text(&from), &there).await;
    assert!(
        !is_copied && refused.contains("the target is not empty"),
        "{refused}"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_goes_on_in_postgresql_where_it_ended_in_a_file() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("tread.db");
    let used = Location::from(&file);
    let yard = Yard::start_configured(|config, _| config.database = used).await;
    let robot = Robot::join(&yard, "rover-1").await;
    let records = |from: u64| -> Vec<_> {
        let seqs = from..from + 50;
        seqs.map(|seq| measured(seq, segment((1, i32::try_from(seq).unwrap()), 0.2, 10)))
            .collect()
    };
    robot.upload(records(1)).await.unwrap();
    let mission = yard.create_mission(&robot.id).await;
    let cells = yard
        .get_value("/v1/sites/yard/friction/cells?limit=1000")
        .await;
    drop(robot);
    yard.server.stop().await.unwrap();

    let location = created(&admin, folder.path());
    let (is_copied, printed) = copy(text(&file), &address_of(&location)).await;
    assert!(is_copied, "{printed}");
    let yard = Yard::start_configured(|config, _| config.database = location).await;
    let copied = yard
        .get_value("/v1/sites/yard/friction/cells?limit=1000")
        .await;
    // Ages, and what follows from them, may differ by a minute.
    let lasting_of = |cells: &serde_json::Value| -> Vec<_> {
        let items = cells["items"].as_array().unwrap().iter();
        let lasting = |cell: &serde_json::Value| {
            let friction = &cell["friction"];
            let parts = ["theta", "stiffness", "segments", "newest_at"];
            (
                cell["cell"].clone(),
                parts.map(|part| friction[part].clone()),
            )
        };
        items.map(lasting).collect()
    };
    assert_eq!(lasting_of(&cells.1), lasting_of(&copied.1));
    assert!(
        !copied.1["items"].as_array().unwrap().is_empty(),
        "{copied:?}"
    );
    let robot = Robot::join(&yard, "rover-1").await;
    let copied = yard.mission(mission.id).await.mission;
    assert_eq!(copied.trajectory, mission.trajectory);
    // Keys go on after those of the file.
    robot.upload(records(101)).await.unwrap();
    let other = Robot::join(&yard, "rover-2").await;
    let queued = yard.create_mission(&other.id).await;
    yard.mission_becomes(queued.id, MissionState::Active).await;
    eventually("all measurements are listed", async || {
        let stored: Page<StoredSegment> = yard.get("/v1/sites/yard/segments?limit=1000").await;
        (stored.items.len() == 100)
            .then_some(())
            .ok_or(stored.items.len())
    })
    .await;
    drop((robot, other));
    yard.server.stop().await.unwrap();
}
