//! Tests one arbitrarily wrong robot among honest ones.

use proptest::prelude::*;
use tread_api::friction::{NORMAL_95, ROBOT_BIAS_RATIO};

use super::coverage::Normal;
use super::epochs::HOUR_S;
use super::fuse::MU_ALONE_MAX;
use super::tests::{at_us, fused, fused_as, measured, with_peak_friction};
use super::weights::FrictionConfig;
use super::*;

const THETA: f64 = 0.2;
/// Standard deviation of the independent error of one robot's measurement.
const OWN_STD_DEV: f64 = 0.01;
/// Number of random fleets of each kind.
const FLEETS: u32 = 4_000;
const SEED: u64 = 0x5EED_0002;

/// Returns coverage and mean width of the intervals of fleets with `honest` honest robots and
/// optionally a wrong one.
fn coverage(honest: u8, wrong: Option<Sums>, ground: Ground) -> (f64, f64) {
    let mut normal = Normal(SEED);
    let (mut held, mut width) = (0_u32, 0.0);
    let config = FrictionConfig {
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        ..FrictionConfig::default()
    };
    for _ in 0..FLEETS {
        let mut seen: Vec<EpochMeasurement<u8>> = (1..=honest)
            .filter_map(|robot| {
                let own = THETA * (1.0 + ROBOT_BIAS_RATIO * normal.next());
                let theta = own + OWN_STD_DEV * normal.next();
                EpochMeasurement::of(robot, 0, &measured(theta, OWN_STD_DEV, i64::from(robot)))
            })
            .collect();
        // Older than the others, because newer measurements of more slip count until contradicted.
        seen.extend(
            wrong
                .as_ref()
                .and_then(|sums| EpochMeasurement::of(0, 0, sums)),
        );
        let fused = fuse(&mut seen, ground, &config, at_us(0)).unwrap();
        let (low, high) = fused.theta.interval_95();
        held += u32::from((low..=high).contains(&THETA));
        width += high - low;
    }
    (
        f64::from(held) / f64::from(FLEETS),
        width / f64::from(FLEETS),
    )
}

/// Returns the mean width of the interval if all robots were known to be honest.
fn width_of(robots: u8) -> f64 {
    let variance = (ROBOT_BIAS_RATIO * THETA).powi(2) + OWN_STD_DEV.powi(2);
    2.0 * NORMAL_95 * (variance / f64::from(robots)).sqrt()
}

/// Checks fleets of `honest + 1` robots, one of which is wrong in various ways.
fn check_one_wrong_beside(honest: u8) {
    let std_dev = (THETA * ROBOT_BIAS_RATIO).hypot(OWN_STD_DEV);
    let (mut held_least, mut ratio_most) = (1.0_f64, 0.0_f64);
    for ground in [Ground::Area, Ground::Cell] {
        for off in [
            -0.2, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 12.0, 30.0, 5e4,
        ] {
            for own_std_dev in [OWN_STD_DEV, 1e-3, 3e-5] {
                let theta = (THETA + off * std_dev).max(1e-6);
                let wrong = measured(theta, own_std_dev, 40);
                let (held, width) = coverage(honest, Some(wrong), ground);
                let ratio = width / width_of(honest + 1);
                let said = format!(
                    "{honest} honest, one {off} deviations off with its own of {own_std_dev}, \
                     {ground:?}: {held:.3} hold the truth, {ratio:.2} times as wide"
                );
                assert!(held >= 0.9, "{said}");
                assert!(ratio <= 2.0, "{said}");
                held_least = held_least.min(held);
                ratio_most = ratio_most.max(ratio);
            }
        }
    }
    eprintln!("at worst {held_least:.3} hold the truth, {ratio_most:.2} times as wide");
}

#[test]
fn one_wrong_robot_of_three_moves_no_interval_off_the_truth_nor_makes_it_wide() {
    check_one_wrong_beside(2);
}

#[test]
fn one_wrong_robot_of_four_moves_no_interval_off_the_truth_nor_makes_it_wide() {
    check_one_wrong_beside(3);
}

#[test]
fn one_wrong_robot_of_five_moves_no_interval_off_the_truth_nor_makes_it_wide() {
    check_one_wrong_beside(4);
}

#[test]
fn one_wrong_robot_of_eight_moves_no_interval_off_the_truth_nor_makes_it_wide() {
    check_one_wrong_beside(7);
}

#[test]
fn where_all_are_honest_the_intervals_hold_and_are_not_much_wider() {
    for (honest, ratio_max) in [(3_u8, 1.7), (5, 1.55), (8, 1.45), (30, 1.3)] {
        let (held, width) = coverage(honest, None, Ground::Cell);
        let ratio = width / width_of(honest);
        eprintln!("{honest} honest: {held:.3} hold the truth, {ratio:.2} times as wide");
        assert!(
            held >= 0.94 && ratio <= ratio_max,
            "{honest}: {held:.3}, {ratio:.2}"
        );
    }
}

