//! Failures of the storage itself, as opposed to errors such as a violated constraint.

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

    /// Returns what to do about it at a database file, for operators.
    pub const fn advice_for_file(self) -> &'static str {
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

    /// Returns what to do about it at a PostgreSQL server, for operators.
    pub const fn advice_for_postgres(self) -> &'static str {
        match self {
            Self::Full => "make room on the disk of PostgreSQL",
            Self::Io => "see PostgreSQL's log, and whether its disk fails or is mounted read-only",
            Self::Memory => "give PostgreSQL more memory, or permit fewer connections to it",
            Self::Damaged => {
                "stop the server and restore a dump; PostgreSQL's log names the damaged page"
            }
            Self::Busy => {
                "see in `pg_stat_activity` which session holds a lock, and how busy PostgreSQL is"
            }
            Self::Connection => "see whether PostgreSQL runs and can be reached from this machine",
        }
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

/// Records a failure.
pub fn record(failure: StorageFailure) {
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
