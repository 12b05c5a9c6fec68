//! Records a drive on the bench, for programs that read recordings.
//!
//! `cargo run -p tread-agent --example record -- FOLDER` drives a mission of the built-in scenario
//! and prints how many ticks are in the record, and the file's name, as one JSON object.

#![expect(
    clippy::print_stdout,
    reason = "saying what was recorded is what it is for"
)]

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use tread_agent::RecordingConfig;
use tread_agent::sim::scenario::Scenario;
use tread_agent::testing::{Bench, PERIOD, site_of};
use tread_control::geometry::Pose;

/// How long is recorded.
const RECORDED: Duration = Duration::from_secs(6);
/// How long the robot stands before its mission.
const STANDS: Duration = Duration::from_secs(1);
/// Larger than the record.
const FILE_BYTES: u64 = 64 << 20;

fn main() -> anyhow::Result<()> {
    let folder = std::env::args_os().nth(1).map(PathBuf::from);
    let folder = folder.context("usage: record FOLDER")?;
    let scenario = Scenario::built_in()?;
    let robot = scenario
        .robots
        .first()
        .context("the scenario has a robot")?;
    let start = Pose {
        x_m: robot.x_m,
        y_m: robot.y_m,
        heading_rad: robot.heading_rad,
    };
    let mut bench = Bench::new(&scenario, start, robot.seed)?;
    let config = RecordingConfig {
        folder: folder.clone(),
        file_bytes: FILE_BYTES,
        files: 2,
    };
    bench.record(config, scenario.site.clone(), robot.id.clone());
    bench.send_site(site_of(&scenario).map_err(anyhow::Error::msg)?)?;
    bench.run_for(STANDS);
    let mission = scenario
        .missions
        .iter()
        .find(|mission| mission.robot == robot.id);
    let mission = mission.context("the scenario has a mission for it")?;
    bench.begin(1, &mission.trajectory, None)?;
    bench.run_for(RECORDED.saturating_sub(STANDS));
    anyhow::ensure!(bench.end_record() == 0, "notes were lost");
    let file = std::fs::read_dir(&folder)?
        .next()
        .context("nothing was recorded")??
        .path();
    let ticks = RECORDED.as_millis() / PERIOD.as_millis();
    println!("{}", serde_json::json!({ "file": file, "ticks": ticks }));
    Ok(())
}
