//! Properties of the gate over random commands and reasons.

use proptest::prelude::*;

use super::*;
use crate::geometry::Twist;

fn maybe(most: f64) -> impl Strategy<Value = Option<f64>> {
    prop_oneof![4 => Just(None), 3 => (0.0..most).prop_map(Some), 1 => Just(Some(f64::NAN))]
}

fn reasons() -> impl Strategy<Value = Reasons> {
    let rare = || prop::bool::weighted(0.1);
    let holds = (rare(), rare(), rare(), rare(), rare(), rare(), rare());
    let cap = || maybe(1.5);
    let caps = (maybe(0.9), cap(), cap(), cap(), cap(), cap());
    let real = prop_oneof![
        2 => Just(None),
        4 => (-1.5..1.5_f64).prop_map(Some),
        1 => Just(Some(f64::NAN)),
    ];
    (holds, caps, real).prop_map(|(holds, caps, real_m_s)| Reasons {
        is_stopped: holds.0,
        is_position_lost: holds.1,
        is_held_outside: holds.2,
        is_link_silent: holds.3,
        is_driver_silent: holds.4,
        is_loop_late: holds.5,
        is_sensor_wrong: holds.6,
        tilt_rad: caps.0,
        fence_max_m_s: caps.1,
        outside_max_m_s: caps.2,
        command_age_max_m_s: caps.3,
        blind_max_m_s: caps.4,
        sensors_max_m_s: caps.5,
        real_m_s,
    })
}

fn centre_m_s(speeds: WheelSpeeds) -> f64 {
    0.5 * RobotModel::yi2007().wheel_radius_m() * (speeds.left_rad_s + speeds.right_rad_s).abs()
}

/// Speed caps that are set; NaN and negative caps count as 0.
fn caps_of(reasons: &Reasons) -> impl Iterator<Item = (f64, GateCause)> + use<> {
    [
        (reasons.fence_max_m_s, GateCause::Fence),
        (reasons.outside_max_m_s, GateCause::ExternalLimit),
        (reasons.command_age_max_m_s, GateCause::CommandAge),
        (reasons.blind_max_m_s, GateCause::StalePosition),
        (reasons.sensors_max_m_s, GateCause::SensorFault),
    ]
    .into_iter()
    .filter_map(|(most_m_s, cause)| {
        let most_m_s = most_m_s?;
        Some((if most_m_s.is_nan() { 0.0 } else { most_m_s }, cause))
    })
}

/// Whether neither forward speed nor turn rate exceeds both the requested and the previous command.
fn is_within(limited: WheelSpeeds, before: WheelSpeeds, requested: WheelSpeeds) -> bool {
    let model = RobotModel::yi2007();
    let [limited, before, requested] =
        [limited, before, requested].map(|wheels| model.twist_from_wheel_speeds(wheels));
    let most = |before: f64, requested: f64| before.abs().max(requested.abs()) + 1.0e-9;
    limited.linear_m_s.abs() <= most(before.linear_m_s, requested.linear_m_s)
        && limited.angular_rad_s.abs() <= most(before.angular_rad_s, requested.angular_rad_s)
}

/// One tick of a gate with random input.
#[derive(Debug, Clone, Copy)]
struct AnyTick {
    command: Option<WheelSpeeds>,
    reasons: Reasons,
    stop: bool,
    feedback_age_s: f64,
    dt_s: f64,
}

fn any_tick() -> impl Strategy<Value = AnyTick> {
    let command = prop_oneof![
        1 => Just(None),
        9 => (speed(), speed()).prop_map(|(left_rad_s, right_rad_s)| Some(WheelSpeeds {
            left_rad_s,
            right_rad_s,
        })),
    ];
    let age_s = prop_oneof![6 => Just(0.0), 1 => 0.0..0.4_f64, 1 => Just(f64::NAN)];
    // On time, late, twice at the same time, and with an invalid time step.
    let dt_s = prop_oneof![
        8 => Just(0.01),
        2 => 0.0..0.2_f64,
        1 => Just(0.0),
        1 => Just(f64::NAN),
        1 => Just(-0.01),
    ];
    let calm = prop_oneof![2 => Just(Reasons::default()), 1 => reasons()];
    let is_stopped = prop::bool::weighted(0.05);
    (command, calm, is_stopped, age_s, dt_s).prop_map(
        |(command, reasons, stop, feedback_age_s, dt_s)| AnyTick {
            command,
            reasons,
            stop,
            feedback_age_s,
            dt_s,
        },
    )
}

