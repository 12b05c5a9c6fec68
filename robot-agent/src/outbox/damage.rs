//! Damaged bytes of the outbox's files, kept for people.
//!
//! Each piece is a line of JSON that says where the bytes were, and then the bytes themselves.

use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::bounded_file::BoundedFile;
use super::store::{StoreError, failure};

/// Most bytes that are kept of one damaged place.
const PIECE_BYTES_MAX: usize = 256 * 1024;

#[derive(Serialize)]
struct Place<'path> {
    file: &'path Path,
    at: usize,
    bytes: usize,
    kept: usize,
}

/// The file of one outbox's damaged bytes.
#[derive(Debug)]
pub(super) struct DamagedBytes(BoundedFile);

impl DamagedBytes {
    pub(super) fn new(folder: &Path) -> Self {
        Self(BoundedFile::new(folder, "damaged", "bin"))
    }

    /// Whether anything is kept; it stays until a person removes it.
    pub(super) fn is_present(&self) -> bool {
        self.0.is_present()
    }

    /// Where the newest are.
    pub(super) fn path(&self) -> PathBuf {
        self.0.path().to_owned()
    }

    /// Keeps the bytes of one place in a file, and waits until the disk has them.
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
