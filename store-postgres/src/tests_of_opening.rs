//! Opening of databases: what is refused and why, TLS, migrations, and the lock of a server.

use std::time::Duration;

use tokio::time::sleep;

use crate::inspection::{Schema, inspect};
use crate::lock::{DatabaseLock, LockError};
use crate::testing::{admin_url, with_database};
use crate::{Db, OpenError, schema};

const PASSWORD: &str = "hunter2";

async fn refusal(url: &str) -> OpenError {
    Db::open(url).await.unwrap_err()
}

/// Returns an error with all its causes, as the log shows it.
fn chain(error: &OpenError) -> String {
    let mut text = error.to_string();
    let mut next = std::error::Error::source(error);
    while let Some(cause) = next {
        text = format!("{text}: {cause}");
        next = cause.source();
    }
    text
}

#[tokio::test]
async fn an_address_that_leads_nowhere_is_named_without_its_password() {
    let error = refusal(&format!("postgres://anna:{PASSWORD}@127.0.0.1:1/yard")).await;
    assert!(matches!(error, OpenError::Unreachable { .. }), "{error:?}");
    let text = chain(&error);
    assert!(
        text.contains("`postgres://anna@127.0.0.1:1/yard`"),
        "{text}"
    );
    assert!(!text.contains(PASSWORD), "{text}");
    for wrong in [
        format!("postgres://anna:{PASSWORD}@127.0.0.1:port/yard"),
        format!("anna:{PASSWORD}"),
        format!("postgres://anna:{PASSWORD}@[::1/yard"),
    ] {
        let error = refusal(&wrong).await;
        assert!(matches!(error, OpenError::Address(_)), "{error:?}");
        assert!(
            !format!("{error:?} {}", chain(&error)).contains(PASSWORD),
            "{error:?}"
        );
    }
}

#[tokio::test]
async fn what_is_wrong_with_user_or_database_is_said() {
    let Some(admin) = admin_url("what_is_wrong_with_user_or_database_is_said") else {
        return;
    };
    let error = refusal(&admin.of("there_is_none")).await;
    assert!(matches!(error, OpenError::NoDatabase { .. }), "{error:?}");
    let (user, server) = admin.0.split_once('@').unwrap();
    let (user, _password) = user.rsplit_once(':').unwrap();
    let error = refusal(&format!("{user}:{PASSWORD}@{server}")).await;
    assert!(
        matches!(error, OpenError::Authentication { .. }),
        "{error:?}"
    );
    assert!(!format!("{error:?} {}", chain(&error)).contains(PASSWORD));
}

#[tokio::test]
async fn tls_is_made_as_the_address_demands() {
    let test = "tls_is_made_as_the_address_demands";
    with_database(test, async |database| {
        let Ok(certificate) = std::env::var("TREAD_TEST_POSTGRES_CERTIFICATE") else {
            eprintln!("`{test}` was NOT RUN: the server has no certificate");
            return;
        };
        // Its authority is none that the operating system trusts.
        let error = refusal(&format!("{}?sslmode=verify-full", database.url)).await;
        assert!(matches!(error, OpenError::Tls { .. }), "{error:?}");
        let trusted = format!(
            "{}?sslmode=verify-full&sslrootcert={certificate}",
            database.url
        );
        for (url, expected) in [
            (trusted, true),
            (format!("{}?sslmode=require", database.url), true),
            (format!("{}?sslmode=disable", database.url), false),
        ] {
            let db = Db::open(&url).await.unwrap();
            let mut tx = db.read("db").await.unwrap();
            let (is_encrypted,): (bool,) =
                sqlx::query_as("SELECT ssl FROM pg_stat_ssl WHERE pid = pg_backend_pid()")
                    .fetch_one(&mut *tx)
                    .await
                    .unwrap();
            assert_eq!(is_encrypted, expected, "{url}");
            drop(tx);
            db.close().await;
        }
    })
    .await;
}

/// Ends all other connections of the database.
const END_ALL: &str = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity
     WHERE datname = current_database() AND pid <> pg_backend_pid()";

