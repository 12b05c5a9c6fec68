//! Checks whether the joints' effort can be the wheels' torque: its signs, gear ratio and torque
//! constant.
//!
//! Pure. No sensor measures torque independently, but two bounds hold. In a turn on the spot the
//! wheels scrub against the ground, so each side's torque has the sign of its rotation and
//! corresponds to a realistic friction coefficient: by the balance of moments of four equal
//! contacts, the force of a side is `μ·(m·g/2)·L/√(L² + W²)`. And the impulse of the wheels during
//! acceleration, above that of steady driving, is the momentum `m·v`, on any ground and slope, plus
//! that of the motors' inertia behind the gear. Errors by a factor of about four are found, of two
//! are not.

use tread_control::robot::RobotModel;

use super::drive_summary::{AccelerationPhase, DriveSummary, Drives};
use super::finding::{Finding, Key};
use crate::drive::ros2::settings::{Effort, JointSettings, Ros2Settings};

/// Ratio to a side's load below which a force against the motion counts as none.
const AGAINST_MIN: f64 = 0.02;
/// Ratio to a side's load up to which a force counts as zero.
const ZERO_MAX: f64 = 1e-6;
/// Realistic friction coefficients of scrubbing wheels, drive train included.
const FRICTION: std::ops::RangeInclusive<f64> = 0.1..=1.5;
/// Ratio of the wheels' impulse to the robot's momentum. Heavy rotors behind a high gear ratio can
/// multiply it; nothing can reduce it to a third.
const MOMENTUM_RATIO: std::ops::RangeInclusive<f64> = 0.4..=8.0;
/// Smallest speed gained, as a ratio to the command.
const GAINED_MIN: f64 = 0.5;

/// Measured effort, expressed in the quantities that are bounded.
#[derive(Debug, Clone, Copy)]
struct MeasuredEffort {
    /// Friction coefficients that correspond to each side's force in the turn, `[left, right]`;
    /// negative against the motion.
    friction: [f64; 2],
    /// Ratio of the wheels' impulse to the robot's momentum, if it gained enough speed.
    momentum_ratio: Option<f64>,
}

/// Returns the finding; `None` for joints without a torque.
pub(super) fn findings(
    settings: &Ros2Settings,
    model: &RobotModel,
    Drives { turned, forward }: &Drives,
) -> Option<Finding> {
    let joints = settings.joints.as_ref()?;
    let effort = joints.effort;
    (effort != Effort::None).then_some(())?;
    let measured = MeasuredEffort {
        friction: friction(model, turned)?,
        momentum_ratio: forward.acceleration.and_then(|acceleration| {
            let steady = forward.torques?;
            momentum_ratio(
                model,
                forward,
                &acceleration,
                steady.left_n_m + steady.right_n_m,
            )
        }),
    };
    let found = of_zero(&measured).or_else(|| of_signs(&measured, joints));
    Some(found.unwrap_or_else(|| of_size(&measured, effort, model)))
}

/// Returns the finding on joints whose effort is zero while their wheels scrub.
fn of_zero(measured: &MeasuredEffort) -> Option<Finding> {
    let is_zero = measured
        .friction
        .iter()
        .all(|friction| friction.abs() <= ZERO_MAX);
    is_zero.then(|| {
        let text = "the joints' effort is zero in a turn on the spot: it is not measured (`effort = \
                    \"none\"`)";
        Finding::on("torque").wrong(Key("drive.ros2.joints.effort"), text).with_line(
            Key("drive.ros2.joints.effort"),
            "\"none\"",
        )
    })
}

fn friction(model: &RobotModel, turned: &DriveSummary) -> Option<[f64; 2]> {
    let (torques, wheels) = (turned.torques?, turned.wheels?);
    let longitudinal = model.wheelbase_m() / model.wheelbase_m().hypot(model.track_width_m());
    let traction_n_m = model.wheel_radius_m() * model.side_load_n() * longitudinal;
    Some([
        torques.left_n_m * wheels.left_rad_s.signum() / traction_n_m,
        torques.right_n_m * wheels.right_rad_s.signum() / traction_n_m,
    ])
}

fn momentum_ratio(
    model: &RobotModel,
    forward: &DriveSummary,
    acceleration: &AccelerationPhase,
    steady_n_m: f64,
) -> Option<f64> {
    let commanded_rad_s = 0.5 * (forward.commanded.left_rad_s + forward.commanded.right_rad_s);
    (acceleration.gained_rad_s > GAINED_MIN * commanded_rad_s).then_some(())?;
    let gained_m_s = model.wheel_radius_m() * acceleration.gained_rad_s;
    let given_n_s =
        (acceleration.torque_n_m - steady_n_m) * acceleration.span_s / model.wheel_radius_m();
    Some(given_n_s / (model.mass_kg() * gained_m_s))
}

