//! Archive of raw measurements: Parquet files in one folder, for programs of any kind.
//!
//! A file holds the measurements of a range of keys, without gaps and in their order. Its name has the
//! first and the last key.
//!
//! ```text
//! *.partial ──► read back ──► *.parquet, which never changes ──► *.superseded
//!  removed at the start                     when the keys are given to other measurements
//! ```
//!
//! The files contain checksums of each row group and of the footer, since Parquet has none that
//! its writers must write. Each file names the last key of the file before it, and the *mark* beside
//! the database has the last archived key, so that a missing file or disk is noticed.

mod checksum;
mod fault;
mod mark;
mod read;
mod rows;
mod schema;
#[cfg(test)]
mod tests;
mod write;

use std::collections::BTreeSet;
use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io;
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

use parquet::errors::ParquetError;
use tread_api::friction::StoredSegment;
use tread_api::ids::{RobotId, SiteId, TerrainId};

use self::mark::Mark;
use self::read::OpenFile;
pub use self::write::{Finished, Writer};
use crate::file_error::FileError;

/// Number of rows of a row group, which is read and checked as a whole.
pub const ROW_GROUP_ROWS: usize = 16_384;
/// Maximum number of measurements that one request searches.
pub const SEARCHED_ROWS_MAX: usize = 64 * ROW_GROUP_ROWS;
/// Maximum number of files that one request opens.
pub const SEARCHED_FILES_MAX: usize = 512;

/// Name of the mark in the folder of the archive, without its suffix.
const MARK_IN_FOLDER: &str = "tread";
/// Suffix of the mark, after the name of the database.
pub const MARK_ENDING: &str = ".archived";
/// Beginning of the name of a file.
const PREFIX: &str = "segments-";
/// End of the name of a file.
const ENDING: &str = ".parquet";
/// End of the name of a file that is being written.
const PARTIAL_ENDING: &str = ".parquet.partial";
/// Name of a file that is created and removed at once. It is one of those that are removed if they remain.
const PROBE_NAME: &str = "segments-probe.parquet.partial";
/// End of the name of a file whose keys were given to other measurements.
const SUPERSEDED_ENDING: &str = ".superseded";
/// End of the name of a file that a person has given up.
const LOST_ENDING: &str = ".lost";
/// Maximum number of superseded files with the same keys.
const SUPERSEDED_MAX: u32 = 1_000;
/// Number of digits of a key in a name, enough for every key.
const KEY_DIGITS: usize = 19;

/// Keys of measurements, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct KeyRange {
    /// The first key.
    pub first: i64,
    /// The last key.
    pub last: i64,
}

impl KeyRange {
    /// Returns whether a key is one of these.
    pub fn contains(self, key: i64) -> bool {
        (self.first..=self.last).contains(&key)
    }

    /// Returns the number of keys.
    pub fn count(self) -> i64 {
        self.last - self.first + 1
    }

    fn overlaps(self, other: Self) -> bool {
        self.first <= other.last && other.first <= self.last
    }

    /// Returns the name of the file with these keys.
    fn name(self) -> String {
        let Self { first, last } = self;
        format!("{PREFIX}{first:0KEY_DIGITS$}-{last:0KEY_DIGITS$}{ENDING}")
    }

    /// Returns the keys in the name of a file; `None` for other names.
    fn of_name(name: &str) -> Option<Self> {
        let keys = name.strip_prefix(PREFIX)?.strip_suffix(ENDING)?;
        let (first, last) = keys.split_once('-')?;
        let is_key = |key: &str| key.len() == KEY_DIGITS && key.bytes().all(|c| c.is_ascii_digit());
        if !(is_key(first) && is_key(last)) {
            return None;
        }
        let (first, last) = (first.parse().ok()?, last.parse().ok()?);
        (1 <= first && first <= last).then_some(Self { first, last })
    }
}

/// What the folder contains.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Listing {
    /// Keys of the files, in their order.
    pub files: Vec<KeyRange>,
    /// Keys of the files that a person has given up.
    pub lost: Vec<KeyRange>,
}

impl Listing {
    fn all(&self) -> impl Iterator<Item = KeyRange> {
        self.files.iter().chain(&self.lost).copied()
    }

