//! Configuration of the server: defaults, overridden by a TOML file, overridden by flags.
//!
//! An unknown key, a value out of range, or an address that other machines can reach without TLS
//! prevents the start. The error names file, line and key.

pub mod backup;
pub(crate) mod credentials;
pub mod oidc;
pub mod webhooks;

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde::Deserialize;
use tread_api::ids::{ConfigurationId, SiteId};
use tread_store::Location;
use tread_telemetry::TelemetryError;
pub use tread_telemetry::TracingConfig;

use self::backup::BackupConfig;
use self::oidc::{OidcConfig, OidcConfigError};
use self::webhooks::WebhooksConfig;
use crate::archive::ArchiveLocation;
use crate::authority::is_port_name;
use crate::friction::index::Normalisation;
pub use crate::friction::weights::FrictionConfig;
use crate::identity::address::Network;
use crate::identity::origin::{Names, Origin};

/// Default address of the REST API.
pub const HTTP_DEFAULT: &str = "127.0.0.1:8420";
/// Default address of the zenoh router.
pub const ZENOH_DEFAULT: &str = "127.0.0.1:7447";
/// Default database file.
pub const DATABASE_DEFAULT: &str = "tread.db";
/// Default identifier of the site that is created at the start.
pub const SITE_DEFAULT: &str = "yard";

/// Flags of the server; each overrides the configuration file.
#[derive(Debug, Clone, Default, Args)]
pub struct ServerArgs {
    /// Configuration file, TOML
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Address of the REST API; port 0 selects a free port
    #[arg(long, value_name = "ADDRESS")]
    pub http: Option<SocketAddr>,
    /// Address of `/metrics` for Prometheus; no metrics when absent
    #[arg(long, value_name = "ADDRESS")]
    pub metrics: Option<SocketAddr>,
    /// Address of the zenoh router that robots connect to; port 0 selects a free port
    #[arg(long, value_name = "ADDRESS")]
    pub zenoh: Option<SocketAddr>,
    /// Database: a file, created when missing, or the address `postgres://…` of a PostgreSQL database
    #[arg(long, value_name = "FILE")]
    pub database: Option<PathBuf>,
    /// Wait while another server uses the PostgreSQL database, and take over when it ends or falls
    /// silent
    #[arg(long)]
    pub standby: bool,
    /// Site to create if it does not exist
    #[arg(long)]
    pub site: Option<SiteId>,
    /// Log filter, such as `info` or `tread_server=debug`; `RUST_LOG` when absent. zenoh logs only
    /// errors unless the filter names it, as in `info,zenoh=warn`
    #[arg(long, value_name = "FILTER")]
    pub log: Option<String>,
    /// Format of log lines
    #[arg(long, value_enum, default_value_t)]
    pub log_format: LogFormat,
}

/// Format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum LogFormat {
    /// For people
    #[default]
    Human,
    /// One JSON object per line
    Json,
}

/// Complete, checked configuration of the server.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Address of the REST API; a loopback address unless `tls` is set.
    pub http: SocketAddr,
    /// Address of `/metrics`, a loopback address; `None` for no metrics.
    pub metrics: Option<SocketAddr>,
    /// Address that robots connect to; a loopback address unless `robots` is set.
    pub zenoh: SocketAddr,
    /// The database: a file, or a PostgreSQL database.
    pub database: Location,
    /// Whether the start waits while another server uses the database.
    pub standby: bool,
    /// Site that is created at the start if missing.
    pub site: SiteId,
    /// Weights of measurements by robot and age.
    pub friction: FrictionConfig,
    /// Declared ratios of θ between robot models, for answers that normalise θ.
    pub normalisations: Vec<Normalisation>,
    /// Retention of raw measurements.
    pub retention: RetentionConfig,
    /// Limits of the storage.
    pub storage: StorageConfig,
    /// Memory for the friction map.
    pub map: MapConfig,
    /// Certificate of the REST API; `None` serves plain HTTP on a loopback address.
    pub tls: Option<TlsSource>,
    /// Host names, origins and proxies of the REST API.
    pub web: WebConfig,
    /// Output of the audit log in addition to the database.
    pub audit: AuditConfig,
    /// Enrolment and authentication of robots; `None` lets robots connect without TLS to a loopback
    /// address.
    pub robots: Option<RobotsConfig>,
    /// Sign-in of people at an OpenID provider; `None` allows tokens only.
    pub oidc: Option<OidcConfig>,
    /// Networks to which webhooks may send.
    pub webhooks: WebhooksConfig,
    /// Where traces of missions are sent.
    pub tracing: TracingConfig,
    /// Backups that the server makes by itself; `None` for none.
    pub backup: Option<BackupConfig>,
    /// Where states, friction and map changes are published once more; `None` for nowhere.
    pub republish: Option<RepublishConfig>,
}

