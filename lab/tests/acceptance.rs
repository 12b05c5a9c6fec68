//! `acceptance` runs the report programs and summarises what they print.

#![cfg(unix)]

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

/// Programs in place of the report programs.
fn folder_with(programs: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, script) in programs {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        fs::write(&path, format!("#!/bin/sh\n{script}\n")).expect("a script");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).expect("a program");
    }
    folder
}

fn acceptance(folder: &Path, arguments: &[&str]) -> Output {
    let mut program = Command::new(env!("CARGO_BIN_EXE_acceptance"));
    program.arg("--programs").arg(folder).args(arguments);
    program.output().expect("it runs")
}

const REACHED: &str = r#"echo '{"checks": [
  {"name": "a: ours over the best peer", "goal": "≤ 1.02", "value": 0.9, "holds": true},
  {"name": "a: with its own θ over without", "goal": "≤ 1.02", "value": 1.0, "holds": true},
  {"name": "mean", "goal": "≤ 0.9", "value": 0.7, "holds": true}]}'"#;
const MISSED: &str =
    r#"echo '{"checks": [{"name": "b", "goal": "≤ 40", "value": null, "holds": false}]}'; exit 1"#;

#[test]
fn checks_of_all_programs_are_in_one_object_and_one_that_fails_decides() {
    let folder = folder_with(&[("tracking", REACHED), ("examples/cost", MISSED)]);
    let reports = folder.path().join("reports");
    let to = reports.to_str().expect("a path");
    let reached = acceptance(
        folder.path(),
        &["--only", "tracking", "--reports", to, "--json"],
    );
    let kept = fs::read_to_string(reports.join("tracking.json")).expect("a report");
    assert!(kept.contains("\"value\": 0.9"), "{kept}");
    assert!(reached.status.success(), "{reached:?}");
    let object: Value = serde_json::from_slice(&reached.stdout).expect("an object");
    let checks = object["checks"].as_array().expect("checks");
    assert_eq!(checks[0]["name"], "tracking: a: ours over the best peer");
    assert!(
        checks.last().expect("a check")["name"]
            .as_str()
            .is_some_and(|name| name.starts_with("minutes on"))
    );
    let requirements = object["requirements"].as_array().expect("requirements");
    let reached = requirements
        .iter()
        .map(|one| one["reached"].as_u64().unwrap_or_default());
    assert_eq!(reached.sum::<u64>(), 3);
    let again = acceptance(folder.path(), &["--only", "tracking", "--summarise", to]);
    let text = String::from_utf8_lossy(&again.stdout);
    assert!(
        again.status.success() && !text.contains("minutes"),
        "{again:?}"
    );
    let missed = acceptance(folder.path(), &["--only", "cost", "--markdown"]);
    assert_eq!(missed.status.code(), Some(1));
    let text = String::from_utf8_lossy(&missed.stdout);
    assert!(text.contains("| cost: b | ≤ 40 | none | FAILS |"), "{text}");
}

#[test]
fn a_program_that_is_not_built_is_named_before_any_runs() {
    let folder = folder_with(&[("examples/cost", "echo ran >&2")]);
    let output = acceptance(folder.path(), &[]);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        !output.status.success() && !errors.contains("ran"),
        "{errors}"
    );
    assert!(
        errors.contains("rough is missing: build it with `cargo build"),
        "{errors}"
    );
}

#[test]
fn a_program_that_fails_is_a_check_that_does_not_hold() {
    let failures = [
        ("exit 3", "ended with"),
        ("echo {}", "printed no report"),
        (r#"echo '{"checks": []}'"#, "checked nothing"),
    ];
    for (script, expected) in failures {
        let folder = folder_with(&[("tracking", script)]);
        let output = acceptance(folder.path(), &["--only", "tracking", "--json"]);
        assert_eq!(output.status.code(), Some(1), "{output:?}");
        let object: Value = serde_json::from_slice(&output.stdout).expect("an object");
        let first = &object["checks"][0];
        let name = first["name"].as_str().expect("a name");
        assert!(name.contains(expected) && first["holds"] == false, "{name}");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(errors.contains("not reached: tracking: "), "{errors}");
    }
}
