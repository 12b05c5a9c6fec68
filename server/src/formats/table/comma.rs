//! Encodes rows as CSV.

use jiff::Timestamp;

use super::{Column, Row, Rows, TableError, Value};

pub(super) struct Comma {
    columns: &'static [Column],
}

impl Comma {
    pub(super) fn new(columns: &'static [Column]) -> Self {
        Self { columns }
    }
}

fn text(value: &Value) -> String {
    match value {
        Value::Nothing => String::new(),
        Value::Integer(number) => number.to_string(),
        Value::Number(number) => number.to_string(),
        Value::Flag(flag) => flag.to_string(),
        Value::Text(text) => text.clone(),
        Value::Time(at_us) => Timestamp::from_microsecond(*at_us)
            .map_or_else(|_range| String::new(), |at| at.to_string()),
    }
}

fn written<'row>(
    rows: impl Iterator<Item = Vec<std::borrow::Cow<'row, str>>>,
) -> Result<Vec<u8>, TableError> {
    let mut writer = csv::WriterBuilder::new()
        .terminator(csv::Terminator::CRLF)
        .from_writer(Vec::new());
    for row in rows {
        writer.write_record(row.iter().map(|field| field.as_bytes()))?;
    }
    let bytes = writer.into_inner();
    Ok(bytes.map_err(|error| csv::Error::from(error.into_error()))?)
}

impl Rows for Comma {
    fn begin(&mut self) -> Result<Vec<u8>, TableError> {
        let names = self.columns.iter().map(|column| column.name.into());
        written(std::iter::once(names.collect()))
    }

    fn rows(&mut self, rows: &[Row]) -> Result<Vec<u8>, TableError> {
        written(
            rows.iter()
                .map(|row| row.iter().map(|value| text(value).into()).collect()),
        )
    }

    fn end(&mut self) -> Result<Vec<u8>, TableError> {
        Ok(Vec::new())
    }
}
