//! The schema of the database: what this program knows, what a file has, and which versions of the
//! server have opened it.

use jiff::Timestamp;

use super::{DbError, Tx, forward};

forward! {
    schema;
    fn note_version(version: &str, at: Timestamp) -> ();
}
