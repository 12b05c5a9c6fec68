//! Tests of invariants of the fusion.

use std::collections::BTreeMap;

use proptest::prelude::*;
use tread_api::friction::{Information, ROBOT_BIAS_RATIO};

use super::epochs::HOUR_S;
use super::fixed::Fixed;
use super::fuse::THETA_STD_DEV_MAX;
use super::sums::{Pair, Pass};
use super::weights::FrictionConfig;
use super::*;

fn now() -> Timestamp {
    "2026-11-01T12:00:00Z".parse().unwrap()
}

/// Returns the time `age_s` seconds before now.
pub(super) fn at_us(age_s: i64) -> i64 {
    now().as_microsecond() - age_s * 1_000_000
}

pub(super) fn measured(theta: f64, std_dev: f64, age_s: i64) -> Sums {
    let information = std_dev.powi(-2);
    let fixed = |value| Fixed::from_f64(value).unwrap();
    Sums {
        theta: Pair {
            information: fixed(information),
            weighted: fixed(information * theta),
        },
        theta_square: fixed(information * theta * theta),
        robot_error: Fixed::default(),
        tyre_error: Fixed::default(),
        track: Pair::default(),
        rolling: Pair::default(),
        segments: 1,
        samples: 10,
        mu_peak: None,
        newest_at_us: at_us(age_s),
        newest: Pass {
            ended_at_us: at_us(age_s),
            theta: Some(Information {
                information,
                weighted: information * theta,
            }),
            mu_peak: None,
        },
    }
}

pub(super) fn with_peak_friction(mu_peak: f64, sums: Sums) -> Sums {
    let newest = Pass {
        mu_peak: Some(mu_peak),
        ..sums.newest
    };
    Sums {
        mu_peak: Some(mu_peak),
        newest,
        ..sums
    }
}

/// Sums measurements per robot and epoch, as the database does, and fuses them.
pub(super) fn fused_as(
    parts: impl IntoIterator<Item = (u8, Sums)>,
    ground: Ground,
    config: &FrictionConfig,
) -> Option<Fused> {
    let mut sums: BTreeMap<(u8, i64), Sums> = BTreeMap::new();
    for (robot, part) in parts {
        let key = (robot, epoch_h(part.newest_at()));
        sums.entry(key)
            .and_modify(|present| present.add(&part))
            .or_insert(part);
    }
    let mut seen: Vec<EpochMeasurement<u8>> = sums
        .iter()
        .filter_map(|(&(robot, epoch), sums)| EpochMeasurement::of(robot, epoch, sums))
        .collect();
    fuse(&mut seen, ground, config, at_us(0))
}

pub(super) fn fused(
    parts: impl IntoIterator<Item = (u8, Sums)>,
    config: &FrictionConfig,
) -> Option<FusedFriction> {
    fused_as(parts, Ground::Cell, config).map(|fused| fused.to_api(at_us(0)))
}

fn no_bias() -> FrictionConfig {
    FrictionConfig {
        robot_bias_ratio: 0.0,
        drift_variance_per_s: 0.0,
        ..FrictionConfig::default()
    }
}

fn close(left: f64, right: f64) -> bool {
    (left - right).abs() <= 1e-6 * right.abs()
}

#[test]
fn nothing_measured_is_nothing_known() {
    assert_eq!(fused([], &FrictionConfig::default()), None);
    let mut empty = measured(0.2, 0.01, 0);
    empty.theta.information = Fixed::default();
    assert_eq!(fused([(1, empty)], &FrictionConfig::default()), None);
}

#[test]
fn what_tells_no_ground_from_another_is_unknown_until_enough_of_it_has_come() {
    let vague = measured(0.2, 1.5 * THETA_STD_DEV_MAX, 0);
    assert_eq!(fused([(1, vague)], &no_bias()), None);
    let four = fused([1, 2, 3, 4].map(|robot| (robot, vague)), &no_bias()).unwrap();
    assert!(four.std_dev < THETA_STD_DEV_MAX, "{four:?}");
}

