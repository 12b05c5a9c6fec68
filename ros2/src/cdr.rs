//! CDR as ROS 2 writes it (XCDR version 1, either byte order): a reader and a writer, bounds-checked.
//!
//! Values are aligned to their own size, counted from behind the four bytes of encapsulation. A
//! string carries its length with its closing zero, a sequence its count. Reading borrows: a string
//! is a slice of the message, a [`Sequence`] a place in it, so that no length that a message claims
//! can make anybody allocate.

mod sequence;

pub use sequence::{Items, Sequence};

/// Largest message that is looked at, bytes: a laser scan is 10 KiB, what Tread reads is far less.
pub const MESSAGE_BYTES_MAX: usize = 256 * 1024;
/// Bytes of the encapsulation before the message.
pub const ENCAPSULATION_BYTES: usize = 4;
/// Most bytes behind a message that are taken for padding to a multiple of four.
const PADDING_BYTES_MAX: usize = 3;
/// Plain CDR, high byte first.
const BIG_ENDIAN: [u8; 2] = [0, 0];
/// Plain CDR, low byte first.
const LITTLE_ENDIAN: [u8; 2] = [0, 1];

/// Why bytes are no message of the type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// The message is larger than [`MESSAGE_BYTES_MAX`], or than it may be where it is read.
    #[error("the message is too large")]
    TooLarge,
    /// It begins with another encapsulation than plain CDR's.
    #[error("the message is not in plain CDR")]
    Encapsulation,
    /// It ends before its type does, or claims more than it has.
    #[error("the message ends before its type does")]
    Short,
    /// More follows than padding.
    #[error("more follows than the type has")]
    Trailing,
    /// A string without its closing zero, with a zero inside, or not in UTF-8.
    #[error("a string is not one")]
    Text,
    /// A truth value that is neither.
    #[error("a truth value is neither true nor false")]
    Bool,
}

/// A part of a message.
///
/// `'a` is the life of the message's bytes.
pub trait Field<'a>: Copy {
    /// Fewest bytes of one on the wire; at least one, so that a count is bounded by the bytes left.
    const BYTES_MIN: usize;

    /// Reads one.
    ///
    /// # Errors
    /// [`CdrError`] when the bytes are no such field.
    fn read(from: &mut Reader<'a>) -> Result<Self, CdrError>;

    /// Writes one.
    fn write(&self, to: &mut Writer<'_>);
}

/// Reads a whole message.
///
/// # Errors
/// [`CdrError`]; nothing was allocated, whatever the message claims.
pub fn decode<'a, T: Field<'a>>(message: &'a [u8]) -> Result<T, CdrError> {
    decode_up_to(message, MESSAGE_BYTES_MAX)
}

/// Reads a whole message that may have so many bytes; for what does not come from a network.
///
/// # Errors
/// [`CdrError`]; nothing was allocated, whatever the message claims.
pub fn decode_up_to<'a, T: Field<'a>>(message: &'a [u8], bytes_max: usize) -> Result<T, CdrError> {
    if message.len() > bytes_max {
        return Err(CdrError::TooLarge);
    }
    let mut reader = Reader::new(message)?;
    let decoded = T::read(&mut reader)?;
    if reader.left() > PADDING_BYTES_MAX {
        return Err(CdrError::Trailing);
    }
    Ok(decoded)
}

/// Writes a whole message in place of what `into` holds, low byte first.
pub fn encode<'a, T: Field<'a>>(message: &T, into: &mut Vec<u8>) {
    into.clear();
    into.extend_from_slice(&LITTLE_ENDIAN);
    into.extend_from_slice(&[0, 0]);
    message.write(&mut Writer { bytes: into });
}

/// A place in a message.
#[derive(Debug, Clone, Copy)]
pub struct Reader<'a> {
    /// The message behind its encapsulation.
    body: &'a [u8],
    at: usize,
    is_big_endian: bool,
}

impl<'a> Reader<'a> {
    fn new(message: &'a [u8]) -> Result<Self, CdrError> {
        let (head, body) = message
            .split_at_checked(ENCAPSULATION_BYTES)
            .ok_or(CdrError::Short)?;
        let is_big_endian = match [head[0], head[1]] {
            BIG_ENDIAN => true,
            LITTLE_ENDIAN => false,
            _ => return Err(CdrError::Encapsulation),
        };
        Ok(Self {
            body,
            at: 0,
            is_big_endian,
        })
    }

    /// Bytes that have not been read.
    fn left(&self) -> usize {
        self.body.len() - self.at
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], CdrError> {
        let end = self.at.checked_add(count).ok_or(CdrError::Short)?;
        let taken = self.body.get(self.at..end).ok_or(CdrError::Short)?;
        self.at = end;
        Ok(taken)
    }

    /// The next number of `N` bytes, aligned, low byte first.
    fn number<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let padding = self.at.next_multiple_of(N) - self.at;
        self.take(padding)?;
        let mut bytes = [0; N];
        bytes.copy_from_slice(self.take(N)?);
        if self.is_big_endian {
            bytes.reverse();
        }
        Ok(bytes)
    }

    fn count(&mut self) -> Result<usize, CdrError> {
        let count = u32::from_le_bytes(self.number()?);
        usize::try_from(count).map_err(|_| CdrError::Short)
    }
}

