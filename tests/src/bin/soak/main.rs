//! `soak`: whether a server survives what robots may send, for as long as one likes.
//!
//! Starts a server that takes robots' certificates as a process of its own. Robots connect, send
//! damaged payloads on all of their keys and tokens of new boots as fast as the link takes them,
//! and cut the link or close it in the middle; other threads keep the processor busy meanwhile. One
//! more robot behaves well, and notes how long the server takes to answer it.

use std::convert::Infallible;
use std::ops::ControlFlow;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use clap::Parser;
use serde::Serialize;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tread_agent::membership::Membership;
use tread_api::ids::{BootId, RobotId, SiteId};
use tread_api::keys;
use tread_api::wire;
use tread_tests::damage::damage;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::{LightRobot, open_secure_session};
use tread_tests::process::node;
use tread_tests::random::Random;
use tread_tests::report::{self, Check, figure, quantile};
use zenoh::handlers::FifoChannel;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait as _};

/// Messages of one connection, at least and at most.
const MESSAGES: (f64, f64) = (50.0, 2_000.0);
/// Time between two questions of the robot that behaves well.
const ASK_EVERY: Duration = Duration::from_millis(100);
/// Time between two looks at the server.
const POLL_INTERVAL: Duration = Duration::from_millis(500);
/// Answers to one question that are kept.
const REPLIES_MAX: usize = 4;
/// Longest wait for an answer to a damaged question, which nobody reads.
const QUESTION_TIMEOUT: Duration = Duration::from_millis(500);
/// Share of connections that are cut and not closed.
const CUT_SHARE: f64 = 0.5;
/// Answers to the robot that behaves well which may fail, as a share: the server sheds load.
const FAILED_SHARE_MAX: f64 = 0.01;

/// Tries whether a server survives what robots may send.
#[derive(Debug, Parser)]
#[command(name = "soak")]
struct Arguments {
    /// How long, seconds
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    seconds: u64,
    /// Robots that send damaged messages
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(0..=200))]
    robots: u32,
    /// Threads that keep the processor busy
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(0..=64))]
    busy: u32,
    /// Seed of all that is random
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

/// What has happened so far.
#[derive(Debug, Default)]
struct Counts {
    connections: AtomicU64,
    refused_connections: AtomicU64,
    messages: AtomicU64,
}

#[derive(Debug, Serialize)]
struct Details {
    seconds: f64,
    connections: u64,
    refused_connections: u64,
    messages: u64,
    answers: u64,
    server_cpu_s: f64,
    server_memory_peak_mib: f64,
}

/// One robot that sends what it may and should not, until it is time.
async fn misbehave(
    endpoint: String,
    membership: Membership,
    template: Arc<Template>,
    counts: Arc<Counts>,
    mut random: Random,
    until: Instant,
) {
    while Instant::now() < until {
        let connecting = open_secure_session(&endpoint, &membership);
        let Ok(Ok((session, tunnel))) =
            tokio::time::timeout(Duration::from_secs(10), connecting).await
        else {
            counts.refused_connections.fetch_add(1, Ordering::Relaxed);
            tokio::time::sleep(POLL_INTERVAL).await;
            continue;
        };
        counts.connections.fetch_add(1, Ordering::Relaxed);
        let is_cut = random.chance(CUT_SHARE);
        let (site, robot) = (membership.site.clone(), membership.robot.clone());
        let (template, counts) = (Arc::clone(&template), Arc::clone(&counts));
        let mut chosen = random.clone();
        random.next_u64();
        // zenoh's calls block their thread.
        let sending = tokio::task::spawn_blocking(move || {
            send_all(
                &session,
                (&site, &robot),
                &template,
                &counts,
                &mut chosen,
                until,
            );
            if !is_cut {
                let _ = session.close().wait();
            }
            drop(tunnel);
        });
        if sending.await.is_err() {
            return;
        }
    }
}

/// Payloads as a good robot sends them.
struct Template {
    state: Vec<u8>,
    batch: Vec<u8>,
}

fn send_all(
    session: &Session,
    (site, robot): (&SiteId, &RobotId),
    template: &Template,
    counts: &Counts,
    random: &mut Random,
    until: Instant,
) {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a count between two small constants"
    )]
    let messages = random.between(MESSAGES.0..MESSAGES.1) as usize;
    let mut tokens = Vec::new();
    for _ in 0..messages {
        if Instant::now() >= until {
            return;
        }
        if send_one(session, (site, robot), template, random, &mut tokens).is_break() {
            return;
        }
        counts.messages.fetch_add(1, Ordering::Relaxed);
    }
}

fn send_one(
    session: &Session,
    (site, robot): (&SiteId, &RobotId),
    template: &Template,
    random: &mut Random,
    tokens: &mut Vec<zenoh::liveliness::LivelinessToken>,
) -> ControlFlow<()> {
    let boot = || BootId::from_uuid(uuid::Uuid::new_v4());
    let which = random.index(8);
    let mut payload = if which < 4 {
        template.state.clone()
    } else {
        template.batch.clone()
    };
    damage(&mut payload, random);
    let sent = match which {
        0..=2 => session
            .put(keys::state(site, robot), payload)
            .congestion_control(CongestionControl::Drop)
            .wait(),
        3 => session
            .put(keys::friction(site, robot), payload)
            .congestion_control(CongestionControl::Drop)
            .wait(),
        4 | 5 => {
            let key = if which == 4 {
                keys::hello(site, robot)
            } else {
                keys::ingest(site, robot)
            };
            session
                .get(key)
                .payload(payload)
                .timeout(QUESTION_TIMEOUT)
                .with(FifoChannel::new(REPLIES_MAX))
                .wait()
                .map(drop)
        }
        6 => session
            .liveliness()
            .declare_token(keys::alive(site, robot, boot()))
            .wait()
            .map(|token| tokens.push(token)),
        _ => {
            tokens.clear();
            Ok(())
        }
    };
    if sent.is_err() {
        ControlFlow::Break(())
    } else {
        ControlFlow::Continue(())
    }
}

