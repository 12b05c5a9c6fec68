//! Tread's server: takes missions over REST, hands them to robots over zenoh, keeps what the
//! robots measure, and gives it back.
//!
//! * [`http`] knows HTTP and no SQL; [`app`] holds the use cases; [`db`] knows SQL and decides
//!   nothing; [`fleet`] is the only module that calls zenoh, [`oidc`] the only one that asks the OpenID
//!   provider; [`friction`] is pure.
//! * [`Server::start`] runs everything inside a program of one's own; [`run_from_args`] is
//!   the whole program, until a signal.

pub mod app;
pub mod authority;
pub mod clock;
pub mod config;
pub mod connections;
pub mod counters;
pub mod db;
pub mod fleet;
pub mod formats;
pub mod friction;
pub mod http;
pub mod identity;
mod init;
mod logging;
pub mod metrics;
pub mod oidc;
mod rate_limit;
pub mod supervisor;

use std::ffi::OsString;
use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use clap::Parser as _;
use jiff::SignedDuration;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tracing::{info, warn};
use tread_api::ids::SiteId;
use tread_api::startup::give_zenoh_threads;

use self::app::enrolment::EnrolmentService;
use self::app::identity::audit;
use self::app::{
    App, Dependencies, checkpoints, events, ingest, memory, merging, reconciler, retention, storage,
};
use self::authority::Authorities;
use self::clock::Clock;
use self::config::RobotsConfig;
pub use self::config::{Config, ServerArgs};
use self::db::Db;
use self::db::lock::DatabaseLock;
use self::fleet::{Fleet, Security};
use self::http::serve::Serving;
use self::http::tls::Tls;
use self::identity::address::TrustedProxies;
use self::supervisor::Supervisor;

/// How long threads that block may take after everything else has stopped.
const RUNTIME_STOP_TIMEOUT: Duration = Duration::from_secs(2);

/// Builds servers.
#[derive(Debug, Clone, Copy)]
pub struct Server;

/// A server at work.
#[derive(Debug)]
pub struct RunningServer {
    http_address: SocketAddr,
    metrics_address: Option<SocketAddr>,
    app: App,
    fleet: Fleet,
    supervisor: Supervisor,
    lock: DatabaseLock,
}

impl Server {
    /// Starts a server on the machine's clock. Needs a multi-threaded tokio runtime.
    ///
    /// # Errors
    /// The database cannot be opened, or an address is in use.
    pub async fn start(config: Config) -> anyhow::Result<RunningServer> {
        Self::start_with_clock(config, Clock::system()).await
    }