/// The end of a message that is being written.
#[derive(Debug)]
pub struct Writer<'a> {
    bytes: &'a mut Vec<u8>,
}

impl Writer<'_> {
    fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        let at = self.bytes.len() - ENCAPSULATION_BYTES;
        let padding = at.next_multiple_of(N) - at;
        self.bytes.resize(self.bytes.len() + padding, 0);
        self.bytes.extend_from_slice(&bytes);
    }

    /// Counts saturate: what Tread writes is bounded far below.
    fn count(&mut self, count: usize) {
        let count = u32::try_from(count).unwrap_or(u32::MAX);
        self.number(count.to_le_bytes());
    }
}

macro_rules! numbers {
    ($($number:ty),*) => {$(
        impl<'a> Field<'a> for $number {
            const BYTES_MIN: usize = size_of::<$number>();

            fn read(from: &mut Reader<'a>) -> Result<Self, CdrError> {
                Ok(Self::from_le_bytes(from.number()?))
            }

            fn write(&self, to: &mut Writer<'_>) {
                to.number(self.to_le_bytes());
            }
        }
    )*};
}
numbers!(u8, i32, u32, i64, u64, f32, f64);

impl<'a> Field<'a> for bool {
    const BYTES_MIN: usize = 1;

    fn read(from: &mut Reader<'a>) -> Result<Self, CdrError> {
        match u8::read(from)? {
            0 => Ok(false),
            1 => Ok(true),
            _ => Err(CdrError::Bool),
        }
    }

    fn write(&self, to: &mut Writer<'_>) {
        u8::from(*self).write(to);
    }
}

impl<'a> Field<'a> for &'a str {
    const BYTES_MIN: usize = size_of::<u32>();

    fn read(from: &mut Reader<'a>) -> Result<Self, CdrError> {
        let length = from.count()?;
        // Some writers leave out the closing zero of an empty string.
        if length == 0 {
            return Ok("");
        }
        let (end, text) = from.take(length)?.split_last().ok_or(CdrError::Short)?;
        if *end != 0 || text.contains(&0) {
            return Err(CdrError::Text);
        }
        std::str::from_utf8(text).map_err(|_| CdrError::Text)
    }

    /// What follows a zero inside is left out: on the wire a zero ends a string.
    fn write(&self, to: &mut Writer<'_>) {
        let text = self.split('\0').next().unwrap_or_default();
        to.count(text.len() + 1);
        to.bytes.extend_from_slice(text.as_bytes());
        to.bytes.push(0);
    }
}

impl<'a, T: Field<'a> + Default, const N: usize> Field<'a> for [T; N] {
    const BYTES_MIN: usize = N * T::BYTES_MIN;

    fn read(from: &mut Reader<'a>) -> Result<Self, CdrError> {
        let mut read = [T::default(); N];
        for item in &mut read {
            *item = T::read(from)?;
        }
        Ok(read)
    }

    fn write(&self, to: &mut Writer<'_>) {
        for item in self {
            item.write(to);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_byte_orders_are_read() {
        let little = [
            0, 1, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x80, 0x3f,
        ];
        let mut reader = Reader::new(&little).unwrap();
        assert_eq!(u8::read(&mut reader), Ok(7));
        assert_eq!(f64::read(&mut reader).map(f64::to_bits), Ok(0x3f80 << 48));
        let big = [0, 0, 0, 0, 0, 0, 1, 2];
        assert_eq!(decode::<u32>(&big), Ok(258));
    }

    #[test]
    fn what_is_no_message_is_named() {
        let cases: [(&[u8], CdrError); 7] = [
            (&[0, 1, 0], CdrError::Short),
            (&[0, 3, 0, 0, 0, 0, 0, 0], CdrError::Encapsulation),
            (&[0, 1, 0, 0, 9, 0, 0, 0, b'a', 0], CdrError::Short),
            (&[0, 1, 0, 0, 2, 0, 0, 0, b'a', b'b'], CdrError::Text),
            (&[0, 1, 0, 0, 3, 0, 0, 0, b'a', 0, 0], CdrError::Text),
            (&[0, 1, 0, 0, 2, 0, 0, 0, 0xff, 0], CdrError::Text),
            (&[0, 1, 0, 0, 0, 0, 0, 0, 1, 2, 3, 4], CdrError::Trailing),
        ];
        for (bytes, error) in cases {
            assert_eq!(decode::<&str>(bytes), Err(error), "{bytes:?}");
        }
        let large = vec![0; MESSAGE_BYTES_MAX + 1];
        assert_eq!(decode::<u8>(&large), Err(CdrError::TooLarge));
        assert_eq!(decode::<bool>(&[0, 1, 0, 0, 2]), Err(CdrError::Bool));
    }

    #[test]
    fn padding_behind_a_message_and_an_empty_string_without_its_zero_are_borne() {
        assert_eq!(decode::<&str>(&[0, 1, 0, 0, 0, 0, 0, 0]), Ok(""));
        assert_eq!(decode::<u8>(&[0, 1, 0, 0, 5, 0, 0, 0]), Ok(5));
    }

    #[test]
    fn a_string_with_a_zero_inside_is_cut_there() {
        let mut bytes = Vec::new();
        encode(&"ab\0cd", &mut bytes);
        assert_eq!(decode::<&str>(&bytes), Ok("ab"));
    }
}
