//! Bound of work on the database.

use std::time::Duration;

use super::DbError;

/// Maximum time for background work. It exceeds any real duration; an engine's library may never answer a
/// statement, as that of SQLite does if its thread ends for lack of memory.
const WORK_MAX: Duration = Duration::from_secs(30);

/// Runs work on the database with a maximum time of 30 s.
///
/// # Errors
/// Those of the work; [`DbError::Unanswered`] after that time.
pub async fn limited<T, E: From<DbError>>(
    work: impl Future<Output = Result<T, E>>,
) -> Result<T, E> {
    tokio::time::timeout(WORK_MAX, work)
        .await
        .unwrap_or_else(|_elapsed| Err(DbError::unanswered().into()))
}
