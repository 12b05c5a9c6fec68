//! Reads the store's files at the start, and repairs them after a crash or disk damage.
//!
//! | bytes after the last intact frame | meaning | |---|---| | at the end of a file, and no record
//! is missing | torn by a crash: cut off | | anything else | damage: the bytes are kept, intact
//! frames behind them are read |
//!
//! Missing records are counted by ordinals: a head states how many records waited when it was
//! written, and later ordinals have no gap.

use std::fs::{self, File};
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};

use super::damage::DamagedBytes;
use super::error::{StoreError, failure};
use super::files::{file_path, size};
use super::frame::{self, Frame, Head, RecordName};
use crate::durable;

/// Bytes per read, so that an unreadable sector costs no more than these.
const BLOCK_BYTES: usize = 4096;
/// Error code of the operating system for an unreadable sector.
const EIO: i32 = 5;

/// Findings at the opening of the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Recovery {
    /// Bytes of incomplete frames, which were cut off.
    pub(super) torn_bytes: u64,
    /// Damaged bytes, which are kept for inspection.
    pub(super) damaged_bytes: u64,
    /// Number of missing records.
    pub(super) lost_records: u64,
}

/// Whether the error means that a part of the disk is unreadable.
pub(super) fn is_unreadable(cause: &io::Error) -> bool {
    cause.raw_os_error() == Some(EIO) || cause.kind() == io::ErrorKind::UnexpectedEof
}

/// A record and its position in its file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    pub(super) name: RecordName,
    pub(super) at: usize,
    pub(super) bytes: usize,
    pub(super) content_bytes: usize,
}

/// Content of one file.
#[derive(Debug)]
pub(super) struct Scan {
    /// Ordinal in the file's name.
    pub(super) first_ordinal: u64,
    pub(super) path: PathBuf,
    pub(super) records: Vec<Found>,
    /// All heads in the file, joined.
    head: Option<Head>,
    /// Smallest ordinal that a record after this file can have.
    next_ordinal: u64,
    bytes: usize,
    /// Ranges without an intact frame.
    damaged_ranges: Vec<Range<usize>>,
}

impl Scan {
    fn of(folder: &Path, first_ordinal: u64, ordinals: Range<u64>) -> Result<Self, StoreError> {
        let path = file_path(folder, first_ordinal);
        let bytes = read_file(&path).map_err(failure("read", &path))?;
        let mut scan = Self {
            first_ordinal,
            path,
            records: Vec::new(),
            head: None,
            next_ordinal: ordinals.start.max(first_ordinal),
            bytes: bytes.len(),
            damaged_ranges: Vec::new(),
        };
        let mut at = 0;
        while at < bytes.len() {
            let expected = scan.next_ordinal..ordinals.end;
            let Some((found_at, frame, length)) = frame::find(&bytes, at, &expected) else {
                scan.damaged_ranges.push(at..bytes.len());
                break;
            };
            if found_at > at {
                scan.damaged_ranges.push(at..found_at);
            }
            match frame {
                Frame::Record(name, content) => {
                    scan.next_ordinal = name.ordinal + 1;
                    scan.records.push(Found {
                        name,
                        at: found_at,
                        bytes: length,
                        content_bytes: content.len(),
                    });
                }
                Frame::Head(head) => {
                    scan.head = Some(scan.head.map_or(head, |known| known.joined(head)));
                }
            }
            at = found_at + length;
        }
        Ok(scan)
    }

    /// Rewrites the file with its intact frames alone; returns its new length, bytes.
    fn repair(
        &mut self,
        is_tail_torn: bool,
        damaged: &mut DamagedBytes,
        recovery: &mut Recovery,
    ) -> Result<u64, StoreError> {
        if self.damaged_ranges.is_empty() {
            return Ok(size(self.bytes));
        }
        let path = &self.path;
        let bytes = read_file(path).map_err(failure("read", path))?;
        for span in &self.damaged_ranges {
            if is_tail_torn && span.end == self.bytes {
                recovery.torn_bytes += size(span.len());
                continue;
            }
            recovery.damaged_bytes += size(span.len());
            let kept = damaged.keep(
                path,
                span.clone(),
                bytes.get(span.clone()).unwrap_or_default(),
            );
            // A full disk must not block the intact records.
            if let Err(cause) = kept {
                tracing::error!("the damaged bytes are not kept: {cause}");
            }
        }
        let damaged_bytes: usize = self.damaged_ranges.iter().map(Range::len).sum();
        let intact_bytes = self.bytes - damaged_bytes;
        if intact_bytes == 0 {
            fs::remove_file(path).map_err(failure("remove", path))?;
            return Ok(0);
        }
        let is_tail_alone =
            self.damaged_ranges.len() == 1 && self.damaged_ranges[0].end == self.bytes;
        if is_tail_alone {
            let file = File::options().write(true).open(path);
            let cut = file.and_then(|file| file.set_len(size(intact_bytes)));
            cut.map_err(failure("repair", path))?;
            return Ok(size(intact_bytes));
        }
        let mut intact = Vec::with_capacity(intact_bytes);
        let mut from = 0;
        for span in &self.damaged_ranges {
            intact.extend_from_slice(&bytes[from..span.start]);
            from = span.end;
        }
        intact.extend_from_slice(&bytes[from..]);
        let (folder, name) = (
            path.parent(),
            path.file_name().and_then(|name| name.to_str()),
        );
        if let (Some(folder), Some(name)) = (folder, name) {
            durable::replace(folder, name, &intact).map_err(failure("repair", path))?;
        }
        for record in &mut self.records {
            let before = self
                .damaged_ranges
                .iter()
                .filter(|span| span.end <= record.at);
            record.at -= before.map(Range::len).sum::<usize>();
        }
        Ok(size(intact_bytes))
    }
}

