//! The paper's closed forms against the sum over four wheels, each erratum by itself, and its
//! experiment of section IV.

use nalgebra::Vector2;
use proptest::prelude::*;
use tread_control::friction::{FrictionCurve, FrictionSpec};
use tread_control::measured::WheelSpeeds;
use tread_control::robot::{GRAVITY_M_S2, RobotModel};
use tread_control::slip::{BodyVelocity, SideSlips};
use tread_lab::paper::closed_form::{SlipShape, forces};
use tread_lab::paper::law::DesiredPoint;
use tread_lab::paper::reduced::{Reduced, ReducedError};
use tread_lab::paper::wheels::{TurningCentres, four_wheel_sum, lateral_forces_n};
use tread_lab::paper::{ClosedLoop, ClosedLoopState, Setting, Yi2007, Yi2007Config, Yi2007Error};

/// A random state: slips of both signs, in both ranges, below 1.
#[derive(Debug, Clone, Copy)]
struct Case {
    velocity: BodyVelocity,
    wheels: WheelSpeeds,
    setting: Setting,
}

fn slip() -> impl Strategy<Value = f64> {
    prop_oneof![-0.19..0.19_f64, 0.21..0.95_f64, -0.95..-0.21_f64]
}

/// Chooses slips and turn, and finds the wheel speeds that go with them.
fn case() -> impl Strategy<Value = Case> {
    let motion = (0.4..1.5_f64, -0.3..0.3_f64, 0.05..1.2_f64, any::<bool>());
    (motion, slip(), slip(), 0.3..25.0_f64, 0.0..0.95_f64).prop_map(
        |((forward, left, turn, right_handed), slip_left, slip_right, stiffness, sliding)| {
            let model = RobotModel::yi2007();
            let velocity = BodyVelocity {
                forward_m_s: forward,
                left_m_s: left,
                yaw_rate_rad_s: if right_handed { -turn } else { turn },
            };
            let half = 0.5 * model.track_width_m() * velocity.yaw_rate_rad_s;
            let wheels = WheelSpeeds {
                left_rad_s: (forward - half) / (1.0 - slip_left) / model.wheel_radius_m(),
                right_rad_s: (forward + half) / (1.0 - slip_right) / model.wheel_radius_m(),
            };
            let spec = FrictionSpec {
                stiffness,
                peak_slip: 0.2,
                sliding_ratio: sliding,
            };
            let curve = FrictionCurve::try_from(spec).expect("figures within their range");
            Case {
                velocity,
                wheels,
                setting: Setting { model, curve },
            }
        },
    )
}

fn close(found: f64, wanted: f64) -> bool {
    (found - wanted).abs() <= 1.0e-9 * (1.0 + wanted.abs())
}

/// Terms of (16) for a case, so that a wrong version can be written beside the right one.
struct Terms {
    shape: SlipShape,
    inputs: Vector2<f64>,
    scale: f64,
}

fn terms(case: &Case) -> Terms {
    let Setting { model, curve } = &case.setting;
    let slips = SideSlips::of(&case.velocity, case.wheels, model);
    let shape = SlipShape::at(slips, curve).expect("slips below one");
    Terms {
        inputs: shape.inputs(case.wheels, model.wheel_radius_m()),
        shape,
        scale: 0.25 * model.mass_kg() * GRAVITY_M_S2 * curve.stiffness(),
    }
}

