//! One tick of the whole loop allocates and frees nothing, whatever it meets on the way.

use std::alloc::System;
use std::time::Duration;

use stats_alloc::{INSTRUMENTED_SYSTEM, Region, Stats, StatsAlloc};
use tempfile::TempDir;
use tread_agent::RecordingConfig;
use tread_agent::sim::scenario::Scenario;
use tread_agent::testing::{Bench, boot, site_of};
use tread_api::geometry::{Point, Polygon, Twist};
use tread_api::safety::{Driver, Geofence};
use tread_api::wire;
use tread_api::wire::ingest::MissionPhase;
use tread_api::wire::safety::{AcquireLease, DriveCommand};
use tread_control::geometry::Pose;
use uuid::Uuid;

#[global_allocator]
static ALLOCATOR: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Longest simulated time.
const TICKS_MAX: u32 = 10_000;

#[test]
fn no_tick_of_a_recorded_mission_across_cells_and_terrains_allocates() {
    let scenario = Scenario::built_in().unwrap();
    let start = Pose {
        x_m: 4.0,
        y_m: 3.0,
        heading_rad: 0.5,
    };
    let mut bench = Bench::new(&scenario, start, 3).unwrap();
    let folder = TempDir::new().unwrap();
    let recording = RecordingConfig {
        folder: folder.path().to_owned(),
        file_bytes: 1 << 20,
        files: 2,
    };
    let robot = scenario.robots[0].id.clone();
    bench.record(recording, scenario.site.clone(), robot);
    bench.send_site(site_of(&scenario).unwrap()).unwrap();
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
            assert_eq!(bench.end_record(), 0, "notes were lost");
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

fn fence() -> Geofence {
    let corners = [(1.0, 1.0), (9.0, 1.0), (9.0, 6.0), (1.0, 6.0)];
    let corners = corners.map(|(x_m, y_m)| Point { x_m, y_m });
    Geofence {
        revision: 1,
        keep_in: vec![Polygon::new(corners.to_vec()).expect("a rectangle")],
        keep_out: Vec::new(),
    }
}

#[test]
fn no_tick_of_teleoperation_to_a_fence_and_into_silence_allocates() {
    let scenario = Scenario::built_in().unwrap();
    let start = Pose {
        x_m: 4.0,
        y_m: 3.0,
        heading_rad: 0.0,
    };
    let mut bench = Bench::new(&scenario, start, 3).unwrap();
    let mut site = site_of(&scenario).unwrap();
    site.geofence = fence();
    bench.send_site(site).unwrap();
    bench.run_for(Duration::from_secs(1));
    let lease = bench.lease(&AcquireLease {
        request: Uuid::from_u128(1),
        holder: Driver {
            client: Uuid::from_u128(2),
            name: "a driver".to_owned(),
        },
        take: false,
    });
    let epoch = lease.unwrap();
    // Up to the fence, then silence until the lease has freed itself.
    for tick in 0..2_000_u64 {
        if tick < 1_000 && tick % 5 == 0 {
            let command = DriveCommand {
                boot: boot(),
                epoch,
                seq: tick,
                sent_us: bench.now_us(),
                until_us: bench.now_us() + 200_000,
                twist: Twist {
                    linear_m_s: 0.8,
                    angular_rad_s: 0.0,
                },
            };
            assert!(bench.teleoperate(&wire::encode(&command).unwrap()));
        }
        bench.simulate();
        let region = Region::new(ALLOCATOR);
        bench.tick_loop(false);
        assert_eq!(region.change(), Stats::default(), "tick {tick}");
        bench.collect();
    }
    assert!(bench.is_standing());
}
