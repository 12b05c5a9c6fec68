//! Archive of raw measurements: Parquet files in one folder, or in a bucket of S3-compatible storage, for
//! programs of any kind.
//!
//! A file holds the measurements of a range of keys, without gaps and in their order. Its name has the
//! first and the last key.
//!
//! ```text
//! *.partial ──► read back ──► *.parquet, which never changes ──► *.superseded
//!  removed at the start                     when the keys are given to other measurements
//! ```
//!
//! For a bucket the unfinished file is on the disk, without a name; an upload is there as a whole or not at
//! all.
//!
//! The files contain checksums of each row group and of the footer, since Parquet has none that
//! its writers must write. Each file names the last key of the file before it, and the *mark* in the
//! database has the last archived key, so that a missing file or disk is noticed.

mod bucket;
mod checksum;
mod error;
mod fault;
mod folder;
mod keys;
mod location;
mod mark_file;
mod read;
mod reason;
mod rows;
mod schema;
mod source;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_of_buckets;
mod write;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::time::Instant;
use tread_api::friction::StoredSegment;
use tread_api::ids::{RobotId, SiteId, TerrainId};
use uuid::Uuid;

use self::bucket::Bucket;
pub use self::error::SegmentArchiveError;
use self::folder::{Folder, Rename};
use self::keys::{ENDING, PREFIX};
pub use self::keys::{KeyRange, Listing};
pub use self::location::{ArchiveLocation, BucketLocation};
use self::read::OpenFile;
use self::source::Source;
pub use self::write::{Finished, Writer};
use crate::paths::folder_of;

/// Number of rows of a row group, which is read and checked as a whole.
pub const ROW_GROUP_ROWS: usize = 16_384;
/// Maximum number of measurements that one request searches.
pub const SEARCHED_ROWS_MAX: usize = 64 * ROW_GROUP_ROWS;
/// Maximum number of files that one request opens.
pub const SEARCHED_FILES_MAX: usize = 512;

/// End of the name of a file that is being written.
const PARTIAL_ENDING: &str = ".parquet.partial";
/// Time after which one request searches no further, if it has searched something.
pub const SEARCH_MAX: Duration = Duration::from_secs(4);
/// Name of a file that is created and removed at once. It is one of those that are removed if they remain.
const PROBE_NAME: &str = "segments-probe.parquet.partial";
/// End of the name of a file whose keys were given to other measurements.
const SUPERSEDED_ENDING: &str = ".superseded";
/// End of the name of a file that a person has given up.
const LOST_ENDING: &str = ".lost";
/// Maximum number of superseded files with the same keys.
const SUPERSEDED_MAX: u32 = 1_000;

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
pub struct SearchResult {
    /// The measurements, by their keys.
    pub segments: Vec<ArchivedSegment>,
    /// All archived measurements up to this key were searched.
    pub searched_to: i64,
}

/// Returns the mark that a former version wrote beside a database file; `None` if there is none.
pub fn former_mark(database: &Path) -> Option<PathBuf> {
    Some(mark_file::beside(database)).filter(|mark| mark.exists())
}

/// Where the files are.
#[derive(Debug, Clone)]
enum Storage {
    /// In a folder.
    Folder(Folder),
    /// In a bucket; the folder is that of unfinished files.
    Bucket(Bucket, PathBuf),
}

/// Files of the archive and where they are.
#[derive(Debug, Clone)]
pub struct SegmentArchive {
    storage: Storage,
    mark_file: Option<PathBuf>,
}

impl SegmentArchive {
    /// Names the place of the files, and the file of the database if it has one. Creates nothing and
    /// makes no request.
    ///
    /// # Errors
    /// The environment has settings for a bucket that cannot be used.
    pub fn new(
        location: ArchiveLocation,
        database: Option<&Path>,
    ) -> Result<Self, SegmentArchiveError> {
        let mut mark_file = database.map(mark_file::beside);
        let storage = match location {
            ArchiveLocation::Folder(path) => {
                mark_file.get_or_insert_with(|| mark_file::within(&path));
                Storage::Folder(Folder::new(path))
            }
            ArchiveLocation::Bucket(location) => {
                let beside = database.map(folder_of).map(Path::to_owned);
                let unfinished = beside.unwrap_or_else(std::env::temp_dir);
                Storage::Bucket(Bucket::open(location)?, unfinished)
            }
        };
        Ok(Self { storage, mark_file })
    }

    /// Returns where the files are, as shown to people.
    pub fn shown(&self) -> PathBuf {
        match &self.storage {
            Storage::Folder(folder) => folder.path().to_owned(),
            Storage::Bucket(bucket, _) => bucket.shown(),
        }
    }

    fn path_of(&self, keys: KeyRange) -> PathBuf {
        self.shown().join(keys.name())
    }

    /// Returns the names of all files; none if there is no folder yet.
    fn names(&self) -> Result<Vec<String>, SegmentArchiveError> {
        match &self.storage {
            Storage::Folder(folder) => Ok(folder.names()?),
            Storage::Bucket(bucket, _) => bucket.names(PREFIX),
        }
    }

