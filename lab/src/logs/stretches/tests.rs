use proptest::prelude::*;
use tread_agent::drive::{SensorSample, StatedNoise};
use tread_control::measured::WheelSpeeds;

use super::*;

fn sample(at_s: f64, left_rad_s: f64, right_rad_s: f64, turn_rad_s: Option<f64>) -> LoopInput {
    LoopInput {
        sample: SensorSample {
            at: Duration::from_secs_f64(at_s),
            yaw_rate_rad_s: turn_rad_s,
            wheel_speeds: Some(WheelSpeeds {
                left_rad_s,
                right_rad_s,
            }),
            ..SensorSample::default()
        },
        noise: StatedNoise::default(),
    }
}

/// Samples at 50 Hz, each moving or not.
fn driven(is_moving: impl Fn(f64) -> bool, length_s: f64) -> Vec<LoopInput> {
    let times = (0..).map(|index| f64::from(index) * 0.02);
    let samples = times.take_while(|at_s| *at_s < length_s).map(|at_s| {
        let speed = if is_moving(at_s) { 5.0 } else { 0.0 };
        sample(at_s, speed, speed, Some(0.0))
    });
    samples.collect()
}

fn all_passes(fed: &[LoopInput], wanted_s: u32) -> Vec<Range<usize>> {
    let model = RobotModel::yi2007();
    let mut found = Vec::new();
    for part in parts(fed) {
        for drive in drives(fed, part, &model) {
            found.extend(passes(fed, drive, Duration::from_secs(u64::from(wanted_s))));
        }
    }
    found
}

fn times_s(fed: &[LoopInput], range: &Range<usize>) -> (f64, f64) {
    let at_s = |index: usize| fed[index].sample.at.as_secs_f64();
    (at_s(range.start), at_s(range.end - 1))
}

#[test]
fn a_gap_begins_a_part_and_a_sample_without_gyro_bridges_none() {
    let mut fed = driven(|_| true, 20.0);
    fed.retain(|fed| !(8.0..9.5).contains(&fed.sample.at.as_secs_f64()));
    assert_eq!(parts(&fed).len(), 2);
    let wheels_alone = sample(8.7, 5.0, 5.0, None);
    let place = fed.partition_point(|fed| fed.sample.at < wheels_alone.sample.at);
    fed.insert(place, wheels_alone);
    let found = parts(&fed);
    assert_eq!(found.len(), 2);
    assert_eq!((found[0].start, found[1].end), (0, fed.len()));
    assert_eq!(found[0].end, found[1].start);
    assert!(parts(&[]).is_empty());
}

#[test]
fn a_short_stop_is_within_a_drive_and_a_long_one_ends_it() {
    let fed = driven(
        |at_s| !(12.0..13.5).contains(&at_s) && !(30.0..33.0).contains(&at_s),
        50.0,
    );
    let found = all_passes(&fed, 60);
    assert_eq!(found.len(), 2);
    let (from_s, to_s) = times_s(&fed, &found[0]);
    assert!(
        from_s.abs() < 1.0e-9 && (to_s - 29.98).abs() < 1.0e-6,
        "{to_s}"
    );
    let (from_s, _) = times_s(&fed, &found[1]);
    assert!((from_s - 33.0).abs() < 1.0e-6, "{from_s}");
}

#[test]
fn what_is_too_short_is_no_pass_and_what_is_long_is_several() {
    assert!(all_passes(&driven(|at_s| at_s < 7.0, 20.0), 60).is_empty());
    let fed = driven(|_| true, 150.0);
    let found = all_passes(&fed, 60);
    assert_eq!(found.len(), 2);
    assert_eq!(found[0].end, found[1].start);
}

#[test]
fn motion_tells_turns_by_their_side_and_the_rate_of_the_wheels() {
    let model = RobotModel::yi2007();
    let mut fed = Vec::new();
    for index in 0..1_500_u32 {
        let at_s = f64::from(index) * 0.02;
        fed.push(match index / 500 {
            0 => sample(at_s, 4.0, 6.0, Some(0.3)),
            1 => sample(at_s, 6.0, 4.0, Some(-0.3)),
            _ => sample(at_s, -4.0, 4.0, Some(0.8)),
        });
    }
    let found = motion(&fed, &model);
    assert!((found.manoeuvres.left_s - 10.0).abs() < 0.1, "{found:?}");
    assert!((found.manoeuvres.right_s - 10.0).abs() < 0.1, "{found:?}");
    assert!(
        (found.manoeuvres.on_the_spot_s - 10.0).abs() < 0.1,
        "{found:?}"
    );
    assert!((found.manoeuvres.moving_s - 30.0).abs() < 0.1, "{found:?}");
    assert!((found.wheel_interval_s - 0.02).abs() < 1.0e-6 && found.long_interval_ratio < 1.0e-9);
    // The speed changes once, where turns on the spot begin.
    assert!(found.manoeuvres.accelerating_s < 1.1, "{found:?}");
    let seldom: Vec<LoopInput> = fed.iter().step_by(10).copied().collect();
    let found = motion(&seldom, &model);
    assert!(
        (found.long_interval_ratio - 1.0).abs() < 1.0e-9,
        "{found:?}"
    );
    assert_eq!(motion(&[], &model), Motion::default());
}

proptest! {
    #[test]
    fn passes_are_disjoint_in_order_within_one_part_and_long_enough(
        stops in proptest::collection::vec((0.0..200.0_f64, 0.1..6.0_f64), 0..8),
        gaps in proptest::collection::vec((0.0..200.0_f64, 0.1..3.0_f64), 0..4),
        wanted_s in 8_u32..90,
    ) {
        let is_within = |spans: &[(f64, f64)], at_s: f64| {
            spans.iter().any(|(from_s, length_s)| (*from_s..from_s + length_s).contains(&at_s))
        };
        let mut fed = driven(|at_s| !is_within(&stops, at_s), 200.0);
        fed.retain(|fed| !is_within(&gaps, fed.sample.at.as_secs_f64()));
        let parts = parts(&fed);
        prop_assert_eq!(parts.iter().map(ExactSizeIterator::len).sum::<usize>(), fed.len());
        let found = all_passes(&fed, wanted_s);
        for pair in found.windows(2) {
            prop_assert!(pair[0].end <= pair[1].start);
        }
        for pass in &found {
            prop_assert!(parts.iter().any(|part| part.start <= pass.start && pass.end <= part.end));
            let (from_s, to_s) = times_s(&fed, pass);
            prop_assert!(to_s - from_s > 6.5, "{from_s} to {to_s}");
            prop_assert!(to_s - from_s < 2.0 * f64::from(wanted_s) + 0.1, "{from_s} to {to_s}");
        }
    }
}
