//! The choices in a configuration, from flags, answers and defaults.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use anyhow::{bail, ensure};
use tread_api::ids::SiteId;

use super::{SetupArgs, TlsChoice};
use crate::authority::is_port_name;
use crate::certificate::{Certificate, Condition, is_for};
use crate::clock::Clock;
use crate::config::{HTTP_DEFAULT, SITE_DEFAULT, TlsFiles, ZENOH_DEFAULT};
use crate::http::tls::{Tls, read_files};

/// Data folder of root, which the Debian package gives to the user `tread`. Agents use
/// `/var/lib/tread-agent`.
const DATA_OF_ROOT: &str = "/var/lib/tread";
/// Data folder of anybody else, beside the configuration file.
const DATA_OF_OTHERS: &str = "tread-data";
/// Name of the file of the admin's token, beside the configuration file.
const TOKEN_FILE: &str = "admin.token";

/// How the REST API gets its certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum CertificateSource {
    /// From the fleet's own authority.
    Authority,
    /// From files.
    Files(TlsFiles),
    /// A proxy on this machine has one.
    Proxy,
    /// It has none, and only this machine reaches it.
    Loopback,
}

/// Complete, checked choices.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Choices {
    /// Configuration file.
    pub(crate) config: PathBuf,
    /// Folder of database and authority.
    pub(crate) data_dir: PathBuf,
    /// File of the admin's token.
    pub(crate) token_file: PathBuf,
    /// Site that the server creates.
    pub(crate) site: SiteId,
    /// Host names and addresses of the server, the first for links.
    pub(crate) names: Vec<String>,
    /// Address of the REST API.
    pub(crate) http: SocketAddr,
    /// Address of the robots' port.
    pub(crate) zenoh: SocketAddr,
    /// Certificate of the REST API.
    pub(crate) web: CertificateSource,
}

/// Values for choices that neither a flag nor an answer gives.
#[derive(Debug, Clone)]
pub(super) struct Defaults {
    pub(super) config: PathBuf,
    pub(super) token_file: Option<PathBuf>,
    pub(super) is_root: bool,
    pub(super) host_name: Option<String>,
}

impl Defaults {
    pub(super) fn data_dir(&self, config: &Path) -> PathBuf {
        if self.is_root {
            return DATA_OF_ROOT.into();
        }
        config.with_file_name(DATA_OF_OTHERS)
    }

    pub(super) fn token_file(&self, config: &Path) -> PathBuf {
        let given = self.token_file.clone();
        given.unwrap_or_else(|| config.with_file_name(TOKEN_FILE))
    }
}

impl TlsChoice {
    /// Returns the default address of the REST API, and of the robots' port.
    pub(super) fn addresses(self) -> [SocketAddr; 2] {
        let [http, zenoh]: [SocketAddr; 2] =
            [HTTP_DEFAULT, ZENOH_DEFAULT].map(|text| text.parse().expect("built-in values parse"));
        let outside = |here: SocketAddr| SocketAddr::new(IpAddr::from([0, 0, 0, 0]), here.port());
        match self {
            Self::Authority | Self::Files => [outside(http), outside(zenoh)],
            // The proxy is on this machine, and robots do not connect through it.
            Self::Proxy => [http, outside(zenoh)],
            Self::Loopback => [http, zenoh],
        }
    }
}

impl Choices {
    /// Returns the choices that flags and defaults give.
    ///
    /// # Errors
    /// A choice is impossible; the message names the flag.
    pub(super) fn of(args: &SetupArgs, defaults: &Defaults) -> anyhow::Result<Self> {
        let tls = args.tls.unwrap_or_else(|| tls_default(args));
        let [http, zenoh] = tls.addresses();
        let config = defaults.config.clone();
        let data_dir = args.data_dir.clone();
        let choices = Self {
            data_dir: data_dir.unwrap_or_else(|| defaults.data_dir(&config)),
            token_file: defaults.token_file(&config),
            site: args
                .site
                .clone()
                .unwrap_or_else(|| SITE_DEFAULT.parse().expect("the built-in value parses")),
            names: args.names.clone(),
            http: args.http.unwrap_or(http),
            zenoh: args.zenoh.unwrap_or(zenoh),
            web: web(tls, files(args))?,
            config,
        };
        choices.check()?;
        Ok(choices)
    }

    /// Returns whether robots join by certificates of the fleet's authority.
    pub(crate) fn has_authority(&self) -> bool {
        self.web != CertificateSource::Loopback || !self.zenoh.ip().is_loopback()
    }

