//! Properties of plans and of the governor that walks along them.

use std::f64::consts::{PI, TAU};

use proptest::prelude::*;
use tread_control::geometry::{Point, Pose, wrap_angle_rad};
use tread_control::plan::{Plan, PlanError, WAYPOINTS_MAX};
use tread_control::reference::{Governor, GovernorInput};
use tread_control::robot::{RobotModel, RobotModelSpec};
use tread_control::trajectory::{CircleSpec, Direction, Trajectory, Waypoint, WaypointsSpec};

fn model() -> RobotModel {
    RobotModel::yi2007()
}

fn pose() -> impl Strategy<Value = Pose> {
    (-10.0..10.0_f64, -10.0..10.0_f64, -PI..PI).prop_map(|(x_m, y_m, heading_rad)| Pose {
        x_m,
        y_m,
        heading_rad,
    })
}

fn circle() -> impl Strategy<Value = Trajectory> {
    (
        -5.0..5.0_f64,
        -5.0..5.0_f64,
        0.3..8.0_f64,
        0.1..1.0_f64,
        any::<bool>(),
        0.1..2.0_f64,
    )
        .prop_map(|(x_m, y_m, radius_m, speed_m_s, left, turns)| {
            Trajectory::Circle(CircleSpec {
                center: Point { x_m, y_m },
                radius_m,
                speed_m_s,
                direction: if left {
                    Direction::CounterClockwise
                } else {
                    Direction::Clockwise
                },
                turns,
            })
        })
}

/// Waypoints a few steps apart, with any turn between them.
fn waypoints() -> impl Strategy<Value = Trajectory> {
    (
        pose(),
        proptest::collection::vec((0.5..4.0_f64, -2.5..2.5_f64, any::<bool>()), 2..12),
        0.2..1.0_f64,
    )
        .prop_map(|(start, steps, speed_m_s)| {
            let (mut at, mut heading_rad) = (start.point(), start.heading_rad);
            let mut points = vec![Waypoint::from(at)];
            for (step_m, turn_rad, slow) in steps {
                heading_rad += turn_rad;
                at.x_m += step_m * heading_rad.cos();
                at.y_m += step_m * heading_rad.sin();
                let speed_m_s = slow.then_some(0.5 * speed_m_s);
                points.push(Waypoint {
                    point: at,
                    speed_m_s,
                    heading_rad: None,
                });
            }
            Trajectory::Waypoints(WaypointsSpec { points, speed_m_s })
        })
}

fn trajectory() -> impl Strategy<Value = Trajectory> {
    prop_oneof![circle(), waypoints()]
}

