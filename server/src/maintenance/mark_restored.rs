//! `tread-server mark-restored` tells a database that its own tools have restored it to an earlier time,
//! as `restore` does for the server's own backups.

use std::io::{self, Write as _};

use anyhow::{Context as _, ensure};
use clap::Args;
use jiff::Timestamp;

use super::{ServerFiles, review};
use crate::build;
use crate::clock::Clock;
use crate::db::lock::DatabaseLock;
use crate::db::restorations::Restoration;

/// Name under which the audit log records it, in place of the file of a backup.
const BACKUP: &str = "restored by the tools of the database";

/// Arguments of `tread-server mark-restored`.
#[derive(Debug, Clone, Args)]
pub(crate) struct MarkRestoredArgs {
    #[command(flatten)]
    files: ServerFiles,
    /// Time of the restored state, such as that of the dump (RFC 3339)
    #[arg(long, value_name = "TIME")]
    taken_at: Timestamp,
}

/// Holds the robots until they are released, ends sessions and join tokens, and prints what to review.
///
/// # Errors
/// The time is to come, a server runs on the database, or it cannot be written.
pub(crate) async fn run(args: MarkRestoredArgs) -> anyhow::Result<()> {
    let location = args.files.load()?.database;
    let now = Clock::system().now();
    ensure!(
        args.taken_at <= now,
        "--taken-at {} is yet to come: give the time of the dump",
        args.taken_at
    );
    ensure!(
        location.file().is_none_or(std::path::Path::exists),
        "there is no database `{location}`: name it by `--database` or in the configuration"
    );
    let lock = DatabaseLock::take(&location)
        .await
        .context("a server uses the database: stop it first")?;
    let restoration = Restoration {
        restored_at: now,
        taken_at: args.taken_at,
        version: build::VERSION.to_owned(),
    };
    let review = review::prepare(&location, &restoration, BACKUP).await?;
    lock.release().await;
    let mut out = io::stdout().lock();
    let taken_at = args.taken_at;
    writeln!(out, "`{location}` counts as restored to {taken_at:.0}").context("cannot print")?;
    review.write(&mut out).context("cannot print")
}