/// Returns the finding on an effort with the wrong sign.
fn of_signs(measured: &MeasuredEffort, joints: &JointSettings) -> Option<Finding> {
    let [is_left, is_right] = measured.friction.map(|friction| friction < -AGAINST_MIN);
    let (key, text) = match (is_left, is_right) {
        (true, true) => (
            "drive.ros2.joints.left_effort_sign",
            "in a turn on the spot the joints' effort points against their motion, which nothing but \
             its sign explains: give `left_effort_sign` and `right_effort_sign`",
        ),
        (true, false) => (
            "drive.ros2.joints.left_effort_sign",
            "in a turn on the spot the left joints' effort points against their motion, the right \
             joints' does not: its sign is wrong",
        ),
        (false, true) => (
            "drive.ros2.joints.right_effort_sign",
            "in a turn on the spot the right joints' effort points against their motion, the left \
             joints' does not: its sign is wrong",
        ),
        (false, false) => return None,
    };
    let wrong = Finding::on("torque").wrong(Key(key), text);
    let lines = [
        (
            is_left,
            Key("drive.ros2.joints.left_effort_sign"),
            joints.left.effort_sign,
        ),
        (
            is_right,
            Key("drive.ros2.joints.right_effort_sign"),
            joints.right.effort_sign,
        ),
    ];
    Some(lines.into_iter().filter(|(is_wrong, _, _)| *is_wrong).fold(
        wrong,
        |finding, (_, key, sign)| {
            let opposite = if sign > 0.0 { "-1" } else { "1" };
            finding.with_line(key, opposite)
        },
    ))
}

/// Returns the finding on the size of the effort.
fn of_size(measured: &MeasuredEffort, effort: Effort, model: &RobotModel) -> Finding {
    let [least, most] = [
        measured.friction.into_iter().fold(f64::INFINITY, f64::min),
        measured.friction.into_iter().fold(0.0, f64::max),
    ];
    let turn = format!(
        "a turn on the spot pulls as on ground with a friction coefficient of {least:.2} to {most:.2}"
    );
    let setting_off = measured.momentum_ratio.map_or_else(String::new, |ratio| {
        let mass_kg = model.mass_kg();
        format!(
            ", setting off as with {:.1} kg where the model says {mass_kg:.1} kg",
            ratio * mass_kg
        )
    });
    let ratio = measured.momentum_ratio;
    let verdict = if most > *FRICTION.end() || ratio.is_some_and(|it| it > *MOMENTUM_RATIO.end()) {
        "too much"
    } else if least < *FRICTION.start() || ratio.is_some_and(|it| it < *MOMENTUM_RATIO.start()) {
        "too little"
    } else {
        return Finding::on("torque").ok(format!("{turn}{setting_off}"));
    };
    let (key, hint, fits) = match effort {
        Effort::Current(n_m_a) => {
            let fits = ratio.filter(|ratio| *ratio > 0.0).map(|ratio| n_m_a / ratio);
            let hint = fits.map_or_else(
                || "the torque constant is another".to_owned(),
                |fits| format!("with {fits:.3} N·m/A, not {n_m_a:.3}, it would fit the mass"),
            );
            ("drive.ros2.joints.torque_constant_n_m_a", hint, fits)
        }
        Effort::Torque | Effort::None => (
            "drive.ros2.joints.effort",
            "it is no torque of the joints in newton metres, but perhaps a current, or the motors' \
             before a gear"
                .to_owned(),
            None,
        ),
    };
    let text = format!("{turn}{setting_off}: the joints' effort is {verdict}; {hint}");
    let wrong = Finding::on("torque").wrong(Key(key), text);
    match fits {
        Some(fits) => {
            let value = format!("{fits:.3}");
            wrong.with_line(Key("drive.ros2.joints.torque_constant_n_m_a"), value)
        }
        None => wrong,
    }
}

#[cfg(test)]
mod tests {
    use tread_control::measured::{WheelSpeeds, WheelTorques};

    use super::*;
    use crate::drive::ros2::tests::settings;

