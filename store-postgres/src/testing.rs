//! Databases for tests, on the server that `TREAD_TEST_POSTGRES` names
//! (`store-postgres/with-postgres cargo test -p tread-store-postgres`).

use std::env;
use std::str::FromStr as _;

use sqlx::postgres::PgConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions as _, Connection as _, PgConnection};
use uuid::Uuid;

use crate::{Db, schema};

/// Variable with the address of a server on which tests may create databases.
const VARIABLE: &str = "TREAD_TEST_POSTGRES";
/// Lock that is held while the template is made.
const TEMPLATE_LOCK: i64 = 1;

/// Address of the server.
pub(crate) struct AdminUrl(pub(crate) String);

impl AdminUrl {
    /// Returns the address of a database of the server.
    pub(crate) fn of(&self, database: &str) -> String {
        let (server, _database) = self.0.rsplit_once('/').unwrap();
        format!("{server}/{database}")
    }
}

/// A database of one test.
pub(crate) struct TestDatabase {
    /// Address of its server.
    pub(crate) admin: AdminUrl,
    name: String,
    /// Its address.
    pub(crate) url: String,
}

async fn connect(url: &str) -> PgConnection {
    let options = PgConnectOptions::from_str(url).unwrap();
    options.connect().await.unwrap()
}

async fn run(db: &mut PgConnection, statement: String) {
    let done = sqlx::raw_sql(AssertSqlSafe(statement)).execute(db).await;
    done.unwrap();
}

/// Returns the address of the server; `None`, which it reports, if no server was named.
pub(crate) fn admin_url(test: &str) -> Option<AdminUrl> {
    let admin = env::var(VARIABLE).ok();
    if admin.is_none() {
        eprintln!("`{test}` was NOT RUN: {VARIABLE} names no PostgreSQL server");
    }
    admin.map(AdminUrl)
}

/// Runs a test with a database that has the present schema, and drops the database. Without a server it
/// reports that the test was not run.
pub(crate) async fn with_database(test: &str, body: impl AsyncFnOnce(&TestDatabase)) {
    let Some(admin) = admin_url(test) else { return };
    let template = template(&admin).await;
    let name = format!("tread_test_{}", Uuid::new_v4().simple());
    let mut server = connect(&admin.0).await;
    run(
        &mut server,
        format!("CREATE DATABASE {name} TEMPLATE {template}"),
    )
    .await;
    let database = TestDatabase {
        url: admin.of(&name),
        admin,
        name,
    };
    body(&database).await;
    database.drop().await;
}

impl TestDatabase {
    /// Opens it with the engine.
    pub(crate) async fn open(&self) -> Db {
        Db::open(&self.url).await.unwrap()
    }

    /// Connects to it without the engine.
    pub(crate) async fn connect(&self) -> PgConnection {
        connect(&self.url).await
    }

    /// Runs statements on it.
    pub(crate) async fn run(&self, statements: &str) {
        let mut connection = self.connect().await;
        run(&mut connection, statements.to_owned()).await;
        connection.close().await.unwrap();
    }

    async fn drop(self) {
        let mut server = connect(&self.admin.0).await;
        let name = &self.name;
        run(&mut server, format!("DROP DATABASE {name} WITH (FORCE)")).await;
    }
}

/// Returns the name of a database with the present schema, which the first test makes.
async fn template(admin: &AdminUrl) -> String {
    let checksums = schema::migrator()
        .iter()
        .flat_map(|one| one.checksum.iter());
    let hash = checksums.fold(0_u64, |hash, byte| {
        hash.wrapping_mul(31).wrapping_add(u64::from(*byte))
    });
    let name = format!("tread_template_{hash:x}");
    let mut server = connect(&admin.0).await;
    run(
        &mut server,
        format!("SELECT pg_advisory_lock({TEMPLATE_LOCK})"),
    )
    .await;
    let found: Option<(i32,)> = sqlx::query_as("SELECT 1 FROM pg_database WHERE datname = $1")
        .bind(&name)
        .fetch_optional(&mut server)
        .await
        .unwrap();
    if found.is_none() {
        let unfinished = format!("{name}_unfinished");
        let statement = format!("DROP DATABASE IF EXISTS {unfinished} WITH (FORCE)");
        run(&mut server, statement).await;
        run(&mut server, format!("CREATE DATABASE {unfinished}")).await;
        let db = Db::open(&admin.of(&unfinished)).await.unwrap();
        db.close().await;
        let statement = format!("ALTER DATABASE {unfinished} RENAME TO {name}");
        run(&mut server, statement).await;
    }
    server.close().await.unwrap();
    name
}
