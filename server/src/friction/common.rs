//! Tests of common errors of segments: of one robot, and of all robots with the same tyres.

use tread_api::friction::{Information, NORMAL_95, ThetaErrors};

use super::coverage::Normal;
use super::fixed::Fixed;
use super::tests::{at_us, fused_as, measured};
use super::weights::FrictionConfig;
use super::*;

const THETA: f64 = 0.2;
/// Standard deviation of the independent error of one segment.
const OWN_STD_DEV: f64 = 0.01;
/// Common errors that the robots state, relative to θ.
const ROBOT_RATIO: f64 = 0.12;
const TYRE_RATIO: f64 = 0.1;
const FLEETS: u32 = 3_000;

/// Returns the sums of a segment that states its common errors.
fn sums_of(theta: f64, age_s: i64, [robot, tyre]: [f64; 2]) -> Sums {
    let sums = measured(theta, OWN_STD_DEV, age_s);
    let information = OWN_STD_DEV.powi(-2);
    Sums {
        robot_error: Fixed::from_f64(information * robot).unwrap(),
        tyre_error: Fixed::from_f64(information * tyre).unwrap(),
        ..sums
    }
}

fn fleet(robots: u8, passes: i64) -> Fused {
    let ratios = [ROBOT_RATIO, TYRE_RATIO];
    let parts = (0..robots)
        .flat_map(|robot| (0..passes).map(move |pass| (robot, sums_of(THETA, pass, ratios))));
    fused_as(parts, Ground::Cell, &FrictionConfig::default()).unwrap()
}

#[test]
fn theta_narrows_with_robots_and_not_with_the_segments_of_one() {
    let std_dev = |robots, passes| fleet(robots, passes).theta.std_dev / THETA;
    let common = ROBOT_RATIO.hypot(TYRE_RATIO);
    let (one, often) = (std_dev(1, 1), std_dev(1, 200));
    assert!(one > often && often > common, "{one} {often} {common}");
    assert!(often < 1.01 * common, "{often} {common}");
    let (two, thirty) = (std_dev(2, 50), std_dev(30, 50));
    assert!(two < 0.85 * often, "{two} {often}");
    // The error common to all robots does not average out.
    assert!(
        (TYRE_RATIO..1.15 * TYRE_RATIO).contains(&thirty),
        "{thirty}"
    );
}

#[test]
fn intervals_hold_the_truth_where_robots_share_the_error_of_their_tyres() {
    for robots in [1_u8, 2, 3, 8] {
        let mut normal = Normal(0x5EED_0003 + u64::from(robots));
        let mut held = 0;
        for _ in 0..FLEETS {
            let tyres = TYRE_RATIO * normal.next();
            let mut parts = Vec::new();
            for robot in 0..robots {
                let own = THETA * (1.0 + tyres + ROBOT_RATIO * normal.next());
                for pass in 0..4 {
                    let theta = own + OWN_STD_DEV * normal.next();
                    parts.push((robot, sums_of(theta, pass, [ROBOT_RATIO, TYRE_RATIO])));
                }
            }
            let fused = fused_as(parts, Ground::Cell, &FrictionConfig::default()).unwrap();
            let (low, high) = fused.theta.interval_95();
            held += u32::from((low..=high).contains(&THETA));
        }
        let share = f64::from(held) / f64::from(FLEETS);
        eprintln!("{robots} robots: {share:.3} hold the truth");
        assert!(share >= 0.93, "{robots} robots: {share}");
    }
}

/// Returns coverage and mean width of the intervals of `honest` honest robots and optionally a
/// wrong one.
fn beside(honest: u8, wrong: Option<Sums>) -> (f64, f64) {
    let mut normal = Normal(0x5EED_0004);
    let (mut held, mut width) = (0, 0.0);
    for _ in 0..FLEETS {
        let tyres = TYRE_RATIO * normal.next();
        let mut parts: Vec<(u8, Sums)> = (1..=honest)
            .map(|robot| {
                let own = THETA * (1.0 + tyres + ROBOT_RATIO * normal.next());
                let theta = own + OWN_STD_DEV * normal.next();
                (robot, sums_of(theta, 1, [ROBOT_RATIO, TYRE_RATIO]))
            })
            .collect();
        parts.extend(wrong.map(|wrong| (0, wrong)));
        let fused = fused_as(parts, Ground::Area, &FrictionConfig::default()).unwrap();
        let (low, high) = fused.theta.interval_95();
        held += u32::from((low..=high).contains(&THETA));
        width += high - low;
    }
    (
        f64::from(held) / f64::from(FLEETS),
        width / f64::from(FLEETS),
    )
}

