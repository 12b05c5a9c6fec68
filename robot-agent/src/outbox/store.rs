//! The outbox's files: appended to, synced in batches, removed once everything in them is settled.
//!
//! Records are counted by *ordinals* over the life of the store. A file is named after the first
//! ordinal that it may hold, so a file is settled as soon as the next file's name is not above the
//! head. The head (how far everything is settled) is a frame among the records; it is written with
//! the next sync. After a crash, whatever was synced is as it was; of what was not, a prefix may
//! survive: a record that was settled a moment before may show up again, and the server knows it.

use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use tread_api::ids::BootId;

use super::frame::{self, CONTENT_BYTES_MAX, Frame, Head, RecordName};

/// The ending of the store's files.
const FILE_ENDING: &str = "log";

/// How much a store may hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Most bytes of records that wait; beyond it the oldest are dropped.
    pub pending_bytes_max: u64,
    /// Most records that wait; beyond it the oldest are dropped.
    pub pending_records_max: usize,
    /// A file that has grown past this is followed by the next one.
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

/// Why the store could not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file could not be read, written or removed.
    #[error("the outbox could not {action} `{}`", path.display())]
    File {
        /// What was tried.
        action: &'static str,
        /// On which file.
        path: PathBuf,
        /// What the operating system said.
        #[source]
        source: io::Error,
    },
    /// A record is too large for the store.
    #[error("a record of {0} bytes does not fit in the outbox")]
    TooLarge(usize),
}

fn failure<'path>(
    action: &'static str,
    path: &'path Path,
) -> impl FnOnce(io::Error) -> StoreError + 'path {
    move |source| StoreError::File {
        action,
        path: path.to_owned(),
        source,
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
    content_at: u64,
    content_bytes: usize,
}

/// What was found when the store was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Recovery {
    /// Bytes cut off behind the last whole frame of a file.
    pub(super) torn_bytes: u64,
    /// Records that should be there and are not.
    pub(super) lost_records: u64,
}

/// The files and what they hold. Every call may touch the disk.
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
}

/// Files to sync without holding the store, and the head that is safe once that is done.
#[derive(Debug)]
pub(super) struct SyncTicket {
    files: Vec<(u64, PathBuf, File, u64)>,
    head: Head,
}

impl SyncTicket {
    /// Waits until the disk has it.
    pub(super) fn run(&self) -> Result<(), StoreError> {
        for (_, path, file, _) in &self.files {
            file.sync_data().map_err(failure("sync", path))?;
        }
        Ok(())
    }
}

impl Store {
    /// Opens the store in a folder, which is made if it is not there; repairs torn files.
    pub(super) fn open(
        folder: &Path,
        limits: Limits,
        boot: BootId,
    ) -> Result<(Self, Recovery), StoreError> {
        fs::create_dir_all(folder).map_err(failure("make the folder", folder))?;
        let mut store = Self {
            folder: folder.to_owned(),
            limits,
            boot,
            next_seq: 0,
            next_ordinal: 0,
            files: BTreeMap::new(),
            pending: VecDeque::new(),
            pending_bytes: 0,
            head: Head::default(),
            head_is_dirty: false,
        };
        let mut recovery = Recovery::default();
        for (index, first_ordinal) in file_names(folder)?.into_iter().enumerate() {
            let expected = (index > 0).then_some(store.next_ordinal);
            store.recover_file(first_ordinal, expected, &mut recovery)?;
        }
        store.next_ordinal = store.next_ordinal.max(store.head.first_pending);
        let first_pending = store.head.first_pending;
        store
            .pending
            .retain(|entry| entry.name.ordinal >= first_pending);
        store.pending_bytes = store
            .pending
            .iter()
            .map(|entry| size(entry.content_bytes))
            .sum();
        if recovery.lost_records > 0 {
            store.head.dropped += recovery.lost_records;
            store.head_is_dirty = true;
        }
        // Records that were dropped just before a crash may be back.
        store.make_room(0, 0);
        if store.files.is_empty() {
            store.start_file()?;
        }
        Ok((store, recovery))
    }

    /// Reads one file into the store. `expected` is the ordinal that it should begin with.
    fn recover_file(
        &mut self,
        first_ordinal: u64,
        expected: Option<u64>,
        recovery: &mut Recovery,
    ) -> Result<(), StoreError> {
        let path = file_path(&self.folder, first_ordinal);
        let bytes = fs::read(&path).map_err(failure("read", &path))?;
        let mut next_ordinal = first_ordinal.max(self.next_ordinal);
        let mut at = 0;
        while let Some((frame, length)) = frame::read(&bytes[at..]) {
            match frame {
                Frame::Record(name, content) => {
                    if name.ordinal < next_ordinal {
                        break;
                    }
                    next_ordinal = name.ordinal + 1;
                    self.pending.push_back(Entry {
                        name,
                        file: first_ordinal,
                        content_at: size(at + frame::content_offset()),
                        content_bytes: content.len(),
                    });
                }
                Frame::Head(head) => self.head = head,
            }
            at += length;
        }
        recovery.torn_bytes += size(bytes.len() - at);
        if at == 0 {
            // Nothing of it had reached the disk when the machine died, or nothing is left.
            return fs::remove_file(&path).map_err(failure("remove", &path));
        }
        let settled = expected.map(|expected| expected.max(self.head.first_pending));
        recovery.lost_records += settled.map_or(0, |from| first_ordinal.saturating_sub(from));
        self.next_ordinal = next_ordinal;
        let file = open_for_append(&path)?;
        if at < bytes.len() {
            file.set_len(size(at)).map_err(failure("repair", &path))?;
        }
        let bytes = size(at);
        self.files.insert(
            first_ordinal,
            LogFile {
                path,
                file,
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

    /// Writes one frame behind the newest file; what could be written of a failed one is cut off.
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
                // Nothing may follow a torn frame: the next write starts another file.
                log.bytes = log.bytes.max(self.limits.file_bytes);
            }
            return Err(failure("write", &log.path)(source));
        }
        log.bytes += size(frame.len());
        Ok((first_ordinal, at))
    }