fn asked_speed_m_s(trajectory: &Trajectory) -> f64 {
    match trajectory {
        Trajectory::Circle(circle) => circle.speed_m_s,
        Trajectory::Waypoints(waypoints) => waypoints.speed_m_s,
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn no_limit_is_exceeded_anywhere_along_a_plan(trajectory in trajectory(), start in pose()) {
        let model = model();
        let Ok(plan) = Plan::new(&trajectory, start, &model) else { return Ok(()) };
        let limits = model.limits();
        let dt_s = 0.01;
        let mut before = plan.sample(0.0);
        prop_assert!(before.speed_m_s <= 1.0e-9 && before.arc_m <= 1.0e-9);
        let mut time_s = 0.0;
        while time_s < plan.duration_s() + 0.1 {
            time_s += dt_s;
            let now = plan.sample(time_s);
            let turn_rad_s = (now.speed_m_s * now.path.curvature_1_m).abs();
            // Limits hold at the nodes; the slack is for the bends between them.
            prop_assert!(now.speed_m_s <= asked_speed_m_s(&trajectory) + 1.0e-9);
            prop_assert!(turn_rad_s <= 1.05 * limits.angular_max_rad_s, "{turn_rad_s} rad/s");
            prop_assert!(now.speed_m_s * turn_rad_s <= 1.05 * limits.lateral_acceleration_max_m_s2);
            prop_assert!(now.acceleration_m_s2.abs() <= limits.linear_acceleration_max_m_s2 + 1.0e-6);
            let wheel_rad_s = (now.speed_m_s + 0.5 * model.effective_track_m() * turn_rad_s)
                / model.wheel_radius_m();
            prop_assert!(wheel_rad_s <= limits.wheel_speed_max_rad_s);
            let jerk_m_s3 = (now.acceleration_m_s2 - before.acceleration_m_s2).abs() / dt_s;
            prop_assert!(jerk_m_s3 <= 1.01 * limits.linear_jerk_max_m_s3, "{jerk_m_s3} m/s³");
            // What is reported is consistent: speed is the change of place, heading its direction.
            prop_assert!(now.arc_m >= before.arc_m - 1.0e-9);
            let moved_m = before.path.pose.point().distance_m(now.path.pose.point());
            prop_assert!(moved_m <= now.arc_m - before.arc_m + 1.0e-6);
            prop_assert!((now.arc_m - before.arc_m - 0.5 * dt_s * (now.speed_m_s + before.speed_m_s)).abs() < 1.0e-4);
            let turned_rad =
                wrap_angle_rad(now.path.pose.heading_rad - before.path.pose.heading_rad).abs();
            prop_assert!(turned_rad <= 1.5 * limits.angular_max_rad_s * dt_s + 1.0e-6);
            before = now;
        }
        prop_assert!(before.speed_m_s <= 1.0e-6, "ends at {} m/s", before.speed_m_s);
        prop_assert!((before.arc_m - plan.length_m()).abs() < 1.0e-6);
    }

    #[test]
    fn a_path_passes_through_its_waypoints_in_order(trajectory in waypoints(), start in pose()) {
        let model = model();
        let Ok(plan) = Plan::new(&trajectory, start, &model) else { return Ok(()) };
        let Trajectory::Waypoints(spec) = &trajectory else { unreachable!("made above") };
        let step_m = 0.005;
        let mut arc_m = 0.0;
        for (index, waypoint) in spec.points.iter().enumerate() {
            let tolerance_m = if index == 0 { 0.05 } else { 0.5 * step_m + 1.0e-6 };
            while plan.path().sample(arc_m).pose.point().distance_m(waypoint.point) > tolerance_m {
                arc_m += step_m;
                prop_assert!(arc_m < plan.length_m() + step_m, "waypoint {index} is not passed");
            }
        }
    }

    #[test]
    fn a_plan_starts_where_the_robot_stands(trajectory in trajectory(), start in pose()) {
        let Ok(plan) = Plan::new(&trajectory, start, &model()) else { return Ok(()) };
        prop_assert!(plan.sample(0.0).path.pose.point().distance_m(start.point()) < 0.051);
    }

    #[test]
    fn curvature_is_continuous_along_a_path(trajectory in trajectory(), start in pose()) {
        let Ok(plan) = Plan::new(&trajectory, start, &model()) else { return Ok(()) };
        let step_m = 1.0e-5;
        for index in 0..400 {
            let arc_m = plan.length_m() * f64::from(index) / 400.0;
            let (here, there) = (plan.path().sample(arc_m), plan.path().sample(arc_m + step_m));
            let slope = (there.curvature_1_m - here.curvature_1_m) / step_m;
            let curved = 1.0 + here.curvature_slope_1_m2.abs().max(there.curvature_slope_1_m2.abs());
            prop_assert!((slope - here.curvature_slope_1_m2).abs() < 0.05 * curved, "at {arc_m} m");
        }
    }

    #[test]
    fn the_governor_never_jumps_and_never_goes_back(
        trajectory in trajectory(), start in pose(),
        inputs in proptest::collection::vec((0.0..0.6_f64, any::<bool>(), 0.0..1.0_f64), 1..60),
        stop_after in proptest::option::of(10_usize..60),
    ) {
        let model = model();
        let Ok(plan) = Plan::new(&trajectory, start, &model) else { return Ok(()) };
        let mut governor = Governor::new(&model);
        let mut before = governor.sample(&plan);
        let dt_s = 0.01;
        let hardest_m_s2 = model.limits().linear_acceleration_max_m_s2;
        for (step, (lag_m, saturated, cap)) in inputs.into_iter().enumerate() {
            governor.set_rate_cap(cap);
            if stop_after.is_some_and(|after| step == after) {
                governor.stop();
            }
            for _ in 0..20 {
                let input = GovernorInput { lag_m, along_track_m: lag_m, saturated };
                let now = governor.step(&plan, &input, dt_s);
                prop_assert!(now.arc_m >= before.arc_m - 1.0e-9);
                let change_m_s2 = (now.speed_m_s - before.speed_m_s).abs() / dt_s;
                prop_assert!(change_m_s2 < 2.0 * hardest_m_s2, "{change_m_s2} m/s²");
                before = now;
            }
        }
        if stop_after.is_some() {
            governor.stop();
            for _ in 0..1000 {
                governor.step(&plan, &GovernorInput::default(), dt_s);
            }
            prop_assert!(governor.is_stopped(&plan));
        }
    }
}

#[test]
fn the_governor_waits_for_a_robot_that_lags() {
    let model = model();
    let start = Pose {
        x_m: 6.0,
        y_m: 0.0,
        heading_rad: PI / 2.0,
    };
    let circle = Trajectory::Circle(CircleSpec {
        center: Point::default(),
        radius_m: 6.0,
        speed_m_s: 0.6,
        direction: Direction::CounterClockwise,
        turns: 1.0,
    });
    let plan = Plan::new(&circle, start, &model).unwrap();
    let mut governor = Governor::new(&model);
    for _ in 0..500 {
        governor.step(&plan, &GovernorInput::default(), 0.01);
    }
    let lag = GovernorInput {
        lag_m: 1.0,
        along_track_m: 1.0,
        saturated: false,
    };
    for _ in 0..500 {
        governor.step(&plan, &lag, 0.01);
    }
    let held = governor.sample(&plan);
    assert!(held.speed_m_s < 0.01, "{held:?}");
    for _ in 0..500 {
        governor.step(&plan, &GovernorInput::default(), 0.01);
    }
    assert!((governor.sample(&plan).speed_m_s - 0.6).abs() < 0.01);
}

#[test]
fn what_cannot_be_driven_is_refused_with_its_place() {
    let model = model();
    let start = Pose::default();
    let plan = |trajectory: Trajectory| Plan::new(&trajectory, start, &model).unwrap_err();
    let round = CircleSpec {
        center: Point::default(),
        radius_m: 2.0,
        speed_m_s: 0.5,
        direction: Direction::CounterClockwise,
        turns: 1.0,
    };
    let circle = |circle: CircleSpec| plan(Trajectory::Circle(circle));
    for radius_m in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(
            circle(CircleSpec { radius_m, ..round }),
            PlanError::Radius(_)
        ));
    }
    assert!(matches!(
        circle(CircleSpec {
            turns: 0.0,
            ..round
        }),
        PlanError::Turns(_)
    ));
    assert!(matches!(
        circle(CircleSpec {
            speed_m_s: 1.01,
            ..round
        }),
        PlanError::SpeedAboveLimit { waypoint: None, .. }
    ));
    assert!(matches!(
        circle(CircleSpec {
            speed_m_s: f64::NAN,
            ..round
        }),
        PlanError::NotFinite { waypoint: None, .. }
    ));
    let through = |places: &[(f64, f64)]| {
        plan(Trajectory::Waypoints(WaypointsSpec {
            points: places
                .iter()
                .map(|&(x_m, y_m)| Point { x_m, y_m }.into())
                .collect(),
            speed_m_s: 0.5,
        }))
    };
    assert_eq!(through(&[]), PlanError::TooFewWaypoints(0));
    assert_eq!(through(&[(1.0, 1.0)]), PlanError::TooFewWaypoints(1));
    assert_eq!(
        through(&[(1.0, 1.0), (2.0, 1.0), (2.0, 1.0)]),
        PlanError::DuplicateWaypoint { waypoint: 2 }
    );
    assert!(matches!(
        through(&[(1.0, 1.0), (2.0, f64::NAN)]),
        PlanError::NotFinite {
            waypoint: Some(1),
            ..
        }
    ));
    let many: Vec<_> = (0..=100_000_u32)
        .map(|index| (f64::from(index), 0.0))
        .collect();
    assert_eq!(
        through(&many),
        PlanError::TooManyWaypoints(WAYPOINTS_MAX + 1)
    );
}

