//! How fast and how large the map is: `cargo run --release -p tread-server --example map_report --
//! --json`. A million cells, each driven by three robots; then, through the whole REST API and over
//! a database on the disk, paths of a kilometre, and once more with tiles of 256 by 256 cells while
//! robots upload 50 000 segments a second to the same cells. At last the whole map is exported. Exits with
//! 1 if a goal is missed. With `--memory-max-mib 64` most of the map is not in memory, and the goals of
//! time do not apply.

mod figures;

use std::alloc::System;
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use axum::body::{Body, to_bytes};
use axum::http::{Request, StatusCode, header};
use serde_json::json;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use tokio::sync::{mpsc, oneshot};
use tower::ServiceExt as _;
use tread_api::friction::{Information, Segment};
use tread_api::ids::{BootId, ConfigurationId, RobotId, SiteId};
use tread_api::robot::{Capabilities, RobotModel};
use tread_api::site::Cell;
use tread_api::wire::hello::Hello;
use tread_api::wire::ingest::{Batch, Record, RecordContent};
use tread_samples::rover;
use tread_server::app::checkpoints;
use tread_server::app::identity::tokens::FirstAdmin;
use tread_server::app::ingest::{self, UPLOADS_WAITING_MAX, Upload};
use tread_server::app::{App, BlockCounts, Dependencies, map_blocks, sums};
use tread_server::clock::Clock;
use tread_server::config::MapConfig;
use tread_server::db::Db;
use tread_server::friction::index::{CELLS_PER_BLOCK, CellSummary, LabelledSum, SiteMap};
use tread_server::friction::{Horizons, Sums, epoch_h};
use tread_server::http;
use tread_server::identity::origin::Names;
use tread_server::supervisor::Supervisor;
use uuid::Uuid;

use self::figures::{Check, Figure, writeln_out};

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Cells along a side of the map.
const SIDE_CELLS: i32 = 1_000;
/// Robots that have driven each cell.
const ROBOTS: u32 = 3;
/// Segments of one upload.
const BATCH: u32 = 100;
/// Uploads each second, for 50 000 segments.
const BATCHES_PER_S: u32 = 500;
const QUESTIONS: i32 = 300;
const TILES: i32 = 300;
const TILE_CELLS: i32 = 256;
/// Time between two questions.
const PAUSE: Duration = Duration::from_millis(20);

fn site() -> anyhow::Result<SiteId> {
    Ok("yard".parse()?)
}

fn model() -> RobotModel {
    rover("report rover")
}

fn segment(configuration: ConfigurationId, cell: Cell, robot: u32, at: jiff::Timestamp) -> Segment {
    let theta = 0.2 + 0.002 * f64::from(robot) + 1.0e-4 * f64::from(cell.ix.rem_euclid(100));
    Segment {
        configuration,
        mission: None,
        started_at: at,
        ended_at: at,
        grid_revision: 1,
        cell,
        terrain: None,
        theta: Information {
            information: 2_500.0,
            weighted: 2_500.0 * theta,
        },
        theta_errors: None,
        effective_track_ratio: None,
        rolling_resistance: None,
        mu_peak_lower_bound: Some(0.3),
        samples: 100,
        distance_m: 1.0,
        saturation_ratio: 0.0,
    }
}

#[expect(clippy::cast_precision_loss, reason = "bytes and counts below 2^53")]
fn ratio(part: usize, whole: usize) -> f64 {
    part as f64 / whole as f64
}

/// Bytes per sum of a map of a million cells, each driven by every robot, with its kept squares.
fn bytes_per_sum(robots: &[RobotId]) -> anyhow::Result<(f64, f64)> {
    let at = jiff::Timestamp::from_second(1_793_000_000)?;
    let region = Region::new(ALLOCATOR);
    let mut map = SiteMap::new(1, Horizons::default());
    for place in 0..SIDE_CELLS * SIDE_CELLS {
        let cell = Cell {
            ix: place % SIDE_CELLS,
            iy: place / SIDE_CELLS,
        };
        for (number, robot) in (0..).zip(robots) {
            let segment = segment(model().configuration(), cell, number, at);
            let labelled = LabelledSum {
                cell,
                grid_revision: 1,
                terrain: &None,
                configuration: segment.configuration,
                robot,
                epoch_h: epoch_h(at),
            };
            map.add(labelled, &Sums::of(&segment).context("out of range")?);
        }
    }
    let change = region.change();
    let held = change.bytes_allocated - change.bytes_deallocated;
    let blocks = map.changes().blocks().count();
    let squares = blocks * CELLS_PER_BLOCK * (size_of::<CellSummary>() + size_of::<u16>());
    let sums = map.part_count();
    Ok((ratio(held, sums), ratio(held + squares, sums)))
}

