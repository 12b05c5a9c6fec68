//! Configuration: built-in values, then a TOML file, then flags; the later one counts.
//!
//! An unknown key, an impossible value or an address beyond this machine stops the start, with a
//! sentence that names file, line and key.

pub mod oidc;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde::Deserialize;
use tread_api::ids::{ConfigurationId, SiteId};

use self::oidc::{OidcConfig, OidcConfigError};
use crate::authority::is_port_name;
use crate::friction::index::Normalisation;
pub use crate::friction::weights::FrictionConfig;
use crate::identity::address::Network;
use crate::identity::origin::{Names, Origin};

/// Address of the REST API when nothing else is said.
pub const HTTP_DEFAULT: &str = "127.0.0.1:8420";
/// Address of the zenoh router when nothing else is said.
pub const ZENOH_DEFAULT: &str = "127.0.0.1:7447";
/// The database file when nothing else is said.
pub const DATABASE_DEFAULT: &str = "tread.db";
/// The site that exists from the start when nothing else is said.
pub const SITE_DEFAULT: &str = "yard";

/// Flags of the server; each wins over the configuration file.
#[derive(Debug, Clone, Default, Args)]
pub struct ServerArgs {
    /// Configuration file, TOML
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Address of the REST API; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS")]
    pub http: Option<SocketAddr>,
    /// Address of `/metrics` for Prometheus; none when absent
    #[arg(long, value_name = "ADDRESS")]
    pub metrics: Option<SocketAddr>,
    /// Address of the zenoh router that robots connect to; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS")]
    pub zenoh: Option<SocketAddr>,
    /// Database file, created when missing
    #[arg(long, value_name = "FILE")]
    pub database: Option<PathBuf>,
    /// Site that is created when missing
    #[arg(long)]
    pub site: Option<SiteId>,
    /// What is logged, such as `info` or `tread_server=debug`; `RUST_LOG` when absent
    #[arg(long, value_name = "FILTER")]
    pub log: Option<String>,
    /// How it is logged
    #[arg(long, value_enum, default_value_t)]
    pub log_format: LogFormat,
}

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum LogFormat {
    /// For people
    #[default]
    Human,
    /// One JSON object per line
    Json,
}

/// Everything that the server needs to know to start.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Address of the REST API, on this machine.
    pub http: SocketAddr,
    /// Address of `/metrics`, on this machine, if there is to be one.
    pub metrics: Option<SocketAddr>,
    /// Address that robots connect to; on this machine, unless they show certificates.
    pub zenoh: SocketAddr,
    /// The database file.
    pub database: PathBuf,
    /// The site that exists from the start.
    pub site: SiteId,
    /// How measurements of several robots and times are weighed.
    pub friction: FrictionConfig,
    /// How the θ of robot models is brought to that of others, where an answer asks for it.
    pub normalisations: Vec<Normalisation>,
    /// How long raw measurements are kept.
    pub retention: RetentionConfig,
    /// What is expected of the storage.
    pub storage: StorageConfig,
    /// The REST API's certificate; without one it listens on this machine alone.
    pub tls: Option<TlsFiles>,
    /// What browsers may do.
    pub web: WebConfig,
    /// What becomes of the audit log besides the database.
    pub audit: AuditConfig,
    /// How robots join and show who they are; without it they connect in the clear, on this
    /// machine alone.
    pub robots: Option<RobotsConfig>,
    /// How people sign in at an OpenID provider; without it with tokens alone.
    pub oidc: Option<OidcConfig>,
}

/// How robots join and show who they are.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotsConfig {
    /// The folder of the fleet's authority, which `tread-server init` makes.
    pub authority: PathBuf,
    /// Names and addresses that robots know this server by, besides `localhost`.
    #[serde(default)]
    pub names: Vec<String>,
    /// How long a robot's certificate is good for, seconds, within [`CERTIFICATE_S_RANGE`]. A
    /// robot renews it when two thirds are over.
    #[serde(default = "certificate_s")]
    pub certificate_s: u32,
}

