//! The folder of scheduled backups: names, order and removal.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use jiff::civil::DateTime;
use jiff::tz::TimeZone;

/// Beginning of the name of a backup.
const PREFIX: &str = "tread-";
/// Format of the time in the name of a backup, UTC.
const TIME_FORMAT: &str = "%Y%m%dT%H%M%SZ";
/// End of the name of a backup that is not encrypted.
const ENDING: &str = ".tar";
/// End of the name of an encrypted backup.
const ENCRYPTED_ENDING: &str = ".tar.encrypted";

/// A complete backup in a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredBackup {
    /// Its file.
    pub path: PathBuf,
    /// Its time, from its name.
    pub taken_at: Timestamp,
    /// Its size, bytes.
    pub bytes: u64,
}

/// Returns the name of a backup.
pub fn name(taken_at: Timestamp, is_encrypted: bool) -> String {
    let time = taken_at.strftime(TIME_FORMAT);
    let ending = if is_encrypted {
        ENCRYPTED_ENDING
    } else {
        ENDING
    };
    format!("{PREFIX}{time}{ending}")
}

fn time_in(name: &str) -> Option<Timestamp> {
    let rest = name.strip_prefix(PREFIX)?;
    let time = rest.strip_suffix(ENCRYPTED_ENDING);
    let time = time.or_else(|| rest.strip_suffix(ENDING))?;
    let time = DateTime::strptime(TIME_FORMAT, time).ok()?;
    Some(time.to_zoned(TimeZone::UTC).ok()?.timestamp())
}

/// Returns the complete backups of a folder, oldest first. It ignores other files.
///
/// # Errors
/// The folder cannot be read.
pub fn list(folder: &Path) -> io::Result<Vec<StoredBackup>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let Some(taken_at) = name.to_str().and_then(time_in) else {
            continue;
        };
        let about = entry.metadata()?;
        if about.is_file() {
            found.push(StoredBackup {
                path: entry.path(),
                taken_at,
                bytes: about.len(),
            });
        }
    }
    found.sort_by(|one, other| (one.taken_at, &one.path).cmp(&(other.taken_at, &other.path)));
    Ok(found)
}

/// Removes the oldest backups of a folder beyond `keep`. Returns their number.
///
/// # Errors
/// The folder cannot be read, or a file cannot be removed.
pub fn remove_old(folder: &Path, keep: usize) -> io::Result<usize> {
    let found = list(folder)?;
    let over = found.len().saturating_sub(keep);
    for old in &found[..over] {
        fs::remove_file(&old.path)?;
    }
    Ok(over)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn time(text: &str) -> Timestamp {
        text.parse().unwrap()
    }

    #[test]
    fn a_backup_is_found_by_its_name_with_its_time() {
        let taken_at = time("2026-11-25T07:55:47Z");
        assert_eq!(name(taken_at, false), "tread-20261125T075547Z.tar");
        for is_encrypted in [false, true] {
            assert_eq!(time_in(&name(taken_at, is_encrypted)), Some(taken_at));
        }
        for other in [
            "tread-20261125T075547Z.tar.partial",
            "tread-20261125T075547Z",
            "tread-20261325T075547Z.tar",
            "tread.db",
            "other-20261125T075547Z.tar",
        ] {
            assert_eq!(time_in(other), None, "{other}");
        }
    }

    #[test]
    fn the_oldest_are_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        for day in 1..=5 {
            let name = format!("tread-2026110{day}T000000Z.tar");
            fs::write(folder.path().join(name), "x").unwrap();
        }
        fs::write(folder.path().join("letter.tar"), "x").unwrap();
        assert_eq!(remove_old(folder.path(), 2).unwrap(), 3);
        let left = list(folder.path()).unwrap();
        let days: Vec<_> = left.iter().map(|one| one.taken_at).collect();
        assert_eq!(
            days,
            [time("2026-11-04T00:00:00Z"), time("2026-11-05T00:00:00Z")]
        );
        assert!(folder.path().join("letter.tar").exists());
        assert_eq!(remove_old(folder.path(), 2).unwrap(), 0);
    }
}
