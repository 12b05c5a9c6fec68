//! The words of the commands about tokens.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use tread_api::identity::{Role, TOKEN_DAYS_DEFAULT, TOKEN_DAYS_MAX};
use tread_api::ids::TokenId;

use super::Connection;

/// How to show who asks, and whom to trust.
#[derive(Debug, Clone, Default, Args)]
pub(crate) struct Showing {
    /// File with the token; else `TREAD_TOKEN`, else what `tread login` keeps for the server
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) token_file: Option<PathBuf>,
    /// Certificate of the authority to trust, PEM, instead of the machine's
    #[arg(long, global = true, env = "TREAD_CA", value_name = "FILE")]
    pub(crate) ca: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct PlainArguments {
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Args)]
pub(crate) struct TokensArguments {
    #[command(subcommand)]
    pub(crate) action: Option<TokensAction>,
    #[command(flatten)]
    pub(crate) connection: Connection,
}

#[derive(Debug, Subcommand)]
pub(crate) enum TokensAction {
    /// List tokens, newest first, dead ones too
    List,
    /// Make a token; it is printed this once
    Create {
        /// What people call it
        name: String,
        /// What it may do: viewer, operator or admin
        #[arg(long)]
        role: Role,
        /// Days until it is refused
        #[arg(long, value_name = "DAYS", default_value_t = TOKEN_DAYS_DEFAULT,
            value_parser = clap::value_parser!(u32).range(1..=i64::from(TOKEN_DAYS_MAX)))]
        valid_days: u32,
    },
    /// Revoke a token: it is refused from now on, and what it has open closes
    Revoke {
        /// The token's identifier, as `tread tokens` lists it
        token: TokenId,
    },
}

#[derive(Debug, Args)]
pub(crate) struct AuditArguments {
    /// Only what was asked with the token of this name
    #[arg(long)]
    pub(crate) who: Option<String>,
    /// Only what was refused or failed
    #[arg(long)]
    pub(crate) refused: bool,
    /// At most so many, newest first
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub(crate) limit: u32,
    #[command(flatten)]
    pub(crate) connection: Connection,
}
