//! Reading and writing of whole tables, for a copy to another engine.
//!
//! Statements are made from the names of tables and columns that the database itself reports.

use std::sync::Arc;

use sqlx::AssertSqlSafe;
pub use tread_store::transfer::{Row, TABLES, Table, Value};

pub use super::transfer_rows::{disable_timeouts, finish, insert};
use super::{Connection, EngineError, column_names, corrupt, transfer_rows, unsigned};

/// Returns the tables that a copy contains, in the order of [`TABLES`].
///
/// # Errors
/// The database failed, or lacks a table.
pub async fn tables(db: &mut Connection) -> Result<Vec<Table>, EngineError> {
    let mut tables = Vec::with_capacity(TABLES.len());
    for name in TABLES {
        let mut columns = transfer_rows::columns(db, name).await?;
        if columns.is_empty() {
            return Err(corrupt("schema", format!("no table {name}")));
        }
        columns.sort_by(|one, other| one.name.cmp(&other.name));
        let name = name.to_owned();
        tables.push(Table { name, columns });
    }
    Ok(tables)
}

/// Returns the number of rows of a table.
pub async fn count(db: &mut Connection, table: &Table) -> Result<u64, EngineError> {
    let statement = format!(r#"SELECT COUNT(*) FROM "{}""#, table.name);
    let counting = sqlx::query_scalar(AssertSqlSafe(statement)).persistent(false);
    unsigned("count", counting.fetch_one(db).await?)
}

/// Removes all rows of a table.
pub async fn clear(db: &mut Connection, table: &Table) -> Result<(), EngineError> {
    let statement = format!(r#"DELETE FROM "{}""#, table.name);
    let clearing = sqlx::query(AssertSqlSafe(statement)).persistent(false);
    clearing.execute(db).await?;
    Ok(())
}

/// Returns at most `limit` rows in the order of the primary key, of which `after` is the last one's that
/// was read.
///
/// # Errors
/// The database failed, or a value has another type than its column.
pub async fn rows(
    db: &mut Connection,
    table: &Table,
    after: Option<&[Value]>,
    limit: u32,
) -> Result<Vec<Row>, EngineError> {
    let all: Vec<usize> = (0..table.columns.len()).collect();
    let columns = column_names::quoted(table, &all);
    let key = column_names::quoted(table, &table.key());
    let condition = after.map_or_else(String::new, |after| {
        let places: Vec<String> = (1..=after.len()).map(|place| format!("${place}")).collect();
        format!("WHERE ({key}) > ({})", places.join(", "))
    });
    let statement = format!(
        r#"SELECT {columns} FROM "{}" {condition} ORDER BY {key} LIMIT {limit}"#,
        table.name
    );
    let reading = sqlx::query(AssertSqlSafe(Arc::<str>::from(statement)));
    let reading = after
        .unwrap_or_default()
        .iter()
        .try_fold(reading, transfer_rows::bind)?;
    let found = reading.fetch_all(db).await?;
    let decoded = found.iter().map(|row| transfer_rows::decode(row, table));
    decoded.collect()
}
