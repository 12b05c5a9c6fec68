//! What fusion must hold, whatever it is given.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

fn now() -> Timestamp {
    "2026-11-01T12:00:00Z".parse().unwrap()
}

fn measured(theta: f64, std_dev: f64, age_s: i64) -> Sums {
    let information = std_dev.powi(-2);
    Sums {
        information: Fixed::from_f64(information).unwrap(),
        weighted: Fixed::from_f64(information * theta).unwrap(),
        segments: 1,
        samples: 10,
        mu_peak: None,
        newest_at: now() - jiff::SignedDuration::from_secs(age_s),
    }
}

fn no_bias() -> FrictionConfig {
    FrictionConfig {
        robot_bias_ratio: 0.0,
        drift_variance_per_s: 0.0,
    }
}

fn close(left: f64, right: f64) -> bool {
    (left - right).abs() <= 1e-6 * right.abs()
}

#[test]
fn nothing_measured_is_nothing_known() {
    assert_eq!(
        fuse(Vec::<(u8, Sums)>::new(), &FrictionConfig::default(), now()),
        None
    );
    let empty = Sums {
        information: Fixed::default(),
        ..measured(0.2, 0.01, 0)
    };
    assert_eq!(fuse([(1, empty)], &FrictionConfig::default(), now()), None);
}

#[test]
fn without_bias_and_drift_information_adds_up() {
    let parts = [
        (1, measured(0.20, 0.01, 0)),
        (2, measured(0.23, 0.02, 9_000)),
    ];
    let fused = fuse(parts, &no_bias(), now()).unwrap();
    assert!(
        close(fused.theta, (0.20 * 1e4 + 0.23 * 2.5e3) / 1.25e4),
        "{fused:?}"
    );
    assert!(close(fused.std_dev, 1.25e4_f64.sqrt().recip()), "{fused:?}");
    assert!(close(fused.stiffness * fused.theta, 1.0));
    assert_eq!((fused.segments, fused.robots), (2, 2));
}

#[test]
fn one_robot_never_gets_surer_than_its_own_bias() {
    let config = FrictionConfig {
        robot_bias_ratio: 0.08,
        drift_variance_per_s: 0.0,
    };
    let alone = fuse([(1, measured(0.2, 1e-4, 0))], &config, now()).unwrap();
    assert!(alone.std_dev >= 0.08 * 0.2, "{alone:?}");
    let many = fuse(
        (0..4).map(|robot| (robot, measured(0.2, 1e-4, 0))),
        &config,
        now(),
    )
    .unwrap();
    assert!(
        (many.std_dev / alone.std_dev - 0.5).abs() < 1e-3,
        "{many:?}"
    );
}

#[test]
fn what_is_old_weighs_less_and_a_clock_that_runs_ahead_gains_nothing() {
    let config = FrictionConfig {
        robot_bias_ratio: 0.0,
        drift_variance_per_s: 1e-8,
    };
    let day_s = 86_400;
    let old = fuse([(1, measured(0.2, 0.001, day_s))], &config, now()).unwrap();
    let variance = 1e-6 + 1e-8 * 86_400.0;
    assert!(close(old.std_dev, f64::sqrt(variance)), "{old:?}");
    let ahead = fuse([(1, measured(0.2, 0.001, -day_s))], &config, now()).unwrap();
    assert!(close(ahead.std_dev, 0.001), "{ahead:?}");
    let changed = fuse(
        [
            (1, measured(0.5, 0.001, day_s)),
            (1, measured(0.2, 0.01, 0)),
        ],
        &config,
        now(),
    );
    assert!(changed.unwrap().theta < 0.25, "the new ground shows");
}

#[test]
fn noise_below_zero_still_gives_a_number_that_json_can_say() {
    let fused = fuse(
        [(1, measured(-0.01, 0.05, 0))],
        &FrictionConfig::default(),
        now(),
    )
    .unwrap();
    assert!(fused.theta > 0.0 && fused.stiffness.is_finite() && fused.theta_low_95 >= 0.0);
    assert!(fused.theta_high_95 > fused.theta, "{fused:?}");
}

fn part() -> impl Strategy<Value = (u8, Sums)> {
    (
        0_u8..5,
        0.01_f64..2.0,
        0.001_f64..0.5,
        -10_000_i64..1_000_000,
    )
        .prop_map(|(robot, theta, std_dev, age_s)| (robot, measured(theta, std_dev, age_s)))
}

proptest! {
    #[test]
    fn the_answer_is_the_same_to_the_bit_in_any_order(
        (parts, shuffled) in prop::collection::vec(part(), 1..40)
            .prop_flat_map(|parts| (Just(parts.clone()), Just(parts).prop_shuffle())),
    ) {
        let config = FrictionConfig::default();
        prop_assert_eq!(fuse(parts, &config, now()), fuse(shuffled, &config, now()));
    }

    #[test]
    fn the_estimate_lies_among_what_was_measured(parts in prop::collection::vec(part(), 1..40)) {
        let thetas: BTreeSet<u64> =
            parts.iter().map(|(_, sums)| (sums.weighted.to_f64() / sums.information.to_f64()).to_bits()).collect();
        let lowest = f64::from_bits(*thetas.first().unwrap());
        let highest = f64::from_bits(*thetas.last().unwrap());
        let fused = fuse(parts, &FrictionConfig::default(), now()).unwrap();
        prop_assert!(fused.theta >= lowest * (1.0 - 1e-9) && fused.theta <= highest * (1.0 + 1e-9));
        prop_assert!(fused.std_dev > 0.0);
    }
}