    /// Starts a server on a clock of one's own.
    ///
    /// # Errors
    /// As [`Server::start`].
    pub async fn start_with_clock(config: Config, clock: Clock) -> anyhow::Result<RunningServer> {
        let names = config.names();
        let proxies = TrustedProxies::new(config.web.trusted_proxies.clone());
        let tls = config.tls.map(Tls::load).transpose()?.map(Arc::new);
        let lock = DatabaseLock::take(&config.database)?;
        // Not before: a rotation that was cut short is completed here, by one server alone.
        let security = config.robots.as_ref().map(security).transpose()?;
        let db = Db::open(&config.database).await?;
        let supervisor = Supervisor::new();
        let stop = || supervisor.stop_token();
        let (of_fleet, fleet_clock) = (security.clone(), clock.clone());
        let fleet = Fleet::open(config.zenoh, of_fleet, fleet_clock, supervisor.clone())?;
        let enrolment_service = |security: Security, robots: &RobotsConfig| EnrolmentService {
            authorities: security.authorities,
            lifetime: SignedDuration::from_secs(robots.certificate_s.into()),
            port: fleet.address().port(),
        };
        let app = App::new(Dependencies {
            db,
            clock,
            friction: config.friction,
            storage: config.storage,
            normalisations: config.normalisations,
            robots: fleet.robot_link(),
            enrolment: security
                .zip(config.robots.as_ref())
                .map(|(security, robots)| enrolment_service(security, robots)),
        });
        app.log_audit(config.audit.log);
        if let Some(oidc) = &config.oidc {
            app.admit_people(oidc)?;
        }
        remember(&app, &config.site).await?;
        let listener = http::serve::listen(config.http)
            .with_context(|| format!("cannot listen for HTTP on {}", config.http))?;
        let http_address = listener.local_addr()?;

        let (uploads, uploads_in) = mpsc::channel(ingest::UPLOADS_WAITING_MAX);
        supervisor.spawn_vital("ingest", ingest::run(app.clone(), uploads_in, stop()));
        fleet.listen(&app, uploads).await?;
        supervisor.spawn_vital("reconciler", reconciler::run(app.clone(), stop()));
        supervisor.spawn_vital("events", events::run(app.clone(), stop()));
        look_after_database(&app, &supervisor);
        let telling = app::friction::live::run(app.clone(), stop());
        supervisor.spawn_vital("map", telling);
        let removing = retention::run(app.clone(), config.retention, stop());
        supervisor.spawn_vital("retention", removing);
        supervisor.spawn_vital("audit", audit::run(app.clone(), stop()));
        supervisor.spawn_vital("tokens", app::identity::run(app.clone(), stop()));
        let finding = app::identity::people::run(app.clone(), stop());
        supervisor.spawn_vital("provider", finding);
        let router = http::router(app.clone(), names);
        if let Some(tls) = &tls {
            supervisor.spawn_vital("certificate", http::tls::watch(Arc::clone(tls), stop()));
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
        let mut metrics_address = None;
        if let Some(address) = config.metrics {
            let listener = http::serve::listen(address)
                .with_context(|| format!("cannot listen for metrics on {address}"))?;
            let address = listener.local_addr()?;
            metrics_address = Some(address);
            let serving = Serving {
                listener,
                router: http::metrics_router(app.clone()),
                tls: None,
                proxies: Arc::default(),
            };
            let serving = http::serve::run(serving, app.clone(), supervisor.clone(), stop());
            supervisor.spawn_vital("metrics", serving);
            info!("metrics on http://{address}/metrics");
        }
        info!("REST API on {scheme}://{http_address}, described at {scheme}://{http_address}/docs");
        if app.admin_count().await? == 0 {
            warn!("nobody can sign in yet: make the first admin's token with `tread-server init`");
        }
        Ok(RunningServer {
            http_address,
            metrics_address,
            app,
            fleet,
            supervisor,
            lock,
        })
    }
}

/// Starts what keeps the database in order, and memory true to it.
fn look_after_database(app: &App, supervisor: &Supervisor) {
    let stop = || supervisor.stop_token();
    supervisor.spawn_vital("memory", memory::run(app.clone(), stop()));
    supervisor.spawn_vital("checkpoints", checkpoints::run(app.clone(), stop()));
    supervisor.spawn_vital("storage", storage::run(app.clone(), stop()));
    supervisor.spawn_vital("merging", merging::run(app.clone(), stop()));
}

/// Reads what the server keeps in memory.
async fn remember(app: &App, site: &SiteId) -> anyhow::Result<()> {
    // With a damaged table robots can still be stopped; only a clock that was set back shows.
    if let Err(error) = app.continue_time().await {
        app.log_failure("continue the time of the database", &error);
    }
    app.ensure_site(site).await?;
    app.know_robots().await?;
    app.load_map().await?;
    app.know_enrolments().await?;
    // Without it each token is looked up when it is shown.
    if let Err(error) = app.know_tokens().await {
        app.log_failure("read the valid tokens", &error);
    }
    Ok(())
}

fn security(robots: &RobotsConfig) -> anyhow::Result<Security> {
    let authorities = Authorities::load(&robots.authority)?;
    Ok(Security {
        authorities: Arc::new(authorities),
        names: robots.names.clone(),
    })
}

impl RunningServer {
    /// Where the REST API listens.
    pub fn http_address(&self) -> SocketAddr {
        self.http_address
    }

