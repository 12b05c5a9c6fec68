//! Every block of Python in the documentation parses, and its page names the packages that it imports.
//!
//! Without `python3` nothing of this is checked. The tests say so, and so does `./check`, which hides
//! what a passing test says.

use std::fmt::Write as _;
use std::io::{self, ErrorKind, Write as _};
use std::process::{Command, Stdio};

use tread_tests::markdown::{Document, documents};

/// Minimum number of blocks of Python; with fewer, the documentation was not found.
const BLOCKS_MIN: usize = 3;
/// Parses a source from standard input, and prints the top-level modules that it imports and that are
/// not of the standard library.
const IMPORTS: &str = r#"
import ast, sys
if sys.version_info < (3, 10):
    sys.exit("Python 3.10 or newer is needed: older ones do not say what their standard library has")
found = set()
for node in ast.walk(ast.parse(sys.stdin.read())):
    if isinstance(node, ast.Import):
        found.update(name.name.split(".")[0] for name in node.names)
    elif isinstance(node, ast.ImportFrom) and node.level == 0:
        found.add(node.module.split(".")[0])
print("\n".join(sorted(found - sys.stdlib_module_names)))
"#;
/// Modules whose package has another name, with the package.
const PACKAGES: [(&str, &str); 2] = [
    ("mcap_ros2", "mcap-ros2-support"),
    ("zenoh", "eclipse-zenoh"),
];

/// Returns the modules that a source imports, or why it does not parse.
fn imports(source: &str) -> io::Result<Result<Vec<String>, String>> {
    let mut python = Command::new("python3")
        .args(["-X", "utf8", "-c", IMPORTS])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let mut input = python.stdin.take().unwrap();
    input.write_all(source.as_bytes())?;
    drop(input);
    let ended = python.wait_with_output()?;
    if !ended.status.success() {
        let said = String::from_utf8_lossy(&ended.stderr);
        let last = said.trim_end().lines().last().unwrap_or("python3 failed");
        return Ok(Err(last.to_owned()));
    }
    let printed = String::from_utf8_lossy(&ended.stdout);
    Ok(Ok(printed.split_whitespace().map(str::to_owned).collect()))
}

/// Returns whether code within the page's sentences names a package.
fn names(document: &Document, package: &str) -> bool {
    let mut words = document
        .codes
        .iter()
        .flat_map(|code| code.text.split_whitespace());
    words.any(|word| word == package)
}

/// Returns the number of blocks of Python in a document, and what is wrong with them.
fn faults(document: &Document) -> io::Result<(usize, String)> {
    let (mut count, mut faults) = (0, String::new());
    let blocks = document.blocks.iter();
    for block in blocks.filter(|block| block.language == "python") {
        count += 1;
        let place = format!("{}:{}", document.name, block.line);
        let modules = match imports(&block.text)? {
            Ok(modules) => modules,
            Err(refused) => {
                let _ = writeln!(faults, "{place}: this is no Python: {refused}");
                continue;
            }
        };
        for module in modules {
            let renamed = PACKAGES.iter().find(|(name, _)| *name == module);
            let package = renamed.map_or(module.as_str(), |&(_, package)| package);
            if !names(document, package) {
                let _ = writeln!(
                    faults,
                    "{place}: imports `{module}`, but the page does not name the package `{package}`"
                );
            }
        }
    }
    Ok((count, faults))
}

/// Returns what Python was asked for; `None`, said on standard error, without `python3`.
fn if_python_is_there<T>(asked: io::Result<T>) -> Option<T> {
    match asked {
        Err(failed) if failed.kind() == ErrorKind::NotFound => {
            eprintln!(
                "NOT CHECKED: the Python blocks of the documentation, for python3 is missing"
            );
            None
        }
        asked => Some(asked.unwrap()),
    }
}

#[test]
fn every_python_block_parses_and_its_page_names_the_packages_that_it_imports() {
    let found: io::Result<Vec<(usize, String)>> = documents().iter().map(faults).collect();
    let Some(found) = if_python_is_there(found) else {
        return;
    };
    let count: usize = found.iter().map(|(count, _)| count).sum();
    let faults: String = found.into_iter().map(|(_, faults)| faults).collect();
    assert!(count >= BLOCKS_MIN, "{count} blocks of Python");
    assert!(faults.is_empty(), "\n{faults}");
}

#[test]
fn python_that_does_not_parse_or_imports_an_unnamed_package_is_found() {
    for (text, expected) in [
        ("```python\nimport json\n```\n", ""),
        (
            "Install `pip install eclipse-zenoh`.\n\n```python\nimport zenoh\n```\n",
            "",
        ),
        (
            "```python\nimport zenoh.ext\n```\n",
            "a.md:1: imports `zenoh`, but the page does not name the package `eclipse-zenoh`\n",
        ),
        (
            "```python\nfrom rosbags.highlevel import AnyReader\n```\n",
            "a.md:1: imports `rosbags`, but the page does not name the package `rosbags`\n",
        ),
    ] {
        let Some((count, faults)) = if_python_is_there(faults(&Document::read("a.md", text)))
        else {
            return;
        };
        assert_eq!((count, faults.as_str()), (1, expected), "{text}");
    }
    let broken = Document::read("a.md", "```python\nprint(\n```\n");
    if let Some((_, faults)) = if_python_is_there(faults(&broken)) {
        assert!(
            faults.contains("this is no Python: SyntaxError"),
            "{faults}"
        );
    }
}