fn speed() -> impl Strategy<Value = f64> {
    prop_oneof![8 => -60.0..60.0_f64, 1 => Just(f64::NAN), 1 => Just(f64::INFINITY)]
}

proptest! {
    #[test]
    fn the_gate_only_reduces(
        left in speed(), right in speed(), before_left in -20.0..20.0_f64,
        before_right in -20.0..20.0_f64, stop: bool, age_s in 0.0..0.4_f64,
        present: bool, dt_s in 0.001..0.05_f64,
    ) {
        let limits = GateLimits::of(&RobotModel::yi2007());
        let command = present.then_some(WheelSpeeds { left_rad_s: left, right_rad_s: right });
        let previous = WheelSpeeds { left_rad_s: before_left, right_rad_s: before_right };
        let input = GateInput { command, previous, stop, feedback_age_s: age_s, dt_s };
        let output = gate(&input, &limits);
        let requested = command.filter(|requested| requested.is_finite()).unwrap_or_default();
        prop_assert!(is_within(output.wheel_speeds, previous, requested));
        for (got, before) in [
            (output.wheel_speeds.left_rad_s, before_left),
            (output.wheel_speeds.right_rad_s, before_right),
        ] {
            prop_assert!(got.abs() <= limits.wheel_speed_max_rad_s.max(before.abs()) + 1.0e-9);
            let change = (got - before).abs();
            prop_assert!(change <= limits.wheel_acceleration_max_rad_s2 * dt_s + 1.0e-9);
            if stop || !present || age_s > limits.feedback_age_max_s {
                prop_assert!(got.abs() <= before.abs());
                prop_assert!(change <= 2.0 * limits.wheel_braking_max_rad_s2 * dt_s + 1.0e-9);
            }
        }
        if stop {
            prop_assert_eq!(output.cause, Some(GateCause::Stop));
        }
    }

    #[test]
    fn no_reason_ever_speeds_a_robot_up_and_the_strictest_is_named(
        left in speed(), right in speed(), before_left in -20.0..20.0_f64,
        before_right in -20.0..20.0_f64, reasons in reasons(), dt_s in 0.001..0.05_f64,
    ) {
        let limits = GateLimits::of(&RobotModel::yi2007());
        let command = WheelSpeeds { left_rad_s: left, right_rad_s: right };
        let previous = WheelSpeeds { left_rad_s: before_left, right_rad_s: before_right };
        let input = GateInput {
            command: Some(command), previous, stop: false, feedback_age_s: 0.0, dt_s,
        };
        let output = gate_with(&input, &reasons, &limits);
        let got = output.wheel_speeds;
        prop_assert!(got.is_finite());
        let requested = if command.is_finite() { command } else { WheelSpeeds::default() };
        prop_assert!(is_within(got, previous, requested));
        for (got, before) in [(got.left_rad_s, before_left), (got.right_rad_s, before_right)] {
            prop_assert!((got - before).abs() <= limits.wheel_acceleration_max_rad_s2 * dt_s + 1.0e-9);
        }
        if let Some(hold) = reasons.hold(&limits) {
            prop_assert_eq!(output.cause, Some(hold));
            prop_assert!(got.left_rad_s.abs() <= before_left.abs());
            prop_assert!(got.right_rad_s.abs() <= before_right.abs());
            // Along the present arc.
            let cross = got.left_rad_s * before_right - got.right_rad_s * before_left;
            prop_assert!(cross.abs() < 1.0e-6);
        }
        // After enough time every cap is kept.
        let mut settled = previous;
        for _ in 0..4_000 {
            let input = GateInput { previous: settled, ..input };
            settled = gate_with(&input, &reasons, &limits).wheel_speeds;
        }
        for (most_m_s, cause) in caps_of(&reasons) {
            prop_assert!(centre_m_s(settled) <= most_m_s + 1.0e-9, "{:?}", cause);
        }
    }

    #[test]
    fn of_several_caps_the_lowest_is_named_and_of_equal_ones_the_strictest(
        caps in prop::array::uniform5(prop_oneof![
            1 => Just(None),
            2 => prop::sample::select(vec![0.1, 0.2, 0.3, f64::NAN]).prop_map(Some),
        ]),
    ) {
        let model = RobotModel::yi2007();
        let [fence_max_m_s, outside_max_m_s, command_age_max_m_s, blind_max_m_s, sensors_max_m_s] = caps;
        let reasons = Reasons {
            fence_max_m_s,
            outside_max_m_s,
            command_age_max_m_s,
            blind_max_m_s,
            sensors_max_m_s,
            ..Reasons::default()
        };
        let wheels = model.wheel_speeds_from_twist(Twist { linear_m_s: 0.5, angular_rad_s: 0.1 });
        let input = GateInput {
            command: Some(wheels), previous: wheels, stop: false, feedback_age_s: 0.0, dt_s: 0.01,
        };
        let lowest_m_s = caps_of(&reasons).map(|cap| cap.0).fold(f64::INFINITY, f64::min);
        let binding = caps_of(&reasons).filter(|cap| cap.0 <= lowest_m_s).map(|cap| cap.1);
        let output = gate_with(&input, &reasons, &GateLimits::of(&model));
        prop_assert_eq!(output.cause, binding.max());
    }

    #[test]
    fn over_any_sequence_commands_keep_to_every_limit_of_speed_and_of_speeding_up(
        ticks in prop::collection::vec(any_tick(), 1..60),
    ) {
        let model = RobotModel::yi2007();
        let (gate_limits, limits) = (GateLimits::of(&model), *model.limits());
        let mut previous = WheelSpeeds::default();
        for tick in ticks {
            let input = GateInput {
                command: tick.command,
                previous,
                stop: tick.stop,
                feedback_age_s: tick.feedback_age_s,
                dt_s: tick.dt_s,
            };
            let output = gate_with(&input, &tick.reasons, &gate_limits);
            let got = output.wheel_speeds;
            prop_assert!(got.is_finite());
            let (before, after) = (
                model.twist_from_wheel_speeds(previous),
                model.twist_from_wheel_speeds(got),
            );
            prop_assert!(after.linear_m_s.abs() <= limits.linear_max_m_s + 1.0e-9);
            prop_assert!(after.angular_rad_s.abs() <= limits.angular_max_rad_s + 1.0e-9);
            prop_assert!(got.magnitude_max_rad_s() <= limits.wheel_speed_max_rad_s + 1.0e-9);
            // With an invalid time step, and while feedback is late, nothing speeds up.
            let is_timed = tick.dt_s.is_finite() && tick.dt_s > 0.0;
            let is_late = tick.feedback_age_s > 0.5 * gate_limits.feedback_age_max_s;
            let dt_s = if is_timed && !is_late { tick.dt_s } else { 0.0 };
            for (before, after, most) in [
                (before.linear_m_s, after.linear_m_s, limits.linear_acceleration_max_m_s2),
                (
                    before.angular_rad_s,
                    after.angular_rad_s,
                    model.angular_acceleration_max_rad_s2(),
                ),
            ] {
                let gained = most * dt_s + 1.0e-9;
                prop_assert!(after.abs() - before.abs() <= gained, "{} to {}", before, after);
                prop_assert!(before * after >= 0.0 || after.abs() <= gained);
            }
            let is_fresh = tick.feedback_age_s <= gate_limits.feedback_age_max_s;
            let hold = if tick.stop {
                Some(GateCause::Stop)
            } else {
                (!is_fresh)
                    .then_some(GateCause::StaleFeedback)
                    .max(tick.reasons.hold(&gate_limits))
            };
            let is_no_command = tick.command.is_none_or(|command| !command.is_finite());
            let is_timeless = !tick.dt_s.is_finite() || tick.dt_s < 0.0;
            if hold.is_some() || is_no_command || is_timeless {
                prop_assert_eq!(output.target, WheelSpeeds::default());
                prop_assert!(got.left_rad_s.abs() <= previous.left_rad_s.abs());
                prop_assert!(got.right_rad_s.abs() <= previous.right_rad_s.abs());
            }
            if hold.is_some() {
                prop_assert_eq!(output.cause, hold);
            }
            previous = got;
        }
    }

    #[test]
    fn a_stop_is_at_rest_within_the_time_of_the_braking_limit(
        left_rad_s in -20.0..20.0_f64, right_rad_s in -20.0..20.0_f64,
        spans_s in prop::collection::vec(0.001..0.2_f64, 2..400),
    ) {
        let limits = GateLimits::of(&RobotModel::yi2007());
        let mut previous = WheelSpeeds { left_rad_s, right_rad_s };
        let bound_s = previous.magnitude_max_rad_s() / limits.wheel_braking_max_rad_s2;
        let mut time_s = 0.0;
        for dt_s in spans_s {
            let input = GateInput {
                command: Some(previous), previous, stop: true, feedback_age_s: f64::NAN, dt_s,
            };
            previous = gate(&input, &limits).wheel_speeds;
            time_s += dt_s;
            prop_assert!(time_s < bound_s || previous == WheelSpeeds::default(), "{} s", time_s);
        }
    }

    #[test]
    fn silence_means_rest(
        before_left in -20.0..20.0_f64, before_right in -20.0..20.0_f64,
    ) {
        let limits = GateLimits::of(&RobotModel::yi2007());
        let mut previous = WheelSpeeds { left_rad_s: before_left, right_rad_s: before_right };
        for _ in 0..110 {
            let input = GateInput {
                command: None, previous, stop: false, feedback_age_s: 0.0, dt_s: 0.01,
            };
            previous = gate(&input, &limits).wheel_speeds;
        }
        prop_assert!(previous.magnitude_max_rad_s() <= 0.0);
    }
}

