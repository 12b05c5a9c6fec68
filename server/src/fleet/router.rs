//! Watches the routers that robots connect to: a client queries each, as a robot would, and if several
//! queries fail the router is closed and opened again.
//!
//! A router may stop accepting connections without any error, which only a client can detect.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::join_all;
use tokio_util::sync::CancellationToken;
use tracing::{error, warn};
use tread_api::tunnel::RouterCredentials;
use zenoh::Wait as _;

use super::client::client_config;
use super::probe::PROBE_KEY;
use super::router_groups::{to_open, to_reopen};
use super::router_pool::{RouterPool, robots_on};
use super::routers::Router;
use crate::app::presence::RobotKey;
use crate::supervisor::Supervisor;

/// Interval between two probes.
pub(super) const PROBE_PERIOD: Duration = Duration::from_secs(10);
/// Maximum time for one probe, with its connection.
const PROBE_TIMEOUT: Duration = Duration::from_secs(3);
/// Number of consecutive failed probes after which the router is opened again.
const FAILURES_MAX: u32 = 3;

/// State of the watch.
pub(super) struct Watch {
    pub(super) pool: Arc<RouterPool>,
    pub(super) supervisor: Supervisor,
    /// Interval between two probes.
    pub(super) period: Duration,
    pub(super) stop: CancellationToken,
}

/// Probes the routers that robots connect to, until the stop.
pub(super) async fn watch(watch: Watch) {
    // Numbers of consecutive failures, by the number of the router; `None` without any router.
    let mut failures: HashMap<Option<u64>, u32> = HashMap::new();
    loop {
        tokio::select! {
            biased;
            () = watch.stop.cancelled() => return,
            () = tokio::time::sleep(watch.period) => {}
        }
        let current = watch.pool.current();
        let numbers: Vec<u64> = current.iter().map(|router| router.number).collect();
        failures.retain(|of, _| of.map_or(numbers.is_empty(), |number| numbers.contains(&number)));
        let mut silent = Vec::new();
        if current.is_empty() {
            silent.push(None);
        }
        // All at once: one that does not answer takes seconds.
        let probed = current.into_iter().map(async |router| {
            let answers = answers(&watch, &router).await;
            (router, answers)
        });
        for (router, answers) in join_all(probed).await {
            if answers {
                failures.remove(&Some(router.number));
            } else {
                silent.push(Some(router));
            }
        }
        for router in silent {
            let number = router.as_ref().map(|router| router.number);
            let failures = failures.entry(number).or_default();
            *failures += 1;
            watch.pool.app.counters().router_probes_failed.one();
            let robots = router.as_ref().map_or(0, |router| router.robots.len());
            warn!(
                router = number,
                robots, "the zenoh router did not answer, {failures} of {FAILURES_MAX} times"
            );
            if *failures >= FAILURES_MAX && !watch.stop.is_cancelled() {
                *failures = 0;
                reopen(&watch.pool, router.as_ref()).await;
            }
        }
    }
}

async fn answers(watch: &Watch, router: &Arc<Router>) -> bool {
    let router = Arc::clone(router);
    let credentials = router.credentials.as_ref();
    let credentials = credentials.map(|derivation| derivation.of_probe());
    let looking = watch
        .supervisor
        .blocking(move || probe(&router, credentials.as_ref()));
    let looked = tokio::time::timeout(2 * PROBE_TIMEOUT, looking).await;
    matches!(looked, Ok(Some(true)))
}

/// Replaces a router that does not answer. A router that still has robots stays open. With a gate, the
/// new router is opened at once and the old one closes when its robots have left; without a gate,
/// there is only one address, so the new router is opened when the old one has no robots.
async fn reopen(pool: &RouterPool, former: Option<&Arc<Router>>) {
    let _turn = pool.turn.lock().await;
    let current = pool.current();
    let robots_max = pool.opener.robots_max;
    let fleet = pool.app.enrolment_registry().robots();
    let mut robots = to_open(&[], &fleet, robots_max).unwrap_or_default();
    if let Some(former) = former {
        // It was superseded since it was probed.
        if current.iter().all(|router| router.number != former.number) {
            return;
        }
        let newer = current
            .iter()
            .filter(|router| router.number > former.number);
        let newer: Vec<&HashSet<RobotKey>> = newer.map(|router| &router.robots).collect();
        robots = to_reopen(&former.robots, &newer, robots_max);
        let robot_count = robots_on(former).await;
        let is_behind_gate = former.credentials.is_some();
        if robot_count == 0 {
            pool.close(former.number).await;
        } else if !is_behind_gate {
            error!("the zenoh router takes no connections; it stays for {robot_count} robots");
            return;
        }
    }
    match pool.open(robots.into_iter().collect()).await {
        Ok(()) => {
            pool.app.counters().router_reopened.one();
            warn!("the zenoh router was opened again");
        }
        // There is no router now, so the next probes fail too and this is repeated.
        Err(failed) => error!("cannot open the zenoh router again: {failed}"),
    }
}