/// `[republish]`: a zenoh router for programs that are no robots.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RepublishConfig {
    /// Loopback address of the router, such as zenohd's, at which it takes connections without TLS.
    pub router: SocketAddr,
}

/// `[robots]`: enrolment and authentication of robots by certificates.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotsConfig {
    /// Folder of the fleet's certificate authority, created by `tread-server init`.
    pub authority: PathBuf,
    /// Host names and addresses by which robots reach this server, in addition to `localhost`.
    #[serde(default)]
    pub names: Vec<String>,
    /// Validity period of a robot's certificate in seconds, within [`CERTIFICATE_S_RANGE`]. A robot
    /// renews its certificate after two thirds of this period.
    #[serde(default = "certificate_s")]
    pub certificate_s: u32,
    /// Maximum number of robots of one zenoh router within the server, within
    /// [`ROBOTS_PER_ROUTER_RANGE`]. A router costs memory and threads; a session of a large one takes
    /// longer to open.
    #[serde(default = "robots_per_router")]
    pub robots_per_router: u16,
}

/// Range of the validity period of robots' certificates, in seconds. The period should outlast
/// outages of the server; the upper bound limits the use of a stolen certificate.
pub const CERTIFICATE_S_RANGE: std::ops::RangeInclusive<u32> = 5..=30 * 24 * 3_600;

const fn certificate_s() -> u32 {
    24 * 3_600
}

/// Range of the number of robots of one router. Copying the rules of one robot takes about 6 µs for
/// each session, so a session of a router of the default size takes 1.5 ms.
pub const ROBOTS_PER_ROUTER_RANGE: std::ops::RangeInclusive<u16> = 1..=1_024;

const fn robots_per_router() -> u16 {
    256
}

/// `[tls]`: origin of the REST API's certificate.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(try_from = "TlsFields")]
pub enum TlsSource {
    /// From files.
    Files(TlsFiles),
    /// Issued by the fleet's own authority at each start, and renewed while the server runs.
    Authority,
}

/// Certificate and key of the REST API, both PEM.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsFiles {
    /// File with the certificate, followed by its intermediate certificates.
    pub certificate: PathBuf,
    /// File with the private key.
    pub key: PathBuf,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct TlsFields {
    certificate: Option<PathBuf>,
    key: Option<PathBuf>,
    #[serde(default)]
    authority: bool,
}

impl TryFrom<TlsFields> for TlsSource {
    type Error = &'static str;

    fn try_from(fields: TlsFields) -> Result<Self, Self::Error> {
        match fields {
            TlsFields {
                certificate: Some(certificate),
                key: Some(key),
                authority: false,
            } => Ok(Self::Files(TlsFiles { certificate, key })),
            TlsFields {
                certificate: None,
                key: None,
                authority: true,
            } => Ok(Self::Authority),
            TlsFields { .. } => {
                Err("`[tls]` needs `certificate` and `key`, or `authority = true` alone")
            }
        }
    }
}

