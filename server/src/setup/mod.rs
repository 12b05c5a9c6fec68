//! `tread-server init` is the first command on a machine. It writes a working configuration, from
//! answers in a terminal or from flags.
//!
//! [`choices`] turns flags, answers and defaults into [`Choices`]; [`text`] writes them as TOML.
//! `init` moves the file into its place last, after everything else has succeeded, so that a person
//! can repeat a failed run.

mod choices;
mod questions;
mod service;
mod steps;
mod text;

use std::fs::{self, DirBuilder, OpenOptions};
use std::io::{self, IsTerminal as _, Write as _};
use std::net::SocketAddr;
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, lchown};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use clap::{Args, ValueEnum};
use nix::unistd::Uid;
use tread_api::ids::SiteId;

pub(crate) use self::choices::Choices;
use self::questions::Questions;
pub(crate) use self::service::{check_service, start_service};
pub(crate) use self::steps::next_steps;
use crate::config::{Config, ServerArgs};
use crate::file_owner;
use crate::paths::folder_of;

/// Mode of the configuration file. It holds no secret: the group of the data folder may read it,
/// and others need not.
const CONFIG_MODE: u32 = 0o640;
/// Mode of a data folder that is created.
const DATA_MODE: u32 = 0o700;
/// Suffix of the name of a replaced configuration file.
const REPLACED_ENDING: &str = "old";

/// The way to reach the REST API.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TlsChoice {
    /// By TLS with a certificate that the fleet's own authority issues and renews
    Authority,
    /// By TLS with certificate and key from files
    Files,
    /// By a proxy on this machine that terminates TLS
    Proxy,
    /// From this machine alone, without TLS
    Loopback,
}

/// Arguments for writing a configuration.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Writing a configuration")]
pub(crate) struct SetupArgs {
    /// Write a configuration without asking questions, with defaults for all absent flags
    #[arg(long)]
    pub(crate) yes: bool,
    /// Then enable and start the service `tread-server` of the package
    #[arg(long)]
    pub(crate) start: bool,
    /// Folder of the database and the fleet's authority, created when missing
    #[arg(long, value_name = "DIR")]
    pub(crate) data_dir: Option<PathBuf>,
    /// Site that the server creates at its first start
    #[arg(long)]
    pub(crate) site: Option<SiteId>,
    /// Host names and addresses by which others reach this server, separated by commas
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub(crate) names: Vec<String>,
    /// Way to reach the REST API
    #[arg(long, value_enum)]
    pub(crate) tls: Option<TlsChoice>,
    /// Certificate of the REST API, PEM, followed by its intermediate certificates
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub(crate) tls_certificate: Option<PathBuf>,
    /// Private key of that certificate, PEM
    #[arg(long, value_name = "FILE", requires = "tls_certificate")]
    pub(crate) tls_key: Option<PathBuf>,
    /// Address of the REST API
    #[arg(long, value_name = "ADDRESS")]
    pub(crate) http: Option<SocketAddr>,
    /// Address that robots connect to
    #[arg(long, value_name = "ADDRESS")]
    pub(crate) zenoh: Option<SocketAddr>,
}

impl SetupArgs {
    /// Returns whether any flag asks for a configuration.
    fn is_given(&self) -> bool {
        let Self {
            yes,
            start,
            data_dir,
            site,
            names,
            tls,
            tls_certificate,
            tls_key,
            http,
            zenoh,
        } = self;
        *yes || *start
            || !names.is_empty()
            || tls.is_some()
            || data_dir.is_some()
            || site.is_some()
            || http.is_some()
            || zenoh.is_some()
            || tls_certificate.is_some()
            || tls_key.is_some()
    }
}

/// Arguments of `init` besides [`SetupArgs`].
#[derive(Debug)]
pub(crate) struct InitOptions<'a> {
    /// The configuration file.
    pub(crate) config: Option<&'a Path>,
    /// The database file.
    pub(crate) database: Option<&'a Path>,
    /// The file for the admin's token.
    pub(crate) token_file: Option<&'a Path>,
    /// Whether to replace existing files.
    pub(crate) force: bool,
}

/// A configuration that is ready to be moved into its place.
#[derive(Debug)]
pub(crate) struct Prepared {
    /// The choices.
    pub(crate) choices: Choices,
    /// The configuration as the server reads it.
    pub(crate) config: Config,
    /// The complete file, under a temporary name.
    new: PathBuf,
}

/// Returns the default of `--config`.
pub(crate) fn config_default(is_root: bool) -> PathBuf {
    PathBuf::from(if is_root {
        "/etc/tread/tread.toml"
    } else {
        "tread.toml"
    })
}