/// The robot that behaves well, for ever: notes how long answers took, milliseconds; infinite
/// without one.
async fn behave(robot: &mut LightRobot, took_ms: &mut Vec<f64>) -> Infallible {
    loop {
        let batch = robot.next_batch(1);
        let answered = robot.upload(&batch).await;
        took_ms.push(answered.map_or(f64::INFINITY, |(_, took)| 1e3 * took.as_secs_f64()));
        let _ = robot.publish_state().await;
        tokio::time::sleep(ASK_EVERY).await;
    }
}

async fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let fleet = Fleet::start_secure_with(&node()?, 86_400).await;
    let endpoint = fleet.zenoh_endpoint();
    let well: RobotId = "well-behaved".parse().context("it is an identifier")?;
    let membership = fleet.membership(&well).await;
    let mut robot = LightRobot::start_secure(&endpoint, &membership).await?;
    let template = Arc::new(Template {
        state: wire::encode(&robot.next_state())?,
        batch: wire::encode(&robot.next_batch(4))?,
    });
    let stop = Arc::new(AtomicBool::new(false));
    let busy: Vec<_> = (0..arguments.busy)
        .map(|_| {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || while !stop.load(Ordering::Relaxed) {})
        })
        .collect();
    let counts = Arc::new(Counts::default());
    let mut random = Random::new(arguments.seed);
    let begin = Instant::now();
    let until = begin + Duration::from_secs(arguments.seconds);
    let mut robots = JoinSet::new();
    for number in 0..arguments.robots {
        let id: RobotId = format!("rover-{number}")
            .parse()
            .context("it is an identifier")?;
        robots.spawn(misbehave(
            endpoint.clone(),
            fleet.membership(&id).await,
            Arc::clone(&template),
            Arc::clone(&counts),
            Random::new(random.next_u64()),
            until,
        ));
    }
    let watching = async {
        while Instant::now() < until && !fleet.has_server_ended() {
            tokio::time::sleep(POLL_INTERVAL).await;
        }
    };
    // A server that has ended answers nobody, so there is nothing to wait for.
    let mut took_ms = Vec::new();
    tokio::select! {
        never = behave(&mut robot, &mut took_ms) => match never {},
        () = watching => {}
    }
    let seconds = begin.elapsed().as_secs_f64();
    stop.store(true, Ordering::Relaxed);
    for thread in busy {
        let _ = thread.join();
    }
    let survived = !fleet.has_server_ended();
    if survived {
        while robots.join_next().await.is_some() {}
    } else {
        eprintln!("{}", fleet.log_tail("server").join("\n"));
    }
    robots.abort_all();
    print_report(arguments, &fleet, &counts, seconds, survived, &took_ms)
}

fn print_report(
    arguments: &Arguments,
    fleet: &Fleet,
    counts: &Counts,
    seconds: f64,
    survived: bool,
    took_ms: &[f64],
) -> anyhow::Result<ExitCode> {
    let usage = fleet.server_usage();
    let mut answered: Vec<f64> = took_ms
        .iter()
        .copied()
        .filter(|took| took.is_finite())
        .collect();
    let failed = took_ms.len() - answered.len();
    let details = Details {
        seconds,
        connections: counts.connections.load(Ordering::Relaxed),
        refused_connections: counts.refused_connections.load(Ordering::Relaxed),
        messages: counts.messages.load(Ordering::Relaxed),
        answers: u64::try_from(answered.len())?,
        server_cpu_s: usage.as_ref().map_or(0.0, |usage| usage.cpu_s),
        server_memory_peak_mib: usage.as_ref().map_or(0.0, |usage| {
            figure(usage.memory_peak_bytes) / f64::from(1 << 20)
        }),
    };
    let asked = figure(u64::try_from(took_ms.len())?);
    let checks = [
        Check::so("the server survived", survived),
        Check::of("connections", figure(details.connections)).at_least(1.0),
        Check::of("messages", figure(details.messages)).at_least(1.0),
        Check::of("answered uploads", figure(details.answers)).at_least(1.0),
        Check::of(
            "uploads of a well-behaved robot without an answer, share",
            figure(u64::try_from(failed)?) / asked.max(1.0),
        )
        .at_most(FAILED_SHARE_MAX),
        Check::shown("receipt p50, ms", quantile(&mut answered, 0.5)),
        Check::shown("receipt p99, ms", quantile(&mut answered, 0.99)),
    ];
    let words = format!(
        "{:.0} s, {} connections ({} refused), {} messages, server {:.1} s of CPU and {:.0} MiB\n",
        details.seconds,
        details.connections,
        details.refused_connections,
        details.messages,
        details.server_cpu_s,
        details.server_memory_peak_mib,
    );
    report::print_with(arguments.json, &details, words, &checks)
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let _ = rustls::crypto::ring::default_provider().install_default();
    run(&Arguments::parse()).await
}
