//! Archive of old measurements: writes those that are due for removal to files before they are removed,
//! and reads them for lists.
//!
//! ```text
//! due ─► a file has them already? ─► compare ─► removable
//!         no │                          │ other contents
//!            └──► write a file ◄────────┘
//!                  └─► compare with the database ─► rename or upload, mark ─► removable
//! ```
//!
//! An uploaded file is read from its bucket and compared once more.
//!
//! A measurement is removable once its file was compared with the database in this run of the server.
//! So a crash between two steps repeats some of them and loses nothing. After a restoration of an older
//! backup, keys are given to other measurements: files with other contents than the database are renamed
//! when the file with the same keys is written, and until then no list shows them, since a list reads
//! files only up to the database's first key.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use jiff::Timestamp;
use jiff::tz::TimeZone;
use tokio::sync::Semaphore;
use tracing::{info, warn};
use tread_api::ids::SiteId;
use tread_api::rights::Scope;
use tread_api::robot::Severity;

use super::sites::SITES_MAX;
use super::{App, AppError};
use crate::archive::{
    ArchivedSegment, Finished, KeyRange, SearchResult, SegmentArchive, SegmentArchiveError,
    Selection, Writer,
};
use crate::db;
use crate::error_text::chain;

/// Code of the alert about measurements that cannot be archived.
pub const ARCHIVE_FAILED_ALERT: &str = "archive-failed";
/// Maximum number of measurements in a file.
pub const FILE_ROWS_MAX: u32 = 1_000_000;
/// Number of measurements that are copied or compared at a time.
const CHUNK_ROWS: u32 = 16_384;
/// Maximum number of requests that read files at the same time; each holds one row group in memory.
const READERS_MAX: usize = 2;
/// Maximum time for which a request waits until it may read files.
const READ_WAIT_MAX: Duration = Duration::from_secs(5);
/// Maximum time for which a request reads files: more than a search may take, and with the wait less than a
/// request may take.
const READ_MAX: Duration = Duration::from_secs(8);

/// The archive and what is known of it.
#[derive(Debug)]
pub(super) struct Archive {
    files: Arc<SegmentArchive>,
    readers: Arc<Semaphore>,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// Keys that were compared with the database and may be removed.
    removable: Option<KeyRange>,
    /// Why the last attempt failed, if it did.
    failure: Option<String>,
    /// Whether a file could be written since the start and the last failure.
    is_writable: bool,
}

impl Archive {
    pub(super) fn new(files: SegmentArchive) -> Self {
        Self {
            files: Arc::new(files),
            readers: Arc::new(Semaphore::new(READERS_MAX)),
            state: Mutex::default(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the last key that may be removed, if the first one may.
    pub(super) fn removable_to(&self, first: i64) -> Option<i64> {
        let removable = self.lock().removable?;
        removable.contains(first).then_some(removable.last)
    }

    /// Reads files for a request, as one of at most [`READERS_MAX`]. The turn ends with the work and not
    /// with its caller, which may be gone: a disk that hangs holds no more threads than these.
    async fn read_in_turn<T: Send + 'static>(
        &self,
        work: impl FnOnce(&SegmentArchive) -> Result<T, SegmentArchiveError> + Send + 'static,
    ) -> Result<T, AppError> {
        let busy = || {
            let folder = self.files.shown();
            AppError::Archive(SegmentArchiveError::Busy { folder })
        };
        let turn = Arc::clone(&self.readers).acquire_owned();
        let Ok(turn) = tokio::time::timeout(READ_WAIT_MAX, turn).await else {
            return Err(busy());
        };
        let reading = self.off_thread(move |files| {
            let _turn = turn;
            work(files)
        });
        let read = tokio::time::timeout(READ_MAX, reading).await;
        read.unwrap_or_else(|_elapsed| Err(busy()))
    }

    /// Runs work on files on a blocking thread.
    async fn off_thread<T: Send + 'static>(
        &self,
        work: impl FnOnce(&SegmentArchive) -> Result<T, SegmentArchiveError> + Send + 'static,
    ) -> Result<T, AppError> {
        let files = Arc::clone(&self.files);
        match tokio::task::spawn_blocking(move || work(&files)).await {
            Ok(done) => done.map_err(AppError::Archive),
            Err(broken) => match broken.try_into_panic() {
                Ok(panic) => std::panic::resume_unwind(panic),
                // The runtime is shutting down, and this task with it.
                Err(_cancelled) => std::future::pending().await,
            },
        }
    }
}

impl App {
    pub(super) fn archive(&self) -> Option<&Archive> {
        self.inner.archive.as_ref()
    }