/// The sums of the same map in a database; SQLite makes them itself, which is faster.
async fn fill(db: &Db, epoch_h: i64) -> anyhow::Result<()> {
    let mut tx = db.write("test").await?;
    // θ in quarters of a unit of information times θ, so that everything is whole.
    sqlx::query(
        "WITH RECURSIVE places (place) AS
             (SELECT 0 UNION ALL SELECT place + 1 FROM places WHERE place < ?1 * ?1 - 1),
         numbers AS (SELECT robots.pk AS robot_pk, robots.configuration_pk, robots.site_pk,
             place / ?1 AS iy, place % ?1 AS ix,
             2000 + 20 * (robots.pk % 3) + place % 100 AS q FROM robots JOIN places)
         INSERT INTO cell_sums (site_pk, iy, ix, grid_revision, terrain, terrain_revision,
             robot_pk, configuration_pk, epoch_h, information_hi, information_lo, weighted_hi,
             weighted_lo, segments, samples, mu_peak, newest_at_us, square_hi, square_lo,
             newest_information, newest_weighted, newest_mu, pass_at_us)
         SELECT site_pk, iy, ix, 1, '', 0, robot_pk, configuration_pk, ?2, 2500, 0, q / 4,
             (q % 4) << 30, 1, 100, 0.3, ?2 * 3600000000, q * q / 40000,
             ((q * q % 40000) << 32) / 40000, 2500.0, q / 4.0, 0.3, ?2 * 3600000000
         FROM numbers ORDER BY robot_pk, iy, ix",
    )
    .bind(SIDE_CELLS)
    .bind(epoch_h)
    .execute(&mut **tx.as_sqlite().expect("it is a file"))
    .await?;
    tx.commit().await?;
    Ok(())
}

/// What the uploads came to.
struct Uploaded {
    segments_per_s: f64,
    ack_p99_ms: f64,
}

/// Uploads at a fixed rate until the stop.
#[expect(clippy::disallowed_methods, reason = "a measurement of real time")]
async fn upload(
    robots: Vec<RobotId>,
    uploads: mpsc::Sender<Upload>,
    stop: Arc<AtomicBool>,
) -> anyhow::Result<Uploaded> {
    let began = Instant::now();
    let (mut next, mut number, mut seq) = (began, 0_u32, 0_u64);
    let mut acks = tokio::task::JoinSet::new();
    let mut took = Vec::new();
    let configuration = model().configuration();
    while !stop.load(Ordering::Relaxed) {
        next += Duration::from_secs(1) / BATCHES_PER_S;
        let of = number % ROBOTS;
        let now = jiff::Timestamp::now();
        let records = (0..BATCH).map(|_| {
            number = number.wrapping_add(1);
            seq += 1;
            let place = i32::try_from(number.wrapping_mul(7_919) % 1_000_000).unwrap_or(0);
            let cell = Cell {
                ix: place % SIDE_CELLS,
                iy: place / SIDE_CELLS,
            };
            Record {
                seq,
                content: RecordContent::Segment(segment(configuration, cell, of, now)),
            }
        });
        let batch = Batch {
            robot: robots.get(of as usize).context("no such robot")?.clone(),
            boot: BootId::from_uuid(Uuid::from_u128(1)),
            robot_time: None,
            records: records.collect(),
        };
        let (answer, answered) = oneshot::channel();
        let asked = Instant::now();
        let upload = Upload {
            site: site()?,
            batch,
            answer,
        };
        uploads.send(upload).await?;
        acks.spawn(async move {
            let answered = answered.await;
            (answered, asked.elapsed())
        });
        while let Some(ack) = acks.try_join_next() {
            let (answered, ack) = ack?;
            let receipt = answered?.map_err(|refusal| anyhow::anyhow!("{refusal:?}"))?;
            anyhow::ensure!(receipt.committed == u64::from(BATCH), "{receipt:?}");
            took.push(ack);
        }
        tokio::time::sleep_until(next.into()).await;
    }
    Ok(Uploaded {
        segments_per_s: f64::from(number) / began.elapsed().as_secs_f64(),
        ack_p99_ms: p99_ms(took)?,
    })
}

fn p99_ms(mut took: Vec<Duration>) -> anyhow::Result<f64> {
    took.sort_unstable();
    let index = (took.len() * 99).div_ceil(100).saturating_sub(1);
    let p99 = took.get(index).context("nothing was asked")?;
    Ok(1.0e3 * p99.as_secs_f64())
}

