//! Failures of the storage itself, as opposed to errors such as a violated constraint.
//!
//! Every connection that is older than the last failure is replaced before it is used again: after a
//! restart of PostgreSQL all of them are useless, and one that leads to a standby stays there.

use std::time::Duration;

use tread_store::failure::{self, StorageFailure};

/// Returns the failure behind an error; `None` for an error of the statement or its values.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "whatever else there is or will be says nothing of the storage"
)]
pub(super) fn of(error: &sqlx::Error) -> Option<StorageFailure> {
    match error {
        sqlx::Error::Database(error) => of_code(&error.code()?),
        sqlx::Error::PoolTimedOut => Some(StorageFailure::Busy),
        // The network, TLS, or an answer that makes no sense.
        sqlx::Error::Io(_)
        | sqlx::Error::Tls(_)
        | sqlx::Error::Protocol(_)
        | sqlx::Error::WorkerCrashed
        | sqlx::Error::PoolClosed
        | sqlx::Error::BeginFailed => Some(StorageFailure::Connection),
        _ => None,
    }
}

/// Returns the failure of an `SQLSTATE`.
fn of_code(code: &str) -> Option<StorageFailure> {
    match code {
        "53100" => Some(StorageFailure::Full),
        "53200" => Some(StorageFailure::Memory),
        // Too many connections, a timeout of a lock or statement, and conflicts of transactions.
        "53000" | "53300" | "53400" | "55P03" | "57014" | "40001" | "40P01" => {
            Some(StorageFailure::Busy)
        }
        "XX001" | "XX002" => Some(StorageFailure::Damaged),
        // The server accepts no writes (a standby), or has ended a transaction that was idle.
        "25006" | "25P03" | "3D000" => Some(StorageFailure::Connection),
        // Another server has taken over.
        super::TAKEN_OVER => Some(StorageFailure::Busy),
        _ => match code.get(..2)? {
            "58" => Some(StorageFailure::Io),
            // Connections, authorisation, and shutdown of the server.
            "08" | "28" | "57" => Some(StorageFailure::Connection),
            _ => None,
        },
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
    fn codes_say_what_failed() {
        let cases = [
            ("53100", Some(StorageFailure::Full)),
            ("53200", Some(StorageFailure::Memory)),
            ("53300", Some(StorageFailure::Busy)),
            ("55P03", Some(StorageFailure::Busy)),
            ("57014", Some(StorageFailure::Busy)),
            ("58030", Some(StorageFailure::Io)),
            ("XX001", Some(StorageFailure::Damaged)),
            ("57P01", Some(StorageFailure::Connection)),
            ("08006", Some(StorageFailure::Connection)),
            ("28P01", Some(StorageFailure::Connection)),
            ("25006", Some(StorageFailure::Connection)),
            // A violated constraint and a wrong statement are errors of the statement.
            ("23505", None),
            ("42P01", None),
            ("25P02", None),
        ];
        for (code, failure) in cases {
            assert_eq!(of_code(code), failure, "{code}");
        }
    }
}
