//! The files of this repository, for tests that read them.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The repository's root: of the clone in which cargo runs the test. With a target folder that
/// clones share, it may have been compiled in another one.
///
/// # Panics
/// Outside of cargo.
pub fn root() -> PathBuf {
    let tests = std::env::var_os("CARGO_MANIFEST_DIR").expect("cargo runs this and says where");
    let tests = Path::new(&tests);
    tests.parent().unwrap_or(tests).to_owned()
}

/// Every file that belongs to the repository, by its path from the root: what git tracks, and what
/// is new and not ignored.
///
/// # Panics
/// Without git.
pub fn files() -> BTreeSet<String> {
    let listed = Command::new("git")
        .args(["ls-files", "--cached", "--others", "--exclude-standard"])
        .current_dir(root())
        .output()
        .expect("git can be started");
    assert!(listed.status.success(), "git lists no files: {listed:?}");
    let names = String::from_utf8(listed.stdout).expect("paths are texts");
    let names = names.lines().filter(|name| root().join(name).exists());
    names.map(str::to_owned).collect()
}