/// `[web]`: host names, origins and proxies of the REST API.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WebConfig {
    /// Host names of this server in addition to `localhost` and IP addresses.
    pub hosts: Vec<String>,
    /// Origins of foreign pages that may send requests with a token (CORS, `WebSocket`).
    pub allowed_origins: Vec<Origin>,
    /// Whether a proxy in front of this server terminates TLS, so that browsers use `https`.
    pub behind_https: bool,
    /// Origin at which standbys of the same database reach this server's REST API, such as
    /// `https://server-a.example.org:8420`; they forward to it what they cannot answer by themselves.
    pub advertise_url: Option<Origin>,
    /// File with the CA certificates (PEM) by which a standby recognises the other server; those of the
    /// machine when absent, or the fleet's own if that issues the certificates.
    pub advertise_authorities: Option<PathBuf>,
    /// Addresses and networks of the proxies in front of this server. Only their `X-Forwarded-For`
    /// entries are used to determine the client address of a request.
    pub trusted_proxies: Vec<Network>,
}

/// `[audit]`: output of the audit log in addition to the database.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AuditConfig {
    /// Whether each entry is also written to the server's log with the target `tread_audit`, from
    /// which a log collector can store it where an intruder in the database cannot change it.
    pub log: bool,
}

/// `[retention]`: retention of raw measurements. Their statistics stay on the map for ever.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RetentionConfig {
    /// Days after which a raw measurement is deleted, within [`SEGMENTS_DAYS_RANGE`].
    pub segments_days: u32,
    /// Maximum number of raw measurements, within [`SEGMENTS_MAX_RANGE`]; beyond it the oldest are
    /// deleted.
    pub segments_max: i64,
    /// Folder of Parquet files to which raw measurements are written before they are deleted, or a bucket
    /// of S3-compatible storage, `s3://BUCKET/PREFIX`; without it they are only deleted.
    pub archive: Option<ArchiveLocation>,
}

/// Range of the retention time of raw measurements, in days.
pub const SEGMENTS_DAYS_RANGE: std::ops::RangeInclusive<u32> = 1..=36_500;
/// Range of the maximum number of raw measurements.
pub const SEGMENTS_MAX_RANGE: std::ops::RangeInclusive<i64> = 1_000..=1_000_000_000_000;

impl Default for RetentionConfig {
    fn default() -> Self {
        Self {
            segments_days: 90,
            segments_max: 20_000_000,
            archive: None,
        }
    }
}

impl RetentionConfig {
    #[expect(clippy::cast_precision_loss, reason = "for a message")]
    fn check(&self) -> Result<(), ConfigError> {
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

/// `[storage]`: limits of the storage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StorageConfig {
    /// Minimum free space on the disk of the database in MiB, within [`DISK_FREE_MIN_MIB_RANGE`];
    /// below it an alert is raised.
    pub disk_free_min_mib: u64,
}

/// Range of the minimum free disk space, in MiB.
pub const DISK_FREE_MIN_MIB_RANGE: std::ops::RangeInclusive<u64> = 16..=1_000_000_000;
/// Bytes of a MiB.
pub(crate) const BYTES_PER_MIB: u64 = 1_024 * 1_024;

impl Default for StorageConfig {
    fn default() -> Self {
        Self {
            disk_free_min_mib: 1_024,
        }
    }
}

impl StorageConfig {
    /// Returns the minimum free disk space in bytes.
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

/// `[map]`: memory for the friction map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapConfig {
    /// Maximum memory for the cells of the map in MiB, within [`MAP_MEMORY_MAX_MIB_RANGE`]; cells
    /// beyond it are read from the database when they are needed.
    pub memory_max_mib: u64,
}

/// Range of the maximum memory for the map, in MiB.
pub const MAP_MEMORY_MAX_MIB_RANGE: std::ops::RangeInclusive<u64> = 64..=1_000_000_000;

impl Default for MapConfig {
    fn default() -> Self {
        Self {
            memory_max_mib: 4_096,
        }
    }
}

impl MapConfig {
    #[expect(clippy::cast_precision_loss, reason = "for a message")]
    fn check(self) -> Result<(), ConfigError> {
        if MAP_MEMORY_MAX_MIB_RANGE.contains(&self.memory_max_mib) {
            return Ok(());
        }
        Err(ConfigError::OutOfRange {
            key: "map.memory_max_mib",
            range: "64 to 1e9",
            value: self.memory_max_mib as f64,
        })
    }
}

/// Checks the ranges of `[friction]`.
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
        // TOML allows `nan`, which no range contains.
        if !bounds.contains(&value) {
            return Err(ConfigError::OutOfRange { key, range, value });
        }
    }
    Ok(())
}

