//! How fast the ingest writer stores segments: `cargo run --release -p tread-server --example
//! ingest_bench -- [segments] [robots] [batch]`. No network; the generator runs in the same
//! process on a thread of its own, whose processor time is measured apart.

use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use tokio::runtime::Runtime;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use tread_api::friction::{Information, Segment};
use tread_api::ids::{BootId, RobotId, SiteId};
use tread_api::robot::{RobotLimits, RobotModel};
use tread_api::site::Cell;
use tread_api::terrain::TerrainRef;
use tread_api::wire;
use tread_api::wire::hello::Hello;
use tread_api::wire::ingest::{Batch, Record, RecordContent};
use tread_server::app::ingest::{self, UPLOADS_WAITING_MAX, Upload};
use tread_server::app::{App, sums};
use tread_server::clock::Clock;
use tread_server::config::{FrictionConfig, StorageConfig};
use tread_server::db::Db;
use tread_server::supervisor::Supervisor;
use uuid::Uuid;

/// Batches that wait for their answers at the same time.
const BATCHES_WAITING: usize = 32;
/// Microseconds of one tick of the kernel's accounting of processor time.
const TICK_US: u64 = 10_000;

fn model() -> RobotModel {
    RobotModel {
        name: "bench".to_owned(),
        tyres: "any".to_owned(),
        mass_kg: 50.0,
        track_width_m: 0.6,
        wheelbase_m: 0.5,
        wheel_radius_m: 0.15,
        yaw_inertia_kg_m2: 3.0,
        limits: RobotLimits {
            linear_max_m_s: 2.0,
            angular_max_rad_s: 2.0,
            linear_acceleration_max_m_s2: 1.0,
            lateral_acceleration_max_m_s2: 1.0,
            linear_jerk_max_m_s3: 5.0,
            wheel_speed_max_rad_s: 20.0,
            wheel_acceleration_max_rad_s2: 50.0,
        },
    }
}

/// A drive in rows over a field of 200 by 200 cells; each robot begins elsewhere.
fn segment(robot: usize, seq: u64, template: &Segment) -> anyhow::Result<Segment> {
    let place = (u64::try_from(robot)? * 397 + seq) % 40_000;
    let (ix, iy) = (i32::try_from(place % 200)?, i32::try_from(place / 200)?);
    let number = f64::from(ix);
    Ok(Segment {
        cell: Cell { ix, iy },
        theta: Information {
            information: 812.345_678 + number,
            weighted: 162.468_9 + number,
        },
        ..template.clone()
    })
}

fn processor_us(path: &str) -> anyhow::Result<u64> {
    let text = fs::read_to_string(path)?;
    let fields = text.rsplit(')').next().context("no fields")?;
    let mut fields = fields.split_whitespace().skip(11);
    let mut tick = || -> anyhow::Result<u64> { Ok(fields.next().context("no field")?.parse()?) };
    Ok((tick()? + tick()?) * TICK_US)
}

fn template(clock: &Clock) -> anyhow::Result<Segment> {
    let now = clock.now();
    Ok(Segment {
        configuration: model().configuration(),
        mission: Some(clock.new_id()),
        started_at: now,
        ended_at: now,
        grid_revision: 1,
        cell: Cell { ix: 0, iy: 0 },
        terrain: Some(TerrainRef {
            id: "lawn".parse()?,
            revision: 1,
        }),
        theta: Information {
            information: 1.0,
            weighted: 1.0,
        },
        theta_errors: None,
        effective_track_ratio: Some(Information {
            information: 331.234_567,
            weighted: 560.1,
        }),
        rolling_resistance: Some(Information {
            information: 2_331.234_567,
            weighted: 46.123,
        }),
        mu_peak_lower_bound: Some(0.412_345_678),
        samples: 137,
        distance_m: 0.823_456_789,
        saturation_ratio: 0.0123,
    })
}

/// A server's writer without its network, and robots that have said hello.
struct Bench {
    runtime: Runtime,
    app: App,
    site: SiteId,
    robots: Vec<RobotId>,
    boot: BootId,
    uploads: mpsc::Sender<Upload>,
}

