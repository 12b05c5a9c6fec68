//! What released versions left: their databases open and lose nothing, and the messages of their
//! agents are taken. Each release has a folder of that in `tests/fixtures/releases`.

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};

use flate2::read::GzDecoder;
use flate2::{Compression, GzBuilder};
use jiff::Timestamp;
use serde_json::{Value, json};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions as _, Connection as _, SqliteConnection};
use tread_api::ids::{RobotId, SiteId};
use tread_api::keys;
use tread_api::wire::hello::Welcome;
use tread_api::wire::ingest::Receipt;
use tread_server::db::file::copy::{self, CopyPaths};
use tread_server::db::file::{OpenError, schema};
use tread_server::db::restorations::{Restoration, begin};
use tread_server::db::{self, Db};
use zenoh::Wait as _;

use crate::backups::{run, words};
use crate::harness::{Yard, ask, eventually, folder_of_the_crate};
use crate::robot::session;

/// Tables that need not have rows in the database of a release.
const MAY_BE_EMPTY: [&str; 3] = ["deferred_segments", "segments_removed", "sessions"];
/// Set to write the database of the present version anew, before it is released.
const UPDATE: &str = "UPDATE_RELEASE";

fn fixtures() -> PathBuf {
    folder_of_the_crate().join("../tests/fixtures")
}

/// The released versions, and the present one: each heading of the changelog with a number.
fn versions() -> Vec<String> {
    let changelog = folder_of_the_crate().join("../CHANGELOG.md");
    let text = fs::read_to_string(changelog).unwrap();
    let headings = text.lines().filter_map(|line| line.strip_prefix("## ["));
    let names = headings.filter_map(|rest| rest.split_once(']'));
    let numbered =
        names.filter(|(name, _)| name.starts_with(|letter: char| letter.is_ascii_digit()));
    numbered.map(|(name, _)| name.to_owned()).collect()
}

fn unpack(packed: &Path, into: &Path) {
    let mut content = Vec::new();
    let packed = fs::File::open(packed).unwrap();
    GzDecoder::new(packed).read_to_end(&mut content).unwrap();
    fs::write(into, content).unwrap();
}

/// Writes the database of the present version, with rows in almost every table.
pub(crate) fn present_database(into: &Path) {
    let version = env!("CARGO_PKG_VERSION");
    let packed = fixtures().join(format!("releases/{version}/tread.db.gz"));
    unpack(&packed, into);
}

/// Writes a database that lacks migrations.
pub(crate) fn earlier_database(into: &Path) {
    unpack(&fixtures().join("state-before-renaming/tread.db.gz"), into);
}

async fn open(file: &Path) -> SqliteConnection {
    let options = SqliteConnectOptions::new().filename(file);
    options.read_only(true).connect().await.unwrap()
}

/// Numbers of rows by table.
async fn rows(connection: &mut SqliteConnection) -> BTreeMap<String, i64> {
    let tables: Vec<(String,)> = sqlx::query_as(
        "SELECT name FROM sqlite_schema WHERE type = 'table' AND name NOT LIKE 'sqlite%'
         AND name NOT LIKE '\\_sqlx%' ESCAPE '\\'",
    )
    .fetch_all(&mut *connection)
    .await
    .unwrap();
    let mut counts = BTreeMap::new();
    for (table,) in tables {
        let count = AssertSqlSafe(format!("SELECT COUNT(*) FROM {table}"));
        let (count,): (i64,) = sqlx::query_as(count)
            .fetch_one(&mut *connection)
            .await
            .unwrap();
        counts.insert(table, count);
    }
    counts
}

