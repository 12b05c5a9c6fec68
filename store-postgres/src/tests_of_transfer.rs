//! A copy between engines: both have the same tables, and every value is the same in either.

use std::collections::BTreeSet;

use proptest::prelude::*;
use proptest::strategy::ValueTree as _;
use proptest::test_runner::TestRunner;
use sqlx::PgConnection;
use tread_store::transfer::{OWN_TABLES, Row, TABLES, Table, Value};

use crate::testing::with_database;
use crate::{EngineError, transfer};

/// Number of random rows.
const ROWS: usize = 300;

fn names() -> BTreeSet<String> {
    let names = TABLES.into_iter().chain(OWN_TABLES);
    names.map(str::to_owned).collect()
}

async fn with_both(
    test: &str,
    body: impl AsyncFnOnce(&mut PgConnection, &mut tread_store_sqlite::Tx),
) {
    with_database(test, async |database| {
        let folder = std::env::temp_dir().join(format!("tread-transfer-{}", uuid::Uuid::new_v4()));
        std::fs::create_dir(&folder).unwrap();
        let sqlite = tread_store_sqlite::Db::open(&folder.join("tread.db"))
            .await
            .unwrap();
        let mut tx = sqlite.write("db").await.unwrap();
        body(&mut database.connect().await, &mut tx).await;
        drop(tx);
        sqlite.close().await;
        std::fs::remove_dir_all(&folder).unwrap();
    })
    .await;
}

#[tokio::test]
async fn both_engines_have_the_same_tables_and_none_is_forgotten() {
    with_both(
        "both_engines_have_the_same_tables",
        async |postgres, sqlite| {
            let here = transfer::tables(postgres).await.unwrap();
            let there = tread_store_sqlite::transfer::tables(sqlite).await.unwrap();
            for (here, there) in here.iter().zip(&there) {
                assert!(here.takes_rows_of(there), "{here:?} {there:?}");
                assert!(!here.key().is_empty(), "{}", here.name);
            }
            let found: Vec<(String,)> = sqlx::query_as(
                "SELECT CAST(relname AS TEXT) FROM pg_class
                 WHERE relnamespace = CAST('public' AS regnamespace)
                     AND relkind IN ('r', 'p') AND NOT relispartition",
            )
            .fetch_all(&mut *postgres)
            .await
            .unwrap();
            let found: BTreeSet<String> = found.into_iter().map(|(name,)| name).collect();
            assert_eq!(found, names());
            let found: Vec<(String,)> = sqlx::query_as(
                "SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT LIKE 'sqlite%'",
            )
            .fetch_all(&mut **sqlite)
            .await
            .unwrap();
            let found: BTreeSet<String> = found.into_iter().map(|(name,)| name).collect();
            let own = names();
            assert!(found.is_subset(&own), "{:?}", found.difference(&own));
        },
    )
    .await;
}

#[tokio::test]
async fn no_table_refers_to_a_later_one() {
    with_both("no_table_refers_to_a_later_one", async |postgres, _| {
        let references: Vec<(String, String)> = sqlx::query_as(
            "SELECT CAST(conrelid::regclass AS TEXT), CAST(confrelid::regclass AS TEXT)
             FROM pg_constraint WHERE contype = 'f'",
        )
        .fetch_all(postgres)
        .await
        .unwrap();
        assert!(references.len() > 10);
        let place = |name: &str| TABLES.iter().position(|table| *table == name).unwrap();
        for (from, to) in references {
            assert!(place(&to) < place(&from), "{from} refers to {to}");
        }
    })
    .await;
}

fn real() -> impl Strategy<Value = f64> {
    any::<f64>().prop_filter("SQLite stores no NaN", |value| !value.is_nan())
}

