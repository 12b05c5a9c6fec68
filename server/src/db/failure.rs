//! Failures of the storage itself, as opposed to errors such as a violated constraint.
//!
//! After some errors (a full disk, a failed read or write, lack of memory) SQLite rolls a
//! transaction back by itself, and the library's count of open transactions no longer matches the
//! connection. A damaged page may also stay in a connection's cache. Therefore every connection
//! that is older than the last failure is replaced before it is used again: [`is_older_than_last`].

use std::io;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use tokio::time::Instant;

/// Kind of storage failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StorageFailure {
    /// The disk is full.
    Full,
    /// The operating system could not open, read, write or sync the file.
    Io,
    /// Memory allocation failed.
    Memory,
    /// The file is damaged, or is not a database.
    Damaged,
    /// Another process holds the file's lock, or no connection became free in time.
    Busy,
    /// The connection is in an unusable state.
    Connection,
}

impl StorageFailure {
    /// Every kind.
    pub const ALL: [Self; 6] = [
        Self::Full,
        Self::Io,
        Self::Memory,
        Self::Damaged,
        Self::Busy,
        Self::Connection,
    ];

    /// Returns its name in metrics.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Io => "io",
            Self::Memory => "memory",
            Self::Damaged => "damaged",
            Self::Busy => "busy",
            Self::Connection => "connection",
        }
    }

    /// Returns its explanation for operators.
    pub const fn explanation(self) -> &'static str {
        match self {
            Self::Full => "the disk is full",
            Self::Io => "the operating system cannot read or write the database's files",
            Self::Memory => "there is no memory",
            Self::Damaged => "the database is damaged",
            Self::Busy => "another process holds the database, or it is too slow",
            Self::Connection => "a connection to the database broke",
        }
    }

    /// Returns what to do about it, for operators.
    pub const fn advice(self) -> &'static str {
        match self {
            Self::Full => "make room on its disk (`df -h`, `df -i`)",
            Self::Io => {
                "see whether the user that the server runs as may write the file and its folder, \
                 whether the disk is mounted read-only, and what `dmesg` says of the disk"
            }
            Self::Memory => "give the machine or its control group more memory",
            Self::Damaged => {
                "stop the server, keep the file, and restore a backup; without one, \
                 `sqlite3 FILE .recover | sqlite3 NEW`"
            }
            Self::Busy => "end the other process that uses the file (`fuser FILE`)",
            Self::Connection => "see the log; start the server again if it lasts",
        }
    }

    /// Returns the failure behind an error; `None` for an error of the statement or its values.
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "whatever else there is or will be says nothing of the storage"
    )]
    pub fn of(error: &sqlx::Error) -> Option<Self> {
        match error {
            sqlx::Error::Database(error) => {
                let extended: u32 = error.code()?.parse().ok()?;
                Self::of_code(extended)
            }
            sqlx::Error::PoolTimedOut => Some(Self::Busy),
            sqlx::Error::Io(_) => Some(Self::Io),
            sqlx::Error::WorkerCrashed
            | sqlx::Error::PoolClosed
            | sqlx::Error::BeginFailed
            | sqlx::Error::InvalidSavePointStatement
            // The library's thread ended for lack of memory: a query that always returns a row, as
            // a count, returned none.
            | sqlx::Error::RowNotFound => Some(Self::Connection),
            _ => None,
        }
    }

    /// Returns the failure of an extended result code of SQLite.
    const fn of_code(extended: u32) -> Option<Self> {
        /// `SQLITE_IOERR_NOMEM`.
        const IO_NO_MEMORY: u32 = 0x0c0a;
        match (extended, extended & 0xff) {
            (IO_NO_MEMORY, _) | (_, 7) => Some(Self::Memory),
            (_, 13) => Some(Self::Full),
            // IOERR, CANTOPEN, READONLY, PERM, AUTH.
            (_, 10 | 14 | 8 | 3 | 23) => Some(Self::Io),
            // CORRUPT, NOTADB.
            (_, 11 | 26) => Some(Self::Damaged),
            // BUSY, LOCKED, PROTOCOL.
            (_, 5 | 6 | 15) => Some(Self::Busy),
            _ => None,
        }
    }
}

/// Returns what to do about an error of the operating system about a file, for operators.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "of all other errors the kernel log says more"
)]
pub fn advice_on(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::PermissionDenied => {
            "give the file and its folder to the user that the server runs as (`ls -l`, `chown`)"
        }
        io::ErrorKind::ReadOnlyFilesystem => {
            "its disk is mounted read-only: see `dmesg`, repair the file system, and mount it for \
             writing"
        }
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => StorageFailure::Full.advice(),
        io::ErrorKind::NotFound => "create its folder first",
        _ => "see `dmesg` for what the disk answers",
    }
}

/// Returns what to do about an error of the database, for operators.
pub fn advice_on_database(error: &sqlx::Error) -> &'static str {
    match (error, StorageFailure::of(error)) {
        (sqlx::Error::Io(error), _) => advice_on(error),
        (_, Some(failure)) => failure.advice(),
        (_, None) => "see docs/runbook.md",
    }
}

/// Failures since the start of the process, of all its databases: replacing a connection needlessly
/// costs only a millisecond.
struct FailureLog {
    counts: [AtomicU64; StorageFailure::ALL.len()],
    /// Time of the last failure that spoils connections, microseconds after [`origin`]; 0 for none.
    last_us: AtomicU64,
    /// Its index in [`StorageFailure::ALL`].
    last: AtomicUsize,
}

static FAILURES: FailureLog = FailureLog {
    counts: [const { AtomicU64::new(0) }; StorageFailure::ALL.len()],
    last_us: AtomicU64::new(0),
    last: AtomicUsize::new(0),
};

fn origin() -> Instant {
    static ORIGIN: OnceLock<Instant> = OnceLock::new();
    *ORIGIN.get_or_init(Instant::now)
}

fn now_us() -> u64 {
    u64::try_from(origin().elapsed().as_micros()).unwrap_or(u64::MAX)
}

/// Records an error.
pub(super) fn note(error: &sqlx::Error) {
    let Some(failure) = StorageFailure::of(error) else {
        return;
    };
    FAILURES.counts[failure as usize].fetch_add(1, Ordering::AcqRel);
    if failure != StorageFailure::Busy {
        FAILURES.last.store(failure as usize, Ordering::Release);
        FAILURES.last_us.store(now_us().max(1), Ordering::Release);
    }
}

/// Returns the number of failures of this kind since the start of the process.
pub fn count(failure: StorageFailure) -> u64 {
    FAILURES.counts[failure as usize].load(Ordering::Acquire)
}

/// Returns the last failure other than a lock, and the time since.
pub fn last() -> Option<(StorageFailure, Duration)> {
    let last_us = FAILURES.last_us.load(Ordering::Acquire);
    let failure = StorageFailure::ALL.get(FAILURES.last.load(Ordering::Acquire))?;
    let since = Duration::from_micros(now_us().saturating_sub(last_us));
    (last_us > 0).then_some((*failure, since))
}

/// Returns whether a connection of this age may have been spoiled by the last failure.
pub(super) fn is_older_than_last(age: Duration) -> bool {
    last().is_some_and(|(_, since)| age >= since)
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
            assert_eq!(StorageFailure::of_code(code), failure, "{code}");
        }
    }
}
