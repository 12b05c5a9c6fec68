//! The whole loop with the simulated base, stepped tick by tick: no thread, no clock, no network.

use std::sync::Arc;
use std::time::Duration;

use tread_api::geometry::{Point, Polygon};
use tread_api::ids::MissionId;
use tread_api::robot::RobotMode;
use tread_api::terrain::TerrainRef;
use tread_api::wire::hello::SiteDefinition;
use tread_api::wire::ingest::MissionPhase;
use tread_control::estimation::EstimatorPrior;
use tread_control::geometry::Pose;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::RobotModel;

use super::channels::{EVENTS_MAX, EndReason, Fault, LoopCommand, loop_channels};
use super::site_view::SiteView;
use super::tick::LoopCore;
use crate::sim::scenario::{Scenario, ScenarioText};
use crate::testing::Bench;

/// Longest simulated time of a test's mission.
const MISSION_MAX: Duration = Duration::from_mins(3);

pub(super) fn site_of(scenario: &Scenario) -> SiteDefinition {
    crate::testing::site_of(scenario).unwrap()
}

pub(super) fn bench_at(scenario: &Scenario, start: Pose, seed: u64) -> Bench {
    Bench::new(scenario, start, seed).unwrap()
}

impl Bench {
    pub(super) fn start(
        &mut self,
        number: u128,
        asked: &str,
        start_by: Option<Duration>,
    ) -> MissionId {
        let trajectory = serde_json::from_str(asked).unwrap();
        self.begin(number, &trajectory, start_by).unwrap()
    }

    pub(super) fn drive_to_the_end(&mut self, number: u128, asked: &str) -> EndReason {
        let mission = self.start(number, asked, None);
        let until = self.now + MISSION_MAX;
        let mut farthest_m: f64 = 0.0;
        while self.now < until {
            self.tick();
            if let Some(progress) = self.ends.shared.snapshot().mission {
                assert!(progress.driven_m >= farthest_m, "progress went back");
                farthest_m = progress.driven_m;
            }
            if let Some(&(ended, reason)) = self.ended.last()
                && ended == mission
            {
                assert_eq!(self.starts.last(), Some(&mission));
                return reason;
            }
        }
        panic!("mission {number} did not end, driven {farthest_m} m");
    }
}

pub(super) fn one_ground(stiffness: f64) -> Scenario {
    let text = format!(
        r#"
site = "bench"
cell_m = 1.0
robots = []
[[terrains]]
id = "floor"
class = "other"
polygon = [[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]]
stiffness = {stiffness}
"#
    );
    Scenario::parse(ScenarioText {
        file: "bench",
        text: &text,
    })
    .unwrap()
}

pub(super) const ORIGIN: Pose = Pose {
    x_m: 0.0,
    y_m: 0.0,
    heading_rad: 0.0,
};
pub(super) const LINE: &str = r#"{"waypoints":{"speed_m_s":0.6,
    "points":[{"x_m":0,"y_m":0},{"x_m":6,"y_m":0},{"x_m":10,"y_m":2},{"x_m":10,"y_m":6}]}}"#;
pub(super) const CIRCLE: &str =
    r#"{"circle":{"center":{"x_m":7.0,"y_m":6.0},"radius_m":3.0,"speed_m_s":0.6}}"#;