/// Queries the router over a connection of its own; returns whether it answered. Blocks its thread.
fn probe(router: &Router, credentials: Option<&RouterCredentials>) -> bool {
    let query = || -> zenoh::Result<bool> {
        let config = client_config(router.address, credentials, PROBE_TIMEOUT.as_millis())?;
        let session = zenoh::open(config).wait()?;
        let replies = session.get(PROBE_KEY).timeout(PROBE_TIMEOUT).wait()?;
        let answered = replies.recv().is_ok_and(|reply| reply.result().is_ok());
        session.close().wait()?;
        Ok(answered)
    };
    query().unwrap_or(false)
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, SocketAddr};
    use std::sync::atomic::AtomicU64;

    use tokio::sync::{Mutex, mpsc};
    use zenoh::Wait as _;

    use super::super::Fleet;
    use super::super::inbox::Channels;
    use super::super::opening::{Opener, with_free_port};
    use super::*;
    use crate::app::App;
    use crate::authority::{Authorities, Authority};
    use crate::clock::Clock;
    use crate::config::{FrictionConfig, StorageConfig};
    use crate::db::Db;

    const PATIENCE: Duration = Duration::from_secs(30);

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_router_that_carries_robots_is_not_closed_for_another() {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&folder.path().join("tread.db")).await.unwrap();
        let clock = Clock::system();
        let app = App::without_robots(
            db,
            clock.clone(),
            FrictionConfig::default(),
            StorageConfig::default(),
        );
        let supervisor = Supervisor::new();
        let authority = Authority::generate("fleet", clock.now()).unwrap();
        // Their channels must outlive the tasks that read them.
        let mut pools = Vec::new();
        for authorities in [None, Some(Authorities::in_memory(Arc::new(authority)))] {
            let is_behind_gate = authorities.is_some();
            let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
            let (uploads, _uploads_in) = mpsc::channel(1);
            let pool = RouterPool {
                app: app.clone(),
                routers: Arc::default(),
                opener: Opener {
                    address: with_free_port(address).unwrap(),
                    authorities: authorities.map(Arc::new),
                    robots_max: 256,
                    supervisor: supervisor.clone(),
                    next: AtomicU64::new(0),
                },
                channels: Channels::new(&supervisor, &app, uploads, None, None),
                turn: Mutex::new(()),
            };
            pool.open(Vec::new()).await.unwrap();
            let router = pool.routers.newest().unwrap();
            let credentials = router.credentials.as_ref().map(|it| it.of_probe());
            let config = client_config(router.address, credentials.as_ref(), 5_000).unwrap();
            let opening = tokio::task::spawn_blocking(move || zenoh::open(config).wait());
            let robot = opening.await.unwrap().unwrap();
            assert_eq!(robots_on(&router).await, 1);
            reopen(&pool, Some(&router)).await;
            assert_eq!(robots_on(&router).await, 1, "it carries on");
            let open = pool.routers.all().len();
            assert_eq!(open, 1 + usize::from(is_behind_gate));
            tokio::task::spawn_blocking(move || robot.close().wait())
                .await
                .unwrap()
                .unwrap();
            while robots_on(&router).await > 0 {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
            // Without a gate it is opened again; behind one it is superseded, and closed now.
            reopen(&pool, Some(&router)).await;
            pool.close_idle().await;
            let numbers = pool.routers.all();
            assert!(numbers.iter().all(|open| open.number != router.number));
            for router in pool.routers.all() {
                pool.close(router.number).await;
            }
            pools.push(pool);
        }
        supervisor.stop().await.unwrap();
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn a_router_that_no_longer_answers_is_opened_again_and_takes_robots() {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&folder.path().join("tread.db")).await.unwrap();
        let app = App::without_robots(
            db,
            Clock::system(),
            FrictionConfig::default(),
            StorageConfig::default(),
        );
        let supervisor = Supervisor::new();
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let opening = Fleet::open(address, None, Clock::system(), supervisor.clone());
        let mut fleet = opening.unwrap();
        fleet.probe_period = Duration::from_millis(50);
        let (uploads, _uploads_in) = mpsc::channel(1);
        fleet.listen(&app, uploads, None).await.unwrap();
        let answers = async |wanted: bool| {
            let looking = async {
                loop {
                    let router = fleet.routers.newest();
                    let looked = tokio::task::spawn_blocking(move || {
                        router.is_some_and(|router| probe(&router, None))
                    });
                    if looked.await.unwrap() == wanted {
                        return;
                    }
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
            };
            tokio::time::timeout(PATIENCE, looking).await.unwrap();
        };
        answers(true).await;
        assert_eq!(app.counters().router_reopened.get(), 0);
        let session = fleet.routers.newest().unwrap().session.clone();
        tokio::task::spawn_blocking(move || session.close().wait())
            .await
            .unwrap()
            .unwrap();
        let reopened = async {
            while app.counters().router_reopened.get() == 0 {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        tokio::time::timeout(PATIENCE, reopened).await.unwrap();
        assert!(app.counters().router_probes_failed.get() >= u64::from(FAILURES_MAX));
        answers(true).await;
        supervisor.stop().await.unwrap();
        fleet.close().await;
    }
}
