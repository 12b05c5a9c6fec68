//! The binary format of the outbox's files.
//!
//! | bytes | what |
//! |---|---|
//! | 4 | length of the body, little-endian |
//! | 4 | CRC-32 (IEEE 802.3) of the body |
//! | … | the body: 1 byte kind, then its fields, integers little-endian |
//!
//! Kind 1 is a record: 8 ordinal, 16 boot id, 8 seq, then its content as JSON. Kind 2 is the head:
//! 8 ordinal of the first record that waits, 8 records dropped and 8 refused since the store was
//! made, 8 of the dropped ones lost by damage, 8 ordinal of the next record, 8 records that wait.
//! Earlier agents wrote heads without the last three.
//!
//! The end of a damaged frame is unknown, so [`find`] searches the next intact frame byte by byte.
//! It finds no frame inside the content of another: a frame begins with a length below 16 MiB, so
//! its fourth byte is 0, which JSON never contains.

use std::ops::Range;

use tread_api::ids::BootId;
use uuid::Uuid;

use crate::checksum::crc32;

/// Size of the length and checksum before a body, bytes.
pub(super) const HEADER_BYTES: usize = 8;
/// Size of a record's fields before its content, bytes.
const RECORD_FIELDS_BYTES: usize = 1 + 8 + 16 + 8;
/// Sizes of a head's body in earlier agents and in this one, bytes.
const HEAD_BYTES: [usize; 2] = [1 + 3 * 8, 1 + 6 * 8];
/// Size of a head's whole frame, bytes.
pub(super) const HEAD_FRAME_BYTES: usize = HEADER_BYTES + HEAD_BYTES[1];
/// Largest body, bytes; a larger length is damage.
pub(super) const BODY_BYTES_MAX: usize = 1024 * 1024;
/// Largest content of a record, bytes.
pub const CONTENT_BYTES_MAX: usize = BODY_BYTES_MAX - RECORD_FIELDS_BYTES;

const KIND_RECORD: u8 = 1;
const KIND_HEAD: u8 = 2;

/// State of the store: what is settled, and what was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Head {
    /// Ordinal of the first record that still waits.
    pub(super) first_pending: u64,
    /// Records dropped since the store was made, those lost by damage included.
    pub(super) dropped: u64,
    /// Records refused since the store was made.
    pub(super) refused: u64,
    /// Records lost by damage since the store was made.
    pub(super) damaged: u64,
    /// Ordinal of the next record when this was written.
    pub(super) next_ordinal: u64,
    /// Records from the first to the next ordinal that waited when this was written; the others
    /// were lost before and are counted.
    pub(super) waiting: u64,
}

impl Head {
    /// Joins two heads of one store, whose counters never decrease.
    ///
    /// An agent of an earlier version that ran in between settles and drops records without stating
    /// which ones wait, so its head may have the higher first ordinal and the lower next one.
    pub(super) fn joined(self, other: Self) -> Self {
        let age = |head: &Self| (head.next_ordinal, head.first_pending);
        let (newer, older) = if age(&other) > age(&self) {
            (other, self)
        } else {
            (self, other)
        };
        let first_pending = newer.first_pending.max(older.first_pending);
        // Records settled since do not wait, though some may have been lost before: a loss may
        // remain uncounted, but no record that was sent counts as lost.
        let settled_since = first_pending - newer.first_pending;
        Self {
            first_pending,
            dropped: newer.dropped.max(older.dropped),
            refused: newer.refused.max(older.refused),
            damaged: newer.damaged.max(older.damaged),
            next_ordinal: newer.next_ordinal,
            waiting: newer.waiting.saturating_sub(settled_since),
        }
    }
}

/// Identity of a record, and its position in the order of all records.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RecordName {
    /// Number of the record in this store, from 0.
    pub(super) ordinal: u64,
    /// Run of the agent that made the record.
    pub(super) boot: BootId,
    /// Number of the record within that run.
    pub(super) seq: u64,
}

/// A decoded frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Frame<'file> {
    Record(RecordName, &'file [u8]),
    Head(Head),
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

/// Appends a head's frame as earlier agents wrote it.
#[cfg(test)]
pub(super) fn write_earlier_head(head: Head, frame: &mut Vec<u8>) {
    let mut body = vec![KIND_HEAD];
    for field in [head.first_pending, head.dropped, head.refused] {
        body.extend_from_slice(&field.to_le_bytes());
    }
    seal(&body, frame);
}

/// Appends a head's frame.
pub(super) fn write_head(head: Head, frame: &mut Vec<u8>) {
    let mut body = Vec::with_capacity(HEAD_BYTES[1]);
    body.push(KIND_HEAD);
    for field in [
        head.first_pending,
        head.dropped,
        head.refused,
        head.damaged,
        head.next_ordinal,
        head.waiting,
    ] {
        body.extend_from_slice(&field.to_le_bytes());
    }
    seal(&body, frame);
}

fn take<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
    let (field, rest) = bytes.split_first_chunk::<N>()?;
    *bytes = rest;
    Some(*field)
}

