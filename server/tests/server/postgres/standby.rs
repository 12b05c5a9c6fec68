//! Two servers on one database: one works, and the other waits until it may.

use std::fs::{self, File};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use reqwest::StatusCode;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::time::Instant;
use tread_server::db::lock::DatabaseLock;
use tread_server::db::schema;

use super::{address_of, created, server_of_tests, tool};
use crate::harness::{client, eventually};

/// Time within which a standby is to answer after the other server was killed, and after it was frozen;
/// longer than it takes, since the machine may be busy.
const AFTER_KILL_MAX: Duration = Duration::from_secs(10);
const AFTER_FREEZE_MAX: Duration = Duration::from_secs(15);

/// A server that is ended with the test.
struct Program {
    process: Child,
    log: PathBuf,
}

impl Program {
    fn start(folder: &Path, name: &str, database: &str) -> Self {
        Self::start_at(folder, name, database, "127.0.0.1:0".parse().unwrap())
    }

    /// Starts one that tells standbys that it is at this address.
    fn start_at(folder: &Path, name: &str, database: &str, http: SocketAddr) -> Self {
        let config = folder.join(format!("{name}.toml"));
        fs::write(
            &config,
            format!("[web]\nadvertise_url = \"http://{http}\"\n"),
        )
        .unwrap();
        let log = folder.join(format!("{name}.log"));
        let mut command = Command::new(env!("CARGO_BIN_EXE_tread-server"));
        command.args(["--standby", "--zenoh=127.0.0.1:0"]);
        command.arg(format!("--http={http}"));
        if http.port() != 0 {
            command.arg("--config").arg(config);
        }
        command.args(["--site=yard", "--database", database]);
        command.env_remove("RUST_LOG").stdin(Stdio::null());
        command
            .stdout(Stdio::null())
            .stderr(File::create(&log).unwrap());
        Self {
            process: command.spawn().unwrap(),
            log,
        }
    }

    fn said(&self) -> String {
        fs::read_to_string(&self.log).unwrap()
    }

    async fn says(&self, words: &str) {
        eventually(words, async || {
            let said = self.said();
            if said.contains(words) {
                Ok(())
            } else {
                Err(said)
            }
        })
        .await;
    }

    /// Waits until it answers, and returns its address.
    async fn address(&self) -> String {
        eventually("the API is up", async || {
            let said = self.said();
            let rest = said.split("REST API on ").nth(1);
            let address = rest.and_then(|rest| rest.split([',', '\n']).next());
            address.map(str::to_owned).ok_or(said)
        })
        .await
    }

    fn signal(&self, signal: Signal) {
        let process = i32::try_from(self.process.id()).unwrap();
        kill(Pid::from_raw(process), signal).unwrap();
    }

