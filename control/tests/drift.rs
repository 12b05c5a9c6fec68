//! Slope and rotation centre that the law adapts, on a robot that is exact but for them.
//!
//! The robot turns and drives as commanded, and slides by `β = −vωθ/g + θ s·n − κ x_c`. So nothing
//! but the sideslip is left to correct.

use proptest::prelude::*;
use tread_control::geometry::{Pose, Twist};
use tread_control::measured::Measured;
use tread_control::reference::ReferenceSample;
use tread_control::robot::{GRAVITY_M_S2, RobotModel};
use tread_control::tracking::{
    ThetaKnowledge, Tracker, TrackerConfig, TrackerError, TrackerOutput,
};

const LOOP_S: f64 = 0.01;
const SPEED_M_S: f64 = 0.5;
/// θ of the ground.
const THETA: f64 = 0.5;

/// What a robot does that its model does not say.
#[derive(Debug, Clone, Copy, Default)]
struct Robot {
    /// Fall over run of the ground along the site's axes.
    slope: [f64; 2],
    /// Rotation centre ahead of the middle, metres.
    center_forward_m: f64,
}

/// Curvature of a path at an arc length, and its slope, 1/m and 1/m².
type Bends = fn(f64) -> (f64, f64);

fn straight(_: f64) -> (f64, f64) {
    (0.0, 0.0)
}

/// A circle of 3 m.
fn circle(_: f64) -> (f64, f64) {
    (1.0 / 3.0, 0.0)
}

/// Bends to the left and to the right, of 2 m radius at the tightest.
fn slalom(arc_m: f64) -> (f64, f64) {
    let (sin, cos) = arc_m.sin_cos();
    (0.5 * sin, 0.5 * cos)
}

/// A loop of law and robot.
struct Run {
    tracker: Tracker,
    robot: Robot,
    bends: Bends,
    reference: ReferenceSample,
    pose: Pose,
    moved: Twist,
}

impl Run {
    fn new(config: TrackerConfig, robot: Robot, bends: Bends) -> Self {
        Self {
            tracker: Tracker::new(RobotModel::yi2007(), config).expect("valid gains"),
            robot,
            bends,
            reference: ReferenceSample::default(),
            pose: Pose::default(),
            moved: Twist {
                linear_m_s: SPEED_M_S,
                angular_rad_s: 0.0,
            },
        }
    }

    /// Measures, commands, and drives one tick; `changed` may alter what is measured.
    fn tick(&mut self, changed: impl Fn(&mut Measured)) -> TrackerOutput {
        self.tick_with(None, changed)
    }

    /// The same with a known θ.
    fn tick_with(
        &mut self,
        knowledge: Option<ThetaKnowledge>,
        changed: impl Fn(&mut Measured),
    ) -> TrackerOutput {
        let arc_m = self.reference.arc_m + LOOP_S * SPEED_M_S;
        let (curvature_1_m, rise_1_m2) = (self.bends)(arc_m);
        let middle_rad = self.reference.pose.heading_rad + 0.5 * LOOP_S * self.reference.turn_rad_s;
        self.reference = ReferenceSample {
            pose: advanced(
                self.reference.pose,
                middle_rad,
                SPEED_M_S,
                self.reference.turn_rad_s,
            ),
            speed_m_s: SPEED_M_S,
            acceleration_m_s2: 0.0,
            turn_rad_s: SPEED_M_S * curvature_1_m,
            turn_acceleration_rad_s2: SPEED_M_S * SPEED_M_S * rise_1_m2,
            curvature_1_m,
            arc_m,
        };
        let model = RobotModel::yi2007();
        let mut measured = Measured {
            pose: self.pose,
            twist: self.moved,
            wheel_speeds: model.wheel_speeds_from_twist(self.moved),
            pose_age_s: 0.0,
            position_std_dev_m: 0.0,
        };
        changed(&mut measured);
        let output = self
            .tracker
            .step(&self.reference, &measured, knowledge, LOOP_S);
        self.moved = output.twist;
        let Twist {
            linear_m_s,
            angular_rad_s,
        } = self.moved;
        let heading_rad = self.pose.heading_rad + 0.5 * LOOP_S * angular_rad_s;
        let (sin, cos) = heading_rad.sin_cos();
        let falls_left = -sin * self.robot.slope[0] + cos * self.robot.slope[1];
        let sideslip_rad = THETA * (falls_left - linear_m_s * angular_rad_s / GRAVITY_M_S2)
            - angular_rad_s / linear_m_s.max(0.05) * self.robot.center_forward_m;
        self.pose = advanced(
            self.pose,
            heading_rad + sideslip_rad,
            linear_m_s,
            angular_rad_s,
        );
        output
    }

