//! A real agent with its threads and clocks is recorded, and the program replays it.

use std::path::PathBuf;
use std::process::Command;

use serde_json::Value;
use tread_agent::{Agent, RecordingConfig};
use tread_api::wire::ingest::MissionPhase;

use crate::SHORT;
use crate::rig::Rig;
use crate::support::offer;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_recorded_mission_of_a_real_agent_runs_again_to_the_bit() {
    let rig = Rig::new();
    let server = rig.serve();
    let folder = tempfile::tempdir().unwrap();
    let mut config = rig.config();
    config.recording = Some(RecordingConfig {
        folder: folder.path().to_owned(),
        file_bytes: 100_000,
        files: 100,
    });
    let agent = Agent::start(config).unwrap();
    rig.ready(agent.boot()).await;
    let first = offer(1, SHORT);
    server.offer(&rig.robot, &first).await;
    rig.sees("the mission ends", |memory| {
        let phases = memory.phases(first.mission);
        phases.contains(&MissionPhase::Succeeded).then_some(())
    })
    .await;
    agent.stop().await;
    server.stop().await;

    let files: Vec<PathBuf> = std::fs::read_dir(folder.path())
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    assert!(files.len() > 1, "{files:?}");
    let replay = Command::new(env!("CARGO_BIN_EXE_tread-agent"))
        .args(["replay", "--json"])
        .args(&files)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&replay.stdout);
    assert!(replay.status.success(), "{text} {replay:?}");
    let found: Value = serde_json::from_str(&text).unwrap();
    assert!(found["driving_ticks"].as_u64().unwrap() > 300, "{found}");
    assert_eq!(found["torn"], Value::Null, "{found}");
    // Without a run's begin there is nothing to compare, and the program says so.
    let mut later = files.clone();
    later.sort();
    let replayed_anyway = |words: &[&str]| {
        let replay = Command::new(env!("CARGO_BIN_EXE_tread-agent"))
            .arg("replay")
            .args(words)
            .args(&later[1..])
            .output()
            .unwrap();
        assert_eq!(replay.status.code(), Some(1), "{replay:?}");
        replay
    };
    let refused = replayed_anyway(&[]);
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(said.contains("part 0 is missing"), "{said}");
    // A program that reads JSON gets it there, also of a file that is none.
    for (words, expected) in [
        (&["--json"][..], "part 0 is missing"),
        (
            &["--json", "gone.mcap"],
            "`gone.mcap` cannot be opened: No such file",
        ),
        (
            &["--json", env!("CARGO_BIN_EXE_tread-agent")],
            "is no MCAP file",
        ),
    ] {
        let refused = replayed_anyway(words);
        let object: Value = serde_json::from_slice(&refused.stdout).unwrap();
        let said = object["refused"].as_str().unwrap();
        assert!(said.contains(expected), "{said}");
        assert_eq!(object["checks"][0]["holds"], false, "{object}");
    }
}
