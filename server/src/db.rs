//! The database of this server. No other module names an engine.

pub use tread_db::*;