/// How long a robot's certificate may be good for, seconds: it must outlive an outage or two, and
/// what was stolen must end some day.
pub const CERTIFICATE_S_RANGE: std::ops::RangeInclusive<u32> = 5..=30 * 24 * 3_600;

const fn certificate_s() -> u32 {
    24 * 3_600
}

/// Certificate and key of the REST API, both PEM.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TlsFiles {
    /// The certificate, followed by those between it and its authority.
    pub certificate: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

/// What browsers may do.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WebConfig {
    /// Names of this server besides `localhost` and its addresses.
    pub hosts: Vec<String>,
    /// Origins of foreign pages that may ask with a token of their own.
    pub allowed_origins: Vec<Origin>,
    /// A proxy before this server ends TLS: browsers come by `https`.
    pub behind_https: bool,
    /// Addresses and networks of the proxies before this server, whose `X-Forwarded-For` says where
    /// a request comes from. Nobody else's is believed.
    pub trusted_proxies: Vec<Network>,
}

/// What becomes of the audit log besides the database.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AuditConfig {
    /// Each entry is a line of the server's log too, of the target `tread_audit`: what the journal or
    /// a collector of logs has, nobody changes who can write the database.
    pub log: bool,
}

/// How long raw measurements are kept; what they say stays on the map for ever.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RetentionConfig {
    /// Days after which a raw measurement is removed, within [`SEGMENTS_DAYS_RANGE`].
    pub segments_days: u32,
    /// Most raw measurements; the oldest go first. Within [`SEGMENTS_MAX_RANGE`].
    pub segments_max: i64,
}

/// How long raw measurements may be kept, days.
pub const SEGMENTS_DAYS_RANGE: std::ops::RangeInclusive<u32> = 1..=36_500;
/// How many raw measurements may be kept.
pub const SEGMENTS_MAX_RANGE: std::ops::RangeInclusive<i64> = 1_000..=1_000_000_000_000;

impl Default for RetentionConfig {
    fn default() -> Self {
        Self {
            segments_days: 90,
            segments_max: 20_000_000,
        }
    }
}

impl RetentionConfig {
    #[expect(clippy::cast_precision_loss, reason = "for a message")]
    fn check(self) -> Result<(), ConfigError> {
        if !SEGMENTS_DAYS_RANGE.contains(&self.segments_days) {
            return Err(ConfigError::OutOfRange {
                key: "retention.segments_days",
                range: "1 to 36500",
                value: self.segments_days.into(),
            });
        }
        if !SEGMENTS_MAX_RANGE.contains(&self.segments_max) {
            return Err(ConfigError::OutOfRange {
                key: "retention.segments_max",
                range: "1000 to 1e12",
                value: self.segments_max as f64,
            });
        }
        Ok(())
    }
}

/// What is expected of the storage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StorageConfig {
    /// An alert is raised when less than this is free on the disk of the database, MiB; within
    /// [`DISK_FREE_MIN_MIB_RANGE`].
    pub disk_free_min_mib: u64,
}

/// How much of the disk may be asked to be free, MiB.
pub const DISK_FREE_MIN_MIB_RANGE: std::ops::RangeInclusive<u64> = 16..=1_000_000_000;
const BYTES_PER_MIB: u64 = 1_024 * 1_024;

impl Default for StorageConfig {
    fn default() -> Self {
        Self {
            disk_free_min_mib: 1_024,
        }
    }
}

impl StorageConfig {
    /// The limit in bytes.
    pub const fn disk_free_min_bytes(self) -> u64 {
        self.disk_free_min_mib.saturating_mul(BYTES_PER_MIB)
    }

    #[expect(clippy::cast_precision_loss, reason = "for a message")]
    fn check(self) -> Result<(), ConfigError> {
        if DISK_FREE_MIN_MIB_RANGE.contains(&self.disk_free_min_mib) {
            return Ok(());
        }
        Err(ConfigError::OutOfRange {
            key: "storage.disk_free_min_mib",
            range: "16 to 1e9",
            value: self.disk_free_min_mib as f64,
        })
    }
}