#[test]
fn the_most_waypoints_are_planned_and_sampled() {
    let points = (0..100_000_u32)
        .map(|index| {
            let angle_rad = f64::from(index) * 0.01;
            Point {
                x_m: 0.1 * f64::from(index),
                y_m: angle_rad.sin(),
            }
            .into()
        })
        .collect();
    let trajectory = Trajectory::Waypoints(WaypointsSpec {
        points,
        speed_m_s: 0.8,
    });
    let plan = Plan::new(&trajectory, Pose::default(), &model()).unwrap();
    assert!(plan.length_m() > 10_000.0 && plan.duration_s() > plan.length_m() / 0.8);
    assert!(plan.peak_speed_m_s() <= 0.8 + 1.0e-9);
}

#[test]
fn there_and_back_is_a_path_without_a_point() {
    let points =
        [(0.0, 0.0), (4.0, 0.0), (0.0, 0.0)].map(|(x_m, y_m)| Waypoint::from(Point { x_m, y_m }));
    let trajectory = Trajectory::Waypoints(WaypointsSpec {
        points: points.to_vec(),
        speed_m_s: 0.5,
    });
    let plan = Plan::new(&trajectory, Pose::default(), &model()).unwrap();
    assert!(plan.length_m() < 16.0, "{} m", plan.length_m());
}

