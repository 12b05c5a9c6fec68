//! The mark of the archive: first and last key of the segments that were archived without a gap.

use std::ops::RangeInclusive;

use super::{DbError, Tx, forward};

forward! {
    archive_mark;
    fn get() -> Option<(i64, i64)>;
    fn set(keys: RangeInclusive<i64>) -> ();
}
