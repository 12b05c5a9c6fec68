//! Backups of the database and of the fleet's authority, on demand and on a schedule.
//!
//! ```text
//! free space? ─► copy beside the database ─► read the copy ─► archive at the target ─► read it back
//! ```
//!
//! SQLite's `VACUUM INTO` makes the copy in one read transaction, while others may write. The copy is
//! in the database's folder, where its content may be in clear text, until it is in the archive. A
//! lock permits one backup of a database at a time, also if several processes request one.

mod schedule;

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use jiff::Timestamp;
use nix::sys::statvfs::statvfs;

pub(super) use self::schedule::Backups;
pub use self::schedule::{BACKUP_FAILED_ALERT, BACKUP_OLD_ALERT, BackupState, Schedule, run};
use crate::authority::{AuthorityError, copies};
use crate::backup::archive::{self, DATABASE_NAME, describe_authority_file, describe_file};
use crate::backup::manifest::{ArchivedFile, FORMAT};
use crate::backup::{ArchiveError, Filter, Manifest, Source, folder};
use crate::build;
use crate::config::BYTES_PER_MIB;
use crate::db::DbError;
use crate::db::file::copy::{self, CopyPaths};
use crate::file_error::FileError;
use crate::paths::folder_of;

/// Interval of reports about a copy in progress.
const PROGRESS_EVERY: Duration = Duration::from_secs(1);
/// Free space that must remain at the target beyond the archive, bytes.
const TARGET_RESERVE_BYTES: u64 = 16 * 1024 * 1024;
/// Suffix of the copy, after the name of the database.
const COPY_ENDING: &str = ".backup-copy";
/// Suffix of the lock of backups, after the name of the database.
const LOCK_ENDING: &str = ".backup-lock";