    /// How many records were ever appended: ordinals begin with 0 and have no gap.
    pub(super) fn appended(&self) -> u64 {
        self.next_ordinal
    }

    /// Appends a record; it is safe from a crash after the next sync. A full store drops its
    /// oldest records for it.
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
        let content_at = frame_at + size(frame::content_offset());
        self.pending.push_back(Entry {
            name,
            file,
            content_at,
            content_bytes: content.len(),
        });
        self.pending_bytes += bytes;
        Ok(name)
    }

    /// Drops the oldest records until so many more fit.
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

    /// The oldest records of one run, read from the disk: at least one if any waits.
    pub(super) fn oldest(
        &self,
        records_max: usize,
        bytes_max: u64,
    ) -> Result<Vec<(RecordName, Vec<u8>)>, StoreError> {
        let Some(first) = self.pending.front() else {
            return Ok(Vec::new());
        };
        let mut records = Vec::new();
        let mut bytes = 0;
        for entry in self.pending.iter().take(records_max) {
            bytes += size(entry.content_bytes);
            if entry.name.boot != first.name.boot || (bytes > bytes_max && !records.is_empty()) {
                break;
            }
            records.push((entry.name, self.content(entry)?));
        }
        Ok(records)
    }

    fn content(&self, entry: &Entry) -> Result<Vec<u8>, StoreError> {
        let log = &self.files[&entry.file];
        let mut content = vec![0; entry.content_bytes];
        log.file
            .read_exact_at(&mut content, entry.content_at)
            .map_err(failure("read", &log.path))?;
        Ok(content)
    }

    /// Everything up to this ordinal is settled, `refused` of it by refusal.
    pub(super) fn settle(&mut self, through_ordinal: u64, refused: u64) {
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

    /// Writes the head if it has moved, and names the files to be synced.
    pub(super) fn begin_sync(&mut self) -> Result<SyncTicket, StoreError> {
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
        })
    }

    /// Takes note of a sync that has run: settled files are removed.
    pub(super) fn finish_sync(&mut self, ticket: &SyncTicket) -> Result<(), StoreError> {
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

    /// Records that wait.
    pub(super) fn pending_records(&self) -> usize {
        self.pending.len()
    }

    /// Everything that waits, read from the disk.
    #[cfg(test)]
    pub(super) fn every_pending(&self) -> Result<Vec<(RecordName, Vec<u8>)>, StoreError> {
        self.pending
            .iter()
            .map(|entry| Ok((entry.name, self.content(entry)?)))
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

    /// Bytes of the records that wait.
    #[cfg(test)]
    pub(super) fn pending_bytes(&self) -> u64 {
        self.pending_bytes
    }

    /// Where the store stands.
    pub(super) fn head(&self) -> Head {
        self.head
    }
}

pub(super) fn size(length: usize) -> u64 {
    u64::try_from(length).expect("no machine has longer pointers than 64 bits")
}

fn file_path(folder: &Path, first_ordinal: u64) -> PathBuf {
    folder.join(format!("{first_ordinal:020}.{FILE_ENDING}"))
}

fn file_names(folder: &Path) -> Result<Vec<u64>, StoreError> {
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(failure("list", folder))? {
        let path = entry.map_err(failure("list", folder))?.path();
        let is_ours = path.extension().is_some_and(|ending| ending == FILE_ENDING);
        let stem = path.file_stem().and_then(|stem| stem.to_str());
        if let Some(first_ordinal) = stem
            .filter(|_| is_ours)
            .and_then(|stem| stem.parse::<u64>().ok())
        {
            names.push(first_ordinal);
        }
    }
    names.sort_unstable();
    Ok(names)
}

fn open_for_append(path: &Path) -> Result<File, StoreError> {
    OpenOptions::new()
        .read(true)
        .append(true)
        .create(true)
        .open(path)
        .map_err(failure("open", path))
}

/// Makes new names in a folder safe from a crash.
fn sync_folder(folder: &Path) -> Result<(), StoreError> {
    let open = File::open(folder).map_err(failure("open", folder))?;
    open.sync_all().map_err(failure("sync", folder))
}
