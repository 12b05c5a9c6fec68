//! Statements that write many rows at once, with every value bound.
//!
//! Each statement has one text per number of rows in [`CHUNKS`], so that a connection prepares it
//! once and a few executions write any number of rows. That takes a third less time than rows as
//! JSON, which SQLite has to parse.

use std::sync::Arc;

use sqlx::encode::Encode;
use sqlx::sqlite::SqliteArguments;
use sqlx::{Arguments as _, AssertSqlSafe, Sqlite, SqliteConnection, Type};

use super::EngineError;

/// Numbers of rows per execution, largest first; the last makes every number possible.
const CHUNKS: [usize; 3] = [100, 10, 1];

/// A statement for any number of rows.
#[derive(Debug)]
pub(super) struct RowsStatement {
    columns: usize,
    texts: [Arc<str>; CHUNKS.len()],
}

/// A row that is being bound.
pub(super) struct Row<'arguments>(&'arguments mut SqliteArguments);

impl Row<'_> {
    /// Binds the next column.
    pub(super) fn add<'value, T>(&mut self, value: T) -> Result<&mut Self, EngineError>
    where
        T: Encode<'value, Sqlite> + Type<Sqlite>,
    {
        let added = self.0.add(value);
        added.map_err(|cause| EngineError::from(sqlx::Error::Encode(cause)))?;
        Ok(self)
    }
}

/// Text of a statement around its rows.
pub(super) struct RowsText<'text> {
    /// Everything before `VALUES`.
    pub(super) into: &'text str,
    /// Number of columns of a row.
    pub(super) columns: usize,
    /// What follows the rows.
    pub(super) then: &'text str,
}

impl RowsStatement {
    /// Makes a statement.
    pub(super) fn new(statement: &RowsText<'_>) -> Self {
        let &RowsText {
            into,
            columns,
            then,
        } = statement;
        let row = format!("({})", vec!["?"; columns].join(","));
        let text = |rows| {
            let rows = vec![row.as_str(); rows].join(",");
            Arc::from(format!("{into} VALUES {rows} {then}"))
        };
        Self {
            columns,
            texts: CHUNKS.map(text),
        }
    }

    /// Writes the rows in their order and returns the number of rows changed.
    pub(super) async fn execute<R>(
        &self,
        db: &mut SqliteConnection,
        mut rows: &[R],
        bind: impl Fn(&mut Row<'_>, &R) -> Result<(), EngineError>,
    ) -> Result<u64, EngineError> {
        let mut changed = 0;
        for (size, text) in CHUNKS.into_iter().zip(&self.texts) {
            while rows.len() >= size {
                let (chunk, rest) = rows.split_at(size);
                rows = rest;
                let mut arguments = SqliteArguments::default();
                arguments.reserve(size * self.columns, 0);
                for row in chunk {
                    bind(&mut Row(&mut arguments), row)?;
                }
                debug_assert_eq!(
                    arguments.len(),
                    size * self.columns,
                    "every column is bound"
                );
                let done = sqlx::query_with(AssertSqlSafe(Arc::clone(text)), arguments);
                changed += done.execute(&mut *db).await?.rows_affected();
            }
        }
        Ok(changed)
    }
}
