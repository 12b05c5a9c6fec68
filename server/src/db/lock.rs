//! The lock of a database: one server at a time.
//!
//! SQLite lets any number of processes share a file, but a server keeps the map in memory and
//! decides by itself what its robots do. The lock is held on a file beside the database and goes
//! with its process, however that ends. What only reads or repairs (`init`, a backup, a check)
//! does not take it.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read as _, Seek as _, Write as _};
use std::path::{Path, PathBuf};

/// What is added to the name of the database.
const LOCK_ENDING: &str = ".lock";
/// Most bytes that are read of whom holds the lock.
const HOLDER_BYTES_MAX: u64 = 32;

/// Why a server may not use a database.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another server is at work on it.
    #[error(
        "the database `{}` is used by another server{holder}: stop that one first, or give this \
         one a database of its own", path.display()
    )]
    InUse {
        /// Which database.
        path: PathBuf,
        /// ` (process N)`, if it is known.
        holder: String,
    },
    /// The lock's file cannot be made.
    #[error("cannot lock the database with `{}`", path.display())]
    File {
        /// Which file.
        path: PathBuf,
        /// What the operating system said.
        #[source]
        source: io::Error,
    },
}

/// A database that is this process's alone, until it is dropped.
#[derive(Debug)]
pub struct DatabaseLock {
    _file: File,
}

impl DatabaseLock {
    /// Locks a database, which need not exist yet.
    ///
    /// # Errors
    /// [`LockError::InUse`] names the process that has it.
    pub fn take(database: &Path) -> Result<Self, LockError> {
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
        // Who holds it is only for the message; on a full disk the lock counts all the same.
        let _ = file
            .set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| writeln!(file, "{}", std::process::id()));
        Ok(Self { _file: file })
    }
}

/// Beside the file itself, wherever links lead to it.
fn lock_path(database: &Path) -> PathBuf {
    let mut name = fs::canonicalize(database)
        .unwrap_or_else(|_missing| {
            let folder = database.parent().filter(|it| !it.as_os_str().is_empty());
            let folder = fs::canonicalize(folder.unwrap_or(Path::new(".")));
            match (folder, database.file_name()) {
                (Ok(folder), Some(file)) => folder.join(file),
                (Ok(_) | Err(_), _) => database.to_owned(),
            }
        })
        .into_os_string();
    name.push(OsString::from(LOCK_ENDING));
    PathBuf::from(name)
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
        let first = DatabaseLock::take(&database).unwrap();
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