    /// Returns the folder of the fleet's authority.
    pub(crate) fn authority(&self) -> PathBuf {
        self.data_dir.join("authority")
    }

    /// Checks that the values are valid and fit together.
    ///
    /// # Errors
    /// A value is invalid, or two values contradict each other; the message names them.
    pub(super) fn check(&self) -> anyhow::Result<()> {
        for name in &self.names {
            check_name(name).map_err(anyhow::Error::msg)?;
        }
        if self.web != CertificateSource::Loopback && self.names.is_empty() {
            bail!(
                "other machines need a name or an address of this server: give --names, such as \
                 --names tread.example.org,192.0.2.1"
            );
        }
        let is_tls = matches!(
            self.web,
            CertificateSource::Authority | CertificateSource::Files(_)
        );
        ensure!(
            is_tls || self.http.ip().is_loopback(),
            "--http {} would be reached by other machines without TLS: take an address of this \
             machine such as {HTTP_DEFAULT}, or --tls authority or files",
            self.http
        );
        ensure!(
            self.http.port() == 0 || self.http.port() != self.zenoh.port(),
            "--http and --zenoh both have port {}: give each its own",
            self.http.port()
        );
        for path in [&self.config, &self.data_dir, &self.token_file] {
            ensure!(
                path.to_str().is_some(),
                "the path `{}` is not valid UTF-8, which a configuration file must be",
                path.display()
            );
        }
        if let CertificateSource::Files(files) = &self.web {
            check_files(files, &self.names)?;
        }
        Ok(())
    }
}

/// Returns the way to reach the REST API if no flag gives it.
pub(super) fn tls_default(args: &SetupArgs) -> TlsChoice {
    if args.tls_certificate.is_some() {
        TlsChoice::Files
    } else if args.names.is_empty() {
        TlsChoice::Loopback
    } else {
        TlsChoice::Authority
    }
}

/// Returns the certificate files, if flags name them.
pub(super) fn files(args: &SetupArgs) -> Option<TlsFiles> {
    Some(TlsFiles {
        certificate: args.tls_certificate.clone()?,
        key: args.tls_key.clone()?,
    })
}

/// Returns the certificate of the REST API.
///
/// # Errors
/// The choice needs files that no flag names, or flags name files that the choice does not use.
pub(super) fn web(tls: TlsChoice, files: Option<TlsFiles>) -> anyhow::Result<CertificateSource> {
    Ok(match (tls, files) {
        (TlsChoice::Files, Some(files)) => CertificateSource::Files(files),
        (TlsChoice::Files, None) => {
            bail!("--tls files needs --tls-certificate and --tls-key")
        }
        (TlsChoice::Authority, None) => CertificateSource::Authority,
        (TlsChoice::Proxy, None) => CertificateSource::Proxy,
        (TlsChoice::Loopback, None) => CertificateSource::Loopback,
        (_, Some(_)) => bail!("--tls-certificate and --tls-key are for --tls files alone"),
    })
}

/// Checks a host name or an address.
pub(super) fn check_name(name: &str) -> Result<(), String> {
    if is_port_name(name) {
        return Ok(());
    }
    Err(format!(
        "`{name}` is neither a host name nor an address: write one such as tread.example.org or \
         192.0.2.1, without scheme and port"
    ))
}

/// Checks that certificate and key belong together, and that the certificate is for these names
/// and valid now.
///
/// # Errors
/// The message names the file.
pub(super) fn check_files(files: &TlsFiles, names: &[String]) -> anyhow::Result<()> {
    Tls::load(files.clone())?;
    let (chain, _key) = read_files(files)?;
    let file = files.certificate.display();
    let Some((leaf, certificate)) = chain
        .first()
        .and_then(|leaf| Some((leaf, Certificate::read(leaf)?)))
    else {
        bail!("the certificate in `{file}` does not read");
    };
    if let Some(name) = names.iter().find(|name| !is_for(leaf, name)) {
        bail!(
            "the certificate in `{file}` is for {}, and not for `{name}`: give names of the \
             certificate, or another certificate",
            certificate.names.join(", ")
        );
    }
    let now = Clock::system().machine_time();
    match certificate.condition(now) {
        Condition::Valid | Condition::Expiring => Ok(()),
        Condition::Expired => bail!(
            "the certificate in `{file}` expired at {}: get another one",
            certificate.not_after
        ),
        Condition::NotYetValid => bail!(
            "the certificate in `{file}` is valid from {} only, and this machine's clock says \
             {now}: set the clock",
            certificate.not_before
        ),
    }
}