/// Reason why no backup was made.
#[derive(Debug, thiserror::Error)]
pub enum BackupError {
    /// Another process makes one.
    #[error("another backup of this database is being made: wait for it")]
    UnderWay,
    /// A folder has too little free space.
    #[error(
        "`{}` has {free_mib} MiB free, and {needed_mib} MiB are needed there: make room, or take \
         another folder", folder.display()
    )]
    NoSpace {
        /// The folder.
        folder: PathBuf,
        /// Required space.
        needed_mib: u64,
        /// Free space.
        free_mib: u64,
    },
    /// A file operation failed.
    #[error(transparent)]
    File(#[from] FileError),
    /// The database cannot be copied.
    #[error("cannot copy the database")]
    Copy(#[source] DbError),
    /// The copy cannot be read, or is damaged.
    #[error("the copy of the database is damaged, and so probably is the database: check it")]
    Examine(#[source] DbError),
    /// The authority's files cannot be read.
    #[error(transparent)]
    Authority(#[from] AuthorityError),
    /// The archive cannot be written.
    #[error(transparent)]
    Archive(#[from] ArchiveError),
    /// A task of the backup panicked.
    #[error("the backup was interrupted")]
    Interrupted,
}

/// What is backed up, and to where.
#[derive(Debug, Clone)]
pub struct Order {
    /// The database.
    pub database: PathBuf,
    /// Folder of the fleet's authority, if the server has one.
    pub authority: Option<PathBuf>,
    /// The file to be written, or the folder for a file named by the time.
    pub target: PathBuf,
    /// Command that encrypts the archive.
    pub encryption: Option<Filter>,
    /// Free space that the server itself needs on the disk of the database, bytes.
    pub reserve_bytes: u64,
    /// Present time.
    pub now: Timestamp,
}

/// A backup that was made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CompletedBackup {
    /// The file.
    pub path: PathBuf,
    /// Its size, bytes.
    pub bytes: u64,
    /// Its manifest.
    pub manifest: Manifest,
}

/// How far a backup is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// The database is copied; `of` is the maximum size of the copy, bytes.
    Copying {
        /// Bytes so far.
        bytes: u64,
        /// Bytes of the whole.
        of: u64,
    },
    /// The copy is read and checked.
    Checking,
    /// The archive is written.
    Writing {
        /// Bytes so far.
        bytes: u64,
        /// Bytes of the whole.
        of: u64,
    },
}

/// Excludes other backups of the same database until it is dropped.
struct BackupLock {
    _file: File,
}

fn beside(database: &Path, ending: &str) -> PathBuf {
    let mut name = database.as_os_str().to_owned();
    name.push(ending);
    name.into()
}

impl BackupLock {
    fn take(database: &Path) -> Result<Self, BackupError> {
        let path = beside(database, LOCK_ENDING);
        let mut options = OpenOptions::new();
        let options = options.write(true).create(true).truncate(false).mode(0o600);
        let file = options.open(&path).map_err(FileError::of("open", &path))?;
        match file.try_lock() {
            Ok(()) => Ok(Self { _file: file }),
            Err(TryLockError::WouldBlock) => Err(BackupError::UnderWay),
            Err(TryLockError::Error(cause)) => Err(FileError::of("lock", &path)(cause).into()),
        }
    }
}

/// Removes the copy when the backup ends, in whatever way.
struct CopyFile(PathBuf);

impl Drop for CopyFile {
    fn drop(&mut self) {
        // If it stays, the next backup removes it.
        let _ = fs::remove_file(&self.0);
    }
}

fn free_bytes(folder: &Path) -> Result<u64, BackupError> {
    let found = statvfs(folder).map_err(|code| FileError::of("examine", folder)(code.into()))?;
    let free = found.blocks_available();
    Ok(free.saturating_mul(found.fragment_size()))
}

/// Refuses when a folder has less free space than needed.
///
/// # Errors
/// [`BackupError::NoSpace`], or the folder cannot be examined.
pub fn check_space(folder: &Path, needed_bytes: u64) -> Result<(), BackupError> {
    let free = free_bytes(folder)?;
    if free >= needed_bytes {
        return Ok(());
    }
    Err(BackupError::NoSpace {
        folder: folder.to_owned(),
        needed_mib: needed_bytes.div_ceil(BYTES_PER_MIB),
        free_mib: free / BYTES_PER_MIB,
    })
}

/// Checks the free space for the copy and for the archive, which may lie on the same disk.
fn check_all_space(order: &Order, target: &Path, size: u64) -> Result<(), BackupError> {
    let (here, there) = (folder_of(&order.database), folder_of(target));
    let disk = |folder: &Path| {
        let about = fs::metadata(folder).map_err(FileError::of("examine", folder));
        about.map(|about| about.dev())
    };
    if disk(here)? == disk(there)? {
        let reserve = order.reserve_bytes.max(TARGET_RESERVE_BYTES);
        return check_space(there, size.saturating_mul(2).saturating_add(reserve));
    }
    check_space(here, size.saturating_add(order.reserve_bytes))?;
    check_space(there, size.saturating_add(TARGET_RESERVE_BYTES))
}

/// Makes a backup: copies the database while others may write to it, checks the copy, and writes the
/// archive. The memory used does not depend on the size of the database.
///
/// # Errors
/// [`BackupError`]; all files of the attempt are removed.
pub async fn make(
    order: Order,
    progress: impl Fn(Progress) + Send + Sync + 'static,
) -> Result<CompletedBackup, BackupError> {
    let target = if order.target.is_dir() {
        let name = folder::name(order.now, order.encryption.is_some());
        order.target.join(name)
    } else {
        order.target.clone()
    };
    let _lock = BackupLock::take(&order.database)?;
    let copy = CopyFile(beside(&order.database, COPY_ENDING));
    // Left behind by a process that was killed.
    match fs::remove_file(&copy.0) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            return Err(FileError::of("remove", &copy.0)(error).into());
        }
        Ok(()) | Err(_) => {}
    }
    let size = copy::size_bytes(&order.database).await;
    let size = size.map_err(|cause| BackupError::Copy(cause.into()))?;
    check_all_space(&order, &target, size)?;
    let paths = CopyPaths {
        database: &order.database,
        target: &copy.0,
    };
    watch_copy(paths, |bytes| {
        progress(Progress::Copying { bytes, of: size });
    })
    .await?;
    progress(Progress::Checking);
    let contents = copy::examine(&copy.0).await;
    let contents = contents.map_err(|cause| BackupError::Examine(cause.into()))?;
    let archiving = tokio::task::spawn_blocking(move || {
        let authority = match &order.authority {
            Some(folder) => copies::read_files(folder)?,
            None => Vec::new(),
        };
        let described = |(name, content): &(String, Vec<u8>)| -> ArchivedFile {
            describe_authority_file(name, content)
        };
        let manifest = Manifest {
            format: FORMAT,
            version: build::VERSION.to_owned(),
            commit: build::commit().map(str::to_owned),
            schema: contents.schema,
            taken_at: order.now,
            database: describe_file(&copy.0, DATABASE_NAME)?,
            rows: contents.rows,
            authority: authority.iter().map(described).collect(),
        };
        let source = Source {
            manifest: &manifest,
            database: &copy.0,
            authority: &authority,
        };
        let of = manifest.database.bytes;
        let mut tell = |bytes| progress(Progress::Writing { bytes, of });
        let archived = archive::write(&target, &source, order.encryption.as_ref(), &mut tell)?;
        Ok(CompletedBackup {
            path: target,
            bytes: archived.bytes,
            manifest,
        })
    });
    archiving.await.unwrap_or(Err(BackupError::Interrupted))
}

/// Copies the database, and reports the size of the copy meanwhile.
async fn watch_copy(paths: CopyPaths<'_>, tell: impl Fn(u64)) -> Result<(), BackupError> {
    let target = paths.target;
    let copying = copy::copy_into(paths);
    tokio::pin!(copying);
    let mut ticks = tokio::time::interval(PROGRESS_EVERY);
    loop {
        tokio::select! {
            copied = &mut copying => return copied.map_err(|cause| BackupError::Copy(cause.into())),
            _ = ticks.tick() => tell(fs::metadata(target).map_or(0, |about| about.len())),
        }
    }
}
