//! The commands of the agent's program that print a result.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// Runs a command that must fail; returns the one JSON object on its standard output.
fn object_of_failure(folder: &Path, words: &[&str]) -> Value {
    let output = Command::new(env!("CARGO_BIN_EXE_tread-agent"))
        .args(words)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1), "{words:?}: {output:?}");
    let read: Result<Value, _> = serde_json::from_slice(&output.stdout);
    let object = read.unwrap_or_else(|cause| panic!("{words:?}: {cause}: {output:?}"));
    assert!(object.is_object(), "{words:?}: {object}");
    object
}

#[test]
fn a_configuration_that_cannot_be_examined_is_a_finding_of_the_doctor() {
    let folder = tempfile::tempdir().unwrap();
    let cases: [(&[u8], &str); 5] = [
        (b"site = ", "robot.toml"),
        (b"site = 3", "robot.toml"),
        (b"\xff\xfe", "is not text in UTF-8"),
        (b"robot = \"rover-1\"", "`site` is missing"),
        (
            b"site = \"yard\"\nrobot = \"rover-1\"\ndata_dir = \"data\"",
            "is simulated",
        ),
    ];
    let words = ["doctor", "--json", "--config", "robot.toml"];
    let check = |expected: &str| {
        let report = object_of_failure(folder.path(), &words);
        let checks = report["checks"].as_array().unwrap();
        assert_eq!(checks.len(), 1, "{report}");
        assert_eq!(checks[0]["name"], "configuration", "{report}");
        assert_eq!(checks[0]["holds"], false, "{report}");
        let said = checks[0]["text"].as_str().unwrap();
        assert!(said.contains(expected), "{expected}: {said}");
        assert_eq!(report["robot_toml"], "", "{report}");
    };
    check("the configuration `robot.toml` cannot be read");
    for (text, expected) in cases {
        std::fs::write(folder.path().join("robot.toml"), text).unwrap();
        check(expected);
    }
}

#[test]
fn a_record_that_cannot_be_recovered_is_said_in_json_too() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("no.mcap"), b"no record").unwrap();
    for (file, expected) in [
        ("gone.mcap", "cannot be read: No such file"),
        ("no.mcap", "nothing can be recovered"),
    ] {
        let words = ["recover", file, "--into", "whole.mcap", "--json"];
        let object = object_of_failure(folder.path(), &words);
        let said = object["refused"].as_str().unwrap();
        assert!(said.contains(expected), "{said}");
    }
}
