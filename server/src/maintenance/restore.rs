//! `tread-server restore` replaces the database by that of a backup. If the fleet's authority is
//! missing, it restores the authority too.
//!
//! ```text
//! lock ─► manifest ─► remove what an interrupted restoration left ─► space ─► extract, compare
//! checksums ─► examine ─► migrate, prepare for robots and people that went on ─► move the old
//! database aside ─► rename the new one ─► report
//! ```
//!
//! It does not change the old database before the new one is complete, and never removes it.

use std::fmt;
use std::fs;
use std::io::{self, IsTerminal as _, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use clap::Args;
use jiff::Timestamp;

use super::review::{self, Review};
use super::unfinished::{SQLITE_SUFFIXES, Unfinished, with_ending};
use super::{ServerFiles, file_of};
use crate::app::backups::check_space;
use crate::authority::{AuthorityError, CERTIFICATE_FILE, copies};
use crate::backup::archive::{self, Extraction, sync_folder};
use crate::backup::{Filter, Manifest};
use crate::build;
use crate::clock::Clock;
use crate::config::BYTES_PER_MIB;
use crate::db::Location;
use crate::db::file::{copy, schema};
use crate::db::lock::DatabaseLock;
use crate::db::restorations::Restoration;
use crate::file_owner;
use crate::paths::folder_of;

/// Suffix of the database while it is restored.
const RESTORING_ENDING: &str = ".restoring";
/// Infix of the names of files and folders that were moved aside.
const REPLACED_INFIX: &str = ".before-restore-";
/// Free space for the log of the database while it is prepared, MiB.
const LOG_MIB: u64 = 16;
/// Step of the progress between printed lines, per cent.
const STEP_PERCENT: u64 = 10;

/// Arguments of `tread-server restore`.
#[derive(Debug, Clone, Args)]
pub(crate) struct RestoreArgs {
    #[command(flatten)]
    files: ServerFiles,
    /// Backup to restore
    #[arg(long, value_name = "FILE")]
    from: PathBuf,
    /// Decrypt with this shell command, from its standard input to its standard output, such as
    /// `age -d -i key.txt`
    #[arg(long, value_name = "COMMAND")]
    decrypt: Option<String>,
    /// Replace an existing database, which is moved aside and kept
    #[arg(long)]
    force: bool,
    /// Replace an existing authority of the fleet too, which is moved aside and kept
    #[arg(long)]
    replace_authority: bool,
}

/// Outcome for the authority.
#[derive(Debug, PartialEq, Eq)]
enum AuthorityOutcome {
    /// The backup or the configuration has none.
    None,
    /// The existing authority stays.
    Kept(PathBuf),
    /// It was restored to the first folder; an earlier one is now in the second folder.
    Restored(PathBuf, Option<PathBuf>),
}

/// Restores a backup.
///
/// # Errors
/// The backup cannot be used, a server runs, a database exists and `--force` is not given, or a
/// file cannot be written.
pub(crate) async fn run(args: RestoreArgs) -> anyhow::Result<()> {
    let config = args.files.clone().load()?;
    let database = file_of(config.database, "restore")?;
    let key = args.decrypt.clone().map(Filter);
    let _lock = DatabaseLock::take(&Location::from(&database))
        .await
        .context("a server uses the database: stop it before you restore a backup")?;
    ensure!(
        args.force || !database.exists(),
        "there is a database `{}`: with `--force` it is moved aside, and kept",
        database.display()
    );
    let manifest = archive::manifest(&args.from, key.as_ref())?;
    refuse_newer(&manifest)?;
    let folder = folder_of(&database);
    ensure!(
        folder.is_dir(),
        "the folder `{}` of the database does not exist; create it first",
        folder.display()
    );
    // What an interrupted restoration left takes the space of this one.
    let restoring = Unfinished::begin(&database, RESTORING_ENDING)?;
    let needed = NeededSpace::of(&manifest);
    check_space(folder, needed.bytes()).with_context(|| needed.to_string())?;
    let now = Clock::system().now();
    let extracted = extract(&args.from, key.as_ref(), &restoring).await?;
    let contents = copy::examine(restoring.path()).await;
    let contents = contents.context("the database in the backup is damaged")?;
    ensure!(
        (contents.schema, &contents.rows) == (manifest.schema, &manifest.rows),
        "the database in the backup is not the one that its manifest describes"
    );
    eprintln!("checked; preparing the database");
    let restoration = Restoration {
        restored_at: now,
        taken_at: manifest.taken_at,
        version: manifest.version.clone(),
    };
    let name = args.from.file_name().unwrap_or_default();
    let name = name.to_string_lossy();
    let review = review::prepare(&Location::from(restoring.path()), &restoration, &name).await?;
    let authority = match &config.robots {
        Some(robots) => restore_authority(
            &robots.authority,
            &extracted.authority,
            (args.replace_authority, now),
        )?,
        None => AuthorityOutcome::None,
    };
    let replaced = replace(&database, restoring, now).await?;
    file_owner::chown_database(&database)?;
    if let AuthorityOutcome::Restored(folder, replaced) = &authority {
        for folder in replaced.iter().chain([folder]) {
            file_owner::chown_to_parents_owner(folder)?;
        }
    }
    let mut out = io::stdout().lock();
    print_outcome(&mut out, (&database, replaced), &restoration, &review)
        .context("cannot print")?;
    print_authority_outcome(&mut out, &authority, &manifest).context("cannot print")?;
    Ok(())
}

/// Space that a restoration needs in the folder of the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct NeededSpace {
    database_mib: u64,
    /// Migrations may write every table once more.
    migrations_mib: u64,
}

