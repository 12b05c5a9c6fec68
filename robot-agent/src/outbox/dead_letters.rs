//! Keeps records that the server refuses for good, for inspection: one JSON object per line.

use std::io;
use std::path::Path;

use serde::Serialize;
use tread_api::ids::BootId;

use super::bounded_file::BoundedFile;
use super::error::{StoreError, failure};

/// The dead-letter file of one outbox.
#[derive(Debug)]
pub(super) struct DeadLetters(BoundedFile);

/// A record that was refused.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct DeadLetter<'record> {
    pub(super) boot: BootId,
    pub(super) seq: u64,
    pub(super) reason: &'record str,
    /// Content of the record in the outbox, as a JSON string.
    pub(super) content: &'record str,
}

impl DeadLetters {
    pub(super) fn new(folder: &Path) -> Self {
        Self(BoundedFile::new(&folder.join("dead-letters"), "jsonl"))
    }

    /// Writes one record and waits until it is on disk.
    pub(super) fn write(&mut self, letter: &DeadLetter<'_>) -> Result<(), StoreError> {
        let line = serde_json::to_vec(letter).map_err(io::Error::from);
        self.0
            .append(&line.map_err(failure("write", self.0.path()))?)
    }
}