    async fn ends(&mut self) -> ExitStatus {
        eventually("it ends", async || match self.process.try_wait().unwrap() {
            Some(status) => Ok(status),
            None => Err(()),
        })
        .await
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Creates the first admin's token.
fn init(database: &str) -> String {
    let mut init = Command::new(env!("CARGO_BIN_EXE_tread-server"));
    let init = init
        .args(["init", "--database", database])
        .output()
        .unwrap();
    assert!(init.status.success());
    String::from_utf8(init.stdout).unwrap().trim().to_owned()
}

async fn create_terrain(address: &str, token: &str, name: &str) -> StatusCode {
    let terrain = serde_json::json!({
        "id": name, "class": "grass",
        "polygon": [{"x_m": 0, "y_m": 0}, {"x_m": 1, "y_m": 0}, {"x_m": 1, "y_m": 1}]
    });
    let url = format!("{address}/v1/sites/yard/terrains");
    let sent = client(Some(token)).post(url).json(&terrain).send().await;
    sent.unwrap().status()
}

async fn terrains(address: &str, token: &str) -> String {
    let url = format!("{address}/v1/sites/yard/terrains");
    let answer = client(Some(token)).get(url).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    answer.text().await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_takes_over_from_a_server_that_was_killed_and_from_one_that_is_frozen() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let database = address_of(&created(&admin, folder.path()));
    let token = init(&database);

    let first = Program::start(folder.path(), "first", &database);
    let address = first.address().await;
    assert!(create_terrain(&address, &token, "sand").await.is_success());
    let second = Program::start(folder.path(), "second", &database);
    second.says("standby: another server").await;
    assert!(!second.said().contains("REST API on"), "{}", second.said());

    let begun = Instant::now();
    first.signal(Signal::SIGKILL);
    let address = second.address().await;
    assert!(begun.elapsed() < AFTER_KILL_MAX, "{:?}", begun.elapsed());
    assert!(terrains(&address, &token).await.contains("sand"));

    let mut third = Program::start(folder.path(), "third", &database);
    third.says("standby: another server").await;
    let begun = Instant::now();
    second.signal(Signal::SIGSTOP);
    let new = third.address().await;
    assert!(begun.elapsed() < AFTER_FREEZE_MAX, "{:?}", begun.elapsed());
    assert!(create_terrain(&new, &token, "grass").await.is_success());
    // It wakes up, and is the server no more.
    let mut second = second;
    second.signal(Signal::SIGCONT);
    assert!(!second.ends().await.success());
    let said = second.said();
    assert!(
        said.contains("taken over the database") || said.contains("lock of the database is lost"),
        "{said}"
    );
    let found = terrains(&new, &token).await;
    assert!(found.contains("sand") && found.contains("grass"), "{found}");
    third.signal(Signal::SIGTERM);
    assert!(third.ends().await.success(), "{}", third.said());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_that_is_asked_to_stop_completes_open_requests() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let database = address_of(&created(&admin, folder.path()));
    let token = init(&database);
    let free = || {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.local_addr().unwrap()
    };
    let (at_first, at_second) = (free(), free());
    let first = Program::start_at(folder.path(), "first", &database, at_first);
    first.address().await;
    let mut second = Program::start_at(folder.path(), "second", &database, at_second);
    second.says("standby: it has the map").await;

    let body = r#"{"id": "quarry"}"#;
    let mut stream = TcpStream::connect(at_second).await.unwrap();
    let head = format!(
        "POST /v1/sites HTTP/1.1\r\nhost: localhost\r\nauthorization: Bearer {token}\r\n\
         content-type: application/json\r\ncontent-length: {}\r\nconnection: close\r\n\r\n",
        body.len()
    );
    let (begin, rest) = body.split_at(8);
    stream.write_all(head.as_bytes()).await.unwrap();
    stream.write_all(begin.as_bytes()).await.unwrap();
    // It has begun with the request: an answer to a later one is there.
    terrains(&format!("http://{at_second}"), &token).await;
    second.signal(Signal::SIGTERM);
    second.says("asked to stop").await;
    stream.write_all(rest.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 201 "), "{answer}");
    assert!(second.ends().await.success(), "{}", second.said());
    assert!(TcpStream::connect(at_second).await.is_err());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_of_the_next_release_waits_for_the_server_and_brings_its_schema_up_to_date() {
    let Some(admin) = server_of_tests() else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let location = created(&admin, folder.path());
    let database = address_of(&location);
    let token = init(&database);
    // As the release before left it, whose server runs.
    let sql = "ALTER TABLE server_epoch DROP COLUMN advertise_url, DROP COLUMN generation;
        DELETE FROM _sqlx_migrations WHERE version = 5";
    tool("psql", &[&database, "--quiet", "--command", sql]);
    let lock = DatabaseLock::take(&location).await.unwrap();
    let next = Program::start(folder.path(), "next", &database);
    next.says("standby: another server").await;
    next.says("standby: it answers no requests").await;
    assert!(!next.said().contains("takes over"), "{}", next.said());
    lock.release().await;
    let address = next.address().await;
    assert!(create_terrain(&address, &token, "sand").await.is_success());
    assert!(terrains(&address, &token).await.contains("sand"));
    let found = schema::of(&location).await.unwrap();
    assert_eq!(found.schema, Some(schema::known(&location)));
}
