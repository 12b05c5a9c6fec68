//! The program as a service manager sees it that waits for messages.

use std::net::SocketAddr;
use std::process::{Command, Stdio};
use std::time::Duration;

use tread_samples::service_manager::ServiceManager;

use crate::harness::{PATIENCE, client};

/// The watchdog's timeout.
const WATCHDOG: Duration = Duration::from_secs(2);
/// Messages to the watchdog whose intervals are measured.
const MESSAGES: usize = 5;

fn health(api: SocketAddr) -> std::process::Output {
    Command::new(env!("CARGO_BIN_EXE_tread-server"))
        .args(["health", "--ready", "--http", &api.to_string()])
        .output()
        .unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_service_manager_hears_ready_when_the_port_answers_then_of_life_and_of_the_stop() {
    let folder = tempfile::tempdir().unwrap();
    let manager = ServiceManager::listen(folder.path()).unwrap();
    let mut program = Command::new(env!("CARGO_BIN_EXE_tread-server"));
    program
        .args(["--http=127.0.0.1:0", "--zenoh=127.0.0.1:0"])
        .arg(format!(
            "--database={}",
            folder.path().join("tread.db").display()
        ))
        .env_remove("RUST_LOG")
        .stdin(Stdio::null())
        .stderr(Stdio::null());
    manager.attend(&mut program, WATCHDOG);
    let mut child = program.spawn().unwrap();
    let (_, ready) = manager
        .next("READY=1", PATIENCE)
        .await
        .expect("it is ready");
    let status = ready.lines().find_map(|line| line.strip_prefix("STATUS="));
    let status = status.unwrap_or_else(|| panic!("no status in {ready}"));
    assert!(status.contains("0 robots connected"), "{status}");
    let address = status.rsplit(' ').next().unwrap();
    let answer = client(None).get(format!("{address}/healthz")).send().await;
    assert_eq!(answer.unwrap().status(), 200, "at once");
    let api: SocketAddr = address.trim_start_matches("http://").parse().unwrap();
    let asked = tokio::task::spawn_blocking(move || health(api))
        .await
        .unwrap();
    assert!(asked.status.success(), "{asked:?}");
    let first = manager.next("WATCHDOG=1", WATCHDOG / 2).await;
    assert!(first.is_some(), "no message to the watchdog at the start");
    for message in 0..MESSAGES {
        let fed = manager.next("WATCHDOG=1", WATCHDOG / 2).await;
        assert!(fed.is_some(), "message {message} came too late");
    }
    let asked = Command::new("kill").arg(child.id().to_string()).status();
    assert!(asked.unwrap().success());
    let stopping = manager.next("STOPPING=1", PATIENCE).await;
    assert!(stopping.is_some(), "it says that it stops");
    let ended = tokio::task::spawn_blocking(move || child.wait().unwrap()).await;
    assert_eq!(ended.unwrap().code(), Some(0));
    let asked = tokio::task::spawn_blocking(move || health(api))
        .await
        .unwrap();
    assert_eq!(asked.status.code(), Some(1));
    let said = String::from_utf8_lossy(&asked.stderr).into_owned();
    assert!(said.contains("is the server running?"), "{said}");
}
