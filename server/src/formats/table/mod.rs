//! Writes row-oriented tables (CSV, Parquet) in chunks; only the rows of the current chunk are in
//! memory.

pub mod cells;
mod comma;
mod parquet;
pub mod segments;

use std::marker::PhantomData;

use self::comma::Comma;
use self::parquet::Parquet;

/// Type of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// 64-bit integer.
    Integer,
    /// 64-bit floating-point number.
    Number,
    /// Boolean.
    Flag,
    /// String.
    Text,
    /// Time, in microseconds since 1970 UTC.
    Time,
}

/// Definition of a column.
#[derive(Debug, Clone, Copy)]
pub struct Column {
    /// Name of the column, with its unit last.
    pub name: &'static str,
    /// Type of its values.
    pub kind: Kind,
    /// Whether the value may be missing in a row.
    pub is_optional: bool,
}

/// Returns a column whose value is required.
const fn each(name: &'static str, kind: Kind) -> Column {
    Column {
        name,
        kind,
        is_optional: false,
    }
}

/// Returns a column whose value is optional.
const fn some(name: &'static str, kind: Kind) -> Column {
    Column {
        name,
        kind,
        is_optional: true,
    }
}

/// Value of one column in a row.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Missing value.
    Nothing,
    /// 64-bit integer.
    Integer(i64),
    /// 64-bit floating-point number.
    Number(f64),
    /// Boolean.
    Flag(bool),
    /// String.
    Text(String),
    /// Time, in microseconds since 1970 UTC.
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

/// Values of one row, in the order of the columns.
pub type Row = Vec<Value>;

/// Error of encoding a table.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// CSV encoding failed.
    #[error("the rows cannot be written as CSV")]
    Comma(#[from] csv::Error),
    /// Parquet encoding failed.
    #[error("the rows cannot be written as Parquet")]
    Parquet(#[from] ::parquet::errors::ParquetError),
    /// JSON encoding failed.
    #[error("the rows cannot be written as JSON")]
    Json(#[from] serde_json::Error),
}

/// Encoder of entries in chunks: call [`Self::begin`], [`Self::piece`] for each chunk, and
/// [`Self::end`], and concatenate the results.
pub trait Writer<T>: Send {
    /// Returns the bytes before the first chunk.
    ///
    /// # Errors
    /// The encoding fails.
    fn begin(&mut self) -> Result<Vec<u8>, TableError>;

    /// Returns the bytes of one chunk of entries.
    ///
    /// # Errors
    /// The encoding fails.
    fn piece(&mut self, entries: &[T]) -> Result<Vec<u8>, TableError>;

    /// Returns the bytes after the last chunk.
    ///
    /// # Errors
    /// The encoding fails.
    fn end(&mut self) -> Result<Vec<u8>, TableError>;
}

/// Encoder of rows in one format.
trait Rows: Send {
    fn begin(&mut self) -> Result<Vec<u8>, TableError>;
    fn rows(&mut self, rows: &[Row]) -> Result<Vec<u8>, TableError>;
    fn end(&mut self) -> Result<Vec<u8>, TableError>;
}

/// Adapter that converts entries to rows and encodes these.
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

/// Returns an encoder of CSV (RFC 4180, with a header row).
pub fn comma<T: 'static>(columns: &'static [Column], row: fn(&T) -> Row) -> Box<dyn Writer<T>> {
    Box::new(Table {
        rows: Comma::new(columns),
        row,
        of: PhantomData,
    })
}

/// Returns an encoder of Parquet, with one row group for each chunk. `metadata` are the key–value
/// metadata of the file.
///
/// # Errors
/// The columns give no valid schema.
pub fn parquet<T: 'static>(
    columns: &'static [Column],
    row: fn(&T) -> Row,
    metadata: Vec<(String, String)>,
) -> Result<Box<dyn Writer<T>>, TableError> {
    Ok(Box::new(Table {
        rows: Parquet::new(columns, metadata)?,
        row,
        of: PhantomData,
    }))
}