    /// Returns whether the last attempt to archive failed; `None` without an archive.
    pub fn is_archive_failed(&self) -> Option<bool> {
        let archive = self.archive()?;
        Some(archive.lock().failure.is_some())
    }

    /// Removes what a killed server left unfinished, and checks that files can be written, long before
    /// the first measurements are due.
    pub(super) async fn prepare_archive(&self) -> Result<(), AppError> {
        let Some(archive) = self.archive() else {
            return Ok(());
        };
        let mark = self.archive_mark(archive).await?;
        // A bucket may keep every version of an object, so nothing is written there without need.
        let is_known = archive.files.is_copied() && archive.lock().is_writable;
        let preparing = move |files: &SegmentArchive| {
            let removed = files.remove_unfinished()?;
            files.check_present(mark)?;
            if !is_known {
                files.check_writable()?;
            }
            Ok(removed)
        };
        let removed = archive.off_thread(preparing).await?;
        if removed > 0 {
            let folder = archive.files.shown();
            let folder = folder.display();
            info!("removed {removed} unfinished files of a former run from the archive `{folder}`");
        }
        Ok(())
    }

    /// Returns the mark: which measurements were archived. Moves that of a former version into the
    /// database.
    async fn archive_mark(&self, archive: &Archive) -> Result<Option<KeyRange>, AppError> {
        if let Some(mark) = self.stored_mark().await? {
            return Ok(Some(mark));
        }
        let former = archive.off_thread(SegmentArchive::former_mark).await?;
        if let Some(mark) = former {
            self.set_archive_mark(mark).await?;
            archive
                .off_thread(SegmentArchive::remove_former_mark)
                .await?;
        }
        Ok(former)
    }

    async fn stored_mark(&self) -> Result<Option<KeyRange>, AppError> {
        let reading = async {
            let mut tx = self.db().read("archive").await?;
            db::archive_mark::get(&mut tx).await
        };
        let mark = db::limited(reading).await?;
        Ok(mark.map(|(first, last)| KeyRange { first, last }))
    }

    /// Records that the measurements with these keys are archived.
    async fn set_archive_mark(&self, keys: KeyRange) -> Result<(), AppError> {
        let mark = keys.joined_to(self.stored_mark().await?);
        let mut tx = self.db().write_uncounted("archive").await?;
        db::archive_mark::set(&mut tx, mark.first..=mark.last).await?;
        Ok(tx.commit().await?)
    }

    /// Brings the measurements that are due, or at least the first of them, into the archive. One file
    /// is written at most. `file_rows_max` is [`FILE_ROWS_MAX`], and less in tests.
    pub(super) async fn archive_due(
        &self,
        due: KeyRange,
        file_rows_max: u32,
    ) -> Result<(), AppError> {
        let Some(archive) = self.archive() else {
            return Ok(());
        };
        if archive.removable_to(due.first).is_some() {
            return Ok(());
        }
        let first = due.first;
        let mark = self.stored_mark().await?;
        let listing = move |files: &SegmentArchive| {
            let listed = files.list()?;
            files.check_end(&listed, mark, first)?;
            Ok(listed)
        };
        let listed = archive.off_thread(listing).await?;
        if let Some(&keys) = listed.files.iter().find(|keys| keys.contains(first))
            && self.is_same(archive, &Written::Named(keys), first).await?
        {
            self.set_archive_mark(keys).await?;
            archive.lock().removable = Some(keys);
            return Ok(());
        }
        let Some(last) = self.end_of_file(due, file_rows_max).await? else {
            return Ok(());
        };
        self.write_file(archive, KeyRange { first, last }).await
    }