impl NeededSpace {
    fn of(manifest: &Manifest) -> Self {
        let database_mib = manifest.database.bytes.div_ceil(BYTES_PER_MIB);
        let is_older = manifest.schema < schema::known();
        Self {
            database_mib,
            migrations_mib: if is_older { database_mib } else { 0 },
        }
    }

    fn bytes(self) -> u64 {
        let mib = self.database_mib.saturating_add(self.migrations_mib);
        mib.saturating_add(LOG_MIB).saturating_mul(BYTES_PER_MIB)
    }
}

impl fmt::Display for NeededSpace {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            database_mib,
            migrations_mib,
        } = self;
        write!(
            formatter,
            "a restoration needs {database_mib} MiB for the database"
        )?;
        if *migrations_mib > 0 {
            write!(
                formatter,
                ", {migrations_mib} MiB for the changes of its schema"
            )?;
        }
        write!(formatter, " and {LOG_MIB} MiB for its log")
    }
}

/// Refuses a backup whose schema this program does not know.
fn refuse_newer(manifest: &Manifest) -> anyhow::Result<()> {
    let (known, version) = (schema::known(), &manifest.version);
    if manifest.schema > known {
        bail!(
            "the backup has schema {} of tread-server {version}, and this is tread-server {} with \
             schema {known}: install version {version} or newer",
            manifest.schema,
            build::VERSION
        );
    }
    Ok(())
}

/// Moves the old database aside, and the new one to its place. Returns the path of the old one.
async fn replace(
    database: &Path,
    restoring: Unfinished,
    now: Timestamp,
) -> anyhow::Result<Option<PathBuf>> {
    let moved = |path: &Path| format!("cannot move `{}` aside", path.display());
    restoring.check_closed()?;
    let is_there = database.exists();
    let to = unused_name(database, now);
    if is_there {
        settle_log(database).await;
    }
    // SQLite would use a log beside the new database as that database's log, also where there is no
    // old one. After a crash here the old database lacks its log, which is among the files that were
    // moved aside.
    for ending in SQLITE_SUFFIXES {
        let beside = with_ending(database, ending);
        if beside.exists() {
            let renamed = fs::rename(&beside, with_ending(&to, ending));
            renamed.with_context(|| moved(&beside))?;
        }
    }
    if is_there {
        // The link keeps a database under this name at every moment: a server that starts
        // meanwhile must not create an empty one.
        fs::hard_link(database, &to).with_context(|| moved(database))?;
    }
    restoring.finish(database)?;
    sync_folder(database)?;
    Ok(is_there.then_some(to))
}

/// Returns a name that no other file has: of two restorations within a second, the second has a number.
fn unused_name(path: &Path, now: Timestamp) -> PathBuf {
    let time = now.strftime("%Y%m%dT%H%M%SZ");
    let first = with_ending(path, &format!("{REPLACED_INFIX}{time}"));
    let numbered = (2_u32..).map(|number| with_ending(&first, &format!("-{number}")));
    let mut names = std::iter::once(first.clone()).chain(numbered);
    names.find(|name| !name.exists()).unwrap_or(first)
}

/// Moves the log of a database into its file, so that one file contains the complete database. A
/// damaged database keeps its log.
async fn settle_log(database: &Path) {
    if let Err(error) = copy::settle_log(database).await {
        eprintln!("the log of the old database stays beside it: {error}");
    }
}

