//! Segments per second, with receipts, and whether each acknowledged one is stored exactly once.

use std::time::Duration;

use anyhow::{Context, ensure};
use hdrhistogram::Histogram;
use nix::sys::statfs::{TMPFS_MAGIC, statfs};
use serde::Serialize;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior};
use tread_tests::database::FleetDatabase;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::LightRobot;
use tread_tests::process::{Usage, usage_of};
use tread_tests::report::figure;
use tread_tests::stored;

use crate::{Arguments, period_of};

/// Shortest time between two uploads of a robot that uploads as fast as receipts arrive.
const SATURATED_EVERY: Duration = Duration::from_millis(1);

/// What the ingest measurement found.
#[derive(Debug, Serialize)]
pub(crate) struct Ingest {
    pub(crate) seconds: f64,
    pub(crate) segments_offered: u64,
    pub(crate) segments_committed: u64,
    pub(crate) segments_per_second: f64,
    pub(crate) ack_p50_ms: f64,
    pub(crate) ack_p99_ms: f64,
    pub(crate) ack_max_ms: f64,
    pub(crate) uploads_failed: u64,
    pub(crate) states_published_per_second: f64,
    pub(crate) server_cpu_us_per_segment: f64,
    pub(crate) acknowledged_but_lost: u64,
    pub(crate) counted_twice: u64,
    pub(crate) sums_per_robot: f64,
    pub(crate) is_on_disk: bool,
    pub(crate) server: Usage,
    pub(crate) generator: Usage,
}

/// What one light robot did.
struct Tally {
    acks_us: Histogram<u64>,
    offered: u64,
    committed: u64,
    failed: u64,
    states: u64,
}

impl Tally {
    fn new() -> anyhow::Result<Self> {
        Ok(Self {
            acks_us: Histogram::new(3)?,
            offered: 0,
            committed: 0,
            failed: 0,
            states: 0,
        })
    }
}

/// A server that is measured.
pub(crate) trait Server {
    /// What its process has used; `None` when it is gone.
    fn usage(&self) -> Option<Usage>;
    /// Its database.
    fn database(&self) -> FleetDatabase;
}

impl Server for Fleet {
    fn usage(&self) -> Option<Usage> {
        self.server_usage()
    }

    fn database(&self) -> FleetDatabase {
        Self::database(self).clone()
    }
}

/// How often robots upload.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Pace {
    /// So many segments per second, of all robots together.
    PerSecond(f64),
    /// The next batch follows the receipt, until the time is over.
    Saturating,
}

pub(crate) async fn measure(
    arguments: &Arguments,
    server: &impl Server,
    robots: Vec<LightRobot>,
    pace: Pace,
) -> anyhow::Result<Ingest> {
    let (robots_count, database) = (robots.len(), server.database());
    let generator_before = usage_of(std::process::id()).context("/proc is not readable")?;
    let server_before = server.usage().context("the server is gone")?;
    let begin = Instant::now();
    let end = begin + Duration::from_secs(arguments.seconds);
    let mut working = JoinSet::new();
    for (index, robot) in robots.into_iter().enumerate() {
        let count = robots_count;
        let plan = UploadPlan::new(arguments, pace, RobotPlace { index, count })?;
        working.spawn(async move { work(robot, plan, end).await });
    }
    let mut all = Tally::new()?;
    while let Some(tally) = working.join_next().await {
        let tally = tally??;
        all.acks_us.add(&tally.acks_us)?;
        all.offered += tally.offered;
        all.committed += tally.committed;
        all.failed += tally.failed;
        all.states += tally.states;
    }
    let seconds = begin.elapsed().as_secs_f64();
    let mut generator = usage_of(std::process::id()).context("/proc is not readable")?;
    generator.cpu_s -= generator_before.cpu_s;
    // Sums are stored behind the receipts; their cost belongs to the segments. A difference that
    // stays is counted below.
    if let Err(error) = stored::await_sums(&database).await {
        eprintln!("{error}");
    }
    let mut used = server.usage().context("the server is gone")?;
    used.cpu_s -= server_before.cpu_s;
    let stored = stored::count(&database).await?;
    let committed = i64::try_from(all.committed)?;
    #[expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]
    let (committed_f64, states_f64) = (all.committed as f64, all.states as f64);
    #[expect(clippy::cast_precision_loss, reason = "microseconds far below 2^53")]
    let quantile_ms = |quantile: f64| all.acks_us.value_at_quantile(quantile) as f64 / 1e3;
    Ok(Ingest {
        seconds,
        segments_offered: all.offered,
        segments_committed: all.committed,
        segments_per_second: committed_f64 / seconds,
        ack_p50_ms: quantile_ms(0.5),
        ack_p99_ms: quantile_ms(0.99),
        ack_max_ms: quantile_ms(1.0),
        uploads_failed: all.failed,
        states_published_per_second: states_f64 / seconds,
        server_cpu_us_per_segment: 1e6 * used.cpu_s / committed_f64.max(1.0),
        // An upload without receipt may or may not be stored, so more may be there than was
        // acknowledged, never less; the sums must hold each stored one once.
        acknowledged_but_lost: (committed - stored.segments).max(0).cast_unsigned(),
        counted_twice: (stored.in_sums - stored.segments).unsigned_abs()
            + stored.doubles.cast_unsigned(),
        sums_per_robot: figure(stored.sums.cast_unsigned()) / figure(robots_count as u64),
        is_on_disk: statfs(&database.folder())?.filesystem_type() != TMPFS_MAGIC,
        server: used,
        generator,
    })
}

