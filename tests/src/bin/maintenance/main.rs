//! `maintenance`: what a backup, a restoration and an upgrade cost a fleet at work.
//!
//! On one server and one database, one after the other:
//!
//! 1. light robots upload until the database has the wanted size, and then for a minute at the
//!    measured rate;
//! 2. **backup**: `tread-server backup` beside that load: times to the receipts, against those of the
//!    minute before, and the size of the database's log;
//! 3. **restoration**: the server is stopped, the backup restored over its database, and the server
//!    started: the time until it is ready;
//! 4. **upgrade**: real agents drive missions while the server is stopped and started again: how long
//!    the REST API was away, and whether a mission or a record was lost.

mod uploads;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use clap::Parser;
use serde::Serialize;
use serde_json::{Value, json};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, Row};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tread_api::ids::{MissionId, RobotId};
use tread_api::mission::MissionState;
use tread_tests::fleet::{Fleet, SITE};
use tread_tests::process::node;
use tread_tests::report::{Check, figure, print_with};
use tread_tests::stored;
use tread_tests::wait::{DRIVE, eventually};

use crate::uploads::{Tally, Uploads};

/// Largest ratio of the receipts' p99 during the backup to that of the minute before.
const RECEIPT_RATIO_MAX: f64 = 2.0;
/// Largest size of the database's log during a backup, as a ratio of the database.
const LOG_RATIO_MAX: f64 = 1.0;
/// Time within which a restored server must be ready, seconds.
const RESTORED_WITHIN_S: f64 = 60.0;
/// Time for which the REST API may be away during an upgrade, seconds.
const REST_AWAY_MAX_S: f64 = 5.0;
/// Interval of the looks at the size of the log, and at the REST API.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Rate of uploads while the database grows, as a multiple of the measured one.
const GROWTH_FACTOR: f64 = 3.0;
/// Longest time until the database has its size.
const GROWTH_MAX: Duration = Duration::from_mins(15);
/// Time for which the load goes on after the backup, to see whether the log grows on.
const AFTER: Duration = Duration::from_secs(20);
/// Distance between the robots of the upgrade, metres.
const APART_M: f64 = 20.0;
const BYTES_PER_MIB: f64 = 1024.0 * 1024.0;

/// Measures what a backup, a restoration and an upgrade cost a fleet at work.
#[derive(Debug, Parser)]
#[command(name = "maintenance")]
struct Arguments {
    /// Size of the database, MiB
    #[arg(long, default_value_t = 1_024, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    megabytes: u32,
    /// Segments uploaded per second, of all light robots together
    #[arg(long, default_value_t = 20_000, value_parser = clap::value_parser!(u32).range(100..=200_000))]
    segments_per_second: u32,
    /// Light robots
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    robots: u32,
    /// Length of the measurement before the backup, seconds
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(2..=3_600))]
    seconds: u64,
    /// Real agents on missions during the upgrade
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=50))]
    agents: u32,
    /// Executable of the server after the upgrade; the same one when absent
    #[arg(long, value_name = "FILE")]
    upgrade_to: Option<PathBuf>,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

/// What was found beside the checks.
#[derive(Debug, Default, Serialize)]
struct Details {
    database_mib: f64,
    backup_mib: f64,
    backup_s: f64,
    segments_per_second_before: f64,
    segments_per_second_during: f64,
    receipt_p50_before_ms: f64,
    receipt_p99_before_ms: f64,
    receipt_p50_during_ms: f64,
    receipt_p99_during_ms: f64,
    receipt_max_during_ms: f64,
    log_before_mib: f64,
    log_largest_mib: f64,
    server_memory_peak_mib: f64,
    restore_s: f64,
    ready_s: f64,
    rest_away_s: f64,
}

