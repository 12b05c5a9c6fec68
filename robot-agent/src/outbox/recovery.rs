//! Reads the store's files after a start, and repairs what a crash or a failing disk left of them.
//!
//! | what stands behind the last intact frame | it is |
//! |---|---|
//! | bytes at the end of a file, and no record is missing | torn by a crash: cut off |
//! | anything else | damage: the bytes are kept, intact frames behind it are read |
//!
//! What is missing is counted by ordinals: a head says how many records waited when it was written,
//! and ordinals have no gap behind that.

use std::fs::{self, File};
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};

use super::damage::DamagedBytes;
use super::frame::{self, Frame, Head, RecordName};
use super::store::{StoreError, failure, file_path, size};
use crate::durable;

/// Bytes that are read at a time, so that a sector that cannot be read costs no more than those.
const BLOCK_BYTES: usize = 4096;
/// What the operating system says of a sector that cannot be read.
const EIO: i32 = 5;

/// What was found when the store was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Recovery {
    /// Bytes of a frame that a crash left unfinished, cut off.
    pub(super) torn_bytes: u64,
    /// Bytes that are damaged, kept for people.
    pub(super) damaged_bytes: u64,
    /// Records that should be there and are not.
    pub(super) lost_records: u64,
}

/// Whether an error says that a place of the disk cannot be read.
pub(super) fn is_unreadable(cause: &io::Error) -> bool {
    cause.raw_os_error() == Some(EIO) || cause.kind() == io::ErrorKind::UnexpectedEof
}

/// A record where it is in its file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    pub(super) name: RecordName,
    pub(super) at: usize,
    pub(super) bytes: usize,
    pub(super) content_bytes: usize,
}

/// What one file holds.
#[derive(Debug)]
pub(super) struct Scan {
    /// The ordinal after which the file is named.
    pub(super) first_ordinal: u64,
    pub(super) path: PathBuf,
    pub(super) records: Vec<Found>,
    /// What the heads in it say together.
    head: Option<Head>,
    /// The ordinal that a record behind it has at least.
    next_ordinal: u64,
    bytes: usize,
    /// Where no intact frame is.
    spoilt: Vec<Range<usize>>,
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
            spoilt: Vec::new(),
        };
        let mut at = 0;
        while at < bytes.len() {
            let expected = scan.next_ordinal..ordinals.end;
            let Some((found_at, frame, length)) = frame::find(&bytes, at, &expected) else {
                scan.spoilt.push(at..bytes.len());
                break;
            };
            if found_at > at {
                scan.spoilt.push(at..found_at);
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

    /// Makes the file hold its intact frames alone and nothing else; its length then.
    fn repair(
        &mut self,
        is_tail_torn: bool,
        damaged: &mut DamagedBytes,
        recovery: &mut Recovery,
    ) -> Result<u64, StoreError> {
        if self.spoilt.is_empty() {
            return Ok(size(self.bytes));
        }
        let path = &self.path;
        let bytes = read_file(path).map_err(failure("read", path))?;
        for span in &self.spoilt {
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
            // A full disk must not keep what is intact behind it.
            if let Err(cause) = kept {
                tracing::error!("the damaged bytes are not kept: {cause}");
            }
        }
        let spoilt_bytes: usize = self.spoilt.iter().map(Range::len).sum();
        let intact_bytes = self.bytes - spoilt_bytes;
        if intact_bytes == 0 {
            fs::remove_file(path).map_err(failure("remove", path))?;
            return Ok(0);
        }
        let is_tail_alone = self.spoilt.len() == 1 && self.spoilt[0].end == self.bytes;
        if is_tail_alone {
            let file = File::options().write(true).open(path);
            let cut = file.and_then(|file| file.set_len(size(intact_bytes)));
            cut.map_err(failure("repair", path))?;
            return Ok(size(intact_bytes));
        }
        let mut intact = Vec::with_capacity(intact_bytes);
        let mut from = 0;
        for span in &self.spoilt {
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
            let before = self.spoilt.iter().filter(|span| span.end <= record.at);
            record.at -= before.map(Range::len).sum::<usize>();
        }
        Ok(size(intact_bytes))
    }
}

/// What all files hold together.
#[derive(Debug)]
pub(super) struct Recovered {
    /// The files that hold anything, oldest first, and their lengths.
    pub(super) files: Vec<(Scan, u64)>,
    /// Where the store stands; lost records are counted in it.
    pub(super) head: Head,
    /// The ordinal of the next record.
    pub(super) next_ordinal: u64,
    pub(super) recovery: Recovery,
}

/// Reads the files of these names, in order, and repairs them. `known` is what is known of the head
/// from elsewhere.
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
    // From the newest on, so that of each it is known what follows.
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
            // Its name had reached the disk when the machine died, and nothing else.
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

/// How many records should be in these files and are not, and the ordinal behind the last that is
/// known of.
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
    // Files in front of the first were settled and removed, even if no head is left to say so.
    let oldest = scans.first().map_or(0, |scan| scan.first_ordinal);
    let written = written.max(oldest).min(end);
    let lost = head.waiting.saturating_sub(before) + (end - written).saturating_sub(behind);
    (lost, end)
}

/// Reads a whole file; what cannot be read of it is zeros.
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
