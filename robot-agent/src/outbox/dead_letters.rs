//! Records that the server will never take, kept aside for people: one JSON object a line.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::Serialize;
use tread_api::ids::BootId;

use super::store::StoreError;

/// A file that has grown past this becomes the old one; there are at most two.
pub(super) const DEAD_LETTER_BYTES_MAX: u64 = 1024 * 1024;
const FILE_NAME: &str = "dead-letters.jsonl";
const OLD_FILE_NAME: &str = "dead-letters.old.jsonl";

/// The dead-letter file of one outbox.
#[derive(Debug)]
pub(super) struct DeadLetters {
    path: PathBuf,
    old_path: PathBuf,
}

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
        Self {
            path: folder.join(FILE_NAME),
            old_path: folder.join(OLD_FILE_NAME),
        }
    }

    /// Writes one record and waits until the disk has it.
    pub(super) fn write(
        &mut self,
        boot: BootId,
        seq: u64,
        reason: &str,
        content: &str,
    ) -> Result<(), StoreError> {
        let path = &self.path;
        let failed = |action| {
            move |source| StoreError::File {
                action,
                path: path.clone(),
                source,
            }
        };
        let letter = DeadLetter {
            boot,
            seq,
            reason,
            content,
        };
        let line = serde_json::to_vec(&letter).map_err(std::io::Error::from);
        let mut line = line.map_err(failed("write"))?;
        line.push(b'\n');
        let is_full = fs::metadata(path).is_ok_and(|metadata| {
            metadata.len() + super::store::size(line.len()) > DEAD_LETTER_BYTES_MAX
        });
        if is_full {
            fs::rename(path, &self.old_path).map_err(failed("rename"))?;
        }
        let mut file = OpenOptions::new()
            .create(true)
            .append(true)
            .open(path)
            .map_err(failed("open"))?;
        file.write_all(&line).map_err(failed("write"))?;
        file.sync_data().map_err(failed("sync"))
    }
}