#[test]
fn one_robot_of_three_or_more_gains_nothing_by_what_it_says_of_its_errors() {
    for honest in [2_u8, 3, 7] {
        let robots = f64::from(honest + 1);
        let own = (ROBOT_RATIO * THETA).hypot(OWN_STD_DEV);
        let ideal = 2.0 * NORMAL_95 * (own / robots.sqrt()).hypot(TYRE_RATIO * THETA);
        for ratios in [
            [0.0, 0.0],
            [0.0, 10.0],
            [10.0, 10.0],
            [ROBOT_RATIO, TYRE_RATIO],
        ] {
            for off in [0.5, 2.0, 3.0, 4.0, 8.0, 1e4] {
                let wrong = sums_of(THETA + off * own, 40, ratios);
                let (held, width) = beside(honest, Some(wrong));
                let said = format!(
                    "{honest} honest, one {off} off that says {ratios:?}: {held:.3}, {:.2} times",
                    width / ideal
                );
                assert!(held >= 0.9 && width <= 2.0 * ideal, "{said}");
            }
        }
    }
}

#[test]
fn sums_keep_the_independent_information_and_mean_shares_of_what_is_common() {
    let mut sums = sums_of(THETA, 0, [0.1, 0.2]);
    sums.add(&sums_of(THETA, 1, [0.3, 0.0]));
    let seen = EpochMeasurement::of(1_u8, 0, &sums).unwrap();
    assert!((seen.robot_ratio - 0.2).abs() < 1e-6 && (seen.tyre_ratio - 0.1).abs() < 1e-6);
    // A robot that does not state its common errors has none in the sums.
    let silent = EpochMeasurement::of(1_u8, 0, &measured(THETA, OWN_STD_DEV, 0)).unwrap();
    assert!(silent.robot_ratio <= 0.0 && silent.tyre_ratio <= 0.0);
    assert!(
        fuse(
            &mut vec![silent],
            Ground::Cell,
            &FrictionConfig::default(),
            at_us(0)
        )
        .is_some()
    );
}

#[test]
fn a_segment_that_tells_its_errors_apart_counts_with_its_independent_one() {
    let text = r#"{
        "configuration": "00000000-0000-0000-0000-000000000001",
        "started_at": "2026-11-01T11:59:00Z", "ended_at": "2026-11-01T12:00:00Z",
        "grid_revision": 1, "cell": {"ix": 0, "iy": 0},
        "theta": {"information": 4.0, "weighted": 0.8},
        "samples": 9, "distance_m": 1.0, "saturation_ratio": 0.0
    }"#;
    let mut segment: tread_api::friction::Segment = serde_json::from_str(text).unwrap();
    assert!(segment.validate().is_ok() && segment.theta_errors.is_none());
    let before = Sums::of(&segment).unwrap().theta.known().unwrap();
    assert!((before.information - 4.0).abs() < 1e-9);
    let errors = ThetaErrors {
        independent_information: 2_500.0,
        robot_ratio: 0.12,
        tyre_ratio: 0.1,
    };
    segment.theta_errors = Some(errors);
    let again: tread_api::friction::Segment =
        serde_json::from_str(&serde_json::to_string(&segment).unwrap()).unwrap();
    assert_eq!(again, segment);
    let sums = Sums::of(&again).unwrap();
    let known = sums.theta.known().unwrap();
    assert!((known.information - 2_500.0).abs() < 1e-6 && (known.value - 0.2).abs() < 1e-9);
    assert!((sums.robot_error.to_f64() - 300.0).abs() < 1e-6);
    let newest = sums.newest.theta.as_ref().and_then(Information::value);
    assert!(newest.is_some_and(|value| (value - 0.2).abs() < 1e-9));
    for bad in [
        ThetaErrors {
            independent_information: 0.0,
            ..errors
        },
        ThetaErrors {
            robot_ratio: -0.1,
            ..errors
        },
        ThetaErrors {
            tyre_ratio: f64::NAN,
            ..errors
        },
        ThetaErrors {
            tyre_ratio: 11.0,
            ..errors
        },
    ] {
        segment.theta_errors = Some(bad);
        assert!(segment.validate().is_err(), "{bad:?}");
    }
}
