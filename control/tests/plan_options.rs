//! What a plan and a mission may be asked beside the trajectory: approach speed, traction limit, excitation,
//! speed limit under way.

use proptest::prelude::*;
use tread_control::excitation::ExcitationSpec;
use tread_control::follower::{Follower, FollowerConfig};
use tread_control::geometry::{Point, Pose};
use tread_control::measured::Measured;
use tread_control::plan::{
    Plan, PlanError, PlanOptions, SlowedBy, TractionLimitCell, TractionLimitMap,
    TractionLimitMapSpec,
};
use tread_control::robot::{GRAVITY_M_S2, RobotModel};
use tread_control::trajectory::{CircleSpec, Direction, Trajectory, Waypoint, WaypointsSpec};

fn bends() -> Trajectory {
    let points = [(1.0, 0.5), (3.0, -1.0), (5.0, 1.0), (4.0, 4.0), (0.0, 3.0)];
    Trajectory::Waypoints(WaypointsSpec {
        points: points
            .map(|(x_m, y_m)| Waypoint::from(Point { x_m, y_m }))
            .to_vec(),
        speed_m_s: 0.7,
    })
}

fn circle() -> Trajectory {
    Trajectory::Circle(CircleSpec {
        center: Point::default(),
        radius_m: 6.0,
        speed_m_s: 0.6,
        direction: Direction::CounterClockwise,
        turns: 1.0,
    })
}

fn planned(trajectory: &Trajectory, start: Pose, options: &PlanOptions<'_>) -> Plan {
    let model = RobotModel::yi2007();
    Plan::with_options(trajectory, start, &model, options).expect("a path that can be driven")
}

/// Largest speed, acceleration and jerk along the path.
fn peaks(plan: &Plan) -> [f64; 3] {
    const STEP_S: f64 = 0.005;
    let mut peaks = [0.0_f64; 3];
    let mut time_s = 0.0;
    while time_s < plan.duration_s() {
        let (now, later) = (plan.sample(time_s), plan.sample(time_s + STEP_S));
        let jerk_m_s3 = (later.acceleration_m_s2 - now.acceleration_m_s2) / STEP_S;
        peaks[0] = peaks[0].max(now.speed_m_s);
        peaks[1] = peaks[1].max(now.acceleration_m_s2.abs());
        peaks[2] = peaks[2].max(jerk_m_s3.abs());
        time_s += STEP_S;
    }
    peaks
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]
    #[test]
    fn an_excitation_stays_on_the_path_and_within_every_limit(
        depth_ratio in 0.05..0.8_f64, period_s in 1.0..12.0_f64,
    ) {
        let excitation = Some(ExcitationSpec { depth_ratio, period_s });
        let options = PlanOptions { excitation, ..PlanOptions::default() };
        let plan = planned(&bends(), Pose::default(), &options);
        let limits = *RobotModel::yi2007().limits();
        let [speed, acceleration, jerk] = peaks(&plan);
        prop_assert!(speed <= 0.7 + 1.0e-9, "{speed} m/s");
        prop_assert!(acceleration <= limits.linear_acceleration_max_m_s2 + 1.0e-6);
        prop_assert!(jerk <= limits.linear_jerk_max_m_s3 + 0.02, "{jerk} m/s³");
        // Speed is the rate of the arc length, and the path ends where it should, at rest.
        let mut time_s = 0.1;
        while time_s < plan.duration_s() {
            let slope = (plan.sample(time_s + 1.0e-4).arc_m - plan.sample(time_s - 1.0e-4).arc_m)
                / 2.0e-4;
            prop_assert!((slope - plan.sample(time_s).speed_m_s).abs() < 1.0e-4);
            time_s += 0.31;
        }
        let end = plan.sample(plan.duration_s());
        prop_assert!((end.arc_m - plan.length_m()).abs() < 1.0e-6 && end.speed_m_s < 1.0e-6);
    }
}

#[test]
fn an_excitation_is_off_by_default_and_excites_when_asked_for() {
    let still = planned(&circle(), on_circle(), &PlanOptions::default());
    let options = PlanOptions {
        excitation: Some(ExcitationSpec::default()),
        ..PlanOptions::default()
    };
    let excited = planned(&circle(), on_circle(), &options);
    let power = |plan: &Plan| {
        (0_u32..300)
            .map(|step| {
                plan.sample(10.0 + 0.1 * f64::from(step))
                    .acceleration_m_s2
                    .powi(2)
            })
            .sum::<f64>()
            / 300.0
    };
    assert!(still.excitation().is_none() && power(&still) < 1.0e-12);
    assert!(power(&excited).sqrt() > 0.1, "{}", power(&excited).sqrt());
    assert!(excited.duration_s() > 1.1 * still.duration_s());
}

fn on_circle() -> Pose {
    Pose {
        x_m: 6.0,
        y_m: 0.0,
        heading_rad: std::f64::consts::FRAC_PI_2,
    }
}

#[test]
fn accelerations_stay_within_what_the_ground_can_give() {
    for mu in [0.05, 0.1, 0.5] {
        let options = PlanOptions {
            traction_limit_mu: Some(mu),
            ..PlanOptions::default()
        };
        let plan = planned(&bends(), Pose::default(), &options);
        let together = plan
            .peak_acceleration_m_s2()
            .hypot(plan.peak_lateral_acceleration_m_s2());
        assert!(
            together <= 0.71 * mu * GRAVITY_M_S2,
            "μ {mu}: {together} m/s²"
        );
    }
}

