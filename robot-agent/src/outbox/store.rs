//! The outbox's files: appended to, synced in batches, removed once all their records are settled.
//!
//! Records are numbered by *ordinals* over the life of the store. A file is named after the first
//! ordinal that it may contain, so it is settled once the next file's name is not above the head's
//! first waiting ordinal. The head is a frame among the records, written with the next sync, and
//! each sync writes a copy of it to a separate file. Damage costs only the records it hits
//! ([`recovery`]). After a crash all synced data are intact; of unsynced data a prefix may survive,
//! so a record settled just before may reappear, and the server recognises it.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use tracing::error;
use tread_api::ids::BootId;

use super::damage::DamagedBytes;
use super::error::{StoreError, failure};
use super::files::{file_names, file_path, size};
use super::frame::{self, CONTENT_BYTES_MAX, Frame, Head, RecordName};
use super::head_file::{HeadFile, HeadWrite};
use super::recovery::{self, Recovery, Scan};

/// Capacity of a store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Largest total of waiting records, bytes; beyond it the oldest are dropped.
    pub pending_bytes_max: u64,
    /// Largest number of waiting records; beyond it the oldest are dropped.
    pub pending_records_max: usize,
    /// Size of a file above which the next one is begun, bytes.
    pub file_bytes: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            pending_bytes_max: 64 * 1024 * 1024,
            pending_records_max: 200_000,
            file_bytes: 1024 * 1024,
        }
    }
}

#[derive(Debug)]
struct LogFile {
    path: PathBuf,
    file: File,
    bytes: u64,
    is_dirty: bool,
}

#[derive(Debug, Clone, Copy)]
struct Entry {
    name: RecordName,
    file: u64,
    frame_at: u64,
    frame_bytes: usize,
    content_bytes: usize,
}

/// The files and their records. Every call may access the disk.
#[derive(Debug)]
pub(super) struct Store {
    folder: PathBuf,
    limits: Limits,
    boot: BootId,
    next_seq: u64,
    next_ordinal: u64,
    files: BTreeMap<u64, LogFile>,
    pending: VecDeque<Entry>,
    pending_bytes: u64,
    head: Head,
    head_is_dirty: bool,
    head_file: HeadFile,
    damaged: DamagedBytes,
    has_damage: bool,
}

/// Records settled by a receipt.
#[derive(Debug, Clone, Copy)]
pub(super) struct Settled {
    /// Ordinal of the last settled record.
    pub(super) through_ordinal: u64,
    /// Number of refused ones among them.
    pub(super) refused: u64,
}

/// Files to sync without locking the store, and the head that is durable afterwards.
#[derive(Debug)]
pub(super) struct SyncTicket {
    files: Vec<(u64, PathBuf, File, u64)>,
    head: Head,
    head_write: HeadWrite,
}

impl SyncTicket {
    /// Syncs the files and writes the head; waits until both are on disk.
    pub(super) fn run(&self) -> Result<(), StoreError> {
        for (_, path, file, _) in &self.files {
            file.sync_data().map_err(failure("sync", path))?;
        }
        // Last, since the head states that the files are synced.
        self.head_write.run()
    }
}