impl std::fmt::Display for Details {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(
            f,
            "database {:.0} MiB, backed up in {:.1} s into {:.0} MiB, restored in {:.1} s",
            self.database_mib, self.backup_s, self.backup_mib, self.restore_s
        )?;
        writeln!(
            f,
            "segments/s {:.0} before and {:.0} during; receipts p50 {:.1} and {:.1} ms, p99 {:.1} and \
             {:.1} ms, longest {:.0} ms",
            self.segments_per_second_before,
            self.segments_per_second_during,
            self.receipt_p50_before_ms,
            self.receipt_p50_during_ms,
            self.receipt_p99_before_ms,
            self.receipt_p99_during_ms,
            self.receipt_max_during_ms
        )?;
        writeln!(
            f,
            "log {:.0} MiB before and {:.0} MiB at most; the server's memory {:.0} MiB at most",
            self.log_before_mib, self.log_largest_mib, self.server_memory_peak_mib
        )
    }
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let node = node()?;
    let mut fleet = Fleet::start_with(&node).await;
    let mut details = Details::default();
    let mut checks = Vec::new();
    let backup = measure_backup(&arguments, &node, &fleet, (&mut details, &mut checks)).await?;
    measure_restoration(&node, &mut fleet, &backup, (&mut details, &mut checks)).await?;
    if let Some(other) = &arguments.upgrade_to {
        fleet.upgrade_server_to(other);
    }
    measure_upgrade(&arguments, &mut fleet, (&mut details, &mut checks)).await?;
    print_with(arguments.json, &details, &details, &checks)
}

#[expect(
    clippy::cast_precision_loss,
    reason = "bytes of files, to a few digits"
)]
fn mib(bytes: u64) -> f64 {
    bytes as f64 / BYTES_PER_MIB
}

fn size_of(path: &Path) -> u64 {
    fs::metadata(path).map_or(0, |about| about.len())
}

fn log_of(fleet: &Fleet) -> PathBuf {
    let mut name = fleet.database_file().into_os_string();
    name.push("-wal");
    name.into()
}

/// Notes the largest size of a file until it is dropped.
struct Watch {
    largest: Arc<AtomicU64>,
    _looking: JoinSet<()>,
}

impl Watch {
    fn start(file: PathBuf) -> Self {
        let largest = Arc::new(AtomicU64::new(0));
        let noted = Arc::clone(&largest);
        let mut looking = JoinSet::new();
        looking.spawn(async move {
            loop {
                noted.fetch_max(size_of(&file), Ordering::Relaxed);
                tokio::time::sleep(POLL_INTERVAL).await;
            }
        });
        Self {
            largest,
            _looking: looking,
        }
    }

    fn largest(&self) -> u64 {
        self.largest.load(Ordering::Relaxed)
    }
}

type Found<'found> = (&'found mut Details, &'found mut Vec<Check>);

async fn measure_backup(
    arguments: &Arguments,
    node: &Path,
    fleet: &Fleet,
    (details, checks): Found<'_>,
) -> anyhow::Result<PathBuf> {
    let rate = f64::from(arguments.segments_per_second);
    let uploads = Uploads::start(fleet, arguments.robots, rate).await?;
    grow(arguments, fleet, &uploads).await?;
    let mut committed = uploads.take().committed;
    eprintln!("the minute before");
    let log = log_of(fleet);
    let (before, before_s) = during(&uploads, Duration::from_secs(arguments.seconds)).await;
    details.log_before_mib = mib(size_of(&log));
    details.database_mib = mib(size_of(&fleet.database_file()));
    eprintln!("the backup of {:.0} MiB", details.database_mib);
    let watch = Watch::start(log.clone());
    let target = fleet.file("backup.tar");
    let mut command = Command::new(node);
    command
        .args(["server", "backup", "--quiet", "--to"])
        .arg(&target);
    command.arg("--database").arg(fleet.database_file());
    let begin = Instant::now();
    let ended = tokio::task::spawn_blocking(move || command.output()).await??;
    let took_s = begin.elapsed().as_secs_f64();
    let said = String::from_utf8_lossy(&ended.stderr);
    ensure!(ended.status.success(), "no backup was made: {said}");
    let during_it = uploads.take();
    let largest = watch.largest();
    let (after, _) = during(&uploads, AFTER).await;
    let grown = watch.largest();
    committed += before.committed + during_it.committed + after.committed;
    let failed = before.failed + during_it.failed + after.failed;
    committed += uploads.stop().await?.committed;
    details.backup_s = took_s;
    details.backup_mib = mib(size_of(&target));
    details.segments_per_second_before = figure(before.committed) / before_s;
    details.segments_per_second_during = figure(during_it.committed) / took_s;
    details.receipt_p50_before_ms = before.quantile_ms(0.5);
    details.receipt_p99_before_ms = before.quantile_ms(0.99);
    details.receipt_p50_during_ms = during_it.quantile_ms(0.5);
    details.receipt_p99_during_ms = during_it.quantile_ms(0.99);
    details.receipt_max_during_ms = during_it.quantile_ms(1.0);
    details.log_largest_mib = mib(largest);
    let usage = fleet.server_usage().context("the server is gone")?;
    details.server_memory_peak_mib = mib(usage.memory_peak_bytes);
    let ratio = details.receipt_p99_during_ms / details.receipt_p99_before_ms;
    // Sums are stored behind the receipts. A difference that stays is counted below.
    if let Err(error) = stored::await_sums(fleet.database()).await {
        eprintln!("{error}");
    }
    let stored = stored::count(fleet.database()).await?;
    checks.extend([
        Check::of("p99 of receipts during the backup / before", ratio).at_most(RECEIPT_RATIO_MAX),
        Check::of(
            "segments/s before the backup",
            details.segments_per_second_before,
        )
        .at_least(0.95 * rate),
        Check::of(
            "largest log / database",
            mib(largest) / details.database_mib,
        )
        .at_most(LOG_RATIO_MAX),
        Check::of(
            "growth of the log after the backup, MiB",
            mib(grown - largest),
        )
        .at_most(64.0),
        Check::of_count("uploads without a receipt", failed).exactly(0),
        Check::of_count(
            "acknowledged segments that are missing",
            committed.saturating_sub(stored.segments.cast_unsigned()),
        )
        .exactly(0),
        Check::of_count(
            "segments counted twice",
            stored.in_sums.abs_diff(stored.segments),
        )
        .exactly(0),
    ]);
    Ok(target)
}

