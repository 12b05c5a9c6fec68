//! The database of a fleet, read beside its server.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use sqlx::postgres::PgRow;
use sqlx::sqlite::{SqliteConnectOptions, SqliteRow};
use sqlx::{ConnectOptions as _, Connection as _, FromRow, PgConnection};

use crate::engine;

/// The database of a fleet: a file, or of PostgreSQL if the environment says so ([`engine`]).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FleetDatabase {
    /// A file of SQLite.
    File(PathBuf),
    /// The address of a PostgreSQL database.
    Postgres(String),
}

impl FleetDatabase {
    /// Names the database of the fleet in a folder, and creates it if it is of PostgreSQL.
    pub(crate) fn of(folder: &Path) -> Self {
        let file = || Self::File(folder.join("tread.db"));
        engine::address_for(folder).map_or_else(file, Self::Postgres)
    }

    /// Returns what `--database` names.
    pub fn argument(&self) -> String {
        match self {
            Self::File(path) => path.display().to_string(),
            Self::Postgres(address) => address.clone(),
        }
    }

    /// Returns the file.
    ///
    /// # Panics
    /// It is a PostgreSQL database.
    pub fn file(&self) -> &Path {
        match self {
            Self::File(path) => path,
            Self::Postgres(_) => panic!("this needs the file of a database, not PostgreSQL"),
        }
    }

    /// Returns the folder in which it lies: of PostgreSQL that of temporary files, where `with-postgres`
    /// starts its server.
    pub fn folder(&self) -> PathBuf {
        match self {
            Self::File(path) => path.parent().unwrap_or(path).to_owned(),
            Self::Postgres(_) => std::env::temp_dir(),
        }
    }

    /// Returns the address of the PostgreSQL server; `None` for a file.
    pub fn server(&self) -> Option<SocketAddr> {
        let Self::Postgres(address) = self else {
            return None;
        };
        let (_, rest) = address.rsplit_once('@')?;
        rest.split('/').next()?.parse().ok()
    }

    /// Returns the same database, reached at another address of its server.
    #[must_use]
    pub fn reached_at(&self, server: SocketAddr) -> Self {
        match (self, self.server()) {
            (Self::Postgres(address), Some(direct)) => {
                let (direct, server) = (format!("@{direct}/"), format!("@{server}/"));
                Self::Postgres(address.replace(&direct, &server))
            }
            (Self::File(_) | Self::Postgres(_), _) => self.clone(),
        }
    }

    /// Runs a statement that both engines know, and returns its rows.
    ///
    /// # Errors
    /// The database cannot be read.
    pub async fn rows<T>(&self, statement: &'static str) -> Result<Vec<T>, sqlx::Error>
    where
        T: Send + Unpin + for<'row> FromRow<'row, SqliteRow> + for<'row> FromRow<'row, PgRow>,
    {
        match self {
            Self::File(path) => {
                let options = SqliteConnectOptions::new().filename(path);
                let mut connection = options.read_only(true).connect().await?;
                let rows = sqlx::query_as(statement).fetch_all(&mut connection).await?;
                connection.close().await?;
                Ok(rows)
            }
            Self::Postgres(address) => {
                let mut connection = PgConnection::connect(address).await?;
                let rows = sqlx::query_as(statement).fetch_all(&mut connection).await?;
                connection.close().await?;
                Ok(rows)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_database_of_postgresql_is_reached_through_another_address() {
        let database = FleetDatabase::Postgres("postgres://u:p@127.0.0.1:5432/fleet".to_owned());
        let server = database.server().unwrap();
        assert_eq!(server, "127.0.0.1:5432".parse().unwrap());
        let through = database.reached_at("127.0.0.1:9".parse().unwrap());
        assert_eq!(through.argument(), "postgres://u:p@127.0.0.1:9/fleet");
        let file = FleetDatabase::File("tread.db".into());
        assert_eq!(file.reached_at(server), file);
    }
}
