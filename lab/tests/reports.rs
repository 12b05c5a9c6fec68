//! Report programs print the same figures for programs, for pages and for people.

#![cfg(feature = "agent")]

use std::process::Command;

use serde_json::Value;

fn rough(form: &[&str]) -> String {
    let mut program = Command::new(env!("CARGO_BIN_EXE_rough"));
    program
        .args(["--runs", "1", "--only", "nothing"])
        .args(form);
    let output = program.output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.code().is_some_and(|code| code < 2),
        "{errors}"
    );
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn the_table_of_a_page_has_the_lines_and_checks_of_the_json_object() {
    let object: Value = serde_json::from_str(&rough(&["--json"])).unwrap();
    let (markdown, words) = (rough(&["--markdown"]), rough(&[]));
    let lines = object["lines"].as_array().unwrap();
    assert_eq!(lines.len(), 2, "with and without torque: {object}");
    for line in lines {
        let coverage = format!("{:.1} %", 100.0 * line["coverage"].as_f64().unwrap());
        let torque = if line["has_torque"] == true {
            "yes"
        } else {
            "no"
        };
        let begin = format!(
            "| nothing | {torque} | {} | {coverage} |",
            line["estimates"]
        );
        assert!(markdown.contains(&begin), "{begin} in {markdown}");
        assert!(words.contains(&coverage), "{coverage} in {words}");
    }
    for check in object["checks"].as_array().unwrap() {
        let begin = format!("| {} | {} |", check["name"], check["goal"]).replace('"', "");
        assert!(markdown.contains(&begin), "{begin} in {markdown}");
    }
}

#[test]
fn two_forms_at_once_are_refused() {
    let mut program = Command::new(env!("CARGO_BIN_EXE_rough"));
    let output = program.args(["--json", "--markdown"]).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        !output.status.success() && errors.contains("--markdown"),
        "{errors}"
    );
}
