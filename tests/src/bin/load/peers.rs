//! A server to compare with: the service in Python of `tests/peers`.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use tread_api::wire::{self, hello::Welcome};
use tread_tests::ports::free_address;
use tread_tests::process::{Process, Usage};
use tread_tests::wait::{SHORT, eventually};

use crate::ingest::Server;

/// The service, in the folder of this package.
const SERVICE: &str = "peers/service.py";

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
            service().display().to_string(),
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

/// Returns the file of the service: below the folder that Cargo names, else in that of the tests.
fn service() -> PathBuf {
    let folder = std::env::var_os("CARGO_MANIFEST_DIR");
    folder
        .map_or_else(|| PathBuf::from("tests"), PathBuf::from)
        .join(SERVICE)
}

fn database(folder: &TempDir) -> PathBuf {
    folder.path().join("peer.db")
}

impl Server for PythonService {
    fn usage(&self) -> Option<Usage> {
        self.process.usage()
    }

    fn database(&self) -> PathBuf {
        database(&self.folder)
    }
}