/// A row of the table: every kind of number in `segment_values`, every text in `server_versions`, and
/// bytes in `tokens`.
fn row_of(table: &Table, place: i64) -> impl Strategy<Value = Row> + use<> {
    let columns = table.columns.clone();
    let column_values = columns.into_iter().map(move |column| {
        use tread_store::transfer::ColumnType;
        match (column.name.as_str(), column.column_type) {
            ("pk", _) => Just(Value::Integer(place)).boxed(),
            ("id", _) => Just(Value::Text(format!("{place:08}"))).boxed(),
            ("role", _) => Just(Value::Text("viewer".to_owned())).boxed(),
            ("rights" | "scope", _) => Just(Value::Null).boxed(),
            ("lookup", _) => Just(Value::Bytes(place.to_le_bytes().to_vec())).boxed(),
            ("hash", _) => prop::collection::vec(any::<u8>(), 32)
                .prop_map(Value::Bytes)
                .boxed(),
            (name, ColumnType::Real) if name.ends_with("_m") || name.starts_with("theta") => {
                real().prop_map(Value::Real).boxed()
            }
            ("saturation_ratio", _) => real().prop_map(Value::Real).boxed(),
            (_, ColumnType::Real) => {
                prop_oneof![Just(Value::Null), real().prop_map(Value::Real)].boxed()
            }
            (_, ColumnType::Integer) => any::<i64>().prop_map(Value::Integer).boxed(),
            (_, ColumnType::Boolean) => (0..=1_i64).prop_map(Value::Integer).boxed(),
            (_, ColumnType::Text) => any::<String>()
                .prop_map(|text| Value::Text(text.replace('\0', "")))
                .boxed(),
            (_, ColumnType::Bytes) => prop::collection::vec(any::<u8>(), 0..9)
                .prop_map(Value::Bytes)
                .boxed(),
        }
    });
    column_values.collect::<Vec<_>>()
}

#[tokio::test]
async fn every_value_is_the_same_after_the_way_to_the_other_engine_and_back() {
    with_both("every_value_is_the_same", async |postgres, sqlite| {
        let here = transfer::tables(postgres).await.unwrap();
        let there = tread_store_sqlite::transfer::tables(sqlite).await.unwrap();
        let mut runner = TestRunner::deterministic();
        for name in ["segment_values", "server_versions", "tokens", "webhooks"] {
            let (here, there) = (table(&here, name), table(&there, name));
            let mut rows = Vec::new();
            for place in 1..=ROWS {
                let place = i64::try_from(place).unwrap();
                let mut row = row_of(here, place).new_tree(&mut runner).unwrap().current();
                if name == "webhooks" {
                    let null = |column: &str| here.columns.iter().position(|it| it.name == column);
                    row[null("kinds").unwrap()] = Value::Null;
                    row[null("sites").unwrap()] = Value::Null;
                    row[null("name").unwrap()] = Value::Text(place.to_string());
                }
                rows.push(row);
            }
            transfer::insert(postgres, here, &rows).await.unwrap();
            let read = all(
                async |after, limit| transfer::rows(postgres, here, after, limit).await,
                here,
            )
            .await;
            assert_eq!(read, rows, "{name}");
            tread_store_sqlite::transfer::insert(sqlite, there, &read)
                .await
                .unwrap();
            let back = tread_store_sqlite::transfer::rows(sqlite, there, None, 1_000)
                .await
                .unwrap();
            assert_eq!(back, rows, "{name}");
        }
        transfer::finish(postgres, &here).await.unwrap();
        let next: (i64,) = sqlx::query_as(
            "INSERT INTO server_versions (version, opened_at_us) VALUES ('1', 1) RETURNING pk",
        )
        .fetch_one(postgres)
        .await
        .unwrap();
        assert_eq!(next.0, i64::try_from(ROWS).unwrap() + 1);
    })
    .await;
}

fn table<'all>(tables: &'all [Table], name: &str) -> &'all Table {
    tables.iter().find(|table| table.name == name).unwrap()
}

/// Reads all rows in chunks of seven.
async fn all(
    mut rows: impl AsyncFnMut(Option<&[Value]>, u32) -> Result<Vec<Row>, EngineError>,
    table: &Table,
) -> Vec<Row> {
    let mut read: Vec<Row> = Vec::new();
    loop {
        let after = read.last().map(|row| table.key_of(row));
        let chunk = rows(after.as_deref(), 7).await.unwrap();
        if chunk.is_empty() {
            return read;
        }
        read.extend(chunk);
    }
}

#[tokio::test]
async fn what_postgresql_cannot_store_is_refused_with_its_place() {
    with_both(
        "what_postgresql_cannot_store_is_refused",
        async |postgres, _| {
            let tables = transfer::tables(postgres).await.unwrap();
            let versions = table(&tables, "server_versions");
            let row = |version: Value| {
                let columns = versions.columns.iter();
                let values = columns.map(|column| match column.name.as_str() {
                    "version" => version.clone(),
                    _ => Value::Integer(7),
                });
                values.collect::<Row>()
            };
            for (version, said) in [
                (
                    Value::Text("a\0b".to_owned()),
                    "column version of server_versions, row [Integer(7)]",
                ),
                (
                    Value::Integer(1),
                    "column version of server_versions, row [Integer(7)]",
                ),
            ] {
                let refused = transfer::insert(postgres, versions, &[row(version)]).await;
                let refused = refused.unwrap_err().to_string();
                assert!(refused.contains(said), "{refused}");
            }
        },
    )
    .await;
}
