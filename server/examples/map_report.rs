//! How fast and how large the map in memory is: `cargo run --release -p tread-server --example
//! map_report -- --json`. A million cells, a path of a kilometre, tiles of 256 by 256 cells while
//! another thread folds 20 000 segments a second into the same map. Exits with 1 if a goal is missed.

use std::alloc::System;
use std::process::ExitCode;
use std::sync::RwLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde_json::json;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};
use tread_api::friction::{Information, Segment};
use tread_api::ids::{ConfigurationId, RobotId};
use tread_api::site::Cell;
use tread_server::config::FrictionConfig;
use tread_server::friction::index::{Choice, Labelled, SiteMap};
use tread_server::friction::{Ground, Sums, epoch_h, fuse};
use uuid::Uuid;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Cells along a side of the map.
const SIDE_CELLS: i32 = 1_000;
/// Robots that have driven each cell.
const ROBOTS: u32 = 3;
/// Segments of one transaction of the ingest writer.
const GROUP: u32 = 500;
/// Transactions each second, for 20 000 segments.
const GROUPS_PER_S: u32 = 40;
const QUESTIONS: i32 = 300;
const TILES: i32 = 200;
const TILE_CELLS: i32 = 256;

fn segment(cell: Cell, robot: u32, minute: i64) -> anyhow::Result<Segment> {
    let at = jiff::Timestamp::from_second(1_793_000_000 + 60 * minute)?;
    let theta = 0.2 + 0.002 * f64::from(robot) + 1.0e-4 * f64::from(cell.ix.rem_euclid(100));
    Ok(Segment {
        configuration: ConfigurationId::from_uuid(Uuid::from_u128(1)),
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
        effective_track_ratio: None,
        rolling_resistance: None,
        mu_peak_lower_bound: Some(0.3),
        samples: 100,
        distance_m: 1.0,
        saturation_ratio: 0.0,
    })
}

fn fold(
    map: &mut SiteMap,
    robots: &[RobotId],
    segment: &Segment,
    robot: u32,
) -> anyhow::Result<()> {
    let labelled = Labelled {
        cell: segment.cell,
        grid_revision: 1,
        terrain: &segment.terrain,
        configuration: segment.configuration,
        robot: robots.get(robot as usize).context("no such robot")?,
        epoch_h: epoch_h(segment.ended_at),
    };
    map.add(labelled, &Sums::of(segment).context("out of range")?);
    Ok(())
}

/// θ of every cell, as an answer has it.
fn ask(map: &SiteMap, cells: impl Iterator<Item = Cell>, now_us: i64) -> f64 {
    let config = FrictionConfig::default();
    let mut sum = 0.0;
    for cell in cells {
        for mut group in map.cell(cell, Choice::default()) {
            if let Some(fused) = fuse(&mut group.seen, Ground::Cell, &config, now_us) {
                sum += fused.to_api(now_us).bounds.theta_upper_95;
            }
        }
    }
    sum
}

/// A map of a million cells, each driven by every robot, and its bytes per sum.
fn build(robots: &[RobotId]) -> anyhow::Result<(SiteMap, f64)> {
    let region = Region::new(ALLOCATOR);
    let mut map = SiteMap::new(1, 0);
    for place in 0..SIDE_CELLS * SIDE_CELLS {
        let cell = Cell {
            ix: place % SIDE_CELLS,
            iy: place / SIDE_CELLS,
        };
        for robot in 0..ROBOTS {
            let minute = i64::from(robot) * 7;
            fold(&mut map, robots, &segment(cell, robot, minute)?, robot)?;
        }
    }
    let change = region.change();
    let held = change.bytes_allocated - change.bytes_deallocated;
    #[expect(clippy::cast_precision_loss, reason = "bytes below 2^53")]
    let bytes_per_part = held as f64 / map.part_count() as f64;
    Ok((map, bytes_per_part))
}