#[test]
fn a_plan_is_slow_only_where_the_ice_is_and_brakes_before_it() {
    const ICE_MU: f64 = 0.03;
    const HIGH_MU: f64 = 0.6;
    let squares = (-3..9_i32).flat_map(|ix| (-3..9_i32).map(move |iy| (ix, iy)));
    let squares = squares.map(|(ix, iy)| TractionLimitCell {
        ix,
        iy,
        mu: if ix >= 5 { ICE_MU } else { HIGH_MU },
    });
    let map = TractionLimitMap::new(TractionLimitMapSpec {
        square_m: 1.0,
        squares: squares.collect(),
        elsewhere_mu: 0.14,
    })
    .unwrap();
    let along = PlanOptions {
        traction_limits: Some(&map),
        ..PlanOptions::default()
    };
    let plan = planned(&bends(), Pose::default(), &along);
    let everywhere = |traction_limit_mu| {
        let options = PlanOptions {
            traction_limit_mu: Some(traction_limit_mu),
            ..PlanOptions::default()
        };
        planned(&bends(), Pose::default(), &options)
    };
    let (ice, traction_limit) = (everywhere(ICE_MU), everywhere(HIGH_MU));
    assert!(
        plan.duration_s() < 0.8 * ice.duration_s(),
        "{}",
        plan.duration_s()
    );
    assert!(
        plan.duration_s() > 1.0 + traction_limit.duration_s(),
        "{}",
        plan.duration_s()
    );
    let mut fastest_m_s: f64 = 0.0;
    let mut time_s = 0.0;
    while time_s < plan.duration_s() {
        let now = plan.sample(time_s);
        let mu = map.at(now.path.pose.point());
        let across_m_s2 = now.speed_m_s.powi(2) * now.path.curvature_1_m.abs();
        let most_m_s2 = 0.71 * mu * GRAVITY_M_S2;
        let together_m_s2 = now.acceleration_m_s2.hypot(across_m_s2);
        assert!(
            together_m_s2 <= most_m_s2 + 1.0e-6,
            "{together_m_s2} m/s² at {:?}, where μ is {mu}",
            now.path.pose
        );
        if mu > 0.5 {
            fastest_m_s = fastest_m_s.max(now.speed_m_s);
        }
        time_s += 0.01;
    }
    assert!(
        fastest_m_s > 0.6,
        "{fastest_m_s} m/s where the traction limit is high"
    );
    assert!(
        plan.slowed()
            .iter()
            .any(|slowed| slowed.by == SlowedBy::Traction)
    );
}

#[test]
fn the_approach_to_the_trajectory_may_be_quicker_than_the_trajectory() {
    let start = Pose {
        x_m: 0.5,
        ..Pose::default()
    };
    let options = PlanOptions {
        approach_speed_m_s: Some(1.0),
        ..PlanOptions::default()
    };
    let (quick, slow) = (
        planned(&circle(), start, &options),
        planned(&circle(), start, &PlanOptions::default()),
    );
    assert!(quick.peak_speed_m_s() > 0.9 && slow.peak_speed_m_s() <= 0.6 + 1.0e-9);
    let mut time_s = 0.0;
    while time_s < quick.duration_s() {
        let sample = quick.sample(time_s);
        if sample.arc_m > quick.approach_length_m() {
            assert!(sample.speed_m_s <= 0.6 + 1.0e-9, "{sample:?}");
        }
        time_s += 0.05;
    }
}

#[test]
fn options_that_are_no_numbers_are_refused() {
    let model = RobotModel::yi2007();
    let refused = |options: PlanOptions<'_>| {
        Plan::with_options(&circle(), Pose::default(), &model, &options).unwrap_err()
    };
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let traction_limit = PlanOptions {
            traction_limit_mu: Some(bad),
            ..PlanOptions::default()
        };
        assert!(
            refused(traction_limit)
                .to_string()
                .contains("the traction limit")
        );
        let approach = PlanOptions {
            approach_speed_m_s: Some(bad),
            ..PlanOptions::default()
        };
        refused(approach);
        let excitation = Some(ExcitationSpec {
            depth_ratio: bad,
            period_s: 3.0,
        });
        let excitation = PlanOptions {
            excitation,
            ..PlanOptions::default()
        };
        assert!(matches!(refused(excitation), PlanError::Excitation(_)));
    }
}

#[test]
fn a_speed_limit_under_way_is_met_without_a_jump_and_lifted_again() {
    const LOOP_S: f64 = 0.01;
    let model = RobotModel::yi2007();
    let plan = planned(&bends(), Pose::default(), &PlanOptions::default());
    let mut follower = Follower::new(plan, model, FollowerConfig::default()).expect("valid gains");
    let mut reference = follower.plan().sample(0.0).path.pose;
    let (mut before_m_s, mut limited_m_s, mut later_m_s) = (0.0, 0.0_f64, 0.0_f64);
    let mut driving = 0;
    for _ in 0..6000 {
        // A robot that is always where it should be.
        let measured = Measured {
            pose: reference,
            ..Measured::default()
        };
        let output = follower.step(&measured, None, LOOP_S);
        if output.status.is_final() {
            break;
        }
        reference = output.reference.pose;
        let speed_m_s = output.reference.speed_m_s;
        let most_m_s2 = 1.05 * model.limits().linear_acceleration_max_m_s2;
        assert!((speed_m_s - before_m_s).abs() <= most_m_s2 * LOOP_S + 1.0e-9);
        before_m_s = speed_m_s;
        if speed_m_s > 0.0 {
            driving += 1;
        }
        match driving {
            400 => follower.set_speed_limit(Some(0.25)),
            650..900 => limited_m_s = limited_m_s.max(speed_m_s),
            900 => follower.set_speed_limit(None),
            1100.. => later_m_s = later_m_s.max(speed_m_s),
            _ => {}
        }
    }
    assert!((0.2..=0.255).contains(&limited_m_s), "{limited_m_s} m/s");
    assert!(later_m_s > 0.4, "{later_m_s} m/s");
}
