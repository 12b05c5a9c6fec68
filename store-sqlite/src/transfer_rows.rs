//! Tables of this engine for a copy to another one: their columns, and rows with values of any type.

use sqlx::query::Query;
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{Row as _, Sqlite, TypeInfo as _, ValueRef as _};
use tread_store::transfer::{Column, ColumnType, Row, Table, Value};

use super::rows::{RowsStatement, RowsText};
use super::{Connection, EngineError, column_names, corrupt};

/// Returns the columns of a table; none if the table does not exist.
pub(super) async fn columns(db: &mut Connection, table: &str) -> Result<Vec<Column>, EngineError> {
    let columns: Vec<(String, String, i64)> =
        sqlx::query_as("SELECT name, type, pk FROM pragma_table_info($1)")
            .bind(table)
            .fetch_all(db)
            .await?;
    let columns = columns.into_iter().map(|(name, declared, position)| {
        let column_type = match declared.as_str() {
            "INTEGER" => ColumnType::Integer,
            "BOOLEAN" => ColumnType::Boolean,
            "REAL" => ColumnType::Real,
            "TEXT" => ColumnType::Text,
            "BLOB" => ColumnType::Bytes,
            _ => return Err(corrupt("type of a column", declared)),
        };
        Ok(Column {
            name,
            column_type,
            key_position: (position > 0).then_some(position),
        })
    });
    columns.collect()
}

/// Binds a value to the next place of a statement.
#[expect(
    clippy::unnecessary_wraps,
    reason = "the other engine cannot bind every value"
)]
pub(super) fn bind<'query>(
    statement: Query<'query, Sqlite, SqliteArguments>,
    value: &Value,
) -> Result<Query<'query, Sqlite, SqliteArguments>, EngineError> {
    Ok(match value {
        Value::Null => statement.bind(None::<i64>),
        Value::Integer(value) => statement.bind(*value),
        Value::Real(value) => statement.bind(*value),
        Value::Text(value) => statement.bind(value.clone()),
        Value::Bytes(value) => statement.bind(value.clone()),
    })
}

/// Reads the values of a row, which has all columns of the table.
pub(super) fn decode(row: &SqliteRow, table: &Table) -> Result<Row, EngineError> {
    let columns = (0..table.columns.len()).map(|place| {
        let raw = row.try_get_raw(place)?;
        if raw.is_null() {
            return Ok(Value::Null);
        }
        // Each value has a type of its own in SQLite.
        let found = raw.type_info().name().to_owned();
        Ok(match found.as_str() {
            "INTEGER" => Value::Integer(row.try_get_unchecked(place)?),
            "REAL" => Value::Real(row.try_get_unchecked(place)?),
            "TEXT" => Value::Text(row.try_get_unchecked(place)?),
            "BLOB" => Value::Bytes(row.try_get_unchecked(place)?),
            _ => return Err(corrupt("type of a value", found)),
        })
    });
    columns.collect()
}

/// Writes rows, which have all columns of the table.
///
/// # Errors
/// The database failed, for instance because a row is stored already.
pub async fn insert(db: &mut Connection, table: &Table, rows: &[Row]) -> Result<(), EngineError> {
    let all: Vec<usize> = (0..table.columns.len()).collect();
    let into = format!(
        r#"INSERT INTO "{}" ({})"#,
        table.name,
        column_names::quoted(table, &all)
    );
    let statement = RowsStatement::new(&RowsText {
        into: &into,
        columns: all.len(),
        then: "",
    });
    let writing = statement.execute(db, rows, |bound, row| {
        for value in row {
            match value {
                Value::Null => bound.add(None::<i64>)?,
                Value::Integer(value) => bound.add(*value)?,
                Value::Real(value) => bound.add(*value)?,
                Value::Text(value) => bound.add(value.clone())?,
                Value::Bytes(value) => bound.add(value.clone())?,
            };
        }
        Ok(())
    });
    writing.await.map(|_written| ())
}

/// Does nothing: statements of SQLite have no timeouts.
///
/// # Errors
/// None.
pub async fn disable_timeouts(_db: &mut Connection) -> Result<(), EngineError> {
    Ok(())
}

/// Does nothing: SQLite takes the next key from the rows.
///
/// # Errors
/// None.
pub async fn finish(_db: &mut Connection, _tables: &[Table]) -> Result<(), EngineError> {
    Ok(())
}
