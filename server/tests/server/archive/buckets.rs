//! The program with an archive in a bucket.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tread_samples::s3::S3Server;
use tread_server::app::{App, Dependencies};
use tread_server::clock::Clock;
use tread_server::db::{Db, archive_mark, segment_ranges};

use super::{OF_A_DAY, drive};
use crate::backups::words;
use crate::harness::{client, database, eventually, time};
use crate::ingest::Writer;

const BUCKET: &str = "fleet";

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

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn old_measurements_move_into_a_bucket_and_doctor_finds_what_is_missing_there() {
    let Some(storage) = S3Server::start("old_measurements_move_into_a_bucket") else {
        return;
    };
    let url = format!("{}/{BUCKET}", storage.endpoint());
    let made = client(None).put(&url).send().await.unwrap();
    assert!(made.status().is_success());
    let folder = tempfile::tempdir().unwrap();
    fill(folder.path(), 30).await;
    let settings = format!(
        "http = \"127.0.0.1:0\"\nzenoh = \"127.0.0.1:0\"\ndatabase = \"{}\"\n\
         [retention]\nsegments_max = 1000\narchive = \"s3://{BUCKET}/yard\"\n",
        database(folder.path()).display()
    );
    std::fs::write(folder.path().join("server.toml"), settings).unwrap();

    let mut started = program(folder.path(), &storage, &[]);
    started.stdout(Stdio::null()).stderr(Stdio::null());
    let running = Running(started.spawn().unwrap());
    let file = "segments-0000000000000000001-0000000000000000200.parquet";
    eventually("the file is in the bucket", async || {
        let listed = names(&storage).await;
        let is_there = listed.contains(&format!("<Key>yard/{file}</Key>"));
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
    assert!(text.contains("all of its 1 files can be read"), "{text}");
    let deleted = client(None)
        .delete(format!("{url}/yard/{file}"))
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
