//! Tables in rows, written piece by piece: nothing of them is held but the rows of one piece.

pub mod cells;
mod comma;
mod parquet;
pub mod segments;

use std::marker::PhantomData;

use self::comma::Comma;
use self::parquet::Parquet;

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A whole number.
    Integer,
    /// A number.
    Number,
    /// Yes or no.
    Flag,
    /// Text.
    Text,
    /// A time, microseconds since 1970 UTC.
    Time,
}

/// A column: its name, what it holds, and whether every row has it.
#[derive(Debug, Clone, Copy)]
pub struct Column {
    /// Its name, with its unit last.
    pub name: &'static str,
    /// What it holds.
    pub kind: Kind,
    /// Whether a row may be without it.
    pub is_optional: bool,
}

/// A column that every row has.
const fn each(name: &'static str, kind: Kind) -> Column {
    Column {
        name,
        kind,
        is_optional: false,
    }
}

/// A column that a row may be without.
const fn some(name: &'static str, kind: Kind) -> Column {
    Column {
        name,
        kind,
        is_optional: true,
    }
}

/// What stands in a row.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Nothing.
    Nothing,
    /// A whole number.
    Integer(i64),
    /// A number.
    Number(f64),
    /// Yes or no.
    Flag(bool),
    /// Text.
    Text(String),
    /// A time, microseconds since 1970 UTC.
    Time(i64),
}

impl Value {
    fn optional<T>(value: Option<T>, of: impl FnOnce(T) -> Self) -> Self {
        value.map_or(Self::Nothing, of)
    }

    fn count(value: u64) -> Self {
        Self::Integer(i64::try_from(value).unwrap_or(i64::MAX))
    }
}

/// One row, in the order of the columns.
pub type Row = Vec<Value>;

/// Why a table cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// As CSV.
    #[error("the rows cannot be written as CSV")]
    Comma(#[from] csv::Error),
    /// As Parquet.
    #[error("the rows cannot be written as Parquet")]
    Parquet(#[from] ::parquet::errors::ParquetError),
    /// As JSON.
    #[error("the rows cannot be written as JSON")]
    Json(#[from] serde_json::Error),
}

/// Writes entries piece by piece.
pub trait Writer<T>: Send {
    /// What stands before the first piece.
    ///
    /// # Errors
    /// It cannot be written.
    fn begin(&mut self) -> Result<Vec<u8>, TableError>;

    /// One piece.
    ///
    /// # Errors
    /// It cannot be written.
    fn piece(&mut self, entries: &[T]) -> Result<Vec<u8>, TableError>;

    /// What stands behind the last piece.
    ///
    /// # Errors
    /// It cannot be written.
    fn end(&mut self) -> Result<Vec<u8>, TableError>;
}

/// Rows of values in some format.
trait Rows: Send {
    fn begin(&mut self) -> Result<Vec<u8>, TableError>;
    fn rows(&mut self, rows: &[Row]) -> Result<Vec<u8>, TableError>;
    fn end(&mut self) -> Result<Vec<u8>, TableError>;
}

/// Entries as rows.
struct Table<T, F> {
    rows: F,
    row: fn(&T) -> Row,
    of: PhantomData<fn(&T)>,
}

impl<T, F: Rows> Writer<T> for Table<T, F> {
    fn begin(&mut self) -> Result<Vec<u8>, TableError> {
        self.rows.begin()
    }

    fn piece(&mut self, entries: &[T]) -> Result<Vec<u8>, TableError> {
        let rows: Vec<Row> = entries.iter().map(self.row).collect();
        self.rows.rows(&rows)
    }

    fn end(&mut self) -> Result<Vec<u8>, TableError> {
        self.rows.end()
    }
}

/// A table as CSV (RFC 4180, with a row of names).
pub fn comma<T: 'static>(columns: &'static [Column], row: fn(&T) -> Row) -> Box<dyn Writer<T>> {
    Box::new(Table {
        rows: Comma::new(columns),
        row,
        of: PhantomData,
    })
}

/// A table as Parquet, with a group of rows for each piece.
///
/// # Errors
/// The columns make no table.
pub fn parquet<T: 'static>(
    columns: &'static [Column],
    row: fn(&T) -> Row,
    said: Vec<(String, String)>,
) -> Result<Box<dyn Writer<T>>, TableError> {
    Ok(Box::new(Table {
        rows: Parquet::new(columns, said)?,
        row,
        of: PhantomData,
    }))
}
