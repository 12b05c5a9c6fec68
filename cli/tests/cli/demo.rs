//! `tread demo` that is interrupted.

use std::os::unix::process::CommandExt as _;
use std::process::{Child, Command, Stdio};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tread_tests::ports::free_address;
use tread_tests::wait::{SHORT, eventually};

const PROGRAM: &str = env!("CARGO_BIN_EXE_tread");

/// A process group, as Ctrl-C in a terminal reaches it; killed when this is dropped.
struct Group(Child);

impl Drop for Group {
    fn drop(&mut self) {
        // Both fail only if it has ended already.
        _ = self.0.kill();
        _ = self.0.wait();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_demo_that_is_interrupted_prints_its_results_so_far() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let file = |name: &str| std::fs::File::create(at(name)).unwrap();
    let process = Command::new(PROGRAM)
        .args(["demo", "--robots", "1", "--port"])
        .arg(free_address().port().to_string())
        .env("HOME", folder.path())
        .env_remove("XDG_CONFIG_HOME")
        .env_remove("TREAD_CREDENTIALS")
        .stdin(Stdio::null())
        .stdout(file("results"))
        .stderr(file("notes"))
        .process_group(0)
        .spawn();
    let mut demo = Group(process.unwrap());
    let read = async || std::fs::read_to_string(at("notes")).unwrap_or_default();
    let is_there = |said: &String| said.contains("missions sent");
    eventually("the demo is there", SHORT * 2, read, is_there).await;
    let group = Pid::from_raw(-demo.0.id().cast_signed());
    kill(group, Signal::SIGINT).unwrap();
    let look = || {
        let status = demo.0.try_wait().unwrap();
        async move { status }
    };
    let ended = eventually("the demo has ended", SHORT * 2, look, Option::is_some).await;
    let notes = read().await;
    assert_eq!(ended.and_then(|status| status.code()), Some(0), "{notes}");
    let results = std::fs::read_to_string(at("results")).unwrap();
    for word in ["missions: ", "TERRAIN", "TRUE THETA", "concrete"] {
        assert!(results.contains(word), "no `{word}`: {results}\n{notes}");
    }
}
