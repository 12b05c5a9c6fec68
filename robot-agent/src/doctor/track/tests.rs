use proptest::prelude::*;
use tread_control::measured::WheelSpeeds;
use tread_control::robot::{RobotModel, RobotModelSpec};

use super::*;
use crate::doctor::DriveSummary;
use crate::drive::ros2::tests::settings;

/// Independent model of a robot, with the forces of its four contacts computed individually.
#[derive(Debug, Clone, Copy)]
struct Truth {
    track_m: f64,
    wheelbase_m: f64,
    radius_m: f64,
    /// Ratio of lateral to longitudinal stiffness of every contact.
    ratio: f64,
    /// Track width by which the base converts a turn rate to wheel speeds.
    base_track_m: f64,
}

impl Truth {
    fn moment(&self, rim_m_s: f64, turn_rad_s: f64) -> f64 {
        let mut moment = 0.0;
        for (x_m, y_m) in [(0.5, 0.5), (0.5, -0.5), (-0.5, 0.5), (-0.5, -0.5)] {
            let (x_m, y_m) = (x_m * self.wheelbase_m, y_m * self.track_m);
            let rim_m_s = if y_m > 0.0 { -rim_m_s } else { rim_m_s };
            let (forward_m_s, left_m_s) = (-turn_rad_s * y_m - rim_m_s, turn_rad_s * x_m);
            let (force_x, force_y) = (-forward_m_s, -self.ratio * left_m_s);
            moment += x_m * force_y - y_m * force_x;
        }
        moment
    }

    /// Returns the turn rate at which the moments balance, by bisection.
    fn turn_rad_s(&self, rim_m_s: f64) -> f64 {
        let (mut slow, mut fast) = (0.0, 10.0);
        for _ in 0..80 {
            let middle = 0.5 * (slow + fast);
            if self.moment(rim_m_s, middle) > 0.0 {
                slow = middle;
            } else {
                fast = middle;
            }
        }
        0.5 * (slow + fast)
    }

    /// Returns the measurements of both motions with the track width `command_m` in the
    /// configured command.
    fn drive(&self, command_m: f64, noise: f64, bias_rad_s: f64) -> Drives {
        let commanded = 0.2 / self.radius_m;
        let wheels_rad_s = commanded * self.base_track_m / command_m;
        let turn_rad_s = self.turn_rad_s(wheels_rad_s * self.radius_m);
        let speeds = |left_rad_s, right_rad_s| WheelSpeeds {
            left_rad_s,
            right_rad_s,
        };
        let blocks = (0..8).map(|index| {
            let sign = if index % 2 == 0 { noise } else { -noise };
            TurnBlock {
                difference_rad_s: 2.0 * wheels_rad_s,
                turn_rad_s: turn_rad_s * (1.0 + sign) + bias_rad_s,
            }
        });
        Drives {
            turned: DriveSummary {
                commanded: speeds(-commanded, commanded),
                wheels: Some(speeds(-wheels_rad_s, wheels_rad_s)),
                turn_blocks: blocks.collect(),
                ..DriveSummary::default()
            },
            forward: DriveSummary {
                commanded: speeds(commanded, commanded),
                wheels: Some(speeds(commanded, commanded)),
                ..DriveSummary::default()
            },
        }
    }

    fn examined(&self, model_m: f64, command_m: f64, noise: f64, bias_rad_s: f64) -> Vec<Finding> {
        let spec = RobotModelSpec {
            track_width_m: model_m,
            wheelbase_m: self.wheelbase_m,
            wheel_radius_m: self.radius_m,
            ..RobotModelSpec::from(RobotModel::yi2007())
        };
        let model = RobotModel::try_from(spec).unwrap();
        let mut settings = settings();
        settings.command.base_track_m = command_m;
        findings(
            &settings,
            &model,
            &self.drive(command_m, noise, bias_rad_s),
            Calibration {
                radius_m: self.radius_m,
                gyro_bias_rad_s: bias_rad_s,
            },
        )
    }
}

fn keys(findings: &[Finding]) -> Vec<&'static str> {
    findings.iter().filter_map(|finding| finding.key).collect()
}

fn value(findings: &[Finding], table: &str) -> f64 {
    let mut lines = findings.iter().flat_map(|finding| &finding.lines);
    let line = lines.find(|line| line.table == table).unwrap();
    assert_eq!(line.key, "track_width_m");
    line.value.parse().unwrap()
}

const PAPER: Truth = Truth {
    track_m: 0.43,
    wheelbase_m: 0.28,
    radius_m: 0.08,
    ratio: 1.0,
    base_track_m: 0.43,
};

