//! The watchdog of the service manager while the storage fails: a restart mends no disk.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tread_samples::service_manager::ServiceManager;

use crate::interposer::{Fault, Interposer, program_with_faults};

const PATIENCE: Duration = Duration::from_secs(30);
const LOOK_AGAIN: Duration = Duration::from_millis(50);
/// The watchdog's timeout.
const WATCHDOG: Duration = Duration::from_secs(2);
/// Messages to the watchdog while the storage fails: two whole timeouts.
const MESSAGES: usize = 8;

/// A server whose storage can fail, under a service manager. Ends with the test.
struct Watched {
    manager: ServiceManager,
    interposer: Interposer,
    child: Child,
    api: String,
}

impl Drop for Watched {
    fn drop(&mut self) {
        self.interposer.disarm();
        // Both fail only if it has ended already.
        _ = self.child.kill();
        _ = self.child.wait();
    }
}

impl Watched {
    async fn start(folder: &Path) -> Self {
        let manager = ServiceManager::listen(folder).unwrap();
        let program = Command::new(env!("CARGO_BIN_EXE_tread-server"));
        let (mut program, interposer) = program_with_faults(program, folder);
        program
            .args(["--http=127.0.0.1:0", "--zenoh=127.0.0.1:0"])
            .arg(format!("--database={}", folder.join("tread.db").display()))
            .stdin(Stdio::null())
            .stderr(Stdio::null());
        manager.attend(&mut program, WATCHDOG);
        let child = program.spawn().unwrap();
        let (status, _) = manager.next("STATUS=", PATIENCE).await.expect("it starts");
        interposer.assert_loaded();
        Self {
            manager,
            interposer,
            child,
            api: status.rsplit(' ').next().unwrap().to_owned(),
        }
    }

    async fn ready(&self) -> u16 {
        let answer = reqwest::get(format!("{}/readyz", self.api)).await;
        answer.map_or(0, |answer| answer.status().as_u16())
    }

    async fn until_ready_is(&self, status: u16) {
        let waiting = async {
            while self.ready().await != status {
                tokio::time::sleep(LOOK_AGAIN).await;
            }
        };
        let came = tokio::time::timeout(PATIENCE, waiting).await;
        assert!(came.is_ok(), "readiness is never {status}");
    }
}

async fn is_fed_while(fault: Fault) {
    let folder = tempfile::tempdir().unwrap();
    let mut watched = Watched::start(folder.path()).await;
    watched.until_ready_is(200).await;
    watched.interposer.arm(fault, 1, true);
    watched.until_ready_is(503).await;
    watched.manager.drain();
    for message in 0..MESSAGES {
        let fed = watched.manager.next("WATCHDOG=1", WATCHDOG / 2).await;
        assert!(
            fed.is_some(),
            "message {message} during {fault:?} is missing"
        );
    }
    assert_eq!(watched.ready().await, 503, "it fails all the time");
    assert!(watched.child.try_wait().unwrap().is_none(), "it lives");
    assert!(watched.interposer.disarm() > 0, "nothing failed");
    watched.until_ready_is(200).await;
    let heard = watched.manager.next("STATUS=0 robots", PATIENCE).await;
    assert!(
        heard.is_some(),
        "the status says that the storage works again"
    );
}

pub(crate) fn fed() {
    // The first call counts; all install the same.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        for fault in [Fault::WriteFull, Fault::SyncIo, Fault::Hang] {
            is_fed_while(fault).await;
        }
    });
}