async fn extract(
    from: &Path,
    key: Option<&Filter>,
    restoring: &Unfinished,
) -> anyhow::Result<archive::Extracted> {
    let (from, key, database) = (from.to_owned(), key.cloned(), restoring.path().to_owned());
    let extracting = tokio::task::spawn_blocking(move || {
        let of = archive::manifest(&from, key.as_ref())?.database.bytes;
        let mut shown = None;
        let extraction = Extraction {
            archive: &from,
            key: key.as_ref(),
            database: &database,
        };
        archive::extract(&extraction, &mut |bytes| {
            let percent = (bytes.saturating_mul(100) / of.max(1)).min(100);
            let step = percent / STEP_PERCENT * STEP_PERCENT;
            if shown != Some(step) {
                shown = Some(step);
                show_step(percent);
            }
        })
    });
    Ok(extracting.await??)
}

fn show_step(percent: u64) {
    if io::stderr().is_terminal() {
        eprint!("\r\x1b[Kextracting {percent} %");
        if percent == 100 {
            eprintln!();
        }
    } else {
        eprintln!("extracting {percent} %");
    }
}

/// Restores the authority if there is none, or if `replace` is set. An existing authority otherwise
/// stays, since it is newer than the backup and robots trust it.
fn restore_authority(
    folder: &Path,
    files: &[(String, Vec<u8>)],
    (replace, now): (bool, Timestamp),
) -> Result<AuthorityOutcome, AuthorityError> {
    if files.is_empty() {
        return Ok(AuthorityOutcome::None);
    }
    let is_there = folder.join(CERTIFICATE_FILE).exists();
    if is_there && !replace {
        return Ok(AuthorityOutcome::Kept(folder.to_owned()));
    }
    let mut replaced = None;
    if folder.exists() {
        let to = unused_name(folder, now);
        fs::rename(folder, &to).map_err(|cause| AuthorityError::Unwritable {
            path: folder.to_owned(),
            cause,
        })?;
        replaced = Some(to);
    }
    copies::write_files(folder, files)?;
    Ok(AuthorityOutcome::Restored(folder.to_owned(), replaced))
}

fn print_outcome(
    out: &mut impl Write,
    (database, replaced): (&Path, Option<PathBuf>),
    restoration: &Restoration,
    review: &Review,
) -> io::Result<()> {
    let Restoration {
        taken_at, version, ..
    } = restoration;
    writeln!(
        out,
        "`{}` is restored from a backup of {taken_at:.0} by tread-server {version}",
        database.display()
    )?;
    if let Some(replaced) = replaced {
        writeln!(out, "the old database is `{}`", replaced.display())?;
    }
    review.write(out)
}

fn print_authority_outcome(
    out: &mut impl Write,
    fate: &AuthorityOutcome,
    manifest: &Manifest,
) -> io::Result<()> {
    match fate {
        AuthorityOutcome::None if manifest.authority.is_empty() => Ok(()),
        AuthorityOutcome::None => writeln!(
            out,
            "the backup has a fleet's authority, and the configuration names no folder for it \
             (`[robots] authority`): it was left out"
        ),
        AuthorityOutcome::Kept(folder) => writeln!(
            out,
            "the fleet's authority in `{}` stays, as it is newer; `--replace-authority` takes the one \
             of the backup",
            folder.display()
        ),
        AuthorityOutcome::Restored(folder, replaced) => {
            writeln!(
                out,
                "the fleet's authority is restored to `{}`",
                folder.display()
            )?;
            match replaced {
                Some(replaced) => writeln!(out, "the old one is in `{}`", replaced.display()),
                None => Ok(()),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::backup::manifest::ArchivedFile;

    fn needed(bytes: u64, schema: i64) -> NeededSpace {
        NeededSpace::of(&Manifest {
            format: 1,
            version: "0.1.0".to_owned(),
            commit: None,
            schema,
            taken_at: Timestamp::UNIX_EPOCH,
            database: ArchivedFile {
                name: "tread.db".to_owned(),
                bytes,
                sha256: String::new(),
            },
            rows: BTreeMap::new(),
            authority: Vec::new(),
        })
    }

    #[test]
    fn a_small_backup_needs_little_space_and_one_of_an_older_schema_twice_its_size() {
        let small = needed(600_000, schema::known());
        assert_eq!(small.bytes(), 17 * BYTES_PER_MIB);
        assert_eq!(
            small.to_string(),
            "a restoration needs 1 MiB for the database and 16 MiB for its log"
        );
        let old = needed(300 * BYTES_PER_MIB, schema::known() - 1);
        assert_eq!(old.bytes(), 616 * BYTES_PER_MIB);
        assert_eq!(
            old.to_string(),
            "a restoration needs 300 MiB for the database, 300 MiB for the changes of its schema and \
             16 MiB for its log"
        );
        let absurd = needed(u64::MAX, 0);
        assert_eq!(absurd.bytes(), u64::MAX);
    }
}