#[test]
fn without_bias_and_drift_information_adds_up() {
    let parts = [
        (1, measured(0.20, 0.01, 0)),
        (2, measured(0.23, 0.02, 9_000)),
    ];
    let fused = fused(parts, &no_bias()).unwrap();
    let expected = (0.20 * 1e4 + 0.23 * 2.5e3) / 1.25e4;
    assert!(close(fused.theta, expected), "{fused:?}");
    assert!(close(fused.std_dev, 1.25e4_f64.sqrt().recip()), "{fused:?}");
    assert!(close(fused.stiffness * fused.theta, 1.0));
    assert_eq!((fused.segments, fused.robots), (2, 2));
    assert!(!fused.disputed && fused.changed_at.is_none());
}

#[test]
fn bounds_lie_around_the_most_probable_value_and_say_when_there_are_none() {
    let config = FrictionConfig::default();
    let fused = fused([(1, measured(0.2, 0.01, 0))], &config).unwrap();
    let bounds = fused.bounds;
    assert!(close(
        bounds.theta_upper_95 - fused.theta,
        NORMAL_90 * fused.std_dev
    ));
    assert!(close(bounds.stiffness_lower_5 * bounds.theta_upper_95, 1.0));
    assert!(bounds.stiffness_upper_95.unwrap() > fused.stiffness);
    let vague = self::fused([(1, measured(0.2, 1.0, 0))], &config).unwrap();
    assert_eq!(vague.bounds.stiffness_upper_95, None);
}

#[test]
fn one_robot_never_gets_surer_than_its_own_bias() {
    let config = FrictionConfig {
        drift_variance_per_s: 0.0,
        ..FrictionConfig::default()
    };
    let alone = fused([(1, measured(0.2, 1e-4, 0))], &config).unwrap();
    assert!(alone.std_dev >= ROBOT_BIAS_RATIO * 0.2, "{alone:?}");
    let robots = (0..5).map(|robot| (robot, measured(0.2, 1e-4, 0)));
    let many = fused(robots, &config).unwrap();
    // Any one of the five may be wrong, so the interval is that of four.
    assert!(
        (many.std_dev / alone.std_dev - 0.5).abs() < 1e-3,
        "{many:?}"
    );
}

#[test]
fn what_is_old_weighs_less_and_a_clock_that_runs_ahead_gains_nothing() {
    let config = FrictionConfig {
        drift_variance_per_s: 1e-8,
        ..no_bias()
    };
    let day_s = 86_400;
    let old = fused([(1, measured(0.2, 0.001, day_s))], &config).unwrap();
    let variance = 1e-6 + 1e-8 * 86_400.0;
    assert!(close(old.std_dev, f64::sqrt(variance)), "{old:?}");
    assert!(close(old.age_s, 86_400.0));
    let ahead = fused([(1, measured(0.2, 0.001, -day_s))], &config).unwrap();
    assert!(
        close(ahead.std_dev, 0.001) && ahead.age_s == 0.0,
        "{ahead:?}"
    );
    let parts = [
        (1, measured(0.22, 0.001, day_s)),
        (1, measured(0.2, 0.01, 0)),
    ];
    assert!(fused(parts, &config).unwrap().theta < 0.203, "new counts");
}

#[test]
fn robots_that_differ_by_more_than_their_bias_dispute_the_ground_and_widen_its_interval() {
    let config = FrictionConfig {
        robot_bias_ratio: ROBOT_BIAS_RATIO,
        ..FrictionConfig::default()
    };
    let parts = |second: f64| {
        (0..6).map(move |robot| {
            let theta = if robot % 2 == 0 { 0.2 } else { second };
            (robot, measured(theta, 0.001, i64::from(robot)))
        })
    };
    let agreed = fused(parts(0.21), &config).unwrap();
    assert!(!agreed.disputed, "{agreed:?}");
    let disputed = fused_as(parts(0.32), Ground::Area, &config).unwrap();
    assert!(disputed.is_disputed, "{disputed:?}");
    assert!(
        disputed.theta.std_dev > 2.0 * agreed.std_dev,
        "{disputed:?}"
    );
}

#[test]
fn passes_of_one_robot_that_contradict_each_other_dispute_a_cell_but_not_an_area() {
    let passes = || {
        (0..20).map(|visit| {
            let theta = if visit % 2 == 0 { 0.2 } else { 0.23 };
            (1, measured(theta, 0.01, visit))
        })
    };
    let cell = fused_as(passes(), Ground::Cell, &FrictionConfig::default()).unwrap();
    assert!(cell.is_disputed, "{cell:?}");
    let area = fused_as(passes(), Ground::Area, &FrictionConfig::default()).unwrap();
    assert!(!area.is_disputed, "places differ: {area:?}");
}

