//! What states of many robots cost, over what a bare zenoh router needs for the same sessions and
//! messages.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use serde::Serialize;
use tempfile::TempDir;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, sleep};
use tread_api::ids::SiteId;
use tread_api::wire::hello::Welcome;
use tread_lab::report::Table;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::LightRobot;
use tread_tests::ports::free_address;
use tread_tests::process::{Process, Usage};
use tread_tests::report::{Check, figure};

use crate::dispatch::{self, Dispatch};
use crate::{Arguments, batches, light_id, period_of, start_fleet, start_light_robots};

/// Robots, and states of each per second.
const FLEETS: [(u32, f64); 2] = [(1_000, 10.0), (5_000, 2.0)];
/// Robots of the largest fleet that gets certificates without `--tls`: 5 000 robots take minutes to join.
const CERTIFICATES_MAX: u32 = 1_000;
/// Files that this program opens for each robot with a certificate: three connections and the port of its
/// tunnel.
const FILES_OF_ROBOT: u64 = 4;
/// Files that it opens besides.
const FILES_BESIDES: u64 = 300;
/// Processor time for each state over that of the bare router, at the most, microseconds.
const OVER_ROUTER_MAX_US: f64 = 25.0;
/// Memory over that of the bare router, at the most, MB.
const OVER_ROUTER_MAX_MB: f64 = 100.0;
/// 99 % of the missions that are sent meanwhile move the wheels within this, milliseconds.
const DISPATCH_P99_MAX_MS: f64 = 25.0;
/// Time for which robots publish before the measurement, so that what connecting costs is over.
const SETTLING: Duration = Duration::from_secs(5);

/// What one server, or a router alone, used.
#[derive(Debug, Serialize)]
pub(crate) struct ResourceUsage {
    states_per_second: f64,
    cpu_us_per_state: f64,
    memory_peak_mb: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    dispatch: Option<Dispatch>,
}

impl ResourceUsage {
    fn words(&self) -> String {
        format!(
            "{:.0} states/s, {:.1} us CPU each, {:.0} MB",
            self.states_per_second, self.cpu_us_per_state, self.memory_peak_mb
        )
    }
}

/// What was measured of a fleet.
#[derive(Debug, Serialize)]
pub(crate) struct FleetMeasurement {
    robots: u32,
    state_rate_hz: f64,
    router: ResourceUsage,
    server: ResourceUsage,
    /// The same with certificates.
    #[serde(skip_serializing_if = "Option::is_none")]
    tls: Option<WithCertificates>,
}

/// What was measured of a fleet with certificates.
#[derive(Debug, Serialize)]
struct WithCertificates {
    /// Robots, fewer than those without certificates if the limit of open files allows no more.
    robots: u32,
    #[serde(flatten)]
    used: ResourceUsage,
}

/// What was measured.
#[derive(Debug, Serialize)]
pub(crate) struct States {
    fleets: Vec<FleetMeasurement>,
}

pub(crate) async fn measure(arguments: &Arguments, node: &Path) -> anyhow::Result<States> {
    let mut fleets = Vec::new();
    for (robots, state_rate_hz) in FLEETS {
        let period = period_of(state_rate_hz);
        let seconds = arguments.seconds;
        let say = |what: &str, used: &ResourceUsage| {
            eprintln!(
                "{robots} robots at {state_rate_hz} Hz: {what}: {}",
                used.words()
            );
        };
        let router = bare_router(node, (robots, period), seconds).await?;
        say("a router alone", &router);
        let mut fleet = start_fleet(node, false).await;
        let light = start_light_robots(&fleet, robots, false).await?;
        let publishing = publish(light, period);
        let mut server = used(|| fleet.server_usage(), &publishing, seconds).await?;
        say("the server", &server);
        let dispatch = dispatch::send_missions(arguments, &mut fleet, None).await?;
        eprintln!(
            "{robots} robots at {state_rate_hz} Hz: {}",
            dispatch.words()
        );
        server.dispatch = Some(dispatch);
        drop((publishing, fleet));
        let mut tls = None;
        if arguments.tls || robots <= CERTIFICATES_MAX {
            let robots = robots.min(certificates_max()?);
            let fleet = start_fleet(node, true).await;
            let begin = Instant::now();
            let light = start_light_robots(&fleet, robots, true).await?;
            let joined_s = begin.elapsed().as_secs_f64();
            let publishing = publish(light, period);
            let used = used(|| fleet.server_usage(), &publishing, seconds).await?;
            let what = format!("the server, {robots} with certificates, joined in {joined_s:.0} s");
            say(&what, &used);
            tls = Some(WithCertificates { robots, used });
        }
        fleets.push(FleetMeasurement {
            robots,
            state_rate_hz,
            router,
            server,
            tls,
        });
    }
    Ok(States { fleets })
}

