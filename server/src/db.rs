//! The store of this server: one SQLite file, from the crate `tread-store-sqlite`. No other module names
//! an engine.

pub use tread_store::{DbError, Disk, Outcome, failure, limited};
pub use tread_store_sqlite::*;
