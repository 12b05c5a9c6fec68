//! Light robots that upload segments at a rate which may change, until they are stopped.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::ensure;
use hdrhistogram::Histogram;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior};
use tread_api::wire::ingest::BATCH_RECORDS_MAX;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::LightRobot;

/// Time between two uploads of a robot.
const EVERY: Duration = Duration::from_millis(250);

/// What all robots did since the last look.
#[derive(Debug)]
pub(crate) struct Tally {
    acks_us: Histogram<u64>,
    pub(crate) committed: u64,
    pub(crate) failed: u64,
}

impl Tally {
    fn new() -> Self {
        let acks_us = Histogram::new(3).expect("three digits are possible");
        Self {
            acks_us,
            committed: 0,
            failed: 0,
        }
    }

    #[expect(clippy::cast_precision_loss, reason = "microseconds far below 2^53")]
    pub(crate) fn quantile_ms(&self, quantile: f64) -> f64 {
        self.acks_us.value_at_quantile(quantile) as f64 / 1e3
    }
}

#[derive(Debug)]
struct Shared {
    records: AtomicUsize,
    stop: AtomicBool,
    tally: Mutex<Tally>,
}

/// Light robots at work.
pub(crate) struct Uploads {
    shared: Arc<Shared>,
    robots: f64,
    working: JoinSet<anyhow::Result<()>>,
}

impl Uploads {
    /// Connects the robots and lets them upload so many segments per second, all together.
    pub(crate) async fn start(fleet: &Fleet, robots: u32, rate: f64) -> anyhow::Result<Self> {
        let shared = Arc::new(Shared {
            records: AtomicUsize::new(1),
            stop: AtomicBool::new(false),
            tally: Mutex::new(Tally::new()),
        });
        let mut working = JoinSet::new();
        let (endpoint, site) = (fleet.zenoh_endpoint(), fleet.site());
        for number in 0..robots {
            let id = format!("light-{number}").parse()?;
            let robot = LightRobot::start(&endpoint, &site, id).await?;
            // The robots are spread over the period: they do not upload in step.
            let first = EVERY.mul_f64(f64::from(number) / f64::from(robots));
            working.spawn(work(robot, Arc::clone(&shared), first));
        }
        let robots = f64::from(robots);
        let uploads = Self {
            shared,
            robots,
            working,
        };
        uploads.set_rate(rate)?;
        Ok(uploads)
    }

    /// Changes how many segments are uploaded per second.
    pub(crate) fn set_rate(&self, rate: f64) -> anyhow::Result<()> {
        let records = (rate * EVERY.as_secs_f64() / self.robots).round();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "checked below"
        )]
        let records = records as usize;
        ensure!(
            (1..=BATCH_RECORDS_MAX).contains(&records),
            "{records} segments for each upload: choose other --robots or --segments-per-second"
        );
        self.shared.records.store(records, Ordering::Relaxed);
        Ok(())
    }

    /// What was done since the last look.
    pub(crate) fn take(&self) -> Tally {
        let mut tally = self
            .shared
            .tally
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        std::mem::replace(&mut *tally, Tally::new())
    }

    /// Stops the robots, after the uploads under way.
    pub(crate) async fn stop(mut self) -> anyhow::Result<Tally> {
        self.shared.stop.store(true, Ordering::Relaxed);
        while let Some(ended) = self.working.join_next().await {
            ended??;
        }
        Ok(self.take())
    }
}

async fn work(mut robot: LightRobot, shared: Arc<Shared>, first: Duration) -> anyhow::Result<()> {
    let mut uploads = tokio::time::interval_at(Instant::now() + first, EVERY);
    // A late receipt does not lower the offered rate: what was missed is caught up.
    uploads.set_missed_tick_behavior(MissedTickBehavior::Burst);
    while !shared.stop.load(Ordering::Relaxed) {
        uploads.tick().await;
        let batch = robot.next_batch(shared.records.load(Ordering::Relaxed));
        let uploaded = robot.upload(&batch).await;
        let mut tally = shared.tally.lock().unwrap_or_else(PoisonError::into_inner);
        match uploaded {
            Ok((receipt, took)) => {
                tally.committed += receipt.committed;
                tally.acks_us.record(u64::try_from(took.as_micros())?)?;
            }
            Err(_) => tally.failed += 1,
        }
    }
    Ok(())
}
