//! `load`: what one server carries, with the generator on the same machine.
//!
//! Starts a server and a few real agents as processes of their own and any number of light robots
//! in this one, then measures, one after the other:
//!
//! 1. **ingest**: every light robot uploads batches of segments at a fixed rate and waits for each
//!    receipt; counted are segments committed, times to the receipt, and the server's processor
//!    time; afterwards the database must hold each acknowledged segment exactly once.
//! 2. **dispatch**: circles are sent over REST to real agents, one at a time, while the light
//!    robots publish their states; counted is the time from the request to the first wheel command.
//!
//! With `--saturate` ingest alone, in the hardest case: every robot uploads its next batch as soon as it
//! has the receipt, and each segment is in another cell than the one before, of 1 600 cells of each
//! robot, so that every segment has its own sum. First in CBOR, then in JSON, then in CBOR at 60 % of
//! what was reached. With `--peers` also into a service in Python (`tests/peers`).
//!
//! Beside dispatch, the time of a query to a client of a bare zenoh router, and of a write to the disk.
//!
//! With `--states` what the states of 5 000 robots at 2 Hz, and of 1 000 at 10 Hz, cost over a bare zenoh
//! router with the same sessions and messages.

mod details;
mod dispatch;
mod floor;
mod ingest;
mod peers;
mod saturation;
mod sizes;
mod states;

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;
use tokio::task::JoinSet;
use tread_api::ids::{RobotId, SiteId};
use tread_tests::collector::Collector;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::LightRobot;
use tread_tests::process::node;
use tread_tests::report;

use crate::details::Details;
use crate::ingest::Pace;

/// How long certificates are good for: longer than any measurement.
const CERTIFICATE_S: u32 = 86_400;

/// Measures what one server carries.
#[derive(Debug, Parser)]
#[command(name = "load")]
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is a flag of the command line"
)]
pub(crate) struct Arguments {
    /// Light robots
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=5_000))]
    robots: u32,
    /// Length of each measurement, seconds
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u64).range(2..=3_600))]
    seconds: u64,
    /// Segments offered per second, of all robots together
    #[arg(long, default_value_t = 24_000)]
    segments_per_second: u32,
    /// Time between two uploads of a robot, milliseconds
    #[arg(long, default_value_t = 250, value_parser = clap::value_parser!(u64).range(10..=10_000))]
    upload_every_ms: u64,
    /// Upload as fast as receipts arrive, and measure nothing else
    #[arg(long)]
    saturate: bool,
    /// Measure the cost of states of many robots beside a bare zenoh router, and nothing else
    #[arg(long, conflicts_with = "saturate")]
    states: bool,
    /// Weigh segments and states, on the way and on the disk, and nothing else
    #[arg(long, conflicts_with_all = ["saturate", "states", "markdown"])]
    sizes: bool,
    /// Segments of each upload with `--saturate`
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u16).range(1..=1_000))]
    records: u16,
    /// Compare with the service in `tests/peers`: a Python that has its `requirements.txt`
    #[arg(long, value_name = "PYTHON", requires = "saturate")]
    peers: Option<PathBuf>,
    /// States published per second by each light robot
    #[arg(long, default_value_t = 2.0)]
    state_rate_hz: f64,
    /// Real agents that missions are sent to
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=20))]
    agents: u32,
    /// Missions sent to each of them
    #[arg(long, default_value_t = 25, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    missions: u32,
    /// Connect all robots by TLS with certificates of their own; with `--states` also the largest fleet, which
    /// takes long
    #[arg(long)]
    tls: bool,
    /// Print one JSON object instead of a table
    #[arg(long, conflicts_with = "markdown")]
    json: bool,
    /// Print tables for a page
    #[arg(long)]
    markdown: bool,
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let node = node()?;
    if arguments.saturate {
        let saturation = saturation::measure(&arguments, &node).await?;
        let checks = saturation.checks();
        if arguments.markdown {
            return report::print_markdown(&saturation.table().markdown(), &checks);
        }
        return report::print_with(arguments.json, &saturation, saturation.words(), &checks);
    }
    if arguments.states {
        let states = states::measure(&arguments, &node).await?;
        let checks = states.checks();
        if arguments.markdown {
            return report::print_markdown(&states.table().markdown(), &checks);
        }
        return report::print_with(arguments.json, &states, states.words(), &checks);
    }
    if arguments.sizes {
        let sizes = sizes::measure(&node).await?;
        return report::print_with(arguments.json, &sizes, sizes.words(), &sizes.checks());
    }
    let collector = Collector::default();
    let mut fleet = start_traced_fleet(&node, arguments.tls, &collector).await?;
    let robots = start_light_robots(&fleet, arguments.robots, arguments.tls).await?;
    let pace = Pace::PerSecond(f64::from(arguments.segments_per_second));
    let ingest = ingest::measure(&arguments, &fleet, robots, pace).await?;
    let dispatch = dispatch::measure(&arguments, &mut fleet, &collector).await?;
    let query = floor::query(&node).await?;
    let details = Details {
        robots: arguments.robots,
        ingest,
        dispatch,
        query,
    };
    details.print(&arguments)
}

