//! Keeps damaged bytes of the outbox's files for inspection.
//!
//! Each entry is a line of JSON with the position of the bytes, followed by the bytes themselves.

use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::bounded_file::BoundedFile;
use super::error::{StoreError, failure};

/// Largest number of bytes kept of one damaged range; the rest is dropped.
const PIECE_BYTES_MAX: usize = 256 * 1024;

#[derive(Serialize)]
struct Place<'path> {
    file: &'path Path,
    at: usize,
    bytes: usize,
    kept: usize,
}

/// The file of an outbox's damaged bytes.
#[derive(Debug)]
pub(super) struct DamagedBytes(BoundedFile);

impl DamagedBytes {
    pub(super) fn new(folder: &Path) -> Self {
        Self(BoundedFile::new(&folder.join("damaged"), "bin"))
    }

    /// Whether damaged bytes are kept; the file stays until a person removes it.
    pub(super) fn is_present(&self) -> bool {
        self.0.is_present()
    }

    /// Returns the path of the newest damaged bytes.
    pub(super) fn path(&self) -> PathBuf {
        self.0.path().to_owned()
    }

    /// Keeps the damaged bytes of a range of a file, and waits until they are on disk.
    pub(super) fn keep(
        &mut self,
        file: &Path,
        at: Range<usize>,
        bytes: &[u8],
    ) -> Result<(), StoreError> {
        let kept = &bytes[..bytes.len().min(PIECE_BYTES_MAX)];
        let place = Place {
            file,
            at: at.start,
            bytes: at.len(),
            kept: kept.len(),
        };
        let line = serde_json::to_vec(&place).map_err(io::Error::from);
        let mut piece = line.map_err(failure("write", self.0.path()))?;
        piece.push(b'\n');
        piece.extend_from_slice(kept);
        self.0.append(&piece)
    }
}
