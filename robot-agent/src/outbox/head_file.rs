//! A second copy of the head: one file with two slots that are written in turn, so that a torn or
//! damaged slot leaves the other.
//!
//! The heads among the records are lost with the file that contains them, and a truncated file does
//! not show that records are missing. The head in this file does.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};

use super::error::{StoreError, failure};
use super::frame::{self, Frame, HEAD_FRAME_BYTES, Head};

const FILE_NAME: &str = "head";
/// Offsets of the two slots, bytes.
const PLACES: [u64; 2] = [0, 64];

/// The file, open.
#[derive(Debug)]
pub(super) struct HeadFile {
    path: PathBuf,
    file: File,
    next_place: usize,
}

/// A write of a head that runs without locking the store.
#[derive(Debug)]
pub(super) struct HeadWrite {
    path: PathBuf,
    file: File,
    place: usize,
    frame: Vec<u8>,
}

impl HeadFile {
    /// Opens the file, creating it if missing, and reads its newest head.
    pub(super) fn open(folder: &Path) -> Result<(Self, Option<Head>), StoreError> {
        let path = folder.join(FILE_NAME);
        let mut options = OpenOptions::new();
        let options = options.read(true).write(true).create(true).truncate(false);
        let file = options.open(&path).map_err(failure("open", &path))?;
        let mut heads = [None; PLACES.len()];
        for (head, place) in heads.iter_mut().zip(PLACES) {
            *head = read_at(&file, place).map_err(failure("read", &path))?;
        }
        let newest = heads.into_iter().flatten().reduce(Head::joined);
        // The newest head is not overwritten.
        let next_place = usize::from(heads[0].is_some() && heads[0] == newest);
        let opened = Self {
            path,
            file,
            next_place,
        };
        Ok((opened, newest))
    }

    /// Prepares the write that replaces the older head by this one.
    pub(super) fn write(&self, head: Head) -> Result<HeadWrite, StoreError> {
        let file = self.file.try_clone().map_err(failure("open", &self.path))?;
        let mut frame = Vec::with_capacity(HEAD_FRAME_BYTES);
        frame::write_head(head, &mut frame);
        Ok(HeadWrite {
            path: self.path.clone(),
            file,
            place: self.next_place,
            frame,
        })
    }

    /// Records a completed write: the other slot is the older one now. Without this call, after a
    /// failed write, the same slot is written again and the other one keeps the last durable head.
    pub(super) fn finish(&mut self, written: &HeadWrite) {
        self.next_place = (written.place + 1) % PLACES.len();
    }
}

impl HeadWrite {
    /// Writes the head and waits until it is on disk.
    pub(super) fn run(&self) -> Result<(), StoreError> {
        let written = self.file.write_all_at(&self.frame, PLACES[self.place]);
        written.map_err(failure("write", &self.path))?;
        self.file.sync_data().map_err(failure("sync", &self.path))
    }
}

fn read_at(file: &File, place: u64) -> io::Result<Option<Head>> {
    let mut bytes = [0; HEAD_FRAME_BYTES];
    match file.read_exact_at(&mut bytes, place) {
        Ok(()) => {}
        Err(cause) if cause.kind() == io::ErrorKind::UnexpectedEof => return Ok(None),
        Err(cause) => return Err(cause),
    }
    Ok(match frame::read(&bytes) {
        Some((Frame::Head(head), _)) => Some(head),
        Some((Frame::Record(..), _)) | None => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(first_pending: u64) -> Head {
        Head {
            first_pending,
            next_ordinal: 100,
            waiting: 100 - first_pending,
            ..Head::default()
        }
    }

    #[test]
    fn writes_that_fail_leave_the_last_head_that_is_safe() {
        let folder = tempfile::tempdir().unwrap();
        let (mut file, found) = HeadFile::open(folder.path()).unwrap();
        assert_eq!(found, None);
        for first_pending in 1..=3 {
            let write = file.write(head(first_pending)).unwrap();
            write.run().unwrap();
            file.finish(&write);
        }
        for failures in 1..=3 {
            // The disk fails in the middle of the frame.
            let write = file.write(head(3 + failures)).unwrap();
            let torn = &write.frame[..HEAD_FRAME_BYTES / 2];
            write.file.write_all_at(torn, PLACES[write.place]).unwrap();
            let (_, found) = HeadFile::open(folder.path()).unwrap();
            assert_eq!(found, Some(head(3)), "{failures} failures");
        }
        let write = file.write(head(9)).unwrap();
        write.run().unwrap();
        file.finish(&write);
        assert_eq!(HeadFile::open(folder.path()).unwrap().1, Some(head(9)));
    }
}