/// Refuses weights that make no sense.
fn check_friction(friction: FrictionConfig) -> Result<(), ConfigError> {
    let FrictionConfig {
        robot_bias_ratio,
        drift_variance_per_s,
        mu_peak_age_max_s,
    } = friction;
    let ratio = ("0 to 1", 0.0..=1.0);
    let span = ("1 to 1e9", 1.0..=1.0e9);
    for (key, value, (range, bounds)) in [
        ("friction.robot_bias_ratio", robot_bias_ratio, ratio.clone()),
        ("friction.drift_variance_per_s", drift_variance_per_s, ratio),
        ("friction.mu_peak_age_max_s", mu_peak_age_max_s, span),
    ] {
        // TOML can say `nan`, which no range contains.
        if !bounds.contains(&value) {
            return Err(ConfigError::OutOfRange { key, range, value });
        }
    }
    Ok(())
}

/// One normalisation of the configuration file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct NormalisationFields {
    reference: ConfigurationId,
    ratios: BTreeMap<ConfigurationId, f64>,
}

/// θ of one model over that of another on the same ground.
const RATIOS: std::ops::RangeInclusive<f64> = 0.01..=100.0;

fn normalisations(
    fields: BTreeMap<String, NormalisationFields>,
) -> Result<Vec<Normalisation>, ConfigError> {
    let mut declared = Vec::new();
    for (name, NormalisationFields { reference, ratios }) in fields {
        if let Some(&value) = ratios.values().find(|ratio| !RATIOS.contains(ratio)) {
            return Err(ConfigError::OutOfRange {
                key: "normalisations.*.ratios",
                range: "0.01 to 100",
                value,
            });
        }
        declared.push(Normalisation {
            name,
            reference,
            ratios,
        });
    }
    Ok(declared)
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    http: Option<SocketAddr>,
    metrics: Option<SocketAddr>,
    zenoh: Option<SocketAddr>,
    database: Option<PathBuf>,
    site: Option<SiteId>,
    #[serde(default)]
    friction: FrictionConfig,
    #[serde(default)]
    normalisations: BTreeMap<String, NormalisationFields>,
    #[serde(default)]
    retention: RetentionConfig,
    #[serde(default)]
    storage: StorageConfig,
    tls: Option<TlsFiles>,
    #[serde(default)]
    web: WebConfig,
    #[serde(default)]
    audit: AuditConfig,
    robots: Option<RobotsConfig>,
    oidc: Option<OidcConfig>,
}

/// Why the server cannot start with this configuration.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the configuration file `{}`", path.display())]
    Unreadable {
        /// Which file.
        path: PathBuf,
        /// Why.
        #[source]
        cause: std::io::Error,
    },
    /// The file does not say something possible; the text names line and key.
    #[error("configuration file `{}`, line {line}: {message}", path.display())]
    Invalid {
        /// Which file.
        path: PathBuf,
        /// Which line, from 1.
        line: usize,
        /// Which key, and what is wrong with it.
        message: String,
    },
    /// A number is out of its range.
    #[error("`{key}` must be {range}, not {value}")]
    OutOfRange {
        /// Which key.
        key: &'static str,
        /// What is allowed.
        range: &'static str,
        /// What was given.
        value: f64,
    },
    /// The sign-in of people at a provider cannot be as it is written.
    #[error(transparent)]
    Oidc(#[from] OidcConfigError),
    /// A name of the robots' port is none.
    #[error("`robots.names` has `{0}`, which is neither a host name nor an address")]
    PortName(String),
    /// An address that others can reach.
    #[error("`{key}` is {address}, which other machines can reach without TLS: {cure}")]
    NotLoopback {
        /// Which key.
        key: &'static str,
        /// What was given.
        address: SocketAddr,
        /// What to do.
        cure: &'static str,
    },
}

