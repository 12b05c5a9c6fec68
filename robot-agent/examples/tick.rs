//! Measures one tick of the whole loop on the bench: read, localise, estimate, track, gate, write.
//!
//! `cargo run --release -p tread-agent --example tick` drives all missions of the built-in scenario
//! and prints one JSON object. The simulation of the base is not in the figures.

#![expect(clippy::print_stdout, reason = "printing figures is what it is for")]

use std::time::Duration;

use anyhow::Context;
use tread_agent::clock::{Clock, SystemClock};
use tread_agent::sim::scenario::Scenario;
use tread_agent::testing::{Bench, site_of};
use tread_control::geometry::Pose;

/// Longest simulated time of one mission.
const MISSION_MAX: Duration = Duration::from_mins(3);

fn main() -> anyhow::Result<()> {
    let clock = SystemClock::new();
    let scenario = Scenario::built_in()?;
    let site = site_of(&scenario).map_err(anyhow::Error::msg)?;
    let mut ticks_us: Vec<f64> = Vec::new();
    for robot in &scenario.robots {
        let start = Pose {
            x_m: robot.x_m,
            y_m: robot.y_m,
            heading_rad: robot.heading_rad,
        };
        let mut bench = Bench::new(&scenario, start, robot.seed)?;
        bench.send_site(site.clone())?;
        bench.run_for(Duration::from_secs(1));
        let missions = scenario
            .missions
            .iter()
            .filter(|mission| mission.robot == robot.id);
        for (number, asked) in (1..).zip(missions) {
            let mission = bench.begin(number, &asked.trajectory, None)?;
            let ticks_max = MISSION_MAX.as_millis() / tread_agent::testing::PERIOD.as_millis();
            for _ in 0..ticks_max {
                bench.simulate();
                let began = clock.monotonic();
                bench.tick_loop(false);
                ticks_us.push(clock.monotonic().saturating_sub(began).as_secs_f64() * 1.0e6);
                bench.collect();
                if bench.end_of(mission).is_some() {
                    break;
                }
            }
            bench
                .end_of(mission)
                .with_context(|| format!("{} did not arrive", robot.id))?;
        }
    }
    ticks_us.sort_by(f64::total_cmp);
    let at = |share_per_mille: usize| ticks_us[(ticks_us.len() - 1) * share_per_mille / 1000];
    let figures = serde_json::json!({
        "ticks": ticks_us.len(),
        "p50_us": at(500),
        "p99_us": at(990),
        "p999_us": at(999),
        "max_us": at(1000),
    });
    println!("{figures}");
    Ok(())
}
