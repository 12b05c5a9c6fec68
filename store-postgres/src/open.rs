//! Opening of a database: the address, the server's version and encoding, and migrations.

use std::fmt;
use std::io;
use std::str::FromStr as _;
use std::sync::LazyLock;
use std::time::Duration;

use sqlx::migrate::MigrateError;
use sqlx::postgres::PgConnectOptions;
use sqlx::{Connection as _, PgConnection};
use tread_api::release::VERSION;
use uuid::Uuid;

use super::{EngineError, connections, schema};

/// Minimum version of PostgreSQL, as it numbers itself: the oldest that its developers maintain.
const VERSION_MIN: i32 = 15_00_00;
/// Maximum time that opening waits for another server that migrates the same database.
const MIGRATION_LOCK_TIMEOUT: Duration = Duration::from_mins(2);
/// Number of prepared statements that a connection keeps: more than there are.
const STATEMENTS_MAX: usize = 512;
/// Begins of an address.
const SCHEMES: [&str; 2] = ["postgres://", "postgresql://"];
/// Begin of the name of our connections in the list of the server's (`pg_stat_activity`).
const APPLICATION: &str = "tread-server";
/// Begin of the names of sessions that follow the database of another process.
const STANDBY: &str = "tread-standby";
/// Number of this process, which no other has.
static NUMBER: LazyLock<Uuid> = LazyLock::new(Uuid::new_v4);
/// Name of this process there, which all its sessions have and no others; those that only read have another.
static PROCESS: LazyLock<String> = LazyLock::new(|| format!("{APPLICATION} {}", *NUMBER));

/// Reason why the database cannot be opened. None contains the password.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The address cannot be read.
    #[error("the address of the database is not like `postgres://USER:PASSWORD@HOST:PORT/NAME`")]
    Address(#[source] sqlx::Error),
    /// The server cannot be reached.
    #[error(
        "cannot reach PostgreSQL for `{address}`: see whether it runs, listens on that address \
         (`listen_addresses`), and is not behind a firewall"
    )]
    Unreachable {
        /// The address, without a password.
        address: String,
        /// The cause.
        #[source]
        cause: sqlx::Error,
    },
    /// There is no encrypted connection as `sslmode` demands.
    #[error(
        "cannot make a TLS connection for `{address}`: see `ssl` of PostgreSQL, and `sslmode` and \
         `sslrootcert` of the address"
    )]
    Tls {
        /// The address, without a password.
        address: String,
        /// The cause.
        #[source]
        cause: sqlx::Error,
    },
    /// The server refuses the user.
    #[error(
        "PostgreSQL refuses the user of `{address}`: see user and password of the address, and \
         `pg_hba.conf` of the server"
    )]
    Authentication {
        /// The address, without a password.
        address: String,
        /// The cause.
        #[source]
        cause: sqlx::Error,
    },
    /// The database is missing.
    #[error(
        "the database of `{address}` does not exist; create it with \
         `createdb --encoding UTF8 --template template0 --owner USER NAME`"
    )]
    NoDatabase {
        /// The address, without a password.
        address: String,
        /// The cause.
        #[source]
        cause: sqlx::Error,
    },
    /// The server fails in another way.
    #[error("cannot open the database `{address}`; see the log of PostgreSQL")]
    Open {
        /// The address, without a password.
        address: String,
        /// The cause.
        #[source]
        cause: sqlx::Error,
    },
    /// The database is of a newer version.
    #[error(
        "the database `{address}` has schema {found}{by}, and tread-server {version} knows schemas \
         up to {known}: a server never goes back. Install {wanted}, or restore a backup that was \
         made before the upgrade"
    )]
    Newer {
        /// The address, without a password.
        address: String,
        /// Its schema.
        found: i64,
        /// ` of tread-server V`, or empty if the version is not known.
        by: String,
        /// The version to install, for people.
        wanted: String,
        /// The newest schema that this program knows.
        known: i64,
        /// Version of this program.
        version: &'static str,
    },
    /// A program that only reads found another schema than its own.
    #[error(
        "the database `{address}` has the schema {found}, and this version reads {known}: the server that \
         has it must be of the same version"
    )]
    OtherSchema {
        /// The address, without a password.
        address: String,
        /// Its schema; 0 for none.
        found: i64,
        /// The schema of this program.
        known: i64,
    },
    /// A migration failed.
    #[error(
        "cannot bring the database `{address}` up to date; its user needs the right to create \
         tables in it"
    )]
    Migrate {
        /// The address, without a password.
        address: String,
        /// The cause.
        #[source]
        cause: MigrateError,
    },
    /// The server is too old.
    #[error("PostgreSQL {0} is too old; 15 or newer is needed")]
    TooOld(String),
    /// The database does not store Unicode.
    #[error(
        "the database `{address}` has the encoding {found}; create it with \
         `createdb --encoding UTF8 --template template0`"
    )]
    Encoding {
        /// The address, without a password.
        address: String,
        /// Its encoding.
        found: String,
    },
}

