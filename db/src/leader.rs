//! What a standby reads of the server that has the database, and that server of its standbys.

pub use tread_store_postgres::leader::Leader;

use super::{DbError, Tx};

/// Returns what the server that has the database says; nothing of a file, which has one server.
///
/// # Errors
/// The engine failed.
pub async fn get(tx: &mut Tx) -> Result<Leader, DbError> {
    match tx {
        Tx::Sqlite(_) => Ok(Leader::default()),
        Tx::Postgres(tx) => Ok(tread_store_postgres::leader::get(tx).await?),
    }
}

/// Returns the number of standbys that follow a PostgreSQL database; `None` for a file, which has one server.
///
/// # Errors
/// The engine failed.
pub async fn standbys(tx: &mut Tx) -> Result<Option<u64>, DbError> {
    match tx {
        Tx::Sqlite(_) => Ok(None),
        Tx::Postgres(tx) => Ok(Some(tread_store_postgres::leader::standbys(tx).await?)),
    }
}
