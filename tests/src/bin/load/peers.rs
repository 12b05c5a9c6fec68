//! What is compared with: the service in Python of `tests/peers`, and SQLite alone.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use tempfile::TempDir;
use tread_api::wire::{self, hello::Welcome};
use tread_tests::database::FleetDatabase;
use tread_tests::ports::free_address;
use tread_tests::process::{Process, Usage};
use tread_tests::wait::{SHORT, eventually};

use crate::ingest::Server;

/// The service, in the folder of this package.
const SERVICE: &str = "peers/service.py";
/// The program that only appends rows, there too.
const FLOOR: &str = "peers/floor.py";

/// A running service; it ends when it is dropped.
#[derive(Debug)]
pub(crate) struct PythonService {
    process: Process,
    zenoh: SocketAddr,
    folder: TempDir,
}

impl PythonService {
    /// Starts the service with this Python. It answers every hello with `welcome`.
    pub(crate) async fn start(python: &Path, welcome: &Welcome) -> anyhow::Result<Self> {
        let folder = tempfile::tempdir()?;
        let (zenoh, http) = (free_address(), free_address());
        let file = folder.path().join("welcome.json");
        std::fs::write(&file, wire::encode(welcome)?)?;
        let arguments = [
            script(SERVICE).display().to_string(),
            format!("--database={}", database(&folder).display()),
            format!("--endpoint=tcp/{zenoh}"),
            format!("--http-port={}", http.port()),
            format!("--welcome={}", file.display()),
        ];
        let log = folder.path().join("log");
        let process = Process::start("the service in Python", python, &arguments, &log)?;
        let counts = format!("http://{http}/counts");
        let client = reqwest::Client::builder().tls_certs_only([]).build()?;
        let ask = async || {
            let answer = client.get(&counts).send().await;
            answer.is_ok_and(|answer| answer.status().is_success())
        };
        eventually("the service in Python answers", SHORT, ask, |&answers| {
            answers
        })
        .await;
        Ok(Self {
            process,
            zenoh,
            folder,
        })
    }

    pub(crate) fn zenoh_endpoint(&self) -> String {
        format!("tcp/{}", self.zenoh)
    }
}

/// Returns a file of this package: below the folder that Cargo names, else in that of the tests.
fn script(name: &str) -> PathBuf {
    let folder = std::env::var_os("CARGO_MANIFEST_DIR");
    folder
        .map_or_else(|| PathBuf::from("tests"), PathBuf::from)
        .join(name)
}

/// What SQLite takes without anything else: rows of as many columns, appended by a loop in C.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct SqliteFloor {
    pub(crate) rows_per_second: f64,
    pub(crate) cpu_us_per_row: f64,
}

/// Measures SQLite alone, with this Python.
pub(crate) fn sqlite_floor(python: &Path, seconds: u64) -> anyhow::Result<SqliteFloor> {
    let folder = tempfile::tempdir()?;
    let ended = Command::new(python)
        .arg(script(FLOOR))
        .arg(format!("--database={}", database(&folder).display()))
        .arg(format!("--seconds={seconds}"))
        .output()
        .with_context(|| format!("cannot start {}", python.display()))?;
    let message = String::from_utf8_lossy(&ended.stderr);
    anyhow::ensure!(ended.status.success(), "{FLOOR} failed: {message}");
    serde_json::from_slice(&ended.stdout).with_context(|| format!("{FLOOR} printed no figures"))
}

fn database(folder: &TempDir) -> PathBuf {
    folder.path().join("peer.db")
}

impl Server for PythonService {
    fn usage(&self) -> Option<Usage> {
        self.process.usage()
    }

    fn database(&self) -> FleetDatabase {
        FleetDatabase::File(database(&self.folder))
    }
}