    fn open(&self, keys: KeyRange) -> Result<OpenFile, SegmentArchiveError> {
        let name = keys.name();
        let source = match &self.storage {
            Storage::Folder(folder) => Source::File(folder.open(&name)?),
            Storage::Bucket(bucket, _) => Source::Object(bucket.open_object(&name)?),
        };
        OpenFile::open(self.path_of(keys), source, keys)
    }

    /// Returns the mark that a former version wrote beside the database; `None` if there is none.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn former_mark(&self) -> Result<Option<KeyRange>, SegmentArchiveError> {
        self.mark_file.as_deref().map_or(Ok(None), mark_file::read)
    }

    /// Removes the mark of a former version, after the database has it.
    ///
    /// # Errors
    /// It cannot be removed.
    pub fn remove_former_mark(&self) -> Result<(), SegmentArchiveError> {
        let removed = self.mark_file.as_deref().map_or(Ok(()), mark_file::remove);
        Ok(removed?)
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
                folder: self.shown(),
                key: pair[1].first,
            }),
            None => Ok(Listing { files, lost }),
        }
    }

    /// Checks that the last of the measurements of a mark before a key is in one of the files.
    ///
    /// # Errors
    /// It is not.
    pub fn check_end(
        &self,
        listing: &Listing,
        mark: Option<KeyRange>,
        before: i64,
    ) -> Result<(), SegmentArchiveError> {
        let Some(mark) = mark else {
            return Ok(());
        };
        let key = mark.last.min(before - 1);
        if key < mark.first || listing.all().any(|keys| keys.contains(key)) {
            return Ok(());
        }
        Err(SegmentArchiveError::Missing {
            folder: self.shown(),
            key,
        })
    }

    /// Removes files that a killed server left unfinished. Returns their number.
    ///
    /// # Errors
    /// The folder cannot be read, or a file cannot be removed.
    pub fn remove_unfinished(&self) -> Result<usize, SegmentArchiveError> {
        let Storage::Folder(folder) = &self.storage else {
            return Ok(0);
        };
        let names = folder.names()?;
        let is_unfinished =
            |name: &&String| name.starts_with(PREFIX) && name.ends_with(PARTIAL_ENDING);
        let unfinished: Vec<&String> = names.iter().filter(is_unfinished).collect();
        for name in &unfinished {
            folder.remove(name)?;
        }
        Ok(unfinished.len())
    }

    /// Checks that the place of the files is the right one.
    ///
    /// # Errors
    /// It cannot be read, or the last archived file is missing.
    pub fn check_present(&self, mark: Option<KeyRange>) -> Result<(), SegmentArchiveError> {
        self.check_end(&self.list()?, mark, i64::MAX)
    }

    /// Checks that files can be written. Creates a folder that is missing; call
    /// [`SegmentArchive::check_present`] before.
    ///
    /// # Errors
    /// No file can be written.
    pub fn check_writable(&self) -> Result<(), SegmentArchiveError> {
        match &self.storage {
            Storage::Folder(folder) => Ok(folder.probe(PROBE_NAME)?),
            Storage::Bucket(bucket, _) => bucket.probe(PROBE_NAME),
        }
    }

    /// Begins a file with these keys, under a temporary name.
    ///
    /// # Errors
    /// The file cannot be created.
    pub fn begin(&self, keys: KeyRange) -> Result<Writer, SegmentArchiveError> {
        let preceding = self.list()?.preceding(keys).unwrap_or_default();
        let name = keys.name();
        let name = name.strip_suffix(ENDING).unwrap_or(&name);
        match &self.storage {
            Storage::Folder(folder) => {
                folder.create()?;
                let path = folder.path_of(&format!("{name}{PARTIAL_ENDING}"));
                Writer::create(path, keys, preceding, false)
            }
            Storage::Bucket(_, unfinished) => {
                let path = unfinished.join(format!("{name}.{}{PARTIAL_ENDING}", Uuid::new_v4()));
                Writer::create(path, keys, preceding, true)
            }
        }
    }

    /// Returns whether a published file is a copy of the finished one, which was not compared with the
    /// database.
    pub fn is_copied(&self) -> bool {
        matches!(self.storage, Storage::Bucket(..))
    }

    /// Gives a written file its name, after it has renamed files with the same keys. Returns the new
    /// names of these.
    ///
    /// # Errors
    /// A file cannot be renamed or uploaded.
    pub fn publish(&self, file: &Finished) -> Result<Vec<PathBuf>, SegmentArchiveError> {
        let keys = file.keys;
        let mut superseded = Vec::new();
        // Not `list`, which refuses files with the same keys.
        let names = self.names()?;
        let mut found = names.iter().filter_map(|name| KeyRange::of_name(name));
        // Its first measurements are in no other file, and would no longer be listed.
        if found.any(|found| found.first < keys.first && found.overlaps(keys)) {
            return Err(SegmentArchiveError::Overlap {
                folder: self.shown(),
                key: keys.first,
            });
        }
        for name in &names {
            if KeyRange::of_name(name).is_some_and(|found| found.overlaps(keys)) {
                superseded.push(self.supersede(name, &names)?);
            }
        }
        match &self.storage {
            Storage::Folder(folder) => {
                file.rename(&folder.path_of(&keys.name()))?;
                folder.sync()?;
            }
            Storage::Bucket(bucket, _) => bucket.upload(file.file(), &keys.name())?,
        }
        Ok(superseded)
    }

    fn supersede(&self, name: &str, present: &[String]) -> Result<PathBuf, SegmentArchiveError> {
        let numbers = 0..SUPERSEDED_MAX;
        let mut targets = numbers.map(|number| match number {
            0 => format!("{name}{SUPERSEDED_ENDING}"),
            _ => format!("{name}.{number}{SUPERSEDED_ENDING}"),
        });
        let target = targets.find(|target| !present.contains(target));
        let target = target.ok_or_else(|| SegmentArchiveError::Superseded {
            path: self.shown().join(name),
        })?;
        let names = Rename {
            from: name,
            to: &target,
        };
        match &self.storage {
            Storage::Folder(folder) => folder.rename(names)?,
            Storage::Bucket(bucket, _) => bucket.rename(names)?,
        }
        Ok(self.shown().join(target))
    }

    /// Reads at most `limit` measurements by their keys. The search ends at [`SEARCHED_ROWS_MAX`],
    /// [`SEARCHED_FILES_MAX`] or [`SEARCH_MAX`]; [`SearchResult::searched_to`] says where.
    ///
    /// # Errors
    /// A file cannot be read, is damaged or missing.
    pub fn read(
        &self,
        selection: &Selection,
        mark: Option<KeyRange>,
        limit: usize,
    ) -> Result<SearchResult, SegmentArchiveError> {
        let listing = self.list()?;
        self.check_end(&listing, mark, selection.before)?;
        let mut found = SearchResult {
            segments: Vec::new(),
            searched_to: selection.after,
        };
        let mut budget = Budget {
            rows: SEARCHED_ROWS_MAX,
            ends_at: Some(Instant::now() + SEARCH_MAX),
        };
        let mut opened = 0;
        for &keys in &listing.files {
            if keys.last <= selection.after || selection.before <= keys.first {
                continue;
            }
            if opened >= SEARCHED_FILES_MAX || budget.is_over(selection, &found) {
                return Ok(found);
            }
            opened += 1;
            let file = self.open(keys)?;
            if let Some(key) = file.missing_before(listing.preceding(keys))? {
                let folder = self.shown();
                return Err(SegmentArchiveError::Missing { folder, key });
            }
            if !file.read(selection, limit, &mut budget, &mut found)? {
                return Ok(found);
            }
        }
        found.searched_to = found.searched_to.max(selection.before - 1);
        Ok(found)
    }

    /// Checks that no file is missing or damaged, without a change: of each file the footer, or all of it.
    /// Returns the number of files.
    ///
    /// # Errors
    /// The first fault that is found.
    pub fn examine(
        &self,
        mark: Option<KeyRange>,
        is_deep: bool,
    ) -> Result<usize, SegmentArchiveError> {
        let listing = self.list()?;
        self.check_end(&listing, mark, i64::MAX)?;
        // After a restoration there are files of keys that the database does not know.
        let known = listing.files.iter();
        let known = known.filter(|keys| mark.is_none_or(|mark| keys.first <= mark.last));
        for &keys in known.clone() {
            let file = self.open(keys)?;
            if let Some(key) = file.missing_before(listing.preceding(keys))? {
                let folder = self.shown();
                return Err(SegmentArchiveError::Missing { folder, key });
            }
            if is_deep {
                file.check_rows()?;
            }
        }
        Ok(known.count())
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
        read_all(&self.open(keys)?, after, limit)
    }
}

/// How far a search may go.
struct Budget {
    /// Number of rows that may still be read.
    rows: usize,
    /// Time at which it ends after some progress.
    ends_at: Option<Instant>,
}

impl Budget {
    /// Returns whether the time is over and something was searched.
    fn is_over(&self, selection: &Selection, found: &SearchResult) -> bool {
        let is_late = self.ends_at.is_some_and(|end| end <= Instant::now());
        is_late && found.searched_to > selection.after
    }
}

/// Reads all measurements of a file after a key, at most `limit`. `path` is shown in errors.
fn read_source(
    path: PathBuf,
    source: Source,
    keys: KeyRange,
    after: i64,
    limit: usize,
) -> Result<Vec<ArchivedSegment>, SegmentArchiveError> {
    read_all(&OpenFile::open(path, source, keys)?, after, limit)
}

fn read_all(
    file: &OpenFile,
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
    let mut found = SearchResult::default();
    let mut budget = Budget {
        rows: usize::MAX,
        ends_at: None,
    };
    file.read(&selection, limit, &mut budget, &mut found)?;
    Ok(found.segments)
}
