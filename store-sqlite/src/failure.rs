//! Failures of the storage itself, as opposed to errors such as a violated constraint.
//!
//! After some errors (a full disk, a failed read or write, lack of memory) SQLite rolls a
//! transaction back by itself, and the library's count of open transactions no longer matches the
//! connection. A damaged page may also stay in a connection's cache. Therefore every connection
//! that is older than the last failure is replaced before it is used again: [`is_older_than_last`].

use std::io;
use std::time::Duration;

use tread_store::failure::{self, StorageFailure};

/// Returns the failure behind an error; `None` for an error of the statement or its values.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "whatever else there is or will be says nothing of the storage"
)]
pub(super) fn of(error: &sqlx::Error) -> Option<StorageFailure> {
    match error {
        sqlx::Error::Database(error) => {
            let extended: u32 = error.code()?.parse().ok()?;
            of_code(extended)
        }
        sqlx::Error::PoolTimedOut => Some(StorageFailure::Busy),
        sqlx::Error::Io(_) => Some(StorageFailure::Io),
        sqlx::Error::WorkerCrashed
        | sqlx::Error::PoolClosed
        | sqlx::Error::BeginFailed
        | sqlx::Error::InvalidSavePointStatement
        // The library's thread ended for lack of memory: a query that always returns a row, as
        // a count, returned none.
        | sqlx::Error::RowNotFound => Some(StorageFailure::Connection),
        _ => None,
    }
}

/// Returns the failure of an extended result code of SQLite.
const fn of_code(extended: u32) -> Option<StorageFailure> {
    /// `SQLITE_IOERR_NOMEM`.
    const IO_NO_MEMORY: u32 = 0x0c0a;
    match (extended, extended & 0xff) {
        (IO_NO_MEMORY, _) | (_, 7) => Some(StorageFailure::Memory),
        (_, 13) => Some(StorageFailure::Full),
        // IOERR, CANTOPEN, READONLY, PERM, AUTH.
        (_, 10 | 14 | 8 | 3 | 23) => Some(StorageFailure::Io),
        // CORRUPT, NOTADB.
        (_, 11 | 26) => Some(StorageFailure::Damaged),
        // BUSY, LOCKED, PROTOCOL.
        (_, 5 | 6 | 15) => Some(StorageFailure::Busy),
        _ => None,
    }
}

/// Returns what to do about an error of the operating system about a file, for operators.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "of all other errors the kernel log says more"
)]
pub(super) fn advice_on(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::PermissionDenied => {
            "give the file and its folder to the user that the server runs as (`ls -l`, `chown`)"
        }
        io::ErrorKind::ReadOnlyFilesystem => {
            "its disk is mounted read-only: see `dmesg`, repair the file system, and mount it for \
             writing"
        }
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            StorageFailure::Full.advice_for_file()
        }
        io::ErrorKind::NotFound => "create its folder first",
        _ => "see `dmesg` for what the disk answers",
    }
}

/// Returns what to do about an error of the database, for operators.
pub(super) fn advice_on_database(error: &sqlx::Error) -> &'static str {
    match (error, of(error)) {
        (sqlx::Error::Io(error), _) => advice_on(error),
        (_, Some(failure)) => failure.advice_for_file(),
        (_, None) => "see docs/runbook.md",
    }
}

/// Records an error.
pub(super) fn record(error: &sqlx::Error) {
    if let Some(failure) = of(error) {
        failure::record(failure);
    }
}

/// Returns whether a connection of this age may have been spoiled by the last failure.
pub(super) fn is_older_than_last(age: Duration) -> bool {
    failure::last().is_some_and(|(_, since)| age >= since)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn result_codes_say_what_failed() {
        let cases = [
            (13, Some(StorageFailure::Full)),
            (10, Some(StorageFailure::Io)),
            (0x040a, Some(StorageFailure::Io)),
            (0x0c0a, Some(StorageFailure::Memory)),
            (7, Some(StorageFailure::Memory)),
            (11, Some(StorageFailure::Damaged)),
            (26, Some(StorageFailure::Damaged)),
            (0x0205, Some(StorageFailure::Busy)),
            (14, Some(StorageFailure::Io)),
            // A violated constraint and a misuse are programming errors of the statement.
            (0x0813, None),
            (1, None),
            (21, None),
        ];
        for (code, failure) in cases {
            assert_eq!(of_code(code), failure, "{code}");
        }
    }
}
