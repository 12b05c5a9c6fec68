//! The mark as former versions wrote it: a small file beside the database, or in the folder of the archive.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::{KeyRange, SegmentArchiveError};
use crate::file_error::FileError;

/// Suffix of the mark, after the name of the database.
const MARK_ENDING: &str = ".archived";

/// Name of the mark in the folder, without its suffix.
const IN_FOLDER: &str = "tread";

/// Returns the file of the mark of a database file.
pub(super) fn beside(database: &Path) -> PathBuf {
    let mut path = database.as_os_str().to_owned();
    path.push(MARK_ENDING);
    path.into()
}

/// Returns the file of the mark in the folder of the archive, of a database without a file.
pub(super) fn within(folder: &Path) -> PathBuf {
    beside(&folder.join(IN_FOLDER))
}

/// Reads the mark; `None` if there is no file.
pub(super) fn read(path: &Path) -> Result<Option<KeyRange>, SegmentArchiveError> {
    let text = match fs::read_to_string(path) {
        Ok(text) => text,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(FileError::of("read", path)(error).into()),
    };
    let keys = text.trim_end().split_once(' ');
    let mark = keys.and_then(|(first, last)| {
        let (first, last) = (first.parse().ok()?, last.parse().ok()?);
        (1 <= first && first <= last).then_some(KeyRange { first, last })
    });
    let damaged = || SegmentArchiveError::Damaged {
        path: path.to_owned(),
        what: "it does not contain two keys".to_owned(),
    };
    mark.map(Some).ok_or_else(damaged)
}

/// Removes the file after the database has the mark.
pub(super) fn remove(path: &Path) -> Result<(), FileError> {
    fs::remove_file(path).map_err(FileError::of("remove", path))
}