/// Makes the database of the present version: that of the earlier build, brought up to date, with
/// rows in what came since.
async fn make_present(target: &Path) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tread.db");
    earlier_database(&path);
    let database = Db::open(&path).await.unwrap();
    let mut tx = database.write("test").await.unwrap();
    let restoration = Restoration {
        restored_at: "2026-11-25T08:00:00Z".parse().unwrap(),
        taken_at: "2026-11-25T07:00:00Z".parse().unwrap(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
    };
    for statement in [
        "INSERT INTO webhooks (id, name, url, secret, enabled, created_at_us, created_by) VALUES
             ('0192f0c1-2b3c-7d4e-8f50-617283940a1b', 'on call', 'https://example.org/', 's', 1, 1, 't')",
        "INSERT INTO webhook_deliveries (id, webhook_id, event, kind, body, state, created_at_us,
             due_at_us) VALUES ('0192f0c1-2b3c-7d4e-8f50-617283940a1c',
             '0192f0c1-2b3c-7d4e-8f50-617283940a1b', 'test', 'test', '{}', 'pending', 1, 1)",
        "INSERT INTO withdrawals (robot_pk, from_h, to_h, reason, withdrawn_by, withdrawn_at_us)
             SELECT MIN(pk), 1, 2, 'a test', 't', 1 FROM robots",
        "INSERT INTO archive_mark (id, first_pk, last_pk) VALUES (1, 1, 1)",
        "INSERT INTO idempotency_keys (owner, key, request_hash, answer, created_at_us) VALUES
             ('o', 'k', 'h', '{}', 1)",
    ] {
        let made = sqlx::raw_sql(statement).execute(&mut **tx.as_sqlite().unwrap()).await;
        made.unwrap();
    }
    begin(&mut tx, &restoration).await.unwrap();
    let now: Timestamp = restoration.restored_at;
    db::schema::record_version(&mut tx, &restoration.version, now)
        .await
        .unwrap();
    tx.commit().await.unwrap();
    database.close().await;
    let copied = folder.path().join("copy.db");
    let paths = CopyPaths {
        database: &path,
        target: &copied,
    };
    copy::copy_into(paths).await.unwrap();
    fs::create_dir_all(target.parent().unwrap()).unwrap();
    // Without a time, so that the same content is the same file.
    let file = fs::File::create(target).unwrap();
    let mut packing = GzBuilder::new().mtime(0).write(file, Compression::best());
    packing.write_all(&fs::read(&copied).unwrap()).unwrap();
    packing.finish().unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_release_has_a_database_of_its_schema() {
    let (present, known) = (env!("CARGO_PKG_VERSION"), schema::known());
    let versions = versions();
    assert_eq!(
        versions.first().map(String::as_str),
        Some(present),
        "CHANGELOG.md"
    );
    if std::env::var_os(UPDATE).is_some() {
        let target = fixtures().join(format!("releases/{present}/tread.db.gz"));
        make_present(&target).await;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut newest = None;
    for version in &versions {
        let packed = fixtures().join(format!("releases/{version}/tread.db.gz"));
        assert!(packed.exists(), "{version} has no {}", packed.display());
        let path = folder.path().join(version);
        unpack(&packed, &path);
        let found = schema::of_file(&path).await.unwrap();
        assert_eq!(found.version.as_deref(), Some(version.as_str()));
        let mut connection = open(&path).await;
        for (table, count) in rows(&mut connection).await {
            let is_there = count > 0 || MAY_BE_EMPTY.contains(&table.as_str());
            assert!(
                is_there,
                "{version}: `{table}` is empty, so its rows are not tried"
            );
        }
        newest = newest.or(found.schema);
    }
    assert_eq!(
        newest,
        Some(known),
        "a migration was added: raise the version and give the changelog a heading, or, if {present} \
         is not released yet, run this test with {UPDATE}=1"
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn databases_of_all_releases_are_brought_up_to_date_and_keep_their_rows() {
    for version in versions() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tread.db");
        let packed = fixtures().join(format!("releases/{version}/tread.db.gz"));
        unpack(&packed, &path);
        let mut connection = open(&path).await;
        let before = rows(&mut connection).await;
        connection.close().await.unwrap();
        let due = schema::missing_after(schema::of_file(&path).await.unwrap().schema);
        let database = path.to_str().unwrap().to_owned();
        let checked = run(&["migrate", "--check", "--database", &database]);
        let expected = if due.is_empty() { 0 } else { 3 };
        assert_eq!(checked.status.code(), Some(expected), "{}", words(&checked));
        let migrated = run(&["migrate", "--database", &database]);
        assert!(migrated.status.success(), "{}", words(&migrated));
        let mut connection = open(&path).await;
        let after = rows(&mut connection).await;
        for (table, count) in before {
            // The version that opened it last is noted.
            let is_kept = after.get(&table).is_some_and(|now| *now >= count);
            assert!(is_kept, "{version}: `{table}` had {count} rows: {after:?}");
        }
        let row = sqlx::query("PRAGMA foreign_key_check").fetch_optional(&mut connection);
        assert!(row.await.unwrap().is_none());
        connection.close().await.unwrap();
        // A server starts on it.
        let database = Db::open(&path).await.unwrap();
        assert_eq!(database.quick_check().await.unwrap(), None);
        database.close().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_newer_database_is_refused_with_the_version_to_install() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tread.db");
    let database = Db::open(&path).await.unwrap();
    let mut tx = database.write("test").await.unwrap();
    let newer = schema::known() + 1;
    sqlx::query(
        "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
         VALUES (?, 'newer', TRUE, x'00', 0)",
    )
    .bind(newer)
    .execute(&mut **tx.as_sqlite().unwrap())
    .await
    .unwrap();
    db::schema::record_version(&mut tx, "9.8.7", Timestamp::UNIX_EPOCH)
        .await
        .unwrap();
    tx.commit().await.unwrap();
    database.close().await;
    let refused = Db::open(&path).await.unwrap_err();
    assert!(
        matches!(refused, db::OpenError::Sqlite(OpenError::Newer { .. })),
        "{refused}"
    );
    let text = refused.to_string();
    for part in ["9.8.7 or newer", "tread-server restore", &newer.to_string()] {
        assert!(text.contains(part), "{part} in {text}");
    }
    let checked = run(&["migrate", "--check", "--database", path.to_str().unwrap()]);
    assert_eq!(checked.status.code(), Some(4), "{}", words(&checked));
    let before = fs::read(&path).unwrap();
    assert_eq!(
        run(&["migrate", "--database", path.to_str().unwrap()])
            .status
            .code(),
        Some(4)
    );
    assert_eq!(fs::read(&path).unwrap(), before, "nothing was changed");
}

#[test]
fn the_version_names_commit_wire_and_schema() {
    let said = words(&run(&["--version"]));
    let schema = schema::known().to_string();
    for part in [
        "tread-server",
        env!("CARGO_PKG_VERSION"),
        "commit",
        "wire",
        &schema,
    ] {
        assert!(said.contains(part), "{part} in {said}");
    }
}

/// Adds a field that nobody knows to every object.
fn add_unknown(value: &mut Value) {
    match value {
        Value::Object(fields) => {
            fields.values_mut().for_each(add_unknown);
            // An object with one field is a choice, which has no room for another.
            if fields.len() > 1 {
                fields.insert("of_a_newer_release".to_owned(), json!({"a": [1, null]}));
            }
        }
        Value::Array(entries) => entries.iter_mut().for_each(add_unknown),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_of_released_agents_are_taken_and_those_of_newer_ones() {
    for version in versions() {
        let file = fixtures().join(format!("releases/{version}/messages.json"));
        let text =
            fs::read_to_string(&file).unwrap_or_else(|_| panic!("{} is missing", file.display()));
        let recorded: Value = serde_json::from_str(&text).unwrap();
        for is_newer in [false, true] {
            let mut messages = recorded.clone();
            if is_newer {
                add_unknown(&mut messages);
                messages["hello"]["body"]["agent_version"] = json!("0.99.0");
            }
            takes(&messages).await;
        }
    }
}

async fn takes(messages: &Value) {
    let yard = Yard::start().await;
    let hello = &messages["hello"];
    let (site, robot): (SiteId, RobotId) = (
        "yard".parse().unwrap(),
        serde_json::from_value(hello["body"]["robot"].clone()).unwrap(),
    );
    let session = session(&yard).await;
    let boot = serde_json::from_value(hello["body"]["boot"].clone()).unwrap();
    let alive = keys::alive(&site, &robot, boot);
    let token = session.liveliness().declare_token(alive).wait().unwrap();
    let bytes = |value: &Value| serde_json::to_vec(value).unwrap();
    let welcome: Welcome = ask(&session, keys::hello(&site, &robot), bytes(hello))
        .await
        .unwrap();
    assert!((welcome.site.grid.cell_m - 1.0).abs() < f64::EPSILON);
    let batches = messages["batches"].as_array().unwrap();
    let (mut segments, mut committed) = (0, 0);
    for batch in batches {
        let records = batch["body"]["records"].as_array().unwrap();
        let of_segments = records
            .iter()
            .filter(|record| record["content"]["segment"].is_object());
        segments += of_segments.count() as u64;
        let receipt: Receipt = ask(&session, keys::ingest(&site, &robot), bytes(batch))
            .await
            .unwrap();
        committed += receipt.committed;
        for refused in receipt.refused {
            // This server never sent the mission that was recorded.
            assert!(refused.reason.contains("mission"), "{}", refused.reason);
        }
    }
    assert!(segments > 0);
    assert_eq!(committed, segments);
    let states = messages["states"].as_array().unwrap();
    eventually("the server shows the robot's state", async || {
        for state in states {
            session
                .put(keys::state(&site, &robot), bytes(state))
                .wait()
                .unwrap();
        }
        let (_, view) = yard
            .get_value(&format!("/v1/sites/yard/robots/{robot}"))
            .await;
        let is_shown = view["live"]["mode"].is_string();
        if is_shown { Ok(()) } else { Err(view) }
    })
    .await;
    let counters = yard.counters().await;
    let malformed = serde_json::to_value(counters).unwrap()["refused_malformed"].clone();
    assert_eq!(malformed, json!(0));
    drop(token);
    yard.server.stop().await.unwrap();
}