/// Returns passes of three robots on θ 0.2 until `ice_s` seconds ago, and then the given passes on
/// ice.
fn iced(on_ice: &[(u8, i64)]) -> Vec<(u8, Sums)> {
    let before = (0..30).map(|visit| {
        let robot = u8::try_from(visit % 3).unwrap();
        let theta = 0.2 + 0.001 * f64::from(robot);
        let age_s = 600 + i64::from(visit) * 700;
        (robot, with_peak_friction(0.6, measured(theta, 0.01, age_s)))
    });
    let after = on_ice
        .iter()
        .map(|&(robot, age_s)| (robot, with_peak_friction(0.1, measured(1.43, 0.07, age_s))));
    before.chain(after).collect()
}

#[test]
fn ice_shows_at_the_first_pass_and_is_certain_at_the_second_within_the_same_hour() {
    let config = FrictionConfig::default();
    let before = fused(iced(&[]), &config).unwrap();
    assert!((before.theta - 0.2).abs() < 0.02 && !before.disputed);
    assert_eq!(before.mu_peak_lower_bound, Some(0.6));
    let first = fused(iced(&[(0, 60)]), &config).unwrap();
    assert!((first.theta - 1.43).abs() < 0.2, "{first:?}");
    assert!(first.disputed, "one pass against all others: {first:?}");
    assert_eq!(
        first.mu_peak_lower_bound,
        Some(0.1),
        "what was seen before is void"
    );
    let second = fused(iced(&[(0, 60), (1, 30)]), &config).unwrap();
    assert!((second.theta - 1.43).abs() < 0.2, "{second:?}");
    assert!(!second.disputed, "{second:?}");
    assert_eq!(second.changed_at.unwrap().as_microsecond(), at_us(60));
}

#[test]
fn a_pass_that_says_next_to_nothing_does_not_hide_the_ice_before_it() {
    let config = FrictionConfig::default();
    let mut parts = iced(&[(0, 60)]);
    let seen = fused(parts.clone(), &config).unwrap();
    // Of the same robot in the same hour, with a relative standard deviation of a quarter.
    parts.push((0, measured(0.8, 0.2, 30)));
    let vague = fused(parts, &config).unwrap();
    assert!(close(vague.theta, seen.theta), "{seen:?}, then {vague:?}");
    assert!(vague.changed_at.is_some() && vague.age_s < seen.age_s);
}

#[test]
fn more_friction_is_believed_when_a_second_pass_confirms_it() {
    let config = FrictionConfig::default();
    let frozen = |visit: i64| (1, measured(1.43, 0.07, 2 * HOUR_S + visit));
    let thawed = |robot: u8, age_s: i64| (robot, measured(0.2, 0.01, age_s));
    let first = fused((0..5).map(frozen).chain([thawed(1, 60)]), &config).unwrap();
    assert!((first.theta - 1.43).abs() < 0.2, "{first:?}");
    assert!(first.disputed && first.changed_at.is_none(), "{first:?}");
    let parts = (0..5).map(frozen).chain([thawed(1, 60), thawed(2, 30)]);
    let second = fused(parts, &config).unwrap();
    assert!((second.theta - 0.2).abs() < 0.02, "{second:?}");
    assert_eq!(second.changed_at.unwrap().as_microsecond(), at_us(60));
}

#[test]
fn friction_that_was_seen_expires() {
    let config = FrictionConfig::default();
    let seen = |age_s| with_peak_friction(0.7, measured(0.2, 0.01, age_s));
    let by_two = |age_s| [1, 2].map(|robot| (robot, seen(age_s)));
    let young = fused(by_two(HOUR_S), &config).unwrap();
    assert_eq!(young.mu_peak_lower_bound, Some(0.7));
    let old = fused(by_two(7 * HOUR_S), &config).unwrap();
    assert_eq!(old.mu_peak_lower_bound, None);
}