#[test]
fn a_robot_slower_than_its_wheels_is_not_pulled_on_while_they_brake() {
    let limits = GateLimits::of(&RobotModel::yi2007());
    let wheels = WheelSpeeds {
        left_rad_s: 6.0,
        right_rad_s: 7.0,
    };
    let rest = |real_m_s: Option<f64>| {
        let mut previous = wheels;
        for _ in 0..10 {
            let input = GateInput {
                command: None,
                previous,
                stop: true,
                feedback_age_s: 0.0,
                dt_s: 0.01,
            };
            let reasons = Reasons {
                real_m_s,
                ..Reasons::default()
            };
            previous = gate_with(&input, &reasons, &limits).wheel_speeds;
        }
        centre_m_s(previous)
    };
    let ramp_m_s = rest(None);
    assert!((0.30..0.40).contains(&ramp_m_s), "{ramp_m_s}");
    // A robot faster than its wheels, or of unknown speed, is braked on the ramp.
    for real_m_s in [0.6, f64::NAN] {
        assert!((rest(Some(real_m_s)) - ramp_m_s).abs() < 1.0e-12);
    }
    // Down to the robot's measured speed at the wheels' rate, and from there on the ramp.
    assert!(
        (0.15..=0.2).contains(&rest(Some(0.2))),
        "{}",
        rest(Some(0.2))
    );
    assert!(rest(Some(-0.2)) < 0.1);
}