impl Config {
    /// Reads the file that the flags name, if any, and lets the flags win.
    ///
    /// # Errors
    /// [`ConfigError`]: unreadable, an unknown key, an impossible value, or an address beyond
    /// this machine.
    pub fn load(args: &ServerArgs) -> Result<Self, ConfigError> {
        let file = args
            .config
            .as_deref()
            .map(read)
            .transpose()?
            .unwrap_or_default();
        let builtin = "the built-in value parses";
        let config = Self {
            http: args
                .http
                .or(file.http)
                .unwrap_or_else(|| HTTP_DEFAULT.parse().expect(builtin)),
            metrics: args.metrics.or(file.metrics),
            zenoh: args
                .zenoh
                .or(file.zenoh)
                .unwrap_or_else(|| ZENOH_DEFAULT.parse().expect(builtin)),
            database: args
                .database
                .clone()
                .or(file.database)
                .unwrap_or_else(|| DATABASE_DEFAULT.into()),
            site: args
                .site
                .clone()
                .or(file.site)
                .unwrap_or_else(|| SITE_DEFAULT.parse().expect(builtin)),
            friction: file.friction,
            normalisations: normalisations(file.normalisations)?,
            retention: file.retention,
            storage: file.storage,
            tls: file.tls,
            web: file.web,
            audit: file.audit,
            robots: file.robots,
            oidc: file.oidc,
        };
        config.check()?;
        Ok(config)
    }

    /// The names that the server goes by.
    pub fn names(&self) -> Names {
        Names {
            hosts: self.web.hosts.clone(),
            allowed_origins: self.web.allowed_origins.clone(),
            is_tls: self.tls.is_some() || self.web.behind_https,
        }
    }

    fn check(&self) -> Result<(), ConfigError> {
        const HERE: &str = "use an address of this machine such as 127.0.0.1";
        const TLS: &str = "give `certificate` and `key` under `[tls]`, or use an address of this \
                           machine such as 127.0.0.1";
        const ROBOTS: &str = "give `authority` under `[robots]` (`tread-server init` makes it), or \
                              use an address of this machine such as 127.0.0.1";
        let metrics = self.metrics.map(|address| ("metrics", address, HERE));
        let http = self.tls.is_none().then_some(("http", self.http, TLS));
        let zenoh = self
            .robots
            .is_none()
            .then_some(("zenoh", self.zenoh, ROBOTS));
        for (key, address, cure) in [http, zenoh, metrics].into_iter().flatten() {
            if !address.ip().is_loopback() {
                return Err(ConfigError::NotLoopback { key, address, cure });
            }
        }
        if let Some(robots) = &self.robots {
            robots.check()?;
        }
        if let Some(oidc) = &self.oidc {
            oidc.check(&self.names())?;
        }
        self.retention.check()?;
        self.storage.check()?;
        check_friction(self.friction)
    }
}

impl RobotsConfig {
    fn check(&self) -> Result<(), ConfigError> {
        if let Some(name) = self.names.iter().find(|name| !is_port_name(name)) {
            return Err(ConfigError::PortName(name.clone()));
        }
        if !CERTIFICATE_S_RANGE.contains(&self.certificate_s) {
            return Err(ConfigError::OutOfRange {
                key: "robots.certificate_s",
                range: "5 to 2592000",
                value: f64::from(self.certificate_s),
            });
        }
        Ok(())
    }
}

fn read(path: &Path) -> Result<File, ConfigError> {
    let text = std::fs::read_to_string(path).map_err(|cause| ConfigError::Unreadable {
        path: path.to_owned(),
        cause,
    })?;
    toml::from_str(&text).map_err(|error| {
        let start = error.span().map_or(0, |span| span.start);
        let line = text
            .bytes()
            .take(start)
            .filter(|&byte| byte == b'\n')
            .count()
            + 1;
        let line_text = text.lines().nth(line - 1).unwrap_or_default().trim();
        let message = format!("{} in `{line_text}`", error.message());
        ConfigError::Invalid {
            path: path.to_owned(),
            line,
            message,
        }
    })
}

#[cfg(test)]
mod tests;
