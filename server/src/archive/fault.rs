//! What may be wrong with the content of a file.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use parquet::errors::ParquetError;

use super::SegmentArchiveError;

/// What is wrong with the content of a file.
#[derive(Debug, thiserror::Error)]
pub(super) enum Fault {
    /// It cannot be read.
    #[error("{0}")]
    Read(#[from] io::Error),
    /// The storage does not answer, or refuses.
    #[error("{0}")]
    Storage(String),
    /// It is no Parquet.
    #[error("{0}")]
    Parquet(#[from] ParquetError),
    /// It is not what this program writes.
    #[error("{0}")]
    Content(String),
}

pub(super) fn fault(what: impl Into<String>) -> Fault {
    Fault::Content(what.into())
}

/// Runs work on a file whose content may be anything. The decoder is not made for damaged input and may
/// panic.
pub(super) fn guarded<T>(
    path: &Path,
    work: impl FnOnce() -> Result<T, Fault>,
) -> Result<T, SegmentArchiveError> {
    let done = catch_unwind(AssertUnwindSafe(work));
    let done = done.unwrap_or_else(|_panic| Err(fault("it cannot be decoded")));
    done.map_err(|wrong| match wrong {
        Fault::Storage(reason) => SegmentArchiveError::Bucket {
            bucket: path.display().to_string(),
            reason,
        },
        Fault::Read(_) | Fault::Parquet(_) | Fault::Content(_) => SegmentArchiveError::Damaged {
            path: path.to_owned(),
            what: wrong.to_string(),
        },
    })
}