impl Ingest {
    /// Returns what is not among the checks, in a line.
    pub(crate) fn words(&self) -> String {
        let Self {
            server, generator, ..
        } = self;
        let memory_mb = |usage: &Usage| usage.memory_peak_bytes / 1_000_000;
        format!(
            "{:.0} segments/s, {:.0} states/s; server {:.1} s CPU, {} MB at most; generator {:.1} s \
             CPU, {} MB at most; ack p50 {:.1}, p99 {:.1}, max {:.1} ms",
            self.segments_per_second,
            self.states_published_per_second,
            server.cpu_s,
            memory_mb(server),
            generator.cpu_s,
            memory_mb(generator),
            self.ack_p50_ms,
            self.ack_p99_ms,
            self.ack_max_ms,
        )
    }
}

/// Place of a robot among all of them.
#[derive(Clone, Copy)]
struct RobotPlace {
    index: usize,
    count: usize,
}

#[derive(Clone, Copy)]
struct UploadPlan {
    records: usize,
    every: Duration,
    first: Duration,
    state_every: Duration,
    /// Whether the next upload follows the receipt, until the time is over.
    saturates: bool,
}

impl UploadPlan {
    fn new(
        arguments: &Arguments,
        pace: Pace,
        RobotPlace { index, count }: RobotPlace,
    ) -> anyhow::Result<Self> {
        let per_second = match pace {
            Pace::PerSecond(per_second) => per_second,
            Pace::Saturating => {
                return Ok(Self {
                    records: arguments.records.into(),
                    every: SATURATED_EVERY,
                    first: Duration::ZERO,
                    state_every: period_of(arguments.state_rate_hz),
                    saturates: true,
                });
            }
        };
        let every = Duration::from_millis(arguments.upload_every_ms);
        let all_per_upload = per_second * every.as_secs_f64();
        let records = all_per_upload / f64::from(u32::try_from(count)?);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "small"
        )]
        let records = records.round() as usize;
        let most = tread_api::wire::ingest::BATCH_RECORDS_MAX;
        ensure!(
            (1..=most).contains(&records),
            "{records} segments for each upload: choose --segments-per-second and \
             --upload-every-ms so that it is 1 to {most}"
        );
        // The robots are spread over the period: they do not upload in step.
        let first =
            every.mul_f64(f64::from(u32::try_from(index)?) / f64::from(u32::try_from(count)?));
        Ok(Self {
            records,
            every,
            first,
            state_every: period_of(arguments.state_rate_hz),
            saturates: false,
        })
    }
}

async fn work(mut robot: LightRobot, plan: UploadPlan, end: Instant) -> anyhow::Result<Tally> {
    let mut tally = Tally::new()?;
    let start = Instant::now() + plan.first;
    let mut uploads = tokio::time::interval_at(start, plan.every);
    // A late receipt does not lower the offered rate: what was missed is caught up.
    uploads.set_missed_tick_behavior(MissedTickBehavior::Burst);
    let mut states = tokio::time::interval_at(start, plan.state_every);
    states.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        tokio::select! {
            due = uploads.tick() => {
                let is_over = if plan.saturates {
                    Instant::now() >= end
                } else {
                    due >= end
                };
                if is_over {
                    return Ok(tally);
                }
                let batch = robot.next_batch(plan.records);
                tally.offered += batch.records.len() as u64;
                match robot.upload(&batch).await {
                    Ok((receipt, took)) => {
                        tally.committed += receipt.committed;
                        tally.acks_us.record(u64::try_from(took.as_micros())?)?;
                    }
                    Err(_) => tally.failed += 1,
                }
            }
            _ = states.tick() => {
                robot.publish_state().await?;
                tally.states += 1;
            }
        }
    }
}
