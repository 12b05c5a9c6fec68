use proptest::prelude::*;
use tread_agent::drive::ros2::reading::Inertial;
use tread_agent::drive::ros2::refusal::Refusal;
use tread_agent::drive::ros2::settings::ImuSettings;
use tread_ros2::names::Name;

use super::*;
use crate::logs::mapping::tests::settings;

const MS: i64 = 1_000_000;

fn with_imu() -> Ros2Settings {
    let mut settings = settings();
    settings.joints = Some(tread_agent::drive::ros2::settings::JointSettings {
        topic: Name::default(),
        left: tread_agent::drive::ros2::settings::SideJoints {
            names: Vec::new(),
            sign: 1.0,
            effort_sign: 1.0,
        },
        right: tread_agent::drive::ros2::settings::SideJoints {
            names: Vec::new(),
            sign: 1.0,
            effort_sign: 1.0,
        },
        gear_ratio: 1.0,
        effort: tread_agent::drive::ros2::settings::Effort::None,
    });
    settings.imu = Some(ImuSettings {
        topic: Name::default(),
        frame: String::new(),
        yaw_rad: 0.0,
        is_upside_down: false,
    });
    settings
}

fn wheels(logged_ns: i64, stamp_ns: i64, left_rad_s: f64) -> Timed {
    Timed {
        source: Source::Joints,
        logged_ns,
        stamp_ns,
        content: Content::Wheels(Wheels {
            speeds: WheelSpeeds {
                left_rad_s,
                right_rad_s: 2.0 * left_rad_s,
            },
            torques: None,
        }),
    }
}

fn inertial(logged_ns: i64, stamp_ns: i64, yaw_rate_rad_s: f64) -> Timed {
    Timed {
        source: Source::Imu,
        logged_ns,
        stamp_ns,
        content: Content::Inertial(Inertial {
            yaw_rate_rad_s,
            yaw_rate_std_dev: None,
            acceleration: None,
            is_specific_force: false,
            acceleration_std_dev: None,
            tilt_rad: None,
        }),
    }
}

fn times_s(timeline: &Timeline) -> Vec<f64> {
    let times = timeline.fed.iter().map(|fed| since_begin_s(fed.sample.at));
    times.collect()
}

fn speeds(timeline: &Timeline) -> Vec<f64> {
    let speeds = timeline
        .fed
        .iter()
        .filter_map(|fed| fed.sample.wheel_speeds);
    speeds.map(|speeds| speeds.left_rad_s).collect()
}

#[test]
fn stamps_count_and_not_when_a_busy_recorder_wrote() {
    let mut refusals = Refusals::default();
    // Every fifth message is recorded with those after it.
    let timed = (0..100_i64).map(|index| {
        let stamp_ns = index * 20 * MS;
        let logged_ns = (index / 5 + 1) * 100 * MS;
        wheels(logged_ns, stamp_ns, 1.0)
    });
    let timeline = assemble(timed.collect(), &settings(), &mut refusals, false);
    assert_eq!(timeline.clocks, [(Source::Joints, Clock::Stamps)]);
    assert_eq!(refusals.iter().count(), 0);
    let seconds = times_s(&timeline);
    assert_eq!(seconds.len(), 100);
    for pair in seconds.windows(2) {
        assert!((pair[1] - pair[0] - 0.02).abs() < 1.0e-6, "{pair:?}");
    }
}

#[test]
fn another_clock_and_one_that_stands_still_are_distinguished() {
    let mut refusals = Refusals::default();
    let of = |stamp: fn(i64) -> i64| -> Vec<Timed> {
        let timed = (0..200_i64).map(|index| wheels(index * 20 * MS, stamp(index), 1.0));
        timed.collect()
    };
    let simulated = assemble(
        of(|index| index * 20 * MS - 50_000_000_000_000),
        &settings(),
        &mut refusals,
        false,
    );
    assert_eq!(simulated.clocks, [(Source::Joints, Clock::OtherStamps)]);
    let unset = assemble(of(|_| 0), &settings(), &mut refusals, false);
    assert_eq!(unset.clocks, [(Source::Joints, Clock::Recorder)]);
    for timeline in [simulated, unset] {
        let seconds = times_s(&timeline);
        assert_eq!(seconds.len(), 200);
        // The smallest delay is forgotten slowly, by half a thousandth of the time.
        assert!(
            (seconds[199] - seconds[0] - 199.0 * 0.02).abs() < 5.0e-3,
            "{}",
            seconds[199]
        );
    }
    assert_eq!(refusals.iter().count(), 0);
}

