//! The engine of the databases that tests and reports make: SQLite, or PostgreSQL if `TREAD_TEST_ENGINE` is
//! `postgres`, on the server that `TREAD_TEST_POSTGRES` names
//! (`TREAD_TEST_ENGINE=postgres store-postgres/with-postgres COMMAND`).

use std::borrow::Cow;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::Path;
use std::{env, thread};

use sqlx::error::DatabaseError;
use sqlx::{AssertSqlSafe, Connection as _, PgConnection};

/// Variable with the engine: `postgres`, or a file of SQLite.
const ENGINE: &str = "TREAD_TEST_ENGINE";
/// Variable with the address of a server on which databases may be created.
pub(crate) const SERVER: &str = "TREAD_TEST_POSTGRES";
/// Code of the error that the database exists.
const EXISTS: &str = "42P04";

/// Returns the address of the database that belongs to a folder, which is created when it is missing;
/// `None` if databases are files of SQLite.
///
/// # Panics
/// No server is named, or it does not create the database.
pub(crate) fn address_for(folder: &Path) -> Option<String> {
    if env::var(ENGINE).ok()? != "postgres" {
        return None;
    }
    let admin = env::var(SERVER).expect("TREAD_TEST_POSTGRES names a server");
    Some(created(&admin, folder))
}

/// Returns the address of the database of a server that belongs to a folder, which is created when it is
/// missing.
///
/// # Panics
/// The server does not create the database.
pub(crate) fn created(admin: &str, folder: &Path) -> String {
    let admin = admin.to_owned();
    let mut hasher = DefaultHasher::new();
    folder.hash(&mut hasher);
    let name = format!("tread_test_of_{:x}", hasher.finish());
    let (server, _database) = admin.rsplit_once('/').expect("it is an address");
    let address = format!("{server}/{name}");
    // Callers make configurations where they cannot wait.
    thread::spawn(move || create(&admin, &name))
        .join()
        .expect("the database is there");
    address
}

fn create(admin: &str, name: &str) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .expect("a runtime");
    runtime.block_on(async {
        let mut connection = PgConnection::connect(admin).await.expect("a connection");
        let statement = AssertSqlSafe(format!("CREATE DATABASE {name}"));
        let created = sqlx::raw_sql(statement).execute(&mut connection).await;
        let code = created.err().map(|error| {
            let code = error.as_database_error().and_then(DatabaseError::code);
            code.map(Cow::into_owned)
        });
        assert!(
            code.is_none() || code == Some(Some(EXISTS.to_owned())),
            "{code:?}"
        );
    });
}
