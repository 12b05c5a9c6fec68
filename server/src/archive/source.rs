//! Bytes of one file of the archive, from a disk or from a bucket.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;

use bytes::buf::Reader;
use bytes::{Buf as _, Bytes};
use parquet::errors::ParquetError;
use parquet::file::reader::{ChunkReader, Length};

use super::bucket::Object;
use super::fault::Fault;

/// Maximum number of bytes that are read into memory at a time; a row group has a few megabytes.
const READ_MAX_BYTES: u64 = 256 * 1024 * 1024;

/// A file that is read.
#[derive(Debug)]
pub(super) enum Source {
    /// On a disk.
    File(File),
    /// In a bucket.
    Object(Object),
}

impl Source {
    /// Returns the number of bytes of the file.
    pub(super) fn length(&self) -> Result<u64, Fault> {
        match self {
            Self::File(file) => Ok(file.metadata()?.len()),
            Self::Object(object) => Ok(object.length()),
        }
    }

    /// Reads a range of bytes.
    pub(super) fn read(&self, range: Range<u64>) -> Result<Bytes, Fault> {
        let Range { start: begin, end } = range;
        let count = end
            .checked_sub(begin)
            .filter(|_| end <= self.length().unwrap_or(0));
        let count = count.ok_or_else(|| invalid("it is too short"))?;
        if count > READ_MAX_BYTES {
            return Err(invalid("a part of it is too long").into());
        }
        match self {
            Self::File(file) => {
                let mut bytes = vec![0; usize::try_from(count).unwrap_or_default()];
                file.read_exact_at(&mut bytes, begin)?;
                Ok(bytes.into())
            }
            Self::Object(object) => object.read(range),
        }
    }
}

/// Returns an error about the content of a file.
pub(super) fn invalid(what: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

/// Some consecutive bytes of a file, as the Parquet decoder reads them.
#[derive(Debug, Clone)]
pub(super) struct Window {
    begin: u64,
    bytes: Bytes,
}

impl Window {
    pub(super) fn new(begin: u64, bytes: Bytes) -> Self {
        Self { begin, bytes }
    }

    fn from(&self, start: u64) -> Result<Bytes, ParquetError> {
        let at = start.checked_sub(self.begin);
        let at = at.and_then(|at| usize::try_from(at).ok());
        match at.filter(|at| *at <= self.bytes.len()) {
            Some(at) => Ok(self.bytes.slice(at..)),
            None => Err(outside()),
        }
    }
}

fn outside() -> ParquetError {
    ParquetError::General("a column is outside of its row group".to_owned())
}

impl Length for Window {
    fn len(&self) -> u64 {
        self.begin + self.bytes.len() as u64
    }
}

impl ChunkReader for Window {
    type T = Reader<Bytes>;

    fn get_read(&self, start: u64) -> Result<Self::T, ParquetError> {
        Ok(self.from(start)?.reader())
    }

    fn get_bytes(&self, start: u64, length: usize) -> Result<Bytes, ParquetError> {
        let bytes = self.from(start)?;
        if length > bytes.len() {
            return Err(outside());
        }
        Ok(bytes.slice(..length))
    }
}
