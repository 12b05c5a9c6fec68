//! Sequences that are not copied: those of a message that was read, and those to be written.

use super::{CdrError, Field, Reader, Writer};

/// A sequence of fields: a place in a message whose fields were all read once, or a slice.
#[derive(Debug, Clone, Copy)]
pub struct Sequence<'a, T>(Source<'a, T>);

#[derive(Debug, Clone, Copy)]
enum Source<'a, T> {
    Message { first: Reader<'a>, count: usize },
    Slice(&'a [T]),
}

impl<'a, T: Field<'a>> Sequence<'a, T> {
    /// How many there are.
    pub fn len(&self) -> usize {
        match self.0 {
            Source::Message { count, .. } => count,
            Source::Slice(slice) => slice.len(),
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// One after the other.
    pub fn iter(&self) -> Items<'a, T> {
        Items {
            rest: self.0,
            next: 0,
        }
    }

    /// The one at a place.
    pub fn get(&self, index: usize) -> Option<T> {
        self.iter().nth(index)
    }
}

impl<T> Default for Sequence<'_, T> {
    fn default() -> Self {
        Self(Source::Slice(&[]))
    }
}

impl<'a, T> From<&'a [T]> for Sequence<'a, T> {
    fn from(slice: &'a [T]) -> Self {
        Self(Source::Slice(slice))
    }
}

impl<'a, T, const N: usize> From<&'a [T; N]> for Sequence<'a, T> {
    fn from(array: &'a [T; N]) -> Self {
        Self(Source::Slice(array))
    }
}

impl<'a, T: Field<'a> + PartialEq> PartialEq for Sequence<'a, T> {
    fn eq(&self, other: &Self) -> bool {
        self.iter().eq(other.iter())
    }
}

impl<'a, T: Field<'a>> IntoIterator for &Sequence<'a, T> {
    type Item = T;
    type IntoIter = Items<'a, T>;

    fn into_iter(self) -> Items<'a, T> {
        self.iter()
    }
}

/// The fields of a [`Sequence`], one after the other.
#[derive(Debug, Clone)]
pub struct Items<'a, T> {
    rest: Source<'a, T>,
    next: usize,
}

impl<'a, T: Field<'a>> Iterator for Items<'a, T> {
    type Item = T;

    fn next(&mut self) -> Option<T> {
        let item = match &mut self.rest {
            Source::Message { count, .. } if self.next >= *count => None,
            // Each was read once when the message was, so each reads again.
            Source::Message { first, .. } => T::read(first).ok(),
            Source::Slice(slice) => slice.get(self.next).copied(),
        };
        self.next += 1;
        item
    }
}

impl<'a, T: Field<'a>> Field<'a> for Sequence<'a, T> {
    const BYTES_MIN: usize = size_of::<u32>();

    fn read(from: &mut Reader<'a>) -> Result<Self, CdrError> {
        let count = from.count()?;
        let bytes_min = count.checked_mul(T::BYTES_MIN).ok_or(CdrError::Short)?;
        if bytes_min > from.left() {
            return Err(CdrError::Short);
        }
        let first = *from;
        for _ in 0..count {
            T::read(from)?;
        }
        Ok(Self(Source::Message { first, count }))
    }

    fn write(&self, to: &mut Writer<'_>) {
        to.count(self.len());
        for item in self {
            item.write(to);
        }
    }
}
