//! Records that the server will never take, kept for people: one JSON object a line.

use std::io;
use std::path::Path;

use serde::Serialize;
use tread_api::ids::BootId;

use super::bounded_file::BoundedFile;
use super::store::{StoreError, failure};

/// The dead-letter file of one outbox.
#[derive(Debug)]
pub(super) struct DeadLetters(BoundedFile);

#[derive(Serialize)]
struct DeadLetter<'record> {
    boot: BootId,
    seq: u64,
    reason: &'record str,
    /// The record's content as it stood in the outbox, JSON in a string.
    content: &'record str,
}

impl DeadLetters {
    pub(super) fn new(folder: &Path) -> Self {
        Self(BoundedFile::new(folder, "dead-letters", "jsonl"))
    }

    /// Writes one record and waits until the disk has it.
    pub(super) fn write(
        &mut self,
        boot: BootId,
        seq: u64,
        reason: &str,
        content: &str,
    ) -> Result<(), StoreError> {
        let letter = DeadLetter {
            boot,
            seq,
            reason,
            content,
        };
        let line = serde_json::to_vec(&letter).map_err(io::Error::from);
        self.0
            .append(&line.map_err(failure("write", self.0.path()))?)
    }
}
