//! Administrative commands that work on the server's database directly, while the server runs or
//! not.
//!
//! * `tread-server init` creates the first admin's token, and the fleet's certificate authority if
//!   `[robots]` is configured. The token is printed once, or written to a file that only its owner
//!   can read. Where there is no configuration yet, it writes one first ([`crate::setup`]).
//! * `tread-server forget-certificates` lets each robot renew with the next certificate that it
//!   presents, as needed after the database was restored from a backup.

use std::io::{self, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use tread_api::identity::TOKEN_DAYS_MAX;

use crate::app::identity::tokens::FirstAdmin;
use crate::app::{App, AppError};
use crate::authority::{Authority, AuthorityError, NEXT_CERTIFICATE_FILE};
use crate::clock::Clock;
use crate::config::{Config, ServerArgs};
use crate::db::{self, Db, DbError};
use crate::setup::{self, InitOptions, SetupArgs};

/// Arguments of `tread-server init`.
#[derive(Debug, Clone, Args)]
pub(crate) struct InitArgs {
    /// Configuration file of the server, TOML. If it does not exist, it is created: with --yes or
    /// other flags below, or from answers in a terminal
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Database file, created when missing
    #[arg(long, value_name = "FILE")]
    database: Option<PathBuf>,
    /// Name of the token
    #[arg(long, default_value = "admin")]
    name: String,
    /// Days until the token expires
    #[arg(long, value_name = "DAYS", default_value_t = 365,
        value_parser = clap::value_parser!(u32).range(1..=i64::from(TOKEN_DAYS_MAX)))]
    valid_days: u32,
    /// Write the token to this file, readable by its owner only, instead of printing it
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Create a token even if an admin exists, and revoke a valid token of the same name; replace
    /// existing files
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    setup: SetupArgs,
}

/// Arguments of `tread-server forget-certificates`.
#[derive(Debug, Clone, Args)]
pub(crate) struct ForgetArgs {
    /// Configuration file of the server, TOML
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Database file
    #[arg(long, value_name = "FILE")]
    database: Option<PathBuf>,
}

/// Deletes the list of certificates issued to each robot. A database restored from a backup lacks
/// the certificates that were issued since, and would refuse their renewal.
///
/// # Errors
/// The configuration is invalid, or the database cannot be written.
pub(crate) async fn delete_certificate_records(args: ForgetArgs) -> anyhow::Result<()> {
    let config = Config::load(&ServerArgs {
        config: args.config,
        database: args.database,
        ..ServerArgs::default()
    })?;
    let database = Db::open(&config.database).await?;
    let forgetting = async {
        let mut tx = database.write("init").await?;
        let count = db::enrolments::delete_issued_certificates(&mut tx).await?;
        tx.commit().await?;
        Ok::<_, DbError>(count)
    };
    let forgotten = forgetting.await;
    database.close().await;
    let count = forgotten.context("cannot write the database")?;
    eprintln!("{count} robots: the next certificate that each presents for renewal is accepted");
    Ok(())
}

/// Writes a configuration if there is none yet, creates the first admin's token, and prints it or
/// writes it to the file.
///
/// # Errors
/// An admin exists and `--force` is not given, or the database or a file cannot be written.
pub(crate) async fn run(args: InitArgs) -> anyhow::Result<()> {
    let given = InitOptions {
        config: args.config.as_deref(),
        database: args.database.as_deref(),
        token_file: args.token_file.as_deref(),
        force: args.force,
    };
    let first = FirstAdmin {
        name: args.name.clone(),
        valid_days: args.valid_days,
        force: args.force,
    };
    let Some(prepared) = setup::prepare(&args.setup, &given)? else {
        if let Some(file) = &args.token_file {
            setup::refuse_to_replace("token file", file, args.force)?;
        }
        let config = Config::load(&ServerArgs {
            config: args.config,
            database: args.database,
            ..ServerArgs::default()
        })?;
        return make(&config, first, args.token_file.as_deref()).await;
    };
    let token_file = Some(prepared.choices.token_file.as_path());
    let made = make(&prepared.config, first, token_file).await;
    let made = made.and_then(|()| prepared.finish());
    if let Err(error) = made {
        prepared.discard();
        return Err(error);
    }
    let authority = match &prepared.config.robots {
        Some(robots) => Some(Authority::load(&robots.authority)?),
        None => None,
    };
    let fingerprint = authority.as_ref().map(Authority::fingerprint);
    let is_started = args.setup.start;
    if is_started {
        setup::start_service()?;
    }
    let text = setup::next_steps(&prepared.choices, fingerprint, is_started);
    write!(io::stdout().lock(), "{text}").context("cannot print")
}

/// Creates the fleet's authority, if one is configured, and the first admin's token.
async fn make(config: &Config, first: FirstAdmin, token_file: Option<&Path>) -> anyhow::Result<()> {
    let clock = Clock::system();
    let made_authority = match &config.robots {
        Some(robots) => make_authority(&robots.authority, &clock)?,
        None => false,
    };
    let db = Db::open(&config.database).await?;
    let app = App::without_robots(db, clock, config.friction, config.storage);
    let created = app.create_first_admin(first).await;
    app.db().close().await;
    if let (true, Err(AppError::AlreadyExists { .. })) = (made_authority, &created) {
        eprintln!("an admin exists already, so no token was created");
        return Ok(());
    }
    let created =
        created.context("cannot create the first admin's token (--force creates another one)")?;
    match token_file {
        Some(file) => write_secret(file, &created.secret)
            .with_context(|| format!("cannot write {}", file.display()))?,
        None => writeln!(io::stdout().lock(), "{}", created.secret).context("cannot print")?,
    }
    let (name, expires_at) = (&created.token.name, created.token.expires_at);
    eprintln!("admin's token `{name}`, valid until {expires_at}; it is shown only once");
    Ok(())
}

/// Creates the fleet's certificate authority unless one exists, which robots trust. Returns whether
/// it was created.
///
/// # Errors
/// The folder cannot be written, or the existing authority cannot be used.
fn make_authority(folder: &Path, clock: &Clock) -> anyhow::Result<bool> {
    match Authority::create(folder, clock.now()) {
        Ok(_made) => {
            let folder = folder.display();
            eprintln!("fleet's authority in {folder}; whoever has its key can pose as any robot");
            Ok(true)
        }
        Err(AuthorityError::Exists(_)) => {
            // During a rotation a running server may be changing the files, so they are not
            // checked.
            if !folder.join(NEXT_CERTIFICATE_FILE).exists() {
                Authority::load(folder)?;
            }
            Ok(false)
        }
        Err(failed) => Err(failed.into()),
    }
}

/// Writes a file atomically, readable by its owner only.
fn write_secret(file: &Path, secret: &str) -> io::Result<()> {
    let mut name = file.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.new", std::process::id()));
    let new = file.with_file_name(name);
    let written = || {
        let mut options = std::fs::OpenOptions::new();
        options.write(true).create_new(true).mode(0o600);
        let mut handle = options.open(&new)?;
        handle.write_all(secret.as_bytes())?;
        handle.write_all(b"\n")?;
        handle.sync_all()?;
        std::fs::rename(&new, file)
    };
    written().inspect_err(|_| {
        // Remove the incomplete file; the error of the write is returned.
        let _ = std::fs::remove_file(&new);
    })
}
