//! `tread-server backup` makes one backup, with or without a running server.

use std::io::{self, IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use anyhow::{Context as _, ensure};
use clap::Args;

use super::{ServerFiles, file_of};
use crate::app::backups::{self, Order, Progress};
use crate::backup::Filter;
use crate::clock::Clock;

/// Step of the progress between printed lines, per cent.
const STEP_PERCENT: u64 = 10;

/// Arguments of `tread-server backup`.
#[derive(Debug, Clone, Args)]
pub(crate) struct BackupArgs {
    #[command(flatten)]
    files: ServerFiles,
    /// File to write, or an existing folder for a file that is named after the time
    #[arg(long, value_name = "PATH")]
    to: PathBuf,
    /// Encrypt with this shell command, from its standard input to its standard output, such as
    /// `age -r age1…`; the default is the command in `[backup]`
    #[arg(long, value_name = "COMMAND")]
    encrypt: Option<String>,
    /// Do not encrypt, even if `[backup]` has a command for it
    #[arg(long, conflicts_with = "encrypt")]
    plain: bool,
    /// Print no progress
    #[arg(long)]
    quiet: bool,
}

/// Makes the backup, and prints its path.
///
/// # Errors
/// The configuration is invalid, or the backup could not be made.
pub(crate) async fn run(args: BackupArgs) -> anyhow::Result<()> {
    let config = args.files.load()?;
    let database = file_of(config.database, "back up")?;
    ensure!(
        database.exists(),
        "there is no database `{}`: name it by `--database` or in the configuration",
        database.display()
    );
    let configured = config.backup.and_then(|backup| backup.encrypt);
    let command = args.encrypt.or(configured).filter(|_| !args.plain);
    let is_encrypted = command.is_some();
    let order = Order {
        database,
        authority: config.robots.map(|robots| robots.authority),
        target: args.to,
        encryption: command.map(Filter),
        reserve_bytes: config.storage.disk_free_min_bytes(),
        now: Clock::system().now(),
    };
    let is_quiet = args.quiet;
    let shown = Mutex::new(ProgressPrinter::default());
    let made = backups::make(order, move |progress| {
        if !is_quiet && let Ok(mut shown) = shown.lock() {
            shown.show(progress);
        }
    });
    let made = made.await.context("no backup was made")?;
    let path = made.path.display();
    if !is_quiet {
        let rows = made.manifest.rows.iter();
        let rows: Vec<String> = rows
            .map(|(table, count)| format!("{count} {table}"))
            .collect();
        let files = made.manifest.authority.len();
        let rows = rows.join(", ");
        if is_encrypted {
            eprintln!(
                "{} bytes, encrypted from: {rows}; {files} files of the authority. What the command \
                 encrypted cannot be read back without the key: try `tread-server restore --decrypt` \
                 into an empty folder",
                made.bytes
            );
        } else {
            eprintln!(
                "{} bytes, read back: {rows}; {files} files of the authority",
                made.bytes
            );
        }
        if made.manifest.authority.iter().any(|file| {
            Path::new(&file.name)
                .extension()
                .is_some_and(|extension| extension == "key")
        }) {
            eprintln!(
                "it has the key of the fleet's authority: keep it where nobody else can read it"
            );
        }
    }
    writeln!(io::stdout().lock(), "{path}").context("cannot print")?;
    Ok(())
}

/// Prints the progress; contains the last printed one.
#[derive(Default)]
struct ProgressPrinter(Option<(&'static str, u64)>);

impl ProgressPrinter {
    fn show(&mut self, progress: Progress) {
        let (what, bytes, of) = match progress {
            Progress::Copying { bytes, of } => ("copying", bytes, of),
            Progress::Checking => ("checking the copy", 0, 1),
            Progress::Writing { bytes, of } => ("writing", bytes, of),
        };
        let percent = (bytes.saturating_mul(100) / of.max(1)).min(100);
        let step = percent / STEP_PERCENT * STEP_PERCENT;
        if self.0 == Some((what, step)) {
            return;
        }
        self.0 = Some((what, step));
        if io::stderr().is_terminal() {
            eprint!("\r\x1b[K{what} {percent} %");
            if progress == Progress::Checking || percent == 100 {
                eprintln!();
            }
        } else {
            eprintln!("{what} {percent} %");
        }
    }
}
