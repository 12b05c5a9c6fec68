//! `tread-server copy` copies everything into a new database, from SQLite to PostgreSQL or back, and
//! proves that both contain the same.

use std::fs;
use std::io::{self, IsTerminal as _, Write as _};
use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, anyhow, ensure};
use clap::Args;
use tokio::signal::unix::{SignalKind, signal};
use tokio::time::Instant;

use super::unfinished::{Unfinished, check_absent, with_ending};
use crate::app::backups::check_space;
use crate::archive::former_mark;
use crate::backup::archive::sync_folder;
use crate::db::lock::DatabaseLock;
use crate::db::schema::{self, refuse_newer};
use crate::db::transfer::{self, Copied, Databases, Progress};
use crate::db::{Db, Location};
use crate::file_owner;
use crate::paths::folder_of;

/// Suffix of a file while it is written.
const COPYING_ENDING: &str = ".copying";
/// Free space that must remain besides the copy, for its log, bytes.
const RESERVE_BYTES: u64 = 512 * 1024 * 1024;
/// Maximum time for a commit, whose log may have to reach a replica.
const COMMIT_TIMEOUT: Duration = Duration::from_hours(1);
/// Interval at which progress is printed to a terminal.
const TERMINAL_INTERVAL: Duration = Duration::from_millis(200);
/// Interval at which progress is printed elsewhere.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Arguments of `tread-server copy`.
#[derive(Debug, Clone, Args)]
pub(crate) struct CopyArgs {
    /// Database to copy: a file, or the address `postgres://…` of a PostgreSQL database
    #[arg(value_name = "FROM")]
    from: Location,
    /// New database: a file that does not exist yet, or a PostgreSQL database without rows
    #[arg(value_name = "TO")]
    to: Location,
    /// Print no progress
    #[arg(long)]
    quiet: bool,
}

/// Copies the database, compares both, and prints what was copied.
///
/// # Errors
/// A server runs on either, the schemas are not the present ones, the target is not empty, or a
/// database cannot be read or written. The database that is copied never changes.
pub(crate) async fn run(args: CopyArgs) -> anyhow::Result<()> {
    let CopyArgs { from, to, quiet } = args;
    ensure!(
        from.file().is_none_or(Path::exists),
        "there is no database `{from}`"
    );
    if let Some(file) = to.file() {
        check_absent(file)?;
        ensure!(
            from.file()
                .is_none_or(|from| !is_same(from, &with_ending(file, COPYING_ENDING))),
            "`{from}` is the name of the unfinished copy: give the database another name first"
        );
    }
    let lock = DatabaseLock::take(&from).await;
    let lock =
        lock.with_context(|| format!("cannot have `{from}` alone; stop its server first"))?;
    let found = schema::of(&from).await;
    let found = found.with_context(|| format!("cannot read `{from}`"))?;
    refuse_newer(&from, &found)?;
    ensure!(
        found.schema.is_some(),
        "`{from}` is no database of a server: it has no tables of one"
    );
    ensure!(
        schema::missing_after(&from, found.schema).is_empty(),
        "`{from}` is of an older version: `tread-server migrate --database FROM` brings it up to date; make a \
         backup before"
    );
    if let Some(mark) = from.file().and_then(former_mark) {
        anyhow::bail!(
            "`{}` says which measurements were archived, and the database does not yet: start this version of \
             the server on it once, with its archive",
            mark.display()
        );
    }
    let locked_to = DatabaseLock::take(&to).await;
    let locked_to = locked_to.with_context(|| format!("cannot have `{to}` alone"))?;
    if !quiet {
        eprintln!("checking `{from}`");
    }
    let copying = async {
        let source = Db::open(&from).await?;
        let copied = match &to {
            Location::File(path) => into_file(&source, path, quiet).await,
            Location::Postgres(_) => into_postgres(&source, &to, quiet).await,
        };
        source.close().await;
        copied
    };
    let copied = tokio::select! {
        copied = copying => copied,
        reason = lock.lost() => Err(anyhow!(reason)),
        reason = locked_to.lost() => Err(anyhow!(reason)),
        reason = interruption() => Err(reason),
    };
    locked_to.release().await;
    lock.release().await;
    if let Some(file) = to.file() {
        // The lock of the target has a file too, also if there is no copy.
        file_owner::chown_database(file)?;
    }
    let copied = copied.with_context(|| format!("`{from}` was not copied to `{to}`"))?;
    print_outcome(&copied, &CopyArgs { from, to, quiet }).context("cannot print")
}

/// Returns whether two names lead to one file.
fn is_same(one: &Path, other: &Path) -> bool {
    match (fs::canonicalize(one), fs::canonicalize(other)) {
        (Ok(one), Ok(other)) => one == other,
        (Err(_), _) | (_, Err(_)) => false,
    }
}

