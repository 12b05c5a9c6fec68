//! Frames of the outbox's files: what is on the disk, byte by byte.
//!
//! | bytes | what |
//! |---|---|
//! | 4 | length of the body, little-endian |
//! | 4 | CRC-32 (IEEE 802.3) of the body |
//! | … | the body: 1 byte kind, then its fields, integers little-endian |
//!
//! Kind 1 is a record: 8 ordinal, 16 boot id, 8 seq, then its content as JSON. Kind 2 is the head:
//! 8 ordinal of the first record that still waits, 8 records dropped and 8 refused since ever.

use tread_api::ids::BootId;
use uuid::Uuid;

/// Length and checksum in front of a body.
pub(super) const HEADER_BYTES: usize = 8;
/// Fields of a record in front of its content.
const RECORD_FIELDS_BYTES: usize = 1 + 8 + 16 + 8;
/// Length of a head's body.
const HEAD_BYTES: usize = 1 + 8 + 8 + 8;
/// Largest body; a length above it is damage.
pub(super) const BODY_BYTES_MAX: usize = 1024 * 1024;
/// Largest content of a record, bytes.
pub const CONTENT_BYTES_MAX: usize = BODY_BYTES_MAX - RECORD_FIELDS_BYTES;

const KIND_RECORD: u8 = 1;
const KIND_HEAD: u8 = 2;

/// Where the outbox stands: what has been settled, and what was lost on the way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Head {
    /// Ordinal of the first record that still waits.
    pub(super) first_pending: u64,
    /// Records dropped since the store was made.
    pub(super) dropped: u64,
    /// Records refused since the store was made.
    pub(super) refused: u64,
}

/// A record's name and place in the order of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RecordName {
    /// Counts all records of this store.
    pub(super) ordinal: u64,
    /// The agent's run that made it.
    pub(super) boot: BootId,
    /// Its number within that run.
    pub(super) seq: u64,
}

/// One frame, read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Frame<'file> {
    Record(RecordName, &'file [u8]),
    Head(Head),
}

const CRC_TABLE: [u32; 256] = {
    let mut table = [0; 256];
    let mut index = 0;
    while index < 256 {
        #[expect(clippy::cast_possible_truncation, reason = "below 256")]
        let mut value = index as u32;
        let mut bit = 0;
        while bit < 8 {
            value = if value & 1 == 1 {
                0xEDB8_8320 ^ (value >> 1)
            } else {
                value >> 1
            };
            bit += 1;
        }
        table[index] = value;
        index += 1;
    }
    table
};

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |crc, &byte| {
        let [low, ..] = crc.to_le_bytes();
        CRC_TABLE[usize::from(low ^ byte)] ^ (crc >> 8)
    })
}

fn seal(body: &[u8], frame: &mut Vec<u8>) {
    let length = u32::try_from(body.len()).expect("bodies are bounded by BODY_BYTES_MAX");
    frame.extend_from_slice(&length.to_le_bytes());
    frame.extend_from_slice(&crc32(body).to_le_bytes());
    frame.extend_from_slice(body);
}

/// Appends a record's frame; the content must not exceed [`CONTENT_BYTES_MAX`].
pub(super) fn write_record(name: RecordName, content: &[u8], frame: &mut Vec<u8>) {
    let mut body = Vec::with_capacity(RECORD_FIELDS_BYTES + content.len());
    body.push(KIND_RECORD);
    body.extend_from_slice(&name.ordinal.to_le_bytes());
    body.extend_from_slice(name.boot.as_uuid().as_bytes());
    body.extend_from_slice(&name.seq.to_le_bytes());
    body.extend_from_slice(content);
    seal(&body, frame);
}

/// Appends a head's frame.
pub(super) fn write_head(head: Head, frame: &mut Vec<u8>) {
    let mut body = Vec::with_capacity(HEAD_BYTES);
    body.push(KIND_HEAD);
    for field in [head.first_pending, head.dropped, head.refused] {
        body.extend_from_slice(&field.to_le_bytes());
    }
    seal(&body, frame);
}

fn take<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
    let (field, rest) = bytes.split_first_chunk::<N>()?;
    *bytes = rest;
    Some(*field)
}

/// Reads the frame at the start of `bytes`, and its whole length; `None` if it is torn or damaged.
pub(super) fn read(bytes: &[u8]) -> Option<(Frame<'_>, usize)> {
    let mut rest = bytes;
    let length = usize::try_from(u32::from_le_bytes(take(&mut rest)?)).ok()?;
    let checksum = u32::from_le_bytes(take(&mut rest)?);
    if length > BODY_BYTES_MAX {
        return None;
    }
    let body = rest.get(..length)?;
    if crc32(body) != checksum {
        return None;
    }
    let mut fields = body;
    let [kind] = take(&mut fields)?;
    let frame = match kind {
        KIND_RECORD => {
            let ordinal = u64::from_le_bytes(take(&mut fields)?);
            let boot = BootId::from_uuid(Uuid::from_bytes(take(&mut fields)?));
            let seq = u64::from_le_bytes(take(&mut fields)?);
            Frame::Record(RecordName { ordinal, boot, seq }, fields)
        }
        KIND_HEAD => Frame::Head(Head {
            first_pending: u64::from_le_bytes(take(&mut fields)?),
            dropped: u64::from_le_bytes(take(&mut fields)?),
            refused: u64::from_le_bytes(take(&mut fields)?),
        }),
        _ => return None,
    };
    Some((frame, HEADER_BYTES + length))
}

/// Bytes in front of a record's content within its frame.
pub(super) const fn content_offset() -> usize {
    HEADER_BYTES + RECORD_FIELDS_BYTES
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_the_one_of_ethernet() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
    }

    #[test]
    fn a_frame_with_any_bit_flipped_or_any_byte_missing_is_not_read() {
        let name = RecordName {
            ordinal: 3,
            boot: BootId::from_uuid(Uuid::from_u128(9)),
            seq: 2,
        };
        let mut frame = Vec::new();
        write_record(name, b"{\"x\":1}", &mut frame);
        assert_eq!(
            read(&frame),
            Some((Frame::Record(name, b"{\"x\":1}"), frame.len()))
        );
        for length in 0..frame.len() {
            assert_eq!(read(&frame[..length]), None);
        }
        for bit in 0..frame.len() * 8 {
            let mut damaged = frame.clone();
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(read(&damaged), None, "bit {bit}");
        }
    }
}