    /// Root mean square of the cross-track error over the last third of a time, metres.
    fn drive(&mut self, ticks: u32) -> f64 {
        let (mut squares, mut count) = (0.0, 0.0);
        for tick in 0..ticks {
            let output = self.tick(|_| {});
            if 3 * tick >= 2 * ticks {
                squares += output.errors.cross_track_m.powi(2);
                count += 1.0;
            }
        }
        f64::sqrt(squares / count)
    }
}

/// A pose one tick later, of a body that moves into a direction and turns.
fn advanced(pose: Pose, direction_rad: f64, linear_m_s: f64, angular_rad_s: f64) -> Pose {
    let (sin, cos) = direction_rad.sin_cos();
    Pose {
        x_m: pose.x_m + LOOP_S * linear_m_s * cos,
        y_m: pose.y_m + LOOP_S * linear_m_s * sin,
        heading_rad: pose.heading_rad + LOOP_S * angular_rad_s,
    }
}

/// Whether slope or rotation centre differ.
fn has_moved(before: &TrackerOutput, now: &TrackerOutput) -> bool {
    let gaps = before.slope_loop_rad.into_iter().zip(now.slope_loop_rad);
    gaps.map(|(before, now)| (before - now).abs())
        .chain([(before.center_loop_m - now.center_loop_m).abs()])
        .any(|gap| gap > 0.0)
}

/// The law without slope and rotation centre.
fn without() -> TrackerConfig {
    TrackerConfig {
        slope_gain_1_m2: 0.0,
        center_gain: 0.0,
        ..TrackerConfig::default()
    }
}

#[test]
fn a_cross_slope_leaves_no_steady_error_on_a_straight() {
    // All of the integral action is the slope's, so that it alone can cancel the error.
    let config = |integral_share: f64| {
        let mut config = TrackerConfig {
            slope_gain_1_m2: 1.0e3,
            ..TrackerConfig::default()
        };
        config.quiet.integral_1_m3 *= integral_share;
        config.noisy.integral_1_m3 *= integral_share;
        config.steady.integral_1_m3 *= integral_share;
        config
    };
    let robot = Robot {
        slope: [0.0, 0.04],
        ..Robot::default()
    };
    let mut with = Run::new(config(1.0), robot, straight);
    let found_m = with.drive(6_000);
    let without_m = Run::new(config(0.0), robot, straight).drive(6_000);
    assert!(found_m < 6.0e-4, "{found_m} m");
    assert!(without_m > 5.0e-3, "{without_m} m");
    let [_, found_rad] = with.tick(|_| {}).slope_loop_rad;
    let expected_rad = THETA * robot.slope[1];
    assert!(
        (found_rad / expected_rad - 1.0).abs() < 0.3,
        "{found_rad} rad"
    );
}

#[test]
fn a_slope_under_a_circle_leaves_no_error_that_turns_with_the_robot() {
    let robot = Robot {
        slope: [0.03, -0.05],
        ..Robot::default()
    };
    let mut with = Run::new(TrackerConfig::default(), robot, circle);
    let found_m = with.drive(24_000);
    let without_m = Run::new(without(), robot, circle).drive(24_000);
    assert!(found_m < 1.2e-3, "{found_m} m");
    assert!(
        found_m < 0.5 * without_m,
        "{found_m} m with, {without_m} m without"
    );
}

#[test]
fn the_adapted_slope_points_downhill() {
    for slope in [[0.04, 0.0], [-0.04, 0.0], [0.0, 0.04], [0.03, -0.03]] {
        let robot = Robot {
            slope,
            ..Robot::default()
        };
        let mut run = Run::new(TrackerConfig::default(), robot, circle);
        run.drive(12_000);
        let found = run.tick(|_| {}).slope_loop_rad;
        let both = found[0] * slope[0] + found[1] * slope[1];
        let sizes = found[0].hypot(found[1]) * slope[0].hypot(slope[1]);
        assert!(both > 0.8 * sizes, "{found:?} of {slope:?}");
    }
}

#[test]
fn a_rotation_centre_off_by_three_centimetres_leaves_no_error_in_bends() {
    for center_forward_m in [-0.03, 0.03] {
        let robot = Robot {
            center_forward_m,
            ..Robot::default()
        };
        let mut with = Run::new(TrackerConfig::default(), robot, slalom);
        let found_m = with.drive(24_000);
        let without_m = Run::new(without(), robot, slalom).drive(24_000);
        assert!(found_m < 6.0e-4, "{found_m} m, {without_m} m without");
    }
}