/// Content of all files.
#[derive(Debug)]
pub(super) struct Recovered {
    /// Files with any content, oldest first, and their lengths, bytes.
    pub(super) files: Vec<(Scan, u64)>,
    /// Joined head, with lost records counted.
    pub(super) head: Head,
    /// Ordinal of the next record.
    pub(super) next_ordinal: u64,
    pub(super) recovery: Recovery,
}

/// Reads the files of these names, in order, and repairs them. `known` is the head in the separate
/// head file.
pub(super) fn recover(
    folder: &Path,
    names: &[u64],
    known: Option<Head>,
    damaged: &mut DamagedBytes,
) -> Result<Recovered, StoreError> {
    let mut scans: Vec<Scan> = Vec::with_capacity(names.len());
    for (index, &first_ordinal) in names.iter().enumerate() {
        let from = scans.last().map_or(0, |scan| scan.next_ordinal);
        let below = names.get(index + 1).copied().unwrap_or(u64::MAX);
        scans.push(Scan::of(folder, first_ordinal, from..below)?);
    }
    let heads = scans.iter().filter_map(|scan| scan.head).chain(known);
    let mut head = heads.reduce(Head::joined).unwrap_or_default();
    let (lost_records, end) = lost(&scans, head);
    head.dropped += lost_records;
    head.damaged += lost_records;
    let mut recovery = Recovery {
        lost_records,
        ..Recovery::default()
    };
    let mut next_ordinal = end;
    let mut files = Vec::with_capacity(scans.len());
    // From the newest file on, so that the next ordinal after each file is known.
    let mut follows = end;
    while let Some(mut scan) = scans.pop() {
        let is_tail_torn = follows <= scan.next_ordinal.max(head.first_pending);
        follows = scan
            .records
            .first()
            .map_or(follows, |record| record.name.ordinal);
        let bytes = scan.repair(is_tail_torn, damaged, &mut recovery)?;
        if bytes > 0 {
            next_ordinal = next_ordinal.max(scan.first_ordinal);
            files.push((scan, bytes));
        } else if scan.bytes == 0 {
            // Only the file's name reached the disk before a crash.
            fs::remove_file(&scan.path).map_err(failure("remove", &scan.path))?;
        }
    }
    files.reverse();
    Ok(Recovered {
        files,
        head,
        next_ordinal,
        recovery,
    })
}

/// Returns the number of records that are missing in these files, and the ordinal after the last
/// known one.
fn lost(scans: &[Scan], head: Head) -> (u64, u64) {
    let written = head.next_ordinal.max(head.first_pending);
    let ordinals = scans.iter().flat_map(|scan| &scan.records);
    let waiting = ordinals
        .map(|record| record.name.ordinal)
        .filter(|ordinal| *ordinal >= head.first_pending);
    let (mut before, mut behind, mut end) = (0, 0, written);
    for ordinal in waiting {
        if ordinal < written {
            before += 1;
        } else {
            behind += 1;
        }
        end = end.max(ordinal + 1);
    }
    // Files before the first were settled and removed, even if no head shows it.
    let oldest = scans.first().map_or(0, |scan| scan.first_ordinal);
    let written = written.max(oldest).min(end);
    let lost = head.waiting.saturating_sub(before) + (end - written).saturating_sub(behind);
    (lost, end)
}

/// Reads a whole file; unreadable blocks are zeros.
fn read_file(path: &Path) -> io::Result<Vec<u8>> {
    let file = File::open(path)?;
    let length = usize::try_from(file.metadata()?.len()).map_err(io::Error::other)?;
    read_blocks(length, |block, at| file.read_exact_at(block, at))
}

fn read_blocks(
    length: usize,
    mut read: impl FnMut(&mut [u8], u64) -> io::Result<()>,
) -> io::Result<Vec<u8>> {
    let mut bytes = vec![0; length];
    for (index, block) in bytes.chunks_mut(BLOCK_BYTES).enumerate() {
        match read(block, size(index * BLOCK_BYTES)) {
            Err(cause) if is_unreadable(&cause) => block.fill(0),
            outcome => outcome?,
        }
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sector_that_cannot_be_read_costs_only_itself() {
        let bytes = read_blocks(3 * BLOCK_BYTES - 1, |block, at| {
            if at == size(BLOCK_BYTES) {
                return Err(io::Error::from_raw_os_error(EIO));
            }
            block.fill(7);
            Ok(())
        })
        .unwrap();
        let (first, rest) = bytes.split_at(BLOCK_BYTES);
        let (unreadable, last) = rest.split_at(BLOCK_BYTES);
        assert!(first.iter().chain(last).all(|byte| *byte == 7));
        assert!(unreadable.iter().all(|byte| *byte == 0));
        let denied = |_: &mut [u8], _| Err(io::ErrorKind::PermissionDenied.into());
        assert!(read_blocks(1, denied).is_err());
    }
}
