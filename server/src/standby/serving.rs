//! What a standby does while it waits for the database: it follows the map, answers from it, and forwards all
//! other requests to the server that has the database ([`crate::http::standby`]).

use std::panic::AssertUnwindSafe;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::Context as _;
use futures_util::FutureExt as _;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::app::identity::READ_AGAIN_BY_STANDBY;
use crate::app::identity::people::People;
use crate::app::robot_link::RobotLink;
use crate::app::{App, Dependencies, Role, following, identity, map_blocks};
use crate::authority::Authorities;
use crate::clock::Clock;
use crate::config::{Config, TlsSource};
use crate::db::{self, Db};
use crate::http;
use crate::http::forward::Forwarder;
use crate::http::forward_body::EndTokens;
use crate::http::serve::Serving;
use crate::identity::address::TrustedProxies;
use crate::supervisor::{Stopped, Supervisor};
use crate::{listen_for_http, listen_for_metrics, open_tls};

/// Interval at which a standby that reads the map looks which server has the database.
const LEADER_REFRESH_INTERVAL: Duration = Duration::from_millis(500);
/// Delay after a failure.
const RETRY: Duration = Duration::from_secs(2);

/// The tasks of a standby that answers requests.
#[derive(Debug)]
pub(crate) struct StandbyServing {
    tasks: JoinSet<()>,
    tokens: EndTokens,
    shown: Arc<Mutex<ServingState>>,
}

/// What others see of it while it answers requests.
#[derive(Debug, Default)]
struct ServingState {
    /// The use cases, once they have the map.
    with_map: Option<App>,
    /// Of the connections that were accepted.
    supervisor: Option<Supervisor>,
}

impl StandbyServing {
    /// Begins to answer requests; tries again as long as that fails.
    pub(crate) fn start(config: Config, clock: Clock) -> Self {
        let (tokens, shown) = (EndTokens::default(), Arc::default());
        let mut tasks = JoinSet::new();
        tasks.spawn(serve(config, clock, tokens.clone(), Arc::clone(&shown)));
        Self {
            tasks,
            tokens,
            shown,
        }
    }

    /// Stops listening, frees the addresses, and ends the open requests. Returns the app with the map, if the
    /// map was read.
    pub(crate) async fn end(mut self) -> Option<App> {
        self.tokens.given_up.cancel();
        self.tokens.stop.cancel();
        // A panic has been logged, and frees the addresses too.
        let _ = self.tasks.join_next().await;
        lock(&self.shown).with_map.take()
    }

    /// Accepts no further connections, and completes open requests.
    ///
    /// # Errors
    /// A task failed, or they take too long.
    pub(crate) async fn stop(mut self) -> Result<(), Stopped> {
        self.tokens.stop.cancel();
        // A panic has been logged.
        let _ = self.tasks.join_next().await;
        let supervisor = lock(&self.shown).supervisor.take();
        match supervisor {
            Some(supervisor) => supervisor.stop().await,
            None => Ok(()),
        }
    }
}

fn lock(shown: &Mutex<ServingState>) -> MutexGuard<'_, ServingState> {
    shown.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Answers requests until the stop.
async fn serve(
    config: Config,
    clock: Clock,
    EndTokens { stop, given_up }: EndTokens,
    shown: Arc<Mutex<ServingState>>,
) {
    let mut logged = String::new();
    loop {
        let tokens = EndTokens {
            stop: stop.clone(),
            given_up: given_up.child_token(),
        };
        let serving = serve_once(&config, &clock, &tokens, &shown);
        let served = AssertUnwindSafe(serving).catch_unwind().await;
        if !stop.is_cancelled() {
            tokens.given_up.cancel();
        }
        let reason = match served {
            Ok(Ok(())) if stop.is_cancelled() => return,
            Ok(Ok(())) => {
                info!(
                    "standby: another server has the database now, or segments are missing: it begins anew"
                );
                lock(&shown).with_map.take();
                continue;
            }
            Ok(Err(error)) => format!("{error:#}"),
            Err(_panic) => "it panicked".to_owned(),
        };
        lock(&shown).with_map.take();
        if reason != logged {
            warn!("standby: it answers no requests: {reason}");
            logged = reason;
        }
        tokio::select! {
            biased;
            () = stop.cancelled() => return,
            () = tokio::time::sleep(RETRY) => {}
        }
    }
}

/// Answers requests until the stop, or until it has to begin anew.
///
/// # Errors
/// It cannot begin, or a task has failed.
async fn serve_once(
    config: &Config,
    clock: &Clock,
    EndTokens { stop, given_up }: &EndTokens,
    shown: &Mutex<ServingState>,
) -> anyhow::Result<()> {
    let supervisor = Supervisor::new();
    lock(shown).supervisor = Some(supervisor.clone());
    // Connections end by themselves then.
    let _ending = supervisor.stop_token().drop_guard();
    let serving = serve_with(config, clock, (&supervisor, given_up), shown);
    tokio::select! {
        biased;
        () = stop.cancelled() => Ok(()),
        served = serving => served,
    }
}

