//! The mark: which measurements were archived, in a small file beside the database.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;

use super::SegmentArchiveError;
use crate::file_error::FileError;
use crate::paths::folder_of;

/// Keys that were archived without a gap, both included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Mark {
    pub(super) first: i64,
    pub(super) last: i64,
}

impl Mark {
    /// Reads the mark; `None` if nothing was archived yet.
    pub(super) fn read(path: &Path) -> Result<Option<Self>, SegmentArchiveError> {
        let text = match fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(FileError::of("read", path)(error).into()),
        };
        let keys = text.trim_end().split_once(' ');
        let mark = keys.and_then(|(first, last)| {
            let (first, last) = (first.parse().ok()?, last.parse().ok()?);
            Some(Self { first, last })
        });
        let damaged = || SegmentArchiveError::Damaged {
            path: path.to_owned(),
            what: "it does not contain two keys".to_owned(),
        };
        mark.map(Some).ok_or_else(damaged)
    }

    /// Writes the mark, so that it survives a power cut.
    pub(super) fn write(self, path: &Path) -> Result<(), FileError> {
        let mut new = path.as_os_str().to_owned();
        new.push(".new");
        let new = Path::new(&new);
        let written = || {
            let mut options = OpenOptions::new();
            options.write(true).create(true).truncate(true).mode(0o600);
            let mut file = options.open(new)?;
            writeln!(file, "{} {}", self.first, self.last)?;
            file.sync_all()?;
            fs::rename(new, path)?;
            File::open(folder_of(path))?.sync_all()
        };
        written().map_err(FileError::of("write", path))
    }
}
