//! What this program was built from.

use std::sync::LazyLock;

pub use tread_api::release::{VERSION, commit};

use crate::db::file::schema;

/// Returns the schema of the database that this program works with: its newest migration.
pub fn schema() -> i64 {
    schema::known()
}

/// Returns what `--version` prints after the name of the program.
pub fn long_version() -> &'static str {
    static TEXT: LazyLock<String> = LazyLock::new(|| tread_api::release::describe(Some(schema())));
    &TEXT
}
