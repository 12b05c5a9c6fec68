//! The program with an archive in a bucket.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use reqwest::StatusCode;
use tokio::time::Instant;
use tread_samples::s3::S3Server;
use tread_server::app::{App, Dependencies};
use tread_server::clock::Clock;
use tread_server::db::{Db, archive_mark, segment_ranges};
use tread_server::http::REQUEST_TIMEOUT;

use super::{OF_A_DAY, drive};
use crate::backups::words;
use crate::harness::{client, database, eventually, time};
use crate::ingest::Writer;

const BUCKET: &str = "fleet";
/// Name of the file with the oldest measurements.
const FILE: &str = "segments-0000000000000000001-0000000000000000200.parquet";

/// Fills a database with measurements of some days.
async fn fill(folder: &Path, days: u64) {
    let db = Db::open(&database(folder)).await.unwrap();
    let clock = Clock::manual(time("2026-11-01T00:00:00Z"));
    let app = App::new(Dependencies::on_database(db, clock));
    let writer = Writer::on(app.clone()).await;
    for day in 0..days {
        let receipt = writer.upload_as("rover-1", drive(day * OF_A_DAY)).await;
        assert_eq!(receipt.committed, OF_A_DAY);
        app.clock().advance(Duration::from_hours(24));
    }
    app.db().close().await;
}

fn program(folder: &Path, storage: &S3Server, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tread-server"));
    command.args(arguments).arg("--config");
    command.arg(folder.join("server.toml"));
    command.env_remove("RUST_LOG").envs(storage.environment());
    command.stdin(Stdio::null());
    command
}

async fn names(storage: &S3Server) -> String {
    let url = format!("{}/{BUCKET}?list-type=2", storage.endpoint());
    let listed = client(None).get(url).send().await.unwrap();
    listed.text().await.unwrap()
}

/// A server that is ended with the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A server whose oldest measurements, 200 of 1200, are in the bucket.
struct Archived {
    storage: S3Server,
    folder: tempfile::TempDir,
    running: Running,
    /// Address of the REST API.
    address: String,
    /// Secret of an admin.
    token: String,
}

impl Archived {
    /// Returns `None` where no storage is installed.
    async fn start(test: &str) -> Option<Self> {
        let storage = S3Server::start(test)?;
        let url = format!("{}/{BUCKET}", storage.endpoint());
        let made = client(None).put(&url).send().await.unwrap();
        assert!(made.status().is_success());
        let folder = tempfile::tempdir().unwrap();
        fill(folder.path(), 30).await;
        let settings = format!(
            "http = \"127.0.0.1:0\"\nzenoh = \"127.0.0.1:0\"\ndatabase = \"{}\"\nsite = \"yard\"\n\
             [retention]\nsegments_max = 1000\narchive = \"s3://{BUCKET}/yard\"\n",
            database(folder.path()).display()
        );
        std::fs::write(folder.path().join("server.toml"), settings).unwrap();
        let first = program(folder.path(), &storage, &["init"])
            .output()
            .unwrap();
        assert!(first.status.success(), "{}", words(&first));
        let token = String::from_utf8(first.stdout).unwrap().trim().to_owned();

        let log = folder.path().join("log");
        let mut started = program(folder.path(), &storage, &[]);
        started.stdout(Stdio::null());
        started.stderr(std::fs::File::create(&log).unwrap());
        let running = Running(started.spawn().unwrap());
        let address = eventually("the API is up", async || {
            let log = std::fs::read_to_string(&log).unwrap();
            let rest = log.split("REST API on ").nth(1);
            let address = rest.and_then(|rest| rest.split([',', '\n']).next());
            address.map(str::to_owned).ok_or(log)
        })
        .await;
        eventually("the file is in the bucket", async || {
            let listed = names(&storage).await;
            let is_there = listed.contains(&format!("<Key>yard/{FILE}</Key>"));
            is_there.then_some(()).ok_or(listed)
        })
        .await;
        eventually("the measurements are removed", async || {
            let db = Db::open(&database(folder.path())).await.unwrap();
            let mut tx = db.read("test").await.unwrap();
            let ends = segment_ranges::ends(&mut tx).await.unwrap();
            let mark = archive_mark::get(&mut tx).await.unwrap();
            drop(tx);
            db.close().await;
            if (ends, mark) == (Some((201, 1200)), Some((1, 200))) {
                return Ok(());
            }
            Err((ends, mark))
        })
        .await;
        Some(Self {
            storage,
            folder,
            running,
            address,
            token,
        })
    }