/// Returns the largest number of robots with certificates for which this process may open its files.
fn certificates_max() -> anyhow::Result<u32> {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, most, most)?;
    let robots = most.saturating_sub(FILES_BESIDES) / FILES_OF_ROBOT;
    Ok(u32::try_from(robots).unwrap_or(u32::MAX))
}

/// Robots that publish until this is dropped.
pub(crate) struct PublishGuard {
    published: Arc<AtomicU64>,
    _tasks: JoinSet<()>,
}

/// Lets robots publish their states, evenly spread over the period.
pub(crate) fn publish(robots: Vec<LightRobot>, period: Duration) -> PublishGuard {
    let published = Arc::new(AtomicU64::new(0));
    let mut tasks = JoinSet::new();
    let (begin, count) = (Instant::now(), robots.len().max(1));
    for (index, mut robot) in robots.into_iter().enumerate() {
        let first = begin + period.mul_f64(figure(index as u64) / figure(count as u64));
        let published = Arc::clone(&published);
        tasks.spawn(async move {
            let mut states = tokio::time::interval_at(first, period);
            states.set_missed_tick_behavior(MissedTickBehavior::Skip);
            loop {
                states.tick().await;
                if robot.publish_state().await.is_err() {
                    return;
                }
                published.fetch_add(1, Ordering::Relaxed);
            }
        });
    }
    PublishGuard {
        published,
        _tasks: tasks,
    }
}

/// Measures a process while robots publish to it.
async fn used(
    usage: impl Fn() -> Option<Usage>,
    publishing: &PublishGuard,
    seconds: u64,
) -> anyhow::Result<ResourceUsage> {
    let usage = || usage().context("the process that was measured is gone");
    sleep(SETTLING).await;
    let (before, published) = (usage()?, publishing.published.load(Ordering::Relaxed));
    let begin = Instant::now();
    sleep(Duration::from_secs(seconds)).await;
    let (after, took) = (usage()?, begin.elapsed().as_secs_f64());
    let states = figure(publishing.published.load(Ordering::Relaxed) - published);
    Ok(ResourceUsage {
        states_per_second: states / took,
        cpu_us_per_state: 1e6 * (after.cpu_s - before.cpu_s) / states.max(1.0),
        memory_peak_mb: figure(after.memory_peak_bytes) / 1e6,
        dispatch: None,
    })
}

/// A running router without a server; it ends when it is dropped.
pub(crate) struct BareRouter {
    process: Process,
    pub(crate) address: SocketAddr,
    _folder: TempDir,
}

impl BareRouter {
    pub(crate) fn start(node: &Path) -> anyhow::Result<Self> {
        let (folder, address) = (tempfile::tempdir()?, free_address());
        let arguments = ["router".to_owned(), format!("--listen=tcp/{address}")];
        let log: PathBuf = folder.path().join("router.log");
        let process = Process::start("the bare router", node, &arguments, &log)?;
        Ok(Self {
            process,
            address,
            _folder: folder,
        })
    }
}

async fn bare_router(
    node: &Path,
    (count, period): (u32, Duration),
    seconds: u64,
) -> anyhow::Result<ResourceUsage> {
    let (welcome, site) = welcome_of(node).await?;
    let router = BareRouter::start(node)?;
    let endpoint = format!("tcp/{}", router.address);
    let mut robots = Vec::new();
    for numbers in batches(count) {
        let mut starting = JoinSet::new();
        for number in numbers {
            let named = (site.clone(), light_id(number)?);
            let (endpoint, welcome) = (endpoint.clone(), welcome.clone());
            starting.spawn(async move {
                LightRobot::start_without_server(&endpoint, welcome, named).await
            });
        }
        while let Some(started) = starting.join_next().await {
            robots.push(started??);
        }
    }
    let publishing = publish(robots, period);
    used(|| router.process.usage(), &publishing, seconds).await
}

