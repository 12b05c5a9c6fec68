use std::time::Duration;

use proptest::prelude::*;
use tread_agent::drive::{SensorSample, StatedNoise};
use tread_control::estimation::CommonError;
use tread_control::measured::WheelSpeeds;

use super::*;
use crate::random::Random;

fn measured(theta: f64, own_std_dev: f64, common: f64) -> ThetaMeasurement {
    ThetaMeasurement {
        theta,
        std_dev: own_std_dev.hypot(common),
        own_std_dev,
        common: CommonError {
            robot: common,
            tyres: 0.0,
        },
        effective_samples: 100.0,
        duration_s: 20.0,
    }
}

#[test]
fn pairs_are_compared_by_the_sum_of_their_variances() {
    let passes = [
        (1, measured(0.2, 0.03, 0.05)),
        (3, measured(0.25, 0.04, 0.05)),
        (4, measured(0.2, 0.03, 0.02)),
    ];
    let found = pairs(&passes);
    let named: Vec<(usize, usize)> = found.iter().map(|pair| (pair.first, pair.second)).collect();
    assert_eq!(named, [(1, 3), (1, 4), (3, 4)]);
    // 0.05² over 0.03² + 0.04²: what both share alike is no difference.
    assert!((found[0].chi_square - 1.0).abs() < 1.0e-9, "{found:?}");
    assert!(found[1].chi_square.abs() < 1.0e-12);
    // What they share unequally is: 0.05² over 0.04² + 0.03² + 0.03².
    assert!(
        (found[2].chi_square - 25.0 / 34.0).abs() < 1.0e-9,
        "{found:?}"
    );
    assert!((mean_chi_square(&found).unwrap() - (1.0 + 25.0 / 34.0) / 3.0).abs() < 1.0e-9);
    assert_eq!(mean_chi_square(&pairs(&passes[..1])), None);
}

#[test]
fn honest_passes_give_one_in_the_mean() {
    let mut random = Random::new(5);
    let (mut sum, runs) = (0.0, 400);
    for _ in 0..runs {
        let shared = random.normal(0.05);
        let passes: Vec<(usize, ThetaMeasurement)> = (1..=5)
            .map(|number| {
                let own = random.uniform(0.01..0.04);
                let theta = 0.3 + shared + random.normal(own);
                (number, measured(theta, own, 0.05))
            })
            .collect();
        sum += mean_chi_square(&pairs(&passes)).unwrap();
    }
    let mean = sum / f64::from(runs);
    assert!((mean - 1.0).abs() < 0.1, "{mean}");
}

/// A minute of turns at 50 Hz: `turn` gives turn rate and forward speed.
fn turning(
    ratio: f64,
    turn: impl Fn(u32) -> (f64, f64),
    gyro_offset_rad_s: f64,
    noise: &mut Random,
) -> Vec<LoopInput> {
    let model = RobotModel::yi2007();
    let (radius_m, track_m) = (model.wheel_radius_m(), model.track_width_m());
    let fed = (0..3_000_u32).map(|index| {
        let (turn_rad_s, forward_m_s) = turn(index);
        let half_m_s = 0.5 * ratio * track_m * turn_rad_s;
        let mut rim = |rim_m_s: f64| rim_m_s / radius_m + noise.normal(0.01);
        LoopInput {
            sample: SensorSample {
                at: Duration::from_millis(20) * index,
                yaw_rate_rad_s: Some(turn_rad_s + gyro_offset_rad_s),
                wheel_speeds: Some(WheelSpeeds {
                    left_rad_s: rim(forward_m_s - half_m_s),
                    right_rad_s: rim(forward_m_s + half_m_s),
                }),
                ..SensorSample::default()
            },
            noise: StatedNoise::default(),
        }
    });
    fed.collect()
}

#[test]
fn straight_driving_gives_no_effective_track() {
    let mut random = Random::new(1);
    let straight = turning(1.5, |_| (0.0, 0.6), 0.0, &mut random);
    assert_eq!(effective_track(&straight, &RobotModel::yi2007()), None);
    // Nor do turns that never are steady for a second.
    let wild = turning(
        1.5,
        |index| (0.8 * (f64::from(index) * 0.1).sin(), 0.5),
        0.0,
        &mut random,
    );
    assert_eq!(effective_track(&wild, &RobotModel::yi2007()), None);
}

#[test]
fn turns_to_both_sides_tell_the_gyros_offset_from_the_track() {
    let mut random = Random::new(2);
    let sides = |index: u32| {
        if (index / 500).is_multiple_of(2) {
            (0.4, 0.5)
        } else {
            (-0.4, 0.5)
        }
    };
    let found = effective_track(
        &turning(1.6, sides, 0.004, &mut random),
        &RobotModel::yi2007(),
    );
    let found = found.unwrap();
    assert!((found.ratio - 1.6).abs() < 0.01, "{found:?}");
    assert!(found.left_bins > 20 && found.right_bins > 20, "{found:?}");
    let one = |_| (0.4, 0.5);
    let one_sided = effective_track(
        &turning(1.6, one, 0.004, &mut random),
        &RobotModel::yi2007(),
    );
    assert!(
        one_sided.unwrap().std_dev > 1.2 * found.std_dev,
        "{one_sided:?}"
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn the_interval_of_the_effective_track_holds_the_truth(
        ratio in 1.1..2.2_f64, rate in 0.15..0.9_f64, offset in -0.004..0.004_f64, seed in 0_u64..1_000,
    ) {
        let mut random = Random::new(seed);
        let sides = |index: u32| if (index / 500).is_multiple_of(2) { (rate, 0.4) } else { (-rate, 0.4) };
        let fed = turning(ratio, sides, offset, &mut random);
        let found = effective_track(&fed, &RobotModel::yi2007()).unwrap();
        prop_assert!(found.low_95 < ratio && ratio < found.high_95, "{found:?}");
        prop_assert!(found.std_dev < 0.03 * ratio, "{found:?}");
    }
}
