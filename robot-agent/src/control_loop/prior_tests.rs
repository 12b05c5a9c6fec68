//! What a map's prior does to a drive, and what it must not do to what is measured.

use std::time::Duration;

use tread_api::site::Cell;
use tread_api::wire::command::{CellPrior, PathPrior};

use super::channels::EndReason;
use super::tests::{CIRCLE, LINE, ORIGIN, bench_at, one_ground, site_of};
use crate::testing::Bench;

/// The same word on every cell around the test's ways.
pub(super) fn everywhere(theta: f64, std_dev: f64, traction_limit_mu: f64) -> PathPrior {
    let cell = |ix, iy| CellPrior {
        cell: Cell { ix, iy },
        theta,
        std_dev,
    };
    PathPrior {
        grid_revision: 1,
        traction_limit_mu,
        robot_bias_ratio: 0.08,
        cells: (-5..20)
            .flat_map(|iy| (-5..20).map(move |ix| cell(ix, iy)))
            .collect(),
        traction_limits: Vec::new(),
    }
}

fn bench_with_prior(stiffness: f64, seed: u64, prior: Option<&PathPrior>) -> Bench {
    let scenario = one_ground(stiffness);
    let mut bench = bench_at(&scenario, ORIGIN, seed);
    bench.send_site(site_of(&scenario)).unwrap();
    if let Some(prior) = prior {
        bench.set_prior(prior);
    }
    bench.run_for(Duration::from_millis(500));
    bench
}

/// θ of all segments with its standard deviation.
fn mapped(bench: &Bench) -> (f64, f64) {
    let (mut information, mut weighted) = (0.0, 0.0);
    for segment in &bench.segments {
        information += segment.statistics.theta_information;
        weighted += segment.statistics.theta_weighted;
    }
    (weighted / information, information.sqrt().recip())
}

#[test]
fn a_wrong_prior_never_comes_onto_the_map() {
    let truth = 0.4;
    for (wrong, seed) in [(0.04, 2), (3.0, 3)] {
        let prior = everywhere(wrong, 0.01 * wrong, 0.5);
        let mut bench = bench_with_prior(2.5, seed, Some(&prior));
        for (number, path) in [(1, LINE), (2, CIRCLE)] {
            assert_eq!(bench.drive_to_the_end(number, path), EndReason::Reached);
        }
        let (theta, std_dev) = mapped(&bench);
        // The same bound as for a robot that was given nothing.
        assert!(
            (theta - truth).abs() / truth < 0.1 + 3.0 * std_dev / truth,
            "given {wrong}: θ {theta} ± {std_dev}, truly {truth}"
        );
        assert!(bench.segments.len() >= 5, "given {wrong}");
    }
}

#[test]
fn a_robot_with_a_prior_knows_the_ground_from_the_first_metre() {
    let estimate_with = |prior: Option<&PathPrior>| {
        let mut bench = bench_with_prior(0.7, 4, prior);
        bench.start(1, LINE, None);
        bench.run_for(Duration::from_millis(300));
        bench.ends.shared.snapshot().theta_loop.unwrap()
    };
    let truth = 1.43;
    let cold = estimate_with(None);
    let warm = estimate_with(Some(&everywhere(truth, 0.1, 0.5)));
    assert!((warm - truth).abs() < 0.1 * truth, "θ̂ {warm}");
    assert!(
        (cold - truth).abs() > 0.5 * truth,
        "θ̂ {cold} without a prior"
    );
}

#[test]
fn a_low_traction_limit_makes_a_slower_plan() {
    let duration_s = |traction_limit_mu: f64| {
        let prior = everywhere(0.2, 0.02, traction_limit_mu);
        let mut bench = bench_with_prior(5.0, 5, Some(&prior));
        let begun = bench.now;
        assert_eq!(bench.drive_to_the_end(1, LINE), EndReason::Reached);
        bench.now.saturating_sub(begun).as_secs_f64()
    };
    let (limit, ice) = (duration_s(0.6), duration_s(0.03));
    assert!(
        ice > limit + 2.0,
        "{limit} s on good ground, {ice} s on ice"
    );
}