#[test]
fn a_robot_on_the_first_waypoint_starts_from_it() {
    let points = [(0.0, 0.0), (4.0, 1.0), (8.0, 0.0)];
    let points = points
        .map(|(x_m, y_m)| Waypoint::from(Point { x_m, y_m }))
        .to_vec();
    let trajectory = Trajectory::Waypoints(WaypointsSpec {
        points,
        speed_m_s: 0.5,
    });
    let start = Pose {
        x_m: 0.02,
        y_m: 0.01,
        heading_rad: 0.2,
    };
    let plan = Plan::new(&trajectory, start, &model()).unwrap();
    assert!(plan.approach_length_m() <= 0.0 && plan.length_m() < 9.0);
    assert!(wrap_angle_rad(plan.start_heading_rad() - 0.2).abs() < 1.0e-9);
}

#[test]
fn a_given_heading_and_speed_are_kept() {
    let points = vec![
        Waypoint::from(Point { x_m: 0.0, y_m: 0.0 }),
        Waypoint {
            point: Point { x_m: 4.0, y_m: 0.0 },
            speed_m_s: Some(0.2),
            heading_rad: Some(1.0),
        },
        Waypoint::from(Point { x_m: 8.0, y_m: 0.0 }),
    ];
    let trajectory = Trajectory::Waypoints(WaypointsSpec {
        points,
        speed_m_s: 0.8,
    });
    let plan = Plan::new(&trajectory, Pose::default(), &model()).unwrap();
    let (mut nearest, mut after_m_s) = ((f64::INFINITY, 0.0), 0.0_f64);
    for step in 0..4000 {
        let sample = plan.sample(plan.duration_s() * f64::from(step) / 4000.0);
        let pose = sample.path.pose;
        let away_m = pose.point().distance_m(Point { x_m: 4.0, y_m: 0.0 });
        if away_m < nearest.0 {
            nearest = (away_m, pose.heading_rad);
            after_m_s = 0.0;
        }
        after_m_s = after_m_s.max(sample.speed_m_s);
    }
    assert!((nearest.1 - 1.0).abs() < 0.02, "{nearest:?}");
    assert!(after_m_s <= 0.2 + 1.0e-6, "{after_m_s}");
    assert!(plan.peak_speed_m_s() > 0.6);
}

#[test]
fn slow_wheels_slow_the_plan() {
    let mut spec = RobotModelSpec::from(model());
    spec.limits.wheel_speed_max_rad_s = 6.0;
    let slow = RobotModel::try_from(spec).unwrap();
    let start = Pose {
        x_m: 0.5,
        y_m: 0.0,
        heading_rad: PI / 2.0,
    };
    let circle = Trajectory::Circle(CircleSpec {
        center: Point::default(),
        radius_m: 0.5,
        speed_m_s: 0.4,
        direction: Direction::CounterClockwise,
        turns: 1.0,
    });
    let plan = Plan::new(&circle, start, &slow).unwrap();
    assert!(plan.peak_speed_m_s() < 0.3 && plan.duration_s() > TAU * 0.5 / 0.3);
}

#[test]
fn hardly_any_random_path_is_refused_and_approaches_are_short() {
    use proptest::strategy::ValueTree;
    use proptest::test_runner::TestRunner;

    let mut runner = TestRunner::deterministic();
    let (mut refused, mut long, count) = (0, 0, 200);
    for _ in 0..count {
        let tree = (waypoints(), pose()).new_tree(&mut runner).unwrap();
        let (trajectory, start) = tree.current();
        let Trajectory::Waypoints(spec) = &trajectory else {
            unreachable!("made above")
        };
        let away_m = start.point().distance_m(spec.points[0].point);
        match Plan::new(&trajectory, start, &model()) {
            Ok(plan) => long += u32::from(plan.approach_length_m() > 1.8 * away_m + 2.0),
            Err(_) => refused += 1,
        }
    }
    assert!(refused * 50 <= count, "{refused} of {count} are refused");
    assert!(long * 50 <= count, "{long} of {count} make a detour");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]
    #[test]
    fn any_circle_can_be_joined_from_anywhere(circle in circle(), start in pose()) {
        let plan = Plan::new(&circle, start, &model());
        prop_assert!(plan.is_ok(), "{plan:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]
    #[test]
    fn a_robot_near_the_first_waypoint_gets_a_path(
        away_m in 0.0..0.6_f64, bearing_rad in -PI..PI, heading_rad in -PI..PI, step_m in 0.5..3.0_f64,
    ) {
        let start = Pose {
            x_m: away_m * bearing_rad.cos(),
            y_m: away_m * bearing_rad.sin(),
            heading_rad,
        };
        let points = [(0.0, 0.0), (1.0, 0.5), (2.0, 0.0), (3.0, -0.5)]
            .map(|(x, y)| Waypoint::from(Point { x_m: step_m * x, y_m: step_m * y }))
            .to_vec();
        let trajectory = Trajectory::Waypoints(WaypointsSpec { points, speed_m_s: 0.5 });
        let plan = Plan::new(&trajectory, start, &model());
        prop_assert!(plan.is_ok(), "{plan:?}");
    }
}
