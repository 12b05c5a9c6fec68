//! Every link of the documentation leads somewhere, and every path that it names is there.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Component, Path, PathBuf};

use tread_tests::markdown::{Document, documents};
use tread_tests::repository::{files, root};

/// Fewest links and paths that are looked at; with less, the documentation was not found.
const LOOKED_AT_MIN: usize = 100;
/// Ends of the names of files that only this repository has; a path that ends like this is one of it.
const SOURCES: [&str; 8] = ["rs", "ts", "svelte", "py", "mjs", "md", "yml", "sql"];
/// What begins like a path of this repository and is a key of zenoh.
const KEYS: [&str; 5] = [
    "server/**",
    "server/hello",
    "server/ingest",
    "server/map",
    "server/pulse",
];

/// The table of contents of the book, which stands in the root when the book is made.
const CONTENTS: &str = "book/SUMMARY.md";

/// Where `to` leads from a document, as a path from the root; `None` out of the repository.
fn resolved(document: &Document, to: &str) -> Option<String> {
    let folder = match document.name.as_str() {
        CONTENTS => Path::new(""),
        name => Path::new(name).parent().unwrap_or(Path::new("")),
    };
    let mut path = PathBuf::new();
    for part in folder.join(to).components() {
        match part {
            Component::ParentDir => {
                if !path.pop() {
                    return None;
                }
            }
            Component::Normal(name) => path.push(name),
            Component::CurDir => {}
            Component::RootDir | Component::Prefix(_) => return None,
        }
    }
    Some(path.display().to_string())
}

/// What is wrong with a link.
fn fault_of_link(
    document: &Document,
    documents: &BTreeMap<&str, &Document>,
    to: &str,
) -> Option<String> {
    if to.contains("://") || to.starts_with("mailto:") {
        let parsed = reqwest::Url::parse(to);
        return parsed
            .err()
            .map(|refused| format!("`{to}` is no address: {refused}"));
    }
    let (path, anchor) = match to.split_once('#') {
        Some((path, anchor)) => (path, Some(anchor)),
        None => (to, None),
    };
    let target = match path {
        "" => document.name.clone(),
        path => match resolved(document, path) {
            Some(target) if root().join(&target).exists() => target,
            _ => return Some(format!("`{to}`: there is no such file")),
        },
    };
    let anchor = anchor?;
    let Some(page) = documents.get(target.as_str()) else {
        return Some(format!("`{to}`: only pages have anchors"));
    };
    (!page.anchors.contains(anchor)).then(|| format!("`{to}`: there is no such heading"))
}

/// Whether some code looks like a path of this repository.
fn is_path(code: &str, top: &[&str]) -> bool {
    let plain = |letter: char| letter.is_ascii_alphanumeric() || "_-./".contains(letter);
    if code.is_empty() || !code.chars().all(plain) || KEYS.contains(&code) {
        return false;
    }
    if let Some((first, _)) = code.split_once('/')
        && top.contains(&first)
    {
        return true;
    }
    let end = Path::new(code).extension().and_then(|end| end.to_str());
    !code.starts_with(['/', '.']) && end.is_some_and(|end| SOURCES.contains(&end))
}

#[test]
fn every_link_and_every_path_of_the_documentation_leads_somewhere() {
    let (documents, files) = (documents(), files());
    let by_name: BTreeMap<&str, &Document> = documents
        .iter()
        .map(|document| (document.name.as_str(), document))
        .collect();
    let mut top: Vec<&str> = files
        .iter()
        .filter_map(|file| Some(file.split_once('/')?.0))
        .collect();
    top.dedup();
    // A path may leave out the folders before it, and may be a folder.
    let is_there = |path: &str| {
        let path = path.trim_end_matches('/');
        let (behind, within) = (format!("/{path}"), format!("/{path}/"));
        root().join(path).exists()
            || files
                .iter()
                .any(|file| file.ends_with(&behind) || file.contains(&within))
    };
    let (mut faults, mut looked_at) = (String::new(), 0);
    for document in &documents {
        let name = &document.name;
        for link in &document.links {
            looked_at += 1;
            if let Some(fault) = fault_of_link(document, &by_name, &link.text) {
                let _ = writeln!(faults, "{name}:{}: {fault}", link.line);
            }
        }
        for code in &document.codes {
            if !is_path(&code.text, &top) {
                continue;
            }
            looked_at += 1;
            if !is_there(&code.text) {
                let _ = writeln!(
                    faults,
                    "{name}:{}: `{}` is not in the repository",
                    code.line, code.text
                );
            }
        }
    }
    assert!(faults.is_empty(), "\n{faults}");
    assert!(looked_at >= LOOKED_AT_MIN, "only {looked_at} were found");
}

#[test]
fn a_link_that_leads_nowhere_is_found() {
    let pages = [
        Document::read("README.md", "# Top\n"),
        Document::read("docs/a.md", "# First part\n"),
    ];
    let by_name: BTreeMap<&str, &Document> = pages
        .iter()
        .map(|page| (page.name.as_str(), page))
        .collect();
    let fault = |to: &str| fault_of_link(&pages[1], &by_name, to);
    for good in [
        "#first-part",
        "../README.md#top",
        "https://example.org/x#y",
        "../check",
    ] {
        assert_eq!(fault(good), None, "{good}");
    }
    for bad in [
        "#second-part",
        "../README.md#nowhere",
        "missing.md",
        "../../outside.md",
        "https://",
        "../check#L1",
    ] {
        assert!(fault(bad).is_some(), "{bad}");
    }
    let top = ["server", "docs"];
    assert!(is_path("server/src/gone.rs", &top) && is_path("tests/gone.py", &top));
    for other in [
        "server/pulse",
        "/v1/sites",
        "robot.toml",
        "tread/{site}/x",
        "a/b",
    ] {
        assert!(!is_path(other, &top), "{other}");
    }
}
