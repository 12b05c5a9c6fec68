//! Checksums of a file: CRC-32 of the bytes of each row group, and of the footer.
//!
//! The footer contains its own checksum as text. It is computed as if that text were zeros.

use std::fs::File;
use std::io::{self, Write};
use std::ops::Range;
use std::os::unix::fs::FileExt as _;

use bytes::Bytes;
use flate2::Crc;

use super::fault::Fault;
use super::source::{Source, invalid};

/// What stands before the checksum in the footer.
const FOOTER_LABEL: &str = "footer-crc32:";
/// The text in place of the checksum while it is computed.
const ZEROS: &str = "00000000";
/// Bytes after the footer: its length, and the magic number.
const TAIL_BYTES: u64 = 8;
const MAGIC: &[u8] = b"PAR1";
/// Maximum length of a footer, bytes.
const FOOTER_MAX_BYTES: u64 = 16 * 1024 * 1024;

/// A file whose written bytes are summed.
#[derive(Debug)]
pub(super) struct ChecksumWriter {
    file: File,
    crc: Crc,
    written: u64,
}

impl ChecksumWriter {
    pub(super) fn new(file: File) -> Self {
        Self {
            file,
            crc: Crc::new(),
            written: 0,
        }
    }

    /// Returns the total number of bytes written, and the checksum of the bytes since the last call.
    pub(super) fn take(&mut self) -> (u64, u32) {
        let sum = self.crc.sum();
        self.crc.reset();
        (self.written, sum)
    }

    pub(super) fn file(&self) -> &File {
        &self.file
    }

    pub(super) fn into_file(self) -> File {
        self.file
    }
}

impl Write for ChecksumWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let count = self.file.write(bytes)?;
        self.crc.update(&bytes[..count]);
        self.written += count as u64;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Returns the text of the footer's checksum before it is known.
pub(super) fn placeholder() -> String {
    format!("{FOOTER_LABEL}{ZEROS}")
}

/// A footer, the position of its first byte in the file, and that of its checksum in the footer.
struct Footer {
    bytes: Vec<u8>,
    begin: u64,
    checksum_at: usize,
}

impl Footer {
    fn read(source: &Source) -> Result<Self, Fault> {
        let length = source.length()?;
        let tail_at = length.checked_sub(TAIL_BYTES);
        let tail_at = tail_at.ok_or_else(|| invalid("it is too short"))?;
        let tail = source.read(tail_at..length)?;
        let (size, magic) = tail.split_at(tail.len() - MAGIC.len());
        if magic != MAGIC {
            return Err(invalid("it does not end like a Parquet file").into());
        }
        let size = size.try_into().map(u32::from_le_bytes).unwrap_or_default();
        let begin = tail_at.checked_sub(size.into());
        let begin = begin.filter(|_| u64::from(size) <= FOOTER_MAX_BYTES);
        let begin = begin.ok_or_else(|| invalid("its footer has an impossible length"))?;
        let bytes = Vec::from(source.read(begin..tail_at)?);
        let label = FOOTER_LABEL.as_bytes();
        let label_at = bytes.windows(label.len()).rposition(|part| part == label);
        let checksum_at = label_at.map(|at| at + label.len());
        let checksum_at = checksum_at.filter(|at| at + ZEROS.len() <= bytes.len());
        Ok(Self {
            checksum_at: checksum_at.ok_or_else(|| invalid("its footer has no checksum"))?,
            bytes,
            begin,
        })
    }

    /// Replaces the checksum by zeros; returns the former text, and the right one.
    fn sum(&mut self) -> (Vec<u8>, String) {
        let place = self.checksum_at..self.checksum_at + ZEROS.len();
        let former = self.bytes[place.clone()].to_vec();
        self.bytes[place].copy_from_slice(ZEROS.as_bytes());
        let mut crc = Crc::new();
        crc.update(&self.bytes);
        (former, format!("{:08x}", crc.sum()))
    }
}

/// Writes the checksum of the footer of a file on a disk into it.
pub(super) fn seal_footer(file: &File) -> Result<(), Fault> {
    let mut footer = Footer::read(&Source::File(file.try_clone()?))?;
    let (_, right) = footer.sum();
    file.write_all_at(right.as_bytes(), footer.begin + footer.checksum_at as u64)?;
    Ok(())
}

/// A footer whose checksum is right.
pub(super) struct CheckedFooter {
    /// Position of its first byte in the file.
    pub(super) begin: u64,
    /// Its bytes, without its length and the magic number.
    pub(super) bytes: Vec<u8>,
}

/// Reads the footer and checks its checksum.
pub(super) fn read_footer(source: &Source) -> Result<CheckedFooter, Fault> {
    let mut footer = Footer::read(source)?;
    let (former, right) = footer.sum();
    if former != right.as_bytes() {
        return Err(invalid("the checksum of its footer is wrong").into());
    }
    let place = footer.checksum_at..footer.checksum_at + former.len();
    footer.bytes[place].copy_from_slice(&former);
    Ok(CheckedFooter {
        begin: footer.begin,
        bytes: footer.bytes,
    })
}

/// Reads a range of bytes and checks them.
pub(super) fn read_checked(source: &Source, range: Range<u64>, sum: u32) -> Result<Bytes, Fault> {
    let bytes = source.read(range)?;
    let mut crc = Crc::new();
    crc.update(&bytes);
    if crc.sum() == sum {
        return Ok(bytes);
    }
    Err(invalid("the checksum of its rows is wrong").into())
}
