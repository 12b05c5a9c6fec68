//! The manifest of an archive states its producer, its time and its content.

use std::collections::BTreeMap;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// Version of the archive's format that this program writes, and the newest that it reads.
pub const FORMAT: u32 = 1;

/// A file of the archive.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ArchivedFile {
    /// Name of its entry.
    pub name: String,
    /// Size, bytes.
    pub bytes: u64,
    /// SHA-256 of its content, hexadecimal.
    pub sha256: String,
}

/// First entry of an archive. A reader ignores fields that it does not know.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of the archive's format.
    pub format: u32,
    /// Version of the server that made it.
    pub version: String,
    /// Commit that this server was built from, if known.
    pub commit: Option<String>,
    /// Schema of the database: its newest migration.
    pub schema: i64,
    /// Time of the copy: later changes are not in it.
    pub taken_at: Timestamp,
    /// The database.
    pub database: ArchivedFile,
    /// Rows of the main tables.
    pub rows: BTreeMap<String, u64>,
    /// Files of the fleet's authority; empty if the server has none.
    pub authority: Vec<ArchivedFile>,
}