/// Waits until somebody wants the command to end, and returns that as the reason of its failure. What is
/// unfinished is removed then.
async fn interruption() -> anyhow::Error {
    let signals = (
        signal(SignalKind::interrupt()),
        signal(SignalKind::terminate()),
        signal(SignalKind::hangup()),
    );
    let (Ok(mut interrupt), Ok(mut terminate), Ok(mut hangup)) = signals else {
        return anyhow!("signals cannot be received");
    };
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
        _ = hangup.recv() => {}
    }
    anyhow!("it was interrupted")
}

async fn into(source: &Db, to: &Location, quiet: bool) -> anyhow::Result<Vec<Copied>> {
    let target = Db::open_with(to, COMMIT_TIMEOUT).await?;
    let mut shown = ProgressPrinter::new(quiet);
    let databases = Databases {
        from: source,
        to: &target,
    };
    let copied = transfer::copy(databases, |progress| shown.show(&progress)).await;
    shown.end();
    target.close().await;
    Ok(copied?)
}

/// Copies into a PostgreSQL database, which is not brought up to date before: it must be new.
async fn into_postgres(source: &Db, to: &Location, quiet: bool) -> anyhow::Result<Vec<Copied>> {
    let found = schema::of(to).await?;
    refuse_newer(to, &found)?;
    ensure!(
        found.schema.is_none() || schema::missing_after(to, found.schema).is_empty(),
        "`{to}` is the database of an older version: name a new one"
    );
    into(source, to, quiet).await
}

/// Copies into a file under a temporary name, which it gets when it is complete.
async fn into_file(source: &Db, path: &Path, quiet: bool) -> anyhow::Result<Vec<Copied>> {
    let folder = folder_of(path);
    let unfinished = Unfinished::begin(path, COPYING_ENDING)?;
    match source.disk().await.and_then(|disk| disk.database_bytes) {
        Some(bytes) => check_space(folder, bytes.saturating_add(RESERVE_BYTES))?,
        None => {
            eprintln!("the size of the database is not known, so the free space is not checked");
        }
    }
    let copied = into(source, &Location::from(unfinished.path()), quiet).await?;
    unfinished.check_closed()?;
    unfinished.finish_new(path)?;
    sync_folder(path)?;
    Ok(copied)
}

/// Prints the progress of the copy.
struct ProgressPrinter {
    interval: Option<Duration>,
    is_terminal: bool,
    at: Instant,
}

impl ProgressPrinter {
    fn new(quiet: bool) -> Self {
        let is_terminal = io::stderr().is_terminal();
        let interval = if is_terminal {
            TERMINAL_INTERVAL
        } else {
            LINE_INTERVAL
        };
        Self {
            interval: (!quiet).then_some(interval),
            is_terminal,
            at: Instant::now(),
        }
    }

    fn show(&mut self, progress: &Progress) {
        if self
            .interval
            .is_none_or(|interval| self.at.elapsed() < interval)
        {
            return;
        }
        self.at = Instant::now();
        let Progress {
            table, rows, of, ..
        } = progress;
        let what = if progress.is_comparing {
            "comparing"
        } else {
            "copying"
        };
        let percent = rows.saturating_mul(100) / (*of).max(1);
        if self.is_terminal {
            eprint!("\r\x1b[K{what} {table}: {rows} of {of} rows, {percent} %");
        } else {
            eprintln!("{what} {table}: {rows} of {of} rows, {percent} %");
        }
    }

    fn end(&self) {
        if self.is_terminal && self.interval.is_some() {
            eprint!("\r\x1b[K");
        }
    }
}

fn print_outcome(copied: &[Copied], args: &CopyArgs) -> io::Result<()> {
    let CopyArgs { from, to, .. } = args;
    let mut out = io::stdout().lock();
    writeln!(out, "{:24} {:>14}  SHA-256 of the rows", "table", "rows")?;
    for one in copied.iter().filter(|one| one.contents.rows > 0) {
        write!(out, "{:24} {:>14}  ", one.table, one.contents.rows)?;
        for byte in one.contents.checksum {
            write!(out, "{byte:02x}")?;
        }
        writeln!(out)?;
    }
    let rows: u64 = copied.iter().map(|one| one.contents.rows).sum();
    writeln!(
        out,
        "{rows} rows of {} tables were read back from `{to}` and are those of `{from}`",
        copied.len()
    )?;
    writeln!(
        out,
        "next: name it as `database` in the configuration. Start no server on `{from}` any more: the robots \
         would get the missions of both"
    )
}
