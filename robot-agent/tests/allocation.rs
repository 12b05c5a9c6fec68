//! One tick of the whole loop allocates and frees nothing, whatever it meets on the way.

use std::alloc::System;
use std::time::Duration;

use stats_alloc::{INSTRUMENTED_SYSTEM, Region, Stats, StatsAlloc};
use tread_agent::bench::{Bench, site_of};
use tread_agent::sim::scenario::Scenario;
use tread_api::wire::ingest::MissionPhase;
use tread_control::geometry::Pose;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Longest simulated time.
const TICKS_MAX: u32 = 10_000;

#[test]
fn no_tick_of_a_mission_across_cells_and_terrains_allocates() {
    let scenario = Scenario::built_in().unwrap();
    let start = Pose {
        x_m: 4.0,
        y_m: 3.0,
        heading_rad: 0.5,
    };
    let mut bench = Bench::new(&scenario, start, 3).unwrap();
    bench.know_site(site_of(&scenario).unwrap()).unwrap();
    bench.run_for(Duration::from_secs(1));
    let mission = bench
        .begin(1, &scenario.missions[0].trajectory, None)
        .unwrap();
    for tick in 0..TICKS_MAX {
        bench.simulate();
        let region = Region::new(ALLOCATOR);
        bench.tick_loop(false);
        assert_eq!(region.change(), Stats::default(), "tick {tick}");
        bench.collect();
        if let Some(phase) = bench.end_of(mission) {
            assert_eq!(phase, MissionPhase::Succeeded);
            assert!(
                bench.segment_count() > 10,
                "{} segments",
                bench.segment_count()
            );
            return;
        }
    }
    panic!("the mission did not end");
}
