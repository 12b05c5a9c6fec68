//! Commands on the database and its backups: `tread-server backup`, `restore` and `migrate`.

pub(crate) mod backup;
pub(crate) mod migrate;
pub(crate) mod restore;

use std::path::PathBuf;

use clap::Args;

use crate::config::{Config, ConfigError, ServerArgs};

/// Arguments that name the server's configuration and database.
#[derive(Debug, Clone, Args)]
pub(crate) struct ServerFiles {
    /// Configuration file of the server, TOML
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Database file
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
