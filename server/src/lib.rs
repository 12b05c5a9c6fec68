//! Tread's server: accepts missions over REST, sends them to robots over zenoh, stores the friction
//! measurements of the robots, and serves the friction map.
//!
//! * [`http`] is the REST API and uses no SQL; [`app`] contains the use cases; [`db`] chooses the
//!   engine of the store, which contains the SQL and no decisions. Only [`fleet`] calls zenoh, only
//!   [`oidc`] the OpenID provider, and only [`webhooks`] the receivers of alerts. [`friction`] is
//!   pure.
//! * [`Server::start`] runs the server inside another program; [`run_from_args`] is the whole
//!   program, which runs until a signal.

pub mod app;
pub mod archive;
pub mod authority;
pub mod backup;
pub mod build;
pub mod certificate;
pub mod clock;
pub mod config;
pub mod connections;
pub mod counters;
pub mod db;
mod doctor;
mod error_text;
mod file_error;
mod file_owner;
pub mod fleet;
pub mod formats;
pub mod friction;
mod health;
pub mod http;
pub mod identity;
mod init;
pub mod liveness;
mod logging;
mod maintenance;
pub mod metrics;
pub mod oidc;
mod paths;
mod program;
mod rate_limit;
mod service_manager;
mod setup;
mod standby;
pub mod supervisor;
pub mod webhooks;

use std::future::pending;
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::pin::pin;
use std::sync::Arc;

use anyhow::Context as _;
use jiff::SignedDuration;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use tread_api::ids::SiteId;
use tread_telemetry::Telemetry;

use self::app::enrolment::EnrolmentService;
use self::app::identity::people::People;
use self::app::identity::{READ_AGAIN, audit};
use self::app::{
    App, Dependencies, Role, backups, checkpoints, events, ingest, memory, merging, reconciler,
    retention, storage, sums,
};
use self::archive::SegmentArchive;
use self::authority::Authorities;
use self::clock::Clock;
pub use self::config::{Config, ServerArgs};
use self::config::{RetentionConfig, RobotsConfig, TlsSource};
use self::db::lock::DatabaseLock;
use self::db::{Db, DbError, Engine, Location};
use self::fleet::{Fleet, Security};
use self::http::serve::Serving;
use self::http::tls::{Issuer, Tls};
use self::identity::address::TrustedProxies;
use self::identity::origin::Origin;
pub use self::program::{command_line, run, run_from_args};
use self::standby::AcquiredLock;
use self::supervisor::Supervisor;
use self::webhooks::{Resolver, Sender, SystemResolver};

/// Entry point that starts servers.
#[derive(Debug, Clone, Copy)]
pub struct Server;

/// A running server; call [`Self::stop`] to stop it.
#[derive(Debug)]
pub struct RunningServer {
    http_address: SocketAddr,
    scheme: &'static str,
    metrics_address: Option<SocketAddr>,
    app: App,
    fleet: Fleet,
    supervisor: Supervisor,
    lock: DatabaseLock,
}

impl Server {
    /// Starts a server with the machine's clock. Needs a multi-threaded tokio runtime.
    ///
    /// # Errors
    /// A configured file cannot be read, the database cannot be opened, or an address is in use.
    pub async fn start(config: Config) -> anyhow::Result<RunningServer> {
        Self::start_with_clock(config, Clock::system()).await
    }

    /// Starts a server with the given clock, as tests and simulations need.
    ///
    /// # Errors
    /// As [`Server::start`].
    pub async fn start_with_clock(config: Config, clock: Clock) -> anyhow::Result<RunningServer> {
        Self::start_with(config, clock, Arc::new(SystemResolver)).await
    }

    /// Starts a server with the given clock and resolver of webhooks' host names.
    ///
    /// # Errors
    /// As [`Server::start`].
    pub async fn start_with(
        config: Config,
        clock: Clock,
        resolver: Arc<dyn Resolver>,
    ) -> anyhow::Result<RunningServer> {
        let started = Self::start_until(pending(), config, clock, resolver).await?;
        started.context("nobody asked it to stop")
    }

    /// Starts a server, or a standby that waits to become one; `None` if it is asked to stop before. A standby
    /// completes open requests then.
    ///
    /// # Errors
    /// As [`Server::start`].
    pub async fn start_until(
        stop_requested: impl Future<Output = ()>,
        mut config: Config,
        clock: Clock,
        resolver: Arc<dyn Resolver>,
    ) -> anyhow::Result<Option<RunningServer>> {
        config.check_credentials()?;
        let mut stop_requested = pin!(stop_requested);
        let Some(taken) = standby::acquire_lock(stop_requested.as_mut(), &config, &clock).await?
        else {
            return Ok(None);
        };
        let starting = Box::pin(Self::start_locked(taken, config, clock, resolver));
        tokio::select! {
            started = starting => started.map(Some),
            () = stop_requested => Ok(None),
        }
    }

