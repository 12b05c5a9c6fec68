//! Failure of an operation on a file or folder.

use std::io;
use std::path::{Path, PathBuf};

/// An operation on a file or folder that failed.
#[derive(Debug, thiserror::Error)]
#[error("cannot {action} `{}`", path.display())]
pub struct FileError {
    /// The operation.
    action: &'static str,
    /// The file or folder.
    path: PathBuf,
    /// The cause.
    #[source]
    cause: io::Error,
}

impl FileError {
    /// Returns what makes an error of a cause.
    pub(crate) fn of(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_owned();
        move |cause| Self {
            action,
            path,
            cause,
        }
    }
}
