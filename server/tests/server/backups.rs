//! Backups: on demand beside a running server, and those that it makes by itself.

use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

use serde_json::Value;
use tread_server::backup::archive::verify;
use tread_server::backup::{Filter, folder};
use tread_server::config::backup::BackupConfig;

use crate::harness::{Yard, database, eventually, measured, segment, time};
use crate::robot::Robot;

/// Runs the program to its end.
pub(crate) fn run(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tread-server"));
    command.args(arguments).env_remove("RUST_LOG");
    command.stdin(Stdio::null()).output().unwrap()
}

pub(crate) fn words(output: &Output) -> String {
    let (out, error) = (&output.stdout, &output.stderr);
    format!(
        "{}{}",
        String::from_utf8_lossy(out),
        String::from_utf8_lossy(error)
    )
}

/// Backs a database up into a file of its folder.
pub(crate) fn back_up(folder: &Path, name: &str) -> PathBuf {
    let target = folder.join(name);
    let output = run(&[
        "backup",
        "--database",
        database(folder).to_str().unwrap(),
        "--to",
        target.to_str().unwrap(),
    ]);
    assert!(output.status.success(), "{}", words(&output));
    target
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_beside_a_server_that_writes_is_complete_and_its_owners_alone() {
    let yard = Yard::start().await;
    let robot = Robot::join(&yard, "rover-1").await;
    let mission = yard.create_mission(&robot.id).await;
    let records: Vec<_> = (0..500)
        .map(|seq| measured(seq, segment((1, 1), 0.2, 10)))
        .collect();
    robot.upload(records).await.unwrap();
    let folder = yard.folder.path().to_owned();
    let backing_up = tokio::task::spawn_blocking(move || back_up(&folder, "backup.tar"));
    // The server goes on meanwhile.
    let mut seq = 1_000;
    while !backing_up.is_finished() {
        robot
            .upload(vec![measured(seq, segment((2, 2), 0.2, 10))])
            .await
            .unwrap();
        seq += 1;
    }
    let backup = backing_up.await.unwrap();
    let mode = std::fs::metadata(&backup).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    let manifest = verify(&backup, None).unwrap();
    assert_eq!(manifest.rows["missions"], 1, "{}", mission.id);
    assert!(manifest.rows["segments"] >= 500, "{:?}", manifest.rows);
    assert_eq!(manifest.version, env!("CARGO_PKG_VERSION"));
    assert!(manifest.authority.is_empty());
    let left: Vec<_> = std::fs::read_dir(yard.folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.contains("copy") || name.contains("partial"))
        .collect();
    assert!(left.is_empty(), "{left:?}");
    yard.server.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_has_the_authority_and_is_encrypted_by_what_the_configuration_names() {
    let yard = Yard::start_joining_at(time("2026-11-24T12:00:00Z")).await;
    let folder = yard.folder.path().to_owned();
    let config = folder.join("tread.toml");
    let text = format!(
        "database = {:?}\n[robots]\nauthority = {:?}\n[backup]\nfolder = {:?}\nencrypt = \"gzip -c\"\n",
        database(&folder),
        folder.join("authority"),
        folder.join("backups"),
    );
    std::fs::write(&config, text).unwrap();
    let output = tokio::task::spawn_blocking(move || {
        let target = folder.join("backup.tar.gz");
        let (config, target) = (config.to_str().unwrap(), target.to_str().unwrap());
        run(&["backup", "--config", config, "--to", target])
    });
    let output = output.await.unwrap();
    assert!(output.status.success(), "{}", words(&output));
    assert!(words(&output).contains("key of the fleet's authority"));
    let backup = yard.folder.path().join("backup.tar.gz");
    verify(&backup, None).unwrap_err();
    let command = Filter("gzip -dc".to_owned());
    let manifest = verify(&backup, Some(&command)).unwrap();
    let names: Vec<&str> = manifest.authority.iter().map(|file| &*file.name).collect();
    assert_eq!(names, ["authority/ca.key", "authority/ca.pem"]);
    yard.server.stop().await.unwrap();
}

#[test]
fn what_cannot_be_backed_up_is_refused_with_words() {
    let folder = tempfile::tempdir().unwrap();
    let missing = folder.path().join("missing.db");
    let target = folder.path().join("backup.tar");
    let (missing, target) = (missing.to_str().unwrap(), target.to_str().unwrap());
    let output = run(&["backup", "--database", missing, "--to", target]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        words(&output).contains("there is no database"),
        "{}",
        words(&output)
    );
    assert!(!Path::new(missing).exists(), "none was made");
    let nothing = folder.path().join("nothing.db");
    std::fs::write(
        &nothing,
        "no database at all, and longer than a header of one is".repeat(9),
    )
    .unwrap();
    let output = run(&[
        "backup",
        "--database",
        nothing.to_str().unwrap(),
        "--to",
        target,
    ]);
    assert_eq!(output.status.code(), Some(1));
    assert!(
        words(&output).contains("not a database"),
        "{}",
        words(&output)
    );
    let config = folder.path().join("tread.toml");
    std::fs::write(
        &config,
        "[backup]\nfolder = \"b\"\nrecipients = [\"age1me\"]\n",
    )
    .unwrap();
    let output = run(&[
        "backup",
        "--config",
        config.to_str().unwrap(),
        "--to",
        target,
    ]);
    assert!(words(&output).contains("age1me"), "{}", words(&output));
    std::fs::write(&config, "[backup]\nfolder = \"b\"\nkeep = 0\n").unwrap();
    let output = run(&[
        "backup",
        "--config",
        config.to_str().unwrap(),
        "--to",
        target,
    ]);
    assert!(words(&output).contains("backup.keep"), "{}", words(&output));
}

async fn alert(yard: &Yard, code: &str) -> Option<String> {
    let (_, alerts) = yard.get_value("/v1/alerts?raised=true").await;
    let items = alerts["items"].as_array().cloned().unwrap_or_default();
    let found = items.into_iter().find(|alert| alert["code"] == code);
    found.map(|alert| alert["text"].as_str().unwrap_or_default().to_owned())
}

async fn count_becomes(folder: &Path, count: usize, last: &str) {
    let what = format!("{count} backups, the last of {last}");
    eventually(&what, async || {
        let found = folder::list(folder).unwrap_or_default();
        let newest = found.last().map(|newest| newest.taken_at);
        if found.len() == count && newest == Some(time(last)) {
            Ok(())
        } else {
            Err(found)
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_makes_backups_by_itself_keeps_some_and_says_when_it_cannot() {
    let place = tempfile::tempdir().unwrap();
    let backups = place.path().join("backups");
    let config = BackupConfig {
        folder: backups.clone(),
        every_hours: 1,
        keep: 2,
        encrypt: None,
    };
    let yard = Yard::start_with(time("2026-11-24T00:00:00Z"), |all| {
        all.backup = Some(config);
    })
    .await;
    let clock = yard.server.app().clock().clone();
    let hours = |hours: u64| clock.advance(Duration::from_hours(hours));
    count_becomes(&backups, 1, "2026-11-24T00:00:00Z").await;
    hours(1);
    count_becomes(&backups, 2, "2026-11-24T01:00:00Z").await;
    hours(1);
    count_becomes(&backups, 2, "2026-11-24T02:00:00Z").await;
    let (_, status) = yard.get_value("/v1/server").await;
    eventually("the status has the last one", async || {
        let (_, status) = yard.get_value("/v1/server").await;
        if status["backup"]["last_at"] == "2026-11-24T02:00:00Z" {
            Ok(())
        } else {
            Err(status)
        }
    })
    .await;
    assert_eq!(status["backup"]["failure"], Value::Null);
    // A file where the folder was: it can neither be listed nor written.
    std::fs::remove_dir_all(&backups).unwrap();
    std::fs::write(&backups, "").unwrap();
    hours(3);
    let text = eventually("the failure is an alert", async || {
        alert(&yard, "backup-failed").await.ok_or("no alert")
    })
    .await;
    assert!(text.contains("backups"), "{text}");
    eventually("so is the age", async || {
        alert(&yard, "backup-old").await.ok_or("no alert")
    })
    .await;
    std::fs::remove_file(&backups).unwrap();
    hours(1);
    count_becomes(&backups, 1, "2026-11-24T06:00:00Z").await;
    eventually("both are over", async || {
        let raised = (
            alert(&yard, "backup-failed").await,
            alert(&yard, "backup-old").await,
        );
        if raised == (None, None) {
            Ok(())
        } else {
            Err(raised)
        }
    })
    .await;
    let address = yard.server.metrics_address().unwrap();
    let page = yard.client().get(format!("http://{address}/metrics"));
    let text = page.send().await.unwrap().text().await.unwrap();
    assert!(text.contains("tread_backup_failed 0"), "{text}");
    assert!(text.contains("tread_backup_age_seconds"), "{text}");
    assert!(text.contains("tread_build_info{version="), "{text}");
    yard.server.stop().await.unwrap();
}