#[test]
fn a_path_and_a_circle_are_driven_to_the_end_and_the_ground_is_measured() {
    for (stiffness, seed) in [(0.7, 1), (2.5, 2), (8.0, 3)] {
        let scenario = one_ground(stiffness);
        let mut bench = bench_at(&scenario, ORIGIN, seed);
        bench.send_site(site_of(&scenario)).unwrap();
        bench.run_for(Duration::from_millis(500));
        assert_eq!(
            bench.drive_to_the_end(1, LINE),
            EndReason::Reached,
            "K {stiffness}"
        );
        let at = bench.drive.truth().pose;
        assert!(
            (at.x_m - 10.0).hypot(at.y_m - 6.0) < 0.15,
            "K {stiffness}: ended at {at:?}"
        );
        assert_eq!(
            bench.drive_to_the_end(2, CIRCLE),
            EndReason::Reached,
            "K {stiffness}"
        );

        let (mut information, mut weighted) = (0.0, 0.0);
        for segment in &bench.segments {
            assert_eq!(segment.terrain, Some(0));
            assert!(segment.statistics.theta_information > 0.0);
            assert!(segment.ended_at > segment.started_at);
            information += segment.statistics.theta_information;
            weighted += segment.statistics.theta_weighted;
        }
        let theta = weighted / information;
        let truth = stiffness.recip();
        let error_ratio = (theta - truth).abs() / truth;
        // The torque constant is wrong by up to 2 %, rolling radii by up to 1 %.
        let sigma = information.sqrt().recip();
        assert!(
            error_ratio < 0.1 + 3.0 * sigma / truth,
            "K {stiffness}: θ {theta} ± {sigma} from {} segments, truly {truth}",
            bench.segments.len(),
        );
        assert!(
            bench.segments.len() >= 5,
            "K {stiffness}: {} segments",
            bench.segments.len()
        );
    }
}

#[test]
fn segments_keep_to_their_cell_and_ground_and_borders_give_none() {
    let scenario = Scenario::built_in().unwrap();
    let start = Pose {
        x_m: 10.0,
        y_m: 6.0,
        heading_rad: 0.0,
    };
    let mut bench = bench_at(&scenario, start, 4);
    let site = site_of(&scenario);
    bench.send_site(site.clone()).unwrap();
    bench.run_for(Duration::from_millis(500));
    let asked = r#"{"waypoints":{"speed_m_s":0.6,"points":[{"x_m":10,"y_m":6},
        {"x_m":13,"y_m":7},{"x_m":16,"y_m":5},{"x_m":19,"y_m":7},{"x_m":22,"y_m":6}]}}"#;
    assert_eq!(bench.drive_to_the_end(1, asked), EndReason::Reached);
    let mut grounds: Vec<&str> = Vec::new();
    for segment in &bench.segments {
        let terrain = segment.terrain.expect("the yard is covered");
        let id = segment.site.terrain(terrain).unwrap().id.as_str();
        grounds.push(id);
        assert!(
            segment.distance_m < 2.0,
            "{} m in a cell of 1 m",
            segment.distance_m
        );
        let center = site.grid.center_of(segment.cell);
        assert_eq!(
            id,
            if center.x_m < 16.0 {
                "concrete"
            } else {
                "gravel"
            }
        );
    }
    assert!(
        grounds.contains(&"concrete") && grounds.contains(&"gravel"),
        "{grounds:?}"
    );
}

#[test]
fn without_a_site_the_robot_drives_and_measures_but_nothing_is_cut() {
    let scenario = one_ground(2.0);
    let mut bench = bench_at(&scenario, ORIGIN, 5);
    bench.run_for(Duration::from_millis(500));
    assert_eq!(bench.drive_to_the_end(1, LINE), EndReason::Reached);
    assert!(bench.segments.is_empty());
    let snapshot = bench.ends.shared.snapshot();
    assert!(snapshot.theta_measured.is_some(), "{snapshot:?}");
    assert_eq!(snapshot.cell, None);
}

#[test]
fn a_cancelled_mission_brakes_along_its_path_and_ends_cancelled() {
    let scenario = one_ground(2.0);
    let mut bench = bench_at(&scenario, ORIGIN, 6);
    bench.run_for(Duration::from_millis(500));
    let mission = bench.start(1, LINE, None);
    bench.run_for(Duration::from_secs(5));
    assert_eq!(bench.ends.shared.snapshot().mode, RobotMode::Tracking);
    bench
        .ends
        .commands
        .send(LoopCommand::Cancel(mission))
        .unwrap();
    bench.run_for(Duration::from_secs(5));
    assert_eq!(bench.ended, [(mission, EndReason::Cancelled)]);
    assert_eq!(EndReason::Cancelled.phase(), MissionPhase::Cancelled);
    assert!(bench.drive.truth().forward_m_s.abs() < 0.01);
    let off_m = bench.cross_track_m.unwrap();
    assert!(off_m.abs() < 0.05, "{off_m} m off the path");
    assert_eq!(bench.ends.shared.snapshot().mode, RobotMode::Idle);
}