    /// Where the metrics are, if anywhere.
    pub fn metrics_address(&self) -> Option<SocketAddr> {
        self.metrics_address
    }

    /// The endpoint that robots connect to, as zenoh writes it.
    pub fn zenoh_endpoint(&self) -> String {
        self.fleet.endpoint()
    }

    /// The use cases, for tests that look behind the API.
    pub fn app(&self) -> &App {
        &self.app
    }

    /// Waits until a vital task fails.
    pub async fn failed(&self) {
        self.supervisor.stopping().await;
    }

    /// Stops: finishes open requests, stores what was uploaded, closes network and database.
    ///
    /// # Errors
    /// A vital task had failed, or tasks did not end in time.
    pub async fn stop(self) -> anyhow::Result<()> {
        let stopped = self.supervisor.stop().await;
        audit::finish(&self.app).await;
        self.fleet.close().await;
        self.app.db().close().await;
        drop(self.lock);
        Ok(stopped?)
    }
}

/// Tread's server: missions to robots, friction from robots, one REST API.
#[derive(Debug, clap::Parser)]
#[command(name = "tread-server", version, args_conflicts_with_subcommands = true)]
struct Command {
    #[command(subcommand)]
    action: Option<Action>,
    #[command(flatten)]
    server: ServerArgs,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Make the first admin's token of a server, and tell it this once
    Init(init::InitArgs),
    /// Take the next certificate that each robot shows, as after a backup of the database was restored
    ForgetCertificates(init::ForgetArgs),
}

/// The words of the program's command line.
pub fn command_line() -> clap::Command {
    <Command as clap::CommandFactory>::command()
}

/// The whole program with these arguments, the first of which is its name.
///
/// Says on standard error what went wrong, and gives the code to end with: 0 after a stop that
/// was asked for, 1 after a failure, 2 for arguments that make no sense.
pub fn run_from_args(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let command = match Command::try_parse_from(arguments) {
        Ok(command) => command,
        Err(error) => {
            // Help and version come this way too; without a terminal there is nobody to tell.
            let _ = error.print();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    let ended = match command.action {
        Some(Action::Init(args)) => run_beside_server(init::run(args)),
        Some(Action::ForgetCertificates(args)) => run_beside_server(init::forget(args)),
        None => run(&command.server),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Lets the process have as many connections open as the machine allows: the usual soft limit is
/// below the bounds of the accept loop.
fn raise_file_limit() {
    let raised = getrlimit(Resource::RLIMIT_NOFILE)
        .and_then(|(_, most)| setrlimit(Resource::RLIMIT_NOFILE, most, most));
    if let Err(error) = raised {
        warn!("cannot raise the limit of open files: {error}");
    }
}

fn run_beside_server(command: impl Future<Output = anyhow::Result<()>>) -> anyhow::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    runtime.block_on(command)
}

/// The whole program: configuration, logging, server, until a signal or a failure.
///
/// # Errors
/// What keeps the server from starting, or what stopped it.
pub fn run(args: &ServerArgs) -> anyhow::Result<()> {
    let threads = give_zenoh_threads();
    logging::start(args)?;
    if let Err(cause) = threads {
        warn!("zenoh has few threads, robots may be mute for seconds after a cut: {cause}");
    }
    let config = Config::load(args)?;
    raise_file_limit();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let ended = runtime.block_on(async {
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        let server = Server::start(config).await?;
        tokio::select! {
            _ = terminate.recv() => info!("asked to stop"),
            _ = interrupt.recv() => info!("asked to stop"),
            () = server.failed() => {}
        }
        server.stop().await
    });
    // A thread that is stuck in the network must not keep the process from ending.
    runtime.shutdown_timeout(RUNTIME_STOP_TIMEOUT);
    ended
}