/// A database that is ready to be used.
pub(super) struct Prepared {
    pub(super) options: PgConnectOptions,
    pub(super) address: String,
    pub(super) version: String,
}

/// The address of a database, without its password.
struct Address<'options>(&'options PgConnectOptions);

impl fmt::Display for Address<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let options = self.0;
        write!(f, "postgres://{}@", options.get_username())?;
        match options.get_socket() {
            Some(socket) => write!(f, "{}", socket.display())?,
            None => write!(f, "{}:{}", options.get_host(), options.get_port())?,
        }
        let database = options.get_database();
        write!(f, "/{}", database.unwrap_or(options.get_username()))
    }
}

/// Reads an address of a database.
///
/// # Errors
/// [`OpenError::Address`].
pub(super) fn options_of(url: &str) -> Result<(PgConnectOptions, String), OpenError> {
    if !SCHEMES.iter().any(|scheme| url.starts_with(scheme)) {
        let cause = sqlx::Error::Configuration("it begins with no `postgres://`".into());
        return Err(OpenError::Address(cause));
    }
    let options = PgConnectOptions::from_str(url).map_err(OpenError::Address)?;
    let options = options
        .application_name(&PROCESS)
        .statement_cache_capacity(STATEMENTS_MAX);
    let address = Address(&options).to_string();
    Ok((options, address))
}

/// Connects, looks at the server, applies migrations, and returns the server's version.
///
/// # Errors
/// See [`OpenError`].
pub(super) async fn prepare(
    options: &PgConnectOptions,
    address: &str,
) -> Result<String, OpenError> {
    let connecting = connections::connect(options).await;
    let mut connection = connecting.map_err(|cause| refused(address, cause))?;
    let version = update(&mut connection, address).await;
    // What it had to do is done, so an error of closing it loses nothing.
    let _ = connection.close().await;
    version
}

/// Connects, looks at the server, and refuses another schema than that of this program.
///
/// # Errors
/// See [`OpenError`].
pub(super) async fn prepare_to_read(url: &str) -> Result<Prepared, OpenError> {
    let (options, address) = options_of(url)?;
    let connecting = connections::connect(&options).await;
    let mut connection = connecting.map_err(|cause| refused(&address, cause))?;
    let looking = async {
        let version = check_server(&mut connection, &address).await?;
        Ok((version, found(&mut connection, &address).await?))
    };
    let looked = looking.await;
    // It was opened for reading, so an error of closing it loses nothing.
    let _ = connection.close().await;
    let (version, schema) = looked?;
    let (found, known) = (schema.schema.unwrap_or_default(), schema::known());
    if found != known {
        return Err(OpenError::OtherSchema {
            address,
            found,
            known,
        });
    }
    Ok(Prepared {
        options: options
            .application_name(&format!("{STANDBY} {}", *NUMBER))
            .options([("default_transaction_read_only", "on")]),
        address,
        version,
    })
}

/// Reads the schema of the database of an address, and changes nothing.
///
/// # Errors
/// See [`OpenError`].
pub async fn schema_of(url: &str) -> Result<schema::FoundSchema, OpenError> {
    let (options, address) = options_of(url)?;
    let connecting = connections::connect(&options).await;
    let mut connection = connecting.map_err(|cause| refused(&address, cause))?;
    let found = found(&mut connection, &address).await;
    // It was opened for reading, so an error of closing it loses nothing.
    let _ = connection.close().await;
    found
}