/// Decodes the frame at the start of `bytes`; returns it and its size in bytes, `None` if it is
/// torn or damaged.
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
        KIND_HEAD => Frame::Head(read_head(&mut fields)?),
        _ => return None,
    };
    Some((frame, HEADER_BYTES + length))
}

fn read_head(fields: &mut &[u8]) -> Option<Head> {
    let mut field = || Some(u64::from_le_bytes(take(fields)?));
    let head = Head {
        first_pending: field()?,
        dropped: field()?,
        refused: field()?,
        ..Head::default()
    };
    Some(match (field(), field(), field()) {
        (Some(damaged), Some(next_ordinal), Some(waiting)) => Head {
            damaged,
            next_ordinal,
            waiting,
            ..head
        },
        // Of an earlier agent, without the number of waiting records.
        _ => Head {
            next_ordinal: head.first_pending,
            ..head
        },
    })
}

/// Whether a frame may begin here, by a cheap check without its checksum.
fn may_begin(bytes: &[u8], ordinals: &Range<u64>) -> bool {
    let mut rest = bytes;
    let (Some(length), Some(_), Some([kind])) = (
        take(&mut rest).map(u32::from_le_bytes),
        take::<4>(&mut rest),
        take(&mut rest),
    ) else {
        return false;
    };
    let length = usize::try_from(length).unwrap_or(usize::MAX);
    match kind {
        KIND_RECORD => {
            let ordinal = take(&mut rest).map(u64::from_le_bytes);
            (RECORD_FIELDS_BYTES..=BODY_BYTES_MAX).contains(&length)
                && ordinal.is_some_and(|ordinal| ordinals.contains(&ordinal))
        }
        KIND_HEAD => HEAD_BYTES.contains(&length),
        _ => false,
    }
}

/// Finds the first intact frame at or after `from` that is a head or a record with one of these
/// ordinals. Returns its position, the frame, and its size in bytes.
pub(super) fn find<'file>(
    bytes: &'file [u8],
    from: usize,
    ordinals: &Range<u64>,
) -> Option<(usize, Frame<'file>, usize)> {
    (from..bytes.len()).find_map(|at| {
        let rest = &bytes[at..];
        let (frame, length) = may_begin(rest, ordinals).then(|| read(rest)).flatten()?;
        Some((at, frame, length))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_head_of_an_earlier_agent_says_nothing_of_what_waits() {
        let mut frame = Vec::new();
        let head = Head {
            first_pending: 7,
            dropped: 2,
            refused: 1,
            next_ordinal: 7,
            ..Head::default()
        };
        write_earlier_head(head, &mut frame);
        assert_eq!(read(&frame), Some((Frame::Head(head), frame.len())));
        frame.clear();
        write_head(head, &mut frame);
        assert_eq!(frame.len(), HEAD_FRAME_BYTES);
        assert_eq!(read(&frame), Some((Frame::Head(head), frame.len())));
    }

    #[test]
    fn heads_of_two_versions_say_together_what_either_knows() {
        let present = Head {
            first_pending: 50,
            dropped: 1,
            refused: 2,
            damaged: 1,
            next_ordinal: 100,
            waiting: 50,
        };
        let earlier = |first_pending| Head {
            first_pending,
            dropped: 4,
            refused: 2,
            next_ordinal: first_pending,
            ..Head::default()
        };
        for (first_pending, next_ordinal, waiting) in
            [(40, 100, 50), (80, 100, 20), (100, 100, 0), (130, 130, 0)]
        {
            let expected = Head {
                first_pending: first_pending.max(50),
                dropped: 4,
                next_ordinal,
                waiting,
                ..present
            };
            assert_eq!(present.joined(earlier(first_pending)), expected);
            assert_eq!(earlier(first_pending).joined(present), expected);
        }
    }

    #[test]
    fn the_next_intact_frame_is_found_behind_damage_and_only_with_a_fitting_ordinal() {
        let name = |ordinal| RecordName {
            ordinal,
            boot: BootId::from_uuid(Uuid::from_u128(9)),
            seq: ordinal,
        };
        let mut bytes = Vec::new();
        write_record(name(3), b"{}", &mut bytes);
        let second = bytes.len();
        write_record(name(4), b"{\"x\":1}", &mut bytes);
        bytes[2] ^= 1;
        let found = find(&bytes, 0, &(3..9)).unwrap();
        let length = bytes.len() - second;
        assert_eq!(
            found,
            (second, Frame::Record(name(4), b"{\"x\":1}"), length)
        );
        assert_eq!(find(&bytes, 0, &(5..9)), None);
        bytes[second..].fill(0);
        assert_eq!(find(&bytes, 0, &(0..9)), None);
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
