//! What only a database in a file has: copies of it, and its schema while it is not open.

pub use tread_store_sqlite::{OpenError, copy, refuse_newer, schema};