/// Starts a server, whose robots show certificates if they connect by TLS.
pub(crate) async fn start_fleet(node: &Path, tls: bool) -> Fleet {
    if tls {
        Fleet::start_secure_with(node, CERTIFICATE_S).await
    } else {
        Fleet::start_with(node).await
    }
}

/// The same, with server and agents that send their traces to a collector.
async fn start_traced_fleet(
    node: &Path,
    tls: bool,
    collector: &Collector,
) -> anyhow::Result<Fleet> {
    let endpoint = collector.start().await?;
    let mut fleet = Fleet::start_traced(node, &endpoint, tls.then_some(CERTIFICATE_S)).await;
    let file = fleet.file("robot.toml");
    std::fs::write(&file, format!("[tracing]\nendpoint = \"{endpoint}\"\n"))?;
    fleet.agents_get(&[&format!("--config={}", file.display())]);
    Ok(fleet)
}

/// Connects the light robots, a few at a time as a fleet does after a power cut with jitter.
pub(crate) async fn start_light_robots(
    fleet: &Fleet,
    count: u32,
    tls: bool,
) -> anyhow::Result<Vec<LightRobot>> {
    let site = fleet.site();
    if !tls {
        return connect_light_robots(&fleet.zenoh_endpoint(), &site, count).await;
    }
    let endpoint = fleet.zenoh_endpoint();
    let mut robots = Vec::new();
    for numbers in batches(count) {
        let mut starting = JoinSet::new();
        for number in numbers {
            let endpoint = endpoint.clone();
            let membership = fleet.membership(&light_id(number)?).await;
            starting.spawn(async move { LightRobot::start_secure(&endpoint, &membership).await });
        }
        while let Some(started) = starting.join_next().await {
            robots.push(started??);
        }
    }
    Ok(robots)
}

/// The same without TLS, at any server.
pub(crate) async fn connect_light_robots(
    endpoint: &str,
    site: &SiteId,
    count: u32,
) -> anyhow::Result<Vec<LightRobot>> {
    let mut robots = Vec::new();
    for numbers in batches(count) {
        let mut starting = JoinSet::new();
        for number in numbers {
            let (endpoint, site, id) = (endpoint.to_owned(), site.clone(), light_id(number)?);
            starting.spawn(async move { LightRobot::start(&endpoint, &site, id).await });
        }
        while let Some(started) = starting.join_next().await {
            robots.push(started??);
        }
    }
    Ok(robots)
}

pub(crate) fn light_id(number: u32) -> anyhow::Result<RobotId> {
    Ok(format!("light-{number}").parse()?)
}

/// Returns the numbers of the robots that are started at the same time.
pub(crate) fn batches(count: u32) -> impl Iterator<Item = Range<u32>> {
    const AT_ONCE: u32 = 20;
    let begins = (0..count).step_by(AT_ONCE as usize);
    begins.map(move |first| first..count.min(first + AT_ONCE))
}

/// A period as a duration; longer than any measurement when the rate is not above zero.
pub(crate) fn period_of(rate_hz: f64) -> Duration {
    const FOR_EVER: Duration = Duration::from_hours(24);
    Duration::try_from_secs_f64(rate_hz.recip()).map_or(FOR_EVER, |period| period.min(FOR_EVER))
}
