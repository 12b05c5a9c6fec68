//! Commands on the database and its backups: `tread-server backup`, `copy`, `restore`,
//! `mark-restored` and `migrate`.

pub(crate) mod backup;
pub(crate) mod copy;
pub(crate) mod mark_restored;
pub(crate) mod migrate;
pub(crate) mod restore;
mod review;
mod unfinished;

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;

use crate::config::{Config, ConfigError, ServerArgs};
use crate::db::Location;

/// Arguments that name the server's configuration and database.
#[derive(Debug, Clone, Args)]
pub(crate) struct ServerFiles {
    /// Configuration file of the server, TOML
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Database: a file, or the address `postgres://…` of a PostgreSQL database
    #[arg(long, value_name = "FILE")]
    database: Option<PathBuf>,
}

impl ServerFiles {
    fn load(self) -> Result<Config, ConfigError> {
        Config::load(&ServerArgs {
            config: self.config,
            database: self.database,
            ..ServerArgs::default()
        })
    }
}

/// Returns the file of a database.
///
/// # Errors
/// It is a PostgreSQL database, whose own tools do what `command` does.
fn file_of(database: Location, command: &str) -> anyhow::Result<PathBuf> {
    match database {
        Location::File(path) => Ok(path),
        Location::Postgres(_) => bail!(
            "`{database}` is a PostgreSQL database: its own tools {command} it, as docs/postgresql.md says"
        ),
    }
}
