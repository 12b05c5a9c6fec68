//! What a database holds, for a copy between engines: tables, rows, values, and checksums over them.

use sha2::{Digest as _, Sha256};

/// Tables that a copy contains. None refers to a row of a later one.
pub const TABLES: [&str; 32] = [
    "sites",
    "terrains",
    "terrain_revisions",
    "geofences",
    "configurations",
    "robots",
    "boots",
    "missions",
    "mission_events",
    "reports_seen",
    "alerts",
    "stops",
    "segment_ranges",
    "segment_values",
    "segments_removed",
    "deferred_segments",
    "measured_configurations",
    "cell_sums",
    "watermarks",
    "withdrawals",
    "tokens",
    "sessions",
    "join_tokens",
    "enrolments",
    "audit",
    "audit_chain",
    "idempotency_keys",
    "webhooks",
    "webhook_deliveries",
    "archive_mark",
    "restorations",
    "server_versions",
];

/// Tables that a copy does not contain, because each database has its own: what a migration or a check
/// of the storage writes, and how PostgreSQL divides a table.
pub const OWN_TABLES: [&str; 4] = [
    "_sqlx_migrations",
    "write_probe",
    "segment_partitions",
    "server_epoch",
];

/// Tables of [`TABLES`] that may have rows in a new database, which the copy replaces: migrations insert
/// them.
pub const SEEDED_TABLES: [&str; 1] = ["audit_chain"];

/// Type of a column, as far as the engines differ in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColumnType {
    /// A 64-bit integer.
    Integer,
    /// A truth value, for SQLite an integer.
    Boolean,
    /// A double.
    Real,
    /// A text.
    Text,
    /// Bytes.
    Bytes,
}

/// A column of a table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Column {
    /// Its name.
    pub name: String,
    /// Its type in this engine.
    pub column_type: ColumnType,
    /// Its place in the primary key, counted from 1; `None` if it is not part of that.
    pub key_position: Option<i64>,
}

/// A table as an engine describes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Table {
    /// Its name.
    pub name: String,
    /// Its columns, by name.
    pub columns: Vec<Column>,
}

impl Table {
    /// Returns the places of the columns of the primary key, in the order of the key.
    pub fn key(&self) -> Vec<usize> {
        let mut key: Vec<usize> = (0..self.columns.len())
            .filter(|place| self.columns[*place].key_position.is_some())
            .collect();
        key.sort_by_key(|place| self.columns[*place].key_position);
        key
    }

    /// Returns the primary key of a row.
    pub fn key_of(&self, row: &Row) -> Vec<Value> {
        let key = self.key().into_iter();
        key.filter_map(|place| row.get(place).cloned()).collect()
    }

    /// Returns whether rows of the other table can be written into this one: columns and key have the
    /// same names.
    pub fn takes_rows_of(&self, other: &Self) -> bool {
        let names = |table: &Self| -> Vec<(String, Option<i64>)> {
            let columns = table.columns.iter();
            columns
                .map(|column| (column.name.clone(), column.key_position))
                .collect()
        };
        names(self) == names(other)
    }
}

/// A stored value.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// No value.
    Null,
    /// An integer; a truth value is 0 or 1.
    Integer(i64),
    /// A double.
    Real(f64),
    /// A text.
    Text(String),
    /// Bytes.
    Bytes(Vec<u8>),
}

impl Value {
    /// Returns about how much memory it takes, bytes.
    pub fn size_bytes(&self) -> usize {
        let content = match self {
            Self::Null | Self::Integer(_) | Self::Real(_) => 0,
            Self::Text(text) => text.len(),
            Self::Bytes(bytes) => bytes.len(),
        };
        size_of::<Self>() + content
    }
}

/// A row: a value for each column of its table.
pub type Row = Vec<Value>;

/// Number and checksum of the rows of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Contents {
    /// Number of rows.
    pub rows: u64,
    /// SHA-256 over the values in the order of the primary key.
    pub checksum: [u8; 32],
}

/// Counts rows and computes their checksum, in the order of the primary key.
#[derive(Debug, Clone, Default)]
pub struct Summary {
    rows: u64,
    hash: Sha256,
}

impl Summary {
    /// Adds a row.
    pub fn add(&mut self, row: &Row) {
        self.rows += 1;
        self.hash.update(row.len().to_le_bytes());
        for value in row {
            match value {
                Value::Null => self.tagged(0, &[]),
                Value::Integer(value) => self.tagged(1, &value.to_le_bytes()),
                // SQLite does not keep the sign of a zero.
                Value::Real(value) => self.tagged(2, &(value + 0.0).to_bits().to_le_bytes()),
                Value::Text(value) => self.tagged(3, value.as_bytes()),
                Value::Bytes(value) => self.tagged(4, value),
            }
        }
    }

    fn tagged(&mut self, tag: u8, bytes: &[u8]) {
        self.hash.update([tag]);
        self.hash.update(bytes.len().to_le_bytes());
        self.hash.update(bytes);
    }

    /// Returns the number of rows that were added.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// Returns number and checksum of the rows that were added.
    pub fn finish(self) -> Contents {
        Contents {
            rows: self.rows,
            checksum: self.hash.finalize().into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn of(rows: &[Row]) -> Contents {
        let mut summary = Summary::default();
        for row in rows {
            summary.add(row);
        }
        summary.finish()
    }

    fn any_value() -> impl Strategy<Value = Value> {
        prop_oneof![
            Just(Value::Null),
            any::<i64>().prop_map(Value::Integer),
            any::<f64>()
                .prop_filter("equality", |value| !value.is_nan())
                .prop_map(Value::Real),
            ".{0,4}".prop_map(Value::Text),
            proptest::collection::vec(any::<u8>(), 0..4).prop_map(Value::Bytes),
        ]
    }

    fn any_rows() -> impl Strategy<Value = Vec<Row>> {
        proptest::collection::vec(proptest::collection::vec(any_value(), 0..3), 0..3)
    }

    proptest! {
        #[test]
        fn different_rows_have_different_checksums(one in any_rows(), other in any_rows()) {
            let (first, second) = (of(&one), of(&other));
            prop_assert_eq!(one == other, first == second);
        }
    }

    #[test]
    fn values_of_different_types_differ_and_both_zeros_are_one() {
        let single = |value| of(&[vec![value]]);
        let all = [
            single(Value::Null),
            single(Value::Integer(0)),
            single(Value::Real(0.0)),
            single(Value::Text(String::new())),
            single(Value::Bytes(Vec::new())),
            of(&[vec![]]),
            of(&[]),
        ];
        for (place, one) in all.iter().enumerate() {
            for other in &all[..place] {
                assert_ne!(one, other);
            }
        }
        assert_eq!(single(Value::Real(-0.0)), single(Value::Real(0.0)));
    }

    #[test]
    fn the_key_is_in_its_own_order() {
        let column = |name: &str, key_position| Column {
            name: name.to_owned(),
            column_type: ColumnType::Integer,
            key_position,
        };
        let table = Table {
            name: "sums".to_owned(),
            columns: vec![
                column("a", Some(2)),
                column("b", None),
                column("c", Some(1)),
            ],
        };
        assert_eq!(table.key(), [2, 0]);
        let row = [1, 2, 3].map(Value::Integer).to_vec();
        assert_eq!(table.key_of(&row), [3, 1].map(Value::Integer));
    }
}