/// Takes the lock that somebody is just releasing.
async fn eventually_taken(url: &str) -> DatabaseLock {
    for _ in 0..100 {
        if let Ok(lock) = DatabaseLock::take(url).await {
            return lock;
        }
        sleep(Duration::from_millis(100)).await;
    }
    panic!("the lock was never released");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn only_one_server_has_the_lock_and_takes_it_again_when_its_connection_ends() {
    let test = "only_one_server_has_the_lock_and_takes_it_again_when_its_connection_ends";
    with_database(test, async |database| {
        let lock = DatabaseLock::take(&database.url).await.unwrap();
        let error = DatabaseLock::take(&database.url).await.unwrap_err();
        assert!(matches!(error, LockError::InUse { .. }), "{error:?}");
        assert!(
            error.to_string().contains("(at 127.0.0.1, since 2"),
            "{error}"
        );
        database.run(END_ALL).await;
        let mut is_held = false;
        for _ in 0..100 {
            // Longer than the interval at which it looks.
            sleep(Duration::from_millis(300)).await;
            let found: (i64,) = sqlx::query_as(
                "SELECT COUNT(*) FROM pg_locks WHERE locktype = 'advisory' AND granted AND database =
                     (SELECT oid FROM pg_database WHERE datname = current_database())",
            )
            .fetch_one(&mut database.connect().await)
            .await
            .unwrap();
            is_held = found.0 > 0;
            if is_held {
                break;
            }
        }
        assert!(is_held, "it was not taken again");
        lock.release().await;
        // Now another process is faster than the one that has lost its connection.
        let first = eventually_taken(&database.url).await;
        let mut other = database.connect().await;
        loop {
            database.run(&format!("{END_ALL} AND application_name LIKE 'tread-server %'")).await;
            let taking = sqlx::query_scalar("SELECT pg_try_advisory_lock(8390880524716175990)");
            let is_taken: bool = taking.fetch_one(&mut other).await.unwrap();
            if is_taken {
                break;
            }
        }
        let reason = first.lost().await;
        assert!(reason.contains("is used by another server"), "{reason}");
    })
    .await;
}

#[tokio::test]
async fn a_database_that_is_newer_or_stores_no_unicode_is_refused() {
    with_database(
        "a_database_that_is_newer_or_stores_no_unicode_is_refused",
        async |database| {
            database
                .run(
                    "INSERT INTO server_versions (version, opened_at_us) VALUES ('9.8.7', 1);
                 INSERT INTO _sqlx_migrations
                     (version, description, success, checksum, execution_time)
                 VALUES (99990101000000, 'later', TRUE, '', 0);",
                )
                .await;
            let error = refusal(&database.url).await;
            assert!(matches!(error, OpenError::Newer { .. }), "{error:?}");
            assert!(
                error.to_string().contains("version 9.8.7 or newer"),
                "{error}"
            );
            let found = inspect(&database.url, false).await.unwrap();
            assert_eq!(found.schema, Schema::Newer(99_990_101_000_000));
            let other = format!("{}_ascii", database.url.rsplit('/').next().unwrap());
            database
                .run(&format!(
                    "CREATE DATABASE {other} ENCODING SQL_ASCII TEMPLATE template0 LOCALE 'C'"
                ))
                .await;
            let error = refusal(&database.admin.of(&other)).await;
            assert!(matches!(error, OpenError::Encoding { .. }), "{error:?}");
            database.run(&format!("DROP DATABASE {other}")).await;
        },
    )
    .await;
}

#[tokio::test]
async fn several_servers_may_open_an_empty_database_at_once() {
    with_database(
        "several_servers_may_open_an_empty_database_at_once",
        async |database| {
            database
                .run("DROP SCHEMA public CASCADE; CREATE SCHEMA public")
                .await;
            assert_eq!(
                inspect(&database.url, true).await.unwrap().schema,
                Schema::Empty
            );
            let opened =
                futures_util::future::join_all((0..4).map(|_| Db::open(&database.url))).await;
            for db in opened {
                db.unwrap().close().await;
            }
            let found = inspect(&database.url, true).await.unwrap();
            assert_eq!(found.schema, Schema::Current(schema::known()));
            assert_eq!((found.newest, found.damage), (None, None));
        },
    )
    .await;
}
