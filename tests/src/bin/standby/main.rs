//! `standby`: how soon the map of a standby is that of the server, and what a read of it costs.
//!
//! Two servers on one PostgreSQL database; robots without physics upload to the one that has it. After each
//! receipt the same parts of the map are asked of both until their answers are equal. Then the same reads of
//! ground in memory are sent to the server alone, and to both in turn, by turns.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context as _;
use clap::Parser;
use reqwest::{Method, StatusCode};
use serde::Serialize;
use serde_json::Value;
use tokio::time::Instant;
use tread_api::ids::RobotId;
use tread_tests::fleet::Fleet;
use tread_tests::light_robot::LightRobot;
use tread_tests::process::node;
use tread_tests::report::{self, Check, quantile};
use tread_tests::rest::Rest;
use tread_tests::wait::{DRIVE, eventually};

/// Longest time from a receipt until both maps are equal.
const EQUAL_MAX_S: f64 = 1.0;
/// Largest processor time of both servers for a read, over that of one.
const CPU_RATIO_MAX: f64 = 1.1;
/// Longest wait for equal answers, after which they count as different.
const GIVE_UP: Duration = Duration::from_secs(5);
/// Time between two looks at the standby.
const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Segments of an upload.
const BATCH: usize = 100;
/// Uploads of each robot before the first comparison: all cells that it visits.
const UPLOADS_BEFORE: u32 = 16;
/// Turns of reads, each of the server alone and then of both.
const TURNS: u32 = 4;
/// Time after which PostgreSQL's counts include what was done: sessions that have nothing to do report
/// after ten seconds.
const STATISTICS_LATE: Duration = Duration::from_secs(12);
/// What is compared and read.
const PATHS: [&str; 4] = [
    "cells?limit=200",
    "point?x_m=5.5&y_m=3.5",
    "visits?x_min_m=0&x_max_m=40&y_min_m=0&y_max_m=40",
    "map?format=csv&resolution_m=4",
];

/// Measures how soon the map of a standby is that of the server, and what a read of it costs.
#[derive(Debug, Parser)]
#[command(name = "standby")]
struct Arguments {
    /// Uploads after which both maps are compared
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    uploads: u32,
    /// Robots
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    robots: u32,
    /// Reads of each turn
    #[arg(long, default_value_t = 2_000, value_parser = clap::value_parser!(u32).range(100..=1_000_000))]
    reads: u32,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Details {
    uploads: u32,
    robots: u32,
    reads: u32,
}

/// Returns the body of an answer about the map.
async fn read(server: &Rest, path: &str) -> anyhow::Result<Value> {
    let path = format!("/v1/sites/yard/friction/{path}");
    let answer = server.call(Method::GET, &path, None).await;
    let (status, body) = answer.with_context(|| format!("no answer to {path}"))?;
    anyhow::ensure!(status == StatusCode::OK, "{path}: {status}: {body}");
    Ok(body)
}

/// Asks both servers until their answers are equal. Returns the time since the receipt, seconds; `None`
/// if they stay different.
async fn until_equal(
    servers: (&Rest, &Rest),
    path: &str,
    received_at: Instant,
) -> anyhow::Result<Option<f64>> {
    let expected = read(servers.0, path).await?;
    loop {
        if read(servers.1, path).await? == expected {
            return Ok(Some(received_at.elapsed().as_secs_f64()));
        }
        if received_at.elapsed() > GIVE_UP {
            return Ok(None);
        }
        tokio::time::sleep(POLL_INTERVAL).await;
    }
}

/// Sends reads to these servers in turn. Returns the processor time of both servers, seconds.
async fn read_often(fleet: &Fleet, servers: &[&Rest], reads: u32) -> anyhow::Result<f64> {
    let used = || fleet.servers_usage().iter().map(|of| of.cpu_s).sum::<f64>();
    let before = used();
    for (number, path) in (0..reads as usize).zip(PATHS.iter().cycle()) {
        // Each server gets each path.
        let server = servers[(number / PATHS.len()) % servers.len()];
        read(server, path).await?;
    }
    Ok(used() - before)
}

/// Returns how often PostgreSQL has looked into an index of the tables of the map so far.
async fn scans(fleet: &Fleet) -> anyhow::Result<i64> {
    tokio::time::sleep(STATISTICS_LATE).await;
    let rows: Vec<(i64,)> = fleet
        .database()
        .rows(
            "SELECT CAST(SUM(COALESCE(idx_scan, 0)) AS BIGINT) FROM pg_stat_user_tables
             WHERE relname IN ('cell_sums', 'terrains')",
        )
        .await?;
    Ok(rows.first().context("PostgreSQL counts scans")?.0)
}

/// Waits until all sums are stored, so that no further ones are while reads are measured.
async fn all_is_stored(fleet: &Fleet) {
    let look = || async {
        let rows: Vec<(i64,)> = fleet
            .database()
            .rows(
                "SELECT COUNT(*) FROM robots WHERE COALESCE((SELECT segment_pk FROM watermarks
                     WHERE watermarks.robot_pk = robots.pk), 0)
                 < COALESCE((SELECT MAX(last_pk) FROM segment_ranges
                     WHERE segment_ranges.robot_pk = robots.pk), 0)",
            )
            .await
            .unwrap_or_default();
        rows.first().map(|row| row.0)
    };
    eventually("all sums are stored", DRIVE, look, |left| *left == Some(0)).await;
}

