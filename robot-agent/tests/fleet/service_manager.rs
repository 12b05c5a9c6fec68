//! The program as a service manager sees it that waits for messages.

use std::fs::File;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use tread_samples::service_manager::ServiceManager;

use crate::support::WAIT_MAX;

/// The watchdog's timeout.
const WATCHDOG: Duration = Duration::from_secs(1);
/// Messages to the watchdog whose intervals are measured.
const MESSAGES: usize = 5;

/// An agent that ends with the test.
struct Program(Child);

impl Drop for Program {
    fn drop(&mut self) {
        // Both fail only if it has ended already.
        _ = self.0.kill();
        _ = self.0.wait();
    }
}

fn start(manager: &ServiceManager, folder: &Path, flags: &[&str]) -> Program {
    start_with_log(manager, folder, flags, Stdio::null())
}

fn start_with_log(manager: &ServiceManager, folder: &Path, flags: &[&str], log: Stdio) -> Program {
    let mut program = Command::new(env!("CARGO_BIN_EXE_tread-agent"));
    program
        // Nobody is there, and it does not matter.
        .args(["--site=yard", "--robot=rover-1", "--server=tcp/127.0.0.1:1"])
        .arg(format!("--data-dir={}", folder.join("robot").display()))
        .args(flags)
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stderr(log);
    manager.attend(&mut program, WATCHDOG);
    Program(program.spawn().unwrap())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_service_manager_hears_ready_then_of_the_loop_then_of_the_stop() {
    let folder = tempfile::tempdir().unwrap();
    let manager = ServiceManager::listen(folder.path()).unwrap();
    let mut program = start(&manager, folder.path(), &[]);
    let (_, ready) = manager
        .next("READY=1", WAIT_MAX)
        .await
        .expect("it is ready");
    assert!(
        ready.contains("STATUS=`rover-1` of `yard`: idle, no server reached yet"),
        "{ready}"
    );
    for message in 0..MESSAGES {
        let fed = manager.next("WATCHDOG=1", WATCHDOG / 2).await;
        assert!(fed.is_some(), "message {message} came too late");
    }
    let asked = Command::new("kill")
        .arg(program.0.id().to_string())
        .status();
    assert!(asked.unwrap().success());
    let stopping = manager.next("STOPPING=1", WAIT_MAX).await;
    assert!(stopping.is_some(), "it says that it stops");
    let ended = tokio::task::spawn_blocking(move || program.0.wait().unwrap()).await;
    assert_eq!(ended.unwrap().code(), Some(0));
}

/// Its log is on a full disk, or the program that read it has gone.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_agent_whose_log_cannot_be_written_goes_on_and_stops_when_its_terminal_is_closed() {
    let folder = tempfile::tempdir().unwrap();
    let manager = ServiceManager::listen(folder.path()).unwrap();
    let full = File::options().write(true).open("/dev/full").unwrap();
    let mut program = start_with_log(&manager, folder.path(), &["--log=debug"], full.into());
    assert!(manager.next("READY=1", WAIT_MAX).await.is_some());
    for message in 0..MESSAGES {
        let fed = manager.next("WATCHDOG=1", WAIT_MAX).await;
        assert!(fed.is_some(), "message {message} did not come");
    }
    let asked = Command::new("kill")
        .args(["-HUP", &program.0.id().to_string()])
        .status();
    assert!(asked.unwrap().success());
    assert!(manager.next("STOPPING=1", WAIT_MAX).await.is_some());
    let ended = tokio::task::spawn_blocking(move || program.0.wait().unwrap()).await;
    assert_eq!(ended.unwrap().code(), Some(0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_control_loop_that_stands_still_starves_the_watchdog_while_the_process_lives() {
    let folder = tempfile::tempdir().unwrap();
    let manager = ServiceManager::listen(folder.path()).unwrap();
    // After 2 s the base's driver does not come back from a read for a minute.
    let mut program = start(&manager, folder.path(), &["--stall-s=2,60"]);
    assert!(manager.next("READY=1", WAIT_MAX).await.is_some());
    assert!(manager.next("WATCHDOG=1", WATCHDOG / 2).await.is_some());
    let starving = async { while manager.next("WATCHDOG=1", WATCHDOG).await.is_some() {} };
    let starved = tokio::time::timeout(WAIT_MAX, starving).await;
    assert!(
        starved.is_ok(),
        "the watchdog is fed by something else than the loop"
    );
    // A service manager would end it now; by itself it first waits for the loop.
    assert!(program.0.try_wait().unwrap().is_none(), "the process lives");
}