#[test]
fn a_mission_past_its_latest_start_never_moves_the_robot() {
    let scenario = one_ground(2.0);
    let mut bench = bench_at(&scenario, ORIGIN, 7);
    bench.run_for(Duration::from_millis(500));
    let mission = bench.start(1, LINE, Some(bench.now));
    bench.run_for(Duration::from_secs(1));
    assert_eq!(bench.ended, [(mission, EndReason::TooLate)]);
    assert!(bench.starts.is_empty());
    assert!(bench.drive.truth().pose.x_m.abs() < 0.01);
}

#[test]
fn a_second_mission_does_not_disturb_the_first() {
    let scenario = one_ground(2.0);
    let mut bench = bench_at(&scenario, ORIGIN, 8);
    bench.run_for(Duration::from_millis(500));
    let first = bench.start(1, LINE, None);
    bench.run_for(Duration::from_secs(2));
    let second = bench.start(2, LINE, None);
    bench.run_for(Duration::from_secs(2));
    assert_eq!(bench.ended, [(second, EndReason::AnotherActive)]);
    assert_eq!(
        bench
            .ends
            .shared
            .snapshot()
            .mission
            .map(|mission| mission.id),
        Some(first)
    );
}

#[test]
fn the_word_to_stop_brings_the_robot_to_rest_within_its_braking_time() {
    let scenario = one_ground(2.0);
    let mut bench = bench_at(&scenario, ORIGIN, 9);
    bench.run_for(Duration::from_millis(500));
    let mission = bench.start(1, LINE, None);
    bench.run_for(Duration::from_secs(5));
    let speed_m_s = bench.drive.truth().forward_m_s;
    assert!(speed_m_s > 0.5, "{speed_m_s}");
    let stop_requested_at = bench.now;
    while !bench.core.is_standing() {
        bench.simulate();
        bench.tick_loop(true);
        bench.collect();
        assert!(
            bench.now < stop_requested_at + Duration::from_secs(3),
            "it does not stand"
        );
    }
    assert_eq!(bench.ended, [(mission, EndReason::AgentStopped)]);
    bench.simulate();
    bench.tick_loop(true);
    assert!(bench.core.flush());
}

#[test]
fn the_base_feedback_watchdog_is_a_fault_and_ends_the_mission() {
    let scenario = one_ground(2.0);
    let mut bench = bench_at(&scenario, ORIGIN, 10);
    bench.run_for(Duration::from_millis(500));
    let mission = bench.start(1, LINE, None);
    bench.run_for(Duration::from_secs(3));
    let silent_since = bench.now;
    while bench.now < silent_since + Duration::from_secs(6) {
        bench.tick_without_base();
    }
    let snapshot = bench.ends.shared.snapshot();
    assert_eq!(snapshot.mode, RobotMode::Fault);
    assert_eq!(snapshot.fault, Some(Fault::BaseSilent));
    assert!(
        matches!(bench.ended.as_slice(), [(ended, EndReason::Failed(_))] if *ended == mission),
        "{:?}",
        bench.ended,
    );
}

#[test]
fn events_that_matter_wait_for_room_and_segments_are_counted() {
    let scenario = one_ground(2.0);
    let mut bench = bench_at(&scenario, ORIGIN, 11);
    bench.run_for(Duration::from_millis(500));
    // Somebody who takes nothing: fill the channel with retired sites.
    let view = || Arc::new(SiteView::new(site_of(&scenario)));
    for _ in 0..EVENTS_MAX + 4 {
        bench.ends.commands.send(LoopCommand::Site(view())).unwrap();
        bench.simulate();
        bench.tick_loop(false);
    }
    let mission = bench.start(1, LINE, Some(Duration::ZERO));
    bench.tick_loop(false);
    assert!(!bench.core.flush(), "the channel should be full");
    bench.tick();
    bench.tick();
    assert_eq!(
        bench.ended.first().map(|(mission, _)| *mission),
        Some(mission)
    );
}