proptest! {
    #[test]
    fn the_closed_form_is_the_sum_over_four_wheels_in_both_ranges(case in case()) {
        let sum = four_wheel_sum(&case.velocity, case.wheels, &case.setting);
        let closed = forces(&case.velocity, case.wheels, &case.setting).unwrap();
        prop_assert!(close(closed.longitudinal_n, sum.longitudinal_n), "{closed:?} {sum:?}");
        prop_assert!(close(closed.left_n, sum.left_n), "{closed:?} {sum:?}");
        prop_assert!(close(closed.moment_n_m, sum.moment_n_m), "{closed:?} {sum:?}");
    }

    #[test]
    fn every_lateral_force_opposes_its_slip(case in case()) {
        // (13) with the printed sign pushes the right side along its slip.
        let forces_n = lateral_forces_n(&case.velocity, case.wheels, &case.setting).unwrap();
        let half_base_m = 0.5 * case.setting.model.wheelbase_m();
        for (wheel, force_n) in forces_n.into_iter().enumerate() {
            let x_m = if wheel % 2 == 0 { half_base_m } else { -half_base_m };
            let skid_m_s = case.velocity.left_m_s + x_m * case.velocity.yaw_rate_rad_s;
            prop_assert!(force_n * skid_m_s <= 1.0e-12);
        }
        let sum = four_wheel_sum(&case.velocity, case.wheels, &case.setting);
        prop_assert!(close(forces_n.iter().sum(), sum.left_n));
        let printed_n = forces_n[0] + forces_n[1] - forces_n[2] - forces_n[3];
        let right_n = forces_n[2] + forces_n[3];
        prop_assume!(right_n.abs() > 1.0e-3);
        prop_assert!(!close(printed_n, sum.left_n));
    }

    #[test]
    fn the_lateral_row_as_printed_is_not_the_sum(case in case()) {
        // (16b) and (17): σ_r1 and σ_r2 change places. They agree in the linear range.
        let found = terms(&case);
        let (difference, sum) = (found.shape.ratio_difference, found.shape.ratio_sum);
        let row_n = |with_first: f64, with_second: f64| {
            -2.0 * found.scale
                * case.velocity.left_m_s
                * (found.inputs[1] * (1.0 + 0.5 * with_second) + 0.5 * with_first * found.inputs[0])
        };
        let (right_n, printed_n) = (row_n(difference, sum), row_n(sum, difference));
        prop_assume!((right_n - printed_n).abs() > 1.0e-3);
        let wheels = four_wheel_sum(&case.velocity, case.wheels, &case.setting);
        prop_assert!(close(right_n, wheels.left_n) && !close(printed_n, wheels.left_n));
    }

    #[test]
    fn the_yaw_row_needs_minus_a_quarter(case in case()) {
        // (16c) has +½L²φ̇σ_r1 where the sum has −¼.
        let found = terms(&case);
        let model = &case.setting.model;
        let sum = four_wheel_sum(&case.velocity, case.wheels, &case.setting);
        let term = model.wheelbase_m().powi(2) * case.velocity.yaw_rate_rad_s
            * found.shape.ratio_difference * found.inputs[0] * found.scale;
        let right = forces(&case.velocity, case.wheels, &case.setting).unwrap().moment_n_m;
        let printed = right + 0.75 * term;
        prop_assume!(term.abs() > 1.0e-3);
        prop_assert!(close(right, sum.moment_n_m) && !close(printed, sum.moment_n_m));
    }

    #[test]
    fn the_yaw_row_of_17_needs_its_half(case in case()) {
        let found = terms(&case);
        let model = &case.setting.model;
        let width = model.track_width_m().powi(2)
            + model.wheelbase_m().powi(2) * (1.0 + 0.5 * found.shape.ratio_sum);
        let term = found.scale * 0.5 * width * case.velocity.yaw_rate_rad_s * found.inputs[1];
        let sum = four_wheel_sum(&case.velocity, case.wheels, &case.setting);
        let right = forces(&case.velocity, case.wheels, &case.setting).unwrap().moment_n_m;
        prop_assume!(term.abs() > 1.0e-3);
        prop_assert!(close(right, sum.moment_n_m) && !close(right - term, sum.moment_n_m));
    }

    #[test]
    fn the_body_obeys_newton_over_the_ground(case in case(), heading_rad in -3.0..3.0_f64) {
        // Without the Coriolis terms that (14) lacks, even a free body would bend its path.
        let Case { velocity, wheels, setting } = case;
        let over_ground = |velocity: &BodyVelocity, heading_rad: f64| {
            let (sin, cos) = heading_rad.sin_cos();
            let (forward, left) = (velocity.forward_m_s, velocity.left_m_s);
            Vector2::new(cos * forward - sin * left, sin * forward + cos * left)
        };
        let force = four_wheel_sum(&velocity, wheels, &setting);
        let rates = force.rates(&velocity, &setting.model);
        let moved = |dt_s: f64| {
            let later = BodyVelocity {
                forward_m_s: velocity.forward_m_s + dt_s * rates.forward_m_s2,
                left_m_s: velocity.left_m_s + dt_s * rates.left_m_s2,
                yaw_rate_rad_s: velocity.yaw_rate_rad_s,
            };
            over_ground(&later, heading_rad + dt_s * velocity.yaw_rate_rad_s)
        };
        let dt_s = 1.0e-5;
        let found = (moved(dt_s) - moved(-dt_s)).scale(0.5 / dt_s);
        let pushed = BodyVelocity {
            forward_m_s: force.longitudinal_n, left_m_s: force.left_n, yaw_rate_rad_s: 0.0,
        };
        let wanted = over_ground(&pushed, heading_rad).scale(setting.model.mass_kg().recip());
        prop_assert!((found - wanted).norm() < 1.0e-6 * (1.0 + wanted.norm()));
    }

    #[test]
    fn skid_velocities_follow_from_the_turning_centres(case in case()) {
        let Case { velocity, wheels, setting } = case;
        let model = &setting.model;
        let centres = TurningCentres::of(&velocity, wheels, model).unwrap();
        let half_m = 0.5 * model.track_width_m();
        // (5) against (2) and (3).
        let skid_m_s = velocity.forward_m_s - half_m * velocity.yaw_rate_rad_s
            - model.wheel_radius_m() * wheels.left_rad_s;
        prop_assert!(close((centres.left_m - half_m) * velocity.yaw_rate_rad_s, skid_m_s));
        prop_assert!(close(centres.body_m * velocity.yaw_rate_rad_s, velocity.forward_m_s));
        prop_assert!(close(-centres.forward_m * velocity.yaw_rate_rad_s, velocity.left_m_s));
    }

    #[test]
    fn the_transformation_makes_the_reduced_model_linear(
        case in case(), tau_1 in -0.1..0.1_f64, tau_2 in -0.02..0.02_f64,
    ) {
        let reduced = Reduced::new(case.setting, 0.167).unwrap();
        let eta = Vector2::new(case.velocity.forward_m_s, -0.167 * case.velocity.yaw_rate_rad_s);
        let shape = terms(&case).shape;
        let tau = Vector2::new(tau_1, tau_2);
        let velocity = reduced.velocity(eta);
        let inputs = reduced.inputs(tau, &velocity, &shape).unwrap();
        let rates = reduced.rates_from_inputs(&velocity, inputs, &shape);
        let stiffness = case.setting.curve.stiffness();
        prop_assert!(close(rates[0], stiffness * tau_1) && close(rates[1], stiffness * tau_2));
    }

    #[test]
    fn the_reduced_model_is_the_constrained_four_wheel_sum(case in case()) {
        let reduced = Reduced::new(case.setting, 0.167).unwrap();
        let eta = Vector2::new(case.velocity.forward_m_s, -0.167 * case.velocity.yaw_rate_rad_s);
        let velocity = reduced.velocity(eta);
        let slips = SideSlips::of(&velocity, case.wheels, &case.setting.model);
        let shape = SlipShape::at(slips, &case.setting.curve).unwrap();
        let inputs = shape.inputs(case.wheels, case.setting.model.wheel_radius_m());
        let closed = reduced.rates_from_inputs(&velocity, inputs, &shape);
        let sum = reduced.rates_from_wheels(eta, case.wheels);
        prop_assert!(close(closed[0], sum[0]) && close(closed[1], sum[1]));
        let back = reduced.wheel_speeds(inputs, &shape).unwrap();
        prop_assert!(close(back.left_rad_s, case.wheels.left_rad_s));
        prop_assert!(close(back.right_rad_s, case.wheels.right_rad_s));
    }
}

