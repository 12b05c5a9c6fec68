//! Tables of this engine for a copy to another one: their columns, and rows with values of any type.

use sqlx::postgres::{PgArguments, PgRow};
use sqlx::query::Query;
use sqlx::{AssertSqlSafe, Postgres, Row as _};
use tread_store::transfer::{Column, ColumnType, Row, Table, Value};

use super::copy_rows::CopyRows;
use super::{Connection, EngineError, column_names, corrupt, partitions};

/// The table that has partitions.
const PARTITIONED: &str = "segment_values";

/// Returns the columns of a table; none if the table does not exist.
pub(super) async fn columns(db: &mut Connection, table: &str) -> Result<Vec<Column>, EngineError> {
    let columns: Vec<(String, String, Option<i64>)> = sqlx::query_as(
        "SELECT CAST(attname AS TEXT), format_type(atttypid, NULL),
             CAST(array_position(CAST(indkey AS SMALLINT[]), attnum) + 1 AS BIGINT)
         FROM pg_attribute LEFT JOIN pg_index ON indrelid = attrelid AND indisprimary
         WHERE attrelid = to_regclass(quote_ident($1)) AND attnum > 0 AND NOT attisdropped",
    )
    .bind(table)
    .fetch_all(db)
    .await?;
    let columns = columns.into_iter().map(|(name, declared, key_position)| {
        let column_type = match declared.as_str() {
            "bigint" => ColumnType::Integer,
            "boolean" => ColumnType::Boolean,
            "double precision" => ColumnType::Real,
            "text" => ColumnType::Text,
            "bytea" => ColumnType::Bytes,
            _ => return Err(corrupt("type of a column", declared)),
        };
        Ok(Column {
            name,
            column_type,
            key_position,
        })
    });
    columns.collect()
}

/// Binds a value of a primary key to the next place of a statement.
pub(super) fn bind<'query>(
    statement: Query<'query, Postgres, PgArguments>,
    value: &Value,
) -> Result<Query<'query, Postgres, PgArguments>, EngineError> {
    match value {
        Value::Integer(value) => Ok(statement.bind(*value)),
        Value::Text(value) => Ok(statement.bind(value.clone())),
        Value::Null | Value::Real(_) | Value::Bytes(_) => {
            Err(corrupt("primary key", format!("{value:?}")))
        }
    }
}

/// Reads the values of a row, which has all columns of the table.
pub(super) fn decode(row: &PgRow, table: &Table) -> Result<Row, EngineError> {
    let columns = table.columns.iter().enumerate();
    let values = columns.map(|(place, column)| {
        let value = match column.column_type {
            ColumnType::Integer => row.try_get::<Option<i64>, _>(place)?.map(Value::Integer),
            ColumnType::Boolean => {
                let value = row.try_get::<Option<bool>, _>(place)?;
                value.map(|value| Value::Integer(value.into()))
            }
            ColumnType::Real => row.try_get::<Option<f64>, _>(place)?.map(Value::Real),
            ColumnType::Text => row.try_get::<Option<String>, _>(place)?.map(Value::Text),
            ColumnType::Bytes => row.try_get::<Option<Vec<u8>>, _>(place)?.map(Value::Bytes),
        };
        Ok(value.unwrap_or(Value::Null))
    });
    values.collect()
}

/// Writes rows, which have all columns of the table, in the order of their primary keys.
///
/// # Errors
/// A value is none of its column's type, or the database failed, for instance because a row is stored
/// already.
pub async fn insert(db: &mut Connection, table: &Table, rows: &[Row]) -> Result<(), EngineError> {
    if table.name == PARTITIONED
        && let (Some(first), Some(last)) = (rows.first(), rows.last())
        && let ([Value::Integer(first)], [Value::Integer(last)]) =
            (&*table.key_of(first), &*table.key_of(last))
    {
        partitions::prepare(db, *first..=*last).await?;
    }
    let all: Vec<usize> = (0..table.columns.len()).collect();
    let width = i16::try_from(all.len()).map_err(|_too_many| EngineError::DoesNotFit("table"))?;
    let mut copied = CopyRows::new(width);
    for row in rows {
        let mut bound = copied.row();
        for (value, column) in row.iter().zip(&table.columns) {
            match (value, column.column_type) {
                (Value::Null, _) => bound.text(None),
                (Value::Integer(value), ColumnType::Integer) => bound.integer(*value),
                (Value::Integer(value @ (0 | 1)), ColumnType::Boolean) => {
                    bound.boolean(*value == 1)
                }
                (Value::Real(value), ColumnType::Real) => bound.real(*value),
                (Value::Text(value), ColumnType::Text) => {
                    check_text(value, table, row, column)?;
                    bound.text(Some(value))
                }
                (Value::Bytes(value), ColumnType::Bytes) => bound.bytes(value),
                (
                    Value::Integer(_) | Value::Real(_) | Value::Text(_) | Value::Bytes(_),
                    ColumnType::Integer
                    | ColumnType::Boolean
                    | ColumnType::Real
                    | ColumnType::Text
                    | ColumnType::Bytes,
                ) => return Err(misplaced(table, row, &column.name)),
            };
        }
    }
    let statement = format!(
        r#"COPY "{}" ({}) FROM STDIN (FORMAT binary)"#,
        table.name,
        column_names::quoted(table, &all)
    );
    copied.write(db, &statement).await.map(|_written| ())
}

/// Refuses a text that PostgreSQL cannot store.
fn check_text(text: &str, table: &Table, row: &Row, column: &Column) -> Result<(), EngineError> {
    if text.contains('\0') {
        let place = place(table, row, &column.name);
        return Err(corrupt(
            "text that PostgreSQL can store, with U+0000 at",
            place,
        ));
    }
    Ok(())
}

fn misplaced(table: &Table, row: &Row, column: &str) -> EngineError {
    corrupt("value of the column's type", place(table, row, column))
}

/// Names the place of a value without showing it.
fn place(table: &Table, row: &Row, column: &str) -> String {
    let (name, key) = (&table.name, table.key_of(row));
    format!("column {column} of {name}, row {key:?}")
}

/// Disables the timeouts of statements and of idle transactions until the transaction ends: a copy waits
/// for the other database, and its size has no limit.
///
/// # Errors
/// The database failed.
pub async fn disable_timeouts(db: &mut Connection) -> Result<(), EngineError> {
    for statement in [
        "SET LOCAL statement_timeout = 0",
        "SET LOCAL idle_in_transaction_session_timeout = 0",
    ] {
        sqlx::query(statement).execute(&mut *db).await?;
    }
    Ok(())
}

/// Makes the sequences of generated keys go on after the rows that were written.
///
/// # Errors
/// The database failed.
pub async fn finish(db: &mut Connection, tables: &[Table]) -> Result<(), EngineError> {
    for table in tables {
        let table = &table.name;
        let generated: Vec<(String,)> = sqlx::query_as(
            "SELECT CAST(attname AS TEXT) FROM pg_attribute
             WHERE attrelid = to_regclass(quote_ident($1)) AND attidentity <> ''",
        )
        .bind(table)
        .fetch_all(&mut *db)
        .await?;
        for (column,) in generated {
            let statement = format!(
                r#"SELECT setval(pg_get_serial_sequence('"{table}"', '{column}'),
                       COALESCE(MAX("{column}"), 0) + 1, FALSE) FROM "{table}""#
            );
            sqlx::query(AssertSqlSafe(statement))
                .persistent(false)
                .execute(&mut *db)
                .await?;
        }
    }
    Ok(())
}