    /// Starts a server on the database that is locked.
    async fn start_locked(
        taken: AcquiredLock,
        config: Config,
        clock: Clock,
        resolver: Arc<dyn Resolver>,
    ) -> anyhow::Result<RunningServer> {
        let AcquiredLock { lock, standby, .. } = &taken;
        let names = config.names();
        let proxies = TrustedProxies::new(config.web.trusted_proxies.clone());
        let schedule = backup_schedule(&config);
        // Only with the lock: this completes an interrupted rotation of the authority.
        let security = config.robots.as_ref().map(security).transpose()?;
        let authorities = security.as_ref().map(|security| &security.authorities);
        let tls = open_tls(&config, authorities, &clock)?;
        let db = open_claimed(&config, lock).await?;
        let supervisor = Supervisor::new();
        let stop = || supervisor.stop_token();
        supervisor.spawn_vital("lock", hold_lock(lock.lost(), db.clone(), stop()));
        let (of_fleet, fleet_clock) = (security.clone(), clock.clone());
        let fleet = Fleet::open(config.zenoh, of_fleet, fleet_clock, supervisor.clone())?;
        let enrolment_service = |security: Security, robots: &RobotsConfig| EnrolmentService {
            authorities: security.authorities,
            lifetime: SignedDuration::from_secs(robots.certificate_s.into()),
            port: fleet.address().port(),
        };
        let people = config
            .oidc
            .as_ref()
            .map(|oidc| People::new(oidc, clock.clone()))
            .transpose()?;
        let archive = config.retention.archive.clone();
        let archive = archive
            .map(|to| SegmentArchive::new(to, db.path()))
            .transpose()?;
        let app = App::new(Dependencies {
            db,
            clock,
            friction: config.friction,
            storage: config.storage,
            map: config.map,
            normalisations: config.normalisations,
            robots: fleet.robot_link(),
            enrolment: security
                .zip(config.robots.as_ref())
                .map(|(security, robots)| enrolment_service(security, robots)),
            webhooks: config.webhooks,
            people,
            audit: config.audit,
            archive,
            telemetry: Telemetry::start(&config.tracing, "tread-server")?,
            role: standby.clone().map_or(Role::Active, Role::Successor),
        });
        let remembered = remember(&app, &config.site).await;
        remembered.map_err(|error| not_readable(error, &config.database))?;
        let sender = Sender::new(app.webhook_rules().clone(), resolver)?;
        let listener = listen_for_http(config.http)?;
        let http_address = listener.local_addr()?;

        let (uploads, uploads_in) = mpsc::channel(ingest::UPLOADS_WAITING_MAX);
        supervisor.spawn_vital("ingest", ingest::run(app.clone(), uploads_in, stop()));
        let republish_at = config.republish.map(|to| to.router);
        fleet.listen(&app, uploads, republish_at).await?;
        supervisor.spawn_vital("reconciler", reconciler::run(app.clone(), stop()));
        supervisor.spawn_vital("events", events::run(app.clone(), stop()));
        let watching_robots = app::watched::run(app.clone(), stop());
        supervisor.spawn_vital("watched robots", watching_robots);
        spawn_database_tasks(&app, config.retention, &supervisor);
        let sending_map = app::friction::live::run(app.clone(), stop());
        supervisor.spawn_vital("map", sending_map);
        spawn_identity_tasks(&app, &supervisor);
        let backing_up = backups::run(app.clone(), schedule, stop());
        supervisor.spawn_vital("backups", backing_up);
        let sending = app::webhooks::delivery::run(app.clone(), sender, stop());
        supervisor.spawn_vital("webhooks", sending);
        let router = http::router(app.clone(), names);
        if let Some(tls) = &tls {
            let watching = http::tls::watch(Arc::clone(tls), app.clone(), stop());
            supervisor.spawn_vital_unwatched("certificate", watching);
        }
        let scheme = if tls.is_some() { "https" } else { "http" };
        let serving = Serving {
            listener,
            router,
            tls,
            proxies: Arc::new(proxies),
        };
        let serving = http::serve::run(serving, app.clone(), supervisor.clone(), stop());
        supervisor.spawn_vital("http", serving);
        let metrics_address = config
            .metrics
            .map(|address| serve_metrics(address, &app, &supervisor))
            .transpose()?;
        info!("REST API on {scheme}://{http_address}, described at {scheme}://{http_address}/docs");
        app.warn_without_admin().await;
        Ok(RunningServer {
            http_address,
            scheme,
            metrics_address,
            app,
            fleet,
            supervisor,
            lock: taken.lock,
        })
    }
}