#[test]
fn a_command_without_a_time_or_without_what_was_commanded_before_is_rest() {
    let limits = GateLimits::of(&RobotModel::yi2007());
    let wheels = WheelSpeeds {
        left_rad_s: 5.0,
        right_rad_s: 5.0,
    };
    let input = GateInput {
        command: Some(wheels),
        previous: wheels,
        stop: false,
        feedback_age_s: 0.0,
        dt_s: f64::NAN,
    };
    let output = gate(&input, &limits);
    assert_eq!(output.cause, Some(GateCause::NotFinite));
    assert!(
        output.wheel_speeds.left_rad_s < 5.0,
        "it brakes all the same"
    );
    let unknown = WheelSpeeds {
        left_rad_s: f64::NAN,
        right_rad_s: 5.0,
    };
    let input = GateInput {
        previous: unknown,
        dt_s: 0.01,
        ..input
    };
    let output = gate(&input, &limits);
    assert_eq!(output.cause, Some(GateCause::NotFinite));
    assert_eq!(output.wheel_speeds, WheelSpeeds::default());
}

#[test]
fn a_command_within_all_limits_passes_whole() {
    let limits = GateLimits::of(&RobotModel::yi2007());
    let command = WheelSpeeds {
        left_rad_s: 5.0,
        right_rad_s: 5.2,
    };
    let input = GateInput {
        command: Some(command),
        previous: WheelSpeeds {
            left_rad_s: 4.95,
            right_rad_s: 5.1,
        },
        stop: false,
        feedback_age_s: 0.01,
        dt_s: 0.01,
    };
    assert_eq!(
        gate(&input, &limits),
        GateOutput {
            wheel_speeds: command,
            target: command,
            cause: None
        }
    );
}
