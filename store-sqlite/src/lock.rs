//! Lock of a database: allows one server at a time.
//!
//! SQLite lets any number of processes share a file, but a server keeps the map in memory and alone
//! decides what its robots do. The lock is on a file beside the database and is released when its
//! process ends, in whatever way. Programs that only read or repair (`init`, a backup, a check) do
//! not take it.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read as _, Seek as _, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use super::failure::advice_on;

/// List of all locks on files of this machine.
const LOCKS_FILE: &str = "/proc/locks";
/// Suffix of the lock file's name, after that of the database.
const LOCK_ENDING: &str = ".lock";
/// Maximum number of symbolic links followed: as many as Linux follows.
const LINKS_MAX: u32 = 40;
/// Maximum number of bytes read from the lock file.
const HOLDER_BYTES_MAX: u64 = 32;

/// Reason why a server may not use a database.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another server uses it.
    #[error(
        "the database `{}` is used by another server{holder}: stop that one first, or give this \
         one a database of its own", path.display()
    )]
    InUse {
        /// The database.
        path: PathBuf,
        /// ` (process N)`, or empty if the process is not known.
        holder: String,
    },
    /// The file has several hard links. SQLite's log is beside only one of them, so a process that
    /// opens another one damages the database.
    #[error(
        "the database `{}` has {names} names (hard links), which damages it when it is used by \
         two of them: remove the others, and copy it with `VACUUM INTO` instead", path.display()
    )]
    HardLinks {
        /// The database.
        path: PathBuf,
        /// Number of its hard links.
        names: u64,
    },
    /// The path is that of a folder.
    #[error(
        "the database `{}` is a folder: give a file in it, such as `{}`",
        path.display(), path.join("tread.db").display()
    )]
    Folder {
        /// The folder.
        path: PathBuf,
    },
    /// The lock file cannot be created.
    #[error("cannot lock the database with `{}`: {}", path.display(), advice_on(source))]
    File {
        /// The lock file.
        path: PathBuf,
        /// Error of the operating system.
        #[source]
        source: io::Error,
    },
}

/// Exclusive use of a database by this process, until it is dropped.
#[derive(Debug)]
pub struct DatabaseLock {
    _file: File,
}

impl DatabaseLock {
    /// Locks a database, which may not exist yet.
    ///
    /// # Errors
    /// [`LockError::InUse`] names the process that holds the lock; [`LockError::HardLinks`]; or
    /// [`LockError::File`].
    pub fn take(database: &Path) -> Result<Self, LockError> {
        let there = fs::metadata(database);
        if there.as_ref().is_ok_and(fs::Metadata::is_dir) {
            return Err(LockError::Folder {
                path: database.to_owned(),
            });
        }
        let names = there.map_or(1, |there| there.nlink());
        if names > 1 {
            return Err(LockError::HardLinks {
                path: database.to_owned(),
                names,
            });
        }
        let path = lock_path(database);
        let failed = |source| LockError::File {
            path: path.clone(),
            source,
        };
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            // Any user who could open the file could lock it.
            .mode(0o600)
            .open(&path)
            .map_err(failed)?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(LockError::InUse {
                    path: database.to_owned(),
                    holder: holder(&mut file),
                });
            }
            Err(TryLockError::Error(source)) => return Err(failed(source)),
        }
        // The content is only for the error message; on a full disk the lock holds without it.
        let _ = file
            .set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| writeln!(file, "{}", std::process::id()));
        Ok(Self { _file: file })
    }
}

/// Returns the process of the server that holds a database's lock; `None` if none does, or the
/// operating system does not tell. Takes no lock, so that it disturbs no server that starts.
pub fn holder_of(database: &Path) -> Option<u32> {
    let found = fs::metadata(lock_path(database)).ok()?;
    let locks = fs::read_to_string(LOCKS_FILE).ok()?;
    let inode = found.ino().to_string();
    locks.lines().find_map(|line| {
        // `1: FLOCK  ADVISORY  WRITE 4711 08:02:1234567 0 EOF`
        let words: Vec<&str> = line.split_whitespace().collect();
        let [_, "FLOCK", _, "WRITE", process, file, ..] = words[..] else {
            return None;
        };
        let is_this = file.rsplit(':').next() == Some(inode.as_str());
        is_this.then(|| process.parse().ok()).flatten()
    })
}