/// Returns what a server answers to a robot's hello, and the site.
pub(crate) async fn welcome_of(node: &Path) -> anyhow::Result<(Welcome, SiteId)> {
    let fleet: Fleet = start_fleet(node, false).await;
    let robots = start_light_robots(&fleet, 1, false).await?;
    let first = robots.first().context("no robot was started")?;
    Ok((first.welcome.clone(), fleet.site()))
}

impl States {
    pub(crate) fn checks(&self) -> Vec<Check> {
        let of_fleet = |fleet: &FleetMeasurement| {
            let FleetMeasurement {
                robots,
                state_rate_hz,
                router,
                server,
                tls,
            } = fleet;
            let named = |what: &str| format!("{robots} robots at {state_rate_hz} Hz: {what}");
            let over_us = server.cpu_us_per_state - router.cpu_us_per_state;
            let over_mb = server.memory_peak_mb - router.memory_peak_mb;
            let offered = f64::from(*robots) * state_rate_hz;
            let dispatch = server.dispatch.as_ref();
            let p99_ms = dispatch.map_or(f64::NAN, |dispatch| dispatch.p99_ms);
            let over = "CPU per state over a bare router, us";
            let mut checks = vec![
                Check::of(named(over), over_us).at_most(OVER_ROUTER_MAX_US),
                Check::of(named("memory over a bare router, MB"), over_mb)
                    .at_most(OVER_ROUTER_MAX_MB),
                Check::of(named("dispatch p99, ms"), p99_ms).at_most(DISPATCH_P99_MAX_MS),
                Check::of(named("states per second"), server.states_per_second)
                    .at_least(0.95 * offered),
                Check::shown(
                    named("CPU per state of a bare router, us"),
                    router.cpu_us_per_state,
                ),
                Check::shown(named("CPU per state, us"), server.cpu_us_per_state),
                Check::shown(named("memory of a bare router, MB"), router.memory_peak_mb),
                Check::shown(named("memory, MB"), server.memory_peak_mb),
            ];
            if let Some(tls) = tls {
                checks.extend([
                    Check::shown(
                        named("CPU per state with certificates, us"),
                        tls.used.cpu_us_per_state,
                    ),
                    Check::shown(
                        named("memory with certificates, MB"),
                        tls.used.memory_peak_mb,
                    ),
                    Check::shown(named("robots with certificates"), f64::from(tls.robots)),
                ]);
            }
            checks
        };
        self.fleets.iter().flat_map(of_fleet).collect()
    }

    /// Returns what the router and the servers used.
    pub(crate) fn table(&self) -> Table {
        let mut table = Table::new([
            "robots",
            "process",
            "states/s",
            "CPU per state, us",
            "over the router, us",
            "memory, MB",
            "over the router, MB",
            "dispatch p50 / p99, ms",
        ]);
        for fleet in &self.fleets {
            let router = &fleet.router;
            let tls = fleet.tls.as_ref();
            let tls = tls.map(|tls| (tls.robots, "the server, with certificates", &tls.used));
            let rows = [
                (fleet.robots, "a bare router", router),
                (fleet.robots, "the server", &fleet.server),
            ];
            for (robots, process, used) in rows.into_iter().chain(tls) {
                let over = |value: f64, of: f64| match process {
                    "a bare router" => String::new(),
                    _ => format!("{:.1}", value - of),
                };
                let dispatch = used.dispatch.as_ref();
                table.row([
                    format!("{robots} at {} Hz", fleet.state_rate_hz),
                    process.to_owned(),
                    format!("{:.0}", used.states_per_second),
                    format!("{:.1}", used.cpu_us_per_state),
                    over(used.cpu_us_per_state, router.cpu_us_per_state),
                    format!("{:.0}", used.memory_peak_mb),
                    over(used.memory_peak_mb, router.memory_peak_mb),
                    dispatch.map_or_else(String::new, |dispatch| {
                        format!("{:.1} / {:.1}", dispatch.p50_ms, dispatch.p99_ms)
                    }),
                ]);
            }
        }
        table
    }

    pub(crate) fn words(&self) -> String {
        let lines = self.fleets.iter().filter_map(|fleet| {
            let dispatch = fleet.server.dispatch.as_ref()?;
            let (robots, rate_hz) = (fleet.robots, fleet.state_rate_hz);
            Some(format!(
                "{robots} robots at {rate_hz} Hz: {}\n",
                dispatch.words()
            ))
        });
        lines.collect()
    }
}
