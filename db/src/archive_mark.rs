//! The mark of the archive: which measurements were archived.

use super::{DbError, Tx, forward};

forward! {
    archive_mark;
    fn get() -> Option<(i64, i64)>;
    fn set(keys: (i64, i64)) -> ();
}