/// Prepares a configuration; returns `None` if `init` should use the existing one or the built-in
/// values.
///
/// # Errors
/// A choice is impossible, the file exists and `--force` is not given, nobody answers, or a folder
/// cannot be written.
pub(crate) fn prepare(
    args: &SetupArgs,
    given: &InitOptions<'_>,
) -> anyhow::Result<Option<Prepared>> {
    let is_root = Uid::effective().is_root();
    let has_terminal = io::stdin().is_terminal() && io::stderr().is_terminal();
    let file = given
        .config
        .map_or_else(|| config_default(is_root), Path::to_owned);
    let exists = file.exists();
    let is_first = given.database.is_none() && !exists && has_terminal;
    if !args.is_given() && !is_first {
        if given.config.is_some() && !exists {
            bail!(
                "there is no configuration file `{}`: give --yes, and it is written with defaults, \
                 or flags such as --names and --tls, or run this in a terminal to be asked",
                file.display()
            );
        }
        if given.config.is_none() && given.database.is_none() && exists {
            bail!(
                "there is a configuration file `{}` already: name it with --config to make an \
                 admin's token for it",
                file.display()
            );
        }
        return Ok(None);
    }
    ensure!(
        given.database.is_none(),
        "--database names a file; a configuration that is written here takes --data-dir, the \
         folder of the database"
    );
    refuse_to_replace("configuration file", &file, given.force)?;
    let defaults = choices::Defaults {
        config: file,
        token_file: given.token_file.map(Path::to_owned),
        is_root,
        host_name: host_name(),
    };
    let choices = if args.yes || !has_terminal {
        Choices::of(args, &defaults)?
    } else {
        let (mut input, mut output) = (io::stdin().lock(), io::stderr().lock());
        let mut questions = Questions::new(&mut input, &mut output);
        questions::ask(args, &defaults, &mut questions)?
    };
    refuse_to_replace("configuration file", &choices.config, given.force)?;
    refuse_to_replace("token file", &choices.token_file, given.force)?;
    if args.start {
        check_service(&choices)?;
    }
    write_beside(choices).map(Some)
}

/// Refuses to replace a file without `--force`.
///
/// # Errors
/// The file exists, and `force` is false.
pub(crate) fn refuse_to_replace(what: &str, file: &Path, force: bool) -> anyhow::Result<()> {
    // A link without a target counts too: a write would create its target.
    let exists = fs::symlink_metadata(file).is_ok();
    ensure!(
        !exists || force,
        "the {what} `{}` exists and is not replaced: name another one, or give --force",
        file.display()
    );
    Ok(())
}

fn host_name() -> Option<String> {
    let name = fs::read_to_string("/proc/sys/kernel/hostname").ok()?;
    let name = name.trim();
    (!name.is_empty() && name != "localhost").then(|| name.to_owned())
}

/// Writes the configuration under a temporary name in its folder, and reads it as the server does.
fn write_beside(choices: Choices) -> anyhow::Result<Prepared> {
    make_folder(folder_of(&choices.config), 0o755)?;
    make_folder(&choices.data_dir, DATA_MODE)?;
    let new = beside(&choices.config, &format!("{}.new", std::process::id()));
    let written = || -> anyhow::Result<Config> {
        let mut options = OpenOptions::new();
        options.write(true).create_new(true).mode(CONFIG_MODE);
        let mut handle = options
            .open(&new)
            .with_context(|| format!("cannot write in `{}`", folder_of(&new).display()))?;
        handle
            .write_all(text::toml(&choices).as_bytes())
            .and_then(|()| handle.sync_all())
            .with_context(|| format!("cannot write `{}`", new.display()))?;
        Ok(Config::load(&ServerArgs {
            config: Some(new.clone()),
            ..ServerArgs::default()
        })?)
    };
    match written() {
        Ok(config) => Ok(Prepared {
            choices,
            config,
            new,
        }),
        Err(error) => {
            // The error of the write matters more; the removal fails if the file was never made.
            let _ = fs::remove_file(&new);
            Err(error)
        }
    }
}

impl Prepared {
    /// Moves the configuration into its place, and gives root's files in the data folder to the
    /// folder's owner.
    ///
    /// # Errors
    /// A file cannot be written.
    pub(crate) fn finish(&self) -> anyhow::Result<()> {
        let file = &self.choices.config;
        if file.exists() {
            let old = beside(file, REPLACED_ENDING);
            fs::rename(file, &old).with_context(|| {
                format!("cannot keep `{}` as `{}`", file.display(), old.display())
            })?;
            eprintln!("the former configuration is kept as `{}`", old.display());
        }
        self.chown_to_service()?;
        fs::rename(&self.new, file).with_context(|| format!("cannot write `{}`", file.display()))
    }

    /// Makes the owner of the data folder, such as the service's user, the owner of root's files in
    /// it.
    fn chown_to_service(&self) -> anyhow::Result<()> {
        let data_dir = &self.choices.data_dir;
        let Some(owner) = file_owner::service_owner(data_dir)? else {
            return Ok(());
        };
        lchown(&self.new, None, Some(owner.gid))
            .with_context(|| format!("cannot give `{}` to its group", self.new.display()))?;
        file_owner::chown_recursively(data_dir, owner)
    }

    /// Removes the temporary file after a failure.
    pub(crate) fn discard(&self) {
        // The caller reports the failure; a file that remains has a unique name.
        let _ = fs::remove_file(&self.new);
    }
}

fn beside(file: &Path, ending: &str) -> PathBuf {
    let mut name = file.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{ending}"));
    file.with_file_name(name)
}

fn make_folder(folder: &Path, mode: u32) -> anyhow::Result<()> {
    let mut builder = DirBuilder::new();
    let created = builder.recursive(true).mode(mode).create(folder);
    created.with_context(|| {
        format!(
            "cannot make the folder `{}`: run this as root, or name another one",
            folder.display()
        )
    })
}

#[cfg(test)]
mod tests;