#[test]
fn slope_and_rotation_centre_are_held_while_the_integral_is() {
    let robot = Robot {
        slope: [0.02, 0.05],
        center_forward_m: 0.02,
    };
    let mut run = Run::new(TrackerConfig::default(), robot, slalom);
    run.drive(500);
    let kept = |run: &mut Run, changed: fn(&mut Measured)| {
        let before = run.tick(changed);
        for _ in 0..10 {
            let now = run.tick(changed);
            assert!(!has_moved(&before, &now), "{now:?}");
        }
    };
    run.tracker.hold_adaptation(true);
    kept(&mut run, |_| {});
    run.tracker.hold_adaptation(false);
    kept(&mut run, |measured| measured.pose_age_s = 1.0);
    // A robot that would have to turn faster than it can.
    let turned: fn(&mut Measured) = |measured| measured.pose.heading_rad += 2.0;
    run.tick(turned);
    kept(&mut run, turned);
    let before = run.tick(|_| {});
    run.tick(|_| {});
    assert!(has_moved(&before, &run.tick(|_| {})), "it never adapted");
}

/// Largest cross-track error in the ten seconds after θ, known under way as 0.1, becomes 0.9 within
/// a time, on a circle on which the law has settled. Neither is the truth.
fn most_m_after(changes_s: f64) -> f64 {
    let mut run = Run::new(TrackerConfig::default(), Robot::default(), circle);
    for _ in 0..3_000 {
        run.tick(|_| {});
    }
    let (mut most_m, mut time_s) = (0.0_f64, 0.0);
    while time_s < changes_s + 10.0 {
        time_s += LOOP_S;
        let share = ((time_s - 2.0) / changes_s).clamp(0.0, 1.0);
        let knowledge = ThetaKnowledge {
            theta: 0.1 * 9.0_f64.powf(share),
            std_dev: 0.01,
        };
        let output = run.tick_with(Some(knowledge), |_| {});
        most_m = most_m.max(output.errors.cross_track_m.abs());
    }
    most_m
}

#[test]
fn a_measured_theta_that_drifts_does_not_disturb_a_law_that_has_settled() {
    let (drifts_m, jumps_m) = (most_m_after(8.0), most_m_after(1.0e-3));
    assert!(drifts_m < 5.0e-4, "{drifts_m} m");
    assert!(
        jumps_m > 2.0e-3,
        "{jumps_m} m: θ of other ground acts at once"
    );
}

#[test]
fn a_robot_that_stands_adapts_nothing() {
    let mut tracker = Tracker::new(RobotModel::yi2007(), TrackerConfig::default()).unwrap();
    let measured = Measured {
        pose: Pose {
            y_m: 0.1,
            ..Pose::default()
        },
        ..Measured::default()
    };
    for _ in 0..100 {
        let output = tracker.step(&ReferenceSample::default(), &measured, None, LOOP_S);
        assert!(!has_moved(&TrackerOutput::default(), &output), "{output:?}");
    }
}

#[test]
fn gains_and_bounds_out_of_range_are_refused() {
    let usual = TrackerConfig::default();
    for value in [-0.1, f64::NAN, f64::INFINITY] {
        for (field, config) in [
            (
                "slope_gain_1_m2",
                TrackerConfig {
                    slope_gain_1_m2: value,
                    ..usual
                },
            ),
            (
                "slope_drift_max_rad",
                TrackerConfig {
                    slope_drift_max_rad: value,
                    ..usual
                },
            ),
            (
                "center_gain",
                TrackerConfig {
                    center_gain: value,
                    ..usual
                },
            ),
            (
                "center_max_m",
                TrackerConfig {
                    center_max_m: value,
                    ..usual
                },
            ),
        ] {
            let Err(TrackerError::OutOfRange { field: named, .. }) =
                Tracker::new(RobotModel::yi2007(), config)
            else {
                panic!("{field} of {value} was taken");
            };
            assert_eq!(named, field);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn slope_and_rotation_centre_never_leave_their_bounds(
        slope_gain_1_m2 in 0.0..1.0e3_f64, center_gain in 0.0..1.0e3_f64,
        slope_drift_max_rad in 0.0..0.2_f64, center_max_m in 0.0..0.2_f64,
        jumps_m in proptest::collection::vec(-2.0..2.0_f64, 1..40),
    ) {
        let config = TrackerConfig {
            slope_gain_1_m2, slope_drift_max_rad, center_gain, center_max_m, ..TrackerConfig::default()
        };
        let mut run = Run::new(config, Robot::default(), slalom);
        for jump_m in jumps_m {
            for _ in 0..20 {
                let output = run.tick(|measured| measured.pose.y_m += jump_m);
                let [x, y] = output.slope_loop_rad;
                prop_assert!(x.hypot(y) <= slope_drift_max_rad + 1.0e-12);
                prop_assert!(output.center_loop_m.abs() <= center_max_m);
                prop_assert!(output.wheel_speeds.is_finite());
            }
        }
    }
}