async fn serve_with(
    config: &Config,
    clock: &Clock,
    (supervisor, given_up): (&Supervisor, &CancellationToken),
    shown: &Mutex<ServingState>,
) -> anyhow::Result<()> {
    let db = Db::open_to_read(&config.database).await?;
    let db = db.context("a file has one server")?;
    let authorities = config.robots.as_ref();
    let authorities = authorities.map(|robots| Authorities::read(&robots.authority));
    let authorities = authorities.transpose()?.map(Arc::new);
    let tls = open_tls(config, authorities.as_ref(), clock)?;
    let forwarder = Forwarder::new(trusted(config)?.as_deref(), given_up.clone())?;
    // Requests are forwarded while the map is read, which takes long.
    let listener = listen_for_http(config.http)?;
    let address = listener.local_addr()?;
    let people = config.oidc.as_ref();
    let people = people.map(|oidc| People::new(oidc, clock.clone()));
    let app = App::new(Dependencies {
        friction: config.friction,
        normalisations: config.normalisations.clone(),
        map: config.map,
        robots: RobotLink::unconnected(supervisor.clone()),
        people: people.transpose()?,
        role: Role::Standby,
        ..Dependencies::on_database(db, clock.clone())
    });
    let metrics = config.metrics;
    let metrics = metrics.map(|address| listen_for_metrics(address, &app));
    let metrics = metrics.transpose()?;
    db::limited(app.load_leader()).await?;
    let scheme = if tls.is_some() { "https" } else { "http" };
    let serving = Serving {
        listener,
        router: http::standby::router(app.clone(), config.names(), forwarder.clone()),
        tls: tls.clone(),
        proxies: Arc::new(TrustedProxies::new(config.web.trusted_proxies.clone())),
    };
    let stop = || supervisor.stop_token();
    let run = |serving| http::serve::run(serving, app.clone(), supervisor.clone(), stop());
    if let Some(tls) = tls {
        let stop = stop();
        let keeping = async move { http::tls::reload_periodically(&tls, stop, |_tls| {}).await };
        supervisor.spawn_vital_unwatched("certificate", keeping);
    }
    let of_other = config.clone();
    let renew = move |forwarder: &Forwarder| {
        let trusted = trusted(&of_other)?;
        Ok(forwarder.renew(trusted.as_deref())?)
    };
    let checking = http::forward::run(forwarder, app.clone(), renew, stop());
    supervisor.spawn_vital_unwatched("other server", checking);
    info!("standby: answers on {scheme}://{address}");
    if config.web.advertise_url.is_none() {
        warn!(
            "standby: no `[web] advertise_url`: after it has taken over, other standbys cannot forward to it"
        );
    }
    let serving_metrics = async {
        match metrics {
            Some(metrics) => run(metrics).await,
            None => std::future::pending().await,
        }
    };
    tokio::select! {
        biased;
        () = supervisor.stopping() => {}
        () = run(serving) => {}
        () = serving_metrics => {}
        followed = follow(&app, supervisor, shown) => return followed,
    }
    anyhow::bail!("a task of the standby has ended")
}

/// Reads the map and follows the database, until the map has to be read as a whole again, or the stop.
///
/// # Errors
/// The map cannot be read.
async fn follow(
    app: &App,
    supervisor: &Supervisor,
    shown: &Mutex<ServingState>,
) -> anyhow::Result<()> {
    tokio::select! {
        loaded = app.load_map() => loaded?,
        () = refresh_leader(app) => {}
    }
    lock(shown).with_map = Some(app.clone());
    if let Err(error) = app.load_tokens().await {
        app.log_failure("read the valid tokens", &error);
    }
    let stop = || supervisor.stop_token();
    supervisor.spawn_vital("map blocks", map_blocks::run(app.clone(), stop()));
    let reading = identity::run(app.clone(), READ_AGAIN_BY_STANDBY, stop());
    supervisor.spawn_vital("tokens", reading);
    info!("standby: it has the map");
    following::run(app.clone(), stop()).await;
    Ok(())
}

/// Reads again and again which server has the database, while the map is read. Returns never.
async fn refresh_leader(app: &App) {
    loop {
        tokio::time::sleep(LEADER_REFRESH_INTERVAL).await;
        if let Err(cause) = db::limited(app.load_leader()).await {
            app.log_failure("read which server has the database", &cause);
        }
    }
}

/// Reads the CA certificates (PEM) by which the server that has the database is recognised; `None` for those
/// of the machine.
fn trusted(config: &Config) -> anyhow::Result<Option<Vec<u8>>> {
    if let Some(file) = &config.web.advertise_authorities {
        let read = std::fs::read(file);
        let file = file.display();
        return Ok(Some(read.with_context(|| {
            format!("cannot read `advertise_authorities`, `{file}`")
        })?));
    }
    match (&config.tls, &config.robots) {
        (Some(TlsSource::Authority), Some(robots)) => {
            let authorities = Authorities::read(&robots.authority)?;
            Ok(Some(authorities.present().bundle_pem().into_bytes()))
        }
        _ => Ok(None),
    }
}
