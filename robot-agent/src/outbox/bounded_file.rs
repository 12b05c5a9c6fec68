//! An append-only file of bounded size: a full file replaces the old one, whose content is lost.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use super::error::{StoreError, failure};
use super::files::size;

/// Size above which a file becomes the old one, bytes; there are at most two files.
pub(super) const FILE_BYTES_MAX: u64 = 1024 * 1024;

/// The two files.
#[derive(Debug)]
pub(super) struct BoundedFile {
    path: PathBuf,
    old_path: PathBuf,
}

impl BoundedFile {
    /// Creates the handle of `<stem>.<ending>` and `<stem>.old.<ending>`; neither need exist.
    pub(super) fn new(stem: &Path, ending: &str) -> Self {
        Self {
            path: stem.with_extension(ending),
            old_path: stem.with_extension(format!("old.{ending}")),
        }
    }

    /// Returns the path of the file that is written.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether any of the two files exists.
    pub(super) fn is_present(&self) -> bool {
        self.path.exists() || self.old_path.exists()
    }

    /// Appends one entry, on lines of its own, and waits until it is on disk.
    pub(super) fn append(&mut self, piece: &[u8]) -> Result<(), StoreError> {
        let path = &self.path;
        let is_full = fs::metadata(path)
            .is_ok_and(|metadata| metadata.len() + size(piece.len()) > FILE_BYTES_MAX);
        if is_full {
            fs::rename(path, &self.old_path).map_err(failure("rename", path))?;
        }
        let mut file = OpenOptions::new()
            .create(true)
            .read(true)
            .append(true)
            .open(path)
            .map_err(failure("open", path))?;
        let mut whole = Vec::with_capacity(piece.len() + 2);
        // A crash may have left an incomplete line.
        if !ends_a_line(&file).map_err(failure("read", path))? {
            whole.push(b'\n');
        }
        whole.extend_from_slice(piece);
        whole.push(b'\n');
        file.write_all(&whole).map_err(failure("write", path))?;
        file.sync_data().map_err(failure("sync", path))
    }
}

fn ends_a_line(file: &File) -> io::Result<bool> {
    use std::os::unix::fs::FileExt as _;
    let Some(last) = file.metadata()?.len().checked_sub(1) else {
        return Ok(true);
    };
    let mut byte = [0];
    file.read_exact_at(&mut byte, last)?;
    Ok(byte == *b"\n")
}