/// Serves the metrics; returns the address, with the port that was taken.
///
/// # Errors
/// The address cannot be taken.
fn serve_metrics(
    address: SocketAddr,
    app: &App,
    supervisor: &Supervisor,
) -> anyhow::Result<SocketAddr> {
    let serving = listen_for_metrics(address, app)?;
    let address = serving.listener.local_addr()?;
    let stop = supervisor.stop_token();
    let serving = http::serve::run(serving, app.clone(), supervisor.clone(), stop);
    supervisor.spawn_vital("metrics", serving);
    Ok(address)
}

fn listen_for_metrics(address: SocketAddr, app: &App) -> anyhow::Result<Serving> {
    let listener = http::serve::listen(address)
        .with_context(|| format!("cannot listen for metrics on {address}"))?;
    info!("metrics on http://{}/metrics", listener.local_addr()?);
    Ok(Serving {
        listener,
        router: http::metrics_router(app.clone()),
        tls: None,
        proxies: Arc::default(),
    })
}

/// Opens the database that is locked, and claims it.
///
/// # Errors
/// It cannot be opened, or a standby cannot write to it, or the lock was lost.
async fn open_claimed(config: &Config, lock: &DatabaseLock) -> anyhow::Result<Db> {
    let db = Db::open(&config.database).await?;
    let advertise_url = config.web.advertise_url.as_ref().map(Origin::as_str);
    let claimed = tokio::select! {
        biased;
        reason = lock.lost() => anyhow::bail!("the lock of the database is lost: {reason}"),
        claimed = db.claim(advertise_url) => claimed,
    };
    match claimed {
        // Stop and teleoperation work without the disk, and nobody else takes over.
        Err(error) if !config.standby => {
            warn!("cannot claim the database: {}", error_text::chain(&error));
        }
        claimed => lock.claimed(claimed?),
    }
    Ok(db)
}

/// Ends when another server has the lock of the database, or has claimed it, or at the stop.
async fn hold_lock(lost: impl Future<Output = String>, db: Db, stop: CancellationToken) {
    tokio::select! {
        () = stop.cancelled() => {}
        reason = lost => error!("the lock of the database is lost: {reason}"),
        () = db.taken_over() => error!("another server has taken over the database: this one ends"),
    }
}

/// Returns the schedule of the server's own backups; `None` if it makes none.
fn backup_schedule(config: &Config) -> Option<backups::Schedule> {
    Some(backups::Schedule {
        config: config.backup.clone()?,
        database: config.database.file()?.to_owned(),
        authority: config
            .robots
            .as_ref()
            .map(|robots| robots.authority.clone()),
        reserve_bytes: config.storage.disk_free_min_bytes(),
    })
}

/// Starts the tasks that maintain the database and keep the state in memory consistent with it.
fn spawn_database_tasks(app: &App, retention: RetentionConfig, supervisor: &Supervisor) {
    let stop = || supervisor.stop_token();
    supervisor.spawn_vital("memory", memory::run(app.clone(), stop()));
    supervisor.spawn_vital("checkpoints", checkpoints::run(app.clone(), stop()));
    supervisor.spawn_vital("storage", storage::run(app.clone(), stop()));
    supervisor.spawn_vital("merging", merging::run(app.clone(), stop()));
    supervisor.spawn_vital("sums", sums::run(app.clone(), stop()));
    supervisor.spawn_vital("map blocks", app::map_blocks::run(app.clone(), stop()));
    let removing = retention::run(app.clone(), retention, stop());
    supervisor.spawn_vital("retention", removing);
}

/// Starts the tasks of tokens, sessions, the OpenID provider and the audit log.
fn spawn_identity_tasks(app: &App, supervisor: &Supervisor) {
    let stop = || supervisor.stop_token();
    supervisor.spawn_vital("audit", audit::run(app.clone(), stop()));
    let reading = app::identity::run(app.clone(), READ_AGAIN, stop());
    supervisor.spawn_vital("tokens", reading);
    let finding = app::identity::people::run(app.clone(), stop());
    supervisor.spawn_vital("provider", finding);
}

