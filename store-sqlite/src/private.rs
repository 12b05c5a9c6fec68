//! File permissions: only the owner may access the database's files, since reading them reveals
//! what the fleet does, and writing them allows to create tokens.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, Read as _};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

use tracing::warn;

/// Mode: read and write for the owner alone.
const OWNERS: u32 = 0o600;
/// Mask of the permissions of group and others.
const OF_OTHERS: u32 = 0o077;
/// Suffixes of the database's files. SQLite gives those beside it the mode of the database.
const ENDINGS: [&str; 4] = ["", "-wal", "-shm", "-journal"];

/// Begin of every database file.
const MAGIC: &[u8; 16] = b"SQLite format 3\0";

/// Returns whether a file has contents of another kind than a database.
fn is_foreign(mut file: File) -> io::Result<bool> {
    let mut begin = Vec::new();
    file.by_ref()
        .take(MAGIC.len() as u64)
        .read_to_end(&mut begin)?;
    Ok(!begin.is_empty() && begin != MAGIC)
}

fn beside(path: &Path, ending: &str) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(ending);
    name.into()
}

/// Creates the database's file if it is missing, for its owner alone, and removes the permissions
/// of others from existing files.
///
/// # Errors
/// The file cannot be created.
pub(super) fn keep(path: &Path) -> io::Result<()> {
    let mut options = OpenOptions::new();
    options
        .write(true)
        .create(true)
        .truncate(false)
        .mode(OWNERS);
    let file = options.read(true).open(path)?;
    if is_foreign(file)? {
        // SQLite refuses it; whoever may use it is nobody's business here.
        return Ok(());
    }
    for ending in ENDINGS {
        let file = beside(path, ending);
        let Ok(found) = fs::metadata(&file) else {
            continue;
        };
        if found.permissions().mode() & OF_OTHERS == 0 {
            continue;
        }
        // A file of another user can be used nevertheless.
        match fs::set_permissions(&file, Permissions::from_mode(OWNERS)) {
            Ok(()) => warn!(
                "others could use `{}`; now its owner alone can",
                file.display()
            ),
            Err(error) => warn!("others can use `{}`: {error}", file.display()),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_of_another_kind_keeps_its_mode() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notes.txt");
        fs::write(&path, "not a database").unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o644)).unwrap();
        keep(&path).unwrap();
        let mode = fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o644);
    }

    #[test]
    fn what_others_could_read_is_taken_away_from_them() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tread.db");
        for ending in ENDINGS {
            fs::write(beside(&path, ending), "").unwrap();
            fs::set_permissions(beside(&path, ending), Permissions::from_mode(0o644)).unwrap();
        }
        keep(&path).unwrap();
        for ending in ENDINGS {
            let mode = fs::metadata(beside(&path, ending))
                .unwrap()
                .permissions()
                .mode();
            assert_eq!(mode & 0o777, OWNERS, "{ending}");
        }
    }
}
