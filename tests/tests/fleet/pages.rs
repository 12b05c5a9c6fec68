//! What the page on safety says of tests is so.

use std::path::Path;

/// All test sources below a folder, one after the other.
fn sources(folder: &Path, text: &mut String) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            if name != "target" && !name.starts_with('.') && name != "node_modules" {
                sources(&path, text);
            }
        } else if path.extension().is_some_and(|kind| kind == "rs") {
            text.push_str(&std::fs::read_to_string(&path).unwrap());
        }
    }
}

#[test]
fn every_test_that_the_page_on_safety_names_is_there() {
    // Asked now: a test that was compiled elsewhere knows another folder.
    let tests = std::env::var_os("CARGO_MANIFEST_DIR").unwrap();
    let root = Path::new(&tests).parent().unwrap();
    let page = std::fs::read_to_string(root.join("docs/safety.md")).unwrap();
    let mut code = String::new();
    for part in [
        "api",
        "cli",
        "control",
        "lab",
        "robot-agent",
        "server",
        "tests",
    ] {
        sources(&root.join(part), &mut code);
    }
    let tables = page
        .split("## What stops a robot, and which test shows it")
        .nth(1);
    let rows: Vec<&str> = tables
        .unwrap()
        .lines()
        .filter(|line| line.starts_with("| ") && line.contains('`'))
        .collect();
    assert!(rows.len() > 25, "the table has lost its rows");
    for row in rows {
        let last = row.trim_end_matches(" |").rsplit(" | ").next().unwrap();
        let named: Vec<&str> = last.split('`').skip(1).step_by(2).collect();
        assert!(!named.is_empty(), "no test: {row}");
        for name in named {
            let is_there = name.starts_with("cargo run ") || code.contains(&format!("fn {name}("));
            assert!(is_there, "no test is called `{name}`");
        }
    }
}
