//! `lateness`: how late the ticks of the control loop are, with and without real-time priority and
//! locked memory, on an idle machine and beside threads that want every core.
//!
//! An agent on a simulated base records its loop. The lateness of a tick is the excess of the
//! interval since the tick before over the period, from the times in the record.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::Context as _;
use clap::Parser;
use mcap::io::MessageReader;
use nix::sys::resource::{RLIM_INFINITY, Resource, setrlimit};
use serde::Serialize;
use tread_tests::process::{Process, node};
use tread_tests::report::{self, Check, quantile};

/// Topic of the ticks in a record.
const TICKS: &str = "/tread/tick";
/// Rate of the loop, Hz.
const RATE_HZ: f64 = 100.0;
/// Ticks at the beginning that are left out: the agent still starts.
const STARTING_TICKS: usize = 200;
/// Least part of the ticks that a run must have recorded.
const RECORDED_RATIO_MIN: f64 = 0.7;
/// Priority of the loop in the runs that have one.
const PRIORITY: u8 = 40;
/// Lateness of 999 of 1000 ticks at the most, with real-time priority and under load, milliseconds.
/// The loop holds the robot from 40 ms on.
const LATE_MAX_MS: f64 = 5.0;

/// Measures how late the ticks of the control loop are.
#[derive(Debug, Parser)]
#[command(name = "lateness")]
struct Arguments {
    /// Duration of each of the four runs
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u64).range(5..=3_600))]
    seconds: u64,
    /// Threads that want all of a core, in the runs under load; twice the cores when absent
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=1_024))]
    load: Option<u16>,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Details {
    seconds: u64,
    load_threads: usize,
    not_measured: Option<String>,
}

/// Settings of a run.
#[derive(Debug, Clone, Copy)]
struct Run {
    is_realtime: bool,
    /// Whether the memory of an agent with real-time priority is locked.
    locks_memory: bool,
    load_threads: usize,
}

impl Run {
    fn name(self) -> String {
        let scheduling = if self.is_realtime {
            "real-time"
        } else {
            "usual"
        };
        let load = if self.load_threads > 0 {
            "load"
        } else {
            "idle"
        };
        format!("{scheduling}, {load}")
    }
}

fn configuration(run: Run, folder: &Path) -> String {
    let realtime = if run.is_realtime {
        let locks_memory = run.locks_memory;
        format!("[realtime]\npriority = {PRIORITY}\nlock_memory = {locks_memory}\n")
    } else {
        String::new()
    };
    format!(
        "site = \"yard\"\nrobot = \"rover-1\"\nserver = \"tcp/127.0.0.1:1\"\n\
         rate_hz = {RATE_HZ:?}\ndata_dir = \"{folder}\"\n\
         [recording]\nenabled = true\nfolder = \"{folder}/recordings\"\n{realtime}",
        folder = folder.display()
    )
}

/// Lateness of each tick in the records of a folder, milliseconds.
fn late_ms(folder: &Path) -> anyhow::Result<Vec<f64>> {
    let mut files: Vec<_> = std::fs::read_dir(folder)?
        .map(|entry| Ok(entry?.path()))
        .collect::<std::io::Result<_>>()?;
    files.sort();
    let mut times_ns = Vec::new();
    for file in files {
        let opened = BufReader::new(File::open(&file)?);
        for message in MessageReader::new(opened) {
            let message = message.with_context(|| format!("cannot read {}", file.display()))?;
            if message.channel.topic == TICKS {
                times_ns.push(message.log_time);
            }
        }
    }
    let intervals = times_ns.windows(2).skip(STARTING_TICKS);
    let late = intervals.map(|two| {
        let interval = Duration::from_nanos(two[1].saturating_sub(two[0]));
        (interval.as_secs_f64() - RATE_HZ.recip()).max(0.0) * 1e3
    });
    Ok(late.collect())
}

/// Threads that want all of a core each, until this is dropped.
struct Load {
    is_over: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Load {
    fn of(threads: usize) -> Self {
        let is_over = Arc::new(AtomicBool::new(false));
        let threads = (0..threads).map(|_| {
            let is_over = Arc::clone(&is_over);
            std::thread::spawn(move || {
                while !is_over.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            })
        });
        let threads = threads.collect();
        Self { is_over, threads }
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            // None of them can panic.
            _ = thread.join();
        }
    }
}

/// Runs an agent beside the load; the lateness of its ticks, milliseconds.
async fn measure(run: Run, span: Duration) -> anyhow::Result<Vec<f64>> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("robot.toml");
    std::fs::write(&file, configuration(run, folder.path()))?;
    let log = folder.path().join("log");
    let arguments = ["agent", "--config", &file.display().to_string()].map(str::to_owned);
    let load = Load::of(run.load_threads);
    let mut agent = Process::start("agent", &node()?, &arguments, &log)?;
    tokio::time::sleep(span).await;
    if let Some(status) = agent.ended() {
        let said = std::fs::read_to_string(&log).unwrap_or_default();
        anyhow::bail!("the agent ended with {status}: {said}");
    }
    agent.stop().await?;
    drop(load);
    let late = late_ms(&folder.path().join("recordings"))?;
    let least = RECORDED_RATIO_MIN * span.as_secs_f64() * RATE_HZ;
    anyhow::ensure!(
        report::figure((late.len() + STARTING_TICKS) as u64) >= least,
        "only {} ticks were recorded",
        late.len()
    );
    Ok(late)
}

fn checks(run: Run, mut late_ms: Vec<f64>) -> Vec<Check> {
    let name = run.name();
    let mut of = |label: &str, share| {
        let figure = quantile(&mut late_ms, share);
        Check::of(format!("{name}: lateness, {label}, ms"), figure)
    };
    let median = of("median", 0.5).shown();
    let p999 = of("p99.9", 0.999);
    let p999 = if run.is_realtime {
        p999.at_most(LATE_MAX_MS)
    } else {
        p999.shown()
    };
    vec![median, p999, of("most", 1.0).shown()]
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    // Fails for an ordinary user, and where root may not raise limits.
    let locks_memory = setrlimit(Resource::RLIMIT_MEMLOCK, RLIM_INFINITY, RLIM_INFINITY).is_ok();
    let cores = std::thread::available_parallelism()?.get();
    let load = arguments.load.map_or(2 * cores, usize::from);
    let mut checks_of_all = Vec::new();
    let mut not_measured = (!locks_memory).then(|| "memory may not be locked here".to_owned());
    for (is_realtime, load_threads) in [(false, 0), (true, 0), (false, load), (true, load)] {
        let run = Run {
            is_realtime,
            locks_memory,
            load_threads,
        };
        eprintln!("{}: {} s", run.name(), arguments.seconds);
        match measure(run, Duration::from_secs(arguments.seconds)).await {
            Ok(late) => checks_of_all.extend(checks(run, late)),
            Err(cause) if is_realtime && format!("{cause:#}").contains("LimitRTPRIO") => {
                not_measured = Some("real-time priority is not permitted here".to_owned());
            }
            Err(cause) => return Err(cause),
        }
    }
    let words = not_measured
        .as_ref()
        .map_or_else(String::new, |why| format!("NOT MEASURED: {why}\n"));
    let details = Details {
        seconds: arguments.seconds,
        load_threads: load,
        not_measured,
    };
    report::print_with(arguments.json, &details, words, &checks_of_all)
}