#[test]
fn what_comes_twice_or_late_is_counted_and_left_out() {
    let mut refusals = Refusals::default();
    let mut timed: Vec<Timed> = (0..50_i64)
        .map(|index| wheels(index * 20 * MS, index * 20 * MS, 1.0))
        .collect();
    timed.push(wheels(401 * MS, 400 * MS, 9.0));
    timed.push(wheels(403 * MS, 360 * MS, 9.0));
    timed.push(wheels(3_000 * MS, 500 * MS, 9.0));
    let timeline = assemble(timed, &settings(), &mut refusals, false);
    let counted: Vec<_> = refusals.iter().collect();
    assert!(
        counted.contains(&(Source::Joints, Refusal::OutOfOrder, 2)),
        "{counted:?}"
    );
    assert!(
        counted.contains(&(Source::Joints, Refusal::Stamp, 1)),
        "{counted:?}"
    );
    assert_eq!(speeds(&timeline).len(), 50);
    assert!(speeds(&timeline).iter().all(|speed| *speed < 2.0));
}

#[test]
fn the_gyro_is_averaged_between_wheel_messages_as_in_the_loop() {
    let mut refusals = Refusals::default();
    let mut timed = Vec::new();
    for index in 1..=100_i64 {
        let at_ns = index * 10 * MS;
        let turn = if index % 2 == 0 { 0.4 } else { 0.2 };
        timed.push(inertial(at_ns, at_ns, turn));
        if index % 2 == 0 {
            timed.push(wheels(at_ns, at_ns, 1.0));
        }
    }
    let timeline = assemble(timed, &with_imu(), &mut refusals, false);
    assert_eq!(timeline.fed.len(), 50);
    for fed in &timeline.fed {
        let turn = fed.sample.yaw_rate_rad_s.unwrap();
        assert!((turn - 0.3).abs() < 1.0e-12, "{turn}");
    }
}

proptest! {
    #[test]
    fn interpolation_keeps_what_was_measured_and_adds_what_lies_between(
        speeds_rad_s in proptest::collection::vec(-5.0..5.0_f64, 2..40), interval_ms in 20_i32..600,
    ) {
        let timed = || -> Vec<Timed> {
            let indexed = (0_i64..).zip(&speeds_rad_s);
            let interval_ms = i64::from(interval_ms);
            indexed.map(|(index, speed)| wheels(index * interval_ms * MS, index * interval_ms * MS, *speed)).collect()
        };
        let mut refusals = Refusals::default();
        let plain = assemble(timed(), &settings(), &mut refusals, false);
        let filled = assemble(timed(), &settings(), &mut refusals, true);
        prop_assert!(times_s(&filled).is_sorted());
        for fed in &plain.fed {
            prop_assert!(filled.fed.iter().any(|other| other.sample == fed.sample));
        }
        let is_filled = INTERPOLATED_RANGE_S.contains(&(f64::from(interval_ms) / 1.0e3));
        prop_assert_eq!(is_filled, filled.interpolated > 0);
        prop_assert_eq!(filled.fed.len() as u64, plain.fed.len() as u64 + filled.interpolated);
        let (least, most) = speeds_rad_s.iter().fold((f64::MAX, f64::MIN), |(least, most), speed| {
            (least.min(*speed), most.max(*speed))
        });
        for speed in speeds(&filled) {
            prop_assert!((least - 1.0e-12..=most + 1.0e-12).contains(&speed));
        }
        if is_filled {
            for pair in times_s(&filled).windows(2) {
                prop_assert!(pair[1] - pair[0] < 0.031, "{pair:?}");
            }
        }
    }
}
