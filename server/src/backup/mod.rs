//! Backup archives: one file with a copy of the database, the fleet's certificate authority, and a
//! manifest with the checksum of each of them.
//!
//! An archive is a tar file whose first entry is `manifest.json`. It may be encrypted by a program of
//! the operator's choice. It is written under another name, read back, and renamed when it is
//! complete.
//!
//! This module knows files and no database. [`crate::app::backups`] makes backups.

pub mod archive;
pub mod encryption;
pub mod folder;
pub mod manifest;

pub use self::archive::{ArchiveError, Archived, Extracted, Source};
pub use self::encryption::Filter;
pub use self::manifest::Manifest;