impl Bench {
    fn start(database: &Path, robots: usize) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()?;
        let db = runtime.block_on(Db::open(database))?;
        let app = App::without_robots(
            db,
            Clock::system(),
            FrictionConfig::default(),
            StorageConfig::default(),
        );
        let site: SiteId = "yard".parse()?;
        let robots: Vec<RobotId> = (0..robots)
            .map(|robot| format!("r-{robot}").parse())
            .collect::<Result<_, _>>()?;
        let boot = BootId::from_uuid(Uuid::from_u128(1));
        runtime.block_on(introduce(&app, &site, &robots, boot))?;
        let supervisor = Supervisor::new();
        let (uploads, uploads_in) = mpsc::channel(UPLOADS_WAITING_MAX);
        let writer = ingest::run(app.clone(), uploads_in, supervisor.stop_token());
        let entered = runtime.enter();
        supervisor.spawn_vital("ingest", writer);
        supervisor.spawn_vital("sums", sums::run(app.clone(), supervisor.stop_token()));
        drop(entered);
        Ok(Self {
            runtime,
            app,
            site,
            robots,
            boot,
            uploads,
        })
    }

    /// Sends segments and waits for their answers. Gives the processor time of the sending in
    /// microseconds, and the waiting times in rising order.
    fn generate(&self, segments: usize, batch: usize) -> anyhow::Result<(u64, Vec<Duration>)> {
        let template = template(self.app.clock())?;
        let waiting = Arc::new(Semaphore::new(BATCHES_WAITING));
        let mut answers = Vec::new();
        let mut sent = 0;
        let reader = tokio::runtime::Builder::new_current_thread().build()?;
        let before_us = processor_us("/proc/thread-self/stat")?;
        for (turn, index) in (0..).flat_map(|turn| (0..self.robots.len()).map(move |i| (turn, i))) {
            if sent >= segments {
                break;
            }
            let first = u64::try_from(turn * batch)?;
            let records = (first..first + u64::try_from(batch)?)
                .map(|seq| {
                    let content = RecordContent::Segment(segment(index, seq, &template)?);
                    Ok(Record { seq, content })
                })
                .collect::<anyhow::Result<_>>()?;
            let robot = self.robots.get(index).context("no such robot")?.clone();
            let payload = wire::encode(&Batch {
                robot_time: None,
                robot,
                boot: self.boot,
                records,
            })?;
            let slot = reader.block_on(Arc::clone(&waiting).acquire_owned())?;
            let serving = serve(payload, self.site.clone(), self.uploads.clone(), slot);
            answers.push(self.runtime.spawn(serving));
            sent += batch;
        }
        let own_us = processor_us("/proc/thread-self/stat")? - before_us;
        let (mut committed, mut waits) = (0, Vec::new());
        for answer in answers {
            let (count, wait) = reader.block_on(answer)??;
            committed += count;
            waits.push(wait);
        }
        anyhow::ensure!(
            committed == u64::try_from(sent)?,
            "{committed} of {sent} were committed"
        );
        waits.sort_unstable();
        Ok((own_us, waits))
    }
}

async fn introduce(
    app: &App,
    site: &SiteId,
    robots: &[RobotId],
    boot: BootId,
) -> anyhow::Result<()> {
    app.ensure_site(site).await?;
    for robot in robots {
        let hello = Hello {
            robot: robot.clone(),
            boot,
            agent_version: "bench".to_owned(),
            model: model(),
            robot_time: app.clock().now(),
            capabilities: tread_api::robot::Capabilities::default(),
        };
        app.hello(site, &hello)
            .await
            .map_err(|refusal| anyhow::anyhow!(refusal.detail))?;
    }
    Ok(())
}

/// The server's part: reads what came over the network, and hands it to the writer.
#[expect(clippy::disallowed_methods, reason = "it measures")]
async fn serve(
    payload: Vec<u8>,
    site: SiteId,
    uploads: mpsc::Sender<Upload>,
    slot: OwnedSemaphorePermit,
) -> anyhow::Result<(u64, Duration)> {
    let arrived = Instant::now();
    let batch: Batch = wire::decode(&payload)?;
    let (answer, answered) = oneshot::channel();
    uploads
        .send(Upload {
            site,
            batch,
            answer,
        })
        .await?;
    let receipt = answered
        .await?
        .map_err(|refusal| anyhow::anyhow!(refusal.detail))?;
    drop(slot);
    Ok((receipt.committed, arrived.elapsed()))
}

#[expect(clippy::print_stdout, reason = "this is what it is for")]
#[expect(clippy::disallowed_methods, reason = "it measures")]
#[expect(clippy::cast_precision_loss, reason = "far below 2^53")]
fn main() -> anyhow::Result<()> {
    let mut numbers = std::env::args()
        .skip(1)
        .map(|argument| argument.parse::<usize>());
    let mut number = |default| numbers.next().unwrap_or(Ok(default));
    let (segments, robots, batch) = (number(400_000)?, number(50)?, number(200)?);
    let folder = tempfile::tempdir()?;
    let bench = Bench::start(&folder.path().join("bench.db"), robots)?;
    let before_us = processor_us("/proc/self/stat")?;
    let started = Instant::now();
    let generated = std::thread::scope(|scope| {
        let generator = scope.spawn(|| bench.generate(segments, batch));
        generator
            .join()
            .map_err(|_panic| anyhow::anyhow!("the generator panicked"))?
    });
    let (generator_us, waits) = generated?;
    // What is stored behind the receipts belongs to them.
    bench.runtime.block_on(bench.app.write_sums())?;
    let span_s = started.elapsed().as_secs_f64();
    let server_us = processor_us("/proc/self/stat")? - before_us - generator_us;
    let count = bench.app.counters().segments_committed.get() as f64;
    let quantile = |share: f64| -> f64 {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "an index"
        )]
        let index = ((waits.len() - 1) as f64 * share) as usize;
        waits.get(index).map_or(0.0, Duration::as_secs_f64) * 1e3
    };
    println!(
        "{:.0} segments/s, {:.1} µs of server CPU each, ack p50 {:.1} ms, p99 {:.1} ms, \
         {:.0} segments per transaction",
        count / span_s,
        server_us as f64 / count,
        quantile(0.5),
        quantile(0.99),
        count / bench.app.counters().ingest_transactions.get() as f64,
    );
    Ok(())
}
