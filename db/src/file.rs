//! What only a database in a file has: its lock, copies of it, and the inspection of a file that is not open.

pub use tread_store_sqlite::{OpenError, copy, inspection, lock, refuse_newer, schema};
