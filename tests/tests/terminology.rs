//! Words that are nobody's terms stay out of code, API, documentation and page: see
//! `terminology.txt`, and `GLOSSARY.md` for the terms.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use regex::Regex;
use tread_tests::repository::{files, root};

/// Most exceptions.
const EXCEPTIONS_MAX: usize = 20;
/// Ends of the names of files that people read.
const READ: [&str; 10] = [
    "rs", "ts", "svelte", "md", "toml", "json", "py", "mjs", "sh", "yml",
];
/// Folders and files that are made by programs, that must stay as they were, or that name the words.
const SKIPPED: [&str; 9] = [
    ".sqlx",
    "dist",
    "migrations",
    "node_modules",
    "package-lock.json",
    "samples",
    "schema.d.ts",
    "terminology.rs",
    "terminology-exceptions.txt",
];

fn is_read(name: &str) -> bool {
    let end = Path::new(name).extension().and_then(|end| end.to_str());
    let is_skipped = name.split('/').any(|part| SKIPPED.contains(&part));
    !is_skipped && end.is_some_and(|end| READ.contains(&end))
}

/// The lines of a list: its columns.
fn columns(file: &str) -> Vec<Vec<String>> {
    let text = fs::read_to_string(root().join("tests").join(file)).expect("the list");
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines
        .map(|line| line.split('\t').map(str::to_owned).collect())
        .collect()
}

#[test]
fn words_that_are_no_terms_do_not_come_back() {
    let patterns: Vec<(Regex, String)> = columns("terminology.txt")
        .into_iter()
        .map(|columns| (Regex::new(&columns[0]).unwrap(), columns[1].clone()))
        .collect();
    let exceptions = columns("terminology-exceptions.txt");
    assert!(exceptions.len() <= EXCEPTIONS_MAX);
    let mut unused: Vec<bool> = vec![true; exceptions.len()];
    let root = root();
    let mut faults = String::new();
    let names: Vec<String> = files().into_iter().filter(|name| is_read(name)).collect();
    assert!(names.len() > 500, "the sources are here");
    for name in names {
        let text = fs::read_to_string(root.join(&name)).unwrap();
        for (number, line) in text.lines().enumerate() {
            for (pattern, instead) in &patterns {
                let Some(word) = pattern.find(line) else {
                    continue;
                };
                let excepted = exceptions
                    .iter()
                    .position(|exception| exception[0] == name && line.contains(&exception[1]));
                if let Some(excepted) = excepted {
                    unused[excepted] = false;
                    continue;
                }
                let _ = writeln!(
                    faults,
                    "{name}:{}: `{}`: say {instead}",
                    number + 1,
                    word.as_str()
                );
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
    let idle = exceptions
        .iter()
        .zip(&unused)
        .filter(|(_, unused)| **unused);
    let idle: Vec<_> = idle.map(|(exception, _)| exception.join(" ")).collect();
    assert!(idle.is_empty(), "exceptions that nothing needs: {idle:#?}");
}
