//! Encodes rows as Parquet.

use std::fmt::Write as _;
use std::sync::Arc;

use parquet::basic::Compression;
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DataType, DoubleType, Int64Type};
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::schema::parser::parse_message_type;

use super::{Column, Kind, Row, Rows, TableError, Value};

pub(super) struct Parquet {
    columns: &'static [Column],
    /// Writer into a buffer that is emptied after each chunk; `None` after the end.
    file: Option<SerializedFileWriter<Vec<u8>>>,
}

impl Parquet {
    pub(super) fn new(
        columns: &'static [Column],
        metadata: Vec<(String, String)>,
    ) -> Result<Self, TableError> {
        let schema = Arc::new(parse_message_type(&message(columns))?);
        let metadata = metadata
            .into_iter()
            .map(|(key, value)| KeyValue::new(key, value))
            .collect();
        let properties = WriterProperties::builder()
            .set_compression(Compression::SNAPPY)
            .set_created_by("tread".to_owned())
            .set_key_value_metadata(Some(metadata))
            .build();
        let file = SerializedFileWriter::new(Vec::new(), schema, Arc::new(properties))?;
        Ok(Self {
            columns,
            file: Some(file),
        })
    }
}

/// Returns the schema in Parquet's message format.
fn message(columns: &[Column]) -> String {
    let mut message = "message table {\n".to_owned();
    for Column {
        name,
        kind,
        is_optional,
    } in columns
    {
        let repetition = if *is_optional { "OPTIONAL" } else { "REQUIRED" };
        let (physical, logical) = match kind {
            Kind::Integer => ("INT64", ""),
            Kind::Number => ("DOUBLE", ""),
            Kind::Flag => ("BOOLEAN", ""),
            Kind::Text => ("BYTE_ARRAY", " (STRING)"),
            Kind::Time => ("INT64", " (TIMESTAMP(MICROS,true))"),
        };
        // Writing to a string does not fail.
        let _ = writeln!(message, "  {repetition} {physical} {name}{logical};");
    }
    message.push('}');
    message
}

/// Writes one column of a row group: the rows, the index of the column, and whether it is optional.
fn put<D: DataType>(
    mut column: SerializedColumnWriter<'_>,
    (rows, place, is_optional): (&[Row], usize, bool),
    of: impl Fn(&Value) -> Option<D::T>,
) -> Result<(), TableError> {
    let found = || rows.iter().map(|row| row.get(place).and_then(&of));
    let values: Vec<D::T> = found().flatten().collect();
    let levels: Vec<i16> = found().map(|value| i16::from(value.is_some())).collect();
    let levels = is_optional.then_some(levels.as_slice());
    column.typed::<D>().write_batch(&values, levels, None)?;
    Ok(column.close()?)
}

#[expect(clippy::wildcard_enum_match_arm, reason = "one kind of many each")]
fn put_column(
    column: SerializedColumnWriter<'_>,
    kind: Kind,
    which: (&[Row], usize, bool),
) -> Result<(), TableError> {
    match kind {
        Kind::Integer | Kind::Time => put::<Int64Type>(column, which, |value| match value {
            Value::Integer(number) | Value::Time(number) => Some(*number),
            _ => None,
        }),
        Kind::Number => put::<DoubleType>(column, which, |value| match value {
            Value::Number(number) => Some(*number),
            _ => None,
        }),
        Kind::Flag => put::<BoolType>(column, which, |value| match value {
            Value::Flag(flag) => Some(*flag),
            _ => None,
        }),
        Kind::Text => put::<ByteArrayType>(column, which, |value| match value {
            Value::Text(text) => Some(ByteArray::from(text.as_str())),
            _ => None,
        }),
    }
}

/// Flushes the writer and takes the bytes written so far out of its buffer.
fn taken(file: &mut SerializedFileWriter<Vec<u8>>) -> Result<Vec<u8>, TableError> {
    file.flush()
        .map_err(::parquet::errors::ParquetError::from)?;
    Ok(std::mem::take(file.inner_mut()))
}

impl Rows for Parquet {
    fn begin(&mut self) -> Result<Vec<u8>, TableError> {
        self.file.as_mut().map_or(Ok(Vec::new()), taken)
    }

    fn rows(&mut self, rows: &[Row]) -> Result<Vec<u8>, TableError> {
        let Some(file) = self.file.as_mut().filter(|_| !rows.is_empty()) else {
            return Ok(Vec::new());
        };
        let mut group = file.next_row_group()?;
        for (place, column) in self.columns.iter().enumerate() {
            if let Some(writer) = group.next_column()? {
                put_column(writer, column.kind, (rows, place, column.is_optional))?;
            }
        }
        group.close()?;
        taken(file)
    }

    fn end(&mut self) -> Result<Vec<u8>, TableError> {
        let Some(file) = self.file.take() else {
            return Ok(Vec::new());
        };
        Ok(file.into_inner()?)
    }
}