/// Loads the state in memory from the database; the map may be that of the standby that this process was.
///
/// # Errors
/// The site, robots, map or enrolments cannot be read.
async fn remember(app: &App, site: &SiteId) -> anyhow::Result<()> {
    // A failure only loses the protection against a clock set back; Stop must work all the same.
    if let Err(error) = app.continue_time().await {
        app.log_failure("continue the time of the database", &error);
    }
    app.ensure_site(site).await?;
    app.record_version().await?;
    app.begin_events().await?;
    app.load_restoration().await?;
    app.load_robots().await?;
    if !app.presences().known().is_empty() {
        app.raise_restart_notice();
    }
    if !app.take_over_map().await? {
        app.load_map().await?;
    }
    app.load_enrolments().await?;
    // Without this cache each token is looked up at its first use.
    if let Err(error) = app.load_tokens().await {
        app.log_failure("read the valid tokens", &error);
    }
    Ok(())
}

/// Reads the certificate of the REST API, or has the fleet's authority issue it.
fn open_tls(
    config: &Config,
    authorities: Option<&Arc<Authorities>>,
    clock: &Clock,
) -> anyhow::Result<Option<Arc<Tls>>> {
    let tls = match (&config.tls, authorities) {
        (Some(TlsSource::Files(files)), _) => Some(Tls::load(files.clone())?),
        (Some(TlsSource::Authority), Some(authorities)) => Some(Tls::issued(Issuer {
            authorities: Arc::clone(authorities),
            names: config.certificate_names(),
            clock: clock.clone(),
        })?),
        // The configuration was checked: an authority is there where it issues certificates.
        (Some(TlsSource::Authority) | None, _) => None,
    };
    Ok(tls.map(Arc::new))
}

fn listen_for_http(address: SocketAddr) -> anyhow::Result<TcpListener> {
    http::serve::listen(address).with_context(|| {
        format!(
            "cannot listen for HTTP on {address}: another program has it, or it is no address of \
             this machine; `tread-server doctor` examines the ports"
        )
    })
}

/// Adds to an error of reading the database which file it is, and what to do.
fn not_readable(error: anyhow::Error, database: &Location) -> anyhow::Error {
    let failure = error
        .chain()
        .find_map(|cause| cause.downcast_ref::<DbError>())
        .and_then(DbError::failure);
    let engine = Engine::at(database);
    let advice = failure.map_or("`tread-server doctor --deep` examines it", |failure| {
        engine.advice(failure)
    });
    error.context(format!("cannot read the database `{database}`: {advice}"))
}

fn security(robots: &RobotsConfig) -> anyhow::Result<Security> {
    let authorities = Authorities::load(&robots.authority)?;
    Ok(Security {
        authorities: Arc::new(authorities),
        names: robots.names.clone(),
        robots_per_router: NonZeroUsize::new(robots.robots_per_router.into())
            .unwrap_or(NonZeroUsize::MIN),
    })
}

impl RunningServer {
    /// Returns the address of the REST API.
    pub fn http_address(&self) -> SocketAddr {
        self.http_address
    }

    /// Returns the address of `/metrics`; `None` if it is not configured.
    pub fn metrics_address(&self) -> Option<SocketAddr> {
        self.metrics_address
    }

    /// Returns the zenoh endpoint that robots connect to, such as `tcp/127.0.0.1:7447`.
    pub fn zenoh_endpoint(&self) -> String {
        self.fleet.endpoint()
    }

    /// Returns the use cases, for tests of internal state.
    pub fn app(&self) -> &App {
        &self.app
    }

    /// Tells the service manager that started this process, if any, that the server is ready, and
    /// from then on that it lives, until the stop.
    fn notify_service_manager(&self) {
        if service_manager::is_present() {
            let address = format!("{}://{}", self.scheme, self.http_address);
            let (supervisor, app) = (&self.supervisor, self.app.clone());
            let (liveness, stop) = (supervisor.liveness(), supervisor.stop_token());
            let notifying = service_manager::run(app, address, liveness, stop);
            supervisor.spawn_vital("service manager", notifying);
        }
    }

    /// Waits until a vital task fails or the server is stopped.
    pub async fn failed(&self) {
        self.supervisor.stopping().await;
    }

    /// Stops the server: completes open requests, stores received uploads and their sums, closes
    /// network and database.
    ///
    /// # Errors
    /// A vital task failed before, or tasks did not end within [`supervisor::STOP_TIMEOUT`].
    pub async fn stop(self) -> anyhow::Result<()> {
        let stopped = self.supervisor.stop().await;
        audit::finish(&self.app).await;
        self.app.try_to_write_sums().await;
        let app = self.app.clone();
        // A collector that does not answer must not hold the runtime.
        let _ended = tokio::task::spawn_blocking(move || app.finish_traces()).await;
        self.fleet.close().await;
        self.app.db().close().await;
        self.lock.release().await;
        Ok(stopped?)
    }
}