/// Lets the robots upload faster until the database has its size.
async fn grow(arguments: &Arguments, fleet: &Fleet, uploads: &Uploads) -> anyhow::Result<()> {
    eprintln!("filling the database");
    uploads.set_rate(GROWTH_FACTOR * f64::from(arguments.segments_per_second))?;
    let begin = Instant::now();
    while mib(size_of(&fleet.database_file())) < f64::from(arguments.megabytes) {
        ensure!(begin.elapsed() < GROWTH_MAX, "the database does not grow");
        tokio::time::sleep(POLL_INTERVAL).await;
    }
    uploads.set_rate(f64::from(arguments.segments_per_second))
}

async fn during(uploads: &Uploads, time: Duration) -> (Tally, f64) {
    drop(uploads.take());
    let begin = Instant::now();
    tokio::time::sleep(time).await;
    (uploads.take(), begin.elapsed().as_secs_f64())
}

async fn measure_restoration(
    node: &Path,
    fleet: &mut Fleet,
    backup: &Path,
    (details, checks): Found<'_>,
) -> anyhow::Result<()> {
    fleet.stop_server().await?;
    eprintln!("the restoration");
    let mut command = Command::new(node);
    command
        .args(["server", "restore", "--force", "--from"])
        .arg(backup);
    command.arg("--database").arg(fleet.database_file());
    let begin = Instant::now();
    let ended = tokio::task::spawn_blocking(move || command.output()).await??;
    details.restore_s = begin.elapsed().as_secs_f64();
    let said = String::from_utf8_lossy(&ended.stderr);
    ensure!(ended.status.success(), "nothing was restored: {said}");
    fleet.start_server().await;
    details.ready_s = begin.elapsed().as_secs_f64();
    let status: Value = fleet.rest.get("/v1/server").await;
    let is_restored = status["restoration"]["restored_at"].is_string();
    checks.extend([
        Check::of("restoration until ready, s", details.ready_s).at_most(RESTORED_WITHIN_S),
        Check::so("the server says that it was restored", is_restored),
    ]);
    Ok(())
}

