//! Statements that begin transactions.

/// Begins a write. The number is the lock of writers, "treaddb" in ASCII. The server releases the lock
/// after it has made the commit visible, and each later statement sees what is visible when it begins.
pub(super) const BEGIN_WRITE: &str = "BEGIN ISOLATION LEVEL READ COMMITTED READ WRITE; SELECT pg_advisory_xact_lock(32776877049668706)";
/// Follows it, if the write changes a site, terrain or robot: other processes see by it that one has.
const COUNT_WRITE: &str = "; UPDATE server_epoch SET generation = generation + 1";
/// Begins a read: its first statement takes the snapshot of all.
pub(super) const BEGIN_READ: &str = "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY";

/// Statements that begin a write.
#[derive(Debug)]
pub(super) struct BeginWrite {
    pub(super) counted: String,
    pub(super) uncounted: String,
}

impl BeginWrite {
    /// Returns those of the server with an epoch.
    pub(super) fn of_server(epoch: i64) -> Self {
        let uncounted = format!("{BEGIN_WRITE}; SELECT check_server_epoch({epoch})");
        Self {
            counted: format!("{uncounted}{COUNT_WRITE}"),
            uncounted,
        }
    }

    /// Returns those of a program that is no server.
    pub(super) fn of_program() -> Self {
        Self {
            counted: format!("{BEGIN_WRITE}{COUNT_WRITE}"),
            uncounted: BEGIN_WRITE.to_owned(),
        }
    }

    /// Returns those of a program that only reads: PostgreSQL refuses each change.
    pub(super) fn of_reader() -> Self {
        Self {
            counted: BEGIN_READ.to_owned(),
            uncounted: BEGIN_READ.to_owned(),
        }
    }
}
