//! The simulated base against what theory says about it.

use proptest::prelude::*;
use tread_control::friction::FrictionCurve;
use tread_control::geometry::{Pose, Twist};
use tread_control::measured::WheelSpeeds;
use tread_control::plant::{Ground, Plant, PlantSpec, PlantState};
use tread_control::robot::{GRAVITY_M_S2, RobotModel};

fn ground(stiffness: f64) -> Ground {
    Ground::uniform(FrictionCurve::with_stiffness(stiffness).expect("a positive stiffness"))
}

fn plant(spec: PlantSpec) -> Plant {
    Plant::new(RobotModel::yi2007(), spec, Pose::default()).expect("a valid plant")
}

fn settled(stiffness: f64, twist: Twist) -> Plant {
    let mut plant = plant(PlantSpec::default());
    let wheels = RobotModel::yi2007().wheel_speeds_from_twist(twist);
    for _ in 0..4000 {
        plant.step(wheels, &ground(stiffness), 0.005);
    }
    plant
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]

    #[test]
    fn a_gentle_turn_has_the_effective_track(
        stiffness in 0.5..20.0_f64, speed_m_s in 0.2..0.6_f64, curvature_1_m in -0.15..0.15_f64,
    ) {
        prop_assume!(curvature_1_m.abs() > 0.01);
        let twist = Twist { linear_m_s: speed_m_s, angular_rad_s: speed_m_s * curvature_1_m };
        let state = *settled(stiffness, twist).state();
        prop_assert!((state.yaw_rate_rad_s / twist.angular_rad_s - 1.0).abs() < 0.02);
        prop_assert!((state.forward_m_s / speed_m_s - 1.0).abs() < 0.01);
    }

    #[test]
    fn a_steady_turn_slides_sideways_by_theta(stiffness in 0.5..20.0_f64) {
        let twist = Twist { linear_m_s: 0.6, angular_rad_s: 0.1 };
        let state = *settled(stiffness, twist).state();
        // β = −v φ̇ θ/g.
        let sideslip_rad = -0.6 * 0.1 / (stiffness * GRAVITY_M_S2);
        prop_assert!((state.left_m_s / state.forward_m_s / sideslip_rad - 1.0).abs() < 0.03);
    }

    #[test]
    fn with_locked_wheels_energy_only_falls(
        stiffness in 0.5..20.0_f64, forward_m_s in -1.0..1.0_f64, left_m_s in -1.0..1.0_f64,
        yaw_rate_rad_s in -2.0..2.0_f64,
    ) {
        let model = RobotModel::yi2007();
        let mut plant = plant(PlantSpec::default());
        plant.set_state(PlantState { forward_m_s, left_m_s, yaw_rate_rad_s, ..PlantState::default() });
        let energy = |state: &PlantState| {
            0.5 * model.mass_kg() * (state.forward_m_s.powi(2) + state.left_m_s.powi(2))
                + 0.5 * model.yaw_inertia_kg_m2() * state.yaw_rate_rad_s.powi(2)
        };
        let mut before = energy(plant.state());
        for _ in 0..2000 {
            plant.step(WheelSpeeds::default(), &ground(stiffness), 0.005);
            let now = energy(plant.state());
            prop_assert!(now <= before + 1.0e-12);
            before = now;
        }
        prop_assert!(before < 1.0e-6, "{before} J are left");
    }

    #[test]
    fn any_command_keeps_the_state_finite_and_within_limits(
        stiffness in 0.2..40.0_f64,
        commands in proptest::collection::vec((-40.0..40.0_f64, -40.0..40.0_f64), 1..40),
    ) {
        let model = RobotModel::yi2007();
        let mut plant = plant(PlantSpec::default());
        for (left_rad_s, right_rad_s) in commands {
            for _ in 0..20 {
                plant.step(WheelSpeeds { left_rad_s, right_rad_s }, &ground(stiffness), 0.01);
                let state = plant.state();
                prop_assert!(state.pose.is_finite() && state.twist().is_finite());
                prop_assert!(
                    state.wheel_speeds.magnitude_max_rad_s()
                        <= model.limits().wheel_speed_max_rad_s + 1.0e-9
                );
                prop_assert!(state.forward_m_s.abs() < 2.0 && state.yaw_rate_rad_s.abs() < 12.0);
            }
        }
    }
}

#[test]
fn the_result_does_not_depend_on_the_callers_step() {
    for stiffness in [0.5, 5.0, 20.0] {
        let wheels = WheelSpeeds {
            left_rad_s: 5.0,
            right_rad_s: 8.0,
        };
        let run = |dt_s: f64, steps: u32| {
            let mut plant = plant(PlantSpec::default());
            for _ in 0..steps {
                plant.step(wheels, &ground(stiffness), dt_s);
            }
            plant.state().pose
        };
        let (fine, coarse) = (run(1.0e-4, 50_000), run(0.02, 250));
        let error_m = fine.point().distance_m(coarse.point());
        assert!(error_m < 1.0e-4, "K {stiffness}: {error_m} m after 5 s");
    }
}

#[test]
fn wheel_torque_is_force_times_radius_plus_rolling_resistance() {
    let model = RobotModel::yi2007();
    let mut plant = settled(
        5.0,
        Twist {
            linear_m_s: 0.6,
            angular_rad_s: 0.0,
        },
    );
    let rolling_n_m = 0.01 * model.side_load_n() * model.wheel_radius_m();
    let torques = plant.wheel_torques();
    assert!(
        (torques.left_n_m - rolling_n_m).abs() < 1.0e-4,
        "{torques:?}"
    );
    plant.step(
        WheelSpeeds {
            left_rad_s: 9.0,
            right_rad_s: 9.0,
        },
        &ground(5.0),
        0.05,
    );
    let force_n = model.mass_kg() * plant.means().acceleration.forward_m_s2;
    let torques = plant.wheel_torques();
    let drive_n =
        (torques.left_n_m + torques.right_n_m - 2.0 * rolling_n_m) / model.wheel_radius_m();
    assert!(force_n > 0.5 && (drive_n - force_n).abs() < 1.0e-2 * force_n);
}

#[test]
fn different_ground_under_the_two_sides_turns_a_robot_that_speeds_up() {
    let mut plant = plant(PlantSpec::default());
    let split = Ground {
        left: FrictionCurve::with_stiffness(0.5).unwrap(),
        right: FrictionCurve::with_stiffness(5.0).unwrap(),
    };
    for _ in 0..60 {
        plant.step(
            WheelSpeeds {
                left_rad_s: 12.0,
                right_rad_s: 12.0,
            },
            &split,
            0.005,
        );
    }
    assert!(plant.state().yaw_rate_rad_s > 0.01, "{:?}", plant.state());
}

#[test]
fn a_plant_out_of_range_is_refused() {
    for spec in [
        PlantSpec {
            servo_lag_s: f64::NAN,
            ..PlantSpec::default()
        },
        PlantSpec {
            servo_lag_s: -0.1,
            ..PlantSpec::default()
        },
        PlantSpec {
            left_radius_ratio: 0.0,
            ..PlantSpec::default()
        },
        PlantSpec {
            rolling_resistance_ratio: -1.0,
            ..PlantSpec::default()
        },
    ] {
        assert!(
            Plant::new(RobotModel::yi2007(), spec, Pose::default()).is_err(),
            "{spec:?}"
        );
    }
}
