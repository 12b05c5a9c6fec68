//! What a standby reads of the server that has the database.

use super::{Connection, EngineError, unsigned};

/// The server that has claimed the database last.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Leader {
    /// How often the database was claimed.
    pub epoch: i64,
    /// Address at which other servers reach its REST API, if it has said one.
    pub advertise_url: Option<String>,
    /// Number of writes that changed a site, terrain or robot.
    pub generation: i64,
}

/// Returns what the server that has the database says.
///
/// # Errors
/// PostgreSQL failed.
pub async fn get(db: &mut Connection) -> Result<Leader, EngineError> {
    let leader = sqlx::query_as!(
        Leader,
        "SELECT epoch, advertise_url, generation FROM server_epoch"
    );
    Ok(leader.fetch_one(db).await?)
}

/// Returns the number of other processes that follow the database ([`super::Db::open_to_read`]), as far as the
/// user may see them.
///
/// # Errors
/// PostgreSQL failed.
pub async fn standbys(db: &mut Connection) -> Result<u64, EngineError> {
    let count = sqlx::query_scalar!(
        r#"SELECT COUNT(DISTINCT application_name) AS "count!" FROM pg_stat_activity
           WHERE datname = current_database() AND application_name LIKE 'tread-standby %'"#
    );
    unsigned("count", count.fetch_one(db).await?)
}

/// Makes the caller the server of the database; returns its epoch.
pub(super) async fn claim(
    db: &mut Connection,
    advertise_url: Option<&str>,
) -> Result<i64, EngineError> {
    let epoch = sqlx::query_scalar!(
        "UPDATE server_epoch SET epoch = epoch + 1, advertise_url = $1 RETURNING epoch",
        advertise_url
    );
    Ok(epoch.fetch_one(db).await?)
}
