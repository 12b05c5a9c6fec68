//! A database file that a command writes under another name until it is complete.

use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};

/// Suffixes of SQLite's files beside a database.
pub(super) const SQLITE_SUFFIXES: [&str; 3] = ["-wal", "-shm", "-journal"];

/// Returns a path with a suffix.
pub(super) fn with_ending(path: &Path, ending: &str) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(ending);
    name.into()
}

/// A file under its temporary name; removed on drop unless it got its own.
pub(super) struct Unfinished {
    path: PathBuf,
    is_finished: bool,
}

impl Unfinished {
    /// Names the file by a suffix, and removes what an interrupted command left of it.
    ///
    /// # Errors
    /// It cannot be removed.
    pub(super) fn begin(database: &Path, ending: &str) -> anyhow::Result<Self> {
        let unfinished = Self {
            path: with_ending(database, ending),
            is_finished: false,
        };
        let removed = unfinished.remove();
        removed.with_context(|| format!("cannot remove `{}`", unfinished.path.display()))?;
        Ok(unfinished)
    }

    /// Returns its temporary name.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Checks that the file is complete without a log beside it. SQLite removes the log when the last
    /// connection closes.
    ///
    /// # Errors
    /// A connection is open.
    pub(super) fn check_closed(&self) -> anyhow::Result<()> {
        for ending in SQLITE_SUFFIXES {
            let beside = with_ending(&self.path, ending);
            ensure!(!beside.exists(), "`{}` is still in use", beside.display());
        }
        Ok(())
    }

    /// Gives it its name.
    ///
    /// # Errors
    /// It cannot be renamed.
    pub(super) fn finish(mut self, database: &Path) -> anyhow::Result<()> {
        let renamed = fs::rename(&self.path, database);
        renamed.with_context(|| format!("cannot write `{}`", database.display()))?;
        self.is_finished = true;
        Ok(())
    }

    /// Gives it its name, which no file may have.
    ///
    /// # Errors
    /// There is a file of that name, or a log of one, or it cannot be written.
    pub(super) fn finish_new(self, database: &Path) -> anyhow::Result<()> {
        check_absent(database)?;
        // Unlike a rename, it replaces no file that was created meanwhile.
        let linked = fs::hard_link(&self.path, database);
        linked.with_context(|| format!("cannot write `{}`", database.display()))
    }

    fn remove(&self) -> io::Result<()> {
        for ending in SQLITE_SUFFIXES.into_iter().chain([""]) {
            remove_if_there(&with_ending(&self.path, ending))?;
        }
        Ok(())
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        if !self.is_finished {
            // The next command removes files that remain.
            let _ = self.remove();
        }
    }
}

/// Checks that neither the file of a new database exists, nor a log or lock file of SQLite with its name:
/// SQLite would treat such a file as one of the new database.
///
/// # Errors
/// One of these files exists.
pub(super) fn check_absent(database: &Path) -> anyhow::Result<()> {
    for ending in SQLITE_SUFFIXES.into_iter().chain([""]) {
        let file = with_ending(database, ending);
        ensure!(
            file.symlink_metadata().is_err(),
            "`{}` exists already: name a file that does not, or move it aside first, with all files whose names \
             begin so",
            file.display()
        );
    }
    Ok(())
}

fn remove_if_there(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        Ok(()) | Err(_) => Ok(()),
    }
}