/// A normalisation, `[normalisations.NAME]`: ratios of θ relative to a reference configuration.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct NormalisationFields {
    reference: ConfigurationId,
    ratios: BTreeMap<ConfigurationId, f64>,
}

/// Range of the ratio of θ between two robot models on the same ground.
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
    #[serde(default)]
    standby: bool,
    site: Option<SiteId>,
    #[serde(default)]
    friction: FrictionConfig,
    #[serde(default)]
    normalisations: BTreeMap<String, NormalisationFields>,
    #[serde(default)]
    retention: RetentionConfig,
    #[serde(default)]
    storage: StorageConfig,
    #[serde(default)]
    map: MapConfig,
    tls: Option<TlsSource>,
    #[serde(default)]
    web: WebConfig,
    #[serde(default)]
    audit: AuditConfig,
    robots: Option<RobotsConfig>,
    oidc: Option<OidcConfig>,
    #[serde(default)]
    webhooks: WebhooksConfig,
    #[serde(default)]
    tracing: TracingConfig,
    backup: Option<BackupConfig>,
    republish: Option<RepublishConfig>,
}

/// Error of reading the configuration.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error(
        "cannot read the configuration file `{}`: it must exist (`tread-server init` writes one), \
         and the user that the server runs as must be able to read it", path.display()
    )]
    Unreadable {
        /// Path of the file.
        path: PathBuf,
        /// Cause of the failure.
        #[source]
        cause: std::io::Error,
    },
    /// The file is not text.
    #[error("configuration file `{}` is not text in UTF-8: save it as UTF-8", path.display())]
    NotText {
        /// Path of the file.
        path: PathBuf,
    },
    /// The file is not valid TOML, or has an unknown key or a value of the wrong type.
    #[error("configuration file `{}`, line {line}: {message}", path.display())]
    Invalid {
        /// Path of the file.
        path: PathBuf,
        /// Number of the line, from 1.
        line: usize,
        /// Message of the parser, and the text of the line.
        message: String,
    },
    /// A number is out of its range.
    #[error("`{key}` must be {range}, not {value}")]
    OutOfRange {
        /// Configuration key.
        key: &'static str,
        /// Allowed range.
        range: &'static str,
        /// Configured value.
        value: f64,
    },
    /// `[tracing]` is invalid.
    #[error(transparent)]
    Tracing(#[from] TelemetryError),
    /// `[oidc]` is invalid.
    #[error(transparent)]
    Oidc(#[from] OidcConfigError),
    /// A list has too many entries.
    #[error("`{key}` has {count} entries; at most {most} are possible")]
    TooMany {
        /// Configuration key.
        key: &'static str,
        /// Number of entries.
        count: usize,
        /// Maximum number of entries.
        most: usize,
    },
    /// The name of a credential is none.
    #[error("`credential:{0}` names no credential: give the name of `LoadCredential=`, not a path")]
    CredentialName(String),
    /// The service manager has not passed a credential.
    #[error(
        "`credential:{0}` was not passed by the service manager: put it into /etc/credstore/{0}, with          `LoadCredential={0}` in the unit, or give the path of a file"
    )]
    NoCredential(String),
    /// Two listeners have the same address.
    #[error("`{}` and `{}` are both {address}: give one of them another port", keys[0], keys[1])]
    SameAddress {
        /// Configuration keys.
        keys: [&'static str; 2],
        /// The address.
        address: SocketAddr,
    },
    /// `[backup]` is set for a PostgreSQL database.
    #[error(
        "`[backup]` copies a database file; a PostgreSQL database is backed up by its own tools, such as \
         `pg_dump` (docs/postgresql.md): remove `[backup]`"
    )]
    BackupOfPostgres,
    /// Another machine would send tokens in the clear.
    #[error(
        "`web.advertise_url`, `{0}`: standbys send the tokens of their clients there, so it must begin with \
         `https://`, or be an address of this machine such as 127.0.0.1"
    )]
    AdvertisedInTheClear(Origin),
    /// `standby` is set for a database file.
    #[error(
        "`standby` needs a PostgreSQL database, which two machines can reach: a file has one server \
         (docs/postgresql.md#standby)"
    )]
    StandbyOfFile,
    /// An entry of `robots.names` is neither a host name nor an IP address.
    #[error("`robots.names` has `{0}`, which is neither a host name nor an address")]
    PortName(String),
    /// `tls.authority` is set, and there is no authority.
    #[error(
        "`tls.authority` needs the fleet's authority: give `authority` under `[robots]` \
         (`tread-server init` makes it)"
    )]
    NoAuthority,
    /// Other machines can reach a configured address without TLS.
    #[error("`{key}` is {address}, which other machines can reach without TLS: {cure}")]
    NotLoopback {
        /// Configuration key.
        key: &'static str,
        /// Configured address.
        address: SocketAddr,
        /// Remedy, for the message.
        cure: &'static str,
    },
}