#[test]
fn the_terrain_comes_from_the_site_and_not_from_the_scenario() {
    let scenario = one_ground(2.0);
    let mut bench = bench_at(&scenario, ORIGIN, 12);
    let mut site = site_of(&scenario);
    let corners = [(-50.0, -50.0), (60.0, -50.0), (60.0, 50.0), (-50.0, 50.0)];
    let corners = corners
        .into_iter()
        .map(|(x_m, y_m)| Point { x_m, y_m })
        .collect();
    site.terrains[0].polygon = Polygon::new(corners).unwrap();
    site.terrains[0].terrain = TerrainRef {
        id: "drawn".parse().unwrap(),
        revision: 7,
    };
    bench.send_site(site).unwrap();
    bench.run_for(Duration::from_millis(500));
    assert_eq!(bench.drive_to_the_end(1, LINE), EndReason::Reached);
    assert_eq!(bench.drive_to_the_end(2, CIRCLE), EndReason::Reached);
    assert!(!bench.segments.is_empty());
    for segment in &bench.segments {
        let terrain = segment.site.terrain(segment.terrain.unwrap()).unwrap();
        assert_eq!((terrain.id.as_str(), terrain.revision), ("drawn", 7));
    }
}

#[test]
fn the_built_in_scenario_shows_every_terrain_in_time() {
    /// Longest simulated time of all missions of one robot.
    const DEMO_MAX: Duration = Duration::from_secs(65);
    let scenario = Scenario::built_in().unwrap();
    let mut sums = vec![(0.0, 0.0, 0_u32); scenario.terrains.len()];
    for robot in &scenario.robots {
        let start = Pose {
            x_m: robot.x_m,
            y_m: robot.y_m,
            heading_rad: robot.heading_rad,
        };
        let mut bench = bench_at(&scenario, start, robot.seed);
        bench.send_site(site_of(&scenario)).unwrap();
        bench.run_for(Duration::from_secs(1));
        let began = bench.now;
        let missions = scenario
            .missions
            .iter()
            .filter(|mission| mission.robot == robot.id);
        for (number, mission) in (1..).zip(missions) {
            let asked = serde_json::to_string(&mission.trajectory).unwrap();
            let end = bench.drive_to_the_end(number, &asked);
            assert_eq!(end, EndReason::Reached, "{} mission {number}", robot.id);
        }
        let took = bench.now.saturating_sub(began);
        assert!(took < DEMO_MAX, "{} took {took:?}", robot.id);
        for segment in &bench.segments {
            let place = segment.terrain.expect("the yard is covered");
            sums[place].0 += segment.statistics.theta_information;
            sums[place].1 += segment.statistics.theta_weighted;
            sums[place].2 += 1;
        }
    }
    for (terrain, (information, weighted, segments)) in scenario.terrains.iter().zip(sums) {
        let (theta, truth) = (weighted / information, terrain.stiffness.recip());
        let sigma = f64::sqrt(1.0 / information + (0.08 * truth).powi(2));
        assert!(segments >= 2, "{}: {segments} segments", terrain.id);
        assert!(
            (theta - truth).abs() < 1.96 * sigma,
            "{}: {theta} for {truth}",
            terrain.id
        );
    }
}

/// A quarter of the stack that Rust gives a thread, because callers need most of it.
const STACK_BYTES: usize = 512 * 1024;

#[test]
fn the_loop_is_created_and_moved_on_a_small_stack() {
    let create = || {
        let (loop_ends, _ends) = loop_channels();
        LoopCore::new(RobotModel::yi2007(), loop_ends)
            .with_blind_within_fence(true)
            .with_silent_after(Duration::from_millis(200))
            .with_prior(EstimatorPrior::default())
            .with_period(Duration::from_millis(20))
            .command()
    };
    let thread = std::thread::Builder::new().stack_size(STACK_BYTES);
    let command = thread.spawn(create).unwrap().join().unwrap();
    assert_eq!(command, WheelSpeeds::default());
}
