//! No source file is long without a reason: see `long-files.txt`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use tread_tests::repository::{files, root};

/// Most lines of a file that needs no reason.
const LINES_MAX: usize = 500;
/// Ends of the names of sources.
const SOURCES: [&str; 5] = ["rs", "ts", "svelte", "py", "mjs"];
/// Folders and files that programs write.
const WRITTEN: [&str; 2] = ["dist", "schema.d.ts"];

fn is_source(name: &str) -> bool {
    let end = Path::new(name).extension().and_then(|end| end.to_str());
    let is_written = name.split('/').any(|part| WRITTEN.contains(&part));
    !is_written && end.is_some_and(|end| SOURCES.contains(&end))
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