impl Config {
    /// Reads the configuration file that the flags name, if any, applies the flags, and checks the
    /// result.
    ///
    /// # Errors
    /// [`ConfigError`] if the file cannot be read, has an unknown key or an invalid value, or if
    /// other machines could reach an address without TLS.
    pub fn load(args: &ServerArgs) -> Result<Self, ConfigError> {
        let file = args
            .config
            .as_deref()
            .map(read)
            .transpose()?
            .unwrap_or_default();
        let builtin = "the built-in value parses";
        let mut config = Self {
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
                .unwrap_or_else(|| DATABASE_DEFAULT.into())
                .into(),
            standby: args.standby || file.standby,
            site: args
                .site
                .clone()
                .or(file.site)
                .unwrap_or_else(|| SITE_DEFAULT.parse().expect(builtin)),
            friction: file.friction,
            normalisations: normalisations(file.normalisations)?,
            retention: file.retention,
            storage: file.storage,
            map: file.map,
            tls: file.tls,
            web: file.web,
            audit: file.audit,
            robots: file.robots,
            oidc: file.oidc,
            webhooks: file.webhooks,
            tracing: file.tracing,
            backup: file.backup,
            republish: file.republish,
        };
        config.resolve_credentials(credentials::folder().as_deref())?;
        config.check()?;
        Ok(config)
    }

    /// Returns the names for a certificate of the REST API that the fleet's authority issues: those
    /// of `[web]` and of `[robots]`, each once.
    pub fn certificate_names(&self) -> Vec<String> {
        let of_robots = self.robots.iter().flat_map(|robots| &robots.names);
        let hosts = self.hosts();
        let all = hosts.iter().chain(of_robots);
        let mut names: Vec<String> = Vec::new();
        for name in all.filter(|name| is_port_name(name)) {
            if !names.contains(name) {
                names.push(name.clone());
            }
        }
        names
    }