    /// Returns the last key before those of a file; `None` if there is none.
    fn preceding(&self, keys: KeyRange) -> Option<i64> {
        let all = self.all().map(|found| found.last);
        all.filter(|last| *last < keys.first).max()
    }
}

/// A measurement with its site, as it is archived.
#[derive(Debug, Clone, PartialEq)]
pub struct ArchivedSegment {
    /// Site of the robot.
    pub site: SiteId,
    /// The measurement.
    pub stored: StoredSegment,
}

/// Which measurements are read.
#[derive(Debug, Clone)]
pub struct Selection {
    /// Only those of this site.
    pub site: Option<SiteId>,
    /// Only those of this robot.
    pub robot: Option<RobotId>,
    /// Only those on this terrain.
    pub terrain: Option<TerrainId>,
    /// Only those of these robots.
    pub robots: Option<BTreeSet<RobotId>>,
    /// Only those with a larger key.
    pub after: i64,
    /// Only those with a smaller key.
    pub before: i64,
}

/// Measurements that were read.
#[derive(Debug, Default)]
pub struct Found {
    /// The measurements, by their keys.
    pub segments: Vec<ArchivedSegment>,
    /// All archived measurements up to this key were searched.
    pub searched_to: i64,
}

/// Failure of the archive.
#[derive(Debug, thiserror::Error)]
pub enum SegmentArchiveError {
    /// An operation on a file failed.
    #[error(transparent)]
    File(#[from] FileError),
    /// A file is damaged, or was not written by this program.
    #[error("`{}` is damaged or no file of this archive: {what}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// Measurements cannot be encoded.
    #[error("cannot write measurements to `{}`", path.display())]
    Encoding {
        /// The file.
        path: PathBuf,
        /// The cause.
        #[source]
        cause: ParquetError,
    },
    /// Archived measurements are missing.
    #[error(
        "the archive `{}` lacks the measurement {key}, which was archived: its disk is not mounted, or \
         a file was removed", folder.display()
    )]
    Missing {
        /// The folder.
        folder: PathBuf,
        /// Key of a missing measurement.
        key: i64,
    },
    /// Two files contain the same keys.
    #[error("`{}` has two files with the measurement {key}: move one of them away", folder.display())]
    Overlap {
        /// The folder.
        folder: PathBuf,
        /// A key that is in both files.
        key: i64,
    },
    /// Other requests read the archive for too long.
    #[error(
        "other requests read the archive `{}`, or its disk does not answer: ask again later",
        folder.display()
    )]
    Busy {
        /// The folder.
        folder: PathBuf,
    },
    /// A new file has other contents than were written to it.
    #[error("a new file in `{}` does not contain what was written: examine the disk", folder.display())]
    NotAsWritten {
        /// The folder.
        folder: PathBuf,
    },
}

/// Returns the file of the mark: beside the database file, or in the folder where there is none.
pub fn mark_of(folder: &Path, database: Option<&Path>) -> PathBuf {
    let in_folder = folder.join(MARK_IN_FOLDER);
    let mut mark = database.unwrap_or(&in_folder).as_os_str().to_owned();
    mark.push(MARK_ENDING);
    mark.into()
}

/// Files of the archive and their folder.
#[derive(Debug, Clone)]
pub struct SegmentArchive {
    folder: PathBuf,
    mark: PathBuf,
}

impl SegmentArchive {
    /// Names the folder of the files, and the file of the mark, which lies beside the database.
    pub fn new(folder: PathBuf, mark: PathBuf) -> Self {
        Self { folder, mark }
    }

