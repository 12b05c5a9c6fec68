//! No source file is long without a reason: see `long-files.txt`. Some pages of the documentation
//! stay short.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use tread_tests::repository::{files, root};

/// Most lines of a file that needs no reason.
const LINES_MAX: usize = 500;
/// Page of the accuracy, and its most lines.
const ACCURACY: (&str, usize) = ("docs/accuracy.md", 150);
/// Begin of the names of decisions: one page each.
const DECISIONS: &str = "docs/decisions/0";
/// Most lines of a decision.
const DECISION_LINES_MAX: usize = 66;
/// Ends of the names of sources.
const SOURCES: [&str; 5] = ["rs", "ts", "svelte", "py", "mjs"];
/// Folders and files that programs write.
const WRITTEN: [&str; 2] = ["dist", "schema.d.ts"];

fn is_source(name: &str) -> bool {
    let end = Path::new(name).extension().and_then(|end| end.to_str());
    let is_written = name.split('/').any(|part| WRITTEN.contains(&part));
    !is_written && end.is_some_and(|end| SOURCES.contains(&end))
}

/// Returns the most lines of a page of the documentation, if it has a limit.
fn page_lines_max(name: &str) -> Option<usize> {
    let (accuracy, lines_max) = ACCURACY;
    let is_decision = name.starts_with(DECISIONS);
    (name == accuracy)
        .then_some(lines_max)
        .or_else(|| is_decision.then_some(DECISION_LINES_MAX))
}

#[test]
fn pages_with_a_limit_stay_short() {
    let mut faults = String::new();
    let mut limited = 0_u32;
    for name in files() {
        let Some(lines_max) = page_lines_max(&name) else {
            continue;
        };
        limited += 1;
        let text = fs::read_to_string(root().join(&name)).expect("a page is text");
        let lines = text.lines().count();
        if lines > lines_max {
            let _ = writeln!(faults, "{name}: {lines} lines, at most {lines_max}");
        }
    }
    assert!(limited > 20, "the pages are here");
    assert!(faults.is_empty(), "\n{faults}");
}

#[test]
fn a_long_file_has_a_reason() {
    let root = root();
    let listed = fs::read_to_string(root.join("tests/long-files.txt")).expect("the list");
    let mut reasons: BTreeMap<&str, &str> = listed
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| line.split_once('\t').expect("a file, a tab, a reason"))
        .collect();
    assert!(reasons.values().all(|reason| reason.len() > 20));
    let mut faults = String::new();
    let names: Vec<String> = files().into_iter().filter(|name| is_source(name)).collect();
    assert!(names.len() > 400, "the sources are here");
    for name in names {
        let text = fs::read_to_string(root.join(&name)).unwrap();
        let lines = text.lines().count();
        if lines > LINES_MAX && reasons.remove(&*name).is_none() {
            let _ = writeln!(faults, "{name}: {lines} lines and no reason");
        }
    }
    for (name, _) in reasons {
        let _ = writeln!(faults, "{name}: a reason, and it is not long");
    }
    assert!(faults.is_empty(), "\n{faults}");
}