/// Asks the whole API one question after another, and says how long 99 of a hundred took at most.
#[expect(clippy::disallowed_methods, reason = "a measurement of real time")]
async fn asked(
    router: &axum::Router,
    count: i32,
    question: impl Fn(i32) -> anyhow::Result<Request<Body>>,
    least_bytes: usize,
) -> anyhow::Result<f64> {
    let mut took = Vec::new();
    for number in 0..count {
        let request = question(number)?;
        let asked = Instant::now();
        let answer = router.clone().oneshot(request).await?;
        let status = answer.status();
        let body = to_bytes(answer.into_body(), usize::MAX).await?;
        took.push(asked.elapsed());
        anyhow::ensure!(
            status == StatusCode::OK && body.len() >= least_bytes,
            "{status}, {} bytes: {}",
            body.len(),
            String::from_utf8_lossy(&body)
                .chars()
                .take(300)
                .collect::<String>()
        );
        tokio::time::sleep(PAUSE).await;
    }
    p99_ms(took)
}

/// A server without a network, with a million cells.
async fn server(
    folder: &Path,
    robots: &[RobotId],
    map: MapConfig,
) -> anyhow::Result<(App, String)> {
    let db = Db::open(&folder.join("map.db")).await?;
    let app = App::new(Dependencies {
        map,
        ..Dependencies::on_database(db, Clock::system())
    });
    app.ensure_site(&site()?).await?;
    for robot in robots {
        let hello = Hello {
            robot: robot.clone(),
            boot: BootId::from_uuid(Uuid::from_u128(1)),
            agent_version: "0".to_owned(),
            model: model(),
            robot_time: app.clock().now(),
            capabilities: Capabilities::default(),
        };
        let welcome = app.hello(&site()?, &hello).await;
        welcome.map_err(|refused| anyhow::anyhow!("{refused:?}"))?;
    }
    fill(app.db(), epoch_h(app.clock().now()) - 2).await?;
    app.load_map().await?;
    let first = FirstAdmin {
        name: "report".to_owned(),
        valid_days: 1,
        force: true,
    };
    let token = app.create_first_admin(first).await?.secret;
    Ok((app, token))
}

fn request(token: &str, method: &str, path: &str, body: Body) -> anyhow::Result<Request<Body>> {
    Ok(Request::builder()
        .method(method)
        .uri(path)
        .header(header::HOST, "localhost")
        .header(header::AUTHORIZATION, format!("Bearer {token}"))
        .header(header::CONTENT_TYPE, "application/json")
        .body(body)?)
}

/// How long questions took.
struct Asked {
    path_p99_ms: f64,
    path_under_uploads_p99_ms: f64,
    tile_p99_ms: f64,
    /// The longest of the first tiles of three places.
    tile_first_ms: f64,
    uploaded: Uploaded,
    export_s: f64,
    blocks: BlockCounts,
    rss_peak_mib: f64,
}

/// Asks for paths while nothing else happens, and for paths and tiles while robots upload.
async fn measured(folder: &Path, robots: &[RobotId], map: MapConfig) -> anyhow::Result<Asked> {
    let (app, token) = server(folder, robots, map).await?;
    let supervisor = Supervisor::new();
    let (uploads, uploads_in) = mpsc::channel(UPLOADS_WAITING_MAX);
    let writer = ingest::run(app.clone(), uploads_in, supervisor.stop_token());
    supervisor.spawn_vital("ingest", writer);
    supervisor.spawn_vital("sums", sums::run(app.clone(), supervisor.stop_token()));
    let evicting = map_blocks::run(app.clone(), supervisor.stop_token());
    supervisor.spawn_vital("map blocks", evicting);
    let logging = checkpoints::run(app.clone(), supervisor.stop_token());
    supervisor.spawn_vital("checkpoints", logging);
    let router = http::router(app.clone(), Names::default());
    let stop = Arc::new(AtomicBool::new(false));
    // A kilometre across the map, changing rows: a cell for each metre and some more.
    let path = |number: i32| {
        let y_m = f64::from(number * 3) + 0.25;
        let body = json!({"robot": "rover-0", "points": [
            {"x_m": 0.0, "y_m": y_m}, {"x_m": 500.0, "y_m": y_m + 60.0}, {"x_m": 996.0, "y_m": y_m}]});
        let route = "/v1/sites/yard/friction/path";
        request(&token, "POST", route, Body::from(body.to_string()))
    };
    let configuration = model().configuration();
    let tile = |number: i32| {
        let low = f64::from(number * 3 % (SIDE_CELLS - TILE_CELLS)) + 0.5;
        let high = low + f64::from(TILE_CELLS) - 1.0;
        let route = format!(
            "/v1/sites/yard/friction/map?format=tile&configuration={configuration}\
             &x_min_m={low}&y_min_m={low}&x_max_m={high}&y_max_m={high}"
        );
        request(&token, "GET", &route, Body::empty())
    };
    // The first time of each place: nothing of it is kept.
    let cold = |number: i32| tile(number % 3 * 83);
    let path_p99_ms = asked(&router, QUESTIONS, path, 100_000).await?;
    let mut uploading = tokio::task::JoinSet::new();
    uploading.spawn(upload(robots.to_vec(), uploads, Arc::clone(&stop)));
    let tile_first_ms = asked(&router, 3, cold, 4 * 65_536).await?;
    let path_under_uploads_p99_ms = asked(&router, QUESTIONS, path, 100_000).await?;
    let tile_p99_ms = asked(&router, TILES, tile, 4 * 65_536).await?;
    stop.store(true, Ordering::Relaxed);
    let uploaded = uploading.join_next().await.context("nobody uploads")???;
    let export = |_| {
        let route = "/v1/sites/yard/friction/map?format=csv";
        request(&token, "GET", route, Body::empty())
    };
    // An answer is read as a whole here, which takes memory too.
    let rss_peak_mib = rss_peak_mib()?;
    let export_s = asked(&router, 1, export, 100_000_000).await? / 1.0e3;
    let blocks = app.map_blocks();
    supervisor.stop().await?;
    app.db().close().await;
    Ok(Asked {
        path_p99_ms,
        path_under_uploads_p99_ms,
        tile_p99_ms,
        tile_first_ms,
        uploaded,
        export_s,
        blocks,
        rss_peak_mib,
    })
}