impl Store {
    /// Opens the store in a folder, creating it if missing; repairs torn files.
    pub(super) fn open(
        folder: &Path,
        limits: Limits,
        boot: BootId,
    ) -> Result<(Self, Recovery), StoreError> {
        fs::create_dir_all(folder).map_err(failure("make the folder", folder))?;
        let (head_file, known) = HeadFile::open(folder)?;
        if known.is_none() {
            sync_folder(folder)?;
        }
        let mut damaged = DamagedBytes::new(folder);
        let has_damage = damaged.is_present();
        let found = recovery::recover(folder, &file_names(folder)?, known, &mut damaged)?;
        let recovery = found.recovery;
        let mut store = Self {
            folder: folder.to_owned(),
            limits,
            boot,
            next_seq: 0,
            next_ordinal: found.next_ordinal,
            files: BTreeMap::new(),
            pending: VecDeque::new(),
            pending_bytes: 0,
            head: found.head,
            head_is_dirty: recovery.lost_records > 0,
            head_file,
            damaged,
            has_damage: has_damage || recovery.damaged_bytes > 0 || recovery.lost_records > 0,
        };
        for (scan, bytes) in found.files {
            store.add_recovered_file(&scan, bytes)?;
        }
        // Records dropped just before a crash may have reappeared.
        store.make_room(0, 0);
        if store.files.is_empty() {
            store.start_file()?;
        }
        if recovery.lost_records > 0 {
            // At once, so that they are counted only once.
            let ticket = store.begin_sync()?;
            ticket.run()?;
            store.finish_sync(&ticket)?;
        }
        Ok((store, recovery))
    }

    /// Adds a repaired file of an earlier run.
    fn add_recovered_file(&mut self, scan: &Scan, bytes: u64) -> Result<(), StoreError> {
        let first_pending = self.head.first_pending;
        for record in &scan.records {
            if record.name.ordinal < first_pending {
                continue;
            }
            self.pending_bytes += size(record.content_bytes);
            self.pending.push_back(Entry {
                name: record.name,
                file: scan.first_ordinal,
                frame_at: size(record.at),
                frame_bytes: record.bytes,
                content_bytes: record.content_bytes,
            });
        }
        self.files.insert(
            scan.first_ordinal,
            LogFile {
                path: scan.path.clone(),
                file: open_for_append(&scan.path)?,
                bytes,
                is_dirty: true,
            },
        );
        Ok(())
    }

    fn start_file(&mut self) -> Result<(), StoreError> {
        let path = file_path(&self.folder, self.next_ordinal);
        let file = open_for_append(&path)?;
        sync_folder(&self.folder)?;
        self.files.insert(
            self.next_ordinal,
            LogFile {
                path,
                file,
                bytes: 0,
                is_dirty: false,
            },
        );
        Ok(())
    }

    /// Appends one frame to the newest file; the rest of a failed write is cut off.
    fn write(&mut self, frame: &[u8]) -> Result<(u64, u64), StoreError> {
        let newest_is_full = self
            .files
            .values()
            .next_back()
            .is_none_or(|log| log.bytes >= self.limits.file_bytes);
        if newest_is_full && self.files.keys().next_back() != Some(&self.next_ordinal) {
            self.start_file()?;
        }
        let mut newest = self
            .files
            .last_entry()
            .expect("a store has at least one file");
        let first_ordinal = *newest.key();
        let log = newest.get_mut();
        let at = log.bytes;
        log.is_dirty = true;
        if let Err(source) = log.file.write_all(frame) {
            if log.file.set_len(at).is_err() {
                // Nothing may follow a torn frame: the next write begins another file.
                log.bytes = log.bytes.max(self.limits.file_bytes);
            }
            return Err(failure("write", &log.path)(source));
        }
        log.bytes += size(frame.len());
        Ok((first_ordinal, at))
    }

    /// Returns the number of records ever appended: ordinals begin with 0 and have no gap.
    pub(super) fn appended(&self) -> u64 {
        self.next_ordinal
    }

    /// Appends a record, which is durable after the next sync. A full store drops its oldest
    /// records.
    pub(super) fn append(&mut self, content: &[u8]) -> Result<RecordName, StoreError> {
        let bytes = size(content.len());
        if content.len() > CONTENT_BYTES_MAX || bytes > self.limits.pending_bytes_max {
            return Err(StoreError::TooLarge(content.len()));
        }
        let name = RecordName {
            ordinal: self.next_ordinal,
            boot: self.boot,
            seq: self.next_seq,
        };
        let mut frame = Vec::new();
        frame::write_record(name, content, &mut frame);
        let (file, frame_at) = self.write(&frame)?;
        self.next_ordinal += 1;
        self.next_seq += 1;
        self.make_room(1, bytes);
        self.pending.push_back(Entry {
            name,
            file,
            frame_at,
            frame_bytes: frame.len(),
            content_bytes: content.len(),
        });
        self.pending_bytes += bytes;
        Ok(name)
    }

