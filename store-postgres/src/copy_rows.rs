//! Rows in the binary format of `COPY`, the fastest way to write many.
//!
//! Each row is the number of its columns and then each value with its length before it; all numbers
//! are in network byte order.

use super::{Connection, EngineError};

/// What every transfer begins with: the signature, no flags, and no extension.
const HEADER: &[u8] = b"PGCOPY\n\xff\r\n\0\0\0\0\0\0\0\0\0";
/// What it ends with, in place of the number of columns.
const END: i16 = -1;
/// Length of a value that is `NULL`.
const NULL: i32 = -1;

/// Rows with the same columns, encoded.
#[derive(Debug)]
pub(super) struct CopyRows {
    bytes: Vec<u8>,
    columns: i16,
}

/// A row that is being encoded, column by column.
pub(super) struct CopyRow<'rows>(&'rows mut Vec<u8>);

impl CopyRows {
    pub(super) fn new(columns: i16) -> Self {
        Self {
            bytes: HEADER.to_vec(),
            columns,
        }
    }

    /// Begins a row, which must get as many values as there are columns.
    pub(super) fn row(&mut self) -> CopyRow<'_> {
        self.bytes.extend(self.columns.to_be_bytes());
        CopyRow(&mut self.bytes)
    }

    /// Writes the rows by a `COPY … FROM STDIN (FORMAT binary)`, and returns their number.
    pub(super) async fn write(
        mut self,
        db: &mut Connection,
        statement: &str,
    ) -> Result<u64, EngineError> {
        self.bytes.extend(END.to_be_bytes());
        let mut copying = db.copy_in_raw(statement).await?;
        copying.send(self.bytes).await?;
        Ok(copying.finish().await?)
    }
}

impl CopyRow<'_> {
    /// Adds a `BIGINT`.
    pub(super) fn integer(&mut self, value: impl Into<i64>) -> &mut Self {
        self.value(&value.into().to_be_bytes())
    }

    /// Adds a `DOUBLE PRECISION`.
    pub(super) fn real(&mut self, value: impl Into<Option<f64>>) -> &mut Self {
        match value.into() {
            Some(value) => self.value(&value.to_be_bytes()),
            None => self.null(),
        }
    }

    /// Adds a `BOOLEAN`.
    pub(super) fn boolean(&mut self, value: bool) -> &mut Self {
        self.value(&[value.into()])
    }

    /// Adds a `BYTEA`.
    pub(super) fn bytes(&mut self, value: &[u8]) -> &mut Self {
        self.value(value)
    }

    /// Adds a `TEXT`.
    pub(super) fn text(&mut self, value: Option<&str>) -> &mut Self {
        match value {
            Some(value) => self.value(value.as_bytes()),
            None => self.null(),
        }
    }

    fn value(&mut self, bytes: &[u8]) -> &mut Self {
        let length = i32::try_from(bytes.len()).unwrap_or(i32::MAX);
        self.0.extend(length.to_be_bytes());
        self.0.extend(bytes);
        self
    }

    fn null(&mut self) -> &mut Self {
        self.0.extend(NULL.to_be_bytes());
        self
    }
}
