//! `half_open`: what thousands of half-sent requests do to the others.
//!
//! Starts a server as a process of its own and asks it at a fixed rate, by connections that are
//! kept and by a new one each time; first undisturbed, then while thousands of connections have
//! each sent half a request. One that the server ends is opened again after a rest, as the usual
//! tools for this attack do. Both are done several times in turn, so that whatever else the
//! machine does falls on both.

use std::net::SocketAddr;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context as _;
use clap::Parser;
use hdrhistogram::Histogram;
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use serde::Serialize;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior};
use tread_tests::fleet::Fleet;
use tread_tests::process::node;
use tread_tests::report::{self, Check};

/// How much longer 99 % of the answers may take, at the most.
const SLOWER_MAX: f64 = 2.0;
/// What each half-open connection sends.
const HALF_A_REQUEST: &[u8] = b"GET /v1/sites HTTP/1.1\r\nhost: 127.0.0.1\r\nx-slow: ";
/// Rest before a connection that was ended is opened again.
const REOPEN_REST: Duration = Duration::from_secs(5);
/// Time for the half-open connections to get in place.
const SETTLE: Duration = Duration::from_secs(2);
/// Longest wait for an answer.
const ANSWER_WAIT_MAX: Duration = Duration::from_secs(10);
/// Files that are open besides the connections.
const OTHER_FILES: u64 = 200;

/// Measures what half-sent requests do to the others.
#[derive(Debug, Parser)]
#[command(name = "half_open")]
struct Arguments {
    /// Half-open connections
    #[arg(long, default_value_t = 5_000, value_parser = clap::value_parser!(u32).range(1..=20_000))]
    connections: u32,
    /// Length of each measurement, seconds
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=600))]
    seconds: u64,
    /// How often it is measured without and with them
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    rounds: u32,
    /// Requests per second, half of them on kept connections
    #[arg(long, default_value_t = 400, value_parser = clap::value_parser!(u64).range(2..=10_000))]
    rate_hz: u64,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

/// Answers of one kind, undisturbed or not.
#[derive(Debug)]
struct Answers {
    took_us: Histogram<u64>,
    failed: u64,
}

impl Answers {
    fn new() -> anyhow::Result<Self> {
        Ok(Self {
            took_us: Histogram::new(3)?,
            failed: 0,
        })
    }

    fn p99_ms(&self) -> f64 {
        #[expect(clippy::cast_precision_loss, reason = "microseconds far below 2^53")]
        let us = self.took_us.value_at_quantile(0.99) as f64;
        us / 1e3
    }
}

#[derive(Debug, Serialize)]
struct Details {
    connections: u32,
    reopened: u64,
    requests: u64,
    kept_p99_ms: [f64; 2],
    new_p99_ms: [f64; 2],
}

/// Which connection a request takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ConnectionMode {
    Kept,
    New,
}

struct Requester {
    address: SocketAddr,
    request: String,
}

impl Requester {
    /// One request on a connection, and the whole answer.
    async fn ask(&self, stream: &mut TcpStream) -> anyhow::Result<()> {
        stream.write_all(self.request.as_bytes()).await?;
        let mut answer = Vec::new();
        loop {
            anyhow::ensure!(
                stream.read_buf(&mut answer).await? > 0,
                "the connection ended"
            );
            let text = String::from_utf8_lossy(&answer);
            if let Some((head, body)) = text.split_once("\r\n\r\n") {
                anyhow::ensure!(head.starts_with("HTTP/1.1 200"), "{head}");
                let length = head
                    .lines()
                    .find_map(|line| line.strip_prefix("content-length: "));
                let length: usize = length.context("the answer has a length")?.parse()?;
                if body.len() >= length {
                    return Ok(());
                }
            }
        }
    }

    async fn on_new(&self) -> anyhow::Result<TcpStream> {
        let mut stream = TcpStream::connect(self.address).await?;
        stream.set_nodelay(true)?;
        self.ask(&mut stream).await?;
        Ok(stream)
    }

    /// Asks at a fixed rate and notes how long each answer took.
    async fn ask_for(
        &self,
        by: ConnectionMode,
        rate_hz: u64,
        span: Duration,
        answers: &mut Answers,
    ) -> anyhow::Result<()> {
        let mut ticks = tokio::time::interval(Duration::from_secs(1) / u32::try_from(rate_hz)?);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let until = Instant::now() + span;
        let mut kept: Option<TcpStream> = None;
        while Instant::now() < until {
            ticks.tick().await;
            let began = Instant::now();
            let asking = async {
                match (by, kept.take()) {
                    (ConnectionMode::Kept, Some(mut stream)) => {
                        self.ask(&mut stream).await?;
                        Ok(stream)
                    }
                    (ConnectionMode::Kept, None) | (ConnectionMode::New, _) => self.on_new().await,
                }
            };
            let answer = tokio::time::timeout(ANSWER_WAIT_MAX, asking).await;
            match answer.map_err(anyhow::Error::from).flatten() {
                Ok(stream) => kept = (by == ConnectionMode::Kept).then_some(stream),
                Err(_) => answers.failed += 1,
            }
            let took_us = u64::try_from(began.elapsed().as_micros())?;
            answers.took_us.record(took_us)?;
        }
        Ok(())
    }
}