#[test]
fn other_layers_are_fused_where_they_were_seen_and_unknown_elsewhere() {
    let config = FrictionConfig::default();
    let mut turned = measured(0.2, 0.01, 0);
    turned.track = Pair {
        information: Fixed::from_f64(1e4).unwrap(),
        weighted: Fixed::from_f64(1.5e4).unwrap(),
    };
    let fused = fused([(1, turned), (2, measured(0.2, 0.01, 0))], &config).unwrap();
    let track = fused.effective_track_ratio.unwrap();
    assert!(
        close(track.value, 1.5) && track.std_dev > ROBOT_BIAS_RATIO * 1.5,
        "{track:?}"
    );
    assert_eq!(fused.rolling_resistance, None);
}

#[test]
fn noise_below_zero_still_gives_a_number_that_json_can_say() {
    let config = FrictionConfig::default();
    let fused = fused([(1, measured(-0.01, 0.05, 0))], &config).unwrap();
    assert!(fused.theta > 0.0 && fused.stiffness.is_finite() && fused.theta_low_95 >= 0.0);
    assert!(fused.theta_high_95 > fused.theta, "{fused:?}");
}

fn part() -> impl Strategy<Value = (u8, Sums)> {
    (
        0_u8..5,
        0.01_f64..2.0,
        0.001_f64..0.5,
        -10_000_i64..1_000_000,
        prop::option::of(0.0_f64..1.0),
    )
        .prop_map(|(robot, theta, std_dev, age_s, mu)| {
            let sums = measured(theta, std_dev, age_s);
            (robot, mu.map_or(sums, |mu| with_peak_friction(mu, sums)))
        })
}

proptest! {
    #[test]
    fn the_answer_is_the_same_to_the_bit_in_any_order_and_batching(
        (parts, shuffled) in prop::collection::vec(part(), 1..40)
            .prop_flat_map(|parts| (Just(parts.clone()), Just(parts).prop_shuffle())),
        cut in 0_usize..40,
    ) {
        let config = FrictionConfig::default();
        for ground in [Ground::Cell, Ground::Area] {
            let whole = fused_as(parts.clone(), ground, &config);
            prop_assert_eq!(whole, fused_as(shuffled.clone(), ground, &config));
        }
        // Each batch is summed first.
        let mut batches: BTreeMap<(bool, u8, i64), Sums> = BTreeMap::new();
        for (index, (robot, part)) in shuffled.iter().enumerate() {
            let key = (index < cut, *robot, epoch_h(part.newest_at()));
            batches.entry(key).and_modify(|sums| sums.add(part)).or_insert(*part);
        }
        let batched = batches.iter().map(|(&(_, robot, _), sums)| (robot, *sums));
        prop_assert_eq!(
            fused_as(parts, Ground::Cell, &config),
            fused_as(batched, Ground::Cell, &config)
        );
    }

    #[test]
    fn the_estimate_lies_among_what_was_measured(parts in prop::collection::vec(part(), 1..40)) {
        let thetas = || parts.iter().map(|(_, sums)| sums.theta.known().unwrap().value);
        let lowest = thetas().fold(f64::INFINITY, f64::min);
        let highest = thetas().fold(0.0, f64::max);
        let fused = fused(parts.clone(), &FrictionConfig::default()).unwrap();
        prop_assert!(fused.theta >= lowest * (1.0 - 1e-6) && fused.theta <= highest * (1.0 + 1e-6));
        prop_assert!(fused.std_dev > 0.0);
    }

    #[test]
    fn without_a_robot_the_map_is_as_if_it_had_never_come(parts in prop::collection::vec(part(), 1..40)) {
        // Sums are kept per robot, so removing one robot does not change those of others.
        let config = FrictionConfig::default();
        let others: Vec<_> = parts.iter().copied().filter(|(robot, _)| *robot != 2).collect();
        let mut sums: BTreeMap<(u8, i64), Sums> = BTreeMap::new();
        for (robot, part) in &parts {
            let key = (*robot, epoch_h(part.newest_at()));
            sums.entry(key).and_modify(|present| present.add(part)).or_insert(*part);
        }
        sums.retain(|&(robot, _), _| robot != 2);
        let mut seen: Vec<_> = sums
            .iter()
            .filter_map(|(&(robot, epoch), sums)| EpochMeasurement::of(robot, epoch, sums))
            .collect();
        let withdrawn = fuse(&mut seen, Ground::Cell, &config, at_us(0));
        prop_assert_eq!(withdrawn, fused_as(others, Ground::Cell, &config));
    }
}