    /// Drops the oldest records until `records` more with `bytes` of content fit.
    fn make_room(&mut self, records: usize, bytes: u64) {
        while self.pending.len() + records > self.limits.pending_records_max
            || self.pending_bytes + bytes > self.limits.pending_bytes_max
        {
            if self.pop_oldest().is_none() {
                return;
            }
            self.head.dropped += 1;
        }
    }

    fn pop_oldest(&mut self) -> Option<Entry> {
        let entry = self.pending.pop_front()?;
        self.pending_bytes -= size(entry.content_bytes);
        self.head.first_pending = entry.name.ordinal + 1;
        self.head_is_dirty = true;
        Some(entry)
    }

    /// Reads the oldest waiting records of one run, at least one if any waits. A record that was
    /// damaged after it was written is lost and counted.
    pub(super) fn oldest(
        &mut self,
        records_max: usize,
        bytes_max: u64,
    ) -> Result<Vec<(RecordName, Vec<u8>)>, StoreError> {
        while !self.pending.is_empty() {
            let records = self.intact_oldest(records_max, bytes_max)?;
            if !records.is_empty() {
                return Ok(records);
            }
            self.drop_damaged_oldest();
        }
        Ok(Vec::new())
    }

    /// Reads the oldest waiting records of one run up to the first damaged one.
    fn intact_oldest(
        &self,
        records_max: usize,
        bytes_max: u64,
    ) -> Result<Vec<(RecordName, Vec<u8>)>, StoreError> {
        let mut records: Vec<(RecordName, Vec<u8>)> = Vec::new();
        let mut bytes = 0;
        for entry in self.pending.iter().take(records_max) {
            bytes += size(entry.content_bytes);
            let is_of_another_run = records
                .first()
                .is_some_and(|(first, _)| first.boot != entry.name.boot);
            if is_of_another_run || (bytes > bytes_max && !records.is_empty()) {
                break;
            }
            let Some(content) = self.content(entry)? else {
                break;
            };
            records.push((entry.name, content));
        }
        Ok(records)
    }

    /// Drops the oldest record, whose frame is damaged, and counts it.
    fn drop_damaged_oldest(&mut self) {
        let Some(&entry) = self.pending.front() else {
            return;
        };
        let log = &self.files[&entry.file];
        let mut bytes = vec![0; entry.frame_bytes];
        // Unreadable bytes stay zero.
        let _ = log.file.read_exact_at(&mut bytes, entry.frame_at);
        let at = usize::try_from(entry.frame_at).unwrap_or(usize::MAX);
        let place = at..at.saturating_add(entry.frame_bytes);
        // A full disk must not block the intact records.
        if let Err(cause) = self.damaged.keep(&log.path, place, &bytes) {
            error!("the damaged bytes are not kept: {cause}");
        }
        let RecordName { boot, seq, .. } = entry.name;
        error!(%boot, seq, "record {seq} of the outbox is damaged and lost");
        self.pop_oldest();
        self.head.dropped += 1;
        self.head.damaged += 1;
        self.has_damage = true;
    }

    /// Reads a record's content; `None` if its frame is damaged.
    fn content(&self, entry: &Entry) -> Result<Option<Vec<u8>>, StoreError> {
        let log = &self.files[&entry.file];
        let mut bytes = vec![0; entry.frame_bytes];
        match log.file.read_exact_at(&mut bytes, entry.frame_at) {
            Err(cause) if recovery::is_unreadable(&cause) => return Ok(None),
            outcome => outcome.map_err(failure("read", &log.path))?,
        }
        Ok(match frame::read(&bytes) {
            Some((Frame::Record(name, content), _)) if name == entry.name => Some(content.to_vec()),
            Some(_) | None => None,
        })
    }