#[tokio::main]
async fn main() -> anyhow::Result<ExitCode> {
    let arguments = Arguments::parse();
    let fleet = Fleet::start_forwarding_pair_with(&node()?).await?;
    let standby = fleet.standby().context("there are two servers")?;
    let server = &fleet.rest;
    let endpoint = format!("tcp/{}", fleet.zenoh_address());
    let mut robots = Vec::new();
    for number in 0..arguments.robots {
        let id: RobotId = format!("light-{number}").parse()?;
        robots.push(LightRobot::start(&endpoint, &fleet.site(), id).await?);
    }
    for robot in &mut robots {
        for _ in 0..UPLOADS_BEFORE {
            let batch = robot.next_batch(BATCH);
            robot.upload(&batch).await?;
        }
    }
    let mut equal_s = Vec::new();
    let mut different = 0_u64;
    let count = robots.len();
    for (number, path) in (0..arguments.uploads as usize).zip(PATHS.iter().cycle()) {
        let robot = &mut robots[number % count];
        let batch = robot.next_batch(BATCH);
        robot.upload(&batch).await?;
        match until_equal((server, &standby), path, Instant::now()).await? {
            Some(seconds) => equal_s.push(seconds),
            None => different += 1,
        }
    }
    let (mut alone_s, mut both_s) = (0.0, 0.0);
    all_is_stored(&fleet).await;
    for server in [server, &standby] {
        for path in PATHS {
            read(server, path).await?;
        }
    }
    let before = scans(&fleet).await?;
    for _ in 0..TURNS {
        alone_s += read_often(&fleet, &[server], arguments.reads).await?;
        both_s += read_often(&fleet, &[server, &standby], arguments.reads).await?;
    }
    let scanned = scans(&fleet).await? - before;
    let reads = f64::from(TURNS * arguments.reads);
    let checks = [
        Check::of("maps equal after a receipt, s", quantile(&mut equal_s, 1.0))
            .at_most(EQUAL_MAX_S),
        Check::shown("the same, median, s", quantile(&mut equal_s, 0.5)),
        Check::of_count("uploads after which the maps stayed different", different).exactly(0),
        Check::shown(
            "server CPU of a read, one server, us",
            alone_s / reads * 1e6,
        ),
        Check::shown(
            "server CPU of a read, two servers, us",
            both_s / reads * 1e6,
        ),
        Check::of("two servers over one", both_s / alone_s).at_most(CPU_RATIO_MAX),
        Check::of_count(
            "scans of the map's indexes by these reads",
            u64::try_from(scanned).unwrap_or_default(),
        )
        .exactly(0),
    ];
    let details = Details {
        uploads: arguments.uploads,
        robots: arguments.robots,
        reads: arguments.reads,
    };
    report::print_with(arguments.json, &details, String::new(), &checks)
}