/// The largest resident memory of this process so far.
fn rss_peak_mib() -> anyhow::Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib: f64 = line
        .and_then(|line| line.trim().strip_suffix("kB"))
        .context("no VmHWM")?
        .trim()
        .parse()?;
    Ok(kib / 1_024.0)
}

/// `--memory-max-mib`, and its default.
fn memory() -> anyhow::Result<(MapConfig, bool)> {
    let mut arguments = std::env::args().skip_while(|argument| argument != "--memory-max-mib");
    match arguments.nth(1) {
        Some(mib) => Ok((
            MapConfig {
                memory_max_mib: mib.parse()?,
            },
            true,
        )),
        None => Ok((MapConfig::default(), false)),
    }
}

fn main() -> anyhow::Result<ExitCode> {
    let (memory, is_small) = memory()?;
    let robots: Vec<RobotId> = (0..ROBOTS)
        .map(|number| format!("rover-{number}").parse())
        .collect::<Result<_, _>>()?;
    let folder = tempfile::tempdir()?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let asked = runtime.block_on(measured(folder.path(), &robots, memory))?;
    // At last, since it takes memory of its own.
    let (bytes, with_squares) = bytes_per_sum(&robots)?;
    let Uploaded {
        segments_per_s,
        ack_p99_ms,
    } = asked.uploaded;
    let checks = [
        Figure::of("memory_bytes_per_sum", with_squares).at_most(200.0),
        Figure::of("path_1_km_p99_ms", asked.path_p99_ms).at_most(3.0),
        Figure::of(
            "path_1_km_under_uploads_p99_ms",
            asked.path_under_uploads_p99_ms,
        )
        .at_most(5.0),
        Figure::of("tile_256_p99_ms", asked.tile_p99_ms).at_most(15.0),
        Figure::of("segments_per_s", segments_per_s).at_least(47_500.0),
        Figure::of("upload_ack_p99_ms", ack_p99_ms).at_most(100.0),
    ];
    let figures = [
        ("memory_bytes_per_sum_without_kept_squares", bytes),
        ("tile_256_first_time_longest_of_3_ms", asked.tile_first_ms),
        ("export_of_all_cells_s", asked.export_s),
        ("resident_memory_peak_mib", asked.rss_peak_mib),
        ("blocks", ratio(asked.blocks.driven, 1)),
        (
            "blocks_in_memory_at_the_end",
            ratio(asked.blocks.in_memory, 1),
        ),
        ("blocks_read", ratio(usize::try_from(asked.blocks.read)?, 1)),
        (
            "blocks_evicted",
            ratio(usize::try_from(asked.blocks.evicted)?, 1),
        ),
    ];
    let is_json = std::env::args().any(|argument| argument == "--json");
    if is_json {
        let checks = checks.each_ref().map(|check| {
            json!({
                "name": check.name, "goal": check.goal,
                "value": check.value, "holds": check.holds,
            })
        });
        let figures = figures.map(|(name, value)| json!({"name": name, "value": value}));
        writeln_out(&json!({"checks": checks, "figures": figures}).to_string())?;
    } else {
        for Check {
            name,
            goal,
            value,
            holds,
        } in &checks
        {
            writeln_out(&format!("{name}: {value:.2} (goal {goal}), holds: {holds}"))?;
        }
        for (name, value) in figures {
            writeln_out(&format!("{name}: {value:.2}"))?;
        }
    }
    Ok(if is_small || checks.iter().all(|check| check.holds) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}
