//! `tread-server migrate` shows or applies the migrations that the database lacks for this version.
//! A server applies them at its start.

use std::io::{self, Write as _};
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context as _, ensure};
use clap::Args;

use super::ServerFiles;
use crate::build;
use crate::clock::Clock;
use crate::db::lock::DatabaseLock;
use crate::db::schema::{self, refuse_newer};
use crate::db::{self, Db};
use crate::file_owner;

/// Exit code of `--check` when migrations are due.
const DUE: u8 = 3;
/// Exit code when a newer version has opened the database.
const NEWER: u8 = 4;

/// Arguments of `tread-server migrate`.
#[derive(Debug, Clone, Args)]
pub(crate) struct MigrateArgs {
    #[command(flatten)]
    files: ServerFiles,
    /// Only show the pending migrations: exit code 0 if there are none, 3 if there are any, 4 if
    /// the database is of a newer version
    #[arg(long)]
    check: bool,
}

/// Comparison of the schemas of file and program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum SchemaComparison {
    /// They are the same, possibly after migrations.
    Same,
    /// Migrations are due, and were not applied.
    Due,
    /// The file is newer.
    Newer,
}

/// Returns the exit code for a result.
pub(crate) fn exit_code(ended: anyhow::Result<SchemaComparison>) -> ExitCode {
    match ended {
        Ok(SchemaComparison::Same) => ExitCode::SUCCESS,
        Ok(SchemaComparison::Due) => ExitCode::from(DUE),
        Ok(SchemaComparison::Newer) => ExitCode::from(NEWER),
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Compares the schemas, and applies the due migrations unless `--check` is given.
///
/// # Errors
/// The configuration is invalid, the file cannot be read, a server runs on it, or a migration
/// failed.
pub(crate) async fn run(args: MigrateArgs) -> anyhow::Result<SchemaComparison> {
    let location = args.files.load()?.database;
    ensure!(
        location.file().is_none_or(Path::exists),
        "there is no database `{location}`: name it by `--database` or in the configuration"
    );
    let found = schema::of(&location).await;
    let found = found.with_context(|| format!("cannot read `{location}`"))?;
    let mut out = io::stdout().lock();
    let of_file = found
        .schema
        .map_or("none".to_owned(), |schema| schema.to_string());
    let by = found.version.as_ref();
    let by = by.map(|version| format!(", last opened by tread-server {version}"));
    let by = by.unwrap_or_default();
    writeln!(out, "schema of `{location}`: {of_file}{by}")?;
    writeln!(
        out,
        "schema of this program: {}, tread-server {}",
        schema::known(&location),
        build::VERSION
    )?;
    let missing = schema::missing_after(&location, found.schema);
    if let Err(newer) = refuse_newer(&location, &found) {
        eprintln!("error: {newer}");
        return Ok(SchemaComparison::Newer);
    }
    if missing.is_empty() {
        writeln!(out, "no migrations are pending")?;
        return Ok(SchemaComparison::Same);
    }
    for (version, description) in &missing {
        writeln!(out, "due: {version} {description}")?;
    }
    if args.check {
        writeln!(
            out,
            "`tread-server migrate`, or a start of the server, applies them; make a backup first: \
             only a backup leads back to the present schema"
        )?;
        return Ok(SchemaComparison::Due);
    }
    let lock = DatabaseLock::take(&location).await?;
    let database = Db::open(&location).await?;
    let noting = async {
        let mut tx = database.write("migrate").await?;
        db::schema::record_version(&mut tx, build::VERSION, Clock::system().now()).await?;
        tx.commit().await?;
        Ok::<_, db::DbError>(())
    };
    let noted = noting.await;
    database.close().await;
    lock.release().await;
    noted.context("cannot write the database")?;
    if let Some(path) = location.file() {
        file_owner::chown_database(path)?;
    }
    writeln!(out, "applied {} migrations", missing.len())?;
    Ok(SchemaComparison::Same)
}