    /// Returns the folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    fn path_of(&self, keys: KeyRange) -> PathBuf {
        self.folder.join(keys.name())
    }

    fn create_folder(&self) -> Result<(), FileError> {
        let mut builder = DirBuilder::new();
        let created = builder.recursive(true).mode(0o700).create(&self.folder);
        created.map_err(FileError::of("create", &self.folder))
    }

    /// Returns the names in the folder; none if the folder does not exist.
    fn names(&self) -> Result<Vec<String>, SegmentArchiveError> {
        let failed = || FileError::of("read the folder", &self.folder);
        let entries = match fs::read_dir(&self.folder) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(failed()(error).into()),
        };
        let mut names = Vec::new();
        for entry in entries {
            names.extend(entry.map_err(failed())?.file_name().into_string());
        }
        Ok(names)
    }

    /// Returns the archived files in the order of their keys.
    ///
    /// # Errors
    /// The folder cannot be read, or two files contain the same keys.
    pub fn list(&self) -> Result<Listing, SegmentArchiveError> {
        let names = self.names()?;
        let of_names = |ending: &str| {
            let names = names.iter().filter_map(|name| name.strip_suffix(ending));
            names.filter_map(KeyRange::of_name).collect::<Vec<_>>()
        };
        let (mut files, lost) = (of_names(""), of_names(LOST_ENDING));
        files.sort_unstable_by_key(|keys| (keys.first, keys.last));
        match files.windows(2).find(|pair| pair[0].overlaps(pair[1])) {
            Some(pair) => Err(SegmentArchiveError::Overlap {
                folder: self.folder.clone(),
                key: pair[1].first,
            }),
            None => Ok(Listing { files, lost }),
        }
    }

    /// Checks that the last archived measurement before a key is in one of the files.
    ///
    /// # Errors
    /// It is not.
    pub fn check_end(&self, listing: &Listing, before: i64) -> Result<(), SegmentArchiveError> {
        let Some(mark) = Mark::read(&self.mark)? else {
            return Ok(());
        };
        let key = mark.last.min(before - 1);
        if key < mark.first || listing.all().any(|keys| keys.contains(key)) {
            return Ok(());
        }
        Err(SegmentArchiveError::Missing {
            folder: self.folder.clone(),
            key,
        })
    }

    /// Removes files that a killed server left unfinished. Returns their number.
    ///
    /// # Errors
    /// The folder cannot be read, or a file cannot be removed.
    pub fn remove_unfinished(&self) -> Result<usize, SegmentArchiveError> {
        let names = self.names()?;
        let is_unfinished =
            |name: &&String| name.starts_with(PREFIX) && name.ends_with(PARTIAL_ENDING);
        let unfinished: Vec<&String> = names.iter().filter(is_unfinished).collect();
        for name in &unfinished {
            let path = self.folder.join(name);
            fs::remove_file(&path).map_err(FileError::of("remove", &path))?;
        }
        Ok(unfinished.len())
    }

    /// Checks that the folder is the right one and that files can be written there. Creates it if it is
    /// missing and nothing was archived yet.
    ///
    /// # Errors
    /// The last archived file is missing, or no file can be written.
    pub fn check_writable(&self) -> Result<(), SegmentArchiveError> {
        self.check_end(&self.list()?, i64::MAX)?;
        self.create_folder()?;
        let path = self.folder.join(PROBE_NAME);
        let mut options = OpenOptions::new();
        let created = options.write(true).create(true).mode(0o600).open(&path);
        created.map_err(FileError::of("create", &path))?;
        Ok(fs::remove_file(&path).map_err(FileError::of("remove", &path))?)
    }

    /// Begins a file with these keys, under a temporary name.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn begin(&self, keys: KeyRange) -> Result<Writer, SegmentArchiveError> {
        self.create_folder()?;
        let preceding = self.list()?.preceding(keys);
        let name = keys.name();
        let name = name.strip_suffix(ENDING).unwrap_or(&name);
        let path = self.folder.join(format!("{name}{PARTIAL_ENDING}"));
        Writer::create(path, keys, preceding.unwrap_or_default())
    }

    /// Gives a written file its name, after it has renamed files with the same keys. Returns the new
    /// names of these.
    ///
    /// # Errors
    /// A file cannot be renamed.
    pub fn publish(&self, file: &Finished) -> Result<Vec<PathBuf>, SegmentArchiveError> {
        let keys = file.keys;
        let mut superseded = Vec::new();
        // Not `list`, which refuses files with the same keys.
        let names = self.names()?;
        let mut found = names.iter().filter_map(|name| KeyRange::of_name(name));
        // Its first measurements are in no other file, and would no longer be listed.
        if found.any(|found| found.first < keys.first && found.overlaps(keys)) {
            return Err(SegmentArchiveError::Overlap {
                folder: self.folder.clone(),
                key: keys.first,
            });
        }
        for name in names {
            if KeyRange::of_name(&name).is_some_and(|found| found.overlaps(keys)) {
                superseded.push(self.supersede(&name)?);
            }
        }
        let path = self.path_of(keys);
        file.rename(&path)?;
        self.sync_folder()?;
        Ok(superseded)
    }

    fn supersede(&self, name: &str) -> Result<PathBuf, SegmentArchiveError> {
        let path = self.folder.join(name);
        let numbers = 0..SUPERSEDED_MAX;
        let mut targets = numbers.map(|number| match number {
            0 => self.folder.join(format!("{name}{SUPERSEDED_ENDING}")),
            _ => self
                .folder
                .join(format!("{name}.{number}{SUPERSEDED_ENDING}")),
        });
        let target = targets.find(|target| !target.exists());
        let target = target.unwrap_or_else(|| self.folder.join(name));
        fs::rename(&path, &target).map_err(FileError::of("rename", &path))?;
        Ok(target)
    }

    fn sync_folder(&self) -> Result<(), FileError> {
        let folder = &self.folder;
        let synced = File::open(folder).and_then(|folder| folder.sync_all());
        synced.map_err(FileError::of("sync", folder))
    }

    /// Records that the measurements with these keys are archived.
    ///
    /// # Errors
    /// The mark cannot be written.
    pub fn set_mark(&self, keys: KeyRange) -> Result<(), SegmentArchiveError> {
        let first = match Mark::read(&self.mark)? {
            Some(mark) if mark.first <= keys.first && keys.first <= mark.last.saturating_add(1) => {
                mark.first
            }
            Some(_) | None => keys.first,
        };
        let last = keys.last;
        Ok(Mark { first, last }.write(&self.mark)?)
    }

    /// Reads at most `limit` measurements by their keys. The search ends earlier after
    /// [`SEARCHED_ROWS_MAX`] rows or [`SEARCHED_FILES_MAX`] files; [`Found::searched_to`] says where.
    ///
    /// # Errors
    /// A file cannot be read, is damaged or missing.
    pub fn read(&self, selection: &Selection, limit: usize) -> Result<Found, SegmentArchiveError> {
        let listing = self.list()?;
        self.check_end(&listing, selection.before)?;
        let mut found = Found {
            segments: Vec::new(),
            searched_to: selection.after,
        };
        let mut rows_left = SEARCHED_ROWS_MAX;
        let mut opened = 0;
        for &keys in &listing.files {
            if keys.last <= selection.after || selection.before <= keys.first {
                continue;
            }
            if opened >= SEARCHED_FILES_MAX {
                return Ok(found);
            }
            opened += 1;
            let file = OpenFile::open(&self.path_of(keys), keys)?;
            if let Some(key) = file.missing_before(listing.preceding(keys))? {
                let folder = self.folder.clone();
                return Err(SegmentArchiveError::Missing { folder, key });
            }
            if !file.read(selection, limit, &mut rows_left, &mut found)? {
                return Ok(found);
            }
        }
        found.searched_to = found.searched_to.max(selection.before - 1);
        Ok(found)
    }

    /// Reads all measurements of one file after a key, at most `limit`.
    ///
    /// # Errors
    /// The file cannot be read or is damaged.
    pub fn read_file(
        &self,
        keys: KeyRange,
        after: i64,
        limit: usize,
    ) -> Result<Vec<ArchivedSegment>, SegmentArchiveError> {
        read_path(&self.path_of(keys), keys, after, limit)
    }
}

/// Reads all measurements of a file after a key, at most `limit`.
fn read_path(
    path: &Path,
    keys: KeyRange,
    after: i64,
    limit: usize,
) -> Result<Vec<ArchivedSegment>, SegmentArchiveError> {
    let selection = Selection {
        site: None,
        robot: None,
        terrain: None,
        robots: None,
        after,
        before: i64::MAX,
    };
    let mut found = Found::default();
    let mut rows_left = usize::MAX;
    OpenFile::open(path, keys)?.read(&selection, limit, &mut rows_left, &mut found)?;
    Ok(found.segments)
}