#[test]
fn the_word_of_one_robot_raises_no_limit_above_what_others_have_shown() {
    let config = FrictionConfig {
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        ..FrictionConfig::default()
    };
    let claim = |robot: u8, mu: f64| {
        (
            robot,
            with_peak_friction(mu, measured(0.2, 0.01, i64::from(robot))),
        )
    };
    let mu = |parts: &[(u8, Sums)]| {
        let fused = fused(parts.iter().copied(), &config).unwrap();
        fused.mu_peak_lower_bound
    };
    assert_eq!(
        mu(&[claim(1, 10.0)]),
        Some(MU_ALONE_MAX),
        "nobody confirms it"
    );
    assert_eq!(mu(&[claim(1, 0.3)]), Some(0.3));
    assert_eq!(mu(&[claim(1, 10.0), claim(2, 0.2)]), Some(MU_ALONE_MAX));
    assert_eq!(mu(&[claim(1, 10.0), claim(2, 0.7)]), Some(0.7));
    assert_eq!(
        mu(&[claim(1, 10.0), claim(2, 0.7), claim(3, 0.6)]),
        Some(0.7)
    );
    let often = [
        claim(1, 10.0),
        (
            1,
            with_peak_friction(10.0, measured(0.2, 0.01, HOUR_S + 60)),
        ),
    ];
    assert_eq!(
        mu(&often),
        Some(MU_ALONE_MAX),
        "it may say it as often as it likes"
    );
}

#[test]
fn one_robot_cannot_make_ground_better_that_several_others_found_worse() {
    let config = FrictionConfig {
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        ..FrictionConfig::default()
    };
    let honest = || (1..=3_u8).map(|robot| (robot, measured(1.4, 0.05, 1_000)));
    let lies = (0..5).map(|time| (9, measured(0.01, 0.001, 10 * time)));
    let estimate = fused(honest().chain(lies), &config).unwrap();
    assert!(
        (estimate.theta - 1.4).abs() < 0.2 && estimate.disputed,
        "{estimate:?}"
    );
    // Two false values, of which the older makes the newer look like more slip, have no effect
    // either, within one hour or over two.
    for (earlier, later) in [(0.001, 0.01), (0.01, 0.001)] {
        for age_s in [20, HOUR_S + 20] {
            let lies = [
                (9, measured(earlier, 1e-5, age_s)),
                (9, measured(later, 1e-5, 10)),
            ];
            let honest = (1..=3_u8).map(|robot| (robot, measured(1.4, 0.05, 3 * HOUR_S)));
            let estimate = fused(honest.chain(lies), &config).unwrap();
            assert!((estimate.theta - 1.4).abs() < 0.3, "{estimate:?}");
        }
    }
    // A vague measurement that contradicts nothing does not confirm the change.
    let lie = (9, measured(0.01, 0.001, 10));
    let vague = (8, measured(1.2, 0.7, 20));
    let estimate = fused(honest().chain([lie, vague]), &config).unwrap();
    assert!((estimate.theta - 1.4).abs() < 0.3, "{estimate:?}");
    // A second robot with the same measurement confirms the change.
    let others = (0..5).map(|time| {
        (
            u8::try_from(8 + time % 2).unwrap(),
            measured(0.2, 0.01, 10 * i64::from(time)),
        )
    });
    let better = fused(honest().chain(others), &config).unwrap();
    assert!((better.theta - 0.2).abs() < 0.05, "{better:?}");
}

#[test]
fn a_lie_about_bad_ground_ends_when_one_honest_robot_has_been_there_twice() {
    let config = FrictionConfig {
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        ..FrictionConfig::default()
    };
    let before = (1, measured(0.2, 0.01, 4 * HOUR_S));
    let lie = (9, measured(5.0, 0.05, 3 * HOUR_S));
    let after = |age_s| (2, measured(0.2, 0.01, age_s));
    let estimate = fused([before, lie, after(60), after(30)], &config).unwrap();
    assert!((estimate.theta - 0.2).abs() < 0.05, "{estimate:?}");
}

#[test]
fn robots_that_know_next_to_nothing_take_nothing_from_one_that_knows() {
    let config = FrictionConfig {
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        ..FrictionConfig::default()
    };
    let precise = (1, measured(0.2, 0.01, 10));
    let vague = [2, 3, 4].map(|robot| (robot, measured(0.5, 1e3, 20)));
    let alone = fused([precise], &config).unwrap();
    let together = fused(vague.into_iter().chain([precise]), &config).unwrap();
    assert!((together.theta - alone.theta).abs() < 1e-3, "{together:?}");
    assert!(
        (together.std_dev - alone.std_dev).abs() < 1e-3,
        "{together:?}"
    );
}

proptest! {
    #[test]
    fn whatever_one_of_three_says_the_interval_holds_both_others_or_most_of_them(
        theta in 1e-6_f64..1e3,
        own_std_dev in 1e-5_f64..1.0,
    ) {
        let config = FrictionConfig {
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        ..FrictionConfig::default()
    };
        let honest = [(1, measured(0.2, 0.01, 1)), (2, measured(0.205, 0.01, 2))];
        let wrong = (0, measured(theta, own_std_dev, 40));
        let fused = fused_as(honest.into_iter().chain([wrong]), Ground::Area, &config).unwrap();
        let (low, high) = fused.theta.interval_95();
        prop_assert!(low < 0.2 && 0.205 < high, "{low} to {high}");
        prop_assert!(high - low < 0.15, "{low} to {high}");
    }
}