    /// Sends a signal to the storage.
    fn signal_storage(&self, signal: Signal) {
        let process = i32::try_from(self.storage.process()).unwrap();
        kill(Pid::from_raw(process), signal).unwrap();
    }

    async fn get(&self, path: &str) -> (StatusCode, String) {
        let asking = client(Some(&self.token));
        let answer = asking.get(format!("{}/v1/sites/yard{path}", self.address));
        let answer = answer.send().await.unwrap();
        (answer.status(), answer.text().await.unwrap())
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_storage_that_hangs_delays_none_but_the_readers_of_the_archive_and_these_within_bounds() {
    let test = "a_storage_that_hangs_delays_none_but_the_readers_of_the_archive";
    let Some(archived) = Archived::start(test).await else {
        return;
    };
    let (status, page) = archived.get("/segments?limit=1000").await;
    assert_eq!(status, StatusCode::OK, "{page}");
    archived.signal_storage(Signal::SIGSTOP);
    let begun = Instant::now();
    let reading = archived.get("/segments?limit=1000");
    let others = async {
        let (status, site) = archived.get("").await;
        assert_eq!(status, StatusCode::OK, "{site}");
        let (status, newer) = archived.get("/segments?cursor=200&limit=1000").await;
        assert_eq!(status, StatusCode::OK, "{newer}");
        begun.elapsed()
    };
    let ((status, problem), others) = tokio::join!(reading, others);
    assert!(others < Duration::from_secs(2), "{others:?}");
    assert_eq!(status, StatusCode::SERVICE_UNAVAILABLE, "{problem}");
    assert!(problem.contains("its storage does not answer"), "{problem}");
    assert!(begun.elapsed() < REQUEST_TIMEOUT, "{:?}", begun.elapsed());
    archived.signal_storage(Signal::SIGCONT);
    eventually("the archive is read again", async || {
        let (status, found) = archived.get("/segments?limit=1000").await;
        if status == StatusCode::OK {
            assert_eq!(found, page);
            return Ok(());
        }
        Err(found)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn old_measurements_move_into_a_bucket_and_doctor_finds_what_is_missing_there() {
    let Some(archived) = Archived::start("old_measurements_move_into_a_bucket").await else {
        return;
    };
    let url = format!("{}/{BUCKET}", archived.storage.endpoint());
    let Archived {
        storage,
        folder,
        running,
        ..
    } = archived;
    let ended = Command::new("kill")
        .arg(running.0.id().to_string())
        .status();
    assert!(ended.unwrap().success());
    let ended = tokio::task::spawn_blocking(move || {
        let mut running = running;
        running.0.wait().unwrap()
    });
    assert!(ended.await.unwrap().success());
    let examined = program(folder.path(), &storage, &["doctor", "--deep"]).output();
    let text = words(&examined.unwrap());
    assert!(text.contains("all files can be read (1)"), "{text}");
    let deleted = client(None)
        .delete(format!("{url}/yard/{FILE}"))
        .send()
        .await;
    assert!(deleted.unwrap().status().is_success());
    let examined = program(folder.path(), &storage, &["doctor"]).output();
    let text = words(&examined.unwrap());
    assert!(text.contains("lacks the measurement 200"), "{text}");
    drop(storage);
    let gone = S3Server::start("old_measurements_move_into_a_bucket").unwrap();
    let examined = program(folder.path(), &gone, &["doctor"]).output();
    let text = words(&examined.unwrap());
    assert!(
        text.contains("s3://fleet/yard") && text.contains("NoSuchBucket"),
        "{text}"
    );
}