#[test]
fn a_track_of_six_tenths_on_a_robot_of_0_43_m_is_the_models_and_nothing_else() {
    // The command uses the model's track width unless it has its own.
    for command_m in [0.6, 0.43] {
        let found = PAPER.examined(0.6, command_m, 0.01, 0.0);
        assert_eq!(keys(&found), ["model.track_width_m"], "{found:#?}");
        let fits_m = value(&found, "model");
        assert!((fits_m - 0.43).abs() < 0.01, "{fits_m}");
    }
}

#[test]
fn a_wrong_track_of_the_command_alone_is_named_with_the_one_that_is_right() {
    for command_m in [0.3, 0.36, 0.5, 0.6, 0.9] {
        let found = PAPER.examined(0.43, command_m, 0.01, 0.0);
        assert_eq!(keys(&found), ["drive.ros2.command.track_width_m"]);
        let right_m = value(&found, "drive.ros2.command");
        assert!((right_m - 0.43).abs() < 0.002, "{right_m}");
    }
}

#[test]
fn a_base_with_a_multiplier_for_slip_is_named_by_its_own_track() {
    let with_multiplier = Truth {
        base_track_m: 0.612,
        ..PAPER
    };
    let found = with_multiplier.examined(0.43, 0.43, 0.01, 0.0);
    assert_eq!(keys(&found), ["drive.ros2.command.track_width_m"]);
    assert!((value(&found, "drive.ros2.command") - 0.612).abs() < 0.002);
}

#[test]
fn a_track_that_another_ground_explains_is_not_named_and_the_range_is_said() {
    let found = PAPER.examined(0.5, 0.43, 0.01, 0.0);
    assert_eq!(keys(&found), Vec::<&str>::new());
    let track = found
        .iter()
        .find(|finding| finding.name == "track")
        .unwrap();
    assert!(
        track.text.contains("effective track of 0.61"),
        "{}",
        track.text
    );
    assert!(track.text.contains("tracks from"), "{}", track.text);
}

#[test]
fn the_gyros_bias_is_taken_off_before_a_track_is_measured() {
    for bias_rad_s in [-0.2, 0.0, 0.2] {
        let found = PAPER.examined(0.43, 0.43, 0.01, bias_rad_s);
        assert_eq!(keys(&found), Vec::<&str>::new());
        assert!(found[2].text.contains("of 0.61"), "{}", found[2].text);
    }
}

proptest! {
    /// A correct configuration gives no finding, on any ground within the range.
    #[test]
    fn a_right_track_is_never_blamed(
        track_m in 0.2_f64..1.2,
        wheelbase_share in 0.3_f64..1.2,
        ratio in 0.45_f64..2.4,
        multiplier in 0.8_f64..2.0,
        noise in 0.0_f64..0.03,
    ) {
        let truth = Truth {
            track_m,
            wheelbase_m: wheelbase_share * track_m,
            radius_m: 0.1,
            ratio,
            base_track_m: multiplier * track_m,
        };
        let found = truth.examined(track_m, truth.base_track_m, noise, 0.0);
        prop_assert_eq!(keys(&found), Vec::<&str>::new());
    }

    /// The interval contains the true value.
    #[test]
    fn the_effective_track_lies_in_its_interval(
        track_m in 0.2_f64..1.2,
        wheelbase_share in 0.3_f64..1.2,
        ratio in 0.45_f64..2.4,
        noise in 0.0_f64..0.05,
    ) {
        let wheelbase_m = wheelbase_share * track_m;
        let truth = Truth { track_m, wheelbase_m, radius_m: 0.1, ratio, base_track_m: track_m };
        let turned = truth.drive(track_m, noise, 0.0).turned;
        let calibration = Calibration { radius_m: 0.1, gyro_bias_rad_s: 0.0 };
        let found = EffectiveTrack::measured(&turned.turn_blocks, calibration).unwrap();
        let expected_m = track_m + ratio * wheelbase_m.powi(2) / track_m;
        prop_assert!(found.least_m < expected_m && expected_m < found.most_m, "{found:?} {expected_m}");
        prop_assert!(found.most_m - found.least_m < 0.25 * expected_m);
    }

    /// A configured track width above the effective one is always reported.
    #[test]
    fn a_track_wider_than_the_effective_one_is_always_named(
        track_m in 0.2_f64..1.2,
        wheelbase_share in 0.3_f64..1.0,
        ratio in 0.45_f64..2.4,
        excess in 1.06_f64..2.0,
    ) {
        let wheelbase_m = wheelbase_share * track_m;
        let truth = Truth { track_m, wheelbase_m, radius_m: 0.1, ratio, base_track_m: track_m };
        let effective_m = track_m + ratio * wheelbase_m.powi(2) / track_m;
        let found = truth.examined(excess * effective_m, track_m, 0.005, 0.0);
        prop_assert_eq!(keys(&found), ["model.track_width_m"]);
    }
}