/// Returns the path beside the file itself, after following links, also if it does not exist yet.
fn lock_path(database: &Path) -> PathBuf {
    let file = behind_links(database);
    let folder = file.parent().filter(|it| !it.as_os_str().is_empty());
    let folder = fs::canonicalize(folder.unwrap_or(Path::new(".")));
    let file = match (folder, file.file_name()) {
        (Ok(folder), Some(name)) => folder.join(name),
        (Ok(_) | Err(_), _) => file,
    };
    let mut name = file.into_os_string();
    name.push(OsString::from(LOCK_ENDING));
    PathBuf::from(name)
}

/// Returns the target of a chain of symbolic links.
fn behind_links(path: &Path) -> PathBuf {
    let mut path = path.to_owned();
    for _ in 0..LINKS_MAX {
        let Ok(target) = fs::read_link(&path) else {
            break;
        };
        let folder = path.parent().unwrap_or(Path::new(""));
        path = folder.join(target);
    }
    path
}

fn holder(file: &mut File) -> String {
    let mut text = String::new();
    let read = file.take(HOLDER_BYTES_MAX).read_to_string(&mut text);
    match text.trim().parse::<u32>() {
        Ok(process) if read.is_ok() => format!(" (process {process})"),
        Ok(_) | Err(_) => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_server_is_refused_by_every_name_of_the_file_until_the_first_is_gone() {
        let folder = tempfile::tempdir().unwrap();
        let database = folder.path().join("tread.db");
        assert_eq!(holder_of(&database), None);
        let first = DatabaseLock::take(&database).unwrap();
        assert_eq!(holder_of(&database), Some(std::process::id()));
        let refused = DatabaseLock::take(&database).unwrap_err().to_string();
        let own = format!("(process {})", std::process::id());
        assert!(
            refused.contains("tread.db") && refused.contains(&own),
            "{refused}"
        );
        fs::write(&database, "").unwrap();
        let link = folder.path().join("other.db");
        std::os::unix::fs::symlink(&database, &link).unwrap();
        assert!(DatabaseLock::take(&link).is_err());
        drop(first);
        DatabaseLock::take(&link).unwrap();
        let refused = DatabaseLock::take(folder.path()).unwrap_err().to_string();
        assert!(refused.contains("is a folder"), "{refused}");
    }

    #[test]
    fn a_link_to_a_database_that_does_not_exist_yet_leads_to_its_lock() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("deep")).unwrap();
        let database = folder.path().join("deep/tread.db");
        let (link, further) = (folder.path().join("link.db"), folder.path().join("more.db"));
        std::os::unix::fs::symlink("deep/tread.db", &link).unwrap();
        std::os::unix::fs::symlink(&link, &further).unwrap();
        let by_link = DatabaseLock::take(&further).unwrap();
        assert!(DatabaseLock::take(&database).is_err());
        assert!(DatabaseLock::take(&link).is_err());
        drop(by_link);
        DatabaseLock::take(&database).unwrap();
        // A link to itself must not cause an endless search.
        let round = folder.path().join("round.db");
        std::os::unix::fs::symlink(&round, &round).unwrap();
        assert!(DatabaseLock::take(&round).is_ok());
    }

    #[test]
    fn a_database_with_two_names_is_refused_by_both() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (folder.path().join("one.db"), folder.path().join("two.db"));
        fs::write(&first, "").unwrap();
        let held = DatabaseLock::take(&first).unwrap();
        fs::hard_link(&first, &second).unwrap();
        for name in [&first, &second] {
            let refused = DatabaseLock::take(name).unwrap_err().to_string();
            assert!(refused.contains("2 names"), "{refused}");
        }
        drop(held);
        fs::remove_file(&first).unwrap();
        DatabaseLock::take(&second).unwrap();
    }

    #[test]
    fn a_lock_in_a_missing_folder_names_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let error = DatabaseLock::take(&folder.path().join("nowhere/tread.db")).unwrap_err();
        assert!(
            error.to_string().contains("nowhere/tread.db.lock"),
            "{error}"
        );
    }
}
