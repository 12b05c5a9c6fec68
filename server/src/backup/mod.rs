//! Backup archives. An archive is one file with a copy of the database, the fleet's certificate
//! authority, and a manifest with the checksum of each.
//!
//! An archive is a tar file whose first entry is `manifest.json`. A program of the operator's
//! choice may encrypt it. It gets a temporary name first; the server reads it back, and renames it
//! when it is complete.
//!
//! This module handles files and knows no database. [`crate::app::backups`] makes backups.

pub mod archive;
pub mod encryption;
pub mod folder;
pub mod manifest;

pub use self::archive::{ArchiveError, Archived, Extracted, Source};
pub use self::encryption::Filter;
pub use self::manifest::Manifest;