    /// Removes settled records.
    pub(super) fn settle(&mut self, settled: Settled) {
        let Settled {
            through_ordinal,
            refused,
        } = settled;
        while self
            .pending
            .front()
            .is_some_and(|entry| entry.name.ordinal <= through_ordinal)
        {
            self.pop_oldest();
        }
        self.head.refused += refused;
        self.head_is_dirty |= refused > 0;
    }

    /// Writes the head if it has changed, and returns the files to sync.
    pub(super) fn begin_sync(&mut self) -> Result<SyncTicket, StoreError> {
        self.head.next_ordinal = self.next_ordinal;
        self.head.waiting = size(self.pending.len());
        if self.head_is_dirty {
            let mut frame = Vec::new();
            frame::write_head(self.head, &mut frame);
            self.write(&frame)?;
            self.head_is_dirty = false;
        }
        let mut files = Vec::new();
        for (&first_ordinal, log) in self.files.iter().filter(|(_, log)| log.is_dirty) {
            let file = log.file.try_clone().map_err(failure("open", &log.path))?;
            files.push((first_ordinal, log.path.clone(), file, log.bytes));
        }
        Ok(SyncTicket {
            files,
            head: self.head,
            head_write: self.head_file.write(self.head)?,
        })
    }

    /// Completes a sync: removes settled files.
    pub(super) fn finish_sync(&mut self, ticket: &SyncTicket) -> Result<(), StoreError> {
        self.head_file.finish(&ticket.head_write);
        for (first_ordinal, _, _, bytes) in &ticket.files {
            if let Some(log) = self.files.get_mut(first_ordinal) {
                log.is_dirty = log.bytes != *bytes;
            }
        }
        let names: Vec<u64> = self.files.keys().copied().collect();
        for pair in names.windows(2) {
            if pair[1] > ticket.head.first_pending {
                break;
            }
            if let Some(log) = self.files.remove(&pair[0]) {
                fs::remove_file(&log.path).map_err(failure("remove", &log.path))?;
            }
        }
        Ok(())
    }

    /// Returns the number of waiting records.
    pub(super) fn pending_records(&self) -> usize {
        self.pending.len()
    }

    /// Everything that waits, read from the disk.
    #[cfg(test)]
    pub(super) fn every_pending(&self) -> Result<Vec<(RecordName, Vec<u8>)>, StoreError> {
        self.pending
            .iter()
            .filter_map(|entry| match self.content(entry) {
                Ok(content) => content.map(|content| Ok((entry.name, content))),
                Err(cause) => Some(Err(cause)),
            })
            .collect()
    }

    /// The ordinal that the next record gets.
    #[cfg(test)]
    pub(super) fn next_ordinal(&self) -> u64 {
        self.next_ordinal
    }

    /// Whether something would not survive a crash now.
    #[cfg(test)]
    pub(super) fn has_unsynced(&self) -> bool {
        self.head_is_dirty || self.files.values().any(|log| log.is_dirty)
    }

    /// Returns the total content of waiting records, bytes.
    #[cfg(test)]
    pub(super) fn pending_bytes(&self) -> u64 {
        self.pending_bytes
    }

    /// Returns the state of the store.
    pub(super) fn head(&self) -> Head {
        self.head
    }

    /// Returns the file of damaged bytes, if damage was found in this run, or in an earlier one and
    /// the file has not been removed.
    pub(super) fn damage(&self) -> Option<PathBuf> {
        self.has_damage.then(|| self.damaged.path())
    }
}

fn open_for_append(path: &Path) -> Result<File, StoreError> {
    OpenOptions::new()
        .read(true)
        .append(true)
        .create(true)
        .open(path)
        .map_err(failure("open", path))
}

/// Syncs a folder, so that its new names survive a crash.
fn sync_folder(folder: &Path) -> Result<(), StoreError> {
    let open = File::open(folder).map_err(failure("open", folder))?;
    open.sync_all().map_err(failure("sync", folder))
}