async fn found(
    connection: &mut PgConnection,
    address: &str,
) -> Result<schema::FoundSchema, OpenError> {
    let found = schema::of_connection(connection).await;
    found.map_err(|error| OpenError::Open {
        address: address.to_owned(),
        cause: match error {
            EngineError::Postgres(cause) => cause,
            EngineError::Corrupt { .. } | EngineError::DoesNotFit(_) => {
                sqlx::Error::Decode(error.into())
            }
        },
    })
}

/// Returns why a connection cannot be opened.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "whatever else there is or will be is shown with its cause"
)]
pub(super) fn refused(address: &str, cause: sqlx::Error) -> OpenError {
    let address = address.to_owned();
    match &cause {
        sqlx::Error::Tls(_) => OpenError::Tls { address, cause },
        // A server without TLS, or a certificate that is not trusted.
        sqlx::Error::Io(error) if error.kind() == io::ErrorKind::InvalidData => {
            OpenError::Tls { address, cause }
        }
        sqlx::Error::Io(_) => OpenError::Unreachable { address, cause },
        sqlx::Error::Database(error) => match error.code().as_deref() {
            Some("28P01" | "28000" | "42501") => OpenError::Authentication { address, cause },
            Some("3D000") => OpenError::NoDatabase { address, cause },
            _ => OpenError::Open { address, cause },
        },
        _ => OpenError::Open { address, cause },
    }
}

/// Looks at the server. Returns its version.
///
/// # Errors
/// It is too old, or the database has another encoding.
async fn check_server(connection: &mut PgConnection, address: &str) -> Result<String, OpenError> {
    let (number, version, encoding): (i32, String, String) = sqlx::query_as(
        "SELECT CAST(current_setting('server_version_num') AS INTEGER),
             current_setting('server_version'), current_setting('server_encoding')",
    )
    .fetch_one(&mut *connection)
    .await
    .map_err(|cause| OpenError::Open {
        address: address.to_owned(),
        cause,
    })?;
    if number < VERSION_MIN {
        return Err(OpenError::TooOld(version));
    }
    if encoding != "UTF8" {
        return Err(OpenError::Encoding {
            address: address.to_owned(),
            found: encoding,
        });
    }
    Ok(version)
}

/// Looks at the server and brings the schema up to date. Returns the server's version.
async fn update(connection: &mut PgConnection, address: &str) -> Result<String, OpenError> {
    let failed = |cause| OpenError::Open {
        address: address.to_owned(),
        cause,
    };
    let version = check_server(connection, address).await?;
    refuse_newer(address, &found(&mut *connection, address).await?)?;
    let waiting = sqlx::AssertSqlSafe(format!(
        "SET lock_timeout = {}",
        MIGRATION_LOCK_TIMEOUT.as_millis()
    ));
    sqlx::raw_sql(waiting)
        .execute(&mut *connection)
        .await
        .map_err(failed)?;
    let migrated = schema::migrator().run(connection).await;
    migrated.map_err(|cause| OpenError::Migrate {
        address: address.to_owned(),
        cause,
    })?;
    Ok(version)
}

/// Refuses a database that a newer version has written.
///
/// # Errors
/// [`OpenError::Newer`].
pub fn refuse_newer(address: &str, found: &schema::FoundSchema) -> Result<(), OpenError> {
    let known = schema::known();
    let Some(newer) = found.schema.filter(|schema| *schema > known) else {
        return Ok(());
    };
    let by = found.version.as_ref();
    let wanted = by.map_or_else(
        || "the version that wrote it, or a newer one".to_owned(),
        |version| format!("version {version} or newer"),
    );
    Err(OpenError::Newer {
        address: address.to_owned(),
        found: newer,
        by: by.map_or_else(String::new, |version| format!(" of tread-server {version}")),
        wanted,
        known,
        version: VERSION,
    })
}