fn section_iv() -> ClosedLoop {
    let law = Yi2007::new(Yi2007Config::section_iv()).expect("gains above zero");
    let start = ClosedLoopState::section_iv();
    ClosedLoop::new(law, 5.0, DesiredPoint::section_iv, start).expect("K above zero")
}

#[test]
fn section_iv_converges_and_its_theta_does_not() {
    let mut run = section_iv();
    let mut lyapunov = run.lyapunov().unwrap();
    let error_m = |run: &ClosedLoop| run.output().unwrap().error.norm();
    let mut found_m = vec![error_m(&run)];
    for step in 1..=120_000_u32 {
        run.step(1.0e-3).unwrap();
        let now = run.lyapunov().unwrap();
        assert!(
            now <= lyapunov + 1.0e-12,
            "V rose at {} s",
            run.state().time_s
        );
        lyapunov = now;
        if step % 10_000 == 0 {
            found_m.push(error_m(&run));
        }
    }
    for (place, wanted_m, by_m) in [
        (0, 3.0, 0.01),
        (1, 1.38, 0.01),
        (2, 0.51, 0.01),
        (4, 0.067, 0.003),
    ] {
        assert!((found_m[place] - wanted_m).abs() < by_m, "{found_m:?}");
    }
    let theta = run.state().theta;
    assert!((theta - 0.9747).abs() < 1.0e-3, "{theta}");
}

#[test]
fn lyapunovs_function_falls_by_xi_s_squared() {
    let mut run = section_iv();
    for _ in 0..2_000 {
        run.step(1.0e-3).unwrap();
    }
    let surface = run.output().unwrap().surface.norm_squared();
    let before = run.lyapunov().unwrap();
    run.step(1.0e-4).unwrap();
    let fall = (run.lyapunov().unwrap() - before) / 1.0e-4;
    assert!(
        (fall + 0.1 * surface).abs() < 1.0e-3 * surface,
        "{fall}, {surface}"
    );
}

#[test]
fn the_law_refuses_standstill_and_gains_that_are_none() {
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let config = Yi2007Config {
            rho: bad,
            ..Yi2007Config::section_iv()
        };
        let error = Yi2007::new(config).unwrap_err();
        assert!(error.to_string().contains("rho"), "{error}");
    }
    let law = Yi2007::new(Yi2007Config::section_iv()).unwrap();
    let still = ClosedLoopState {
        forward_m_s: 0.0,
        ..ClosedLoopState::section_iv()
    };
    let mut run = ClosedLoop::new(law, 5.0, DesiredPoint::section_iv, still).unwrap();
    assert!(matches!(run.step(1.0e-3), Err(Yi2007Error::Standstill(_))));
    let setting = Setting {
        model: RobotModel::yi2007(),
        curve: FrictionCurve::with_stiffness(5.0).unwrap(),
    };
    assert!(matches!(
        Reduced::new(setting, 0.0),
        Err(ReducedError::Centre(_))
    ));
    let reduced = Reduced::new(setting, 0.167).unwrap();
    let still = reduced.velocity(Vector2::zeros());
    let inputs = reduced.inputs(Vector2::zeros(), &still, &SlipShape::linear());
    assert_eq!(inputs, Err(ReducedError::Singular));
}