    /// Returns the last key of the next file, which begins at the first key of `due`: the end of the last
    /// UTC day that is due as a whole and fits into a file. `None` if no whole day is due.
    async fn end_of_file(&self, due: KeyRange, rows_max: u32) -> Result<Option<i64>, AppError> {
        let most = due.first.saturating_add(i64::from(rows_max)) - 1;
        let end = due.last.min(most);
        let mut tx = self.db().read("archive").await?;
        let Some(next_us) = db::segment_ranges::received_at_us(&mut tx, end + 1).await? else {
            return Ok(None);
        };
        let day = Timestamp::from_microsecond(next_us).unwrap_or(Timestamp::MIN);
        let day = day.to_zoned(TimeZone::UTC).start_of_day();
        let day = day.map_or(Timestamp::MIN, |day| day.timestamp());
        let whole = db::removed::last_before(&mut tx, day, end).await?;
        let whole = whole.map(|last| last.min(end));
        let whole = whole.filter(|&last| last >= due.first);
        // A day that does not fit into a file is divided.
        Ok(whole.or_else(|| (end == most).then_some(end)))
    }

    /// Writes a file, reads it again, and gives it its name.
    async fn write_file(&self, archive: &Archive, keys: KeyRange) -> Result<(), AppError> {
        let mut writer = archive.off_thread(move |files| files.begin(keys)).await?;
        let mut after = keys.first - 1;
        while after < keys.last {
            let rest = KeyRange {
                first: after + 1,
                ..keys
            };
            let rows = self.rows_of(rest).await?;
            let Some(last) = rows.last() else { break };
            after = last.stored.id;
            let adding = move |_: &SegmentArchive| {
                writer.add(rows)?;
                Ok(writer)
            };
            writer = archive.off_thread(adding).await?;
        }
        let finished = archive.off_thread(move |_| Writer::finish(writer)).await?;
        let finished = Arc::new(finished);
        let written = Written::Finished(Arc::clone(&finished));
        if !self.is_same(archive, &written, keys.first).await? {
            let folder = archive.files.shown();
            return Err(AppError::Archive(SegmentArchiveError::NotAsWritten {
                folder,
            }));
        }
        let publishing = move |files: &SegmentArchive| files.publish(&finished);
        for path in archive.off_thread(publishing).await? {
            warn!(
                "the file of the archive is now `{}`: its keys were given to other measurements after a \
                 restoration, so lists do not show its contents",
                path.display()
            );
        }
        if archive.files.is_copied()
            && !self
                .is_same(archive, &Written::Named(keys), keys.first)
                .await?
        {
            let folder = archive.files.shown();
            return Err(AppError::Archive(SegmentArchiveError::NotAsWritten {
                folder,
            }));
        }
        self.set_archive_mark(keys).await?;
        let count = keys.count().unsigned_abs();
        self.counters().segments_archived.add(count);
        info!(
            "{count} raw measurements from {} to {} were archived",
            keys.first, keys.last
        );
        archive.lock().removable = Some(keys);
        Ok(())
    }

    /// Returns the first measurements of the database in a range of keys.
    async fn rows_of(&self, keys: KeyRange) -> Result<Vec<ArchivedSegment>, AppError> {
        let range = keys.first..=keys.last;
        let reading = async {
            let mut tx = self.db().read("archive").await?;
            let sites = db::sites::list(&mut tx, &Scope::EVERYWHERE, "", SITES_MAX).await?;
            let rows = db::segments::of_all_sites(&mut tx, range, CHUNK_ROWS).await?;
            Ok::<_, AppError>((sites, rows))
        };
        let (sites, rows) = db::limited(reading).await?;
        let site_of = |site_pk: i64| -> Option<SiteId> {
            let row = sites.iter().find(|row| row.pk == site_pk);
            row.map(|row| row.site.id.clone())
        };
        let archived = rows.into_iter().filter_map(|(site_pk, stored)| {
            let site = site_of(site_pk)?;
            Some(ArchivedSegment { site, stored })
        });
        Ok(archived.collect())
    }

