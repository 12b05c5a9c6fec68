//! Robots whose clock is an hour off, and a robot whose certificate has expired: each says so with what
//! to do, and keeps what it measured until the server has it.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::Command;

use tread_api::ids::RobotId;
use tread_api::mission::MissionState;
use tread_tests::fleet::Fleet;
use tread_tests::wait::{DRIVE, SHORT, eventually};

use crate::bend;

/// Short enough that a certificate expires within a test.
const CERTIFICATE_S: u32 = 6;
/// An address where nobody listens.
const NOWHERE: &str = "http://127.0.0.1:9";

fn assert_says(text: &str, parts: &[&str]) {
    for part in parts {
        assert!(text.contains(part), "`{part}` in: {text}");
    }
}

/// Waits until a log says something, and returns it.
async fn says(fleet: &Fleet, name: &str, part: &str) -> String {
    let what = format!("`{part}` in the log of {name}");
    eventually(
        &what,
        SHORT,
        async || fleet.log(name),
        |log| log.contains(part),
    )
    .await
}

/// Compiles the library that sets a process's clock.
fn clock_library(fleet: &Fleet) -> PathBuf {
    let here = PathBuf::from(std::env::var_os("CARGO_MANIFEST_DIR").unwrap());
    let library = fleet.file("clock_off.so");
    let compiler = std::env::var_os("CC").unwrap_or_else(|| OsString::from("cc"));
    let done = Command::new(compiler)
        .args(["-shared", "-fPIC", "-O1", "-Wall", "-o"])
        .arg(&library)
        .arg(here.join("tests/fleet/clock_off.c"))
        .arg("-ldl")
        .output()
        .expect("a C compiler is there: SQLite is built with it");
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{said}");
    library
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_whose_clock_is_an_hour_off_says_so_and_its_measurements_arrive() {
    let mut fleet = crate::fleet().await;
    let library = clock_library(&fleet).display().to_string();
    for (name, off_s, direction) in [
        ("rover-1", "-3600", "behind"),
        ("rover-2", "3600", "ahead of"),
    ] {
        let robot: RobotId = name.parse().unwrap();
        let variables = [
            ("LD_PRELOAD", library.as_str()),
            ("TREAD_CLOCK_OFF_S", off_s),
        ];
        let variables = variables.map(|(name, value)| (name.to_owned(), value.to_owned()));
        fleet.agent_environment = variables.to_vec();
        fleet.start_agent(&robot, 0.0).await;
        let log = says(&fleet, name, "this robot's clock is").await;
        assert_says(
            &log,
            &[direction, "the server's", "synchronised", "start it again"],
        );
        let offset = format!("the server sees that the clock of {name} is off");
        let look = || fleet.rest.robot(&robot);
        eventually(&offset, SHORT, look, |seen| {
            let live = seen.as_ref().and_then(|seen| seen.live.as_ref());
            live.is_some_and(|live| {
                live.clock_offset_ms.unsigned_abs().abs_diff(3_600_000) < 10_000
            })
        })
        .await;
        let mission = fleet.rest.send(&robot, bend(0.0)).await;
        fleet
            .rest
            .mission_reaches(mission, &[MissionState::Succeeded], DRIVE)
            .await;
        let emptied = format!("the outbox of {name} is empty");
        let look = || fleet.rest.robot(&robot);
        eventually(&emptied, SHORT, look, |seen| {
            let live = seen.as_ref().and_then(|seen| seen.live.as_ref());
            live.is_some_and(|live| live.outbox.pending == 0 && live.outbox.dropped == 0)
        })
        .await;
    }
}

/// Writes where the robot finds the REST API, as a person does who edits the file.
fn set_server(folder: &Path, server: &str) {
    let path = folder.join("membership.json");
    let text = std::fs::read_to_string(&path).unwrap();
    let mut file: serde_json::Value = serde_json::from_str(&text).unwrap();
    let fields = file.as_object_mut().unwrap();
    fields.remove("crc32");
    fields.insert("server".to_owned(), server.into());
    std::fs::write(&path, serde_json::to_vec(&file).unwrap()).unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_whose_certificate_has_expired_says_so_and_comes_back_with_all_it_measured() {
    let node = Path::new(env!("CARGO_BIN_EXE_node"));
    let mut fleet = Fleet::start_secure_with(node, CERTIFICATE_S).await;
    let robot: RobotId = "rover-1".parse().unwrap();
    fleet.join(&robot).await;
    fleet.start_agent(&robot, 0.0).await;
    let mission = fleet.rest.send(&robot, bend(0.0)).await;
    fleet
        .rest
        .mission_reaches(mission, &[MissionState::Active], SHORT)
        .await;
    // It drives to the end without the server, so that something waits in its outbox.
    fleet.kill_server();
    says(&fleet, "rover-1", "the certificate was not renewed").await;
    fleet.stop_agent(&robot).await.unwrap();
    let address = format!("http://{}", fleet.http_address());
    set_server(&fleet.robot_folder(&robot), NOWHERE);
    fleet.start_server().await;
    fleet.spawn_agent(&robot, 0.0);
    let log = says(
        &fleet,
        "rover-1",
        "refuses this robot's certificate as expired",
    )
    .await;
    assert_says(&log, &["REST API can be reached", "tread-agent enroll"]);
    let log = says(&fleet, "server", "whose certificate has expired").await;
    assert_says(
        &log,
        &[
            "renews it while it reaches the REST API",
            "compare its clock",
        ],
    );
    fleet.stop_agent(&robot).await.unwrap();

    set_server(&fleet.robot_folder(&robot), &address);
    fleet.start_agent(&robot, 0.0).await;
    let look = || fleet.rest.robot(&robot);
    eventually("what it measured has arrived", SHORT, look, |seen| {
        let live = seen.as_ref().and_then(|seen| seen.live.as_ref());
        live.is_some_and(|live| live.outbox.pending == 0 && live.outbox.dropped == 0)
    })
    .await;
    let ended = [MissionState::Succeeded, MissionState::Failed];
    fleet.rest.mission_reaches(mission, &ended, SHORT).await;
}