async fn measure_upgrade(
    arguments: &Arguments,
    fleet: &mut Fleet,
    (details, checks): Found<'_>,
) -> anyhow::Result<()> {
    eprintln!("the upgrade with {} robots on missions", arguments.agents);
    let mut missions: Vec<(RobotId, MissionId)> = Vec::new();
    for number in 0..arguments.agents {
        let robot: RobotId = format!("rover-{number}").parse()?;
        fleet.start_agent(&robot, APART_M * f64::from(number)).await;
        missions.push((robot, send(fleet, number).await?));
    }
    let running = [MissionState::Active];
    for (_, mission) in &missions {
        fleet.rest.mission_reaches(*mission, &running, DRIVE).await;
    }
    let away = Downtime::watch(fleet);
    fleet.stop_server().await?;
    fleet.start_server().await;
    tokio::time::sleep(Duration::from_secs(1)).await;
    details.rest_away_s = away.longest().as_secs_f64();
    let mut lost = 0_u64;
    for (robot, mission) in &missions {
        let ended = ended(fleet, *mission).await;
        if ended != MissionState::Succeeded {
            eprintln!("mission {mission} of {robot} is {}", ended.as_str());
            lost += 1;
        }
    }
    for (robot, _) in &missions {
        let look = || fleet.rest.robot(robot);
        eventually(&format!("{robot} has uploaded all"), DRIVE, look, |seen| {
            let live = seen.as_ref().and_then(|seen| seen.live.as_ref());
            live.is_some_and(|live| live.outbox.pending == 0)
        })
        .await;
    }
    let missing = missing_records(fleet).await?;
    checks.extend([
        Check::of("REST API away during the upgrade, s", details.rest_away_s)
            .at_most(REST_AWAY_MAX_S),
        Check::of_count("missions that did not succeed", lost).exactly(0),
        Check::of_count("records of robots that are missing", missing).exactly(0),
    ]);
    Ok(())
}

async fn send(fleet: &Fleet, number: u32) -> anyhow::Result<MissionId> {
    let x_m = APART_M * f64::from(number);
    let circle = json!({"circle": {
        "center": {"x_m": x_m, "y_m": 3.0}, "radius_m": 3.0, "speed_m_s": 0.6, "turns": 1.0,
    }});
    let robot: RobotId = format!("rover-{number}").parse()?;
    Ok(fleet.rest.send(&robot, circle).await)
}

async fn ended(fleet: &Fleet, mission: MissionId) -> MissionState {
    let look = || fleet.rest.mission(mission);
    let bound = 2 * DRIVE;
    let detail = eventually("the mission has ended", bound, look, |seen| {
        seen.mission.state.is_terminal()
    })
    .await;
    detail.mission.state
}

/// How long the REST API is away at a stretch.
struct Downtime {
    longest_us: Arc<AtomicU64>,
    _looking: JoinSet<()>,
}

impl Downtime {
    fn watch(fleet: &Fleet) -> Self {
        let url = format!("http://{}/readyz", fleet.http_address());
        let longest_us = Arc::new(AtomicU64::new(0));
        let noted = Arc::clone(&longest_us);
        let mut looking = JoinSet::new();
        looking.spawn(async move {
            let client = reqwest::Client::builder().timeout(Duration::from_secs(1));
            let Ok(client) = client.build() else { return };
            let mut answered_at = Instant::now();
            loop {
                let answer = client.get(&url).send().await;
                if answer.is_ok_and(|answer| answer.status().is_success()) {
                    answered_at = Instant::now();
                }
                let away_us = u64::try_from(answered_at.elapsed().as_micros());
                noted.fetch_max(away_us.unwrap_or(u64::MAX), Ordering::Relaxed);
                tokio::time::sleep(POLL_INTERVAL).await;
            }
        });
        Self {
            longest_us,
            _looking: looking,
        }
    }

    fn longest(&self) -> Duration {
        Duration::from_micros(self.longest_us.load(Ordering::Relaxed))
    }
}

/// The numbers of a run's records have no gap: what is missing was lost.
async fn missing_records(fleet: &Fleet) -> anyhow::Result<u64> {
    let options = SqliteConnectOptions::new().filename(fleet.database_file());
    let mut connection = options.read_only(true).connect().await?;
    let rows = sqlx::query(
        "SELECT COUNT(*), MAX(seq) + 1 FROM (
             SELECT boot_pk, seq FROM segments UNION SELECT boot_pk, seq FROM reports_seen)
         WHERE boot_pk IN (SELECT boots.pk FROM boots JOIN robots ON robots.pk = boots.robot_pk
             WHERE robots.id LIKE 'rover-%')
         GROUP BY boot_pk",
    )
    .fetch_all(&mut connection)
    .await?;
    if rows.is_empty() {
        bail!("no agent of site `{SITE}` has uploaded anything");
    }
    let mut missing = 0;
    for row in rows {
        let (there, all): (i64, i64) = (row.try_get(0)?, row.try_get(1)?);
        missing += u64::try_from(all - there)?;
    }
    Ok(missing)
}
