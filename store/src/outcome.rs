//! Outcome of a commit, and the space that a database takes.

/// Outcome of a commit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Everything is written durably.
    Written,
    /// Nothing is written.
    Nothing,
    /// Unknown: the database did not answer in time, and may still write everything.
    Unknown,
}

/// Size of the database's files, and the free space on their disk.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Disk {
    /// Free bytes.
    pub free_bytes: Option<u64>,
    /// Size of the database file, bytes.
    pub database_bytes: Option<u64>,
    /// Size of its write-ahead log, bytes.
    pub log_bytes: Option<u64>,
}
