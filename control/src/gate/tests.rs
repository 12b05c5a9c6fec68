//! What the gate promises, over random commands and reasons.

use proptest::prelude::*;

use super::*;

fn maybe(most: f64) -> impl Strategy<Value = Option<f64>> {
    prop_oneof![4 => Just(None), 3 => (0.0..most).prop_map(Some), 1 => Just(Some(f64::NAN))]
}

fn reasons() -> impl Strategy<Value = Reasons> {
    let rare = || prop::bool::weighted(0.1);
    let holds = (rare(), rare(), rare(), rare(), rare(), rare());
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
        is_sensor_wrong: holds.5,
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
        let wanted = command.filter(|wanted| wanted.is_finite()).unwrap_or_default();
        for (got, want, before) in [
            (output.wheel_speeds.left_rad_s, wanted.left_rad_s, before_left),
            (output.wheel_speeds.right_rad_s, wanted.right_rad_s, before_right),
        ] {
            // Never beyond both what was wanted and what the wheels already do.
            prop_assert!(got.abs() <= want.abs().max(before.abs()) + 1.0e-12);
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
        let wanted = if command.is_finite() { command } else { WheelSpeeds::default() };
        for (got, want, before) in [
            (got.left_rad_s, wanted.left_rad_s, before_left),
            (got.right_rad_s, wanted.right_rad_s, before_right),
        ] {
            prop_assert!(got.abs() <= want.abs().max(before.abs()) + 1.0e-12);
            prop_assert!((got - before).abs() <= limits.wheel_acceleration_max_rad_s2 * dt_s + 1.0e-9);
        }
        if let Some(hold) = reasons.hold(&limits) {
            prop_assert_eq!(output.cause, Some(hold));
            prop_assert!(got.left_rad_s.abs() <= before_left.abs());
            prop_assert!(got.right_rad_s.abs() <= before_right.abs());
            // Along the arc that was being driven.
            let cross = got.left_rad_s * before_right - got.right_rad_s * before_left;
            prop_assert!(cross.abs() < 1.0e-6);
        }
        // Given time, every cap is kept.
        let mut settled = previous;
        for _ in 0..4_000 {
            let input = GateInput { previous: settled, ..input };
            settled = gate_with(&input, &reasons, &limits).wheel_speeds;
        }
        for (most_m_s, cause) in reasons.caps() {
            let most_m_s = most_m_s.map_or(f64::INFINITY, |most| if most.is_nan() { 0.0 } else { most });
            prop_assert!(centre_m_s(settled) <= most_m_s + 1.0e-9, "{:?}", cause);
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
    // What is faster than its wheels, or not known, is braked on the ramp.
    for real_m_s in [0.6, f64::NAN] {
        assert!((rest(Some(real_m_s)) - ramp_m_s).abs() < 1.0e-12);
    }
    // Down to the robot's own speed at the wheels' rate, and from there on the ramp.
    assert!(
        (0.15..=0.2).contains(&rest(Some(0.2))),
        "{}",
        rest(Some(0.2))
    );
    assert!(rest(Some(-0.2)) < 0.1);
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
            left_rad_s: 4.9,
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
