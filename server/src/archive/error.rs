//! Failures of the archive.

use std::path::PathBuf;

use parquet::errors::ParquetError;

use super::SUPERSEDED_MAX;
use crate::file_error::FileError;

/// Failure of the archive.
#[derive(Debug, thiserror::Error)]
pub enum SegmentArchiveError {
    /// An operation on a file failed.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file is damaged, or was not written by this program.
    #[error("`{}` is damaged or no file of this archive: {what}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// Measurements cannot be encoded.
    #[error("cannot write measurements to `{}`", path.display())]
    Encoding {
        /// The file.
        path: PathBuf,
        /// The cause.
        #[source]
        cause: ParquetError,
    },
    /// The storage of a bucket does not answer, or refuses.
    #[error("the storage of `{bucket}` does not answer, or refuses: {reason}")]
    Bucket {
        /// The bucket or an object.
        bucket: String,
        /// The reason.
        reason: String,
    },
    /// The settings in the environment give no access to a bucket.
    #[error("`{bucket}` cannot be used with the environment variables AWS_...: {reason}")]
    Settings {
        /// The bucket.
        bucket: String,
        /// The reason.
        reason: String,
    },
    /// There are too many superseded files with the same keys.
    #[error("`{}` has {SUPERSEDED_MAX} superseded files like this: remove some", path.display())]
    Superseded {
        /// The file that cannot be renamed.
        path: PathBuf,
    },
    /// Archived measurements are missing.
    #[error(
        "the archive `{}` lacks the measurement {key}, which was archived: a file was removed, or this is \
         not the storage that was written to (a disk that is not mounted, another bucket)", folder.display()
    )]
    Missing {
        /// The folder.
        folder: PathBuf,
        /// Key of a missing measurement.
        key: i64,
    },
    /// Two files contain the same keys.
    #[error("`{}` has two files with the measurement {key}: move one of them away", folder.display())]
    Overlap {
        /// The folder.
        folder: PathBuf,
        /// A key that is in both files.
        key: i64,
    },
    /// Other requests read the archive for too long, or its storage does not answer.
    #[error(
        "other requests read the archive `{}`, or its storage does not answer: ask again later",
        folder.display()
    )]
    Busy {
        /// The folder.
        folder: PathBuf,
    },
    /// A new file has other contents than were written to it.
    #[error("a new file in `{}` does not contain what was written: examine the storage", folder.display())]
    NotAsWritten {
        /// The folder.
        folder: PathBuf,
    },
}