    /// Returns a turn and a start of the paper's robot on ground with this friction, with its
    /// torques multiplied by these factors.
    fn found(effort: Effort, friction: f64, factors: [f64; 2]) -> Option<Finding> {
        let model = RobotModel::yi2007();
        let mut settings = settings();
        let joints = settings.joints.take().unwrap();
        settings.joints = Some(JointSettings { effort, ..joints });
        let speeds = |left_rad_s, right_rad_s| WheelSpeeds {
            left_rad_s,
            right_rad_s,
        };
        let torques = |left: f64, right: f64| {
            Some(WheelTorques {
                left_n_m: left * factors[0],
                right_n_m: right * factors[1],
            })
        };
        let longitudinal = model.wheelbase_m() / model.wheelbase_m().hypot(model.track_width_m());
        let scrub_n_m = friction * longitudinal * model.side_load_n() * model.wheel_radius_m();
        let turned = DriveSummary {
            commanded: speeds(-2.0, 2.0),
            wheels: Some(speeds(-2.0, 2.0)),
            torques: torques(-scrub_n_m, scrub_n_m),
            ..DriveSummary::default()
        };
        // Uphill with half a newton metre per side, from rest to 2 rad/s within a second.
        let setting_off_n_m = model.mass_kg() * 2.0 * model.wheel_radius_m().powi(2);
        let forward = DriveSummary {
            commanded: speeds(2.0, 2.0),
            wheels: Some(speeds(2.0, 2.0)),
            torques: torques(0.5, 0.5),
            acceleration: Some(AccelerationPhase {
                torque_n_m: factors.iter().sum::<f64>() * 0.5 * (1.0 + setting_off_n_m),
                span_s: 1.0,
                gained_rad_s: 2.0,
            }),
            ..DriveSummary::default()
        };
        findings(&settings, &model, &Drives { turned, forward })
    }

    fn key(effort: Effort, friction: f64, factors: [f64; 2]) -> Option<&'static str> {
        found(effort, friction, factors).unwrap().key
    }

    #[test]
    fn a_plausible_torque_is_reported_with_friction_and_mass() {
        let well = found(Effort::Torque, 0.5, [1.0, 1.0]).unwrap();
        assert!(well.holds);
        assert!(well.text.contains("0.50 to 0.50"), "{}", well.text);
        let mass = format!("with {:.1} kg", RobotModel::yi2007().mass_kg());
        assert!(well.text.contains(&mass), "{}", well.text);
        for friction in [0.2, 1.1] {
            assert_eq!(key(Effort::Current(0.4), friction, [1.3, 0.8]), None);
        }
    }

    #[test]
    fn each_sign_of_effort_has_its_key() {
        let of = |factors| key(Effort::Torque, 0.5, factors);
        let [left, right] = [
            "drive.ros2.joints.left_effort_sign",
            "drive.ros2.joints.right_effort_sign",
        ];
        assert_eq!(of([-1.0, 1.0]), Some(left));
        assert_eq!(of([1.0, -1.0]), Some(right));
        assert_eq!(of([-1.0, -1.0]), Some(left));
        assert_eq!(of([-10.0, -10.0]), Some(left));
    }

    #[test]
    fn a_torque_constant_ten_times_off_is_reported_with_the_one_that_fits() {
        let constant = Effort::Current(0.5);
        let of_constant = Some("drive.ros2.joints.torque_constant_n_m_a");
        for (factor, fits) in [(10.0, "0.050 N·m/A"), (0.1, "5.000 N·m/A")] {
            let wrong = found(constant, 0.5, [factor, factor]).unwrap();
            assert_eq!(wrong.key, of_constant, "{}", wrong.text);
            assert!(wrong.text.contains(fits), "{}", wrong.text);
        }
        // On any ground; on ice the friction alone would fit a correct constant.
        for friction in [0.1, 0.3, 1.0] {
            for factor in [10.0, 0.1] {
                let named = key(constant, friction, [factor, factor]);
                assert_eq!(named, of_constant, "{friction} {factor}");
            }
        }
        let torque = key(Effort::Torque, 0.5, [0.1, 0.1]);
        assert_eq!(torque, Some("drive.ros2.joints.effort"));
    }

    #[test]
    fn a_side_that_says_nothing_is_not_hidden_by_the_other() {
        assert_eq!(
            key(Effort::Torque, 0.5, [0.0, 1.0]),
            Some("drive.ros2.joints.effort")
        );
    }

    #[test]
    fn an_effort_that_is_zero_in_motion_is_not_measured() {
        for effort in [Effort::Torque, Effort::Current(0.4)] {
            let wrong = found(effort, 0.5, [0.0, 0.0]).unwrap();
            assert_eq!(wrong.key, Some("drive.ros2.joints.effort"));
            assert!(wrong.text.contains("not measured"), "{}", wrong.text);
        }
    }

    #[test]
    fn joints_that_say_no_torque_are_not_judged() {
        assert_eq!(found(Effort::None, 0.5, [1.0, 1.0]), None);
    }
}