    /// Returns the host names of this server, with that at which standbys reach it.
    fn hosts(&self) -> Vec<String> {
        let advertised = self.web.advertise_url.as_ref().map(Origin::host);
        let bare = advertised.map(|host| host.trim_matches(['[', ']']).trim_end_matches('.'));
        let hosts = self.web.hosts.iter().map(String::as_str);
        hosts.chain(bare).map(str::to_owned).collect()
    }

    /// Returns the host names of this server and the allowed origins.
    pub fn names(&self) -> Names {
        Names {
            hosts: self.hosts(),
            allowed_origins: self.web.allowed_origins.clone(),
            is_tls: self.tls.is_some() || self.web.behind_https,
        }
    }

    fn check(&self) -> Result<(), ConfigError> {
        const HERE: &str = "use an address of this machine such as 127.0.0.1";
        const TLS: &str = "give `certificate` and `key`, or `authority = true`, under `[tls]`, or \
                           use an address of this machine such as 127.0.0.1";
        const ROBOTS: &str = "give `authority` under `[robots]` (`tread-server init` makes it), or \
                              use an address of this machine such as 127.0.0.1";
        const ROUTER: &str =
            "let the router listen on 127.0.0.1 for this server, and with TLS for other machines";
        let metrics = self.metrics.map(|address| ("metrics", address, HERE));
        let republish = self.republish;
        let republish = republish.map(|to| ("republish.router", to.router, ROUTER));
        let http = self.tls.is_none().then_some(("http", self.http, TLS));
        let zenoh = self
            .robots
            .is_none()
            .then_some(("zenoh", self.zenoh, ROBOTS));
        if self.database.is_postgres() && self.backup.is_some() {
            return Err(ConfigError::BackupOfPostgres);
        }
        if !self.database.is_postgres() && self.standby {
            return Err(ConfigError::StandbyOfFile);
        }
        for (key, address, cure) in [http, zenoh, metrics, republish].into_iter().flatten() {
            if !address.ip().is_loopback() {
                return Err(ConfigError::NotLoopback { key, address, cure });
            }
        }
        let listened = [
            ("http", Some(self.http)),
            ("zenoh", Some(self.zenoh)),
            ("metrics", self.metrics),
            ("republish.router", self.republish.map(|to| to.router)),
        ];
        for (place, (key, address)) in listened.iter().enumerate() {
            let same = |other: &&(&'static str, Option<SocketAddr>)| {
                address.is_some_and(|address| address.port() != 0 && other.1 == Some(address))
            };
            if let Some((other, Some(address))) = listened[..place].iter().find(same) {
                return Err(ConfigError::SameAddress {
                    keys: [*other, *key],
                    address: *address,
                });
            }
        }
        if let Some(url) = &self.web.advertise_url
            && !url.is_safe()
        {
            return Err(ConfigError::AdvertisedInTheClear(url.clone()));
        }
        if let Some(robots) = &self.robots {
            robots.check()?;
        }
        if self.tls == Some(TlsSource::Authority) && self.robots.is_none() {
            return Err(ConfigError::NoAuthority);
        }
        if let Some(oidc) = &self.oidc {
            oidc.check(&self.names())?;
        }
        self.retention.check()?;
        self.storage.check()?;
        self.map.check()?;
        self.webhooks.check()?;
        self.tracing.check()?;
        if let Some(backup) = &self.backup {
            backup.check()?;
        }
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
        if !ROBOTS_PER_ROUTER_RANGE.contains(&self.robots_per_router) {
            return Err(ConfigError::OutOfRange {
                key: "robots.robots_per_router",
                range: "1 to 1024",
                value: f64::from(self.robots_per_router),
            });
        }
        Ok(())
    }
}

fn read(path: &Path) -> Result<File, ConfigError> {
    let text = std::fs::read_to_string(path).map_err(|cause| {
        let path = path.to_owned();
        if cause.kind() == std::io::ErrorKind::InvalidData {
            ConfigError::NotText { path }
        } else {
            ConfigError::Unreadable { path, cause }
        }
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
