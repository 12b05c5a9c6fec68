//! What an inspection of a database finds, without a change of it.

use jiff::Timestamp;

/// Schema of a database against that of this version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Schema {
    /// Both are the same, with this version of it.
    Current(i64),
    /// It has no tables.
    Empty,
    /// It lacks migrations.
    Older {
        /// Number of those.
        pending: usize,
    },
    /// It has this migration, which this version does not know.
    Newer(i64),
    /// It has another migration of this version.
    Differs(i64),
}

/// How a database is inspected.
#[derive(Debug, Clone, Copy)]
pub struct InspectOptions {
    /// A server runs on it.
    pub is_in_use: bool,
    /// All of it is read.
    pub is_deep: bool,
}

/// What was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Inspection {
    /// Its schema.
    pub schema: Schema,
    /// The newest time that it holds; `None` if it has another schema or holds none.
    pub newest: Option<Timestamp>,
    /// First and last key of the measurements that were archived; `None` if it has another schema or
    /// nothing was archived.
    pub archived: Option<(i64, i64)>,
    /// The engine's finding if it is damaged.
    pub damage: Option<String>,
}

/// Schema that a database has.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundSchema {
    /// Its newest migration; `None` for an empty database.
    pub schema: Option<i64>,
    /// Version of the server that opened it first with its schema or later, if it says so.
    pub version: Option<String>,
}
