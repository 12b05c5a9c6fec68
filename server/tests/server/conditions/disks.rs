//! A full disk, and one that is mounted read-only.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use reqwest::StatusCode;
use serde_json::{Value, json};
use tempfile::TempDir;
use tread_server::Server;

use super::{PROGRAM, assert_says, is_root, said};
use crate::backups::back_up;
use crate::harness::{client, config, database, eventually};

/// Size of the disk of the tests, bytes.
const DISK: &str = "size=16m";

/// A server as a process, with its log and an admin's token.
struct Running {
    child: Child,
    folder: TempDir,
    address: String,
    token: String,
}

impl Running {
    /// Starts a server whose data folder is a disk of its own. What `before` prepares there is on it.
    async fn on_a_disk(options: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let disk = folder.path().join("disk");
        fs::create_dir(&disk).unwrap();
        let log = File::create(folder.path().join("log")).unwrap();
        // The disk is seen by this process and its children alone, and goes with them.
        let script = "mount -t tmpfs -o \"$1\" tmpfs \"$2\" && shift 2 && exec \"$@\"";
        let child = Command::new("unshare")
            .args(["--mount", "sh", "-c", script, "sh", options])
            .arg(&disk)
            .arg(PROGRAM)
            .args(["--http=127.0.0.1:0", "--zenoh=127.0.0.1:0", "--site=yard"])
            .arg(format!("--database={}", disk.join("tread.db").display()))
            .env_remove("RUST_LOG")
            .stdin(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap();
        let mut running = Self {
            child,
            folder,
            address: String::new(),
            token: String::new(),
        };
        running.address = eventually("the API is up", async || running.address_in_log()).await;
        running.token = running.init();
        running
    }

    fn log(&self) -> String {
        fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    fn address_in_log(&self) -> Result<String, String> {
        let log = self.log();
        let rest = log.split("REST API on ").nth(1);
        let address = rest.and_then(|rest| rest.split(',').next());
        address.map(str::to_owned).ok_or(log)
    }

    /// The disk as the server sees it.
    fn disk(&self) -> PathBuf {
        let below = self.folder.path().join("disk");
        let below = below.strip_prefix("/").unwrap();
        Path::new("/proc")
            .join(self.child.id().to_string())
            .join("root")
            .join(below)
    }

    /// Runs the program where the disk is mounted, on the server's database. SQLite follows links,
    /// so a path below `/proc` would lead it to another file.
    fn run(&self, arguments: &[&str]) -> Output {
        let database = self.folder.path().join("disk/tread.db");
        Command::new("nsenter")
            .arg(format!("--target={}", self.child.id()))
            .args(["--mount", PROGRAM])
            .args(arguments)
            .arg(format!("--database={}", database.display()))
            .stdin(Stdio::null())
            .output()
            .unwrap()
    }

    fn init(&self) -> String {
        let output = self.run(&["init"]);
        assert!(output.status.success(), "{}", said(&output));
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    async fn post(&self, path: &str, body: &Value) -> (StatusCode, Value) {
        let asked = client(Some(&self.token)).post(format!("{}{path}", self.address));
        let answer = asked.json(body).send().await.unwrap();
        (answer.status(), answer.json().await.unwrap_or_default())
    }

    async fn get(&self, path: &str) -> (StatusCode, Value) {
        let asked = client(Some(&self.token)).get(format!("{}{path}", self.address));
        let answer = asked.send().await.unwrap();
        (answer.status(), answer.json().await.unwrap_or_default())
    }

    /// Creates sites until one is refused; those that were acknowledged.
    async fn create_sites(&self, begin: &str, count: u32) -> Vec<String> {
        let mut acknowledged = Vec::new();
        for number in 0..count {
            let id = format!("{begin}-{number}");
            let (status, _) = self.post("/v1/sites", &json!({"id": id})).await;
            if status == StatusCode::CREATED {
                acknowledged.push(id);
            }
        }
        acknowledged
    }

    async fn has_all(&self, sites: &[String]) {
        for id in sites {
            let (status, body) = self.get(&format!("/v1/sites/{id}")).await;
            assert_eq!(status, StatusCode::OK, "{id}: {body}");
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // Both fail only if it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Whether this process may make disks of its own.
fn may_mount() -> bool {
    let tried = Command::new("unshare")
        .args(["--mount", "mount", "-t", "tmpfs", "tmpfs", "/mnt"])
        .stderr(Stdio::null())
        .status();
    let may = is_root() && tried.is_ok_and(|status| status.success());
    if !may {
        eprintln!("NOT CHECKED: only root, with CAP_SYS_ADMIN, can mount a disk for the test");
    }
    may
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_a_full_disk_the_server_says_so_and_keeps_all_that_it_acknowledged() {
    if !may_mount() {
        return;
    }
    let running = Running::on_a_disk(DISK).await;
    let mut acknowledged = running.create_sites("before", 3).await;
    assert_eq!(acknowledged.len(), 3);
    let filler = running.disk().join("filler");
    let mut file = File::create(&filler).unwrap();
    let full = std::io::copy(&mut std::io::repeat(0), &mut file).unwrap_err();
    assert_eq!(full.kind(), std::io::ErrorKind::StorageFull);
    drop(file);
    let detail = eventually("the server is not ready", async || {
        // What still fits is acknowledged, and must stay.
        acknowledged.extend(
            running
                .create_sites(&format!("full-{}", acknowledged.len()), 5)
                .await,
        );
        let (status, body) = running.get("/readyz").await;
        let detail = body["detail"].as_str().map(str::to_owned);
        detail
            .filter(|_| status == StatusCode::SERVICE_UNAVAILABLE)
            .ok_or((status, body))
    })
    .await;
    assert_says(&detail, &["the disk is full", "make room on its disk"]);
    let (_, alerts) = running.get("/v1/alerts?kind=storage-unwritable").await;
    let alert = alerts["items"][0]["text"]
        .as_str()
        .unwrap_or_default()
        .to_owned();
    assert_says(&alert, &["tread.db", "the disk is full", "make room"]);
    assert_says(
        &running.log(),
        &["the disk is full", "make room on its disk"],
    );

    // The doctor, beside the running server.
    let doctor = running.run(&["doctor", "--json"]);
    assert_eq!(doctor.status.code(), Some(1));
    assert_says(&String::from_utf8_lossy(&doctor.stdout), &["make room"]);

    fs::remove_file(&filler).unwrap();
    eventually("the server is ready again", async || {
        let (status, body) = running.get("/readyz").await;
        if status == StatusCode::OK {
            Ok(())
        } else {
            Err(body)
        }
    })
    .await;
    acknowledged.extend(running.create_sites("after", 3).await);
    running.has_all(&acknowledged).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_a_read_only_disk_the_server_does_not_start_and_says_why() {
    if !may_mount() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let server = Server::start(config(folder.path(), "127.0.0.1:0"))
        .await
        .unwrap();
    server.stop().await.unwrap();
    let before = fs::read(database(folder.path())).unwrap();
    let script =
        "mount --bind \"$1\" \"$1\" && mount -o remount,ro,bind \"$1\" && shift && exec \"$@\"";
    let run = |arguments: &[String]| {
        let output = Command::new("unshare")
            .args(["--mount", "sh", "-c", script, "sh"])
            .arg(folder.path())
            .arg(PROGRAM)
            .args(arguments)
            .stdin(Stdio::null())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned() + &said(&output);
        (output.status.code(), text)
    };
    let of_database = format!("--database={}", at("tread.db"));
    let flags = ["--http=127.0.0.1:0", "--zenoh=127.0.0.1:0", &of_database];
    let (code, text) = run(&flags.map(str::to_owned));
    assert_eq!(code, Some(1), "{text}");
    assert_says(
        &text,
        &[&at("tread.db"), "mounted read-only", "mount it for writing"],
    );
    let (code, text) = run(&["doctor".to_owned(), of_database]);
    assert_eq!(code, Some(1), "{text}");
    assert_says(
        &text,
        &["WRONG folder", "mounted read-only", "ok    database"],
    );
    assert_eq!(
        fs::read(database(folder.path())).unwrap(),
        before,
        "it is as it was"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_is_restored_to_a_small_disk_over_what_an_interrupted_restoration_left() {
    if !may_mount() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(config(folder.path(), "127.0.0.1:0"))
        .await
        .unwrap();
    server.stop().await.unwrap();
    let backup = back_up(folder.path(), "backup.tar");
    let disk = folder.path().join("disk");
    fs::create_dir(&disk).unwrap();
    let other = folder.path().join("other.tar");
    fs::write(&other, "no backup").unwrap();
    // What was left is on the disk before the program runs.
    let script = "mount -t tmpfs -o \"$1\" tmpfs \"$2\" && \
                  head -c \"$3\" /dev/zero >\"$2/tread.db.restoring\" && shift 3 && exec \"$@\"";
    let restore = |options: &str, left: &str, from: &Path| {
        let output = Command::new("unshare")
            .args(["--mount", "sh", "-c", script, "sh", options])
            .arg(&disk)
            .args([left, PROGRAM, "restore", "--from"])
            .arg(from)
            .arg(format!("--database={}", disk.join("tread.db").display()))
            .stdin(Stdio::null())
            .output()
            .unwrap();
        (output.status.code(), said(&output))
    };
    let (code, text) = restore("size=40m", "30M", &backup);
    assert_eq!(code, Some(0), "{text}");
    let (code, text) = restore("size=8m", "0", &backup);
    assert_eq!(code, Some(1), "{text}");
    assert_says(
        &text,
        &[
            "MiB for the database and 16 MiB for its log",
            "MiB free",
            "MiB are needed there: make room",
        ],
    );
    // What is no backup is refused as that, however full the disk is.
    let (code, text) = restore("size=8m", "0", &other);
    assert_eq!(code, Some(1), "{text}");
    assert_says(&text, &["is no backup of tread-server"]);
}
