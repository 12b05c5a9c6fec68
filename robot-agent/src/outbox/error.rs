//! Errors of the store.

use std::io;
use std::path::{Path, PathBuf};

/// Errors of the store.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file could not be read, written or removed.
    #[error("the outbox could not {action} `{}`", path.display())]
    File {
        /// The operation that failed.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        #[source]
        source: io::Error,
    },
    /// A record is too large for the store.
    #[error("a record of {0} bytes does not fit in the outbox")]
    TooLarge(usize),
}

pub(super) fn failure<'path>(
    action: &'static str,
    path: &'path Path,
) -> impl FnOnce(io::Error) -> StoreError + 'path {
    move |source| StoreError::File {
        action,
        path: path.to_owned(),
        source,
    }
}