    /// Returns whether a file has exactly the database's measurements from a key to the end of the file.
    async fn is_same(
        &self,
        archive: &Archive,
        file: &Written,
        first: i64,
    ) -> Result<bool, AppError> {
        let last = file.keys().last;
        let mut after = first - 1;
        while after < last {
            let rest = KeyRange {
                first: after + 1,
                last,
            };
            let rows = self.rows_of(rest).await?;
            let Some(end) = rows.last().map(|row| row.stored.id) else {
                return Ok(false);
            };
            let (file, count) = (file.clone(), rows.len());
            let reading = move |files: &SegmentArchive| file.read(files, after, count);
            if archive.off_thread(reading).await? != rows {
                return Ok(false);
            }
            after = end;
        }
        Ok(true)
    }

    /// Reads archived measurements for a list, at most `limit`.
    pub(super) async fn read_archive(
        &self,
        archive: &Archive,
        selection: Selection,
        limit: usize,
    ) -> Result<SearchResult, AppError> {
        let mark = self.stored_mark().await?;
        let found = archive
            .read_in_turn(move |files| files.read(&selection, mark, limit))
            .await;
        found.inspect_err(|_| self.counters().archive_failures.one())
    }

    /// Returns how many files there are and their keys, as text, by which changes of the files show.
    pub(super) async fn archive_extent(&self) -> Result<String, AppError> {
        let Some(archive) = self.archive() else {
            return Ok(String::new());
        };
        let listing = archive.read_in_turn(SegmentArchive::list).await?;
        let files = listing.files;
        let (first, last) = (files.first(), files.last());
        Ok(format!("{} {first:?} {last:?}", files.len()))
    }

    /// Shows the result of an attempt to archive: raises the alert after a failure and clears it after
    /// a success.
    pub(super) fn show_archived(&self, failure: Option<&SegmentArchiveError>) {
        let Some(archive) = self.archive() else {
            return;
        };
        if failure.is_some() {
            self.counters().archive_failures.one();
        }
        let failure = failure.map(|cause| chain(cause));
        {
            let mut state = archive.lock();
            state.is_writable = failure.is_none();
            state.failure.clone_from(&failure);
        }
        let folder = archive.files.shown();
        let folder = folder.display();
        let text = failure.map(|why| {
            format!(
                "old measurements cannot be archived in `{folder}`, so none is removed from the \
                 database: {why}; correct this, it is tried again every 10 min"
            )
        });
        self.set_server_alert(ARCHIVE_FAILED_ALERT, Severity::Warning, text);
    }
}

/// A file to be compared with the database.
#[derive(Debug, Clone)]
enum Written {
    /// A file of the archive.
    Named(KeyRange),
    /// A file that has no name yet.
    Finished(Arc<Finished>),
}

impl Written {
    fn keys(&self) -> KeyRange {
        match self {
            Self::Named(keys) => *keys,
            Self::Finished(finished) => finished.keys(),
        }
    }

    fn read(
        &self,
        files: &SegmentArchive,
        after: i64,
        limit: usize,
    ) -> Result<Vec<ArchivedSegment>, SegmentArchiveError> {
        match self {
            Self::Named(keys) => files.read_file(*keys, after, limit),
            Self::Finished(finished) => finished.read(after, limit),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::ArchiveLocation;

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_reader_whose_disk_hangs_keeps_its_turn_and_others_are_refused_in_time() {
        let folder = tempfile::tempdir().unwrap();
        let location = ArchiveLocation::Folder(folder.path().join("archive"));
        let archive = Archive::new(SegmentArchive::new(location, None).unwrap());
        let (release, hanging) = std::sync::mpsc::channel::<()>();
        let hanging = Arc::new(Mutex::new(hanging));
        for _ in 0..READERS_MAX {
            let hanging = Arc::clone(&hanging);
            let reading = archive.read_in_turn(move |_| {
                // Ends when the other side is dropped.
                let _ = hanging.lock().unwrap().recv();
                Ok(())
            });
            // The request is gone; its thread is not.
            let gone = tokio::time::timeout(Duration::from_millis(10), reading).await;
            assert!(gone.is_err());
        }
        let refused = archive.read_in_turn(|_| Ok(())).await;
        assert!(matches!(
            refused,
            Err(AppError::Archive(SegmentArchiveError::Busy { .. }))
        ));
        drop(release);
        archive.read_in_turn(|_| Ok(())).await.unwrap();
    }
}
