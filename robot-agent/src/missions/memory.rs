//! Stores the state of missions on disk: one JSON file, replaced as a whole.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::MissionSlot;
use crate::durable;

const FILE_NAME: &str = "missions.json";

/// Why the memory could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum MemoryError {
    /// A file operation failed.
    #[error("the mission memory `{}` cannot be {action}", path.display())]
    File {
        /// The operation that failed.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        #[source]
        source: io::Error,
    },
    /// The checksum of the file does not match.
    #[error("the mission memory `{}` is damaged; move it away to start afresh", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
    },
    /// The file is not valid JSON of a [`MissionSlot`].
    #[error("the mission memory `{}` does not parse; move it away to start afresh", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Error of the parser.
        #[source]
        source: serde_json::Error,
    },
}

/// The file that keeps a [`MissionSlot`] over restarts.
#[derive(Debug, Clone)]
pub struct Memory {
    folder: PathBuf,
}

impl Memory {
    /// Creates the handle of the file in a folder, which must exist.
    pub fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
        }
    }

    /// Reads the file; empty at a robot's first start.
    ///
    /// # Errors
    /// [`MemoryError`] if the file cannot be read, is damaged or does not parse.
    pub fn load(&self) -> Result<MissionSlot, MemoryError> {
        let path = self.folder.join(FILE_NAME);
        match fs::read(&path) {
            Ok(file) => {
                let Ok(text) = durable::unsealed(&file) else {
                    return Err(MemoryError::Damaged { path });
                };
                serde_json::from_slice(text)
                    .map_err(|source| MemoryError::Malformed { path, source })
            }
            Err(source) if source.kind() == io::ErrorKind::NotFound => Ok(MissionSlot::default()),
            Err(source) => Err(MemoryError::File {
                action: "read",
                path,
                source,
            }),
        }
    }

    /// Writes the file and waits until it is on disk. Blocks.
    ///
    /// # Errors
    /// [`MemoryError`] if the disk fails; the former content is kept.
    pub fn save(&self, slot: &MissionSlot) -> Result<(), MemoryError> {
        let text = serde_json::to_vec(slot).map_err(io::Error::from);
        let written = text
            .and_then(|text| durable::replace(&self.folder, FILE_NAME, &durable::sealed(&text)));
        written.map_err(|source| MemoryError::File {
            action: "written",
            path: self.folder.join(FILE_NAME),
            source,
        })
    }
}

#[cfg(test)]
mod tests {
    use tread_api::ids::MissionId;
    use uuid::Uuid;

    use super::*;

    #[test]
    fn a_slot_comes_back_as_it_was_saved() {
        let folder = tempfile::tempdir().unwrap();
        let memory = Memory::new(folder.path());
        assert_eq!(memory.load().unwrap(), MissionSlot::default());
        let mut slot = MissionSlot::default();
        slot.cancel(MissionId::from_uuid(Uuid::from_u128(7)));
        memory.save(&slot).unwrap();
        memory.save(&slot).unwrap();
        assert_eq!(memory.load().unwrap(), slot);
    }

    #[test]
    fn a_memory_that_does_not_parse_is_no_empty_memory() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(FILE_NAME), b"{").unwrap();
        let refused = Memory::new(folder.path()).load().unwrap_err();
        assert!(refused.to_string().contains(FILE_NAME), "{refused}");
    }

    #[test]
    fn a_memory_with_any_bit_flipped_is_refused_and_never_another_one() {
        let folder = tempfile::tempdir().unwrap();
        let memory = Memory::new(folder.path());
        let mut slot = MissionSlot::default();
        slot.cancel(MissionId::from_uuid(Uuid::from_u128(7)));
        memory.save(&slot).unwrap();
        let path = folder.path().join(FILE_NAME);
        let intact = fs::read(&path).unwrap();
        for bit in 0..intact.len() * 8 {
            let mut damaged = intact.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            fs::write(&path, damaged).unwrap();
            match memory.load() {
                // In the checksum's own name.
                Ok(read) => assert_eq!(read, slot, "bit {bit}"),
                Err(refused) => {
                    let refused = refused.to_string();
                    assert!(refused.contains("move it away"), "bit {bit}: {refused}");
                }
            }
        }
        let earlier = serde_json::to_vec(&slot).unwrap();
        fs::write(&path, earlier).unwrap();
        assert_eq!(memory.load().unwrap(), slot, "of an earlier agent");
    }
}
