//! What a drive tells of the map's word, and of wheels that dig.

use std::time::Duration;

use super::channels::EndReason;
use super::prior_tests::everywhere;
use super::tests::{LINE, ORIGIN, bench_at, site_of};
use crate::sim::scenario::{Scenario, ScenarioText};
use crate::testing::Bench;

const HIGH_MU: f64 = 0.3;

/// A floor with a strip across the way of [`LINE`], and what becomes of the floor.
fn floor_with_strip(stiffness: f64, strip: f64, then: &str) -> Scenario {
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
then = [{then}]
[[terrains]]
id = "strip"
class = "other"
polygon = [[2.0, -9.0], [5.0, -9.0], [5.0, 9.0], [2.0, 9.0]]
layer = 1
stiffness = {strip}
"#
    );
    Scenario::parse(ScenarioText {
        file: "bench",
        text: &text,
    })
    .unwrap()
}

fn bench_with_theta(scenario: &Scenario, theta: f64, seed: u64) -> Bench {
    let mut bench = bench_at(scenario, ORIGIN, seed);
    bench.send_site(site_of(scenario)).unwrap();
    bench.set_prior(&everywhere(theta, 0.02, HIGH_MU));
    bench.run_for(Duration::from_millis(500));
    bench
}

#[test]
fn ground_that_is_not_as_the_map_says_is_reported_while_it_is_so_and_no_longer() {
    for (strip, is_other) in [(0.7, true), (5.0, false)] {
        let mut bench = bench_with_theta(&floor_with_strip(5.0, strip, ""), 0.2, 6);
        bench.start(1, LINE, None);
        let (mut seen, mut where_m) = (0, f64::NAN);
        while bench.ended.is_empty() {
            bench.tick();
            if let Some(found) = bench.ends.shared.snapshot().surface_change {
                let x_m = bench.drive.truth().pose.x_m;
                if seen == 0 {
                    where_m = x_m;
                    assert!(found.measured.theta > 1.0, "{found:?}");
                    assert!((2..5).contains(&found.cell.ix), "{found:?}");
                }
                seen += 1;
            }
        }
        assert_eq!(bench.ended[0].1, EndReason::Reached);
        assert_eq!(seen > 0, is_other, "K {strip}");
        if is_other {
            assert!(where_m < 5.5, "first reported {where_m} m on");
            let left = bench.ends.shared.snapshot().surface_change;
            assert_eq!(left, None, "eight metres as expected end it");
        }
        let gain = bench.last_driven.as_ref().unwrap().quality().prior.unwrap();
        assert_eq!(gain.cells_contradicted > 0, is_other, "{gain:?}");
        assert!(
            gain.known_ratio > 0.99 && gain.cells_compared >= 5,
            "{gain:?}"
        );
        assert!((gain.traction_limit_mu - HIGH_MU).abs() < 1.0e-12);
        // It knew its ground from the start, and would not have known it alone.
        assert!(gain.known_s > gain.known_alone_s + 1.0, "{gain:?}");
        let first_s = gain.first_known_alone_s.unwrap();
        assert!((0.5..15.0).contains(&first_s), "{gain:?}");
        if !is_other {
            assert!(gain.difference_ratio.unwrap().abs() < 0.1, "{gain:?}");
            assert!(gain.difference_rms.unwrap() < 2.0, "{gain:?}");
        }
    }
}

#[test]
fn a_robot_without_a_prior_reports_no_gain() {
    let scenario = floor_with_strip(5.0, 5.0, "");
    let mut bench = bench_at(&scenario, ORIGIN, 7);
    bench.send_site(site_of(&scenario)).unwrap();
    bench.run_for(Duration::from_millis(500));
    assert_eq!(bench.drive_to_the_end(1, LINE), EndReason::Reached);
    assert_eq!(bench.last_driven.as_ref().unwrap().quality().prior, None);
    assert_eq!(bench.ends.shared.snapshot().surface_change, None);
}

#[test]
fn wheels_that_turn_without_progress_are_reported_until_they_take_the_robot_on() {
    // No friction at all for a while, then a floor.
    let scenario = floor_with_strip(0.004, 0.004, "{ after_s = 9.0, stiffness = 5.0 }");
    let mut bench = bench_at(&scenario, ORIGIN, 8);
    bench.send_site(site_of(&scenario)).unwrap();
    bench.run_for(Duration::from_millis(500));
    bench.start(1, LINE, None);
    let is_dug_in = |bench: &Bench| bench.ends.shared.snapshot().dug_in_at.is_some();
    bench.run_for(Duration::from_secs(6));
    assert!(is_dug_in(&bench), "it is at {:?}", bench.drive.truth().pose);
    assert!(bench.drive.truth().pose.x_m < 0.5);
    bench.run_for(Duration::from_secs(10));
    assert!(
        !is_dug_in(&bench),
        "it is at {:?}",
        bench.drive.truth().pose
    );
}