/// Opens half-open connections that stay, or come again, until the result is dropped.
fn attack(
    attacker: &Handle,
    address: SocketAddr,
    count: u32,
    reopened: &Arc<AtomicU64>,
) -> JoinSet<()> {
    let mut open = JoinSet::new();
    for number in 0..count {
        let reopened = Arc::clone(reopened);
        let attacking = async move {
            // Over the time to settle, not all in one moment.
            tokio::time::sleep(SETTLE * number / (2 * count)).await;
            loop {
                if let Ok(mut stream) = TcpStream::connect(address).await
                    && stream.write_all(HALF_A_REQUEST).await.is_ok()
                {
                    // Nothing comes; the end does.
                    let _ended = stream.read(&mut [0; 512]).await;
                }
                reopened.fetch_add(1, Ordering::Relaxed);
                tokio::time::sleep(REOPEN_REST).await;
            }
        };
        open.spawn_on(attacking, attacker);
    }
    open
}

fn main() -> anyhow::Result<ExitCode> {
    // A runtime for each, so that what is measured is the server and not the attacker's tasks.
    let runtime = || {
        tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
    };
    let attacker = runtime()?;
    runtime()?.block_on(measure(Arguments::parse(), attacker.handle()))
}

async fn measure(arguments: Arguments, attacker: &Handle) -> anyhow::Result<ExitCode> {
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, most, most)?;
    anyhow::ensure!(
        most >= u64::from(arguments.connections) + OTHER_FILES,
        "only {most} files may be open: raise `ulimit -n`, or take fewer --connections"
    );
    let node = node()?;
    let fleet = Fleet::start_with(&node).await;
    let address = fleet.http_address();
    let request = format!(
        "GET /v1/sites HTTP/1.1\r\nhost: {address}\r\nauthorization: Bearer {}\r\n\r\n",
        fleet.token()
    );
    let asker = Requester { address, request };
    let reopened = Arc::new(AtomicU64::new(0));
    let span = Duration::from_secs(arguments.seconds);
    let (mut kept, mut new) = (
        [Answers::new()?, Answers::new()?],
        [Answers::new()?, Answers::new()?],
    );
    for _ in 0..arguments.rounds {
        for disturbed in 0..2 {
            let count = if disturbed == 1 {
                arguments.connections
            } else {
                0
            };
            let open = attack(attacker, address, count, &reopened);
            tokio::time::sleep(SETTLE).await;
            let rate_hz = arguments.rate_hz / 2;
            tokio::try_join!(
                asker.ask_for(ConnectionMode::Kept, rate_hz, span, &mut kept[disturbed]),
                asker.ask_for(ConnectionMode::New, rate_hz, span, &mut new[disturbed]),
            )?;
            drop(open);
        }
    }
    print_report(&arguments, reopened.load(Ordering::Relaxed), &kept, &new)
}

fn print_report(
    arguments: &Arguments,
    reopened: u64,
    kept: &[Answers; 2],
    new: &[Answers; 2],
) -> anyhow::Result<ExitCode> {
    let slower = |name, [normal, disturbed]: &[Answers; 2]| {
        Check::of(name, disturbed.p99_ms() / normal.p99_ms()).below(SLOWER_MAX)
    };
    let all = || kept.iter().chain(new);
    let failed = all().map(|answers| answers.failed).sum();
    let details = Details {
        connections: arguments.connections,
        reopened,
        requests: all().map(|answers| answers.took_us.len()).sum(),
        kept_p99_ms: [kept[0].p99_ms(), kept[1].p99_ms()],
        new_p99_ms: [new[0].p99_ms(), new[1].p99_ms()],
    };
    let checks = [
        slower("p99 on kept connections, times normal", kept),
        slower("p99 on new connections, times normal", new),
        Check::of_count("requests without an answer", failed).exactly(0),
    ];
    let [normal, disturbed] = details.kept_p99_ms;
    let [new_normal, new_disturbed] = details.new_p99_ms;
    let words = format!(
        "{} half-open connections, {} times ended and opened again; {} requests; p99 on kept \
         connections {normal:.2} and {disturbed:.2} ms, on new ones {new_normal:.2} and \
         {new_disturbed:.2} ms\n",
        details.connections, details.reopened, details.requests
    );
    report::print_with(arguments.json, &details, words, &checks)
}