/// Folds segments at a fixed rate until the stop; how many.
#[expect(clippy::disallowed_methods, reason = "a measurement of real time")]
fn ingest(map: &RwLock<SiteMap>, robots: &[RobotId], stop: &AtomicBool) -> anyhow::Result<f64> {
    let began = Instant::now();
    let (mut next, mut number) = (began, 0_u32);
    while !stop.load(Ordering::Relaxed) {
        next += Duration::from_secs(1) / GROUPS_PER_S;
        let mut map = map
            .write()
            .map_err(|_poisoned| anyhow::anyhow!("poisoned"))?;
        for _ in 0..GROUP {
            number = number.wrapping_add(1);
            let place = i32::try_from(number.wrapping_mul(7_919) % 1_000_000)?;
            let cell = Cell {
                ix: place % SIDE_CELLS,
                iy: place / SIDE_CELLS,
            };
            let robot = number % ROBOTS;
            fold(&mut map, robots, &segment(cell, robot, 30)?, robot)?;
        }
        drop(map);
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
    Ok(f64::from(number) / began.elapsed().as_secs_f64())
}

/// How long questions take, the longest of a hundred left out: milliseconds.
#[expect(clippy::disallowed_methods, reason = "a measurement of real time")]
fn p99_ms(
    map: &RwLock<SiteMap>,
    count: i32,
    question: impl Fn(&SiteMap, i32) -> f64,
) -> anyhow::Result<f64> {
    let mut took = Vec::new();
    for number in 0..count {
        let asked = Instant::now();
        let map = map
            .read()
            .map_err(|_poisoned| anyhow::anyhow!("poisoned"))?;
        let sum = question(&map, number);
        drop(map);
        took.push(asked.elapsed());
        anyhow::ensure!(sum > 0.0, "nothing was read");
        std::thread::sleep(Duration::from_millis(10));
    }
    took.sort_unstable();
    let index = (took.len() * 99).div_ceil(100).saturating_sub(1);
    let p99 = took.get(index).context("nothing was asked")?;
    Ok(1.0e3 * p99.as_secs_f64())
}

fn main() -> anyhow::Result<ExitCode> {
    let robots: Vec<RobotId> = (0..ROBOTS)
        .map(|number| format!("rover-{number}").parse())
        .collect::<Result<_, _>>()?;
    let (map, bytes_per_part) = build(&robots)?;
    let now_us = jiff::Timestamp::from_second(1_793_010_000)?.as_microsecond();
    let map = RwLock::new(map);
    let stop = AtomicBool::new(false);
    // A kilometre across the map, changing rows: a cell for each metre.
    let path = |map: &SiteMap, number: i32| {
        let cells = (0..SIDE_CELLS).map(|ix| Cell {
            ix,
            iy: (number + ix / 3) % SIDE_CELLS,
        });
        ask(map, cells, now_us)
    };
    let tile = |map: &SiteMap, number: i32| {
        let corner = |low: i32| Cell { ix: low, iy: low };
        let cells = map.cells_in(
            corner(number * 3),
            corner(number * 3 + TILE_CELLS - 1),
            None,
        );
        ask(map, cells, now_us)
    };
    let (path_ms, tile_ms, rate) = std::thread::scope(|scope| -> anyhow::Result<_> {
        let writer = scope.spawn(|| ingest(&map, &robots, &stop));
        let asked = p99_ms(&map, QUESTIONS, path)
            .and_then(|path_ms| Ok((path_ms, p99_ms(&map, TILES, tile)?)));
        stop.store(true, Ordering::Relaxed);
        let rate = writer
            .join()
            .map_err(|_panic| anyhow::anyhow!("the writer panicked"))??;
        let (path_ms, tile_ms) = asked?;
        Ok((path_ms, tile_ms, rate))
    })?;
    let checks = [
        (
            "memory_bytes_per_sum",
            "<= 200",
            bytes_per_part,
            bytes_per_part <= 200.0,
        ),
        ("path_1_km_p99_ms", "<= 5", path_ms, path_ms <= 5.0),
        ("tile_256_p99_ms", "<= 20", tile_ms, tile_ms <= 20.0),
        ("segments_per_s", ">= 19000", rate, rate >= 19_000.0),
    ];
    let is_json = std::env::args().any(|argument| argument == "--json");
    if is_json {
        let checks = checks.map(|(name, goal, value, holds)| {
            json!({"name": name, "goal": goal, "value": value, "holds": holds})
        });
        writeln_out(&json!({"checks": checks}).to_string())?;
    } else {
        for (name, goal, value, holds) in checks {
            writeln_out(&format!("{name}: {value:.2} (goal {goal}), holds: {holds}"))?;
        }
    }
    Ok(if checks.iter().all(|check| check.3) {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn writeln_out(line: &str) -> std::io::Result<()> {
    use std::io::Write as _;
    writeln!(std::io::stdout(), "{line}")
}
