//! Bounds of waits for the database that do not depend on the engine.

use std::time::Duration;

/// Maximum time that a request waits for a connection.
pub const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum time for a commit, with its sync.
pub const COMMIT_TIMEOUT: Duration = Duration::from_secs(15);
/// Maximum time for a rollback; beyond it the connection is closed instead.
pub const ROLLBACK_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum time for connections to be returned and closed.
pub const CLOSE_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum time for reporting the size of the database and the free space of its disk.
pub const DISK_TIMEOUT: Duration = Duration::from_secs(2);
